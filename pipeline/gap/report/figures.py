"""Figures of a diagnosis as PNG: maps and profiles before and after, the gap as a bar, the identifiability matrix."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from pipeline.change.robust import nmad
from pipeline.gap.naming.gap_score import Gap
from pipeline.gap.naming.workflow import GapDiagnosis
from pipeline.gap.report.covariate_ranking import inliers, quantile_bins
from pipeline.gap.report.wording import covariate_with_unit
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals, predicted_sigma
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from pipeline.report.figures import COLOURS, label_map_axes
from pipeline.report.pictures import png
from pipeline.report.plain_text import power_of_ten
from scene.geometry.mesh import FloatArray
from sensors.models.sensor_model import StereoModel, TlsModel

_BINS = 24
_POINTS_PER_PIXEL = 8.0
_BEFORE, _AFTER, _NAMED = "#D55E00", "#0072B2", "black"
_DEPTH_LABEL = "surface deeper than predicted, mm; missing rock positive"
_MOST_NMAD = 6.0
"""Times the NMAD of a map's values beyond which they do not influence its colours."""
_PLATE = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
_COLUMNS = 3
_LOGARITHMIC = ("edge_step",)
"""Covariates with a logarithmic axis: most of their values are near zero, the rest are spread over decades."""
_MOST_PIXELS = 400
"""Most pixels of a map in each direction, for points in a narrow strip."""
_MANY_DECADES = 300.0
"""Ratio of the ends of a logarithmic axis from which on it has one number per decade, else two."""


def maps_figure(found: GapDiagnosis) -> bytes:
    """Draw four maps of the wall for the report, as PNG, that show where the named effects improve the sensor model.

    The upper two show the mean residual, the lower two the standard deviation over the predicted one. The left ones are without
    the named effects, the right ones with them. A pixel of a map has about eight points.
    """
    unit, pixels = 1e3 * found.residuals.depth_m, _PixelGrid(found)
    left, right, low, high = pixels.extent
    figure = Figure(figsize=(11.5, float(np.clip(10.0 * (high - low) / (right - left), 4.0, 12.0)) + 2.2), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    means = [pixels.mean(values * unit) for values in (found.before, found.after)]
    limit = _colour_limit(means[0])
    sigmas = found.residuals.sigma, sigma_after(found)
    ratios = [
        pixels.standard_deviation(values / sigma) for values, sigma in zip((found.before, found.after), sigmas, strict=True)
    ]
    rows: tuple[tuple[list[FloatArray], str, str, dict[str, Any]], ...] = (
        (means, "mean residual", _DEPTH_LABEL, {"cmap": COLOURS, "vmin": -limit, "vmax": limit}),
        (ratios, "standard deviation over the predicted one", "1: as predicted", {"cmap": "PuOr_r", "vmin": 0.4, "vmax": 1.6}),
    )
    for row, (maps, what, label, colours) in zip(panels, rows, strict=True):
        for panel, values, title in zip(row, maps, ("before", "after"), strict=True):
            image = panel.imshow(values, extent=pixels.extent, origin="lower", **colours)
            panel.set_title(f"{what}, {title}", fontsize=10)
        # below the maps, the label has room even if they are low
        figure.colorbar(image, ax=row, label=label, extend="both", location="bottom", shrink=0.6, aspect=45)
    for panel in panels.ravel():
        panel.set_facecolor("0.85")
        panel.set_anchor("N")  # if centred, the title of a low map could lie outside of the figure
        label_map_axes(panel, pixels.extent[0], pixels.extent[2])
        panel.label_outer()
        for change in found.changes:
            corner, opposite = change.bounds[:, :2]
            panel.add_patch(Rectangle(tuple(corner), *(opposite - corner), fill=False, edgecolor="black", linewidth=1.0))
    return png(figure)


def _colour_limit(means: FloatArray) -> float:
    """End of a map's colours: the 98 % quantile of its values, or less where a few are far larger than all others."""
    known = np.abs(means[np.isfinite(means)])
    usual = _MOST_NMAD * nmad(known, 0.0) if known.size else 0.0
    top = float(np.quantile(known, 0.98)) if known.size else 0.0
    return (min(top, usual) if usual > 0 else top) or 1.0


def sigma_after(found: GapDiagnosis) -> FloatArray:
    """Return the standard deviation of each point's noise that the sensor model with the named effects predicts.

    They are (n,) in the unit of the observable (m or px). Raises TypeError if model and residuals are of different sensors.
    """
    match found.model_after, found.residuals:
        case TlsModel() as model, TlsResiduals(geometry=rays) as ranges:
            return np.asarray(np.sqrt(model.variance(rays) + ranges.reference_variance))
        case StereoModel() as model, SurfaceResiduals(geometry=places):
            return predicted_sigma(model, places)
        case StereoModel() as model, residuals:
            return np.asarray(np.sqrt(np.broadcast_to(model.variance, len(residuals))))
    raise TypeError("model and residuals are of different sensors")


def profiles_figure(found: GapDiagnosis) -> bytes:
    """Draw mean and standard deviation of the residuals against each covariate (such as range) for the report, as PNG.

    Two colours show the residuals without and with the named effects, with bands of two standard errors. A black line shows
    what the effects explain, and dashed lines the predicted standard deviation.
    """
    used = inliers(found)
    names = list(found.residuals.covariates) if used.any() else []
    rows = max((len(names) + _COLUMNS - 1) // _COLUMNS, 1)
    figure = Figure(figsize=(11.5, 4.0 * rows))
    panels = np.atleast_2d(figure.subplots(2 * rows, _COLUMNS, height_ratios=[1.4, 1.0] * rows))
    # fixed margins in inches: a computed layout takes as long as the drawing
    figure.subplots_adjust(0.055, 0.3 / (4.0 * rows), 0.99, 1 - 0.3 / (4.0 * rows), wspace=0.22, hspace=0.33)
    unit = 1e3 * found.residuals.depth_m[used]
    before, after = found.before[used] * unit, found.after[used] * unit
    predicted = found.residuals.sigma[used] * np.abs(unit), sigma_after(found)[used] * np.abs(unit)
    for number, name in enumerate(names):
        row, column = divmod(number, _COLUMNS)
        upper, lower = panels[2 * row, column], panels[2 * row + 1, column]
        x = found.residuals.covariates[name][used]
        edges, group = quantile_bins(x, _BINS)
        if len(edges) < 3:
            continue
        middle = (edges[1:] + edges[:-1]) / 2
        for values, colour, label in ((before, _BEFORE, "before"), (after, _AFTER, "after")):
            _draw_bands(upper, lower, middle, group, values, color=colour, label=label)
        if found.effects:
            upper.plot(middle, _means(group, before - after, len(middle)), color=_NAMED, linewidth=1.4, label="named effects")
        for sigma, colour in zip(predicted, (_BEFORE, _AFTER), strict=True):
            lower.plot(middle, np.sqrt(_means(group, sigma**2, len(middle))), color=colour, linestyle="--", linewidth=1.0)
        upper.axhline(0.0, color="0.7", linewidth=0.6, zorder=0)
        upper.set_title(covariate_with_unit(name, found.residuals.sensor), fontsize=9)
        upper.set_ylabel("mean depth, mm", fontsize=8)
        lower.set_ylabel("standard deviation, mm", fontsize=8)
        for panel in (upper, lower):
            panel.tick_params(labelsize=7)
            if name in _LOGARITHMIC:
                _log_axis(panel)
        if number == 0:
            upper.legend(fontsize=7)
    for panel in panels.ravel():
        if not panel.has_data():
            panel.set_visible(False)
    return png(figure)


def _log_axis(panel: Axes) -> None:
    """Use a logarithmic x axis with few and plain numbers."""
    panel.set_xscale("log")
    low, high = panel.get_xlim()
    panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0) if high < _MANY_DECADES * low else (1.0,)))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: power_of_ten(value)))
    panel.xaxis.set_minor_formatter(NullFormatter())


