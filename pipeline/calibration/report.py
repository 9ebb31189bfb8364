"""A calibration's report: the fitted noise, the measured epochs, and measured beside simulated maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure
from scipy import stats

from pipeline.calibration.calibrate import Baseline, CalibrationResult
from pipeline.calibration.parameters import ORIENTATION
from pipeline.change.difference import statistics
from pipeline.formats.files.atomic import write_text
from pipeline.report.figures import DIFFERENCE_LABEL, DPI, FAMILY, difference_figure, label_axes, plain_numbers, png_bytes
from pipeline.report.page import p_value_in_words, percent, template, with_minus_sign
from pipeline.report.plain_text import powers_of_ten
from scene.geometry.mesh import FloatArray

Pictures = Sequence[tuple[str, str, bytes]]
"""Name of the file, caption, PNG."""
_MEASURED, _SIMULATED = FAMILY[:2]
_COLOURS = "Red: rock is missing; blue: the surface stands further out; grey: no data; axes in m, wall frame."
_SIGMAS = 3.0
_READ_IN = {"m": (" mm", 1e3), "rad": (" \N{MICRO SIGN}rad", 1e6), "px": (" px", 1.0), "ppm": (" ppm", 1.0)}
"""Unit and factor by the suffix of a parameter's name."""
_LEAST_P = 0.01
"""At or below which the model is said not to make such maps."""
_INSTRUMENTS = {"stereo": "stereo pair", "tls": "laser scanner"}


@dataclass(frozen=True)
class _Table:
    caption: str
    head: list[str]
    rows: list[list[str]]


def summary(result: CalibrationResult) -> str:
    """The result in a few lines of text."""
    found = result.found
    lines = [f"{_maps(len(result.epochs))} of a {_INSTRUMENTS[result.sensor]}"]
    lines += [f"  {name:<26}{text}" for name, text in _values(result)]
    lines += [f"  {warning}" for warning in warnings(result)]
    lines.append(f"  {found.maps:,} simulated maps, {result.rate:.1f} observations a second, {result.seconds:.0f} s in all")
    return "\n".join(lines)


def warnings(result: CalibrationResult) -> list[str]:
    """What a reader has to know before using the values."""
    found, error = result.found, result.material.reference_error
    texts = []
    if error is not None:
        texts.append(
            f"The reference is made of points that are off by {1e3 * error.sigma_m:.3g} mm each: that is simulated beside the "
            "instrument's noise, and a wrong value goes into the range noise."
        )
    texts += [
        f"{first} and {second} cannot be told apart by these maps (correlation {value:+.2f}): only their combination is known."
        for first, second, value in result.inseparable()
    ]
    if found.misfit_p < _LEAST_P:
        worst = np.argsort(-np.abs(found.misfit))[:3]
        names = ", ".join(f"{result.statistics[place]} ({found.misfit[place]:+.1f} sigma)" for place in worst)
        texts.append(
            f"The model cannot make such maps (p = {found.misfit_p:.3f}, below {_LEAST_P:g}); farthest off: {names}. "
            "`scarpsim gap` may say why."
        )
    if not found.settled:
        texts.append("The search did not settle: the values lie beyond the last simulations. Raise calibration.simulations.")
    low, high = np.log(result.parameters.low), np.log(result.parameters.high)
    for place, name in enumerate(result.parameters.names):
        if found.low[place] <= low[place] + 1e-6 or found.high[place] >= high[place] - 1e-6:
            texts.append(f"{name} is not bounded by these maps: its interval ends where the search does.")
    return texts


def scale_m(result: CalibrationResult) -> float:
    """NMAD of the last measured map in the windows, m: the scale of all maps."""
    return max(statistics(result.windows.cut(result.material.maps[-1])).nmad, 1e-6)


