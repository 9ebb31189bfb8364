"""Workers that live and do nothing: a deadlock in native code, a stopped process. They are ended, another one begins anew.

What works takes processor time, and be it a hundredth of a second. Whoever cannot look at itself, as its interpreter stands too,
is looked at by the job (`workers_watched`); within a worker the threads that wait for messages do not count (`ended_if_stuck`).
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
STUCK_S = 25.0
_LOOKS = 10
"""Times that is looked within STUCK_S."""
_LEAST_S = 0.01
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


def unless_stuck(work: Callable[[T], Result], seconds: float, argument: T) -> Result:
    """work(argument); ends this process where that stands still for so long."""
    with ended_if_stuck(seconds):
        return work(argument)


@contextmanager
def ended_if_stuck(seconds: float = STUCK_S) -> Iterator[None]:
    """End this process where what is in the block, with the threads that it starts, takes no processor time for so long."""
    own = threading.get_native_id()
    others = {thread.native_id for thread in threading.enumerate()} - {own}
    pulse = _Pulse()

    def look() -> None:
        others.add(threading.get_native_id())
        if pulse.stands(_thread_seconds(others), seconds):
            _tell(seconds)
            os._exit(1)

    with _looked_at(look, seconds):
        yield


@contextmanager
def workers_watched(seconds: float = STUCK_S) -> Iterator[None]:
    """Kill the worker processes that are started in the block and take no processor time for so long."""
    import psutil

    before = {child.pid for child in psutil.Process().children()}
    known: dict[int, _Pulse] = {}

    def look() -> None:
        for child in psutil.Process().children():
            with suppress(psutil.Error):  # is gone
                used = sum(child.cpu_times()[:2])
                is_worker = child.pid not in before and "spawn_main" in " ".join(child.cmdline())
                if is_worker and known.setdefault(child.pid, _Pulse()).stands(used, seconds):
                    _tell(seconds)
                    del known[child.pid]
                    child.kill()

    with _looked_at(look, seconds):
        yield


@contextmanager
def _looked_at(look: Callable[[], None], seconds: float) -> Iterator[None]:
    """Call look() from a thread of its own during the block, _LOOKS times within so many seconds."""
    over = threading.Event()

    def watch() -> None:
        while not over.wait(seconds / _LOOKS):
            look()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@dataclass
class _Pulse:
    used: float = -1.0
    since: float = 0.0
    looked: float = field(default_factory=time.monotonic)

    def stands(self, used: float, seconds: float) -> bool:
        """Whether the processor time `used`, s, has not grown for so long; a time without looks, as by Ctrl-Z, says nothing."""
        now = time.monotonic()
        slept, self.looked = now - self.looked > seconds, now
        if slept or used > self.used + _LEAST_S:
            self.used, self.since = used, now
        return now - self.since > seconds


def _thread_seconds(others: set[int | None]) -> float:
    """Processor time of the threads of this process but `others`, s; it grows, as far as threads do not end."""
    total = 0.0
    for folder in Path("/proc/self/task").iterdir():
        if int(folder.name) not in others:
            try:
                words = (folder / "stat").read_text().rpartition(")")[2].split()
            except OSError:  # has just ended
                continue
            total += (int(words[11]) + int(words[12])) * _TICK_S
    return total


def _tell(seconds: float) -> None:
    text = f"a worker process took no processor time for {seconds:g} s; it is ended, and its epochs are begun anew"
    print(text, file=sys.stderr, flush=True)  # noqa: T201  (said while the job goes on)
