"""Track the progress of a long command: named stages with weights, the remaining time, and each stage's wall time.

Library code takes an optional `Progress`; the base class shows nothing and only measures times. `shown_progress` chooses the
variant that suits the terminal.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Self, TextIO

_QUIET_S = 2.0
"""A command shorter than this prints no progress lines, s."""
_INTERVAL_S = 5.0
"""Time between progress lines, s."""
_GUESS_LIMIT = 0.95
"""Largest share that a stage counts as done if it does not report its progress."""
_OVERDUE = 2.0
"""A stage that takes this many times as long as the pace of earlier stages predicts makes the remaining time unknown."""


class Progress:
    """Measure how much of a long computation is done, and how long each of its stages takes, without showing it.

    Subclasses show it. Use it in a `with` statement around the stages; `clock` returns the time in seconds.

    Attributes
    ----------
    timings : dict
        Wall time of each stage, s; the sum if a stage occurs several times.
    current : str
        Name of the stage that is running; "" between stages.
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
        """Announce stages that will follow, so that the share done and the remaining time can be estimated.

        Stages that were announced earlier and are not done remain planned. Stages announced after some are done divide the
        remaining share of the work, so that the share done never decreases. A stage that was not announced is timed, but adds
        nothing to the share done.

        Parameters
        ----------
        weights : mapping of str to float
            Name of each stage, and the seconds that it is expected to take. Once a stage is done, only their ratios matter.
        """
        self._share_before, self._weight_before = self.share, self._weight_before + self._done()
        left = {name: weight for name, weight in self._weights.items() if name not in self._finished}
        self._weights, self._finished = left | dict(weights), set()

    @contextmanager
    def stage(self, name: str) -> Iterator[Self]:
        """Mark what is done inside the `with` block as the stage `name` of the computation, and time it. Stages do not nest."""
        self.current, self._stage_began, self._fraction = name, self._clock(), 0.0
        try:
            yield self
        finally:
            self.timings[name] = self.timings.get(name, 0.0) + self._clock() - self._stage_began
            self._finished.add(name)
            self.current = ""

    def advance(self, fraction: float) -> None:
        """Report which fraction of the current stage is done, 0 to 1, for the estimate of the remaining time."""
        self._fraction = min(max(fraction, self._fraction), 1.0)

    @property
    def elapsed_s(self) -> float:
        """Wall time since the computation started, s."""
        return self._clock() - self._began

    @property
    def share(self) -> float:
        """Estimated share of the whole computation that is done, 0 to 1; it never decreases."""
        part = self._done() / (sum(self._weights.values()) or 1.0)
        self._most = max(self._most, self._share_before + (1 - self._share_before) * part)
        return self._most

    @property
    def left_s(self) -> float:
        """Expected remaining wall time of the computation, s, if it goes on at its pace so far."""
        done = self._done()
        so_far = self._weight_before + done
        return (sum(self._weights.values()) - done) * (self.elapsed_s / so_far if so_far > 0 else 1.0)

    @property
    def time(self) -> str:
        """The remaining time in words, such as "about 40 s left".

        It is the elapsed time instead if no stages were announced, or if the current stage takes much longer than expected.
        """
        overdue = bool(self._finished) and self._guess() > _OVERDUE
        if self._weights and not overdue:
            return f"about {duration(self.left_s)} left"
        return f"{duration(self.elapsed_s)} so far" + (", slower than expected" if overdue else "")

    def _done(self) -> float:
        """Return the weight that is done.

        A stage that has not reported its progress is estimated from the pace of earlier stages.
        """
        return self._weight_finished() + self._weight() * (self._fraction or min(self._guess(), _GUESS_LIMIT))

    def _weight_finished(self) -> float:
        """Return the weight of the finished stages."""
        return sum(self._weights.get(name, 0.0) for name in self._finished)

    def _weight(self) -> float:
        """Return the weight of the current stage; 0 if it occurred before."""
        return 0.0 if self.current in self._finished else self._weights.get(self.current, 0.0)

    def _guess(self) -> float:
        """Return the share of the current stage that is done.

        It is as reported, else estimated from the pace of earlier stages (above 1 if the stage is slower).
        """
        weight = self._weight()
        if not weight or self._fraction:
            return self._fraction
        so_far = self._weight_before + self._weight_finished()
        pace = (self._stage_began - self._began) / so_far if so_far else 1.0
        return (self._clock() - self._stage_began) / max(pace * weight, 1e-9)


class LineProgress(Progress):
    """Print how much of a long computation is done as lines of text, one every few seconds, for log files and pipes.

    Parameters
    ----------
    stream : TextIO
        Where to print.
    quiet_s, interval_s : float
        Time before the first line, and between lines, s.
    """

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
        """Print a line from time to time."""
        wait = self._quiet_s
        while not self._stop.wait(wait):
            self._stream.write(f"{int(100 * self.share)} %  {self.current}  ({self.time})\n")
            self._stream.flush()
            wait = self._interval_s


def shown_progress(*, quiet: bool = False, stream: TextIO | None = None) -> Progress:
    """Choose how a command shows its progress: as a bar on a terminal, as lines of text elsewhere.

    Parameters
    ----------
    quiet : bool
        Whether to show nothing.
    stream : TextIO, optional
        Where to print; by default stderr. Nothing is shown if stderr is closed.

    Returns
    -------
    Progress
        Object that the command tells its stages; to be used in a `with` statement.
    """
    stream = stream or sys.stderr
    if quiet or stream is None:
        return Progress()
    if not stream.isatty():
        return LineProgress(stream)
    from pipeline.report.progress_bar import BarProgress  # slow to import, and only needed here

    return BarProgress(stream)


def duration(seconds: float) -> str:
    """Format a time in seconds as text: 40 s, 3 min 20 s, 2 h 5 min."""
    total = round(seconds)
    hours, minutes = total // 3600, total % 3600 // 60
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {total % 60} s" if minutes else f"{total} s"