def pictures(result: CalibrationResult, simulated: FloatArray | None) -> Pictures:
    """All pictures. simulated: (h, w) a map of the whole wall, m, where there is one."""
    material, sigma = result.material, scale_m(result)
    none = np.zeros(material.grid.shape, dtype=np.int32)
    shown: list[tuple[str, str, bytes]] = [
        ("windows", "The last measured map and a simulated one in the windows that are compared, on one scale; white: no data.",
         _mosaics(result, sigma)),
        ("measured", f"Measured: {material.names[-1]}, the whole map. {_COLOURS}",
         difference_figure(material.maps[-1], material.grid, none, sigma, "Measured")),
    ]  # fmt: skip
    if simulated is not None:
        caption = "Simulated with the calibrated noise by the whole simulation, on the same scale; no block falls in it."
        shown.append(("simulated", caption, difference_figure(simulated, material.grid, none, sigma, "Simulated")))
    mean = difference_figure(result.systematic, material.grid, none, sigma, "Mean over the epochs")
    shown.append(
        (
            "systematic",
            "The systematic part: the mean of the measured maps over stable ground. It holds the reference's own errors.",
            mean,
        )
    )
    further = (
        (
            "distribution",
            "Left: distribution of the differences in the windows. Right: their variogram, how much two pixels at a "
            "distance differ.",
            _size_and_variogram,
        ),
        (
            "statistics",
            "All that is compared, measured (dots) over expected: size of the noise, variogram by distance, bending of the whole "
            "wall, noise at edges and elsewhere, and by angle of incidence. Bars: two standard deviations of a simulated set.",
            _statistics,
        ),
        ("epochs", "Median and standard deviation over the epochs; the line is their mean.", _over_time),
    )
    shown += [(name, caption, picture(result)) for name, caption, picture in further]
    return shown


def write_calibration_report(path: Path, result: CalibrationResult, shown: Pictures, config: Mapping[str, Any]) -> None:
    """Write report.html, whole or not at all."""
    page = template("calibration/report.html.jinja").render(
        title=f"Noise of a {_INSTRUMENTS[result.sensor]}, calibrated",
        answer=_answer(result),
        summary=_sentence(result),
        warnings=warnings(result),
        tables=_tables(result),
        pictures=shown,
        config=yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True),
    )
    write_text(path, page)


def _maps(count: int) -> str:
    return f"{count} difference map{'' if count == 1 else 's'}"


def _answer(result: CalibrationResult) -> str:
    """The fitted values, for a reader who wants nothing else."""
    values = [f"{result.parameters.meaning(name)}: {text}" for name, text in _values(result)]
    text = "; ".join(values)
    return f"{text[0].upper()}{text[1:]}; intervals of {percent(result.confidence, 0)}."


def _sentence(result: CalibrationResult) -> str:
    deviations = [each.size.standard_deviation * 1e3 for each in result.epochs]
    ground = "drawn by the user" if result.material.drawn else "found by the program"
    return (
        f"{_maps(len(deviations))}, standard deviation {np.mean(deviations):.1f} mm on average over stable ground "
        f"{ground} ({percent(float(np.mean(result.material.stable)), 0)} of the map). Noise that gives the like was sought with "
        f"{result.found.maps:,} simulated maps in {result.seconds:.0f} s."
    )


def _values(result: CalibrationResult) -> list[tuple[str, str]]:
    found = result.found
    columns = (np.exp(each) for each in (found.x, found.low, found.high))
    return [
        (name, _with_interval(name, value, low, high))
        for name, value, low, high in zip(result.parameters.names, *columns, strict=True)
    ]


def _with_interval(name: str, value: float, low: float, high: float) -> str:
    """A parameter in the unit that people read it in; of the orientation the factor to the config's sigmas."""
    unit, factor = _READ_IN.get(name.rpartition("_")[2], (" times the config's" if name == ORIENTATION else "", 1.0))
    return f"{factor * value:.4g}{unit}  ({factor * low:.4g} to {factor * high:.4g})"


def _tables(result: CalibrationResult) -> list[_Table]:
    names = list(result.parameters.names)
    share = percent(result.confidence, 0)
    fitted = [[result.parameters.meaning(name), name, text] for name, text in _values(result)]
    tables = [
        _Table(f"Fitted values with intervals of {share}.", ["noise", "key", "value"], fitted),
        _Table(
            "Correlations of the errors of the estimate: near 1 in magnitude, only a combination is known.",
            ["", *names],
            _matrix(names, result.found.correlation),
        ),
        _epochs(result),
    ]
    if result.patterns is not None:
        caption = (
            "Orientation: RMS of the map of one sigma in the left camera, mm, and cosines between the maps of two parameters "
            "after registration: beyond 0.9 two parameters make the same pattern."
        )
        rows = _matrix(list(result.patterns.names), result.patterns.cosines)
        sized = [[row[0], f"{1e3 * size:.2f}", *row[1:]] for row, size in zip(rows, result.patterns.size_m, strict=True)]
        tables.append(_Table(caption, ["", "mm", *result.patterns.names], sized))
    if result.baseline is not None:
        tables.append(_greedy(result, result.baseline))
    return tables


