"""Draw the rockfalls of a series: when each happens, how large it is, and whether it moves before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.series.config import EventConfig, Motion, PrecursorConfig, RockfallRate

MOST_EVENTS = 20_000
"""Most rockfalls in a series."""


@dataclass(frozen=True)
class Rockfall:
    """A rockfall that is to happen in a simulated time series. Times count in hours from the first epoch.

    Attributes
    ----------
    number : int
        Number of the rockfall, from 1, in the order of the first motion.
    key : str
        Key of the rockfall's random numbers, which does not depend on the other rockfalls.
    falls_h : float
        Time of the fall, h.
    volume_m3 : float
        Volume of the rock, m3.
    position_m : (x, y), optional
        Place of the block, wall frame, m; None: at random.
    motion : Motion, optional
        How the block moves before it falls; None: not at all.
    """

    number: int
    key: str
    falls_h: float
    volume_m3: float
    position_m: tuple[float, float] | None
    motion: Motion | None

    @property
    def starts_h(self) -> float:
        """Time when the block begins to move, or falls if it does not move before, h after the first epoch."""
        return self.falls_h - (0.0 if self.motion is None else self.motion.lead_h)

    def displacement_m(self, time_h: float) -> float | None:
        """Return how far the block has moved out of the wall at a time, m; None once it has fallen.

        time_h: time after the first epoch, h.
        """
        if time_h >= self.falls_h:
            return None
        if self.motion is None:
            return 0.0
        return self.motion.displacement(self.falls_h - time_h) - self.motion.displacement(self.falls_h)


def drawn_rockfalls(rate: RockfallRate, precursor: PrecursorConfig | None, end_h: float, random: KeyedRandom) -> list[Rockfall]:
    """Draw the rockfalls of a time series at random: those until the last epoch, and later ones that already move by then.

    Parameters
    ----------
    rate : RockfallRate
        How many rockfalls happen per day, and the distribution of their volumes.
    precursor : PrecursorConfig, optional
        How a share of them moves before the fall; None: none moves.
    end_h : float
        Time of the last epoch, h.
    random : KeyedRandom
        Source of random numbers; each rockfall has its own child.

    Returns
    -------
    list of Rockfall
        Not yet numbered (all have number 0).

    Raises
    ------
    InputError
        If there would be too many.
    """
    span = end_h + (0.0 if precursor is None else precursor.lead_h)
    mean = rate.rate_per_day * span / 24
    if mean > MOST_EVENTS:
        raise InputError(
            f"{rate.rate_per_day:g} rockfalls per day make {mean:,.0f} rockfalls in this series",
            where="series.rockfall.rate_per_day",
            allowed=f"up to {MOST_EVENTS:,} rockfalls",
            remedy="lower the rate, or shorten the series",
        )
    found = []
    for index in range(int(random.child("count").generator().poisson(mean))):
        when, share, moves = random.child("rockfall", index).generator().random(3)
        motion = precursor if precursor is not None and moves < precursor.share else None
        rockfall = Rockfall(0, f"drawn {index}", float(when * span), rate.volume_m3.power_law.volume(float(share)), None, motion)
        if min(rockfall.falls_h, rockfall.starts_h) <= end_h:
            found.append(rockfall)
    return found


def given_rockfalls(events: Sequence[EventConfig], falls_h: Sequence[float]) -> list[Rockfall]:
    """Return the rockfalls that a config lists one by one, not yet numbered (all have number 0).

    events: the listed rockfalls. falls_h: when each falls, h after the first epoch.
    """
    return [
        Rockfall(0, f"given {index}", when, event.volume_m3, event.position_m, event.precursor)
        for index, (event, when) in enumerate(zip(events, falls_h, strict=True))
    ]


def numbered(rockfalls: Sequence[Rockfall]) -> tuple[Rockfall, ...]:
    """Number rockfalls from 1 in the order in which they begin to move, or fall if they do not move before."""
    ordered = sorted(rockfalls, key=lambda each: (each.starts_h, each.falls_h, each.key))
    return tuple(
        Rockfall(number, each.key, each.falls_h, each.volume_m3, each.position_m, each.motion)
        for number, each in enumerate(ordered, start=1)
    )
