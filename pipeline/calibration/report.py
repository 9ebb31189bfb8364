"""Write the report of a calibration: the fitted noise, the measured epochs, and measured beside simulated maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure
from scipy import stats

from pipeline.calibration.calibrate import CalibrationResult, GreedyComparison
from pipeline.calibration.parameters import ORIENTATION
from pipeline.change.difference import statistics
from pipeline.formats.files.atomic import write_text
from pipeline.report.figures import DIFFERENCE_LABEL, DPI, FAMILY, difference_figure, label_axes, plain_numbers, png_bytes
from pipeline.report.page import p_value_in_words, percent, template, with_minus_sign
from pipeline.report.plain_text import powers_of_ten
from scene.geometry.mesh import FloatArray

Pictures = Sequence[tuple[str, str, bytes]]
"""File name, caption and PNG of each picture."""
_MEASURED, _SIMULATED = FAMILY[:2]
_COLOURS = "Red: rock is missing; blue: the surface stands further out; grey: no data; axes in m, wall frame."
_SIGMAS = 3.0
"""Range of the colour scale, in NMADs of the measured map."""
_READ_IN = {"m": (" mm", 1e3), "rad": (" \N{MICRO SIGN}rad", 1e6), "px": (" px", 1.0), "ppm": (" ppm", 1.0)}
"""Unit and factor for display, by the suffix of a parameter's name."""
_LEAST_P = 0.01
"""Significance level at or below which the report says that the model does not fit."""
_INSTRUMENTS = {"stereo": "stereo pair", "tls": "laser scanner"}


@dataclass(frozen=True)
class _Table:
    caption: str
    head: list[str]
    rows: list[list[str]]


def summary(result: CalibrationResult) -> str:
    """Summarise a calibration for the terminal, line by line: noise parameters with intervals, warnings, and duration."""
    found = result.found
    lines = [f"{_maps(len(result.epochs))} of a {_INSTRUMENTS[result.sensor]}"]
    lines += [f"  {name:<26}{text}" for name, text in _values(result)]
    lines += [f"  {result.single_ranges.words}"] if result.single_ranges is not None else []
    lines += [f"  {warning}" for warning in warnings(result)]
    lines.append(f"  {found.maps:,} simulated maps, {result.rate:.1f} observations a second, {result.seconds:.0f} s in all")
    return "\n".join(lines)


def warnings(result: CalibrationResult) -> list[str]:
    """Return what a user must know before using the fitted noise, as sentences, such as that the model does not fit."""
    found, error = result.found, result.inputs.reference_error
    texts = []
    if error is not None:
        texts.append(
            f"The reference is made of points with a standard deviation of {1e3 * error.sigma_m:.3g} mm. The simulation has "
            "this error too; if the value is wrong, the fitted range noise is biased."
        )
    texts += [
        f"These maps cannot separate {first} from {second} (correlation {value:+.2f}); they determine only a combination."
        for first, second, value in result.inseparable()
    ]
    if found.misfit_p < _LEAST_P:
        worst = np.argsort(-np.abs(found.misfit))[:3]
        names = ", ".join(f"{result.statistics[place]} ({found.misfit[place]:+.1f} sigma)" for place in worst)
        texts.append(
            f"The model does not fit these maps (p = {found.misfit_p:.3f}, below {_LEAST_P:g}); largest misfits: {names}. "
            "`scarpsim gap` may find the reason."
        )
    if not found.converged:
        texts.append(
            "The search did not converge: the values lie outside the last simulations. Increase calibration.simulations."
        )
    low, high = np.log(result.parameters.low), np.log(result.parameters.high)
    for place, name in enumerate(result.parameters.names):
        if found.low[place] <= low[place] + 1e-6 or found.high[place] >= high[place] - 1e-6:
            texts.append(f"These maps do not bound {name}: its interval ends at the limit of the search.")
    return texts


def scale_m(result: CalibrationResult) -> float:
    """Return the size of the noise by which all maps in a calibration's report are coloured, m, so that they can be compared.

    It is the NMAD of the last measured map in the compared windows (square parts).
    """
    return max(statistics(result.windows.cut(result.inputs.maps[-1])).nmad, 1e-6)


