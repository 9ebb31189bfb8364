"""Draw the curves and histograms of reports: detection probabilities, changes, convergence of the registration; as PNG bytes.

Equal arguments give equal bytes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from pipeline.change.difference import DifferenceStatistics, statistics
from pipeline.report.figures import (
    DIFFERENCE_LABEL,
    DPI,
    FAMILY,
    PICTURE_WIDTH_IN,
    SCALE_SIGMAS,
    label_axes,
    plain_numbers,
    png_bytes,
    signed,
)
from pipeline.report.plain_text import powers_of_ten

_OUTSIDE, _INSIDE = "#0072B2", "#D55E00"
_BINS = 120


class Iteration(Protocol):
    """Describe an iteration of ICP (iterative closest point) for `convergence_figure`: any object with these attributes.

    Attributes
    ----------
    rms_m : float
        RMS of the inliers' residuals, m.
    inliers, points : int
        Number of points within the outlier threshold, and of all points.
    """

    @property
    def rms_m(self) -> float:
        """RMS of the inliers' residuals in this iteration of the registration (ICP), m."""
        ...

    @property
    def inliers(self) -> int:
        """Number of moving points within the outlier threshold in this iteration of the registration (ICP)."""
        ...

    @property
    def points(self) -> int:
        """Number of moving points, inliers and outliers, in this iteration of the registration (ICP)."""
        ...


@dataclass(frozen=True)
class CurvePanel:
    """Describe one panel of `curves_figure`: curves of a probability or share, 0 to 1, against one quantity.

    Attributes
    ----------
    label : str
        The quantity on the x axis, with its unit.
    x : (k,) array
        Values of the quantity.
    at : float
        Value of the quantity in the present set-up, where a dashed line is drawn.
    curves : mapping of str to (k,) array
        Name of each curve, and its values at x, 0 to 1.
    logarithmic : bool
        Whether the x axis is logarithmic.
    """

    label: str
    x: NDArray[np.floating]
    at: float
    curves: Mapping[str, NDArray[np.floating]]
    logarithmic: bool = False