def _greedy(result: CalibrationResult, baseline: Baseline) -> _Table:
    rows = [["one parameter at a time, by StD", str(baseline.result.tests), f"{baseline.cost:.0f}"]]
    rows += [
        [f"this search, after round {number}", str(maps), f"{cost:.0f}"] for number, (maps, cost) in enumerate(baseline.costs, 1)
    ]
    caption = f"Two searches: cost of fresh simulations ({len(result.statistics)} statistics: that many is a perfect fit)."
    if baseline.overtaken is not None:
        caption += f" This search was nearer than the other's end after {_maps(baseline.overtaken)}."
    return _Table(caption, ["search", "simulated maps", "cost"], rows)


def _matrix(names: list[str], values: FloatArray) -> list[list[str]]:
    return [[name, *(_signed(value) for value in row)] for name, row in zip(names, values, strict=True)]


def _signed(value: float) -> str:
    return ("+" if value >= 0 else "") + with_minus_sign(value, 2)


def _epochs(result: CalibrationResult) -> _Table:
    rows = []
    for each in result.epochs:
        p = each.normality.p_value
        size, tail = each.size, each.tails
        lengths = (size.median, size.standard_deviation, size.rmse, size.nmad)
        rows.append(
            [each.name, *(with_minus_sign(1e3 * value, 1) for value in lengths), with_minus_sign(tail.skewness, 2),
             with_minus_sign(tail.excess_kurtosis, 1),
             p_value_in_words(p), f"{each.independent:,.0f}", each.model.summary()]
        )  # fmt: skip
    sizes = [each.size for each in result.epochs]
    mean = (np.mean([getattr(one, name) for one in sizes]) for name in ("median", "standard_deviation", "rmse", "nmad"))
    rows.append(["mean", *(with_minus_sign(1e3 * value, 1) for value in mean), *[""] * 5])
    trends = [
        f"{name} {_signed(1e3 * found.per_epoch_m)} mm per epoch (p: {p_value_in_words(found.p_value)})"
        for name, found in (("median", result.median_trend), ("StD", result.std_trend))
        if found.per_epoch_m is not None and found.p_value is not None
    ]
    caption = "The measured epochs over stable ground, mm; p: of a test for a normal distribution, of independent values alone. "
    caption += "Trend: " + ("; ".join(trends) if trends else "needs four epochs") + "."
    head = ["epoch", "median", "StD", "RMSE", "NMAD", "skewness", "excess kurtosis", "normal, p", "independent", "variogram"]
    return _Table(caption, head, rows)


def _mosaics(result: CalibrationResult, sigma: float) -> bytes:
    measured = result.windows.cut(result.material.maps[-1])
    figure = Figure(figsize=(11.0, 5.6), dpi=DPI, layout="constrained")
    for axes, windows, title in zip(figure.subplots(1, 2), (measured, result.predicted), ("Measured", "Simulated"), strict=True):
        image = axes.imshow(1e3 * _mosaic(windows), cmap="RdBu_r", vmin=-1e3 * _SIGMAS * sigma, vmax=1e3 * _SIGMAS * sigma)
        axes.set_title(title, fontsize=11)
        axes.set_axis_off()
    bar = figure.colorbar(image, ax=figure.axes, shrink=0.7, extend="both")
    bar.ax.tick_params(labelsize=8)
    bar.set_label(DIFFERENCE_LABEL, fontsize=9)
    return png_bytes(figure)


def _mosaic(windows: FloatArray) -> FloatArray:
    """(k, n, n) windows as one picture with gaps, as square as may be."""
    count, side = len(windows), windows.shape[1]
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    picture = np.full((rows * (side + 2), columns * (side + 2)), np.nan)
    for number, window in enumerate(windows):
        row, column = divmod(number, columns)
        picture[row * (side + 2) : row * (side + 2) + side, column * (side + 2) : column * (side + 2) + side] = window
    return picture


