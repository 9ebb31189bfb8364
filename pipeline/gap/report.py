"""The files of a diagnosis: gap.json, the model after, points before and after, report and pictures."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure

from pipeline.formats.atomic import write_json, write_text, writing
from pipeline.formats.laz import write_laz
from pipeline.gap.measurement import Measurement
from pipeline.gap.workflow import Diagnosis
from pipeline.report.page import template
from scene.mesh import FloatArray

_BINS = 24
_WORDS = {
    "no_gap": "The measurement agrees with the model: nothing was found that the model does not hold.",
    "named": "One effect explains where measurement and model disagree.",
    "several": "More than one effect is needed to explain where measurement and model disagree.",
    "ambiguous": "An effect is there, but this measurement cannot tell it from others that would look the same.",
    "unknown": "The model is rejected, and no effect of the catalogue passes its own test; an empirical term describes it.",
    "insufficient_data": "There are too few points on smooth parts of the reference to say anything.",
}


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


def where(found: Diagnosis) -> list[dict[str, Any]]:
    """Covariates along which mean or spread of the residuals depart from the model, the clearest first."""
    rows: list[dict[str, Any]] = []
    for name, x, z in _standardised(found):
        edges = np.unique(np.quantile(x, np.linspace(0, 1, _BINS // 2 + 1)))
        if len(edges) < 3:
            continue
        group = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
        count = np.maximum(np.bincount(group, minlength=len(edges) - 1), 1)
        mean = np.bincount(group, z, len(edges) - 1) / count
        spread = np.sqrt(np.maximum(np.bincount(group, z**2, len(edges) - 1) / count - mean**2, 0))
        effective = np.minimum(count, 60)  # points of one block share the reference's error
        for statistic, size in (
            ("mean", np.abs(mean) * np.sqrt(effective)),
            ("spread", np.abs(spread - 1) * np.sqrt(2 * effective)),
        ):
            worst = int(np.argmax(size))
            value = mean[worst] if statistic == "mean" else spread[worst] - 1
            p_value = float(min(1.0, max(2 * len(edges) * np.exp(-(size[worst] ** 2) / 2), 1e-3)))
            region = {"from": float(edges[worst]), "to": float(edges[worst + 1])}
            metres = float(value * np.median(found.residuals.sigma * found.residuals.unit_m))
            rows.append({"covariate": name, "statistic": statistic, "p_value": p_value, "region": region, "size_m": metres})
    return sorted(rows, key=lambda row: (row["p_value"], -abs(row["size_m"])))[:10]


def _standardised(found: Diagnosis) -> list[tuple[str, FloatArray, FloatArray]]:
    residuals = found.residuals
    kept = residuals.smooth & (np.abs(found.before) < 6 * residuals.sigma)
    z = found.before[kept] / residuals.sigma[kept]
    return [(name, values[kept], z) for name, values in residuals.covariates.items()] if kept.any() else []


def write(out: Path, found: Diagnosis, measurement: Measurement) -> Path:
    """Write all files of a diagnosis into `out`; returns report.html."""
    write_json(out / "gap.json", to_dict(found, measurement))
    text = yaml.safe_dump(found.model_after.model_dump(mode="json", exclude_defaults=False), sort_keys=False)
    write_text(out / "model_after.yaml", text)
    points = measurement.frame.to_world(measurement.cloud.points[found.residuals.index])
    for name, values in (("before", found.before), ("after", found.after)):
        extra: dict[str, Any] = {"residual_m": values * found.residuals.unit_m, "held_out": found.held_out.astype(np.uint8)}
        write_laz(out / f"{name}.laz", points, extra=extra)
    pictures = {"maps.png": _maps(found), "profiles.png": _profiles(found), "gap.png": _bars(found)}
    for file, png in pictures.items():
        with writing(out / file) as temporary:
            temporary.write_bytes(png)
    page = template("gap.html.jinja").render(
        found=found, words=_WORDS[found.verdict], pictures=pictures, model=text, where=where(found), note=found.remaining["note"]
    )
    write_text(out / "report.html", page)
    return out / "report.html"


def summary(found: Diagnosis) -> str:
    """The verdict in some lines of text."""
    lines = [f"{found.verdict}: {_WORDS[found.verdict]}"]
    for effect in found.effects:
        values = ", ".join(f"{key} {value}" for key, value in effect.entry.items() if key != "name")
        lines.append(f"  {effect.name} ({values})" + (f"; cannot be told from {', '.join(effect.alike)}" if effect.alike else ""))
    if found.changes:
        lines.append(f"  {len(found.changes)} regions where the scene itself moved were set aside")
    if found.gap is not None:
        closed = "within its uncertainty" if found.gap.closed is None else f"{found.gap.closed:.0%} closed"
        scores = ", ".join(f"{1e3 * value:.3f} mm {name}" for name, value in found.gap.scores.items())
        lines.append(f"  gap {scores}: {closed}")
    return "\n".join(lines)


def _maps(found: Diagnosis) -> bytes:
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    at, unit = found.residuals.at, 1e3 * found.residuals.unit_m
    some = slice(None, None, max(len(at) // 40_000, 1))
    limit = float(3 * np.median(np.abs(found.before * unit))) or 1.0
    for panel, values, title in zip(axes, (found.before, found.after), ("before", "after"), strict=True):
        image = panel.scatter(*at[some].T, c=(values * unit)[some], s=1, cmap="RdBu_r", vmin=-limit, vmax=limit, linewidths=0)
        panel.set(title=title, aspect="equal", xlabel="along the wall, m")
    axes[0].set_ylabel("up the wall, m")
    figure.colorbar(image, ax=axes, label="measured minus predicted, mm")
    return _png(figure)


def _profiles(found: Diagnosis) -> bytes:
    rows = _standardised(found)
    figure = Figure(figsize=(11, 2.4 * max((len(rows) + 2) // 3, 1)), layout="constrained")
    kept = found.residuals.smooth & (np.abs(found.before) < 6 * found.residuals.sigma)
    unit = 1e3 * found.residuals.unit_m[kept]
    for number, (name, x, _) in enumerate(rows):
        panel = figure.add_subplot(max((len(rows) + 2) // 3, 1), 3, number + 1)
        for values, colour, label in ((found.before, "tab:red", "before"), (found.after, "tab:blue", "after")):
            _band(panel, x, values[kept] * unit, colour, label)
        panel.set_xlabel(name)
        panel.set_ylabel("mm")
        if number == 0:
            panel.legend()
    return _png(figure)


def _band(panel: Any, x: FloatArray, values: FloatArray, colour: str, label: str) -> None:
    """Mean of bins of equal numbers, with twice the standard error."""
    edges = np.unique(np.quantile(x, np.linspace(0, 1, _BINS + 1)))
    if len(edges) < 3:
        return
    group = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    count = np.maximum(np.bincount(group, minlength=len(edges) - 1), 1)
    mean = np.bincount(group, values, len(edges) - 1) / count
    error = 2 * np.sqrt(np.maximum(np.bincount(group, values**2, len(edges) - 1) / count - mean**2, 0) / count)
    middle = (edges[1:] + edges[:-1]) / 2
    panel.plot(middle, mean, color=colour, label=label)
    panel.fill_between(middle, mean - error, mean + error, color=colour, alpha=0.2, linewidth=0)


def _bars(found: Diagnosis) -> bytes:
    figure = Figure(figsize=(6, 1.8), layout="constrained")
    panel = figure.add_subplot()
    if found.gap is not None:
        values = [1e3 * found.gap.before, 1e3 * found.gap.after, 1e3 * found.gap.floor]
        panel.barh(["before", "after", "floor"], values, color=["tab:red", "tab:blue", "0.6"])
        panel.set_xlim(0.9 * min(values), 1.02 * max(values))
        panel.invert_yaxis()
    panel.set_xlabel("score on held-out blocks, mm")
    return _png(figure)


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()
