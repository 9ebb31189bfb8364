"""A diagnosis in plain words: the paragraph at the top of the report, and what became of each explanation that was tried."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipeline.gap.mean.selection import FamilyScore
from pipeline.gap.naming.entries import Named
from pipeline.gap.naming.verdict import VERDICTS, closing, in_a_sentence, left_over
from pipeline.gap.naming.workflow import GapDiagnosis
from pipeline.gap.other.spread import SpreadTried
from pipeline.gap.report.quantities import with_std
from pipeline.gap.report.scale import scale_of
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals
from pipeline.report.page import true_minus
from sensors.effects.base import ShowsIn
from sensors.effects.surface_empirical import SurfaceEmpirical

_STATISTICS = {"mean": "mean", "spread": "spread", "shape": "outliers", "missing": "lost returns"}
_WITHOUT_NAMES = {
    VERDICTS["no_gap"]: "The cloud agrees with the reference: what is left is as large as its noise.",
    VERDICTS["unknown"]: "The cloud departs from the reference by more than its noise; an empirical term describes how.",
}
"""Sentences of verdicts where no effect of the catalogue can be tried."""
_CLEAR = 0.01
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
                return f"{listed(names)} closes little of the gap: something else is missing"
            if found.evidence.supports_nothing:
                return f"{listed(names)} does not make the gap smaller: something else may be missing"
            if found.evidence.stays_rejected:
                return f"{listed(names)} leaves more than chance would: something else is missing"
            return f"{listed(names)}, and something that makes the residuals spread"
        case "unknown" if isinstance(found.residuals, SurfaceResiduals):
            return "The cloud departs from the reference by more than its noise"
        case "unknown":
            return "Missing: something that is not in the catalogue" + (f", and {listed(names)}" if names else "")
        case _:
            return f"Missing: {listed(names)}"


def paragraph(found: GapDiagnosis, rows: list[dict[str, Any]]) -> str:
    """What was compared, what was found, how far the gap closes. rows: as `where` gives them."""
    return " ".join(each for each in (*_findings(found, rows), gap_in_words(found), *_asides(found)) if each)


def answer(found: GapDiagnosis, rows: list[dict[str, Any]]) -> str:
    """The same for a reader who wants to know what is the matter: scores stand elsewhere."""
    return " ".join(each for each in (*_findings(found, rows), _closed(found), *_asides(found)) if each)


def sentence(found: GapDiagnosis) -> str:
    """The verdict in words; of a surface without cameras, of which no effect of the catalogue can be tried, in its own."""
    said = in_a_sentence(found.verdict, found.effects, found.evidence)
    return _WITHOUT_NAMES.get(said, said) if isinstance(found.residuals, SurfaceResiduals) else said


def _findings(found: GapDiagnosis, rows: list[dict[str, Any]]) -> list[str]:
    parts = [f"{len(found.residuals):,} {found.residuals.label} were compared with what the model predicts."]
    parts.append(sentence(found))
    scale = scale_of(found)
    parts += [] if scale is None else [scale.words]
    parts += [_effect(effect) for effect in found.effects]
    return [*parts, left_over(found.effects, found.evidence), _shown_most(found, rows)]


def _closed(found: GapDiagnosis) -> str:
    """How much of the gap closes, where something was named; the scores are evidence."""
    if found.gap is None or found.gap.closed is None or not found.mended:
        return ""
    return f"With it in the model {closing(found.gap, found.mended)}, on rock that no step had used."


def _asides(found: GapDiagnosis) -> list[str]:
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


def _shown_most(found: GapDiagnosis, rows: list[dict[str, Any]]) -> str:
    """Where the disagreement is; where nothing describes it, also how large it is there."""
    if found.verdict in ("no_gap", "insufficient_data") or not rows:
        return ""
    clear = [row for row in rows if row["p_value"] <= _CLEAR]
    first = (clear or rows)[0]
    statistic = _STATISTICS[first["statistic"]]
    if not found.effects:
        what = in_words(first["covariate"])
        region = " to ".join(number(first["region"][key]) for key in ("from", "to"))
        size = f"{number(1e3 * abs(first['size_m']), 2)} mm"
        size = f"{100 * first['share_lost']:.0f} % lost" if first["statistic"] == "missing" else size
        return f"It shows most in the {statistic} against {what}, from {region}: {size} there."
    if not clear:
        return ""
    seen = [in_words(row["covariate"]) for row in clear[:3] if row["statistic"] == first["statistic"]]
    return f"Before anything was named it showed most in the {statistic} against {listed(seen)}."


def outcome(found: GapDiagnosis, tried: Sequence[FamilyScore], item: FamilyScore) -> str:
    """What became of one of the explanations `tried`, best first: named, in the class of a named one, or rejected."""
    if item.empirical:
        added = {effect.entry.get("covariate") for effect in found.effects if effect.kind == "empirical"}
        best = next(each for each in tried if each.empirical and each.name == item.name)
        return "added as empirical" if item is best and item.name in added else "rejected"
    return _outcome_of(found, item.name)


def spread_outcome(found: GapDiagnosis, item: SpreadTried) -> str:
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


def listed(words: Sequence[str]) -> str:
    """a, b and c."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def with_unit(covariate: str, sensor: str) -> str:
    """A covariate as a report shows it, with the unit of its values."""
    _, unit = _COVARIATES.get(covariate, ("", ""))
    return f"{in_words(covariate)}, {unit or ('m' if sensor == 'tls' else 'px')}"


