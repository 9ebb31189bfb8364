"""What every effect is: one way in which a real sensor departs from the ideal one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Any, ClassVar, Literal, TypeVar, cast

import numpy as np
from pydantic import Field

from scene.common.config import Config
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

StateT = TypeVar("StateT")
Sensor = Literal["tls", "stereo"]


class Stage(IntEnum):
    """Where in a sensor's chain an effect acts; the chain runs in this order, whatever the order in a config."""

    AIM = 1  # TLS: from the pattern's direction to the emitted one
    FOOTPRINT = 2  # TLS: the beam's sub-rays
    RANGE = 3  # TLS: the recorded range
    POWER = 4  # TLS: the received power
    RETURN = 5  # TLS: returns kept, lost, first or last
    CAMERA = 11  # stereo: the real pair against the nominal one
    EXPOSE = 12  # stereo: image rows
    MATCH = 13  # stereo: disparity, in the order that sensors/signal_chain/matches.py gives
    FILL = 14  # stereo: cells without a match
    POINT = 15  # stereo: the recorded points, m


class ShowsIn(StrEnum):
    """In what of a measurement an effect shows."""

    MEAN = "mean"  # ranges or disparities are off
    SPREAD = "spread"  # they scatter more
    VALUES = "values"  # they crowd at some values
    RETURNS = "returns"  # some are missing
    EDGES = "edges"  # the surface's edges are displaced


@dataclass(frozen=True)
class Search:
    """A sine whose period is searched.

    period: the parameter that holds it; along: the covariate it repeats along; shortest, longest: periods, in the covariate's
    unit, None where its reach is the bound; cycles: the fewest within that reach.
    """

    period: str
    along: str
    shortest: float
    longest: float | None = None
    cycles: float = 1.0


class Effect(Config, ABC):
    """Base of all effects: a frozen set of parameters and a pure `apply`.

    A subclass declares `name` (the catalogue's, as a Literal field, so that it stands in configs), `sensor` and `stage`, its
    parameters through `parameter`, and `evaluate(state, random)`. At the parameters' null values `apply` is the identity, bit
    for bit. Signs: recorded = true + effect. Within a stage effects act by rising `order`; equal ones in the config's order.

    What else is to be known of it stands here too, so that no other place decides by its name:
    shows_in; looks_at: its own pulse or pixel (`element`), neighbouring ones, or the whole scan or image; needs: fields that a
    measurement must have; catalogue: whether `scarpsim gap` may name it; empirical: a term that has no name; planned: whether a
    plan takes it into account; means, act: what it says of an instrument, and what to do about it, in sentences; told_by: what to
    measure to tell it, if it is a noise that depends on something, from others;
    searched: of a sine; sets: of its parameters that are tried (default: all that switch it on,
    together); trials: a parameter that is not fitted, with the values that are tried; shared: whether neighbours scatter alike;
    held_out_gain: log score on held-out data up to which it is not believed.
    """

    name: str
    sensor: ClassVar[Sensor]
    stage: ClassVar[Stage]
    order: ClassVar[int] = 0
    shows_in: ClassVar[ShowsIn]
    looks_at: ClassVar[Literal["element", "neighbours", "whole"]] = "element"
    needs: ClassVar[tuple[str, ...]] = ()
    catalogue: ClassVar[bool] = True
    empirical: ClassVar[bool] = False
    planned: ClassVar[bool] = False
    means: ClassVar[str] = ""
    act: ClassVar[str] = ""
    told_by: ClassVar[str] = ""
    searched: ClassVar[Search | None] = None
    sets: ClassVar[tuple[tuple[str, ...], ...]] = ()
    trials: ClassVar[tuple[str, tuple[float, ...]] | None] = None
    shared: ClassVar[bool] = False
    held_out_gain: ClassVar[float] = 0.0

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Raises TypeError where a class declares a searched sine and not what that runs along."""
        if cls.searched is not None and cls.argument is Effect.argument:
            raise TypeError(f"{cls.__name__} declares `searched`; it needs `argument` too, what the sine runs along")

    @classmethod
    def tag(cls) -> str:
        """The name that configs hold."""
        return cast(str, cls.model_fields["name"].default)

    @classmethod
    def scored(cls) -> bool:
        """Whether a Gaussian log score of residuals shows what the effect is worth."""
        return cls.shows_in in (ShowsIn.MEAN, ShowsIn.SPREAD)

    @classmethod
    def known(cls, at: Any) -> bool:
        """Whether a geometry holds all that the effect's equation needs."""
        return all(getattr(at, name, None) is not None for name in cls.needs)

    @classmethod
    def typical_sizes(cls) -> dict[str, float]:
        """Typical values of the parameters that are 0 where the effect is not there."""
        found = {key: info.json_schema_extra for key, info in cls.model_fields.items()}
        return {
            key: float(known["typical"])  # type: ignore[arg-type]
            for key, known in found.items()
            if isinstance(known, dict) and known.get("null") == 0.0 and isinstance(known.get("typical"), float)
        }

    def argument(self, at: Any) -> FloatArray:
        """(n,) what a searched sine runs along, in the unit of its period. Raises TypeError where the effect is none."""
        raise TypeError(f"{self.name} is no searched sine")

    def mean(self, at: Any) -> FloatArray:
        """(n,) by how much the effect changes a recorded range (m) or disparity (px) on average.

        at: what the sensor's equations look at, as host arrays (`PulseGeometry`, or the pixels' geometry of a stereo pair).
        """
        return np.zeros(len(at))

    def variance(self, at: Any) -> FloatArray:
        """(n,) variance that the effect adds to a recorded range (m2) or disparity (px2)."""
        return np.zeros(len(at))

    def kept(self, at: Any) -> FloatArray:
        """(n,) probability that a return is not lost to the effect."""
        return np.ones(len(at))

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
        """The state (`Pulses`, `Beam`, `CameraPair`, `Matches`, `RecordedPoints`) after this effect; `random`: its own source."""
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
