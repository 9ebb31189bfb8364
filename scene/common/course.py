"""Define how a quantity changes over the epochs of a series: drift, daily cycle, random walk, table."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from scene.common.config import Config
from scene.common.keyed_random import KeyedRandom

FloatArray = NDArray[np.float64]


class Cycle(Config):
    """A periodic departure, such as a daily one: a sine over time.

    It describes how a quantity, such as the scanner's zero error, differs from its configured value through the epochs of a
    time series.
    """

    amplitude: float = Field(description="half the difference of largest and smallest value, in the quantity's unit")
    period_h: float = Field(24.0, gt=0, description="period [h]")
    largest_after_h: float = Field(0.0, description="when it is largest, after the first epoch [h]")


class TimeTable(Config):
    """Values at some times, with straight lines between them and the first and last value beyond.

    They are what a quantity, such as the scanner's zero error, is to differ by from its configured value in a time series.
    """

    hours: tuple[float, ...] = Field(min_length=1, description="times after the first epoch, increasing [h]")
    values: tuple[float, ...] = Field(min_length=1, description="values at these times, in the quantity's unit")

    @model_validator(mode="after")
    def _paired(self) -> TimeTable:
        if len(self.hours) != len(self.values):
            raise ValueError(f"{len(self.hours)} hours need as many values, got {len(self.values)}")
        if not np.all(np.diff(self.hours) > 0):
            raise ValueError("hours must increase")
        return self


class Course(Config):
    """How a quantity departs over time from its value in the config: the sum of a random walk, a drift, a cycle and a table.

    The quantity is one of a sensor, such as its zero error or position, in a time series of epochs. All values are in the
    quantity's unit.
    """

    random_walk: float = Field(0.0, ge=0, description="standard deviation of the change in one day; it grows as the root of time")
    drift: float = Field(0.0, description="change per day")
    cycle: Cycle | None = Field(None, description="a sine, such as that of the day's temperature")
    table: TimeTable | None = Field(None, description="values at some times")

    @model_validator(mode="after")
    def _changing(self) -> Course:
        if self.random_walk == self.drift == 0 and self.cycle is None and self.table is None:
            raise ValueError("changes nothing: give random_walk, drift, cycle or table")
        return self

    def values(self, hours: FloatArray, random: KeyedRandom) -> FloatArray:
        """Return by how much a quantity departs from its configured value at n epochs, (n,), in the unit of the quantity.

        A course describes how a condition of a series, such as the range scale, changes over time. The departure is the sum of
        what the config states for it: a random walk, a drift, a cycle and a table of values.

        hours: (n,) times of the epochs, h, increasing; a random walk and a drift start at the first. random: source of the
        random walk.
        """
        days = hours / 24
        steps = random.generator().standard_normal(len(hours)) * np.sqrt(np.diff(days, prepend=days[0]))
        values = self.random_walk * np.cumsum(steps) + self.drift * (days - days[0])
        if self.cycle is not None:
            values += self.cycle.amplitude * np.cos(2 * np.pi * (hours - self.cycle.largest_after_h) / self.cycle.period_h)
        if self.table is not None:
            values += np.interp(hours, self.table.hours, self.table.values)
        return np.asarray(values)
