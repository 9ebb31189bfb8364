"""Score answers against truths and write the table for each sensor, with binomial 95 % intervals.

Every case that is not right is listed.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta, norm

from . import laser_effects, stereo_effects

OUTCOMES = ("alone", "class", "more", "part", "wrong name", "unknown", "no_gap", "insufficient_data", "error")
RIGHT = {"none": ("no_gap",), "change": ("no_gap",), "off": ("unknown",), "one": ("alone", "class"), "two": ("alone", "class")}
CLEAR = 12.0
_NAMING, _BLAMING = ("alone", "class", "more", "part", "wrong name"), ("wrong name", "more")
_TITLES = {"tls": "Laser scans", "stereo": "Stereo pairs"}
_ABOUT = """The generator (`benchmarks/gap_second_generator`) was written only from the descriptions of effects, measurement
folders and answers, without knowledge of the program. So it makes other assumptions than the
[first generator](gap_closed_form.md):

| part | what it makes |
|---|---|
| walls | joints, benches, overhangs and roofs |
| error of the reference | a bend, a fractal, strips or tiles |
| laser scans | gaps, shrubs, lost double echoes |
| stereo pairs | converging cameras, a matcher's noise on grids |
| strength of an effect | signal-to-noise ratio of 6 to 100, no more than a few times the catalogue's typical size |
"""
_WORDS = """| kind of measurement | what it contains |
|---|---|
| none | no effect |
| change | no effect, but rock that fell or moved |
| off | one error outside the catalogue |
| one, two | one or two effects of the catalogue |

