"""Stop workers that are alive but do nothing, such as in a deadlock of native code, so that another one makes their epochs.

A working process uses processor time, if only a hundredth of a second. The job watches the processor time of its workers from
outside (`watch_workers`), because a process may be unable to watch itself. Within a worker, the threads that wait for messages
are not counted (`exit_if_stalled`).
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
Result = TypeVar("Result")
STALLED_S = 25.0
"""Time without processor time after which a worker is stopped, s."""
_CHECKS = 10
"""Number of checks within that time."""
_LEAST_S = 0.01
"""Processor time, s, from which a process counts as working."""
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
"""Unit of the processor times in /proc, s."""


def run_with_watchdog(work: Callable[[T], Result], seconds: float, argument: T) -> Result:
    """Return work(argument), but end this process if it hangs, as in a deadlock.

    work: the function to call. seconds: time without any use of the processor after which the process is ended.
    """
    with exit_if_stalled(seconds):
        return work(argument)


@contextmanager
def exit_if_stalled(seconds: float = STALLED_S) -> Iterator[None]:
    """Within the `with` block, end this process if it hangs, as in a deadlock.

    seconds: time after which it is ended if the block, and the threads that it starts, have not used the processor.
    """
    own = threading.get_native_id()
    others = {thread.native_id for thread in threading.enumerate()} - {own}
    pulse = _Activity()

    def check() -> None:
        others.add(threading.get_native_id())
        if pulse.stalled(_thread_seconds(others), seconds):
            _warn(seconds)
            os._exit(1)

    with _check_regularly(check, seconds):
        yield


@contextmanager
def watch_workers(seconds: float = STALLED_S) -> Iterator[None]:
    """Within the `with` block, kill worker processes that hang, as in a deadlock.

    seconds: time after which a process that was started in the block is killed if it has not used the processor.
    """
    import psutil

    before = {child.pid for child in psutil.Process().children()}
    known: dict[int, _Activity] = {}

    def check() -> None:
        for child in psutil.Process().children():
            with suppress(psutil.Error):  # has ended
                used = sum(child.cpu_times()[:2])
                is_worker = child.pid not in before and "spawn_main" in " ".join(child.cmdline())
                if is_worker and known.setdefault(child.pid, _Activity()).stalled(used, seconds):
                    _warn(seconds)
                    del known[child.pid]
                    child.kill()

    with _check_regularly(check, seconds):
        yield


@contextmanager
def _check_regularly(check: Callable[[], None], seconds: float) -> Iterator[None]:
    """Call check() regularly from another thread during the block, ten times within so many seconds."""
    over = threading.Event()

    def watch() -> None:
        while not over.wait(seconds / _CHECKS):
            check()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@dataclass
class _Activity:
    """Processor time of a process at its last activity.

    Attributes
    ----------
    used : Processor time, s.
    since : Time of the last activity, s.
    checked : Time of the last check, s.
    """

    used: float = -1.0
    since: float = 0.0
    checked: float = field(default_factory=time.monotonic)

    def stalled(self, used: float, seconds: float) -> bool:
        """Whether the processor time `used`, s, has not grown for so many seconds.

        A time without checks, as after Ctrl-Z, does not count.
        """
        now = time.monotonic()
        slept, self.checked = now - self.checked > seconds, now
        if slept or used > self.used + _LEAST_S:
            self.used, self.since = used, now
        return now - self.since > seconds


def _thread_seconds(others: set[int | None]) -> float:
    """Return the processor time of all threads of this process except `others`, s."""
    total = 0.0
    for folder in Path("/proc/self/task").iterdir():
        if int(folder.name) not in others:
            try:
                words = (folder / "stat").read_text().rpartition(")")[2].split()
            except OSError:  # has just ended
                continue
            total += (int(words[11]) + int(words[12])) * _TICK_S
    return total


def _warn(seconds: float) -> None:
    """Say on the terminal that a worker is stopped."""
    text = f"a worker process used no processor time for {seconds:g} s; it is stopped, and its epochs are started again"
    print(text, file=sys.stderr, flush=True)  # noqa: T201  (the job continues)
