"""Define what an effect is: one way in which a real sensor differs from the ideal one."""

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
    """Where in a sensor's chain of measurement an effect (an error or noise) acts, from the aim of a beam to recorded points.

    A simulation applies the effects in the order of the stages, whatever the order in a config. AIM, FOOTPRINT, RANGE, POWER
    and RETURN belong to a laser scanner; CAMERA, EXPOSE (image rows), MATCH (disparities), FILL (cells without a match) and
    POINT (recorded points) to a stereo pair.
    """

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
    """How an effect (a sensor's error or noise) becomes visible in a measurement.

    MEAN: ranges or disparities are systematically wrong. SPREAD: they scatter more. VALUES: they crowd at some values, as after
    rounding. RETURNS: some are missing. EDGES: edges of the surface are displaced. `scarpsim gap` searches each kind by another
    method.
    """

    MEAN = "mean"
    SPREAD = "spread"
    VALUES = "values"
    RETURNS = "returns"
    EDGES = "edges"


@dataclass(frozen=True)
class Search:
    """Declares that an effect is an error that repeats as a sine, and between which periods `scarpsim gap` searches.

    Attributes
    ----------
    period : str
        Name of the parameter that holds the period.
    along : str
        Quantity along which the sine repeats, such as the range or the image row.
    shortest, longest : float
        Shortest and longest period, in that quantity's unit; longest is None if the extent of the data is the limit.
    cycles : float
        Smallest number of cycles within the extent of the data.
    """

    period: str
    along: str
    shortest: float
    longest: float | None = None
    cycles: float = 1.0


