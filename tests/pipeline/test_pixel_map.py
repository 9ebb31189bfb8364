"""Pictures that are drawn and compressed without Matplotlib's and Pillow's slower ways look exactly as with them."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from pipeline.report.figures import COLOURS, NO_DATA
from pipeline.report.pixel_map import PixelMap, coloured
from pipeline.report.png import encode_png

EXTENT = (0.0, 7.0, 0.0, 5.0)


def drawn(values: np.ndarray, *, by_imshow: bool) -> np.ndarray:
    figure = Figure(figsize=(4.0, 3.0), dpi=97)
    axes = figure.add_axes((0.13, 0.11, 0.7, 0.5 * 4 / 3))
    if by_imshow:
        axes.set_facecolor(NO_DATA)
        axes.imshow(values, cmap=COLOURS, vmin=-2, vmax=2, extent=EXTENT, interpolation="nearest")
    else:
        figure.add_artist(PixelMap(coloured(values, 2.0, COLOURS, NO_DATA), axes, EXTENT))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def test_a_pixel_map_looks_like_imshow() -> None:
    values = np.random.default_rng(0).normal(size=(50, 70)).astype(np.float32)
    values[:10, 20:30] = np.nan
    assert np.array_equal(drawn(values, by_imshow=False), drawn(values, by_imshow=True))


@pytest.mark.parametrize("channels", [3, 4])
def test_other_programs_read_the_png(channels: int) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (20, 31, channels)).astype(np.uint8)
    with Image.open(io.BytesIO(encode_png(pixels, 150))) as image:
        assert np.array_equal(np.asarray(image), pixels)
        assert image.info["dpi"] == pytest.approx((150, 150), abs=0.02)
