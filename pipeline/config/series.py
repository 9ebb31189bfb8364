"""Define the section `series` of a config: a wall over time."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from scene.common.config import Config
from scene.common.course import Course
from scene.geometry.mesh import FloatArray
from scene.series.config import DepositsConfig, EventConfig, PrecursorConfig, RockfallRate
from sensors.models.conditions import EffectCourses, PoseCourses

MOST_EPOCHS = 10_000
"""Most epochs of a series, the reference included."""
_HOUR = timedelta(hours=1)


class RegularTimes(Config):
    """Times of the epochs of a series, at equal intervals."""

    start: datetime = Field(description="time of the reference, ISO 8601, such as 2026-03-01T00:00:00Z")
    every_h: float = Field(1.0, gt=0, le=1e5, description="interval [h]")
    count: int = Field(ge=2, le=MOST_EPOCHS, description="number of epochs, the reference included")


Times = Annotated[
    Annotated[RegularTimes, Tag("regular")]
    | Annotated[Annotated[tuple[datetime, ...], Field(min_length=2, max_length=MOST_EPOCHS)], Tag("list")],
    Discriminator(lambda value: "list" if isinstance(value, list | tuple) else "regular"),
]


class ConditionsConfig(Config):
    """What changes from epoch to epoch besides the rock: pose and errors of the sensor, snow and vegetation.

    Each value is a course over time: a random_walk, a drift, a cycle or a table.
    """

    pose: PoseCourses | None = Field(None, description="real minus surveyed pose of the sensor")
    effects: EffectCourses = Field(
        {}, description="parameters of effects, as `range_scale: {cycle: {amplitude: 5}}` or `wobble: {amplitude_m: ..}`"
    )
    snow_m: Course | None = Field(None, description="thickness of snow on level rock [m]")
    vegetation_m: Course | None = Field(None, description="height of vegetation in patches on the rock [m]")


class SeriesConfig(Config):
    """Settings of a time series: times of the epochs, and how the wall and the conditions of measurement change between them.

    Rocks that fall stay fallen, can move before, and can lie at the foot of the wall afterwards.
    """

    times: Times = Field(description="times of the epochs, the reference first: start, every_h, count; or a list")
    cumulative: bool = Field(True, description="what fell stays fallen; false: an epoch has only what fell since the last")
    rockfall: RockfallRate | None = Field(None, description="rockfalls at random; none: only `events`")
    events: tuple[EventConfig, ...] = Field((), max_length=10_000, description="rockfalls by hand")
    precursor: PrecursorConfig | None = Field(None, description="how random rockfalls move before; none: not at all")
    deposits: DepositsConfig | None = Field(None, description="`true`: fragments of fallen rock lie at the foot of the wall")
    surfaces: tuple[Path, ...] = Field((), description="instead of rockfalls: own meshes, one an epoch, the reference first")
    conditions: ConditionsConfig = ConditionsConfig()
    kinds: bool = Field(
        False,
        description="categories of annotations: `true`: missing, moved and deposited rock; `false`: missing rock only, as block",
    )

    @field_validator("deposits", mode="before")
    @classmethod
    def _off(cls, value: Any) -> Any:
        return None if value is False else value

    @field_validator("times")
    @classmethod
    def _increasing(cls, times: RegularTimes | tuple[datetime, ...]) -> RegularTimes | tuple[datetime, ...]:
        listed = [utc(each) for each in times] if isinstance(times, tuple) else []
        if any(after <= before for before, after in itertools.pairwise(listed)):
            raise ValueError("times must increase")
        return times

    @model_validator(mode="after")
    def _consistent(self) -> SeriesConfig:
        if self.surfaces:
            if self.rockfall or self.events or self.precursor or self.deposits:
                raise ValueError("`surfaces` replace rockfall, events, precursor and deposits: leave those out")
            if len(self.surfaces) != self.count:
                raise ValueError(f"{len(self.surfaces)} surfaces for {self.count} epochs: give one for each, the reference first")
        if self.precursor is not None and self.rockfall is None:
            raise ValueError("`precursor` is that of `rockfall`; give events one of their own")
        early = [event for event in self.events if event.time is not None and self.hours_of(event.time) <= 0]
        if early:
            raise ValueError(f"an event at {early[0].time} is not after the first epoch, {self.when(0).isoformat()}")
        return self

    @property
    def count(self) -> int:
        """Number of epochs in the series, the reference included."""
        return len(self.times) if isinstance(self.times, tuple) else self.times.count

    def when(self, number: int) -> datetime:
        """Return the time of an epoch, in UTC; `number` counts from 0, the reference."""
        if isinstance(self.times, tuple):
            return utc(self.times[number])
        return utc(self.times.start) + number * self.times.every_h * _HOUR

    def hours_of(self, time: datetime) -> float:
        """Convert a time of a series to hours after its first epoch."""
        return (utc(time) - self.when(0)) / _HOUR

    @property
    def hours(self) -> FloatArray:
        """(count,) times of the epochs of the series, h after the first."""
        return np.array([self.hours_of(self.when(number)) for number in range(self.count)])

    def falls_h(self) -> Sequence[float]:
        """Return when each rockfall that the config lists under `events` falls, h after the first epoch, in their order."""
        return [self.hours_of(event.time) if event.time is not None else event.after_h or 0.0 for event in self.events]


def utc(time: datetime) -> datetime:
    """Return a time converted to UTC, so that times can be compared; one without a zone is taken as UTC."""
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)
