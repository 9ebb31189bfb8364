"""Divide the cores among parallel test workers, and mark the long tests, which `make validate` runs.

If all workers used all cores, threads would wait for each other and take half as long again.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pictures import write_blank

if "PYTEST_XDIST_WORKER" in os.environ and hasattr(os, "sched_setaffinity"):
    _worker, _workers = int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw")), int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    _cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, _cores[_worker % len(_cores) :: _workers])  # before NumPy and Dr.Jit start their threads

LONG = tomllib.loads((Path(__file__).parent / "validation.toml").read_text(encoding="utf-8"))["group"]
"""Groups of tests that `make validate` carries out: a reason, and names of tests by file."""


@pytest.fixture(scope="module")
def undrawn() -> Iterator[Callable[..., None]]:
    """Write a blank picture for each figure: drawing takes most of a small run's time.

    Modules use it whose tests do not look at pictures. Figures are put together as always. A test that looks at its pictures
    asks for `drawn`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    draw = FigureCanvasAgg.print_png
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FigureCanvasAgg, "print_png", write_blank)
        yield draw


@pytest.fixture
def undrawn_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write a blank picture for each figure of one test, in a module whose other tests look at theirs."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    monkeypatch.setattr(FigureCanvasAgg, "print_png", write_blank)


@pytest.fixture
def drawn(undrawn: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw figures in a test of a module that uses `undrawn`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    monkeypatch.setattr(FigureCanvasAgg, "print_png", undrawn)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the long tests, and report names in validation.toml that no test has any more."""
    long = {f"{file}::{name}" for group in LONG for file, names in group.items() if file != "reason" for name in names}
    files, found = set(), set()
    for item in items:
        whole = item.nodeid
        files.add(whole.partition("::")[0])
        for name in (whole, whole.partition("[")[0]):
            if name in long:
                item.add_marker(pytest.mark.validation)
                found.add(name)
    if missing := sorted(name for name in long - found if name.partition("::")[0] in files and len(files) > 1):
        raise pytest.UsageError(f"tests/validation.toml names tests that are not there: {', '.join(missing)}")
