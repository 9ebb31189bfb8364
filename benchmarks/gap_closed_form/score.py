"""Score answers against truths: the figures of GAP.md's table, confusion, detection curves, coverage, control and baselines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import pairwise
from statistics import median
from typing import Any

import numpy as np

Json = dict[str, Any]
CLEAR = 8.0
"""Signal-to-noise ratio x sin(angle to the nearest other effect) from which an answer should be right."""
_ALONE = 0.05
"""Largest share of an effect's square that another may explain for the effect to be unlike all others."""
_Z90 = 1.6449
_BINS = (0.0, 2.0, 4.0, 6.0, 8.0, 12.0, 20.0, 40.0, np.inf)
_NAMING = ("named", "several", "ambiguous", "unknown")


def score(pairs: list[tuple[Json, Json]]) -> Json:
    """Score pairs of truth and answer."""
    rows = [_row(truth, answer) for truth, answer in pairs]
    return {
        "figures": _figures(rows),
        "by_sensor": {sensor: _figures([row for row in rows if row["sensor"] == sensor]) for sensor in ("tls", "stereo")},
        "confusion": _confusion(rows),
        "by_effect": _by_effect(rows),
        "detection": {sensor: _curve([row for row in rows if row["sensor"] == sensor]) for sensor in ("tls", "stereo")},
        "coverage": _coverage(rows),
        "baselines": {name: _baseline(rows, name) for name in ("largest_z", "plain_bic")},
        "seconds": _seconds(rows),
        "failures": [_failure(row) for row in rows if row["wrong"]],
        "rows": rows,
    }


def _row(truth: Json, answer: Json) -> Json:
    """Compare one answer with its truth, and list what is wrong with it."""
    said = answer.get("effects", [])
    named = [
        {"name": _bare(e["name"]), "class": [_bare(e["name"]), *map(_bare, e["cannot_be_told_from"])]}
        for e in said
        if e["kind"] == "physical"
    ]
    true = truth["effects"] if truth["stratum"] != "off" else []
    names = {effect["name"] for effect in true}
    row: Json = {
        "case": truth["number"],
        "sensor": truth["sensor"],
        "stratum": truth["stratum"],
        "points": truth["points"],
        "fields": truth["fields"],
        "known": truth["known"],
        "true": truth["effects"],
        "verdict": answer.get("verdict", "error"),
        "error": answer.get("error", ""),
        "named": named,
        "empirical": any(effect["kind"] == "empirical" for effect in said),
        "hits": [any(effect["name"] in each["class"] for each in named) for effect in true],
        "wrong_names": [each["name"] for each in named if not names & set(each["class"])],
        "falls": len(truth["changes"]),
        "falls_found": len(answer.get("scene_changes", [])),
        "gap": answer.get("gap", {}),
        "wall_s": answer.get("wall_s"),
        "baselines": truth["baselines"],
        "intervals": _intervals(true, said),
        "control": _control(truth, named),
    }
    row["wrong"] = _what_is_wrong(row)
    return row


def _bare(name: str) -> str:
    return name.partition(".")[2] or name


def _clear(effect: Json) -> bool:
    return bool(effect["snr_sin_angle"] >= CLEAR)


def _what_is_wrong(row: Json) -> str:
    if row["verdict"] == "error":
        return "no answer"
    if row["stratum"] in ("none", "change"):
        return "false alarm" if row["verdict"] in _NAMING else ""
    if row["wrong_names"]:
        return "wrong name"
    clear = [_clear(effect) for effect in row["true"]]
    if row["stratum"] == "off":
        return "not answered unknown" if clear[0] and row["verdict"] != "unknown" else ""
    if any(is_clear and not hit for is_clear, hit in zip(clear, row["hits"], strict=True)):
        return "missed"
    return "called unknown" if row["empirical"] else ""


def _intervals(true: list[Json], said: list[Json]) -> list[Json]:
    """Return the parameters of effects that are named by their own name: value, standard deviation, truth."""
    found = []
    for effect in true:
        for each in said:
            if _bare(each["name"]) == effect["name"] and each["kind"] == "physical":
                same_side = _value(each, "camera") in (None, effect["parameters"].get("camera"))
                found += [
                    {
                        "effect": effect["name"],
                        "parameter": key,
                        "same_camera": same_side,
                        **_off(key, value, each["parameters"].get(key)),
                    }
                    for key, value in effect["parameters"].items()
                    if not isinstance(value, str)
                ]
    return found


