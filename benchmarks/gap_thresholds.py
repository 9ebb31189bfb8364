"""Measure the effect of each threshold of the diagnosis when it is 0.7 and 1.4 times as large, on development cases.

    python benchmarks/gap_thresholds.py --cases 24 --seed 3100 --out /tmp/thresholds --table docs/validation/gap_thresholds.md

The first diagnosis of a case also carries each threshold's other values (benchmarks/varied.py) and records which of them would
change a decision; only with those is it diagnosed again. An interrupted run continues. `--minutes` ends it with the table so far;
`--all` also repeats the diagnosis with values that change no decision, and fails if one does.
"""

from __future__ import annotations

import argparse
import functools
import json
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from benchmarks.gap_closed_form.cases import Case, make, plan
from benchmarks.gap_closed_form.score import score
from benchmarks.varied import Setting, WatchedThresholds
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.naming.workflow import diagnose
from pipeline.gap.report.report import to_dict
from pipeline.gap.thresholds import Thresholds

Json = dict[str, Any]
FACTORS = (0.7, 1.4)
WRONGS = ("false alarm", "wrong name", "missed", "not answered unknown", "called unknown", "no answer")


@functools.cache
def _others(key: str) -> dict[Setting, Any]:
    """Return a threshold's other values; none for an impossible factor."""
    group, name = key.split(".")
    found = {factor: scaled(key, factor) for factor in FACTORS}
    return {(key, factor): getattr(getattr(by, group), name) for factor, by in found.items() if by is not None}


def keys() -> list[str]:
    """All thresholds, as group.key."""
    return [f"{group}.{key}" for group, values in Thresholds().model_dump().items() for key in values]


def scaled(key: str, factor: float) -> Thresholds | None:
    """Return the usual thresholds with one of them scaled; None if the value is not allowed or does not change."""
    group, name = key.split(".")
    values = Thresholds().model_dump()
    old = values[group][name]
    new = max(round(factor * old), 1) if isinstance(old, int) else factor * old
    values[group][name] = new
    try:
        return None if new == old else Thresholds.model_validate(values)
    except ValidationError:
        return None


def answer(folder: Path, thresholds: Any) -> Json:
    """Return gap.json, or the error."""
    measurement = read_measurement(folder)
    try:
        return to_dict(diagnose(measurement, thresholds=thresholds), measurement)
    except Exception as error:
        return {"error": repr(error)}


def jobs(cases: list[Case], out: Path, *, everything: bool) -> Iterator[tuple[Case, str, float]]:
    """Yield what to diagnose: each case as usual, then with each threshold that makes a difference (or was used)."""
    for case in cases:
        yield case, "usual", 1.0
    turns: Counter[Setting] = Counter()
    found = []
    for case in cases:
        for key, factor in _asked(out, case, everything=everything):
            turns[key, factor] += 1
            found.append((turns[key, factor], key, factor, case))
    for _, key, factor, case in sorted(found, key=lambda each: each[:3]):
        yield case, key, factor


def _asked(out: Path, case: Case, *, everything: bool) -> list[Setting]:
    """Return thresholds and factors that a case used, or only those that would have changed a decision."""
    noted = json.loads((out / case.name / "asked.json").read_text())
    some = [(key, factor) for key in noted["asked"] for _, factor in _others(key)]
    return some if everything else [each for each in some if list(each) in noted["matters"]]


def work(cases: list[Case], out: Path, minutes: float, *, everything: bool = False) -> None:
    """Diagnose cases without an answer until the time is up; those with the usual thresholds in any case."""
    end = time.monotonic() + 60 * minutes
    for case, key, factor in jobs(cases, out, everything=everything):
        folder = out / case.name
        path = folder / f"{key}@{factor:g}.json"
        if path.exists() or (key != "usual" and time.monotonic() > end):
            continue
        if not (folder / "truth.json").exists():
            make(case, folder / "case", folder / "truth.json")
        found = answer(folder / "case", scaled(key, factor)) if key != "usual" else _usual(folder)
        path.write_text(json.dumps(found))
        print(f"{case.name} {key} x {factor:g}: {found.get('verdict', found)}", flush=True)


