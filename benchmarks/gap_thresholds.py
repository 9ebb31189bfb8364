"""What each threshold of the diagnosis does when it is 0.7 and 1.4 times as large, on development cases.

    python benchmarks/gap_thresholds.py --cases 24 --seed 3100 --out /tmp/thresholds --table docs/gap_thresholds.md

Small cases, hours of them: a case is diagnosed again only with thresholds that its first diagnosis asked for.
Interrupted, it goes on where it was; `--minutes` ends it with the table of what there is.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from benchmarks.gap_challenge.cases import Case, make, plan
from benchmarks.gap_challenge.score import score
from pipeline.formats.measurement import read_measurement
from pipeline.gap.decisions import Decisions
from pipeline.gap.naming.workflow import diagnose
from pipeline.gap.report.report import to_dict

Json = dict[str, Any]
FACTORS = (0.7, 1.4)
WRONGS = ("false alarm", "wrong name", "missed", "not answered unknown", "called unknown", "no answer")


class _Asked:
    """Decisions that note which of them are asked for, as group.key."""

    def __init__(self, values: Any, prefix: str, asked: set[str]) -> None:
        self._values, self._prefix, self._asked = values, prefix, asked

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._values, name)
        if name.startswith("model_"):
            return found
        if not self._prefix:
            return _Asked(found, f"{name}.", self._asked)
        self._asked.add(f"{self._prefix}{name}")
        return found


def keys() -> list[str]:
    """All thresholds, as group.key."""
    return [f"{group}.{key}" for group, values in Decisions().model_dump().items() for key in values]


def scaled(key: str, factor: float) -> Decisions | None:
    """The usual decisions with one of them so many times as large; None where it may not be, or where whole numbers stay."""
    group, name = key.split(".")
    values = Decisions().model_dump()
    old = values[group][name]
    new = max(round(factor * old), 1) if isinstance(old, int) else factor * old
    values[group][name] = new
    try:
        return None if new == old else Decisions.model_validate(values)
    except ValidationError:
        return None


def answer(folder: Path, decisions: Any) -> Json:
    """gap.json, or what went wrong."""
    measurement = read_measurement(folder)
    try:
        return to_dict(diagnose(measurement, decisions=decisions), measurement)
    except Exception as error:
        return {"error": repr(error)}


def jobs(cases: list[Case], out: Path) -> Iterator[tuple[Case, str, float]]:
    """What is to be diagnosed: each case as usual, and then with each threshold that it asked for."""
    for case in cases:
        yield case, "usual", 1.0
    turns = [(place, key, case) for case in cases for place, key in _asked_of(case, cases, out)]
    for _, key, case in sorted(turns, key=lambda turn: turn[:2]):
        for factor in FACTORS:
            yield case, key, factor


def _asked_of(case: Case, cases: list[Case], out: Path) -> list[tuple[int, str]]:
    """The thresholds that a case asked for, each with how many cases before it did: none waits for all the others."""
    asked = {each.name: set(json.loads((out / each.name / "asked.json").read_text())) for each in cases}
    before = cases[: cases.index(case)]
    return [(sum(key in asked[each.name] for each in before), key) for key in asked[case.name]]


def work(cases: list[Case], out: Path, minutes: float) -> None:
    """Diagnose what has no answer yet, until the time is up; the usual answers in any case."""
    end = time.monotonic() + 60 * minutes
    for case, key, factor in jobs(cases, out):
        folder = out / case.name
        path = folder / f"{key}@{factor:g}.json"
        if path.exists() or (key != "usual" and time.monotonic() > end):
            continue
        if not (folder / "truth.json").exists():
            make(case, folder / "case", folder / "truth.json")
        asked: set[str] = set()
        decisions = _Asked(Decisions(), "", asked) if key == "usual" else scaled(key, factor)
        if decisions is not None:
            found = answer(folder / "case", decisions)
            if key == "usual":
                (folder / "asked.json").write_text(json.dumps(sorted(asked)))
            path.write_text(json.dumps(found))
            print(f"{case.name} {key} x {factor:g}: {found.get('verdict', 'error')}", flush=True)


def _row(truth: Json, folder: Path, name: str) -> Json | None:
    path = folder / f"{name}.json"
    return dict(score([(truth, json.loads(path.read_text()))])["rows"][0]) if path.exists() else None


def table(cases: list[Case], out: Path) -> str:
    """One line for each threshold that some case asked for: how many answers change, and what becomes wrong or right."""
    cells: dict[str, dict[float, list[tuple[Json, Json]]]] = {}
    for case in cases:
        folder = out / case.name
        truth = json.loads((folder / "truth.json").read_text())
        usual = _row(truth, folder, "usual@1")
        for key in json.loads((folder / "asked.json").read_text()):
            for factor in FACTORS:
                row = _row(truth, folder, f"{key}@{factor:g}")
                if row is not None and usual is not None:
                    cells.setdefault(key, {}).setdefault(factor, []).append((usual, row))
    lines = [
        "| threshold | value | cases "
        + "".join(f"| x {factor:g}: changed | became wrong | became right " for factor in FACTORS)
        + "|",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for key in keys():
        if key not in cells:
            continue
        group, name = key.split(".")
        value = getattr(getattr(Decisions(), group), name)
        sides = " | ".join(_side(cells[key].get(factor, [])) for factor in FACTORS)
        count = max(len(pairs) for pairs in cells[key].values())
        lines.append(f"| `{key}` | {value:g} | {count} | {sides} |")
    return "\n".join(lines)


def _side(pairs: list[tuple[Json, Json]]) -> str:
    if not pairs:
        return "- | - | -"
    changed = sum(_said(usual) != _said(row) for usual, row in pairs)
    worse = Counter(row["wrong"] for usual, row in pairs if row["wrong"] and row["wrong"] != usual["wrong"])
    better = Counter(usual["wrong"] for usual, row in pairs if usual["wrong"] and row["wrong"] != usual["wrong"])
    return f"{changed} | {_counted(worse)} | {_counted(better)}"


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
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    cases = plan(arguments.cases, arguments.seed, small=True)
    for case in cases:
        (arguments.out / case.name).mkdir(parents=True, exist_ok=True)
    work(cases, arguments.out, arguments.minutes)
    found = table(cases, arguments.out)
    print(found)
    if arguments.table:
        arguments.table.write_text(f"{_HEAD}\n\n{found}\n")


_HEAD = """# What each threshold does

Each threshold of `pipeline/gap/decisions.py` at 0.7 and 1.4 times its value, on development cases of some thousand points made by
`benchmarks/gap_thresholds.py`: in how many of the cases that ask for it the answer changes (verdict or names), and what
becomes wrong, or right, by it. A threshold that is missing was asked for by no case; "-": its value may not be so large or small,
or the time was up."""


if __name__ == "__main__":
    main()
