"""Draw the maps of reports: hillshades, maps of changes and of other quantities; each as PNG bytes.

Equal arguments give equal bytes. Colours can be distinguished by colour-blind readers (Okabe and Ito's, RdBu for differences).
"""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import BoundaryNorm, ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from pipeline.report.pixel_map import PixelMap, coloured
from pipeline.report.plain_text import plain_text
from pipeline.report.png import encode_png
from scene.geometry.grid import Grid
from scene.geometry.mesh import WALL, IntArray

SCALE_SIGMAS = 6.0
"""The colour scale of a difference map ends at this many sigma on either side of zero."""
DIFFERENCE_LABEL = "reference minus epoch, mm; missing rock positive"
"""Label of all difference maps, which share one sign and the colours COLOURS: red where rock is missing."""
_WIDEST_PX = 2000
"""Largest side of a picture, px; larger rasters are averaged."""
DPI = 150
_OPAQUE = 255
_MAP_WIDTH_IN, _MAP_HEIGHT_IN = 9.6, 9.0
_PAIRED = 0.55
"""Relative size of a picture that stands beside another one. Its text is larger in proportion; its number of pixels is the
same.
"""
_LOW_IN, _BENEATH_IN = 3.6, 0.65
"""Height of maps below which the colour bar's label has no room beside them; height of the bar beneath them."""
_FAR_M, _ROUND_M = 1e4, 1e3
"""Coordinates beyond the first value, such as those of a national grid, are given relative to a multiple of the second."""
_LEFT_IN, _RIGHT_IN, _BOTTOM_IN, _TOP_IN = 0.7, 1.25, 0.6, 0.4
PICTURE_WIDTH_IN = _LEFT_IN + _MAP_WIDTH_IN + _RIGHT_IN
"""Width of a picture that fills the page."""
FAMILY = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Okabe and Ito's colours for families of curves."""
NO_DATA, _NO_DATA_HILLSHADE = "#b5b5b5", "#c9dced"
_LIGHT = np.array([-0.5, 0.5, np.sqrt(0.5)])
"""Direction towards the light: from the upper left, 45 degrees above the wall's plane."""
COLOURS = colormaps["RdBu_r"].resampled(49)
"""Steps of a quarter of a sigma, which the eye cannot distinguish and which make a smaller file."""
_GREYS = colormaps["gray"].resampled(64)
SEQUENTIAL = colormaps["viridis"].resampled(48)
_MOST_NUMBERED, _MOST_ZOOMED, _ZOOMS_A_ROW = 200, 24, 6
"""Most blocks that are numbered on a map, most that are shown enlarged, and enlarged ones per row."""
_ONE_DECADE = 10.0
"""Span of a logarithmic colour bar below which ticks at 1, 2, 5, 10 are too few."""
_CONSTANT = ListedColormap(["#dbe6ee"])
"""Colour of a map with one value everywhere."""
_MOST_STEPS = 12
"""Largest range of whole numbers that get separate colours."""
_LETTER_IN = 0.066
"""Width of a letter in the label of a colour bar, in."""
_TWO_DECADES = 250.0
"""Span of a logarithmic axis from which on 2 and 5 are not labelled."""
_CROWDED = 0.15
"""A map whose median lies within this share of its range from the lower end gets a logarithmic scale."""


def hillshade_figure(heights: NDArray[np.floating], grid: Grid, title: str = "") -> bytes:
    """Draw the relief of a raster of heights as grey shading, lit from the upper left, and return it as PNG.

    Parameters
    ----------
    heights : (h, w) array
        Heights, m; NaN without data.
    grid : Grid
        Size and position of the raster's pixels, wall frame.
    title : str
        Title of the picture.
    """
    heights, pixel = mean_pooled(heights, pooling(grid)), grid.gsd * pooling(grid)
    down, right = np.gradient(heights, pixel) if min(heights.shape) > 1 else (0 * heights, 0 * heights)
    shade = (-_LIGHT[0] * right + _LIGHT[1] * down + _LIGHT[2]) / np.sqrt(
        1 + right**2 + down**2
    )  # the normal is (-dz/dx, -dz/dy, 1)
    figure, axes = _map_figure(grid, title, bar=False, size=_PAIRED)
    axes.set_facecolor(_NO_DATA_HILLSHADE)
    axes.imshow(shade, cmap=_GREYS, vmin=-0.1, vmax=1.0, extent=raster_extent(grid, shade.shape), interpolation="nearest")
    _no_data_legend(axes, heights, _NO_DATA_HILLSHADE)
    return png_bytes(figure)


