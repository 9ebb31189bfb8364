"""Progress: share done, remaining time and timings, with a clock that the test sets."""

from __future__ import annotations

import io
import time

import pytest

from pipeline.report.progress import LineProgress, Progress, duration, shown_progress
from pipeline.report.progress_bar import BarProgress


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_share_and_time_left_follow_weights_and_pace() -> None:
    clock = Clock()
    progress = Progress(clock)
    assert progress.time == "0 s so far"
    progress.plan({"wall": 1.0, "observe": 3.0})
    assert (progress.share, progress.left_s, progress.time) == (0.0, 4.0, "about 4 s left")
    with progress.stage("wall"):
        clock.now += 2.0  # twice as slow as planned
    assert progress.share == pytest.approx(0.25)
    assert progress.left_s == pytest.approx(6.0)
    with progress.stage("observe"):
        progress.advance(0.5)
        clock.now += 3.0
        assert progress.share == pytest.approx(0.625)
        assert progress.left_s == pytest.approx(3.0)
    assert (progress.share, progress.left_s) == (1.0, 0.0)


def test_a_silent_stage_goes_by_the_pace_and_never_ends_early() -> None:
    clock = Clock()
    progress = Progress(clock)
    progress.plan({"a": 1.0, "b": 1.0})
    with progress.stage("a"):
        clock.now += 4.0
    with progress.stage("b"):
        clock.now += 1.0
        assert progress.share == pytest.approx(0.5 + 0.5 * 0.25)
        clock.now += 1000.0
        assert progress.share < 1.0


def test_a_stage_that_takes_far_longer_than_planned_promises_no_end() -> None:
    clock = Clock()
    progress = Progress(clock)
    progress.plan({"read": 1.0, "search": 4.0, "write": 1.0})
    with progress.stage("read"):
        clock.now += 10.0  # the first says how fast all is
        assert progress.time.endswith("left")
    with progress.stage("search"):
        clock.now += 70.0
        assert progress.time.endswith("left")
        clock.now += 20.0
        assert progress.time == "1 min 40 s so far, slower than expected"
        progress.advance(0.9)
        assert progress.time.endswith("left"), "a stage that says how far it is can be believed"
    assert progress.time.endswith("left")


def test_a_plan_made_under_way_divides_what_is_left() -> None:
    """Half is done when as much work as the other half turns up in addition: each second then counts a third of the remainder."""
    clock = Clock()
    progress = Progress(clock)
    progress.plan({"a": 1.0, "b": 1.0})
    with progress.stage("a"):
        clock.now += 1.0
    progress.plan({"c": 2.0})
    assert (progress.share, progress.left_s) == (0.5, 3.0)
    with progress.stage("b"):
        clock.now += 1.0
    assert progress.share == pytest.approx(0.5 + 0.5 / 3)
    with progress.stage("c"):
        clock.now += 2.0
    assert (progress.share, progress.left_s) == (1.0, 0.0)


def test_the_share_never_falls() -> None:
    """A stage that comes again, and one that reports less progress than was estimated."""
    clock = Clock()
    progress = Progress(clock)
    progress.plan({"a": 1.0, "b": 1.0})
    shares = []
    for fraction in (0.0, 0.3, 1.0):
        with progress.stage("a"):
            clock.now += 0.9
            shares.append(progress.share)
            progress.advance(fraction)
            shares.append(progress.share)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(0.5)


def test_timings_add_up_per_stage_and_survive_an_error() -> None:
    clock = Clock()
    progress = Progress(clock)
    for seconds in (1.0, 2.0):
        with progress.stage("observe"):
            clock.now += seconds

    def break_down() -> None:
        with progress.stage("mesh"):
            clock.now += 0.5
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        break_down()
    assert progress.timings == pytest.approx({"observe": 3.0, "mesh": 0.5})


def test_lines_appear_after_the_quiet_time_only() -> None:
    stream = io.StringIO()
    with LineProgress(stream) as progress, progress.stage("short"):
        pass
    assert stream.getvalue() == ""
    with LineProgress(stream, quiet_s=0.01, interval_s=0.01) as progress:
        progress.plan({"cast": 10.0})
        with progress.stage("cast"):
            progress.advance(0.5)
            while not stream.getvalue().count("\n") >= 2:
                time.sleep(0.005)
    first = stream.getvalue().splitlines()[0]
    assert first.startswith("50 %  cast  (about 0 s left)")


def test_the_terminal_decides_what_is_shown() -> None:
    assert type(shown_progress(stream=io.StringIO())) is LineProgress
    assert type(shown_progress(stream=io.StringIO(), quiet=True)) is Progress
    assert type(shown_progress(stream=Terminal())) is BarProgress


def test_the_bar_shows_stage_and_share(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    terminal = Terminal()
    with BarProgress(terminal) as progress:
        progress.plan({"wall": 1.0, "carve": 1.0})
        with progress.stage("wall"):
            pass
        with progress.stage("carve"):
            progress.advance(0.5)
            progress._bar.refresh()
    assert "carve" in terminal.getvalue()
    assert "75 %" in terminal.getvalue()


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0 s"), (59.6, "1 min 0 s"), (200, "3 min 20 s"), (7500, "2 h 5 min")])
def test_durations_are_for_people(seconds: float, text: str) -> None:
    assert duration(seconds) == text
