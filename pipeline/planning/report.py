"""Write a plan's report and its summary: what a set-up achieves, with a picture of every map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pipeline.formats.files.atomic import write_text
from pipeline.planning.maps import Plan, PlanMap
from pipeline.precision.detectability import CLEAR_SNR
from pipeline.report.curve_figures import CurvePanel, curves_figure
from pipeline.report.figures import map_figure
from pipeline.report.page import percent, template

_NOTHING = "\N{EN DASH}"
_FIGURES: dict[str, tuple[str, str, float]] = {
    "seen": ("Wall seen", "%", 100.0),
    "seen_by_several": ("Wall seen from several stations", "%", 100.0),
    "seen_by_both": ("Wall seen by both cameras", "%", 100.0),
    "seen_by_one": ("Wall seen by one camera", "%", 100.0),
    "seen_by_none": ("Wall seen by no camera", "%", 100.0),
    "hidden": ("Wall hidden from the scanner", "%", 100.0),
    "beyond_window_or_reach": ("Wall beyond window, reach or detection limit", "%", 100.0),
    "overlap": ("Overlap: wall in both frames over wall in either", "%", 100.0),
    "base_m": ("Base", "m", 1.0),
    "disparity_sigma_px": ("Standard deviation of the disparity", "px", 1.0),
    "normal_case_sigma_z_m": ("Standard deviation in depth, by Z\N{SUPERSCRIPT TWO}/(cB)", "mm", 1e3),
    "pulses": ("Pulses", "million", 1e-6),
    "seconds_to_scan": ("Time to scan", "s", 1.0),
}
"""Title, unit and factor of each single figure of a plan."""


@dataclass(frozen=True)
class _PlanRow:
    """One map as a row of the table."""

    title: str
    unit: str
    values: list[str]


@dataclass(frozen=True)
class _Picture:
    """One map in report.html of `scarpsim inspect`. grey: what places without a value mean; "" if all have one."""

    title: str
    png: bytes
    grey: str


@dataclass(frozen=True)
class _Part:
    """What report.html of `scarpsim inspect` shows of one sensor."""

    instrument: str
    answer: str
    figures: list[tuple[str, str]]
    rows: list[_PlanRow]
    ignored: str
    curves: bytes | None
    pictures: list[_Picture]


def summary(plan: Plan) -> str:
    """Describe a plan (what a sensor is predicted to achieve on a wall) as lines of text for the terminal.

    They are the main result, the single figures, and a table of the maps with medians and 5 and 95 % quantiles.
    """
    lines = [f"{plan.instrument}, wall {plan.wall}", f"  {answer(plan)}"]
    lines += [f"  {title:<52}{value:>12}" for title, value in _figures(plan)]
    lines.append(f"  {'map':<52}{'middle':>12}{'median':>10}{'5 %':>10}{'95 %':>10}")
    lines += [f"  {row.title:<52}" + "{:>12}{:>10}{:>10}{:>10}".format(*row.values) + f"  {row.unit}" for row in _rows(plan)]
    return "\n".join(lines + ([f"  not counted: {', '.join(plan.ignored)}"] if plan.ignored else []))


def answer(plan: Plan) -> str:
    """State the main result of a plan in words: the smallest block whose fall the sensor detects in the middle of the wall."""
    share = percent(plan.config.probability, 0)
    middle, least = (_in_the_middle(plan, name) for name in ("smallest_block_m", "smallest_findable_m"))
    name = plan.instrument
    if middle is None or least is None:
        return f"{name}: in the middle of the wall no block is seen in {share} of cases."
    points = plan.config.minimum_points
    return (
        f"{name}: at a typical place in the middle of the wall, the fall of a block with sides of {100 * middle:.1f} cm exceeds "
        f"the level of detection in {share} of cases, a test that needs {points} points in each epoch. "
        f"The signal-to-noise ratio of a fall is {CLEAR_SNR:g} from sides of {100 * least:.1f} cm on; below, noise elsewhere on "
        "the wall looks like a block."
    )


def _in_the_middle(plan: Plan, name: str) -> float | None:
    """Return the value of a map in the middle of the wall."""
    return next(found for found in plan.maps if found.name == name).summary(plan.in_middle)["middle"]


def write_plan_report(path: Path, plans: Sequence[Plan], config: Mapping[str, Any], series: Sequence[Any] = ()) -> None:
    """Write report.html, the page that shows plans: what sensors are predicted to achieve on a wall.

    The file is written completely or not at all. Equal arguments give equal bytes.

    Parameters
    ----------
    path : Path
        File to write.
    plans : sequence of Plan
        The plans, one or more of the same wall.
    config : mapping
        The config with all its values, which the page lists.
    series : sequence of SeriesPart
        Prepared sections of the page on what series of epochs will show (from `series_parts`).
    """
    page = template("planning/report.html.jinja").render(
        title=f"{plans[0].wall.replace('_', ' ').capitalize()}: a plan",
        parts=[_part(plan) for plan in plans],
        series=series,
        depth_ratio=plans[0].config.depth_ratio,
        config=yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True),
    )
    write_text(path, page)


def _part(plan: Plan) -> _Part:
    """Collect what the page shows of one plan."""
    return _Part(
        instrument=plan.instrument,
        answer=answer(plan),
        figures=_figures(plan),
        rows=_rows(plan),
        ignored=", ".join(plan.ignored),
        curves=_curves(plan),
        pictures=[_picture(plan, found) for found in plan.maps],
    )


def _figures(plan: Plan) -> list[tuple[str, str]]:
    """Return title and value of each single figure."""
    entries = ((*_FIGURES[name], value) for name, value in plan.figures.items())
    return [(title, f"{value * factor:.3g} {unit}") for title, unit, factor, value in entries]


def _rows(plan: Plan) -> list[_PlanRow]:
    """Return the rows of the table of maps."""
    middle = plan.in_middle
    return [_PlanRow(found.title, found.unit, _values(found, found.summary(middle))) for found in plan.maps]


def _values(found: PlanMap, figures: Mapping[str, float | None]) -> list[str]:
    """Format the values of a row."""
    return [_NOTHING if value is None else f"{value * found.factor:.4g}" for value in figures.values()]


def map_picture(plan: Plan, found: PlanMap) -> bytes:
    """Draw one map of a plan as PNG, with a colour bar in the unit that the map gives for reports.

    Parameters
    ----------
    plan : Plan
        The plan, whose raster says where on the wall the values lie.
    found : PlanMap
        The map to draw, one of the plan's.
    """
    return map_figure(plan.raster.image(found.values * found.factor), plan.raster.grid, found.unit or "ratio", found.title)


def _picture(plan: Plan, found: PlanMap) -> _Picture:
    """Draw a map for report.html."""
    png = map_picture(plan, found)
    none = found.name in ("smallest_block_m", "smallest_findable_m")
    grey = "not seen, or no block would be, however large" if none else "not seen"
    shown = np.isnan(plan.raster.image(found.values)).any()
    return _Picture(found.title, png, grey if shown else "")


def _curves(plan: Plan) -> bytes | None:
    """Draw the curves of the detection probability; None for several stations together, which have no single range."""
    if not plan.curves:
        return None
    panels = [
        CurvePanel(
            curve.label,
            curve.x,
            curve.at,
            {f"block of {size:g} m": values for size, values in curve.probability.items()},
            logarithmic="incidence" not in curve.label,
        )
        for curve in plan.curves
    ]
    return curves_figure(panels, "detection probability, %")
