"""Blank pictures, for tests that do not look at them: drawing figures takes most of a small run's time."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

BLANK = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108000000003a7e9b55"
    "0000000a49444154789c63f80f0001010100b138f6140000000049454e44ae426082"
)
"""A PNG file of one pixel."""

ROOT = Path(__file__).parents[1]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
"""Environment of a process that carries out `command`."""


def command(name: str, *words: str) -> list[str]:
    """Return the words that start a command of the program in a process of its own, which leaves its pictures blank.

    name: function of `pipeline.cli.main`. words: those of the command.
    """
    program = f"from pictures import leave_blank; leave_blank(); from pipeline.cli.main import {name}; raise SystemExit({name}())"
    return [sys.executable, "-c", program, *words]


def write_blank(canvas: Any, file: Any, **_: Any) -> None:
    """Write a blank picture in place of a figure, like Matplotlib's `FigureCanvasAgg.print_png`."""
    from matplotlib.cbook import open_file_cm

    if "draw" in vars(canvas.figure):  # Matplotlib replaces it where it only asks for a renderer
        canvas.figure.draw(canvas.get_renderer())
    with open_file_cm(file, "wb") as opened:
        opened.write(BLANK)


def leave_blank() -> None:
    """Write a blank picture for each figure of this process."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg.print_png = write_blank  # type: ignore[method-assign, assignment]
