"""The pictures of the viewer's page, and what a click on them selects."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.view.figures import map_figure, wall_figure
from pipeline.view.page import clicked, zoom
from pipeline.view.results import Item, Layer, Patch


def patch_of(values: np.ndarray) -> Patch:
    height, width = values.shape
    return Patch(
        np.arange(width, dtype=float), np.arange(height)[::-1].astype(float), 0 * values, values, (values > 5).astype(int), 1
    )


def test_the_figures_are_about_zero_and_name_their_items() -> None:
    layer = Layer("difference", "reference minus epoch", "mm", 1e3, diverging=True, limit=6.0)
    block = Item("block", "block 1", (1, 2, 1, 2, -0.1, 0.1), {"volume": "1 m³"})
    items = [block, Item("detection", "detection 1", (2, 3, 0, 1, np.nan, np.nan))]
    far = Item("block", "block 9", (90, 92, 1, 2, 0, 1))
    patch = patch_of(np.arange(20.0).reshape(4, 5))
    wall = wall_figure(patch, None, [*items, far], layer, ["surface", "block", "detection"], 0)
    surface = wall.data[0]
    assert (surface.cmin, surface.cmax) == (-6, 6)
    assert surface.colorscale[0][1] != surface.colorscale[-1][1]
    handles = [trace for trace in wall.data[1:] if trace.mode == "markers"]
    assert [list(map(list, trace.customdata)) for trace in handles] == [[[0]], [[1]]]  # block 9 is not in the window
    assert handles[0].text[0] == "<b>block 1</b><br>volume: 1 m³"
    flat = map_figure(patch, items, layer, ["surface"], None)
    assert [trace.type for trace in flat.data] == ["heatmap"]


def test_clicks_and_zooms() -> None:
    assert clicked({"points": [{"customdata": [3], "text": "block"}]}) == 3
    assert clicked({"points": [{"customdata": 3.5, "text": ""}]}) is None
    assert clicked(None) is None
    ranges = {"xaxis.range[0]": 1, "xaxis.range[1]": 2, "yaxis.range[0]": 3, "yaxis.range[1]": 4}
    assert zoom(ranges, None) == [1, 2, 3, 4]
    assert zoom({"xaxis.autorange": True}, [1, 2, 3, 4]) is None


@pytest.mark.parametrize(("width", "height"), [(24.0, 15.0), (100.0, 30.0), (3.0, 3.0), (5.0, 20.0)])
def test_the_first_view_holds_the_whole_wall(width: float, height: float) -> None:
    """Plotly's camera: 45 degrees up and down, at the eye, towards the middle; in units in which the product of extents is 1."""
    x, y = np.linspace(0, width, 9), np.linspace(0, height, 7)
    relief = np.add.outer(np.sin(y), np.sin(x))
    patch = Patch(x, y, relief, relief, np.zeros((7, 9), dtype=int), 1)
    figure = wall_figure(patch, None, [], Layer("difference", "difference", "mm", 10.0), {"surface"})
    eye = np.array([figure.layout.scene.camera.eye[axis] for axis in "xyz"])
    extent = np.array([width, height, np.ptp(relief)])
    corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, 8).T * extent / np.cbrt(extent.prod())
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    seen = corners - eye
    tangent = np.abs(seen @ np.stack([right, np.cross(right, forward)], axis=1)) / (seen @ forward)[:, None]
    assert tangent[:, 1].max() < np.tan(np.radians(22.5))
    assert tangent[:, 0].max() < 1.5 * np.tan(np.radians(22.5))
    assert tangent.max() > 0.6 * np.tan(np.radians(22.5))  # and is no speck in it
