"""Run the same work on several items in threads, with the same results as one after the other."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def executor(threads: int | None = None) -> ThreadPoolExecutor:
    """Make a pool of worker threads. `threads` is their number; None: as many as the process may use processor cores."""
    return ThreadPoolExecutor(threads or len(os.sched_getaffinity(0)))


def map_in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return `work(item)` for every item, in the order of the items, computed in parallel threads.

    Useful for NumPy work that releases Python's global lock. The items must not share data that `work` changes.
    """
    every = list(items)
    if len(every) < 2:  # a pool would only add overhead
        return [work(item) for item in every]
    with executor() as pool:
        return [found.result() for found in [pool.submit(copy_context().run, work, item) for item in every]]