def gap_figure(gap: Gap) -> bytes:
    """Draw how much of the gap between model and measurement the named effects close, as one bar, as PNG.

    The gap is measured by a score on validation points. Three of its values are marked: floor (what noise alone leaves), after
    (with the named effects) and before (without them).
    """
    factor, unit = gap.display_unit
    floor, after, before = (factor * value for value in (gap.floor, gap.after, gap.before))
    figure = Figure(figsize=(9.0, 2.0), layout="constrained")
    panel = figure.add_subplot()
    panel.barh(0, before - after, left=after, color="#56B4E9", height=0.5, label="closed")
    panel.barh(0, max(after - floor, 0.0), left=floor, color=_BEFORE, height=0.5, label="left")
    errors = {"before": factor * gap.error, "after": factor * gap.floor_error}
    for name, value, level in (("floor", floor, -0.4), ("after", after, 0.4), ("before", before, 0.72)):  # a row for each
        panel.plot([value, value], [min(level, -0.33), max(level, 0.33)], color="black", linewidth=1.2)
        place: dict[str, Any] = {"ha": "center", "va": "bottom" if level > 0 else "top"}
        panel.text(value, level, f"{name} {value:.3f}", fontsize=8, bbox=_PLATE, **place)
        if name in errors:
            panel.errorbar(value, 0, xerr=2 * errors[name], color="black", linewidth=0.8, capsize=3)
    scores, whisker = (floor, after, before), 2 * max(errors.values())
    room = whisker + 0.25 * max(np.ptp(scores), whisker, 1e-6)
    panel.set_xlim(min(scores) - room, max(scores) + room)
    panel.set_ylim(-0.75, 1.1)
    panel.set_yticks([])
    what = f"score on validation points, {unit} (whiskers: two standard errors of the differences)"
    panel.set_xlabel(what, fontsize=8)
    panel.tick_params(labelsize=8)
    return png(figure)