def _value(effect: Json, key: str) -> Any:
    return effect["parameters"].get(key, {}).get("value")


def _off(key: str, truth: float, given: Json | None) -> Json:
    if given is None or given.get("std") is None or isinstance(given["value"], str):
        return {"true": truth, "value": None if given is None else given["value"], "std": None, "inside": None}
    away = given["value"] - truth
    if key == "phase_rad":
        away = float(np.angle(np.exp(1j * away)))
    return {"true": truth, "value": given["value"], "std": given["std"], "inside": bool(abs(away) <= _Z90 * given["std"])}


def _control(truth: Json, named: list[Json]) -> Json | None:
    """Return the share of the gap on validation blocks that the best wrong effect closes, if one clear mean effect was named.

    The wrong effect is outside of the answered class and best by its fit. Also returned is the share of the signature's square
    that the angle to the nearest other effect leaves to that one, 1 - sin^2.
    """
    if truth["stratum"] != "one" or not truth["closed_by"] or not named or not _clear(truth["effects"][0]):
        return None
    true = truth["effects"][0]
    inside = {true["name"], *true.get("alike", ()), *(name for each in named for name in each["class"])}
    outside = [shares for name, shares in truth["closed_by"].items() if name not in inside]
    if not outside:
        return None
    sine = true["snr_sin_angle"] / true["snr"]
    return {
        "closed": max(max(outside, key=lambda shares: shares["fitted"])["held_out"], 0.0),
        "by_angle": 1 - min(sine, 1.0) ** 2,
    }


def _figures(rows: list[Json]) -> list[Json]:
    """Return the rows of GAP.md's table."""
    of = {stratum: [row for row in rows if row["stratum"] == stratum] for stratum in ("none", "one", "two", "off", "change")}
    clear_one = [row for row in of["one"] if _clear(row["true"][0])]
    clear_two = [row for row in of["two"] if all(_clear(effect) for effect in row["true"])]
    clear_off = [row for row in of["off"] if _clear(row["true"][0])]
    committed = [row for row in rows if row["named"]]
    committed_one = [row for row in of["one"] if row["named"]]
    sizes = [len(each["class"]) for row in committed for each in row["named"]]
    intervals = _insides(rows)
    complete = _insides(row for row in rows if all(row["hits"]))
    right = [row for row in (*of["one"], *of["two"]) if all(row["hits"]) and not row["empirical"]]
    closed = [row["gap"]["closed"] for row in right if row["gap"].get("closed") is not None]
    pooled = _pooled(row["gap"] for row in right)
    control = [row["control"] for row in rows if row["control"] is not None]
    alone = [each["closed"] for each in control if each["by_angle"] <= _ALONE]
    return [
        _share("false alarms on no-effect cases", of["none"], lambda row: row["verdict"] in _NAMING, "at most 1 %", (0.0, 0.01)),
        _share(
            f"right class at S/N x sin(angle) of {CLEAR:.0f} or more", clear_one, lambda row: row["hits"][0], "95 %", (0.95, 1.0)
        ),
        _share(
            "wrong names among committed answers", committed, lambda row: bool(row["wrong_names"]), "at most 2 %", (0.0, 0.02)
        ),
        _share("the class contains the truth", committed_one, lambda row: row["hits"][0], "93-97 %", (0.93, 0.97)),
        _number("median size of the class", sizes, median, "at most 2", (0.0, 2.0)),
        _share("off-catalogue effects answered unknown", clear_off, lambda row: row["verdict"] == "unknown", "90 %", (0.9, 1.0)),
        _share(
            "real change blamed on the sensor", of["change"], lambda row: row["verdict"] in _NAMING, "at most 5 %", (0.0, 0.05)
        ),
        _share("90 % intervals that contain the true parameter", intervals, bool, "86-94 %", (0.86, 0.94)),
        _share("the same, where every true effect was named", complete, bool, "86-94 %", (0.86, 0.94)),
        _number("gap closed on held-out data, effects named (median)", closed, median, "95 %", (0.95, np.inf)),
        _number(
            "gap closed, all cases' metres summed", [pooled] if pooled is not None else [], median, "(shown beside it)", None
        ),
        _number(
            "gap closed by the best wrong effect outside the class (median)",
            [each["closed"] for each in control],
            median,
            "at most 5 %",
            (0.0, 0.05),
        ),
        _number(
            "the same, as the angle to the nearest other effect lets it (1 - sin^2, median)",
            [each["by_angle"] for each in control],
            median,
            "",
            None,
        ),
        _number("the same, where that angle leaves it 5 % at most", alone, median, "at most 5 %", (0.0, 0.05)),
        _share("two effects at once, both classes right", clear_two, lambda row: all(row["hits"]), "85 %", (0.85, 1.0)),
        _share(
            "rightly named, but the gap is within its uncertainty", right, lambda row: row["gap"].get("closed") is None, "", None
        ),
        _share("cases without an answer", rows, lambda row: row["verdict"] == "error", "none", (0.0, 0.0)),
    ]


