"""Folders that several test modules read, each made once in a test session, whichever worker of pytest-xdist needs it first."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return the folder that `make` fills.

    Parameters
    ----------
    factory : pytest.TempPathFactory
        Gives the session's temporary folder.
    name : str
        Name of the folder, one for each `make`.
    make : callable
        Takes the path of the folder, which does not exist yet.
    """
    base = factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared_outputs"
    shared.mkdir(exist_ok=True)
    folder, done = shared / name, shared / f"{name}.done"
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            make(folder)
            done.touch()
    return folder


def build_site(folder: Path) -> None:
    """Build the documentation site; a warning is an error."""
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1", "SIGNATURE_WIDTH": "100000"}  # no formatter for each signature
    build = "import gc, mkdocs.__main__; gc.disable(); mkdocs.__main__.cli()"  # without garbage collection it takes a fifth less
    command = [sys.executable, "-c", build, "build", "--quiet", "--site-dir", str(folder)]
    built = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
