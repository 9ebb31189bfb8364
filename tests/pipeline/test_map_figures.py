"""Maps over a wall: labels fit into the picture for any width of the wall, and national-grid coordinates are readable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gap_cases import write_scan
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from pipeline.comparison import figures as comparison_figures
from pipeline.comparison.figures import MapPanel, side_by_side
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.naming.workflow import diagnose
from pipeline.gap.report import figures as gap_figures
from pipeline.report import figures
from pipeline.report.figures import DIFFERENCE_LABEL, difference_figure, map_figure
from scene.geometry.grid import Grid

EAST, NORTH = 679_805.0, 8_428_069.0
SHAPES = [(40, 800), (60, 240), (100, 100), (300, 40)]
"""Rows and columns of walls 20 times as wide as high up to 7.5 times as high as wide."""


def drawings(grid: Grid) -> dict[str, Callable[[], bytes]]:
    values = (0.003 * np.random.default_rng(2).standard_normal((grid.height, grid.width))).astype(np.float32)
    block = np.zeros(values.shape, dtype=np.int32)
    panels = [MapPanel(name, values, grid, block) for name in ("laser scanner", "stereo pair")]
    return {
        "difference": lambda: difference_figure(values, grid, block, 0.003),
        "map": lambda: map_figure(np.abs(values), grid, "angle of incidence, degrees from the normal"),
        "side by side": lambda: side_by_side(panels, 0.02, DIFFERENCE_LABEL, signed=True),
    }


def drawn(monkeypatch: pytest.MonkeyPatch, draw: Callable[[], bytes]) -> Figure:
    kept: list[Figure] = []

    def keep(figure: Figure, *_: Any) -> bytes:
        FigureCanvasAgg(figure).draw()
        kept.append(figure)
        return b""

    for module in (figures, comparison_figures):
        monkeypatch.setattr(module, "png_bytes", keep)
    monkeypatch.setattr(gap_figures, "png", keep)
    draw()
    return kept[0]


@pytest.mark.parametrize("name", ["difference", "map", "side by side"])
@pytest.mark.parametrize("shape", SHAPES)
def test_the_label_of_a_colour_bar_is_within_the_picture(
    name: str, shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = Grid(x_min=0.0, y_max=shape[0] * 0.05, gsd=0.05, width=shape[1], height=shape[0])
    figure = drawn(monkeypatch, drawings(grid)[name])
    bar = figure.axes[-1]
    label = bar.xaxis.label if bar.xaxis.label.get_text() else bar.yaxis.label
    assert label.get_text()
    picture, box = figure.bbox, label.get_window_extent()
    assert picture.x0 <= box.x0 < box.x1 <= picture.x1
    assert picture.y0 <= box.y0 < box.y1 <= picture.y1
    assert not Bbox.intersection(box, figure.axes[0].get_window_extent())


@pytest.mark.parametrize("name", ["difference", "map", "side by side"])
def test_places_of_a_national_grid_are_relative_to_an_offset_that_is_told(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    grid = Grid(x_min=EAST, y_max=NORTH, gsd=0.1, width=200, height=150)
    panel = drawn(monkeypatch, drawings(grid)[name]).axes[0]
    assert panel.get_xlabel() == "x along the wall, m (from x 679,000, y 8,428,000)"
    for axis, low, high in ((panel.xaxis, 805, 825), (panel.yaxis, 54, 69)):
        shown = [float(label.get_text()) for label in axis.get_ticklabels()]
        assert sum(low <= each <= high for each in shown) >= 3
        assert axis.get_offset_text().get_text() == ""


def test_residuals_of_a_national_grid_are_mapped_and_of_a_narrow_strip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_scan(tmp_path, 1, step_rad=0.05)
    found = diagnose(read_measurement(tmp_path))
    for at in (found.residuals.wall_xy + np.array([EAST, NORTH]), found.residuals.wall_xy * [1.0, 1e-9]):
        moved = replace(found, residuals=replace(found.residuals, wall_xy=at))
        figure = drawn(monkeypatch, lambda moved=moved: gap_figures.maps_figure(moved))
        assert all(max(axes.images[0].get_array().shape) <= 500 for axes in figure.axes[:4])
        shown = [float(label.get_text().replace("\N{MINUS SIGN}", "-")) for label in figure.axes[2].get_xticklabels()]
        assert max(shown) < 1000