def matrix_figure(names: list[str], cosines: FloatArray, survival: FloatArray) -> bytes:
    """Draw which sensor errors a measurement can tell apart, as PNG: a matrix of their similarities, and a bar for each error.

    A signature is the pattern of residuals that an error makes. A bar shows how much of it is left after the sensor's pose is
    fitted.

    Parameters
    ----------
    names : names of m sensor errors.
    cosines : (m, m) absolute cosines between the signatures after the pose fit; 1: indistinguishable.
    survival : (m,) share of each signature that is left after the pose fit, from 0 to 1.
    """
    short, count = [name.partition(".")[2] for name in names], len(names)
    figure = Figure(figsize=(2.8 + 0.62 * count, 1.9 + 0.44 * count), layout="constrained")
    matrix, bars = figure.subplots(1, 2, width_ratios=[count, 3.0], sharey=True)
    image = matrix.imshow(cosines, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for row, column in zip(*np.nonzero((cosines >= 0.3) & ~np.eye(count, dtype=bool)), strict=True):
        value = cosines[row, column]
        colour = "white" if value > 0.6 else "black"
        matrix.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=7, color=colour)
    matrix.set_xticks(range(count), short, rotation=60, ha="right", fontsize=8)
    matrix.set_yticks(range(count), short, fontsize=8)
    matrix.set_title("cosine of the signatures after the pose fit", fontsize=9)
    figure.colorbar(image, ax=matrix, shrink=0.7)
    bars.barh(range(count), 100 * survival, color=_AFTER)
    bars.set_title("left by the pose fit, %", fontsize=9)
    bars.set_xlim(0, 100)
    bars.tick_params(labelsize=8)
    return png(figure)


class _PixelGrid:
    """Square pixels over the smooth points, with about eight points in each."""

    def __init__(self, found: GapDiagnosis) -> None:
        residuals = found.residuals
        self._kept = residuals.usable if residuals.usable.any() else ~residuals.usable
        at = residuals.wall_xy[self._kept]
        low, extent = at.min(axis=0), np.ptp(at, axis=0)
        side = max(float(np.sqrt(np.prod(extent) * _POINTS_PER_PIXEL / len(at))), float(extent.max()) / _MOST_PIXELS) or 1.0
        columns, rows = (int(size / side) + 1 for size in extent)
        column, row = (np.floor((at[:, axis] - low[axis]) / side).astype(np.int64) for axis in (0, 1))
        self._shape, self._pixel = (rows, columns), row * columns + column
        self._count = np.bincount(self._pixel, minlength=rows * columns)
        self.extent = (float(low[0]), float(low[0] + columns * side), float(low[1]), float(low[1] + rows * side))

    def mean(self, values: FloatArray) -> FloatArray:
        """(rows, columns) mean of (n,) values, NaN without points."""
        total = np.bincount(self._pixel, values[self._kept], len(self._count))
        return np.where(self._count > 0, total / np.maximum(self._count, 1), np.nan).reshape(self._shape)

    def standard_deviation(self, values: FloatArray) -> FloatArray:
        """(rows, columns) standard deviation about the pixel's mean, unbiased, NaN for fewer than three points."""
        mean = self.mean(values).ravel()
        square = np.bincount(self._pixel, (values[self._kept] - mean[self._pixel]) ** 2, len(self._count))
        found = np.sqrt(square / np.maximum(self._count - 1, 1))
        return np.where(self._count > 2, found, np.nan).reshape(self._shape)


def _means(group: Any, values: FloatArray, size: int) -> FloatArray:
    """Mean of the values of each group."""
    return np.asarray(np.bincount(group, values, size) / np.maximum(np.bincount(group, minlength=size), 1))


def _draw_bands(upper: Axes, lower: Axes, middle: FloatArray, group: Any, values: FloatArray, *, color: str, label: str) -> None:
    """Draw mean (upper panel) and standard deviation (lower panel) of each bin, with bands of two standard errors."""
    count = np.maximum(np.bincount(group, minlength=len(middle)), 1)
    mean = _means(group, values, len(middle))
    variance = np.maximum(_means(group, values**2, len(middle)) - mean**2, 0)
    spread = np.sqrt(variance)
    for panel, line, error in ((upper, mean, np.sqrt(variance / count)), (lower, spread, spread / np.sqrt(2 * count))):
        panel.plot(middle, line, color=color, linewidth=1.0, label=label)
        panel.fill_between(middle, line - 2 * error, line + 2 * error, color=color, alpha=0.25, linewidth=0)
