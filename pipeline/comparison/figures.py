"""Draw the pictures of a comparison as PNG: maps side by side on one colour scale, and curves with one colour for each sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.comparison.assess import DetectionClass, MapNoise, SensorAssessment
from pipeline.comparison.detection_curve import DetectionCurve
from pipeline.report.figures import (
    COLOURS,
    DIFFERENCE_LABEL,
    DPI,
    FAMILY,
    NO_DATA,
    SCALE_SIGMAS,
    SEQUENTIAL,
    colour_bar_position,
    label_axes,
    label_map_axes,
    mean_pooled,
    plain_numbers,
    png_bytes,
    pooling,
    raster_extent,
)
from pipeline.report.plain_text import powers_of_ten
from scene.geometry.grid import Grid
from scene.geometry.mesh import IntArray

_WIDTH_IN = 13.0
_SIZE_LABEL = "block size, ∛(2 V), m"
COVARIATES = {
    "range_m": ("mean range, m", 1.0),
    "incidence_rad": ("incidence angle, degrees", 180 / np.pi),
    "edge_m": ("distance from the nearest edge, m", 1.0),
    "albedo": ("albedo", 1.0),
}
"""Axis label and display factor of each covariate."""


@dataclass(frozen=True)
class MapPanel:
    """One map in a figure that shows the maps of several sensors side by side.

    Attributes
    ----------
    title : Title above the map.
    values : (h, w) values, m; NaN without data.
    grid : Raster of the map, for its axes in m.
    block : (h, w) block labels, 0 outside, whose outlines are drawn; None: no outlines.
    """

    title: str
    values: NDArray[np.floating]
    grid: Grid
    block: IntArray | None = None


def side_by_side(panels: Sequence[MapPanel], limit_m: float, label: str, *, signed: bool) -> bytes:
    """Draw the maps of several sensors in rows of two on one colour scale, so that they can be compared.

    Parameters
    ----------
    panels : The maps.
    limit_m : Upper end of the scale, m.
    label : Label of the colour bar.
    signed : Whether the scale begins at -limit_m, as for differences; otherwise at 0.

    Returns
    -------
    The figure as PNG.
    """
    columns = min(len(panels), 2)
    rows = -(-len(panels) // columns)
    aspect = max(panel.grid.height / panel.grid.width for panel in panels)
    height = rows * (_WIDTH_IN / columns * aspect + 0.5) + 0.4
    place, room = colour_bar_position(height)
    figure = Figure(figsize=(_WIDTH_IN, height + room), dpi=DPI, layout="constrained")
    grid = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    low, colours = (-limit_m * 1e3, COLOURS) if signed else (0.0, SEQUENTIAL)
    for axes, panel in zip(grid, panels, strict=False):
        values = mean_pooled(panel.values, pooling(panel.grid)) * 1e3
        extent = raster_extent(panel.grid, values.shape)
        axes.set_facecolor(NO_DATA)
        image = axes.imshow(values, cmap=colours, vmin=low, vmax=limit_m * 1e3, extent=extent, interpolation="nearest")
        if panel.block is not None and panel.block.any():
            inside = panel.block[:: pooling(panel.grid), :: pooling(panel.grid)] != 0
            axes.contour(inside, levels=[0.5], colors="black", linewidths=0.5, origin="upper", extent=extent)
        axes.set_title(panel.title, fontsize=10, loc="left")
        label_map_axes(axes, extent[0], extent[2])
    bar = figure.colorbar(image, ax=grid.tolist(), pad=0.01, extend="both" if signed else "max", **place)
    bar.ax.tick_params(labelsize=8)
    bar.set_label(label, fontsize=9)
    return png_bytes(figure)


def noise_figure(noises: Mapping[str, MapNoise]) -> bytes:
    """Draw the noise of several sensors: histograms, linear and logarithmic, and variograms with fitted models. Returns a PNG.

    noises: the noise of each sensor, by its name. Dashed lines are normal distributions with the same median and NMAD.
    """
    figure = Figure(figsize=(_WIDTH_IN, 4.4), dpi=DPI, layout="constrained")
    linear, logarithmic, correlation = figure.subplots(1, 3)
    for colour, (name, noise) in zip(_colours(len(noises)), noises.items(), strict=True):
        found, count = noise.histogram, max(noise.stable.count, 1)
        middle, width = (found.edges[1:] + found.edges[:-1]) * 500, np.diff(found.edges) * 1e3
        for axes in (linear, logarithmic):
            axes.step(middle, found.counts / count / width, where="mid", color=colour, linewidth=1.2, label=name)
            axes.plot(middle, found.normal / count / width, color=colour, linewidth=0.8, linestyle="--")
        correlation.plot(noise.variogram.lag_m, noise.variogram.semivariance_m2 * 1e6, "o", color=colour, markersize=3)
        lag = np.geomspace(noise.variogram.lag_m[0], noise.variogram.lag_m[-1], 200)
        correlation.plot(lag, noise.model.semivariance(lag) * 1e6, color=colour, linewidth=1.2)
    logarithmic.set_yscale("log")
    powers_of_ten(logarithmic.yaxis)
    logarithmic.set_ylim(bottom=1e-5)
    label_axes(linear, DIFFERENCE_LABEL, "density, 1/mm")
    label_axes(logarithmic, DIFFERENCE_LABEL, "density, 1/mm")
    _metric(correlation, both=True)
    label_axes(correlation, "distance, m", "semivariance, mm²")
    _grid_and_legend(figure, [linear, logarithmic, correlation])
    return png_bytes(figure)


def covariate_figure(found: Sequence[SensorAssessment]) -> bytes:
    """Draw how the noise of several sensors depends on range, incidence angle, distance from edges, and albedo. Returns a PNG.

    found: the results of each sensor. The figure shows the NMAD of the differences over stable ground.
    """
    figure = Figure(figsize=(_WIDTH_IN, 6.4), dpi=DPI, layout="constrained")
    panels = figure.subplots(2, 2, sharey=True).ravel()
    for axes, (key, (label, factor)) in zip(panels, COVARIATES.items(), strict=True):
        for colour, each in zip(_colours(len(found)), found, strict=True):
            bins = [item for item in each.by[key] if item.statistics.count]
            high = [item.high if np.isfinite(item.high) else 2 * item.low for item in bins]
            middle = [(item.low + top) / 2 * factor for item, top in zip(bins, high, strict=True)]
            axes.plot(
                middle,
                [item.statistics.nmad * 1e3 for item in bins],
                "o-",
                color=colour,
                markersize=3.5,
                linewidth=1.2,
                label=each.name,
            )
        if key == "edge_m":
            _metric(axes)
        label_axes(axes, label, "NMAD, mm")
    panels[0].set_ylim(bottom=0)
    _grid_and_legend(figure, list(panels))
    return png_bytes(figure)


def detection_figure(found: Sequence[SensorAssessment]) -> bytes:
    """Draw which share of the fallen blocks sensors detect, against size and depth, and volume errors. Returns a PNG.

    found: the results of each sensor. Points are size classes with 95 % intervals, lines the fitted curves. Volume errors are
    drawn for classes of which at least half are detected; below, the noise is as large as the volume.
    """
    figure = Figure(figsize=(_WIDTH_IN, 4.4), dpi=DPI, layout="constrained")
    by_size, by_depth, volume = figure.subplots(1, 3)
    for number, (colour, each) in enumerate(zip(_colours(len(found)), found, strict=True)):
        shift = 1.012 ** (number - (len(found) - 1) / 2)
        detection = each.detection
        _shares(by_size, detection.size_classes, detection.by_size, colour, shift, each.name)
        _shares(by_depth, detection.depth_classes, detection.by_depth, colour, shift, each.name)
        shown = [item for item in detection.size_classes if item.volume_error is not None and 2 * item.seen >= item.blocks]
        middle = [np.sqrt(item.low_m * item.high_m) * shift for item in shown]
        error = [100 * (item.volume_error or 0.0) for item in shown]
        spread = [100 * (item.volume_spread or 0.0) for item in shown]
        volume.errorbar(middle, error, spread, fmt="o-", color=colour, markersize=3.5, linewidth=1.2, capsize=2)
    for axes, label in ((by_size, _SIZE_LABEL), (by_depth, "mean depth of the niche, m")):
        axes.axhline(95, color="0.3", linewidth=0.8, linestyle=":")
        axes.set_ylim(-3, 103)
        label_axes(axes, label, "blocks seen, %")
    volume.axhline(0, color="0.3", linewidth=0.8, linestyle=":")
    volume.set_ylim(-100, 100)
    label_axes(volume, _SIZE_LABEL, "volume error, %: median, NMAD")
    volume.sharex(by_size)  # is empty if fewer than half of the blocks of every size are detected
    for axes in (by_size, by_depth):
        _metric(axes)
    _grid_and_legend(figure, [by_size, by_depth, volume])
    return png_bytes(figure)


def table_figure(found: Sequence[SensorAssessment]) -> bytes:
    """Draw the share of fallen blocks that each sensor detects, in classes of both size and depth. Returns a PNG.

    found: the results of each sensor, one panel each. Fields without a block stay white.
    """
    figure = Figure(figsize=(_WIDTH_IN, 4.0), dpi=DPI, layout="constrained")
    row = np.atleast_1d(figure.subplots(1, len(found), sharey=True))
    for axes, each in zip(row, found, strict=True):
        detection = each.detection
        size = [item.low_m for item in detection.size_classes] + [detection.size_classes[-1].high_m]
        depth = [item.low_m for item in detection.depth_classes] + [detection.depth_classes[-1].high_m]
        image = axes.pcolormesh(size, depth, 100 * detection.table.T, cmap=SEQUENTIAL, vmin=0, vmax=100)
        _metric(axes, both=True)
        axes.set_title(each.name, fontsize=10, loc="left")
        label_axes(axes, _SIZE_LABEL, "mean depth of the niche, m")
    bar = figure.colorbar(image, ax=row.tolist(), pad=0.01)
    bar.ax.tick_params(labelsize=8)
    bar.set_label("blocks seen, %", fontsize=9)
    return png_bytes(figure)


def scale_limit_m(sigma_m: float) -> float:
    """Return the upper end of the colour scale of difference maps, m, as a fixed multiple of their noise.

    sigma_m: standard deviation of the noise, m.
    """
    return SCALE_SIGMAS * sigma_m


def level_limit_m(noises: Sequence[MapNoise]) -> float:
    """Return the upper end of the colour scale for maps of the level of detection, m.

    noises: the noise of each sensor. The end is the largest of the sensors' 98 % quantiles of the level.
    """
    tops = [float(np.nanquantile(noise.level, 0.98)) for noise in noises if np.isfinite(noise.level).any()]
    return max(tops, default=1e-3) or 1e-3


def _shares(
    axes: Axes, classes: Sequence[DetectionClass], curve: DetectionCurve | None, colour: str, shift: float, name: str
) -> None:
    """Draw the share detected by class with intervals, and the fitted curve."""
    shown = [item for item in classes if item.blocks]
    middle = np.array([np.sqrt(item.low_m * item.high_m) * shift for item in shown])
    share = np.array([100 * item.seen / item.blocks for item in shown])
    low, high = (np.array([100 * item.interval[end] for item in shown]) for end in (0, 1))
    bars = np.maximum(np.stack([share - low, high - share]), 0)
    axes.errorbar(middle, share, bars, fmt="o", color=colour, markersize=3.5, linewidth=0.9, capsize=2, label=name)
    if curve is not None:
        x = np.geomspace(curve.smallest_m, curve.largest_m, 200)
        axes.plot(x, 100 * curve.probability(x), color=colour, linewidth=1.4)


def _colours(count: int) -> list[str]:
    """Return one colour for each sensor."""
    return [FAMILY[number % len(FAMILY)] for number in range(count)]


def _metric(axes: Axes, *, both: bool = False) -> None:
    """Make one axis, or both, logarithmic with plain numbers, unless nothing positive is drawn."""
    scales = [(axes.set_xscale, axes.xaxis), (axes.set_yscale, axes.yaxis)][: 1 + both]
    for (set_scale, axis), smallest in zip(scales, axes.dataLim.minpos, strict=False):
        if np.isfinite(smallest):
            set_scale("log")
            plain_numbers(axis)


def _grid_and_legend(figure: Figure, panels: Sequence[Axes]) -> None:
    """Add grid lines to all panels and one legend to the figure."""
    for axes in panels:
        axes.grid(color="0.9", linewidth=0.6)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=9, frameon=False)
