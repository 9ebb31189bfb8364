"""One public report of a file that broke another program, and what this program does with a file of the same kind."""

from __future__ import annotations

import contextlib
import io
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.cli.main import main
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray


@dataclass(frozen=True)
class Report:
    """A report from the tracker of another program.

    Attributes
    ----------
    thread : str
        Repository and number of the public thread, as `laspy/laspy#242`.
    fault : str
        What the file has that the other program did not expect.
    right : str
        What this program should do with such a file.
    tried : callable
        Writes a small file of that kind into an empty folder, has it read, and returns what came out in words. Raises
        AssertionError where that is not what is right.
    """

    thread: str
    fault: str
    right: str
    tried: Callable[[Path], str]

    @property
    def url(self) -> str:
        """Address of the thread; GitHub leads from an issue's address to a pull request of that number."""
        repository, _, number = self.thread.partition("#")
        return f"https://github.com/{repository}/issues/{number}"


def points_of_wall(count: int = 600, seed: int = 11) -> FloatArray:
    """(count, 3) points on a rough wall of 30 m x 20 m in projected coordinates, m, to the millimetre."""
    drawn = np.random.default_rng(seed).uniform([0.0, 0.0], [30.0, 20.0], (count, 2))
    depth = 0.4 * np.sin(drawn[:, 0]) * np.cos(drawn[:, 1])
    local = np.column_stack([drawn[:, 0], depth, drawn[:, 1]])
    return np.asarray(np.round(local + np.array([345_200.0, 5_389_450.0, 120.0]), 3))


def same_points(found: FloatArray, truth: FloatArray, tolerance_m: float = 6e-4) -> str:
    """Say that the points that were read are the true ones; raises AssertionError where they are not."""
    assert found.shape == truth.shape, f"{len(found)} points of {len(truth)}"
    farthest = float(np.abs(found - truth).max())
    assert farthest <= tolerance_m, f"points are {farthest:.3g} m off"
    return f"reads all {len(truth):,} points in their place"


def refused(read: Callable[[], Any], folder: Path, *words: str) -> str:
    """Return the message with which a file is refused; raises AssertionError if it is not, or without one of the words."""
    try:
        read()
    except InputError as error:
        message = str(error).replace(f"{folder}/", "")
        missing = [word for word in words if word not in message]
        assert not missing, f"the message lacks {missing}: {message}"
        return f"refuses it: {message}"
    raise AssertionError("the file was taken")


def refused_by_command(command: str, folder: Path, *words: str) -> str:
    """Run a command in the folder and return its message; raises AssertionError unless it ends with exit status 2."""
    told = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stderr(told), contextlib.redirect_stdout(io.StringIO()):
        code = main(shlex.split(command))
    message = told.getvalue().strip().splitlines()[-1]
    assert code == 2, f"exit status {code}: {message}"
    missing = [word for word in words if word not in message]
    assert not missing, f"the message lacks {missing}: {message}"
    return f"refuses it: {message.removeprefix('error: ')}"
