"""The files of a diagnosis: gap.json, the model after, points before and after, report and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pipeline.formats.atomic import write_json, write_text, writing
from pipeline.formats.laz import write_laz
from pipeline.gap.figures import gap_figure, maps_figure, matrix_figure, profiles_figure
from pipeline.gap.in_words import (
    VERDICTS,
    decimal,
    number,
    outcome,
    paragraph,
    rounded,
    spread_outcome,
    title,
    values,
    with_unit,
)
from pipeline.gap.measurement import Measurement
from pipeline.gap.where import where
from pipeline.gap.workflow import Diagnosis
from pipeline.report.page import p_value_in_words, percent, template

_MOST_TRIED = 25


def to_dict(found: Diagnosis, measurement: Measurement) -> dict[str, Any]:
    """gap.json."""
    shift, turn = found.pose[:3], found.pose[3:]
    axes = measurement.frame.rotation
    return {
        "schema": 1,
        "verdict": found.verdict,
        "effects": [effect.to_dict() for effect in found.effects],
        "where": where(found),
        "scene_changes": [change.to_dict(measurement.frame) for change in found.changes],
        "sensor": measurement.sensor,
        "registration": {"translation_m": (axes.T @ shift).tolist(), "rotation_rad": (axes.T @ turn).tolist()},
        "identifiability": found.identifiability,
        "gap": found.gap.to_dict() if found.gap else None,
        "remaining": found.remaining,
        "seconds": round(found.seconds, 2),
    }


def write(out: Path, found: Diagnosis, measurement: Measurement) -> Path:
    """Write all files of a diagnosis into `out`; returns report.html."""
    write_json(out / "gap.json", to_dict(found, measurement))
    write_text(out / "model_after.yaml", _yaml(found.model_after.model_dump(mode="json", exclude_defaults=False)))
    points = measurement.frame.to_world(measurement.cloud.points[found.residuals.index])
    for name, residual in (("before", found.before), ("after", found.after)):
        extra: dict[str, Any] = {"residual_m": residual * found.residuals.unit_m, "held_out": found.held_out.astype(np.uint8)}
        write_laz(out / f"{name}.laz", points, extra=extra)
    pictures = _pictures(found)
    for file, png in pictures.items():
        with writing(out / file) as temporary:
            temporary.write_bytes(png)
    write_text(out / "report.html", _page(found, pictures))
    return out / "report.html"


def summary(found: Diagnosis) -> str:
    """The verdict in some lines of text."""
    lines = [f"{found.verdict}: {VERDICTS[found.verdict]}"]
    for effect in found.effects:
        alike = f"; cannot be told from {', '.join(effect.alike)}" if effect.alike else ""
        lines.append(f"  {effect.name} ({values(effect)}){alike}")
    if found.changes:
        lines.append(f"  {len(found.changes)} regions where the scene itself moved were set aside")
    if found.gap is not None:
        closed = "within its uncertainty" if found.gap.closed is None else f"{percent(found.gap.closed, 0)} closed"
        factor, unit = found.gap.shown
        scores = ", ".join(f"{factor * value:.3f} {unit} {name}" for name, value in found.gap.scores.items())
        lines.append(f"  gap {scores}: {closed}")
    return "\n".join(lines)


def _pictures(found: Diagnosis) -> dict[str, bytes]:
    pictures = {"maps.png": maps_figure(found), "profiles.png": profiles_figure(found)} if len(found.residuals) else {}
    if found.gap is not None:
        pictures["gap.png"] = gap_figure(found.gap)
    table = found.identifiability
    if table["names"]:
        cosines = np.abs(np.array(table["cosines"], dtype=np.float64))
        pictures["identifiability.png"] = matrix_figure(table["names"], cosines, np.array(table["survival"], dtype=np.float64))
    return pictures


def _page(found: Diagnosis, pictures: dict[str, bytes]) -> str:
    rows = where(found)
    tried = sorted(found.tried, key=lambda item: -item.score)
    best = tried[0].score if tried else 0.0
    after = found.model_after.model_dump(mode="json")
    return template("gap.html.jinja").render(
        found=found,
        title=title(found),
        paragraph=paragraph(found, rows),
        pictures=pictures,
        where=rows,
        tried=[(item, best - item.score, outcome(found, tried, item)) for item in tried[:_MOST_TRIED]],
        more=max(len(tried) - _MOST_TRIED, 0),
        spread_tried=[(item, spread_outcome(found, item)) for item in found.spread_tried],
        added=_yaml({"effects": [rounded(effect.entry) for effect in found.effects]}),
        model=_yaml(after),
        number=number,
        decimal=decimal,
        rounded=rounded,
        p_value=p_value_in_words,
        with_unit=with_unit,
        slowest=sum(found.timings.values()),
    )


def _yaml(content: dict[str, Any]) -> str:
    return yaml.safe_dump(content, sort_keys=False)