def _insides(rows: Iterable[Json]) -> list[bool]:
    """Return, for each interval of a named effect of the right camera, whether it contains the truth."""
    return [each["inside"] for row in rows for each in row["intervals"] if each["same_camera"] and each["inside"] is not None]


def _pooled(gaps: Any) -> float | None:
    known = [gap for gap in gaps if gap and gap.get("before") is not None and gap.get("closed") is not None]
    gained, open_before = (sum(gap["before"] - gap[key] for gap in known) for key in ("after", "floor"))
    return gained / open_before if open_before > 0 else None


def wilson(successes: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson 1927)."""
    if count == 0:
        return 0.0, 1.0
    z, p = 1.96, successes / count
    middle, half = p + z * z / (2 * count), z * float(np.sqrt(p * (1 - p) / count + z * z / (4 * count * count)))
    return max(middle - half, 0.0) / (1 + z * z / count), (middle + half) / (1 + z * z / count)


def _share(what: str, of: list[Any], hit: Any, goal: str, limits: tuple[float, float] | None) -> Json:
    """Return a row of the table; it is undecided if its 95 % interval does not settle it."""
    count, successes = len(of), sum(bool(hit(item)) for item in of)
    value = successes / count if count else None
    low, high = wilson(successes, count)
    return {
        "what": what, "goal": goal, "value": value, "successes": successes, "count": count, "interval": [low, high],
        "reached": None if value is None or limits is None else _settled(low, high, successes, limits),
    }  # fmt: skip


def _settled(low: float, high: float, successes: int, limits: tuple[float, float]) -> str:
    """Return whether all of an interval is within the limits, none of it, or neither; equal limits are decided by the count."""
    if limits == (0.0, 0.0):
        return "no" if successes else "yes"
    if limits[0] <= low and high <= limits[1]:
        return "yes"
    return "no" if high < limits[0] or low > limits[1] else "undecided"


def _number(what: str, values: list[float], statistic: Any, goal: str, limits: tuple[float, float] | None) -> Json:
    value = float(statistic(values)) if values else None
    reached = None if value is None or limits is None else ("yes" if limits[0] <= value <= limits[1] else "no")
    return {"what": what, "goal": goal, "value": value, "count": len(values), "reached": reached, "percent": "size" not in what}


def answer_of(row: Json, hit: bool) -> str:
    """Return the column of the confusion matrix of an effect's case."""
    if row["verdict"] in ("error", "insufficient_data"):
        return row["verdict"]
    if hit:
        return "right, alone" if all(len(each["class"]) == 1 for each in row["named"]) else "right, in a class"
    if row["wrong_names"]:
        return "wrong name"
    if row["empirical"]:
        return "unknown"
    return "other effect only" if row["named"] else "no_gap"


def _confusion(rows: list[Json]) -> Json:
    """Count answers by truth (name or stratum); a class gives its members in order of likelihood."""
    found: dict[str, Counter[str]] = {}
    for row in rows:
        said = " + ".join(" ~ ".join(each["class"]) for each in row["named"])
        said = " + ".join(part for part in (said, "unknown" if row["empirical"] else "") if part) or row["verdict"]
        truth = " + ".join(effect["name"] for effect in row["true"]) or row["stratum"]
        found.setdefault(f"{row['sensor']}: {truth}", Counter())[said] += 1
    return {truth: dict(counts) for truth, counts in sorted(found.items())}