class Effect(Config, ABC):
    """Base class of all effects, that is systematic errors and noise by which a real sensor differs from an ideal one.

    An effect is a frozen set of parameters with a method `apply` without side effects.

    A subclass declares `name` (as a Literal field, because configs contain it), `sensor`, `stage`, its parameters through
    `parameter`, and `evaluate(state, random)`. Where all parameters have their null values, at which the effect is off, `apply`
    changes nothing. Sign convention: recorded = true + effect. Effects of a stage act by ascending `order`, and equal ones in
    the config's order.

    Attributes
    ----------
    name : str
        Name in configs and in the catalogue.
    sensor, stage, order
        The sensor ("tls" or "stereo"), the stage of its chain of measurement, and the order within the stage.
    shows_in : ShowsIn
        How it becomes visible in a measurement.
    looks_at : str
        What it depends on: its own pulse or pixel ("element"), neighbouring ones, or the whole scan or image.
    needs : tuple of str
        Fields that the geometry of a measurement must have so that the effect can be fitted.
    catalogue : bool
        Whether `scarpsim gap` may name it.
    empirical : bool
        Whether it describes a pattern without naming a cause.
    planned : bool
        Whether `scarpsim inspect`, which predicts precision before a survey, takes it into account.
    means, act : str
        What it says about an instrument, and what to do about it, in sentences for reports.
    told_by : str
        For a noise that depends on a quantity, such as the range: what to measure to distinguish it from other noise.
    searched : Search, optional
        For an error that repeats as a sine of unknown period: where to search the period.
    sets : tuple of tuples of str
        Sets of parameters that `scarpsim gap` fits; by default all that switch the effect on, together.
    trials : (str, tuple of float), optional
        A parameter that `scarpsim gap` does not fit but tries at some values, and these values. A limit of a systematic error
        is tried relative to the error's size: the values hold for the typical one.
    shared : bool
        For noise: whether neighbouring pixels have similar errors.
    held_out_gain : float
        Increase of the log score on validation data above which `scarpsim gap` accepts the effect.
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
        """Raise TypeError if a class declares a searched sine but not the argument along which it runs."""
        if cls.searched is not None and cls.argument is Effect.argument:
            raise TypeError(f"{cls.__name__} declares `searched`; it needs `argument` too, what the sine runs along")

    @classmethod
    def tag(cls) -> str:
        """Return the name by which configs select this effect, such as "wobble"."""
        return cast(str, cls.model_fields["name"].default)

    @classmethod
    def scored(cls) -> bool:
        """Return whether `scarpsim gap` can judge the effect by a Gaussian log score of residuals.

        It can if the effect changes the mean or the scatter of ranges or disparities.
        """
        return cls.shows_in in (ShowsIn.MEAN, ShowsIn.SPREAD)

    @classmethod
    def known(cls, at: Any) -> bool:
        """Return whether the geometry of a measurement holds all that the effect's equation needs, such as the received power.

        at: geometry of pulses or pixels, whose missing quantities are None.
        """
        return all(getattr(at, name, None) is not None for name in cls.needs)

    @classmethod
    def typical_sizes(cls) -> dict[str, float]:
        """Return typical values of the effect's parameters, by name, for those parameters that are 0 when the effect is off."""
        found = {key: info.json_schema_extra for key, info in cls.model_fields.items()}
        return {
            key: float(known["typical"])  # type: ignore[arg-type]
            for key, known in found.items()
            if isinstance(known, dict) and known.get("null") == 0.0 and isinstance(known.get("typical"), float)
        }

    def argument(self, at: Any) -> FloatArray:
        """Return the quantity (n,) along which the effect repeats as a sine, such as the range, in the unit of its period.

        at: geometry of n pulses of a scanner or n pixels of a stereo pair, as NumPy arrays. Raises TypeError for an effect that
        is no sine with a searched period.
        """
        raise TypeError(f"{self.name} is not a searched sine")

    def mean(self, at: Any) -> FloatArray:
        """Return by how much the effect changes recorded ranges (m) or disparities (px) on average, (n,); 0 for pure noise.

        at: geometry of n pulses of a scanner (`PulseGeometry`) or n pixels of a stereo pair, as NumPy arrays.
        """
        return np.zeros(len(at))

    def variance(self, at: Any) -> FloatArray:
        """Return the variance (n,) that the effect adds to recorded ranges (m2) or disparities (px2).

        at: geometry of n pulses of a scanner or n pixels of a stereo pair, as NumPy arrays.
        """
        return np.zeros(len(at))

    def kept(self, at: Any) -> FloatArray:
        """Return the probability (n,) that the return of each pulse is not lost to the effect, such as rain.

        at: geometry of n pulses of a scanner, as NumPy arrays.
        """
        return np.ones(len(at))

    @property
    def is_null(self) -> bool:
        """Whether the effect is off: every parameter has its null value."""
        return all(getattr(self, key) == null for key, null in self.nulls().items())

    @classmethod
    def nulls(cls) -> dict[str, float]:
        """Return the values of the effect's parameters, by name, at which the effect is off; a period or a phase has none."""
        extras = ((key, info.json_schema_extra) for key, info in cls.model_fields.items())
        return {
            key: cast(float, extra["null"]) for key, extra in extras if isinstance(extra, dict) and extra.get("null") is not None
        }

    def apply(self, state: StateT, random: KeyedRandom) -> StateT:
        """Apply the effect to a simulated measurement: return its state after the effect.

        state: what the effect's stage acts on, such as `Pulses` of a scanner or `Matches` of a stereo pair. random: the
        effect's own source of random numbers.
        """
        return state if self.is_null else self.evaluate(state, random)

    @abstractmethod
    def evaluate(self, state: Any, random: KeyedRandom) -> Any:
        """Compute the state of a simulated measurement after this effect, for an effect that is not off; a subclass defines it.

        state: what the effect's stage acts on, such as `Pulses` of a scanner or `Matches` of a stereo pair. random: the
        effect's own source of random numbers.
        """


def apply_stage(effects: Sequence[Effect], stage: Stage, state: StateT, random: KeyedRandom) -> StateT:
    """Apply the effects (errors and noise) of one stage of a sensor's simulation, by ascending `order`.

    Each effect draws from a child of `random` named after the effect and its number among those of the same name, so that the
    other effects of a config do not change its random numbers.

    Parameters
    ----------
    effects : sequence of Effect
        Effects of any stage.
    stage : Stage
        The stage to apply.
    state
        What the stage acts on, such as `Pulses` of a scanner or `Matches` of a stereo pair.
    random : KeyedRandom
        Source of random numbers.

    Returns
    -------
    The changed state.
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
    """Declare a parameter of an effect, as a field of its class.

    Parameters
    ----------
    meaning : str
        What the parameter is.
    unit : str
        Its unit.
    source : str
        Paper, data sheet or "empirical".
    null : float or None
        Value at which the effect is off. None for a parameter that does not switch it off (a period, a phase), which needs a
        `default`.
    default : float, optional
        Default value; by default `null`.
    typical : float, optional
        Value of typical size, for the example on the effect's page; by default `default`.
    **bounds : float
        Limits of the value: ge (at least), gt (above), le (at most), lt (below).
    """
    value = null if default is None else default
    extra: dict[str, Any] = {"unit": unit, "null": null, "source": source, "typical": default if typical is None else typical}
    limits: dict[str, Any] = dict(bounds)
    return Field(default=value, description=f"{meaning} [{unit}]", json_schema_extra=extra, **limits)
