"""Draw the pictures of a data set card as PNG: block sizes, noise of the epochs, and sample tiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pipeline.report.figures import FAMILY, NO_DATA, SCALE_SIGMAS, png_bytes

_DPI = 110
_STYLES = ("-", "--", ":", "-.")
_BINS = 40


@dataclass(frozen=True)
class SampleTile:
    """A tile to draw as an example in a data set's README.

    Attributes
    ----------
    title : Title of the panel.
    values : (h, w) differences, m.
    blocks : (h, w) true within annotated masks.
    sigma_m : Noise of its epoch, m; the colour scale ends at six times this.
    """

    title: str
    values: NDArray[np.floating]
    blocks: NDArray[np.bool_]
    sigma_m: float


def sizes_figure(counts: Mapping[str, NDArray[np.integer]], edges: NDArray[np.floating]) -> bytes:
    """Draw histograms of the sizes of a data set's blocks, as PNG.

    counts: number of blocks in each bin, by size class. edges: edges of the bins, m, equally spaced in the logarithm.
    """
    figure, axes = _axes()
    for number, (name, values) in enumerate(counts.items()):
        axes.stairs(values, edges, fill=True, alpha=0.35, color=FAMILY[number % len(FAMILY)], label=name)
    axes.set_xscale("log")
    ticks = [tick for tick in (0.05, 0.1, 0.2, 0.5, 1, 2, 5) if edges[0] <= tick <= edges[-1]]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    _dress(axes, "block size (mean of its three axes), m", "annotations")
    return png_bytes(figure)


def noise_figure(noise: Mapping[str, Sequence[float]]) -> bytes:
    """Draw histograms of the noise in a data set's epochs, as PNG.

    noise: standard deviation of each epoch outside the blocks, m, by sensor and noise level.
    """
    figure, axes = _axes()
    values = {name: 1e3 * np.asarray(each) for name, each in noise.items()}
    high = max((float(each.max()) for each in values.values() if each.size), default=1.0)
    edges = np.linspace(0, 1.05 * high, _BINS + 1)
    for number, (name, each) in enumerate(values.items()):
        style = _STYLES[number // len(FAMILY) % len(_STYLES)]
        colour = FAMILY[number % len(FAMILY)]
        axes.stairs(np.histogram(each, edges)[0], edges, linewidth=1.5, linestyle=style, color=colour, label=name)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    _dress(axes, "StD of the difference map outside the blocks, mm", "epochs")
    return png_bytes(figure)


def samples_figure(rows: Sequence[Sequence[SampleTile]]) -> bytes:
    """Draw sample tiles of a data set in rows, with the outlines of their annotated blocks, as PNG.

    The colours end at +-6 times the noise of a tile's epoch.
    """
    columns = max(len(row) for row in rows)
    figure = Figure(figsize=(3.1 * columns, 3.3 * len(rows)), dpi=_DPI, layout="constrained")
    grid = np.atleast_2d(figure.subplots(len(rows), columns, squeeze=False))
    for line, row in zip(grid, rows, strict=True):
        for axes in line:
            axes.set_axis_off()
        for axes, sample in zip(line, row, strict=False):
            limit = SCALE_SIGMAS * max(sample.sigma_m, 1e-4)
            shown = np.ma.masked_invalid(sample.values)
            colours = colormaps["RdBu_r"].with_extremes(bad=NO_DATA)
            axes.imshow(shown, cmap=colours, vmin=-limit, vmax=limit, interpolation="nearest")
            if sample.blocks.any() and not sample.blocks.all():
                axes.contour(sample.blocks, levels=[0.5], colors="black", linewidths=0.5)
            axes.set_title(f"{sample.title}\n±{1e3 * limit:.0f} mm", fontsize=8)
    return png_bytes(figure)


def _axes() -> tuple[Figure, Axes]:
    """Return a figure with one panel."""
    figure = Figure(figsize=(7.5, 3.6), dpi=_DPI, layout="constrained")
    return figure, figure.subplots()


def _dress(axes: Axes, x_label: str, y_label: str) -> None:
    """Label the axes and add the legend."""
    axes.set_xlabel(x_label, fontsize=9)
    axes.set_ylabel(y_label, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.set_ylim(bottom=0)
    if axes.get_legend_handles_labels()[0]:  # an empty set has none
        axes.legend(fontsize=8, frameon=False)
