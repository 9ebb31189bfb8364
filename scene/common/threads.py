"""Work on several things at once, with the same results as on one after the other."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def executor(threads: int | None = None) -> ThreadPoolExecutor:
    """As many threads as this process may use cores, or `threads`."""
    return ThreadPoolExecutor(threads or len(os.sched_getaffinity(0)))


def side_by_side(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """`work` of every item, in their order; for work that NumPy does without Python's lock, and that no other item touches."""
    every = list(items)
    if len(every) < 2:  # a pool would only cost the hand-over
        return [work(item) for item in every]
    with executor() as pool:
        return [found.result() for found in [pool.submit(copy_context().run, work, item) for item in every]]