def in_words(covariate: str) -> str:
    """A covariate as a sentence has it."""
    return _COVARIATES[covariate][0] if covariate in _COVARIATES else covariate.replace("_", " ")


def number(value: float, digits: int = 4) -> str:
    """With at most so many significant digits, written out below a million and above a ten-thousandth."""
    return f"{float(f'{value:.{digits}g}'):g}"


def decimal(value: float) -> str:
    """With one decimal, without any from ten thousand on."""
    return true_minus(value, 1) if abs(value) < 9999.95 else number(value, 5)


def rounded(value: Any) -> Any:
    """A value of an effect's entry with at most five significant digits in each number."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def values(effect: Named) -> str:
    """Parameters with their standard deviations."""
    return ", ".join(f"{key} {shown(key, value, effect.std.get(key))}" for key, value in effect.entry.items() if key != "name")


def shown(key: str, value: Any, std: float | None) -> str:
    """One value of an effect's entry: a number with its standard deviation, an axis or a table by what it spans."""
    if isinstance(value, dict):
        cycle = f", repeated every {number(value['period'])}" if value.get("period") else ""
        return f"{number(value['low'])} to {number(value['high'])}{cycle}"
    if isinstance(value, list):
        flat = [each for row in value for each in row]
        return f"{len(value)} x {len(value[0])} from {number(min(flat), 3)} to {number(max(flat), 3)}"
    if not isinstance(value, float):
        return str(value)
    return with_std(key, value, std)


def _effect(effect: Named) -> str:
    if effect.kind == "empirical":
        return f"The disagreement {_described(effect)}; it is described, not explained, by {effect.name}."
    said = f"It is {effect.name} ({values(effect)})."
    return f"{said} It looks like {', '.join(effect.alike)}; what would split them: {effect.split_by}." if effect.alike else said


def _described(effect: Named) -> str:
    covariates = [in_words(effect.entry[key]) for key in ("covariate", "second") if effect.entry.get(key)]
    if covariates:
        return f"depends on {listed(covariates)}{_span(effect)}"
    lost = effect.effect.shows_in == ShowsIn.RETURNS
    return "is in the directions from which nothing returns" if lost else "is larger than the model says"


def _span(effect: Named) -> str:
    """How much an empirical term of a surface differs between its places."""
    if effect.effect is not SurfaceEmpirical:
        return ""
    values = [each for row in effect.entry["values_m"] for each in row]
    return f" (over {number(1e3 * (max(values) - min(values)), 3)} mm from its lowest to its highest value)"


def gap_in_words(found: GapDiagnosis) -> str:
    """The scores before and after, and what the model's own noise leaves; "" where they were not measured."""
    if found.gap is None:
        return ""
    gap, mended = found.gap, found.mended
    factor, unit = gap.shown
    before, after, floor = (f"{factor * value:.3f} {unit}" for value in (gap.before, gap.after, gap.floor))
    scores = f"{before} before, {after} after" if mended else f"{before} before"
    text = f"On blocks that no step has used, the gap is {scores}; the model's own noise leaves {floor}"
    return f"{text}{', so ' if gap.closed is None else ': '}{closing(gap, mended)}."
