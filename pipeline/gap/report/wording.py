"""Put a diagnosis into words: title, first paragraph of the report, and the outcome of each explanation that was tried."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipeline.gap.mean.selection import FamilyScore
from pipeline.gap.naming.named_effects import NamedEffect
from pipeline.gap.naming.verdict import VERDICTS, describe_closing, describe_misfit, verdict_sentence
from pipeline.gap.naming.workflow import GapDiagnosis
from pipeline.gap.noise_and_edges.variance_model import VarianceScore
from pipeline.gap.report.datum_scale import estimate_scale
from pipeline.gap.report.quantities import format_with_std
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals
from pipeline.report.page import with_minus_sign
from sensors.effects.base import ShowsIn
from sensors.effects.surface_empirical import SurfaceEmpirical

_STATISTICS = {"mean": "mean", "spread": "standard deviation", "shape": "outliers", "missing": "lost returns"}
_SURFACE_SENTENCES = {
    VERDICTS["no_gap"]: "The cloud agrees with the reference: the residuals are no larger than its noise.",
    VERDICTS["unknown"]: "The cloud differs from the reference by more than its noise; an empirical term describes how.",
}
"""Sentences of verdicts where no effect of the catalogue can be tried, because there are no cameras."""
_CLEAR_P_VALUE = 0.01
"""p-value up to which a covariate is mentioned."""
_COVARIATES = {
    "range": ("range", "m"), "depth": ("depth", "m"), "azimuth": ("azimuth", "rad"), "zenith": ("zenith", "rad"),
    "incidence": ("incidence", "rad"), "image_x": ("image x", "px"), "image_y": ("image y", "px"),
    "radius": ("distance from the image's middle", "px"), "disparity": ("disparity", "px"),
    "disparity_fraction": ("fraction of the disparity", "px"), "intensity": ("intensity", "ln of power over its median"),
    "line": ("scan line", "number"), "time": ("time", "share of the scan"),
    "along": ("place along the wall", "m"), "up": ("place up the wall", "m"), "out": ("place out of the wall's plane", "m"),
    "slope": ("slope against the wall's plane", "rad"), "roughness": ("roughness", "m"), "convexity": ("convexity", "m"),
    "edge_distance": ("distance to the nearest edge", "m"),
    "log_power": ("expected power", "ln of power over that at 100 m"), "edge_step": ("step beside the point", ""),
}  # fmt: skip
"""Each covariate in words, and the unit of its values; "" for the unit of the observable."""


def title(found: GapDiagnosis) -> str:
    """Return the outcome of a diagnosis as the headline of the report, such as "Missing: tls.range_offset"."""
    names = [" or ".join([effect.name, *effect.alternatives]) for effect in found.effects if effect.kind == "physical"]
    match found.verdict:
        case "no_gap" | "unknown" if found.evidence.only_noise_too_large(found.effects):
            return "No missing effect was found, but the model is too noisy"
        case "no_gap":
            return "No effect is missing"
        case "insufficient_data" if found.evidence.much_moved:
            return "Much of the wall moved: nothing can be said about the sensor"
        case "insufficient_data":
            return "Too few data for a diagnosis"
        case "unknown" if not found.effects:
            return "Measurement and model disagree, and nothing that was tried explains it"
        case "unknown" if not any(effect.kind == "empirical" for effect in found.effects):
            if found.evidence.gap_stays_open:
                return f"{join_words(names)} closes little of the gap: something else is missing"
            if found.evidence.effects_unsupported:
                return f"{join_words(names)} does not make the gap smaller: something else may be missing"
            if found.evidence.misfit_stays:
                return f"{join_words(names)} leaves a misfit larger than chance would: something else is missing"
            return f"{join_words(names)}, and something that adds noise to the residuals"
        case "unknown" if isinstance(found.residuals, SurfaceResiduals):
            return "The cloud differs from the reference by more than its noise"
        case "unknown":
            return "Missing: something that is not in the catalogue" + (f", and {join_words(names)}" if names else "")
        case _:
            return f"Missing: {join_words(names)}"


def paragraph(found: GapDiagnosis, rows: list[dict[str, Any]], *, scores: bool = True) -> str:
    """Return the outcome of a diagnosis as a paragraph: verdict, named effects, and how much of the gap they close.

    The gap is the distance between sensor model and measurement.

    Parameters
    ----------
    found : diagnosis.
    rows : values of covariates, such as the range, where measurement and model differ most, from `rank_disagreements`.
    scores : whether to state the scores of the model without and with the named effects. The top of the report leaves them out.
    """
    gap = describe_gap(found) if scores else _describe_closed_gap(found)
    return " ".join(each for each in (*_findings(found, rows), gap, *_side_notes(found)) if each)


def verdict_in_words(found: GapDiagnosis) -> str:
    """Return the verdict of a diagnosis as a sentence for the report and the terminal.

    A surface from unknown cameras has sentences of its own, because no camera error can be tried for it.
    """
    said = verdict_sentence(found.verdict, found.effects, found.evidence)
    return _SURFACE_SENTENCES.get(said, said) if isinstance(found.residuals, SurfaceResiduals) else said


def _findings(found: GapDiagnosis, rows: list[dict[str, Any]]) -> list[str]:
    """Sentences on what was compared and what was found."""
    parts = [f"{len(found.residuals):,} {found.residuals.label} were compared with what the model predicts."]
    parts.append(verdict_in_words(found))
    scale = estimate_scale(found)
    parts += [] if scale is None else [scale.words]
    parts += _describe_effects(found.effects)
    return [*parts, describe_misfit(found.effects, found.evidence), _largest_disagreement(found, rows)]


def _describe_closed_gap(found: GapDiagnosis) -> str:
    """How much of the gap closes, if something was named."""
    if found.gap is None or found.gap.closed is None or not found.model_changed:
        return ""
    what = "them" if len(found.effects) > 1 else "it"
    closed = describe_closing(found.gap, found.model_changed)
    return f"With {what} in the model, {closed} on validation blocks, which no fit had used."


def _side_notes(found: GapDiagnosis) -> list[str]:
    """Sentences on scene changes, and the notes."""
    parts = []
    if found.changes:
        volume = sum(abs(change.volume_m3) for change in found.changes)
        regions, were = ("1 region", "was") if len(found.changes) == 1 else (f"{len(found.changes)} regions", "were")
        std = sum(change.volume_std_m3**2 for change in found.changes) ** 0.5
        moved = f"{volume:.2g} \N{PLUS-MINUS SIGN} {std:.1g} m\N{SUPERSCRIPT THREE} in all"
        parts.append(f"{regions} where the rock itself moved ({moved}) {were} set aside.")
    if found.remaining.get("note"):
        parts.append(f"Note: {found.remaining['note']}.")
    return parts


def _largest_disagreement(found: GapDiagnosis, rows: list[dict[str, Any]]) -> str:
    """Where the disagreement is largest, and how large it is there if nothing describes it."""
    if found.verdict in ("no_gap", "insufficient_data") or not rows:
        return ""
    clear = [row for row in rows if row["p_value"] <= _CLEAR_P_VALUE]
    first = (clear or rows)[0]
    statistic = _STATISTICS[first["statistic"]]
    if not found.effects:
        what = covariate_name(first["covariate"])
        region = " to ".join(format_number(first["region"][key]) for key in ("from", "to"))
        size = f"{format_number(1e3 * abs(first['size_m']), 2)} mm"
        size = f"{100 * first['share_lost']:.0f} % lost" if first["statistic"] == "missing" else size
        return f"The disagreement is largest in the {statistic} against {what}, from {region}: {size} there."
    if not clear:
        return ""
    seen = [covariate_name(row["covariate"]) for row in clear[:3] if row["statistic"] == first["statistic"]]
    return f"Before any effect was named, the disagreement was largest in the {statistic} against {join_words(seen)}."


def outcome(found: GapDiagnosis, item: FamilyScore | VarianceScore) -> str:
    """Say what became of one explanation that the diagnosis tried, for the report's tables.

    Parameters
    ----------
    found : diagnosis.
    item : one of `found.tried` (systematic sensor errors, and curves without a cause) or of `found.variance_tried` (noise terms).

    Returns
    -------
    str : "named", "cannot be told from the named one", "added as empirical" or "rejected".
    """
    named = [each for each in found.effects if each.kind == ("empirical" if item.empirical else "physical")]
    if item.empirical:
        if isinstance(item, VarianceScore):
            added = any(effect.adds_variance for effect in named)
        else:
            forms = (each for each in found.tried if each.empirical and each.name == item.name)
            best = max(forms, key=lambda each: each.score)
            added = item is best and item.name in {effect.entry.get("covariate") for effect in named}
        return "added as empirical" if added else "rejected"
    name = f"{found.residuals.sensor}.{item.name}"
    if any(each.name == name for each in named):
        return "named"
    alike = {other for each in named for other in each.indistinguishable}
    return "cannot be told from the named one" if name in alike else "rejected"


def join_words(words: Sequence[str]) -> str:
    """Join one or more words or names for a sentence, as in "a, b and c"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def covariate_with_unit(covariate: str, sensor: str) -> str:
    """Return a covariate (a quantity on which an error may depend) in words with its unit, such as "range, m".

    sensor: "tls" or "stereo"; a covariate without a unit of its own has that of the observable, m or px.
    """
    _, unit = _COVARIATES.get(covariate, ("", ""))
    return f"{covariate_name(covariate)}, {unit or ('m' if sensor == 'tls' else 'px')}"