def _usual(folder: Path) -> Json:
    """Diagnose with the usual thresholds, and record which were used and which make a difference."""
    asked: set[str] = set()
    matters: set[Setting] = set()
    measurement = read_measurement(folder / "case")
    watched: Any = WatchedThresholds(Thresholds(), _others, asked, matters)
    found = to_dict(diagnose(measurement, thresholds=watched), measurement)
    (folder / "asked.json").write_text(json.dumps({"asked": sorted(asked), "matters": sorted(matters)}))
    return found


def _check_followed(cases: list[Case], out: Path) -> None:
    """Raise ValueError if a threshold recorded as making no difference makes one."""
    for case in cases:
        usual = json.loads((out / case.name / "usual@1.json").read_text())
        for key, factor in set(_asked(out, case, everything=True)) - set(_asked(out, case, everything=False)):
            path = out / case.name / f"{key}@{factor:g}.json"
            if path.exists() and _bare(json.loads(path.read_text())) != _bare(usual):
                raise ValueError(f"{path} differs from usual@1.json, and was said not to")


def _bare(found: Json) -> Json:
    """Return the parts of an answer that must not depend on a threshold that decides nothing."""
    return {key: value for key, value in found.items() if key not in ("seconds", "timings", "decisions")}


def _row(truth: Json, folder: Path, name: str) -> Json | None:
    path = folder / f"{name}.json"
    return dict(score([(truth, json.loads(path.read_text()))])["rows"][0]) if path.exists() else None


def table(cases: list[Case], out: Path) -> str:
    """Return one line for each threshold that some case used: how many answers change, and become wrong or right."""
    cells: dict[str, dict[float, list[tuple[Json, Json]]]] = {}
    for case in cases:
        folder = out / case.name
        truth = json.loads((folder / "truth.json").read_text())
        usual = _row(truth, folder, "usual@1")
        mattering = _asked(out, case, everything=False)
        for key, factor in _asked(out, case, everything=True):
            other = _row(truth, folder, f"{key}@{factor:g}") if (key, factor) in mattering else usual
            if other is not None and usual is not None:
                cells.setdefault(key, {}).setdefault(factor, []).append((usual, other))
    sides = "".join(f"| x {factor:g}: cases | changed | became wrong | became right " for factor in FACTORS)
    lines = [f"| threshold | value {sides}|", "| --- | --- " + "| --- | --- | --- | --- " * len(FACTORS) + "|"]
    for key in keys():
        if key in cells:
            group, name = key.split(".")
            value = getattr(getattr(Thresholds(), group), name)
            lines.append(f"| `{key}` | {value:g} | " + " | ".join(_side(cells[key].get(factor, [])) for factor in FACTORS) + " |")
    return "\n".join(lines)


def _side(pairs: list[tuple[Json, Json]]) -> str:
    if not pairs:
        return "- | - | - | -"
    changed = sum(_said(usual) != _said(row) for usual, row in pairs)
    worse = Counter(row["wrong"] for usual, row in pairs if row["wrong"] and row["wrong"] != usual["wrong"])
    better = Counter(usual["wrong"] for usual, row in pairs if usual["wrong"] and row["wrong"] != usual["wrong"])
    return f"{len(pairs)} | {changed} | {_counted(worse)} | {_counted(better)}"


def _said(row: Json) -> tuple[str, tuple[str, ...]]:
    return row["verdict"], tuple(sorted(each["name"] for each in row["named"]))


def _counted(wrong: Counter[str]) -> str:
    return ", ".join(f"{wrong[kind]} {kind}" for kind in WRONGS if wrong[kind]) or "0"


