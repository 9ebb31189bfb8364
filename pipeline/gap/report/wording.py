"""A diagnosis in plain words: the paragraph at the top of the report, and what became of each explanation that was tried."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipeline.gap.mean.selection import Tried
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

_STATISTICS = {"mean": "mean", "spread": "spread", "shape": "outliers", "missing": "lost returns"}
_SURFACE_SENTENCES = {
    VERDICTS["no_gap"]: "The cloud agrees with the reference: what is left is as large as its noise.",
    VERDICTS["unknown"]: "The cloud departs from the reference by more than its noise; an empirical term describes how.",
}
"""Sentences of verdicts where no effect of the catalogue can be tried."""
_CLEAR_P_VALUE = 0.01
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
"""A covariate in words, and the unit of its values; "": the observable's."""


def title(found: GapDiagnosis) -> str:
    """The outcome in a few words."""
    names = [" or ".join([effect.name, *effect.alike]) for effect in found.effects if effect.kind == "physical"]
    match found.verdict:
        case "no_gap" | "unknown" if found.evidence.only_too_noisy(found.effects):
            return "No effect was found to be missing, but the model is too noisy"
        case "no_gap":
            return "No effect is missing"
        case "insufficient_data" if found.evidence.much_moved:
            return "Much of the wall moved: nothing can be said of the sensor"
        case "insufficient_data":
            return "Too few data to say what is missing"
        case "unknown" if not found.effects:
            return "Measurement and model disagree, and nothing that was tried says why"
        case "unknown" if not any(effect.kind == "empirical" for effect in found.effects):
            if found.evidence.stays_open:
                return f"{join_words(names)} closes little of the gap: something else is missing"
            if found.evidence.supports_nothing:
                return f"{join_words(names)} does not make the gap smaller: something else may be missing"
            if found.evidence.stays_rejected:
                return f"{join_words(names)} leaves more than chance would: something else is missing"
            return f"{join_words(names)}, and something that makes the residuals spread"
        case "unknown" if isinstance(found.residuals, SurfaceResiduals):
            return "The cloud departs from the reference by more than its noise"
        case "unknown":
            return "Missing: something that is not in the catalogue" + (f", and {join_words(names)}" if names else "")
        case _:
            return f"Missing: {join_words(names)}"


def paragraph(found: GapDiagnosis, rows: list[dict[str, Any]]) -> str:
    """What was compared, what was found, how far the gap closes. rows: as `where` gives them."""
    return " ".join(each for each in (*_findings(found, rows), describe_gap(found), *_side_notes(found)) if each)


def answer(found: GapDiagnosis, rows: list[dict[str, Any]]) -> str:
    """The same for a reader who wants to know what is the matter: scores stand elsewhere."""
    return " ".join(each for each in (*_findings(found, rows), _describe_closed_gap(found), *_side_notes(found)) if each)


def verdict_in_words(found: GapDiagnosis) -> str:
    """The verdict in words; of a surface without cameras, of which no effect of the catalogue can be tried, in its own."""
    said = verdict_sentence(found.verdict, found.effects, found.evidence)
    return _SURFACE_SENTENCES.get(said, said) if isinstance(found.residuals, SurfaceResiduals) else said


def _findings(found: GapDiagnosis, rows: list[dict[str, Any]]) -> list[str]:
    parts = [f"{len(found.residuals):,} {found.residuals.called} were compared with what the model predicts."]
    parts.append(verdict_in_words(found))
    scale = estimate_scale(found)
    parts += [] if scale is None else [scale.words]
    parts += [_describe_effect(effect) for effect in found.effects]
    return [*parts, describe_misfit(found.effects, found.evidence), _largest_disagreement(found, rows)]


def _describe_closed_gap(found: GapDiagnosis) -> str:
    """How much of the gap closes, where something was named; the scores are evidence."""
    if found.gap is None or found.gap.closed is None or not found.mended:
        return ""
    return f"With it in the model {describe_closing(found.gap, found.mended)}, on rock that no step had used."


def _side_notes(found: GapDiagnosis) -> list[str]:
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
    """Where the disagreement is; where nothing describes it, also how large it is there."""
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
        return f"It shows most in the {statistic} against {what}, from {region}: {size} there."
    if not clear:
        return ""
    seen = [covariate_name(row["covariate"]) for row in clear[:3] if row["statistic"] == first["statistic"]]
    return f"Before anything was named it showed most in the {statistic} against {join_words(seen)}."


def outcome(found: GapDiagnosis, tried: Sequence[Tried], item: Tried) -> str:
    """What became of one of the explanations `tried`, best first: named, in the class of a named one, or rejected."""
    if item.empirical:
        added = {effect.entry.get("covariate") for effect in found.effects if effect.kind == "empirical"}
        best = next(each for each in tried if each.empirical and each.name == item.name)
        return "added as empirical" if item is best and item.name in added else "rejected"
    return _outcome_of(found, item.name)


