"""Divide the cores among parallel test workers, and mark the long tests, which `make validate` runs.

If all workers used all cores, threads would wait for each other and take half as long again.
"""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

import pytest

if "PYTEST_XDIST_WORKER" in os.environ and hasattr(os, "sched_setaffinity"):
    _worker, _workers = int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw")), int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    _cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, _cores[_worker % len(_cores) :: _workers])  # before NumPy and Dr.Jit start their threads

LONG = tomllib.loads((Path(__file__).parent / "validation.toml").read_text(encoding="utf-8"))["group"]
"""Groups of tests that `make validate` carries out: a reason, and names of tests by file."""


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
