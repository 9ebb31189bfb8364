"""Parallel work in threads: results in order, in the caller's context, and errors of the work itself."""

from __future__ import annotations

import time
from contextvars import ContextVar

import pytest

from scene.common.threads import map_in_threads

VALUE: ContextVar[int] = ContextVar("value", default=0)


def test_results_come_in_the_order_of_the_items() -> None:
    def work(number: int) -> int:
        time.sleep(0.05 if number == 0 else 0)  # the first is done last
        return number**2

    assert map_in_threads(work, range(20)) == [number**2 for number in range(20)]


def test_what_the_caller_decided_by_counts() -> None:
    token = VALUE.set(7)
    try:
        assert map_in_threads(lambda item: item + VALUE.get(), [1, 2]) == [8, 9]
    finally:
        VALUE.reset(token)


def test_an_error_of_the_work_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        map_in_threads(lambda item: 1 / item, [1, 0])