def main() -> None:
    """Diagnose for so many minutes, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=24)
    parser.add_argument("--seed", type=int, default=3100)
    parser.add_argument("--minutes", type=float, default=60.0, help="for the changed thresholds")
    parser.add_argument("--all", action="store_true", help="with thresholds that make no difference too; fails where one does")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    cases = plan(arguments.cases, arguments.seed, small=True)
    for case in cases:
        (arguments.out / case.name).mkdir(parents=True, exist_ok=True)
    work(cases, arguments.out, arguments.minutes, everything=arguments.all)
    if arguments.all:
        _check_followed(cases, arguments.out)
    found = table(cases, arguments.out)
    print(found)
    if arguments.table:
        arguments.table.write_text(f"{_HEAD}\n\n{_made_by(arguments)}\n\n{found}\n\n{decided()}")


def decided() -> str:
    """Return a table of all thresholds with their units and what each decides."""
    lines = [_WORDS, "", "| threshold | value | unit | what it decides |", "|---|---|---|---|"]
    for key in keys():
        group, name = key.split(".")
        values = getattr(Thresholds(), group)
        field = type(values).model_fields[name]
        lines.append(f"| `{key}` | {getattr(values, name):g} | {field.json_schema_extra['unit']} | {field.description} |")
    return "\n".join(lines) + "\n"


def _made_by(arguments: argparse.Namespace) -> str:
    """Return the table of how the results were made."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    words = f"python benchmarks/gap_thresholds.py --cases {arguments.cases} --seed {arguments.seed} --out DIR --table {_PAGE}"
    row = f"| {arguments.cases} | {arguments.seed} | {commit} | `{words}` |"
    return f"| cases | seed | commit | command |\n|---|---|---|---|\n{row}"


_WORDS = """## What the thresholds decide

[How gap works](../explanation/how_gap_works.md) explains the steps, and the [glossary](../reference/glossary.md) more words:

| word | meaning |
|---|---|
| log-likelihood | unit of a difference: 3 means a factor of 20 in likelihood |
| gain, log-likelihood ratio | by how much the logarithm of the likelihood is larger with the effect than without it |
| score | gain minus a penalty for the number of parameters |
| score, in the groups `validation` and `verdict` | how well validation blocks are predicted: log score, or a distance in metres |
| signature | the pattern of residuals that an effect makes |
| class, equivalence class | effects that the measurement cannot tell apart |
| semivariogram | how much the residuals of two points differ, by their distance |
| wall blocks | parts into which the wall is divided, not fallen rock |
| root sums of squares of the wall blocks' gains | their sum over the root of their sum of squares; four equal gains give 2 |
| non-parametric, empirical term | a curve that describes residuals without naming a cause |
| resultant length | how much values prefer one phase, such as whole pixels: 0 for none, 1 if all have it; they then crowd there |
| strips | parts of the scan by direction, each across the sector in question |
| selection pass, trial | one run of the search for effects; one value of a parameter that is tried |"""
_PAGE = "docs/validation/gap_thresholds.md"
_HEAD = """# What each threshold does

This page shows how far the answers of `scarpsim gap` depend on its thresholds. It is for developers who change one, and for users
who wonder whether a default decides their case. `--set` changes a threshold for one diagnosis, and `gap.json` records the values:

    scarpsim gap my_measurement --set mean.class_margin=4 --set points.fewest=500 --out diagnosis

Each threshold of `pipeline/gap/thresholds.py` was set to 0.7 and 1.4 times its value, on development cases of some thousand
points of the [closed-form generator](gap_closed_form.md). The table has four columns for each of both values ("x 0.7",
"x 1.4"):

| column | cases that it counts |
|---|---|
| cases | those that use the threshold |
| changed | those whose answer (verdict or names) is another one than with the usual value |
| became wrong | those whose answer was right, with what is wrong now: a wrong name, a missed effect, a false alarm |
| became right | those whose answer was wrong, with what was wrong |

A threshold that no case uses, or that is newer than the run, is not listed. "-" means that the value is not allowed, or that the
time was up. Most thresholds change no answer within this range. So few cases show which thresholds are close to changing an
answer, but not how often they do. [What the thresholds decide](#what-the-thresholds-decide) is at the end of the page."""


if __name__ == "__main__":
    main()
