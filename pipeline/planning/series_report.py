"""Describe in words and pictures what a series of epochs is predicted to show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.planning.series import PROBABILITY, EpochPromise, SeriesPlan
from pipeline.report.curve_figures import CurvePanel, curves_figure
from pipeline.report.page import litres, millimetres

_SENSORS = {"tls": "Laser scanner", "stereo": "Stereo pair"}
_CURVE_POINTS = 80


@dataclass(frozen=True)
class SeriesPart:
    """Hold what report.html of `scarpsim inspect` shows about one series of epochs.

    Attributes
    ----------
    title : str
        Heading of the section.
    sentences : list of str
        The main statements, such as the smallest rockfall that is listed.
    curves : bytes
        Picture of the detection probabilities, PNG.
    heads, rows : list of str, list of lists of str
        Header and rows of a table: how early moving blocks are noticed, by number of scans, volume and interval.
    """

    title: str
    sentences: list[str]
    curves: bytes
    heads: list[str]
    rows: list[list[str]]


def series_summary(plan: SeriesPlan) -> str:
    """Describe which rockfalls a series of epochs is predicted to show, and how early, as lines of text for the terminal."""
    part = series_part(plan)
    widths = [max(len(row[place]) for row in [part.heads, *part.rows]) for place in range(len(part.heads))]
    table = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in [part.heads, *part.rows]]
    return "\n".join([part.title, *(f"  {each}" for each in [*part.sentences, *table])])


def series_part(plan: SeriesPlan) -> SeriesPart:
    """Prepare the section of report.html that shows what one series of epochs is predicted to detect."""
    return SeriesPart(
        title=f"{_SENSORS[plan.sensor]}, series, maps of {plan.gsd_m * 1e3:g} mm a pixel",
        sentences=_sentences(plan),
        curves=_curves(plan),
        heads=["scans", "volume", "shows from", *(f"lead, every {_hours(each)}" for each in plan.schedules_h)],
        rows=[_row(plan, promise, volume) for promise in plan.promises for volume in plan.volumes_m3],
    )


def _sentences(plan: SeriesPlan) -> list[str]:
    """Return the main statements."""
    found = []
    for promise in plan.promises:
        value, low, high = promise.missing.volume_m3()
        scans = "one scan an epoch" if promise.scans == 1 else f"{promise.scans} scans an epoch"
        found.append(
            f"With {scans}, rockfalls from {litres(value)} l on are listed in {100 * PROBABILITY:g} % of cases "
            f"({litres(low)} to {litres(high)} l); the median level of detection is {millimetres(promise.level_m)}."
        )
    motion = plan.motion
    law = "inverse velocity" if motion.law == "inverse_velocity" else "linear creep"
    found.append(
        f"Precursor: {millimetres(motion.displacement_m)} in {_hours(motion.lead_h)} before the fall, {law}. Lead: how long "
        f"before the fall it is listed in {100 * PROBABILITY:g} % of cases, whenever the epochs are (in brackets: median)."
    )
    return found


def _row(plan: SeriesPlan, promise: EpochPromise, volume_m3: float) -> list[str]:
    """Return the table's row of a block that moves."""
    shows = promise.moved.displacement_m(volume_m3)[0]
    visible = millimetres(shows) if shows <= plan.motion.displacement_m else "not before it falls"
    leads = [plan.lead_h(volume_m3, every, promise) for every in plan.schedules_h]
    cells = [f"{_lead(least)} ({_lead(usual)})" for least, usual in leads]
    return [str(promise.scans), f"{litres(volume_m3)} l", visible, *cells]


def _lead(hours: float) -> str:
    """Return a lead time; "none" where there is none."""
    return f"{hours:.1f} h" if hours > 0 else "none"


def _curves(plan: SeriesPlan) -> bytes:
    """Draw the probability against the volume that falls, and against the displacement of a block that moves."""
    first = plan.promises[0]
    smallest = first.missing.volume_m3()[0]
    volume = np.geomspace(smallest / 20, smallest * 5, _CURVE_POINTS)
    moved = np.geomspace(plan.motion.displacement_m / 50, plan.motion.displacement_m * 2, _CURVE_POINTS)
    names = {each.scans: "one scan" if each.scans == 1 else f"{each.scans} scans" for each in plan.promises}
    falls = {names[each.scans]: each.missing.probability(volume) for each in plan.promises}
    middle = plan.volumes_m3[len(plan.volumes_m3) // 2]
    leans = {names[each.scans]: each.moved.probability(np.full(_CURVE_POINTS, middle), moved) for each in plan.promises}
    panels = [
        CurvePanel("volume that falls, litres", 1e3 * volume, 1e3 * smallest, falls, logarithmic=True),
        CurvePanel(
            f"displacement of a block of {litres(middle)} l, mm", 1e3 * moved, 1e3 * plan.motion.displacement_m, leans, True
        ),
    ]
    return curves_figure(panels, "probability of being listed, %")


def _hours(hours: float) -> str:
    """Return a time in hours, or in days where it is a whole number of them above one."""
    return f"{hours / 24:g} days" if hours > 24 and hours % 24 == 0 else f"{hours:g} h"


def series_parts(plans: Sequence[SeriesPlan]) -> list[SeriesPart]:
    """Prepare the sections of report.html for several predicted series of epochs, one for each sensor."""
    return [series_part(plan) for plan in plans]
