"""A diagnosis in plain words: the paragraph at the top of the report, and what became of each explanation that was tried."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipeline.gap.entries import SPREADS, Named
from pipeline.gap.missing import LOSSES
from pipeline.gap.selection import Tried
from pipeline.gap.spread import SpreadTried
from pipeline.gap.verify import Gap
from pipeline.gap.workflow import Diagnosis
from pipeline.report.page import percent, true_minus

VERDICTS = {
    "no_gap": "The measurement agrees with the model: nothing was found that the model does not hold.",
    "named": "One effect explains where measurement and model disagree.",
    "several": "More than one effect is needed to explain where measurement and model disagree.",
    "ambiguous": "An effect is there, but this measurement cannot tell it from others that would look the same.",
    "unknown": "The model is rejected, and no effect of the catalogue passes its own test; an empirical term describes it.",
    "insufficient_data": "There are too few points on smooth parts of the reference to say anything.",
}
_INSTRUMENTS = {"tls": "ranges of a laser scan", "stereo": "disparities of a stereo pair"}
_STATISTICS = {"mean": "mean", "spread": "spread", "shape": "outliers", "missing": "lost returns"}
_CLEAR = 0.01
_UNITS = {
    "range": "m", "depth": "m", "azimuth": "rad", "zenith": "rad", "incidence": "rad", "image_x": "px",
    "image_y": "px", "radius": "px", "disparity": "px", "intensity": "ln of power over its median", "line": "number",
    "time": "share of the scan", "disparity_fraction": "px", "log_power": "ln of relative power",
}  # fmt: skip


def title(found: Diagnosis) -> str:
    """The outcome in a few words."""
    names = [" or ".join([effect.name, *effect.alike]) for effect in found.effects if effect.kind == "physical"]
    match found.verdict:
        case "no_gap":
            return "No effect is missing"
        case "insufficient_data":
            return "Too few data to say what is missing"
        case "unknown":
            return "Missing: something that is not in the catalogue" + (f", and {listed(names)}" if names else "")
        case _:
            return f"Missing: {listed(names)}"


def paragraph(found: Diagnosis, rows: list[dict[str, Any]]) -> str:
    """What was compared, what was found, how far the gap closes. rows: as `where` gives them."""
    parts = [f"{len(found.residuals):,} {_INSTRUMENTS[found.residuals.sensor]} were compared with what the model predicts."]
    parts.append(VERDICTS[found.verdict])
    parts += [_effect(effect) for effect in found.effects]
    clear = [row for row in rows if row["p_value"] <= _CLEAR]
    if clear and found.effects:
        first = clear[0]["statistic"]
        seen = [row["covariate"].replace("_", " ") for row in clear[:3] if row["statistic"] == first]
        parts.append(f"Before anything was named it showed most in the {_STATISTICS[first]} against {listed(seen)}.")
    if found.gap is not None:
        parts.append(_gap(found.gap, bool(found.effects)))
    if found.changes:
        volume = sum(abs(change.volume_m3) for change in found.changes)
        regions = "1 region" if len(found.changes) == 1 else f"{len(found.changes)} regions"
        parts.append(f"{regions} where the rock itself moved ({volume:.2g} m\N{SUPERSCRIPT THREE} in all) were set aside.")
    if found.remaining.get("note"):
        parts.append(f"Note: {found.remaining['note']}.")
    return " ".join(parts)


def outcome(found: Diagnosis, tried: Sequence[Tried], item: Tried) -> str:
    """What became of one of the explanations `tried`, best first: named, in the class of a named one, or rejected."""
    if item.empirical:
        added = {effect.entry.get("covariate") for effect in found.effects if effect.kind == "empirical"}
        best = next(each for each in tried if each.empirical and each.name == item.name)
        return "added as empirical" if item is best and item.name in added else "rejected"
    return _outcome_of(found, item.name)


def spread_outcome(found: Diagnosis, item: SpreadTried) -> str:
    """What became of one of the explanations of the spread."""
    if item.empirical:
        added = any(effect.kind == "empirical" and effect.name.partition(".")[2] in SPREADS for effect in found.effects)
        return "added as empirical" if added else "rejected"
    return _outcome_of(found, item.name)


def _outcome_of(found: Diagnosis, effect: str) -> str:
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
    return f"{covariate}, {_UNITS.get(covariate, 'm' if sensor == 'tls' else 'px')}"


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
    return ", ".join(_value(key, value, effect.std.get(key)) for key, value in effect.entry.items() if key != "name")


def _value(key: str, value: Any, std: float | None) -> str:
    if isinstance(value, dict):
        cycle = f", repeated every {number(value['period'])}" if value.get("period") else ""
        return f"{key} {number(value['low'])} to {number(value['high'])}{cycle}"
    if isinstance(value, list):
        flat = [each for row in value for each in row]
        return f"{key} {len(value)} x {len(value[0])} from {number(min(flat), 3)} to {number(max(flat), 3)}"
    if not isinstance(value, float):
        return f"{key} {value}"
    return f"{key} {number(value)}" + ("" if not std else f" \N{PLUS-MINUS SIGN} {std:.1g}")


def _effect(effect: Named) -> str:
    if effect.kind == "empirical":
        return f"The disagreement {_described(effect)}; it is described, not explained, by {effect.name}."
    said = f"It is {effect.name} ({values(effect)})."
    return f"{said} It looks like {', '.join(effect.alike)}; what would split them: {effect.split_by}." if effect.alike else said


def _described(effect: Named) -> str:
    covariates = [effect.entry[key] for key in ("covariate", "second") if effect.entry.get(key)]
    if covariates:
        return f"depends on {listed(covariates)}"
    lost = effect.name.partition(".")[2] in LOSSES
    return "is in the directions from which nothing returns" if lost else "is larger than the model says"


def _gap(gap: Gap, named: bool) -> str:
    factor, unit = gap.shown
    before, after, floor = (f"{factor * value:.3f} {unit}" for value in (gap.before, gap.after, gap.floor))
    scores = f"{before} before, {after} after" if named else f"{before} before"
    text = f"On blocks that no step has used, the gap is {scores}; the model's own noise leaves {floor}"
    if gap.closed is None:
        return f"{text}, so before and floor differ by no more than their uncertainty."
    return f"{text}: {percent(gap.closed, 0)} of the gap is closed."