def difference_figure(difference: NDArray[np.floating], grid: Grid, block: IntArray, sigma_m: float, title: str = "") -> bytes:
    """Draw a map of the changes between a reference and an epoch, with outlines and numbers of the blocks that fell, as PNG.

    The colours reach from -6 to +6 times `sigma_m`.

    Parameters
    ----------
    difference : (h, w) array
        Reference minus epoch, m, so that missing rock is positive; NaN without data.
    grid : Grid
        Size and position of the pixels, wall frame.
    block : (h, w) array
        Number of the block at each pixel; 0 for the wall. With more than 200 blocks the numbers are omitted.
    sigma_m : float
        Standard deviation of the map's noise, m, greater than 0.
    title : str
        Title of the picture.
    """
    if not sigma_m > 0:
        raise ValueError(f"sigma_m must be positive, got {sigma_m}")
    values = mean_pooled(difference, pooling(grid)) * 1e3
    limit, extent = SCALE_SIGMAS * sigma_m * 1e3, raster_extent(grid, values.shape)
    figure, axes = _map_figure(grid, title)
    figure.add_artist(PixelMap(coloured(values, limit, COLOURS, NO_DATA), axes, extent))
    image = ScalarMappable(Normalize(-limit, limit), COLOURS)
    inside = _max_pooled(block != WALL, pooling(grid))
    if inside.any() and min(inside.shape) > 1:
        axes.contour(inside, levels=[0.5], colors="black", linewidths=0.6, origin="upper", extent=extent)
    places = block_boxes(block)
    for label, (_, right, _, top) in places.items() if len(places) <= _MOST_NUMBERED else ():
        at = grid.x_min + right * grid.gsd, grid.y_max - top * grid.gsd
        number = axes.annotate(f"{label}", at, fontsize=8, annotation_clip=True)
        number.set_path_effects([withStroke(linewidth=2, foreground="white")])
    _sigma_bar(figure, axes, image, sigma_m * 1e3)
    _no_data_legend(axes, values, NO_DATA, "outline: block, numbered as in the table" if inside.any() else "")
    return png_bytes(figure)


def block_boxes(block: IntArray) -> dict[int, tuple[int, int, int, int]]:
    """Find the bounding box of each block's pixels, to place labels and enlarged pictures.

    Parameters
    ----------
    block : (h, w) array
        Number of the block at each pixel; 0 for the wall, which gets no box.

    Returns
    -------
    dict
        Number of the block, and left, right, bottom, top in px from the top-left corner of the raster (right and bottom
        exclusive).
    """
    rows, columns = np.nonzero(block != WALL)
    if not len(rows):
        return {}
    labels, place = np.unique(block[rows, columns], return_inverse=True)
    low = np.full((2, len(labels)), np.iinfo(np.int64).max)
    high = np.full((2, len(labels)), -1)
    for axis, values in enumerate((columns, rows)):
        np.minimum.at(low[axis], place, values)
        np.maximum.at(high[axis], place, values)
    return {
        int(label): (int(low[0, k]), int(high[0, k]) + 1, int(high[1, k]) + 1, int(low[1, k])) for k, label in enumerate(labels)
    }