def pictures(result: CalibrationResult, simulated: FloatArray | None) -> Pictures:
    """Draw all pictures of the report of a calibration: measured beside simulated maps, distributions, statistics and epochs.

    Parameters
    ----------
    result : The calibration.
    simulated : (h, w) difference map of the whole wall, simulated with the fitted noise, m; None if there is none.

    Returns
    -------
    For each picture its file name without ending, its caption, and the PNG.
    """
    inputs, sigma = result.inputs, scale_m(result)
    none = np.zeros(inputs.grid.shape, dtype=np.int32)
    shown: list[tuple[str, str, bytes]] = [
        ("windows", "The last measured map and a simulated one in the compared windows, on one colour scale; white: no data.",
         _mosaics(result, sigma)),
        ("measured", f"Measured: {inputs.names[-1]}, the whole map. {_COLOURS}",
         difference_figure(inputs.maps[-1], inputs.grid, none, sigma, "Measured")),
    ]  # fmt: skip
    if simulated is not None:
        caption = "Full simulation with the calibrated noise and without rockfall, on the same colour scale."
        shown.append(("simulated", caption, difference_figure(simulated, inputs.grid, none, sigma, "Simulated")))
    mean = difference_figure(result.systematic, inputs.grid, none, sigma, "Mean over the epochs")
    shown.append(
        (
            "systematic",
            "The systematic part: the mean of the measured maps over stable ground. It contains errors of the reference.",
            mean,
        )
    )
    further = (
        (
            "distribution",
            "Left: distribution of the differences in the windows. Right: their variogram, the difference of two pixels by "
            "distance.",
            _size_and_variogram,
        ),
        (
            "statistics",
            "All compared statistics, measured (dots) over expected: size of the noise, variogram by distance, bending of the "
            "wall, noise at edges and elsewhere, and by incidence angle. Bars: two standard deviations of simulated maps.",
            _statistics,
        ),
        ("epochs", "Median and standard deviation of each epoch; the line is their mean.", _over_time),
    )
    shown += [(name, caption, picture(result)) for name, caption, picture in further]
    return shown


def write_calibration_report(path: Path, result: CalibrationResult, shown: Pictures, config: Mapping[str, Any]) -> None:
    """Write the report of a calibration as an HTML page; if that fails, no file is left.

    Parameters
    ----------
    path : File to write.
    result : The calibration.
    shown : Pictures of the page: file name without ending, caption and PNG of each.
    config : The config with all defaults filled in, which the page lists.
    """
    page = template("calibration/report.html.jinja").render(
        title=f"Noise of a {_INSTRUMENTS[result.sensor]}, calibrated",
        answer=_answer(result),
        summary=_sentence(result),
        single_ranges=None if result.single_ranges is None else result.single_ranges.words,
        warnings=warnings(result),
        tables=_tables(result),
        pictures=shown,
        config=yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True),
    )
    write_text(path, page)


def _maps(count: int) -> str:
    return f"{count} difference map{'' if count == 1 else 's'}"


def _answer(result: CalibrationResult) -> str:
    """Return the fitted values with their intervals as one sentence."""
    values = [f"{result.parameters.meaning(name)}: {text}" for name, text in _values(result)]
    text = "; ".join(values)
    return f"{text[0].upper()}{text[1:]}; intervals of {percent(result.confidence, 0)}."


def _sentence(result: CalibrationResult) -> str:
    """Return the sentence on the maps, the size of their noise, and the effort of the search."""
    deviations = [each.size.standard_deviation * 1e3 for each in result.epochs]
    ground = "drawn by the user" if result.inputs.drawn else "found by the program"
    return (
        f"{_maps(len(deviations))}, standard deviation {np.mean(deviations):.1f} mm on average over stable ground "
        f"{ground} ({percent(float(np.mean(result.inputs.stable)), 0)} of the map). The noise parameters were fitted with "
        f"{result.found.maps:,} simulated maps in {result.seconds:.0f} s."
    )


def _values(result: CalibrationResult) -> list[tuple[str, str]]:
    """Return each parameter's name, and its value and interval as text."""
    found = result.found
    columns = (np.exp(each) for each in (found.x, found.low, found.high))
    return [
        (name, _with_interval(name, value, low, high))
        for name, value, low, high in zip(result.parameters.names, *columns, strict=True)
    ]


def _with_interval(name: str, value: float, low: float, high: float) -> str:
    """Format a value and its interval in the unit that people read it in.

    The orientation's value is a factor of the config's sigmas.
    """
    unit, factor = _READ_IN.get(name.rpartition("_")[2], (" times the config's" if name == ORIENTATION else "", 1.0))
    return f"{factor * value:.4g}{unit}  ({factor * low:.4g} to {factor * high:.4g})"


