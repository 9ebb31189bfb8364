"""Define what a config says about rocks that fall over time: how often, how large, how they move before, what lies below."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from scene.common.config import Config

LAST_SHARE = 0.01
"""Share of the lead time before failure at which a block that follows the inverse-velocity law has moved by
    `displacement_m`."""


class MagnitudeFrequency(Config):
    """Magnitude-frequency law of rockfalls: N(> V) = a V^-exponent between the smallest and the largest volume.

    N(> V) is the number of rockfalls with more than the volume V, m3; the rate of rockfalls fixes the constant a. Dussauge,
    Grasso, Helmstetter (2003), "Statistical analysis of rockfall volume distributions: implications for rockfall dynamics", JGR
    108(B6), found exponents of 0.5 +- 0.2 on subvertical cliffs.
    """

    exponent: float = Field(0.5, gt=0, le=5, description="b in N(> V) = a V^-b; 0.5 on subvertical cliffs (Dussauge et al. 2003)")
    smallest: float = Field(0.01, ge=1e-6, le=1e6, description="smallest volume [m3]")
    largest: float = Field(1.0, ge=1e-6, le=1e6, description="largest volume [m3]")

    @model_validator(mode="after")
    def _ordered(self) -> MagnitudeFrequency:
        if self.largest < self.smallest:
            raise ValueError("largest must not be below smallest")
        return self

    def volume(self, share: float) -> float:
        """Return the volume, m3, that a share (0 to 1) of all rockfalls does not exceed (inverse distribution function).

        A uniform random share gives the volume of a random rockfall.
        """
        ends = self.smallest**-self.exponent, self.largest**-self.exponent
        return float((ends[0] - share * (ends[0] - ends[1])) ** (-1 / self.exponent))


class VolumeLaw(Config):
    """Distribution of the volumes of rockfalls.

    It has one key, which selects the only law there is: a magnitude-frequency power law.
    """

    power_law: MagnitudeFrequency = MagnitudeFrequency()


class RockfallRate(Config):
    """Settings of random rockfalls: how often rocks fall (a Poisson process in time), and the distribution of their volumes.

    Their times and volumes are drawn for the whole duration of a time series.
    """

    rate_per_day: float = Field(gt=0, le=1e5, description="mean number of rockfalls per day on the whole wall")
    volume_m3: VolumeLaw = VolumeLaw()


class Motion(Config):
    """How a block moves out of the wall, along its normal, before it falls.

    Let s be the time that is left until the fall, L the lead time (`lead_h`), D the largest displacement (`displacement_m`)
    and v the velocity. `linear` creep moves the block by D (1 - s / L). The inverse-velocity law of Fukuzono (1985), 1 / v
    proportional to s, moves it by D ln(L / s) / ln(100), at most by D: it has moved by D when 1 % of the lead time is left.
    """

    law: Literal["inverse_velocity", "linear"] = Field(
        "inverse_velocity", description="velocity inversely proportional to the time left (Fukuzono 1985), or constant"
    )
    lead_h: float = Field(24.0, gt=0, le=1e5, description="time from the first motion to the fall [h]")
    displacement_m: float = Field(0.03, gt=0, le=1.0, description="D: how far the block moves out before it falls [m]")

    def displacement(self, left_h: float) -> float:
        """Return how far the block has moved, m, when `left_h` hours are left until it falls; 0 before the lead time."""
        if left_h >= self.lead_h:
            return 0.0
        if self.law == "linear":
            return self.displacement_m * (1 - left_h / self.lead_h)
        share = max(left_h / self.lead_h, LAST_SHARE)
        return float(self.displacement_m * np.log(share) / np.log(LAST_SHARE))

    def time_left(self, displacement_m: float) -> float:
        """Return the hours that are left until the fall when the block has moved `displacement_m` (inverse of `displacement`).

        It is 0 if the block has moved farther than the field `displacement_m` of the config, the largest motion before the
        fall.
        """
        moved = displacement_m / self.displacement_m
        if moved > 1:
            return 0.0
        return self.lead_h * (1 - moved if self.law == "linear" else LAST_SHARE**moved)


class PrecursorConfig(Motion):
    """Settings of precursors: the slow motion of a block out of the wall, in the hours before it falls.

    They apply to a share of the rockfalls drawn at random. Besides `share` there are the keys of `Motion`, which say how the
    block moves: `law`, `lead_h` and `displacement_m`.
    """

    share: float = Field(1.0, ge=0, le=1, description="share of the rockfalls that move before they fall")


class EventConfig(Config):
    """Settings of one rockfall whose time, volume and place the user prescribes, instead of having them drawn at random."""

    time: datetime | None = Field(None, description="when it falls, ISO 8601; or `after_h`")
    after_h: float | None = Field(None, gt=0, le=1e6, description="when it falls, after the first epoch; or `time` [h]")
    volume_m3: float = Field(ge=1e-6, le=1e6, description="volume of the rock that falls [m3]")
    position_m: tuple[float, float] | None = Field(None, description="x and y in the wall frame; none: at random [m]")
    precursor: Motion | None = Field(None, description="how it moves before it falls; none: not at all")

    @model_validator(mode="after")
    def _timed(self) -> EventConfig:
        if (self.time is None) == (self.after_h is None):
            raise ValueError("needs either `time` or `after_h`")
        return self


class DepositsConfig(Config):
    """Settings of the fragments into which fallen rock breaks, and which come to rest at the foot of the wall below its place.

    The volume of the rock is divided at random among the fragments and stays the same in total.
    """

    fragments: int = Field(8, ge=1, le=200, description="number of fragments into which a rock breaks")
    volume_sigma_log: float = Field(
        0.8, ge=0, le=3, description="standard deviation of the natural logarithm of the fragments' volumes"
    )
    spread: float = Field(
        0.15, ge=0, le=2, description="standard deviation of where fragments land along the wall, over the height of fall"
    )

    @model_validator(mode="before")
    @classmethod
    def _switch(cls, values: Any) -> Any:
        return {} if values is True else values
