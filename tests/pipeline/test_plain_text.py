"""Text in pictures is drawn literally, in every module that draws."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from pipeline.detection.products.figures import write_overlay
from pipeline.report.figures import hillshade_figure, png_bytes
from pipeline.report.pictures import png
from pipeline.report.plain_text import power_of_ten, powers_of_ten
from scene.geometry.grid import Grid

FORMULAE = ["$x^$", r"a $\frac b$", r"$\nonsense$"]


def panel(title: str) -> Figure:
    figure = Figure(figsize=(3, 2), layout="constrained")
    axes = figure.subplots()
    axes.plot([1, 2], [1e-4, 1], label=title)
    axes.set_xticks([1, 2], [title, "b"])
    axes.set_yscale("log")
    powers_of_ten(axes.yaxis)
    axes.legend()
    return figure


@pytest.mark.parametrize("title", FORMULAE)
def test_what_looks_like_a_formula_is_none(title: str, tmp_path: Path) -> None:
    grid = Grid(0.0, 1.0, 0.1, 20, 10)
    for picture in (png_bytes(panel(title)), png(panel(title)), hillshade_figure(np.zeros(grid.shape), grid, title)):
        assert picture.startswith(b"\x89PNG")
    write_overlay(np.zeros(grid.shape, np.float32), grid, [], tmp_path / "map.png", title)
    assert (tmp_path / "map.png").stat().st_size > 0


def test_dollars_are_drawn() -> None:
    """ "$ii$" must be wider than "ii" by two characters, measured by the columns with ink."""

    def inked(text: str) -> int:
        figure = Figure(figsize=(3, 1))
        figure.text(0.1, 0.4, text, fontsize=20)
        image = cv2.imdecode(np.frombuffer(png_bytes(figure), np.uint8), cv2.IMREAD_GRAYSCALE)
        return int(np.ptp(np.flatnonzero((image < 128).any(axis=0))))

    assert inked("$ii$") > 2 * inked("ii")


def test_powers_of_ten() -> None:
    shown = [power_of_ten(value) for value in (1e-5, 0.1, 1.0, 10.0, 1e12, 0.0, 2.0, 5e-3)]
    assert shown == ["10⁻⁵", "10⁻¹", "10⁰", "10¹", "10¹²", "0", "2", "0.005"]