def spread_outcome(found: GapDiagnosis, item: VarianceScore) -> str:
    """What became of one of the explanations of the spread."""
    if item.empirical:
        added = any(effect.kind == "empirical" and effect.spreads for effect in found.effects)
        return "added as empirical" if added else "rejected"
    return _outcome_of(found, item.name)


def _outcome_of(found: GapDiagnosis, effect: str) -> str:
    """What became of an effect of the catalogue."""
    name = f"{found.residuals.sensor}.{effect}"
    physical = [each for each in found.effects if each.kind == "physical"]
    if any(each.name == name for each in physical):
        return "named"
    alike = {other for each in physical for other in each.alike}
    return "cannot be told from the named one" if name in alike else "rejected"


def join_words(words: Sequence[str]) -> str:
    """a, b and c."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def covariate_with_unit(covariate: str, sensor: str) -> str:
    """A covariate as a report shows it, with the unit of its values."""
    _, unit = _COVARIATES.get(covariate, ("", ""))
    return f"{covariate_name(covariate)}, {unit or ('m' if sensor == 'tls' else 'px')}"


def covariate_name(covariate: str) -> str:
    """A covariate as a sentence has it."""
    return _COVARIATES[covariate][0] if covariate in _COVARIATES else covariate.replace("_", " ")


def format_number(value: float, digits: int = 4) -> str:
    """With at most so many significant digits, written out below a million and above a ten-thousandth."""
    return f"{float(f'{value:.{digits}g}'):g}"


def format_decimal(value: float) -> str:
    """With one decimal, without any from ten thousand on."""
    return with_minus_sign(value, 1) if abs(value) < 9999.95 else format_number(value, 5)


def round_entry(value: Any) -> Any:
    """A value of an effect's entry with at most five significant digits in each number."""
    if isinstance(value, dict):
        return {key: round_entry(each) for key, each in value.items()}
    if isinstance(value, list):
        return [round_entry(each) for each in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def format_parameters(effect: NamedEffect) -> str:
    """Parameters with their standard deviations."""
    return ", ".join(
        f"{key} {format_value(key, value, effect.std.get(key))}" for key, value in effect.entry.items() if key != "name"
    )


def format_value(key: str, value: Any, std: float | None) -> str:
    """One value of an effect's entry: a number with its standard deviation, an axis or a table by what it spans."""
    if isinstance(value, dict):
        cycle = f", repeated every {format_number(value['period'])}" if value.get("period") else ""
        return f"{format_number(value['low'])} to {format_number(value['high'])}{cycle}"
    if isinstance(value, list):
        flat = [each for row in value for each in row]
        return f"{len(value)} x {len(value[0])} from {format_number(min(flat), 3)} to {format_number(max(flat), 3)}"
    if not isinstance(value, float):
        return str(value)
    return format_with_std(key, value, std)


def _describe_effect(effect: NamedEffect) -> str:
    if effect.kind == "empirical":
        return f"The disagreement {_describe_empirical(effect)}; it is described, not explained, by {effect.name}."
    said = f"It is {effect.name} ({format_parameters(effect)})."
    return f"{said} It looks like {', '.join(effect.alike)}; what would split them: {effect.split_by}." if effect.alike else said


def _describe_empirical(effect: NamedEffect) -> str:
    covariates = [covariate_name(effect.entry[key]) for key in ("covariate", "second") if effect.entry.get(key)]
    if covariates:
        return f"depends on {join_words(covariates)}{_describe_range(effect)}"
    lost = effect.effect.shows_in == ShowsIn.RETURNS
    return "is in the directions from which nothing returns" if lost else "is larger than the model says"


def _describe_range(effect: NamedEffect) -> str:
    """How much an empirical term of a surface differs between its places."""
    if effect.effect is not SurfaceEmpirical:
        return ""
    values = [each for row in effect.entry["values_m"] for each in row]
    return f" (over {format_number(1e3 * (max(values) - min(values)), 3)} mm from its lowest to its highest value)"


def describe_gap(found: GapDiagnosis) -> str:
    """The scores before and after, and what the model's own noise leaves; "" where they were not measured."""
    if found.gap is None:
        return ""
    gap, mended = found.gap, found.mended
    factor, unit = gap.shown
    before, after, floor = (f"{factor * value:.3f} {unit}" for value in (gap.before, gap.after, gap.floor))
    scores = f"{before} before, {after} after" if mended else f"{before} before"
    text = f"On blocks that no step has used, the gap is {scores}; the model's own noise leaves {floor}"
    return f"{text}{', so ' if gap.closed is None else ': '}{describe_closing(gap, mended)}."