def blocks_figure(
    difference: NDArray[np.floating], grid: Grid, block: IntArray, sigma_m: float, captions: Mapping[int, str]
) -> bytes | None:
    """Draw each block of a map of changes enlarged, in a window twice as large as the block, as PNG.

    Parameters
    ----------
    difference : (h, w) array
        Reference minus epoch, m; NaN without data.
    grid : Grid
        Size and position of the pixels.
    block : (h, w) array
        Number of the block at each pixel; 0 for the wall.
    sigma_m : float
        Standard deviation of the map's noise, m. The colours reach from -6 to +6 times this.
    captions : mapping of int to str
        Captions by number of the block, in the order in which blocks are shown. At most 24 are.

    Returns
    -------
    bytes or None
        The picture; None if none of the blocks is on the map.
    """
    places = block_boxes(block)
    shown = [label for label in captions if label in places][:_MOST_ZOOMED]
    if not shown:
        return None
    rows = -(-len(shown) // _ZOOMS_A_ROW)
    figure = Figure(figsize=(PICTURE_WIDTH_IN, 0.3 + 2.1 * rows), dpi=DPI, layout="constrained")
    limit = SCALE_SIGMAS * sigma_m * 1e3
    for axes, label in zip(figure.subplots(rows, _ZOOMS_A_ROW, squeeze=False).flat, shown, strict=False):
        left, right, bottom, top = places[label]
        reach = max(right - left, bottom - top, 4)
        (first, last), (begin, end) = (
            ((low + high) // 2 - reach, (low + high) // 2 + reach) for low, high in ((top, bottom), (left, right))
        )
        part = slice(max(first, 0), max(last, 1)), slice(max(begin, 0), max(end, 1))
        axes.set_facecolor(NO_DATA)
        axes.imshow(1e3 * difference[part], cmap=COLOURS, vmin=-limit, vmax=limit, interpolation="nearest")
        if min(difference[part].shape) > 1:
            axes.contour(block[part] == label, levels=[0.5], colors="black", linewidths=0.8)
        side = difference[part].shape[1] * grid.gsd
        axes.set_title(f"{label}: {captions[label]}, picture {side:.2g} m wide", fontsize=8)
        axes.set(xticks=[], yticks=[])
    for axes in figure.axes[len(shown) :]:
        axes.set_visible(False)
    return png_bytes(figure)


def map_figure(values: NDArray[np.floating], grid: Grid, label: str, title: str = "") -> bytes:
    """Draw a map of any quantity over the wall, such as the point spacing, as PNG.

    Colours span its 1 to 99 % quantiles, on a logarithmic scale if most of the map would otherwise have nearly one colour. Whole
    numbers, such as counts, get a colour each. A quantity that is the same everywhere is written as text instead.

    Parameters
    ----------
    values : (h, w) array
        Values of the quantity; NaN without data.
    grid : Grid
        Size and position of the pixels, wall frame.
    label : str
        Unit of the values, as text of the colour bar.
    title : str
        Title of the picture.
    """
    known = values[np.isfinite(values)]
    counts = bool(known.size) and np.array_equal(known, np.round(known))
    pooled = mean_pooled(values, pooling(grid))
    pooled = np.round(pooled) if counts else pooled
    known = pooled[np.isfinite(pooled)]
    scale = _count_scale(known) if counts else _scale(known)
    figure, axes = _map_figure(grid, title, size=_PAIRED)
    axes.set_facecolor(NO_DATA)
    image = axes.imshow(pooled, cmap=SEQUENTIAL, norm=scale, extent=raster_extent(grid, pooled.shape), interpolation="nearest")
    if known.size and np.ptp(known) <= 1e-6 * np.abs(known).max():
        image.set(cmap=_CONSTANT, norm=Normalize(known[0] - 1, known[0] + 1))
        words = {"transform": axes.transAxes, "ha": "center", "va": "center", "fontsize": 12}
        axes.text(0.5, 0.5, f"{known[0]:.4g} {label} everywhere", **words)
        _no_data_legend(axes, pooled, NO_DATA)
        return png_bytes(figure)
    beyond = known.size and (known.min() < scale.vmin or known.max() > scale.vmax)
    bar = _colour_bar(figure, axes, image, label, "both" if beyond else "neither")
    if isinstance(scale, LogNorm) and scale.vmax < _ONE_DECADE * scale.vmin:
        ticks = MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(scale.vmin, scale.vmax)
        inside = ticks[(ticks >= scale.vmin) & (ticks <= scale.vmax)]
        bar.set_ticks(inside, labels=[f"{tick:g}" for tick in inside])
        bar.minorticks_off()
    elif isinstance(scale, LogNorm):
        plain_numbers(bar.long_axis)
    elif counts:
        bar.locator = MaxNLocator(integer=True)
        bar.minorticks_off()
    _no_data_legend(axes, pooled, NO_DATA)
    return png_bytes(figure)


def _count_scale(known: NDArray[np.floating]) -> Normalize:
    """Return the colour scale of whole numbers (n,): a colour for each, or a continuous scale if there are many."""
    low, high = float(known.min()), float(known.max())
    if high - low > _MOST_STEPS:
        return _scale(known)
    return BoundaryNorm(np.arange(low - 0.5, high + 1.0), SEQUENTIAL.N)


def _scale(known: NDArray[np.floating]) -> Normalize:
    """Return the colour scale for values (n,): 1 to 99 % quantiles, logarithmic if half are near the lower end."""
    low, middle, high = np.quantile(known, [0.01, 0.5, 0.99]).tolist() if known.size else (0.0, 0.5, 1.0)
    crowded = low > 0 and middle - low < _CROWDED * (high - low)
    return LogNorm(low, high) if crowded else Normalize(low, high)


def plain_numbers(axis: Axis) -> None:
    """Label a logarithmic axis with ordinary numbers at 1, 2, 5, 10, 20, ...; from a span of 250 on, only at powers of ten."""

    def number(value: float, _: Any) -> str:
        low, high = axis.get_view_interval()
        is_power = f"{value:.6e}".startswith("1.000000")
        return f"{value:g}" if is_power or high < _TWO_DECADES * low else ""

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(number))
    axis.set_minor_formatter(NullFormatter())


def _map_figure(grid: Grid, title: str, *, bar: bool = True, size: float = 1.0) -> tuple[Figure, Axes]:
    """Make a figure whose axes have the aspect of the grid, in wall-frame metres.

    bar: whether to leave room for a colour bar; size: relative size of the map, whose number of pixels stays the same.
    """
    aspect = grid.height / grid.width
    width = min(_MAP_WIDTH_IN, _MAP_HEIGHT_IN / aspect) * size
    height = width * aspect
    beneath = bar and height < _LOW_IN
    bottom = _BOTTOM_IN + (_BENEATH_IN if beneath else 0.0)
    full_width, full_height = _LEFT_IN + width + (_RIGHT_IN if bar and not beneath else 0.2), bottom + height + _TOP_IN
    figure = Figure(figsize=(full_width, full_height), dpi=DPI / size)
    axes = figure.add_axes((_LEFT_IN / full_width, bottom / full_height, width / full_width, height / full_height))
    axes.set_title(title, fontsize=11, loc="left")
    label_map_axes(axes, grid.x_min, grid.y_max - grid.height * grid.gsd)
    return figure, axes


def label_map_axes(axes: Axes, left: float, bottom: float) -> None:
    """Label the axes of a map over a wall with x and y in metres.

    Coordinates of 10 km and more, such as those of a national grid, are shortened: the label names a round number to add.

    Parameters
    ----------
    axes : Axes
        Matplotlib's axes that show the map.
    left, bottom : float
        Smallest x and y of the map, wall frame, m.
    """
    offsets = [_shortened(axis, low) for axis, low in ((axes.xaxis, left), (axes.yaxis, bottom))]
    far = f" (from x {offsets[0]:,.0f}, y {offsets[1]:,.0f})" if any(offsets) else ""
    label_axes(axes, f"x along the wall, m{far}", "y up the wall, m")


def _shortened(axis: Axis, low: float) -> float:
    """Make the tick labels of an axis that starts at `low` relative to a round number, and return that number."""
    if abs(low) < _FAR_M:
        return 0.0
    offset = float(_ROUND_M * np.floor(low / _ROUND_M))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value - offset:g}"))
    return offset


