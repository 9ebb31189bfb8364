"""Draw the map of a raster quickly: each pixel of the picture has the colour of the raster at its centre.

Matplotlib's imshow draws the same, but it first enlarges the values to the pixels of the picture, which takes six times as long.
"""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.colors import Colormap, to_rgb
from numpy.typing import NDArray

_OPAQUE = 255


def coloured(values: NDArray[np.floating], limit: float, colours: Colormap, no_data: str) -> NDArray[np.uint8]:
    """Return the colours (h, w, 3) of a raster.

    values: (h, w). limit: value at the end of the colour scale, which begins at -limit. colours: of at most 255 steps. no_data:
    colour of NaN.
    """
    steps = colours(np.arange(colours.N), bytes=True)[:, :3]
    table = np.concatenate([steps, [np.rint(_OPAQUE * np.array(to_rgb(no_data)))]]).astype(np.uint8)
    step = (values + np.float32(limit)) * np.float32(colours.N / (2 * limit))
    step = np.where(np.isnan(step), colours.N, np.clip(step, 0, colours.N - 1))
    return np.asarray(table[step.astype(np.uint8)])


class PixelMap(Artist):
    """A raster of colours that fills axes, as an element of a Matplotlib figure.

    Parameters
    ----------
    colours : (h, w, 3) array
        Colours, the top row first.
    axes : Axes
        The axes; their background becomes transparent, because the map lies beneath them.
    extent : (float, float, float, float)
        Left, right, bottom and top of the raster, which become the limits of the axes.
    """

    def __init__(self, colours: NDArray[np.uint8], axes: Axes, extent: tuple[float, float, float, float]) -> None:
        super().__init__()
        self.set_zorder(-1)
        axes.set(xlim=extent[:2], ylim=extent[2:], aspect="equal", facecolor="none")
        self._colours, self._axes = colours, axes

    def draw(self, renderer: RendererBase) -> None:
        """Draw the raster. renderer: Matplotlib's, of pixels."""
        self._axes.apply_aspect()
        box = self._axes.get_window_extent()
        height, width = self._colours.shape[:2]
        columns = _cells_at(box.x0, box.x1, width)
        rows = height - 1 - _cells_at(box.y0, box.y1, height)
        pixels = np.full((len(rows), len(columns), 4), _OPAQUE, dtype=np.uint8)
        pixels[:, :, :3] = self._colours[rows][:, columns]
        renderer.draw_image(renderer.new_gc(), round(box.x0), round(box.y0), pixels)


def _cells_at(low: float, high: float, count: int) -> NDArray[np.int64]:
    """Return which of `count` cells between two places on the picture, px, lies at each pixel between them."""
    centre = np.arange(round(low), round(high)) + 0.5
    return np.clip((centre - low) * (count / (high - low)), 0, count - 1).astype(np.int64)