def covariate_name(covariate: str) -> str:
    """Return a covariate (a quantity on which an error may depend) in words, such as "scan line" for "line"."""
    return _COVARIATES[covariate][0] if covariate in _COVARIATES else covariate.replace("_", " ")


def format_number(value: float, digits: int = 4) -> str:
    """Format a number for the report with at most `digits` significant digits, without an exponent from 0.0001 to a million."""
    return f"{float(f'{value:.{digits}g}'):g}"


def format_decimal(value: float) -> str:
    """Format a number for the report with one decimal, or without decimals from ten thousand on."""
    return with_minus_sign(value, 1) if abs(value) < 9999.95 else format_number(value, 5)


def round_entry(value: Any) -> Any:
    """Round all numbers in an effect's entry of a sensor model to five significant digits, so that the report can show it.

    value: the entry (a dictionary) or a part of it, such as a list or a number.
    """
    if isinstance(value, dict):
        return {key: round_entry(each) for key, each in value.items()}
    if isinstance(value, list):
        return [round_entry(each) for each in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def format_parameters(effect: NamedEffect) -> str:
    """Format the parameters of a named effect (sensor error) with their standard deviations, separated by commas."""
    return ", ".join(
        f"{key} {format_value(key, value, effect.std.get(key))}" for key, value in effect.entry.items() if key != "name"
    )


def format_value(key: str, value: Any, std: float | None) -> str:
    """Format one parameter of a named effect (sensor error) for the report.

    Parameters
    ----------
    key : key of the parameter, whose suffix names its unit, such as `amplitude_m`.
    value : a number, a text, an axis (dictionary with low and high) or a table (list of lists). Of axis and table only the
        range of values is given.
    std : standard deviation of a number; None if it is not known.
    """
    if isinstance(value, dict):
        cycle = f", repeated every {format_number(value['period'])}" if value.get("period") else ""
        return f"{format_number(value['low'])} to {format_number(value['high'])}{cycle}"
    if isinstance(value, list):
        flat = [each for row in value for each in row]
        return f"{len(value)} x {len(value[0])} from {format_number(min(flat), 3)} to {format_number(max(flat), 3)}"
    if not isinstance(value, float):
        return str(value)
    return format_with_std(key, value, std)


def _describe_effects(effects: Sequence[NamedEffect]) -> list[str]:
    """Sentences on the named effects."""
    physical = [effect for effect in effects if effect.kind != "empirical"]
    starts = iter(["It is"] if len(physical) == 1 else ["One effect is", *["Another one is"] * len(physical)])
    return [
        f"The disagreement {_describe_empirical(effect)}; {effect.name} describes it but does not explain it."
        if effect.kind == "empirical"
        else f"{next(starts)} {effect.name} ({format_parameters(effect)}).{_describe_alternatives(effect)}"
        for effect in effects
    ]


def _describe_alternatives(effect: NamedEffect) -> str:
    """Sentence on the effects from which a named one cannot be told, after a space; "" if there are none."""
    if not effect.indistinguishable:
        return ""
    return f" It cannot be told from {', '.join(effect.alternatives)}; to separate them: {effect.split_by}."


def _describe_empirical(effect: NamedEffect) -> str:
    """What an empirical term depends on."""
    covariates = [covariate_name(effect.entry[key]) for key in ("covariate", "second") if effect.entry.get(key)]
    if covariates:
        said = f"depends on {join_words(covariates)}"
        if effect.effect is not SurfaceEmpirical:
            return said
        values = [each for row in effect.entry["values_m"] for each in row]
        return f"{said} (by {format_number(1e3 * (max(values) - min(values)), 3)} mm from its lowest to its highest value)"
    lost = effect.effect.shows_in == ShowsIn.RETURNS
    return "is in the directions from which nothing returns" if lost else "is larger than the model predicts"


def describe_gap(found: GapDiagnosis) -> str:
    """Return a sentence with the scores of the sensor model without and with the named effects, and that of noise alone.

    It is "" if nothing was scored.
    """
    if found.gap is None:
        return ""
    gap, model_changed = found.gap, found.model_changed
    factor, unit = gap.display_unit
    before, after, floor = (f"{factor * value:.3f} {unit}" for value in (gap.before, gap.after, gap.floor))
    scores = f"{before} before, {after} after" if model_changed else f"{before} before"
    text = f"On validation blocks, which no fit has used, the gap is {scores}; the model's own noise leaves {floor}"
    return f"{text}{', so ' if gap.closed is None else ': '}{describe_closing(gap, model_changed)}."
