"""What every effect is: one way in which a real sensor departs from the ideal one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, ClassVar, Literal, TypeVar, cast

from pydantic import Field

from scene.config import Config
from scene.keyed_random import KeyedRandom

StateT = TypeVar("StateT")


class Stage(IntEnum):
    """Where in a sensor's chain an effect acts; the chain runs in this order, whatever the order in a config."""

    AIM = 1  # TLS: from the pattern's direction to the emitted one
    FOOTPRINT = 2  # TLS: the beam's sub-rays
    RANGE = 3  # TLS: the recorded range
    POWER = 4  # TLS: the received power
    RETURN = 5  # TLS: returns kept, lost, first or last
    CAMERA = 11  # stereo: the real pair against the nominal one
    EXPOSE = 12  # stereo: image rows
    MATCH = 13  # stereo: disparity, in the order that sensors/matches.py gives
    FILL = 14  # stereo: cells without a match


class Effect(Config, ABC):
    """Base of all effects: a frozen set of parameters and a pure `apply`.

    A subclass declares `name` (the catalogue's, as a Literal field, so that it stands in configs), `sensor` and `stage`, its
    parameters through `parameter`, and `evaluate(state, random)`. At the parameters' null values `apply` is the identity, bit
    for bit. Signs: recorded = true + effect. Within a stage effects act by rising `order`; equal ones in the config's order.
    """

    name: str
    sensor: ClassVar[Literal["tls", "stereo"]]
    stage: ClassVar[Stage]
    order: ClassVar[int] = 0

    @property
    def is_null(self) -> bool:
        """Whether every parameter has the value at which the effect does nothing."""
        return all(getattr(self, key) == null for key, null in self.nulls().items())

    @classmethod
    def nulls(cls) -> dict[str, float]:
        """The value at which the effect does nothing, by parameter; a period or a phase has none."""
        extras = ((key, info.json_schema_extra) for key, info in cls.model_fields.items())
        return {
            key: cast(float, extra["null"]) for key, extra in extras if isinstance(extra, dict) and extra.get("null") is not None
        }

    def apply(self, state: StateT, random: KeyedRandom) -> StateT:
        """The state (`Pulses`, `Beam`, `CameraPair` or `Matches`) after this effect; `random` is the effect's own source."""
        return state if self.is_null else self.evaluate(state, random)

    @abstractmethod
    def evaluate(self, state: Any, random: KeyedRandom) -> Any:
        """The state after this effect, for parameters that are not null."""


def apply_stage(effects: Sequence[Effect], stage: Stage, state: StateT, random: KeyedRandom) -> StateT:
    """Apply the effects of one stage by rising `order`.

    Each draws from a child of `random` named by its name and its number among the effects of that name, so that the other effects
    of a config do not change its random numbers.
    """
    numbers: Counter[str] = Counter()
    for effect in sorted((effect for effect in effects if effect.stage == stage), key=lambda effect: effect.order):
        state = effect.apply(state, random.child(effect.name, numbers[effect.name]))
        numbers[effect.name] += 1
    return state


def parameter(
    meaning: str,
    *,
    unit: str,
    source: str,
    null: float | None = 0.0,
    default: float | None = None,
    typical: float | None = None,
    **bounds: float,
) -> Any:
    """A parameter of an effect: its meaning, unit, source, the value at which the effect is off, and bounds (ge, gt, le, lt).

    A `null` of None marks a parameter that does not switch the effect off (a period or a phase); it needs a `default`. The
    gallery shows the effect at its parameters' `typical` values (by default the `default`).
    """
    value = null if default is None else default
    extra: dict[str, Any] = {"unit": unit, "null": null, "source": source, "typical": default if typical is None else typical}
    limits: dict[str, Any] = dict(bounds)
    return Field(default=value, description=f"{meaning} [{unit}]", json_schema_extra=extra, **limits)