def colour_bar_position(height_in: float) -> tuple[dict[str, Any], float]:
    """Choose where a map's colour bar goes: to the right of a high map, below a low one, whose side has no room for the label.

    Parameters
    ----------
    height_in : float
        Height of the map, inches.

    Returns
    -------
    (dict, float)
        Arguments for Matplotlib's `colorbar`, and the height that the bar takes below the map, inches; 0 at the right.
    """
    if height_in < _LOW_IN:
        return {"location": "bottom", "shrink": 0.6, "aspect": 45}, _BENEATH_IN
    return {"location": "right", "shrink": 0.8}, 0.0


def label_axes(axes: Axes, x_label: str, y_label: str) -> None:
    """Label the x and y axes of a picture, in the font size that all pictures of the reports share."""
    axes.set_xlabel(x_label, fontsize=9)
    axes.set_ylabel(y_label, fontsize=9)
    axes.tick_params(labelsize=8)


def _colour_bar(figure: Figure, axes: Axes, image: ScalarMappable, label: str, extend: str) -> Colorbar:
    """Add a colour bar at the right of a map, or beneath a low one."""
    box, width, height = axes.get_position(), figure.get_figwidth(), figure.get_figheight()
    if box.height * height < _LOW_IN:
        place, orientation = (box.x0 + 0.1 * box.width, _BENEATH_IN / height, 0.8 * box.width, 0.14 / height), "horizontal"
    else:
        place, orientation = (box.x1 + 0.15 / width, box.y0, 0.16 / width, box.height), "vertical"
    bar = figure.colorbar(image, cax=figure.add_axes(place), extend=extend, orientation=orientation)
    bar.ax.tick_params(labelsize=8)
    length = (box.height * height if orientation == "vertical" else 0.8 * box.width * width) / _LETTER_IN
    bar.set_label(fill(label, max(int(length), 12)), fontsize=9)
    return bar