def _tables(result: CalibrationResult) -> list[_Table]:
    names = list(result.parameters.names)
    share = percent(result.confidence, 0)
    fitted = [[result.parameters.meaning(name), name, text] for name, text in _values(result)]
    tables = [
        _Table(f"Fitted values with intervals of {share}.", ["noise", "key", "value"], fitted),
        _Table(
            "Correlations of the estimates' errors: near 1 in magnitude, the maps determine only a combination of the two.",
            ["", *names],
            _matrix(names, result.found.correlation),
        ),
        _epochs(result),
    ]
    if result.patterns is not None:
        caption = (
            "Orientation: RMS of the map of a one-sigma error of the left camera, mm, and cosines between the maps of two "
            "parameters after registration. Beyond 0.9, two parameters make the same pattern."
        )
        rows = _matrix(list(result.patterns.names), result.patterns.cosines)
        sized = [[row[0], f"{1e3 * size:.2f}", *row[1:]] for row, size in zip(rows, result.patterns.size_m, strict=True)]
        tables.append(_Table(caption, ["", "mm", *result.patterns.names], sized))
    if result.baseline is not None:
        tables.append(_greedy(result, result.baseline))
    return tables


def _greedy(result: CalibrationResult, baseline: GreedyComparison) -> _Table:
    """Compare the costs of the greedy search and of this search in a table."""
    rows = [["one parameter at a time, by StD", str(baseline.result.tests), f"{baseline.cost:.0f}"]]
    rows += [
        [f"this search, after round {number}", str(maps), f"{cost:.0f}"] for number, (maps, cost) in enumerate(baseline.costs, 1)
    ]
    caption = f"Two searches: cost from new simulations (a perfect fit has about {len(result.statistics)}, one per statistic)."
    if baseline.overtaken is not None:
        caption += f" This search was nearer than the end of the other after {_maps(baseline.overtaken)}."
    return _Table(caption, ["search", "simulated maps", "cost"], rows)


def _matrix(names: list[str], values: FloatArray) -> list[list[str]]:
    """Return a matrix as table rows with signed numbers, each starting with its name."""
    return [[name, *(_signed(value) for value in row)] for name, row in zip(names, values, strict=True)]


def _signed(value: float) -> str:
    return ("+" if value >= 0 else "") + with_minus_sign(value, 2)


def _epochs(result: CalibrationResult) -> _Table:
    """Describe the noise of each measured epoch, their mean and their trends in a table."""
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
    caption = "The measured epochs over stable ground, mm. p: test for a normal distribution, on independent values only. "
    caption += "Trend: " + ("; ".join(trends) if trends else "needs four epochs") + "."
    head = ["epoch", "median", "StD", "RMSE", "NMAD", "skewness", "excess kurtosis", "normal, p", "independent", "variogram"]
    return _Table(caption, head, rows)


def _mosaics(result: CalibrationResult, sigma: float) -> bytes:
    """Draw the measured and the simulated windows side by side."""
    measured = result.windows.cut(result.inputs.maps[-1])
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
    """Arrange (k, n, n) windows in one nearly square picture with gaps between them."""
    count, side = len(windows), windows.shape[1]
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    picture = np.full((rows * (side + 2), columns * (side + 2)), np.nan)
    for number, window in enumerate(windows):
        row, column = divmod(number, columns)
        picture[row * (side + 2) : row * (side + 2) + side, column * (side + 2) : column * (side + 2) + side] = window
    return picture


def _size_and_variogram(result: CalibrationResult) -> bytes:
    """Draw the distribution of the differences and their variogram, measured and simulated."""
    figure = Figure(figsize=(11.0, 4.2), dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2)
    measured = np.concatenate([result.windows.cut(values).ravel() for values in result.inputs.maps])
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
    """Draw all summary statistics, measured over expected."""
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
    """Return the name of a summary statistic (pipeline/calibration/summary_statistics.py) in words."""
    group, name = statistic.split(".")
    if group == "variogram":
        return f"variogram at {name.removesuffix('px')} px"
    return f"{group}: {name.replace('_', ' ').replace('std', 'StD').replace('nmad', 'NMAD')}"


def _over_time(result: CalibrationResult) -> bytes:
    """Draw the median and the standard deviation of each epoch."""
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
