"""Progress of a long command: named stages with weights, the time left, and each stage's wall time.

Library code takes an optional `Progress`; the base class shows nothing and only takes the times. `shown_progress` picks the one
that suits the terminal.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Self, TextIO

_QUIET_S = 2.0
"""A command shorter than this shows no plain lines."""
_INTERVAL_S = 5.0
_GUESS_LIMIT = 0.95
"""A stage that does not say how far it is counts as at most this much done."""
_OVERDUE = 2.0
"""A stage that takes so many times what the stages before it let one expect: the time left is anyone's guess."""


class Progress:
    """Stages as they go by, shown to nobody.

    `timings` holds the wall time of each stage, s, summed where a stage comes several times; `current` is the stage under way.
    Use it as a context manager around the stages.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.timings: dict[str, float] = {}
        self.current = ""
        self._weights: dict[str, float] = {}
        self._finished: set[str] = set()
        self._share_before = self._weight_before = self._most = 0.0
        self._clock = clock
        self._began = self._stage_began = clock()
        self._fraction = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Stop showing."""

    def plan(self, weights: Mapping[str, float]) -> None:
        """Name stages to come and the seconds each is expected to take; only their ratios matter once one is done.

        Stages that were named before and are not done stay planned. A plan made under way divides the share that is left, so
        that the share never falls. A stage that is not in the plan is timed like the others, and adds nothing to the share done.
        """
        self._share_before, self._weight_before = self.share, self._weight_before + self._done()
        left = {name: weight for name, weight in self._weights.items() if name not in self._finished}
        self._weights, self._finished = left | dict(weights), set()

    @contextmanager
    def stage(self, name: str) -> Iterator[Self]:
        """Mark what is done inside as the stage `name`; stages do not nest."""
        self.current, self._stage_began, self._fraction = name, self._clock(), 0.0
        try:
            yield self
        finally:
            self.timings[name] = self.timings.get(name, 0.0) + self._clock() - self._stage_began
            self._finished.add(name)
            self.current = ""

    def advance(self, fraction: float) -> None:
        """Say how much of the current stage is done, 0 to 1."""
        self._fraction = min(max(fraction, self._fraction), 1.0)

    @property
    def elapsed_s(self) -> float:
        """Wall time since the start, s."""
        return self._clock() - self._began

    @property
    def share(self) -> float:
        """The share of all the work that is done, 0 to 1; it never falls."""
        part = self._done() / (sum(self._weights.values()) or 1.0)
        self._most = max(self._most, self._share_before + (1 - self._share_before) * part)
        return self._most

    @property
    def left_s(self) -> float:
        """The wall time that the rest will take at the pace so far, s."""
        done = self._done()
        so_far = self._weight_before + done
        return (sum(self._weights.values()) - done) * (self.elapsed_s / so_far if so_far > 0 else 1.0)

    @property
    def time(self) -> str:
        """The time left, for people; the time so far without a plan, or where a stage takes longer than one could have told."""
        overdue = bool(self._finished) and self._guess() > _OVERDUE
        if self._weights and not overdue:
            return f"about {duration(self.left_s)} left"
        return f"{duration(self.elapsed_s)} so far" + (", longer than usual" if overdue else "")

    def _done(self) -> float:
        """Weight done of the plan; a stage that has not said how far it is goes by the pace of the stages before it."""
        return self._weight_finished() + self._weight() * (self._fraction or min(self._guess(), _GUESS_LIMIT))

    def _weight_finished(self) -> float:
        """Of the plan's stages that are over."""
        return sum(self._weights.get(name, 0.0) for name in self._finished)

    def _weight(self) -> float:
        """Of the current stage; nothing where it came before."""
        return 0.0 if self.current in self._finished else self._weights.get(self.current, 0.0)

    def _guess(self) -> float:
        """Share of the current stage that is done at the pace of the stages before it, above 1 where it takes longer; what the
        stage says where it says so."""
        weight = self._weight()
        if not weight or self._fraction:
            return self._fraction
        so_far = self._weight_before + self._weight_finished()
        pace = (self._stage_began - self._began) / so_far if so_far else 1.0
        return (self._clock() - self._stage_began) / max(pace * weight, 1e-9)


class LineProgress(Progress):
    """Progress as plain lines, one at most every few seconds: for log files and pipes."""

    def __init__(self, stream: TextIO, quiet_s: float = _QUIET_S, interval_s: float = _INTERVAL_S) -> None:
        super().__init__()
        self._stream, self._quiet_s, self._interval_s = stream, quiet_s, interval_s
        self._stop = threading.Event()
        self._ticker = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self) -> Self:
        self._ticker.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._ticker.join()

    def _tick(self) -> None:
        wait = self._quiet_s
        while not self._stop.wait(wait):
            self._stream.write(f"{int(100 * self.share)} % done, {self.time}: {self.current}\n")
            self._stream.flush()
            wait = self._interval_s


def shown_progress(*, quiet: bool = False, stream: TextIO | None = None) -> Progress:
    """The progress for a command: a bar on a terminal, plain lines elsewhere, nothing where `quiet`; on stderr, if it is open."""
    stream = stream or sys.stderr
    if quiet or stream is None:
        return Progress()
    if not stream.isatty():
        return LineProgress(stream)
    from pipeline.report.progress_bar import BarProgress  # rich is slow to import, and of no use elsewhere

    return BarProgress(stream)


def duration(seconds: float) -> str:
    """A duration for people: 40 s, 3 min 20 s, 2 h 5 min."""
    total = round(seconds)
    hours, minutes = total // 3600, total % 3600 // 60
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {total % 60} s" if minutes else f"{total} s"
