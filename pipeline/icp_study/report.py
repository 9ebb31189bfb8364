"""Make the folder of `scarpsim icp-study`: icp_study.json, icp_study.csv, two pictures and report.html."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.comparison.report import write_csv
from pipeline.formats.files.atomic import filling, write_bytes, write_json, write_text
from pipeline.icp_study.results import IcpStudy, Parameter, Recommendation, StudyRow
from pipeline.report.figures import DPI, FAMILY, label_axes, plain_numbers, png_bytes
from pipeline.report.page import millimetres, template
from pipeline.report.provenance import versions

_TITLES: dict[Parameter, str] = {
    "subsample_ratio": "share of the points left out",
    "outlier_distance_threshold": "outlier threshold, m",
}
"""Axis labels."""
_LEAST_KEPT = 5e-4
"""Smallest share of points on the axis of subsample ratios."""


def write_icp_study(out: Path, study: IcpStudy) -> Path:
    """Write the results of an ICP study as a report with tables and pictures, and return the report's path.

    Such a study registers repeated measurements (epochs) with many values of ICP's settings, to find good ones. The folder
    `out` gets report.html, tables (icp_study.json, icp_study.csv) and a picture for each setting. It appears only when
    everything has been written.
    """
    with filling(out) as folder:
        _write(folder, study)
    return out / "report.html"


def _write(out: Path, study: IcpStudy) -> None:
    """Write everything into the folder."""
    write_json(out / "icp_study.json", {**study.to_dict(), "versions": versions()})
    write_csv(out / "icp_study.csv", [row.to_dict() for row in study.rows])
    pictures = {f"{name}.png": study_figure(study, name) for name in _TITLES}
    for name, png in pictures.items():
        write_bytes(out / name, png)
    page = template("icp_study/report.html.jinja").render(
        study=study, answers=[recommendation_sentence(each) for each in study.recommended], pictures=pictures
    )
    write_text(out / "report.html", page)


def recommendation_sentence(found: Recommendation) -> str:
    """State a recommended value of an ICP setting, and the error that remains with it, as a sentence for the report.

    found: the recommendation.
    """
    low, high = found.good
    error = f"{millimetres(found.normal_error_m, 2)} of error along the surface's normal remains"
    if found.parameter == "subsample_ratio":
        good = f"up to {high:g} of the points may be left out"
        return f"icp.subsample_ratio: {found.value:g}. With the run's other settings {good}; {error}."
    good = f"{low:.3f} to {high:.3f} m are as good"
    return f"icp.outlier_distance_threshold: {found.value:.3f} m. With the run's other settings {good}; {error}."


def summary(study: IcpStudy) -> str:
    """State the main results of an ICP study as lines of text for the terminal.

    They are the recommended settings, and the error of the registration that the command `simulate` applied to each epoch.
    """
    lines = [recommendation_sentence(each) for each in study.recommended]
    for number, error in study.applied.items():
        if error is not None:
            lines.append(
                f"epoch {number}: the run's transform errs by {error.normal_m * 1e3:.2f} mm along the surface's normal, "
                f"{error.displacement_m * 1e3:.2f} mm in all (RMS over the wall)"
            )
    return "\n".join(lines)


def study_figure(study: IcpStudy, parameter: Parameter) -> bytes:
    """Draw how well ICP registers with different values of one of its settings, and return the picture as PNG.

    Three panels show the RMS residual, the error of the pose and the share of inliers. Lines are medians, dots single
    registrations.

    study: the results of the study. parameter: the setting, "subsample_ratio" or "outlier_distance_threshold".
    """
    rows = [row for row in study.rows if row.parameter == parameter]
    figure = Figure(figsize=(13.0, 4.2), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, 3)
    labels = ("RMS of all points within the threshold, mm", "error along the normal, mm (RMS)", "points within the threshold, %")
    fields = ("rms_m", "normal_error_m", "inlier_share")
    for axes, label, field, factor in zip(panels, labels, fields, (1e3, 1e3, 100.0), strict=True):
        for colour, gradual in zip(FAMILY, (True, False), strict=False):
            part = [row for row in rows if row.gradual == gradual and getattr(row, field) is not None]
            if part:
                name = "threshold comes down over the iterations" if gradual else "threshold from the first iteration"
                _curve(axes, part, field, factor, colour, name if parameter == "outlier_distance_threshold" else "")
        best = next((each for each in study.recommended if each.parameter == parameter), None)
        if best is not None:
            axes.axvline(_place(parameter, best.value), color="0.3", linewidth=0.8, linestyle="--", label="recommended")
        label_axes(axes, _TITLES[parameter], label)
        axes.grid(color="0.9", linewidth=0.6)
        _scale(axes, parameter, rows)
    panels[1].set_yscale("log")
    plain_numbers(panels[1].yaxis)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    return png_bytes(figure)


def _curve(axes: Axes, rows: Sequence[StudyRow], field: str, factor: float, colour: str, label: str) -> None:
    """Draw the median and the single registrations of one variant."""
    values = sorted({row.value for row in rows})
    place = [_place(rows[0].parameter, value) for value in values]
    median = [factor * float(np.median([getattr(row, field) for row in rows if row.value == value])) for value in values]
    dots: list[Any] = [factor * getattr(row, field) for row in rows]
    axes.plot([_place(row.parameter, row.value) for row in rows], dots, ".", color=colour, markersize=3, alpha=0.6)
    axes.plot(place, median, color=colour, linewidth=1.4, label=label or "median")


def _place(parameter: Parameter, value: float) -> float:
    """Return the position of a value on its axis: for ratios the share that is kept, on a logarithmic axis."""
    return max(1 - value, _LEAST_KEPT) if parameter == "subsample_ratio" else value


def _scale(axes: Axes, parameter: Parameter, rows: Sequence[StudyRow]) -> None:
    """Set the scale of the parameter's axis."""
    if parameter == "outlier_distance_threshold":
        return
    axes.set_xscale("log")
    axes.invert_xaxis()
    shown = [value for value in sorted({row.value for row in rows}) if value in (0, 0.5, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)]
    axes.set_xticks([_place(parameter, value) for value in shown], [f"{value:g}" for value in shown], fontsize=8)
    axes.minorticks_off()