def curves_figure(panels: Sequence[CurvePanel], y_label: str, title: str = "") -> bytes:
    """Draw curves in panels side by side, such as detection probabilities against range, as PNG.

    A dashed line marks the value of the present set-up in each panel.

    Parameters
    ----------
    panels : sequence of CurvePanel
        The panels, which share the y axis and the names of the curves.
    y_label : str
        Label of the y axis, which is in per cent.
    title : str
        Title of the picture.
    """
    figure = Figure(figsize=(PICTURE_WIDTH_IN, 4.0), dpi=DPI, layout="constrained")
    figure.suptitle(title, fontsize=11)
    row = np.atleast_1d(figure.subplots(1, len(panels), sharey=True))
    for axes, panel in zip(row, panels, strict=True):
        for colour, (name, values) in zip(FAMILY * len(panel.curves), panel.curves.items(), strict=False):
            axes.plot(panel.x, 100 * np.asarray(values), color=colour, linewidth=1.5, label=name)
        axes.axvline(panel.at, color="0.3", linewidth=0.8, linestyle="--", label="this set-up")
        if panel.logarithmic:
            axes.set_xscale("log")
            plain_numbers(axes.xaxis)
        axes.set_ylim(-2, 102)
        label_axes(axes, panel.label, y_label)
        axes.label_outer()
        axes.grid(color="0.9", linewidth=0.6)
    figure.legend(*row[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=9, frameon=False)
    return png_bytes(figure)


def histogram_figure(outside: NDArray[np.floating], inside: NDArray[np.floating], title: str = "") -> bytes:
    """Draw histograms of a map of changes, for pixels outside and inside the blocks that fell, as PNG.

    The left panel shows the noise on a linear scale, the right panel all values on a logarithmic one.

    Parameters
    ----------
    outside, inside : (n,) and (m,) arrays
        Reference minus epoch, m, of the pixels outside and inside blocks; NaN is ignored.
    title : str
        Title of the picture.
    """
    groups = [("outside the blocks", outside, _OUTSIDE), ("inside the blocks", inside, _INSIDE)]
    samples = [(name, values[~np.isnan(values)] * 1e3, colour) for name, values, colour in groups]
    figure = Figure(figsize=(PICTURE_WIDTH_IN, 4.6), dpi=DPI, layout="constrained")
    figure.suptitle(title, fontsize=11)
    noise, whole = figure.subplots(1, 2)
    _histogram(noise, samples, _noise_range(samples[0][1]))
    noise.set_title("The noise: linear scale", fontsize=10)
    _histogram(whole, samples, _whole_range(samples))
    whole.set_title("Everything: logarithmic scale", fontsize=10)
    whole.set_yscale("symlog", linthresh=1)
    powers_of_ten(whole.yaxis)
    whole.set_ylim(bottom=0)
    handles = [Patch(color=colour, label=f"{name}\n{_in_words(statistics(values))}") for name, values, colour in samples]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return png_bytes(figure)


def convergence_figure(history: Sequence[Iteration], title: str = "") -> bytes:
    """Draw how a registration by ICP (iterative closest point) converged, as PNG.

    Two panels show the RMS of the inliers' residuals, mm, and the share of inliers, %, against the iteration.

    Parameters
    ----------
    history : sequence of Iteration
        The iterations in order.
    title : str
        Title of the picture.
    """
    iteration = np.arange(1, len(history) + 1)
    figure = Figure(figsize=(PICTURE_WIDTH_IN, 3.4), dpi=DPI, layout="constrained")
    figure.suptitle(title, fontsize=11)
    panels = [
        ("RMS of the inliers, mm", [step.rms_m * 1e3 for step in history], _OUTSIDE),
        ("inliers, % of the points", [100 * step.inliers / max(step.points, 1) for step in history], _INSIDE),
    ]
    for axes, (label, values, colour) in zip(figure.subplots(1, 2), panels, strict=True):
        axes.plot(iteration, values, color=colour, marker="o", markersize=3.5, linewidth=1.2)
        axes.xaxis.get_major_locator().set_params(integer=True)
        label_axes(axes, "iteration", label)
        axes.grid(color="0.9", linewidth=0.6)
    return png_bytes(figure)


def _histogram(axes: Axes, samples: Sequence[tuple[str, NDArray[np.floating], str]], limits: tuple[float, float]) -> None:
    edges = np.linspace(*limits, _BINS + 1)
    for _, values, colour in samples:
        counts, _ = np.histogram(values, edges)
        axes.stairs(counts, edges, fill=True, color=colour, alpha=0.35)
        axes.stairs(counts, edges, color=colour, linewidth=1.2)
    axes.axvline(0, color="0.3", linewidth=0.8)
    axes.set_xlim(limits)
    label_axes(axes, DIFFERENCE_LABEL, f"pixels per {edges[1] - edges[0]:.3g} mm")


def _noise_range(values: NDArray[np.floating]) -> tuple[float, float]:
    """Return the median plus and minus SCALE_SIGMAS times the NMAD, mm."""
    found = statistics(values)
    centre, half = (found.median, SCALE_SIGMAS * found.nmad) if found.count else (0.0, 0.0)
    return centre - (half or 1.0), centre + (half or 1.0)


def _whole_range(samples: Sequence[tuple[str, NDArray[np.floating], str]]) -> tuple[float, float]:
    values = [values for _, values, _ in samples if len(values)]
    low = min((float(part.min()) for part in values), default=-1.0)
    high = max((float(part.max()) for part in values), default=1.0)
    margin = 0.02 * (high - low) or 1.0
    return low - margin, high + margin


def _in_words(found: DifferenceStatistics) -> str:
    """Describe the statistics of values in mm."""
    if not found.count:
        return "no data"
    return (
        f"median {signed(found.median, 1)}, StD {found.standard_deviation:.1f}, "
        f"RMSE {found.rmse:.1f}, NMAD {found.nmad:.1f} mm\n{found.count:,} pixels"
    )