def _sigma_bar(figure: Figure, axes: Axes, image: ScalarMappable, sigma_mm: float) -> None:
    limit = SCALE_SIGMAS * sigma_mm
    ticks = MaxNLocator(nbins=8, steps=[1, 2, 2.5, 5, 10], symmetric=True).tick_values(-limit, limit)
    ticks = ticks[np.abs(ticks) <= 1.001 * limit]
    digits = max(0, int(np.ceil(-np.log10(np.diff(ticks).min()) + 0.39)))  # + 0.39, because 2.5 needs one more digit
    sigma = "\N{GREEK SMALL LETTER SIGMA}"
    label = f"{DIFFERENCE_LABEL}; to 6 {sigma}, {sigma} = {sigma_mm:.3g} mm"
    _colour_bar(figure, axes, image, label, "both").set_ticks(ticks, labels=[signed(tick, digits) for tick in ticks])


def signed(value: float, digits: int) -> str:
    """Format a number with `digits` decimals and its sign, with a typographic minus sign; a rounded zero has no sign."""
    return f"{value:+.{digits}f}".replace("-", "\N{MINUS SIGN}") if round(value, digits) else f"{0:.{digits}f}"


def _no_data_legend(axes: Axes, values: NDArray[np.floating], colour: str, outline: str = "") -> None:
    handles = [Patch(facecolor=colour, edgecolor="0.3", linewidth=0.5, label="no data")] if np.isnan(values).any() else []
    if outline:
        handles.append(Patch(facecolor="none", edgecolor="black", linewidth=0.8, label=outline))
    if handles:
        axes.legend(handles=handles, loc="lower right", bbox_to_anchor=(1, 1), ncols=2, fontsize=8, frameon=False, borderpad=0.1)


def pooling(grid: Grid) -> int:
    """Return the factor by which a raster is reduced so that its picture has at most 2000 pixels a side.

    With the factor f, the mean of f x f pixels becomes one pixel of the picture; 1 means no reduction. grid: the raster.
    """
    return max(1, int(np.ceil(max(grid.width, grid.height) / _WIDEST_PX)))


def raster_extent(grid: Grid, shape: tuple[int, ...]) -> tuple[float, float, float, float]:
    """Return left, right, bottom, top of a raster that was reduced for a picture, wall frame, m (Matplotlib's `extent`).

    Parameters
    ----------
    grid : Grid
        Size and position of the original pixels.
    shape : (int, int)
        Height and width of the reduced raster (see `pooling`), px.
    """
    pixel = grid.gsd * pooling(grid)
    return grid.x_min, grid.x_min + shape[1] * pixel, grid.y_max - shape[0] * pixel, grid.y_max


def _cells(raster: NDArray[Any], factor: int) -> NDArray[Any]:
    """View a raster as (h, factor, w, factor); incomplete cells at the right and the bottom are left out."""
    height, width = (max(size // factor, 1) for size in raster.shape)
    rows, columns = min(factor, raster.shape[0]), min(factor, raster.shape[1])
    return raster[: height * rows, : width * columns].reshape(height, rows, width, columns)


def mean_pooled(raster: NDArray[np.floating], factor: int) -> NDArray[np.float32]:
    """Reduce a raster by averaging blocks of `factor` x `factor` pixels, so that it fits a picture.

    Parameters
    ----------
    raster : (h, w) array
        The raster; NaN is ignored in the averages.
    factor : int
        Side of the blocks, px. Incomplete blocks at the right and lower edge are left out.

    Returns
    -------
    (h // factor, w // factor) array
        The averages; NaN where a block has no data.
    """
    if factor == 1:
        return raster.astype(np.float32)
    cells = _cells(raster, factor)
    known = ~np.isnan(cells)
    count = known.sum(axis=(1, 3))
    total = np.where(known, cells, 0).sum(axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)


def _max_pooled(mask: NDArray[np.bool_], factor: int) -> NDArray[np.bool_]:
    return np.asarray(_cells(mask, factor).any(axis=(1, 3)))


def png_bytes(figure: Figure) -> bytes:
    """Convert a Matplotlib figure to a PNG file without date or version, so that equal figures give equal bytes."""
    canvas = FigureCanvasAgg(figure)
    with plain_text(figure):
        canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())
    opaque = pixels[:, :, 3].min() == _OPAQUE
    return encode_png(pixels[:, :, :3] if opaque else pixels, figure.dpi)