def _by_effect(rows: list[Json]) -> Json:
    """Count the kinds of answers by true effect or stratum."""
    found: dict[str, Counter[str]] = {}
    for row in rows:
        if row["stratum"] in ("none", "change", "off"):
            key = f"{row['sensor']}.({row['stratum']}{' ' + row['true'][0]['name'] if row['true'] else ''})"
            found.setdefault(key, Counter())[answer_of(row, False)] += 1
        else:
            for effect, hit in zip(row["true"], row["hits"], strict=True):
                clear = "clear" if _clear(effect) else "weak"
                found.setdefault(f"{row['sensor']}.{effect['name']}", Counter())[f"{clear}: {answer_of(row, hit)}"] += 1
    return {key: dict(counts) for key, counts in sorted(found.items())}


def _curve(rows: list[Json]) -> list[Json]:
    """Return, by bins, the share of single effects for which anything was found (by S/N), and the right class (by S/N x sin)."""
    single = [row for row in rows if row["stratum"] == "one"]
    found = []
    for low, high in pairwise(_BINS):
        by_snr = [row for row in single if low <= row["true"][0]["snr"] < high]
        by_angle = [row for row in single if low <= row["true"][0]["snr_sin_angle"] < high]
        found.append(
            {
                "from": low,
                "to": high if np.isfinite(high) else None,
                "cases": len(by_snr),
                "detected": sum(bool(row["named"]) or row["empirical"] for row in by_snr),
                "cases_by_angle": len(by_angle),
                "right": sum(row["hits"][0] for row in by_angle),
            }
        )
    return found


def _coverage(rows: list[Json]) -> Json:
    """Return, for each parameter, how many of its 90 % intervals contain the truth."""
    found: dict[str, list[bool]] = {}
    for row in rows:
        for each in row["intervals"]:
            if each["inside"] is not None and each["same_camera"]:
                found.setdefault(f"{row['sensor']}.{each['effect']}.{each['parameter']}", []).append(each["inside"])
    return {key: {"inside": sum(values), "count": len(values)} for key, values in sorted(found.items())}


def _baseline(rows: list[Json], name: str) -> Json:
    """Score a baseline, which gives one name or none, in the same way."""
    quiet = [row for row in rows if row["stratum"] in ("none",)]
    change = [row for row in rows if row["stratum"] == "change"]
    clear = [row for row in rows if row["stratum"] == "one" and _clear(row["true"][0])]
    committed = [row for row in rows if row["baselines"][name]]
    truths = [{effect["name"] for effect in row["true"]} for row in committed]
    wrong = sum(row["baselines"][name] not in names for row, names in zip(committed, truths, strict=True))
    return {
        "false_alarms": [sum(bool(row["baselines"][name]) for row in quiet), len(quiet)],
        "change_blamed": [sum(bool(row["baselines"][name]) for row in change), len(change)],
        "right": [sum(row["baselines"][name] == row["true"][0]["name"] for row in clear), len(clear)],
        "wrong_names": [wrong, len(committed)],
    }


def _seconds(rows: list[Json]) -> Json:
    known = sorted(row["wall_s"] for row in rows if row["wall_s"] is not None)
    return {"median": median(known), "longest": known[-1], "total": sum(known)} if known else {}


def _failure(row: Json) -> Json:
    true = [
        f"{e['name']} (S/N {e['snr']:.1f}, x sin {e['snr_sin_angle']:.1f}, nearest {e['nearest'] or '-'})" for e in row["true"]
    ]
    said = [" ~ ".join(each["class"]) for each in row["named"]] + (["empirical"] if row["empirical"] else [])
    return {
        "case": row["case"], "sensor": row["sensor"], "stratum": row["stratum"], "wrong": row["wrong"], "true": true,
        "verdict": row["verdict"], "said": said, "error": row["error"][-300:], "falls": row["falls"], "fields": row["fields"],
    }  # fmt: skip
