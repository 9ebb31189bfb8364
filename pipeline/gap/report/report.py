"""Write the files of a diagnosis: gap.json, the model after, points before and after, report and figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pipeline.formats.files.atomic import write_json, write_text, writing
from pipeline.formats.measurements.measurement import Measurement
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from pipeline.gap.naming.verdict import describe_closing
from pipeline.gap.naming.workflow import GapDiagnosis
from pipeline.gap.report.advice import advice_on, page_of
from pipeline.gap.report.contributions import contributions
from pipeline.gap.report.covariate_ranking import inliers, rank_disagreements
from pipeline.gap.report.datum_scale import estimate_scale
from pipeline.gap.report.figures import gap_figure, maps_figure, matrix_figure, profiles_figure
from pipeline.gap.report.unseen import reference_line, unseen_entry, unseen_line, unseen_rows
from pipeline.gap.report.wording import (
    covariate_with_unit,
    describe_gap,
    format_decimal,
    format_number,
    format_parameters,
    format_value,
    outcome,
    paragraph,
    round_entry,
    title,
    verdict_in_words,
)
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals
from pipeline.gap.thresholds import use_thresholds
from pipeline.report.page import p_value_in_words, template

_MOST_TRIED = 25
"""Most explanations that the report lists."""


def to_dict(found: GapDiagnosis, measurement: Measurement) -> dict[str, Any]:
    """Return the content of gap.json, the machine-readable result of a diagnosis.

    found: the diagnosis. measurement: the measurement that was diagnosed; it is needed to give positions in the world frame.
    """
    pose = found.residuals.datum[:6] @ found.pose if isinstance(found.residuals, SurfaceResiduals) else found.pose
    to_world = measurement.frame.rotation.T
    poses = [
        {"translation_m": (to_world @ each[:3]).tolist(), "rotation_rad": (to_world @ each[3:]).tolist()}
        for each in np.split(pose, range(6, len(pose), 6))
    ]
    with use_thresholds(found.thresholds):
        gap = found.gap.to_dict() if found.gap else None
    return {
        "schema": 1,
        "verdict": found.verdict,
        "effects": [effect.to_dict() for effect in found.effects],
        "where": rank_disagreements(found),
        "scene_changes": [change.to_dict(measurement.frame) for change in found.changes],
        "sensor": measurement.sensor,
        "registration": poses[0] | _scale_entry(found),
        **({"further_registrations": poses[1:]} if len(poses) > 1 else {}),
        "identifiability": found.identifiability,
        "gap": gap,
        "remaining": found.remaining,
        "detectable": unseen_entry(found),
        "reference_error_m": found.reference_sigma * float(np.median(found.residuals.unit_m)) if len(found.residuals) else None,
        "decisions": found.thresholds.model_dump(),
        "seconds": round(found.seconds, 2),
    }


def _scale_entry(found: GapDiagnosis) -> dict[str, Any]:
    """Entry of the scale, for a surface without cameras; null where its relief does not show it."""
    if not isinstance(found.residuals, SurfaceResiduals):
        return {}
    scale = estimate_scale(found)
    return {"scale_ppm": {"value": None, "std": None} if scale is None else scale.to_dict()}


def write_report(out: Path, found: GapDiagnosis, measurement: Measurement) -> Path:
    """Write the files of a diagnosis: gap.json, model_after.yaml, before.laz and after.laz, report.html and its figures.

    model_after.yaml is the sensor model with the named effects. before.laz and after.laz hold the points (world frame) with
    their residual `residual_m` without and with the named effects; it is positive where the measured surface lies deeper than
    predicted. With several effects, before.laz also holds what each explains alone: `effect_1_m`, `effect_2_m` and so on, in
    the order of gap.json. Nothing is written if a figure fails.

    Parameters
    ----------
    out : folder to write.
    found : diagnosis.
    measurement : measurement that was diagnosed.

    Returns
    -------
    Path : path of report.html.
    """
    with use_thresholds(found.thresholds):
        parts = contributions(found, measurement) if len(found.effects) > 1 else ()
        pictures = _pictures(found)
        page = _render_page(found, pictures)
    write_json(out / "gap.json", to_dict(found, measurement))
    write_text(out / "model_after.yaml", _yaml(found.model_after.model_dump(mode="json", exclude_defaults=False)))
    points = measurement.frame.to_world(measurement.cloud.points[found.residuals.index])
    for name, residual in (("before", found.before), ("after", found.after)):
        extra: dict[str, Any] = {"residual_m": residual * found.residuals.depth_m, "held_out": found.held_out.astype(np.uint8)}
        if name == "before":
            extra |= {f"effect_{number}_m": part * found.residuals.depth_m for number, part in enumerate(parts, start=1)}
        write_laz(out / f"{name}.laz", PointCloud(points, extra=extra))
    for file, png in pictures.items():
        with writing(out / file) as temporary:
            temporary.write_bytes(png)
    write_text(out / "report.html", page)
    return out / "report.html"


def summarise(found: GapDiagnosis) -> str:
    """Return the result of a diagnosis as lines for the terminal: verdict, named effects, scores, and what may be hidden."""
    with use_thresholds(found.thresholds):
        lines, scale = [f"{found.verdict}: {verdict_in_words(found)}"], estimate_scale(found)
        lines += [] if scale is None else [f"  {scale.words}"]
        if found.verdict == "insufficient_data":
            lines += [f"  {found.remaining['note']}", f"  to measure: {_describe_needed_data(found)}"]
        for effect in found.effects:
            alike = f"; cannot be told from {', '.join(effect.alternatives)}" if effect.indistinguishable else ""
            lines.append(f"  {effect.name} ({format_parameters(effect)}){alike}")
        if found.changes:
            regions = "1 region" if len(found.changes) == 1 else f"{len(found.changes)} regions"
            lines.append(f"  set aside: {regions} where the scene itself moved")
        if found.gap is not None:
            factor, unit = found.gap.display_unit
            scores = ", ".join(f"{factor * value:.3f} {unit} {name}" for name, value in found.gap.scores.items())
            lines.append(f"  gap {scores}: {describe_closing(found.gap, found.model_changed)}")
        lines += [f"  {line}"] if (line := unseen_line(found)) else []
        lines += [f"  {line}"] if (line := reference_line(found)) else []
        if found.verdict in ("no_gap", "unknown") and found.remaining.get("note"):
            lines.append(f"  note: {found.remaining['note']}")
        return "\n".join(lines)


def _describe_needed_data(found: GapDiagnosis) -> str:
    """What to measure if the verdict is insufficient_data."""
    if found.evidence.much_moved:
        return (
            "stable_areas in measurement.yaml (boxes or polygons, wall frame, m) where nothing moved, or a reference of the same "
            "time. Movements of the rock are measured as a difference of two epochs, not as an effect of the sensor."
        )
    return (
        f"at least {found.thresholds.points.fewest} points on smooth rock of stable ground, spread over the wall: scan or match "
        "more densely, include more of the wall, or enlarge stable_areas (wall frame, m) where they exclude stable rock."
    )


def _pictures(found: GapDiagnosis) -> dict[str, bytes]:
    """The figures by file name, as PNG."""
    pictures = {"maps.png": maps_figure(found)} if len(found.residuals) else {}
    if inliers(found).any():
        pictures["profiles.png"] = profiles_figure(found)
    if found.gap is not None:
        pictures["gap.png"] = gap_figure(found.gap)
    table = found.identifiability
    if table["names"]:
        cosines = np.abs(np.array(table["cosines"], dtype=np.float64))
        pictures["identifiability.png"] = matrix_figure(table["names"], cosines, np.array(table["survival"], dtype=np.float64))
    return pictures


def _render_page(found: GapDiagnosis, pictures: dict[str, bytes]) -> str:
    """The page report.html."""
    rows = rank_disagreements(found)
    tried = sorted(found.tried, key=lambda item: -item.score)
    best = tried[0].score if tried else 0.0
    after = found.model_after.model_dump(mode="json")
    return template("gap/report/report.html.jinja").render(
        found=found,
        title=title(found),
        answer=paragraph(found, rows, scores=False),
        scores=describe_gap(found),
        advice=advice_on,
        page_of=page_of,
        pictures=pictures,
        where=rows,
        tried=[(item, best - item.score, outcome(found, item)) for item in tried[:_MOST_TRIED]],
        more=max(len(tried) - _MOST_TRIED, 0),
        unseen=unseen_rows(found),
        reference_words=reference_line(found),
        variance_tried=[(item, outcome(found, item)) for item in found.variance_tried],
        added=_yaml({"effects": [round_entry(effect.entry) for effect in found.effects]}),
        model=_yaml(after),
        number=format_number,
        decimal=format_decimal,
        shown=format_value,
        p_value=p_value_in_words,
        with_unit=covariate_with_unit,
        request=_describe_needed_data(found),
        total=sum(found.timings.values()) or 1.0,
    )


def _yaml(content: dict[str, Any]) -> str:
    """YAML in which lists of numbers stay on one line."""
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)