def _size_and_variogram(result: CalibrationResult) -> bytes:
    figure = Figure(figsize=(11.0, 4.2), dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2)
    measured = np.concatenate([result.windows.cut(values).ravel() for values in result.material.maps])
    sigma = 1e3 * statistics(measured).nmad
    edges = np.linspace(-6 * sigma, 6 * sigma, 121)
    for values, name, colour in ((measured, "measured", _MEASURED), (result.predicted, "simulated", _SIMULATED)):
        known = 1e3 * values[~np.isnan(values)]
        density, _ = np.histogram(known - np.median(known), edges, density=True)
        left.stairs(density, edges, color=colour, label=name)
    left.plot(edges, stats.norm.pdf(edges, 0, sigma), color="0.5", linestyle="--", linewidth=1, label="normal of the same NMAD")
    left.set_yscale("log")
    powers_of_ten(left.yaxis)
    left.set_ylim(1e-5 / sigma)
    label_axes(left, "difference less its median, mm", "density, 1/mm")
    left.legend(frameon=False, fontsize=9)
    lags = [name for name in result.statistics if name.startswith("variogram.")]
    place = [result.statistics.index(name) for name in lags]
    distance = np.array([int(name.removeprefix("variogram.").removesuffix("px")) for name in lags]) * result.windows.grid.gsd
    expected, scatter = result.found.surface.mean(result.found.x), np.sqrt(np.diag(result.found.surface.covariance))
    right.fill_between(
        distance,
        *(1e3 * np.exp((expected + side * scatter)[place]) for side in (-2, 2)),
        color=_SIMULATED,
        alpha=0.25,
        linewidth=0,
    )
    right.plot(distance, 1e3 * np.exp(expected[place]), color=_SIMULATED, label="simulated, with two standard deviations")
    right.plot(distance, 1e3 * np.exp(result.observed[place]), "o", color=_MEASURED, markersize=4, label="measured")
    right.set_xscale("log")
    plain_numbers(right.xaxis)
    right.set_ylim(0)
    label_axes(right, "distance, m", "root of the semivariance, mm")
    right.legend(frameon=False, fontsize=9)
    return png_bytes(figure)


def _statistics(result: CalibrationResult) -> bytes:
    expected, scatter = result.found.surface.mean(result.found.x), np.sqrt(np.diag(result.found.surface.covariance))
    place = np.arange(len(expected))[::-1]
    figure = Figure(figsize=(11.0, 0.2 * len(expected) + 1.0), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    axes.barh(place, 2 * (np.exp(2 * scatter) - 1), left=1 - (np.exp(2 * scatter) - 1), color=_SIMULATED, alpha=0.25, height=0.8)
    axes.plot(np.exp(result.observed - expected), place, "o", color=_MEASURED, markersize=4)
    axes.axvline(1, color="0.3", linewidth=0.8)
    label_axes(axes, "measured over expected", "")
    axes.set_yticks(place, [_in_words(name) for name in result.statistics], fontsize=8)
    return png_bytes(figure)


def _in_words(statistic: str) -> str:
    """The name of a statistic (pipeline/calibration/signature.py) as a reader understands it."""
    group, name = statistic.split(".")
    if group == "variogram":
        return f"variogram at {name.removesuffix('px')} px"
    return f"{group}: {name.replace('_', ' ').replace('std', 'StD').replace('nmad', 'NMAD')}"


def _over_time(result: CalibrationResult) -> bytes:
    figure = Figure(figsize=(11.0, 3.2), dpi=DPI, layout="constrained")
    for axes, name, label in zip(
        figure.subplots(1, 2), ("median", "standard_deviation"), ("median, mm", "standard deviation, mm"), strict=True
    ):
        values = [1e3 * getattr(each.size, name) for each in result.epochs]
        axes.bar(np.arange(len(values)), values, color=_MEASURED)
        axes.axhline(float(np.mean(values)), color=_SIMULATED)
        axes.axhline(0, color="0.3", linewidth=0.8)
        label_axes(axes, "", label)
        axes.set_xticks(np.arange(len(values)), [each.name for each in result.epochs], rotation=45, ha="right", fontsize=8)
    return png_bytes(figure)