| outcome | what the answer says |
|---|---|
| alone | the true effect, without alternatives |
| class | the true effect among those that cannot be told apart |
| more | the true effect and a wrong one |
| part | one of two true effects |
| wrong name | a wrong effect |
| unknown, no_gap, insufficient_data | this [verdict](../reference/glossary.md#model-and-measurement), and no effect |

The right answer is `no_gap` for the kinds none and change, and `unknown` for off. Alone and class are right for the kinds one
and two. Errors outside the catalogue are, for example, second_wall (echoes by way of a second wall), matcher_tiles (tiles of
the disparity raster with errors of their own) and rough_rows (more noise in some rows). In the first table of each sensor, a
row is a kind of measurement, and the columns count the outcomes; "error" means that the program gave no answer. The second
table has shares with their counts and binomial 95 % intervals. A *clear* effect has a ratio of 12 or more beside the most
similar other one, and the *reference* is the surface with which a measurement is compared.

The table of failures has the number and kind of each case that is not answered rightly. "Truth" is what the case contains.
"Ratio" is the signal-to-noise ratio of an effect, in brackets what is left of it when the most similar other effect, which is
named, is fitted too. "Answer" is the verdict and the named effects with their parameters, whose last part is the unit. "p of
what remains" is the p-value of the misfit that is left: at 0.01 and below `gap` rejects the model.
"""
LEVEL_90 = float(norm.ppf(0.95))
EDGED = ("strips", "tiles")
"""Errors of the reference with jumps along whole lines, which look like sensor errors from one station."""
EITHER_SIGN = {"tilt_drift"}  # EFFECTS.md does not say which way the tilt turns


@dataclass(frozen=True)
class Result:
    """One case: its truth, its answer, its outcome, and how many of the 90 % intervals contain the truth.

    inside, intervals: number of intervals that contain it, and of all that can be checked; outside: the other intervals, as text.
    """

    truth: dict[str, Any]
    answer: dict[str, Any]
    outcome: str
    inside: int
    intervals: int
    outside: tuple[str, ...]

    @property
    def right(self) -> bool:
        """Whether the answer is right."""
        return self.outcome in RIGHT[self.truth["kind"]]

    @property
    def clarity(self) -> float:
        """Signal-to-noise ratio of the least clear effect, after its nearest neighbour if there is one; inf without effects."""
        ratios = [each.get("apart", each["ratio"]) for each in self.truth["clear"].values()]
        return min(ratios, default=np.inf)


def scored(out: Path, name: str) -> Result:
    """Read the case `name` of the folder `out`, with its answer, and score it."""
    truth = json.loads((out / "truth" / f"{name}.json").read_text())
    said = json.loads((out / "answers" / name / "said.json").read_text())
    written = out / "answers" / name / "gap.json"
    answer: dict[str, Any] = {"verdict": "error", "effects": []}
    if said["status"] == 0 and written.exists():
        answer = json.loads(written.read_text())
    checks = [each for effect in answer["effects"] for each in intervals(truth, effect)]
    outside = tuple(text for text, inside in checks if not inside)
    return Result(truth, {**answer, "said": said}, outcome(truth, answer), len(checks) - len(outside), len(checks), outside)


def outcome(truth: dict[str, Any], answer: dict[str, Any]) -> str:
    """Return one of OUTCOMES.

    `class`: each true effect is in the class of an answer; `more`: the same, with others in addition; `part`: some of the true
    effects and nothing wrong.
    """
    if answer["verdict"] in ("error", "insufficient_data", "no_gap", "unknown"):
        return str(answer["verdict"])
    true = set(truth["effects"]) if truth["kind"] in ("one", "two") else set()
    classes = [{_short(each) for each in (effect["name"], *effect["cannot_be_told_from"])} for effect in answer["effects"]]
    idle = [each for each in classes if not each & true]
    found = true & set().union(*classes)
    if not found:
        return "wrong name"
    if idle:
        return "more"
    if found != true:
        return "part"
    return "alone" if all(len(each) == 1 for each in classes) else "class"


def _short(name: str) -> str:
    return name.split(".")[-1]


def intervals(truth: dict[str, Any], effect: dict[str, Any]) -> list[tuple[str, bool]]:
    """Return whether the 90 % intervals of a named effect contain the truth.

    There is one statement and one answer for each parameter that may be checked.
    """
    name = _short(effect["name"])
    known = {**laser_effects.CATALOGUE, **stereo_effects.CATALOGUE}.get(name)
    true, said = truth["effects"].get(name), effect["parameters"]
    if known is None or true is None or said.get("camera", {}).get("value") != true.get("camera"):
        return []
    return [_interval(name, key, true, said[key]) for key in known.scored if key in said and said[key].get("std")]


def _interval(name: str, key: str, true: dict[str, Any], said: dict[str, float]) -> tuple[str, bool]:
    signs = (1, -1) if name in EITHER_SIGN else (1,)
    inside = any(abs(said["value"] - sign * true[key]) <= LEVEL_90 * said["std"] for sign in signs)
    return f"{name}.{key} {true[key]:.4g}, said {said['value']:.4g} ± {said['std']:.2g}", inside


def share(count: int, total: int) -> str:
    """Format `count / total (percentage; 95 % Clopper-Pearson interval)`."""
    if not total:
        return "-"
    low = beta.ppf(0.025, count, total - count + 1) if count else 0.0
    high = beta.ppf(0.975, count + 1, total - count) if count < total else 1.0
    return f"{count}/{total} ({100 * count / total:.0f} %; {100 * low:.0f}-{100 * high:.0f})"


def table(results: list[Result], command: str, commit: str) -> str:
    """Return Markdown: for each sensor the outcomes by kind, the rates, and the cases that are not right.

    command, commit: the command that made it, and the program's commit.
    """
    made_by = f"Made by `{command}`, commit {commit}."
    text = f"# Measurements of a second generator\n\n{_in_short(results)}\n{_ABOUT}\n{made_by}\n\n{_WORDS}"
    for sensor in ("tls", "stereo"):
        mine = [each for each in results if each.truth["sensor"] == sensor]
        if mine:
            text += (
                f"\n## {_TITLES[sensor]}\n\n{_outcomes(mine)}\n{_rates(mine)}\n### Failures of the {_TITLES[sensor].lower()}\n\n"
            )
            text += _not_right(mine)
    return text


def _in_short(results: list[Result]) -> str:
    """What was evaluated, and what it comes to."""
    clear = [each for each in results if each.truth["kind"] in ("one", "two") and each.clarity >= CLEAR]
    quiet = [each for each in results if each.truth["kind"] == "none"]
    spoke = [each for each in results if each.outcome in _NAMING]
    wrong = [each for each in spoke if each.outcome in _BLAMING]
    moved = [each for each in results if each.truth["kind"] == "change"]
    right = sum(each.right for each in clear)
    rejected, blamed = (sum(map(_alarmed, group)) for group in (quiet, moved))
    return f"""This page shows how `scarpsim gap` does on {len(results)} simulated measurements of a generator that does not share
the program's assumptions. It is for users who want to know how far the results of one generator carry over to other data.

- {right} of {len(clear)} clear effects are answered rightly: their signal-to-noise ratio is at least {CLEAR:.0f} beside the most
  similar other effect.
- {len(wrong)} of {len(spoke)} answers that name an effect contain a wrong name.
- {rejected} of {len(quiet)} measurements without an effect are not answered with `no_gap`, and {_named(quiet)} of them
  name an effect.
- {blamed} of {len(moved)} measurements in which only rock fell are not answered with `no_gap`.
"""


def _named(results: list[Result]) -> int:
    return sum(each.outcome in _NAMING for each in results)


def _outcomes(results: list[Result]) -> str:
    rows = ["| kind | " + " | ".join(OUTCOMES) + " | right |", "|" + "---|" * (len(OUTCOMES) + 2)]
    for kind in RIGHT:
        mine = [each for each in results if each.truth["kind"] == kind]
        counts = [str(sum(each.outcome == one for each in mine)) for one in OUTCOMES]
        rows.append(f"| {kind} | " + " | ".join(counts) + f" | {share(sum(each.right for each in mine), len(mine))} |")
    return "\n".join(rows) + "\n"


def _rates(results: list[Result]) -> str:
    """Return those figures of GAP.md that this generator can give."""
    clear = [each for each in results if each.truth["kind"] in ("one", "two") and each.clarity >= CLEAR]
    quiet = [each for each in results if each.truth["kind"] == "none"]
    moved = [each for each in results if each.truth["kind"] == "change"]
    spoke = [each for each in results if each.outcome in _NAMING]
    p = [each.answer["remaining"]["p_value"] for each in quiet if each.answer.get("remaining", {}).get("p_value") is not None]
    inside, checked = sum(each.inside for each in results), sum(each.intervals for each in results)
    jumping, even = ([each for each in quiet if (each.truth["error"]["kind"] in EDGED) is edged] for edged in (True, False))
    rows = {
        f"clear effects (ratio of {CLEAR:.0f} or more beside the most similar other) that are answered rightly": _count(
            clear, lambda each: each.right
        ),
        "false alarms without an effect": _count(quiet, _alarmed),
        "the same, if the reference is wrong in strips or tiles": _count(jumping, _alarmed),
        "the same, if the reference is wrong by a bend or a fractal": _count(even, _alarmed),
        "false alarms where only rock fell": _count(moved, _alarmed),
        "wrong names among answers that name": _count(spoke, lambda each: each.outcome in _BLAMING),
        "90 % intervals that contain the truth": share(inside, checked),
        "p-values of what remains below 0.01, without an effect": share(sum(each < 0.01 for each in p), len(p)),
        "median time of a diagnosis, s": f"{np.median([each.answer['said']['seconds'] for each in results]):.0f}",
    }
    return "| what | share (95 % interval), or value |\n|---|---|\n" + "".join(
        f"| {key} | {value} |\n" for key, value in rows.items()
    )


def _alarmed(result: Result) -> bool:
    return result.outcome not in ("no_gap", "insufficient_data")


def _count(results: list[Result], wanted: Callable[[Result], bool]) -> str:
    return share(sum(wanted(each) for each in results), len(results))


def _not_right(results: list[Result]) -> str:
    rows = ["| case | truth | ratio (apart from) | outcome | answer | p of what remains |", "|---|---|---|---|---|---|"]
    for each in results:
        if not each.right or each.outside:
            named = "; ".join(_said(effect) for effect in each.answer["effects"]) or "nothing named"
            outside = f" outside: {'; '.join(each.outside)}" if each.outside else ""
            p = each.answer.get("remaining", {}).get("p_value")
            case = f"{each.truth['number']:04d} {each.truth['kind']}"
            cells = [case, _true(each.truth), _clear(each.truth), each.outcome + outside]
            rows.append("| " + " | ".join([*cells, f"{each.answer['verdict']}: {named}", str(p)]) + " |")
    return "\n".join(rows) + "\n"


def _true(truth: dict[str, Any]) -> str:
    effects = [f"{name} {_numbers(given)}" for name, given in truth["effects"].items()]
    return "; ".join(effects) or f"{len(truth['changes'])} changes"


def _numbers(given: dict[str, Any]) -> str:
    return ", ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in given.items())


def _clear(truth: dict[str, Any]) -> str:
    texts = [
        f"{each['ratio']:.0f}" + (f" ({each['apart']:.0f} from {each['nearest']})" if "apart" in each else "")
        for each in truth["clear"].values()
    ]
    return "; ".join(texts)


def _said(effect: dict[str, Any]) -> str:
    besides = [_short(each) for each in effect["cannot_be_told_from"]]
    given = {key: each["value"] for key, each in effect["parameters"].items() if isinstance(each["value"], float | str)}
    return f"{_short(effect['name'])} {_numbers(given)}" + (f" (or {', '.join(besides)})" if besides else "")
