"""Switch off the rule behind each threshold of `gap`, and each of its steps, on stored cases with known truth.

    python benchmarks/gap_ablation/run.py --runs RUNS --measurements DIR --out OUT --minutes 60

The first diagnosis of a case also carries the value of each threshold with which its rule never acts (benchmarks/varied.py), and
records which of them would change a decision, and which steps ran (steps.py). Only with those is the case diagnosed again,
settings that take the least time first; a step is a setting `step=NAME`. An interrupted run continues. `--together KEY=NAME ...`
diagnoses all cases with several settings at once instead, and `--final` with the thresholds as they are now, once some were
deleted.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gap_ablation.settings import changed, others
from benchmarks.gap_ablation.sources import StoredCase, stored_cases
from benchmarks.gap_ablation.steps import noting_steps, switched_off
from benchmarks.varied import Setting, WatchedThresholds
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.naming.workflow import diagnose
from pipeline.gap.report.report import to_dict
from pipeline.gap.thresholds import Thresholds

Json = dict[str, Any]
STEP = "step"
"""In place of the key of a threshold: the setting's name is that of a step to switch off."""


def diagnosed(folder: Path, thresholds: Any) -> Json:
    """Return what gap.json says, with the seconds, or the error."""
    start = time.monotonic()
    try:
        measurement = read_measurement(folder)
        found = to_dict(diagnose(measurement, thresholds=thresholds), measurement)
    except Exception as error:
        return {"verdict": "error", "error": repr(error), "effects": []}
    found.pop("decisions", None)
    return {**found, "wall_s": time.monotonic() - start}


def watch(case: StoredCase, out: Path) -> None:
    """Diagnose with the usual thresholds, and record which were used and which settings would change a decision."""
    place = out / case.source / case.name
    if (place / "usual.json").exists():
        return
    asked: set[str] = set()
    matters: set[Setting] = set()
    place.mkdir(parents=True, exist_ok=True)
    steps: set[str] = set()
    with noting_steps(steps):
        found = diagnosed(case.folder, WatchedThresholds(Thresholds(), others, asked, matters))
    matters |= {(STEP, step) for step in steps}
    (place / "asked.json").write_text(json.dumps({"asked": sorted(asked), "matters": sorted(matters)}))
    (place / "usual.json").write_text(json.dumps(found, default=float))
    print(f"{case.source} {case.name}: {found['verdict']} {case.judged(found)!r} {found.get('wall_s', 0):.0f} s", flush=True)


def jobs(cases: list[StoredCase], out: Path, only: list[str], most: int) -> list[tuple[StoredCase, Setting]]:
    """Return what to diagnose again: settings that take the least time first, each on its cases in turn.

    only: names of settings (off, merged), or settings as KEY=NAME; empty for all. most: cases of a setting, drawn at random.
    """
    by_setting: dict[Setting, list[StoredCase]] = {}
    for case in cases:
        for key, name in noted(case, out)["matters"]:
            if not only or name in only or f"{key}={name}" in only:
                by_setting.setdefault((key, name), []).append(case)
    drawn = {each: row for row, each in enumerate(np.random.default_rng(0).permutation(len(cases)))}
    rank = {case: drawn[row] for row, case in enumerate(sorted(cases, key=lambda case: (case.source, case.name)))}
    by_setting = {setting: sorted(some, key=rank.__getitem__)[:most] for setting, some in by_setting.items()}
    seconds = {case: _usual(case, out).get("wall_s", 0.0) for case in cases}
    ordered = sorted(by_setting.items(), key=lambda item: sum(seconds[case] for case in item[1]))
    return [(case, setting) for setting, some in ordered for case in some]


def _usual(case: StoredCase, out: Path) -> Json:
    """Return the first answer to a case; empty if there is none."""
    path = out / case.source / case.name / "usual.json"
    return dict(json.loads(path.read_text())) if path.exists() else {}


def noted(case: StoredCase, out: Path) -> Json:
    """Return what the first diagnosis of a case recorded."""
    path = out / case.source / case.name / "asked.json"
    return dict(json.loads(path.read_text())) if path.exists() else {"asked": [], "matters": []}


def again(case: StoredCase, settings: list[Setting], name: str, out: Path) -> None:
    """Diagnose a case with some settings, unless that was done; name: of the file."""
    path = out / case.source / case.name / f"{name}.json"
    if path.exists():
        return
    with switched_off([name for key, name in settings if key == STEP]):
        found = diagnosed(case.folder, changed([each for each in settings if each[0] != STEP]))
    path.write_text(json.dumps(found, default=float))
    before, after = case.judged(_usual(case, out)), case.judged(found)
    print(f"{name}: {case.source} {case.name}: {before!r} -> {after!r} ({found['verdict']})", flush=True)


def main() -> None:
    """Watch all cases, then diagnose again until the time is up."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, required=True, help="folder with the runs inj, second and closed")
    parser.add_argument("--measurements", type=Path, required=True, help="folder with measurement folders and their truth.json")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--order", type=Path, help="file that lists cases as SOURCE/NAME, which are taken in this order")
    parser.add_argument("--watch", action="store_true", help="only the first diagnosis of each case")
    parser.add_argument("--only", nargs="*", default=[], help="settings for the second diagnoses: names, or KEY=NAME")
    parser.add_argument("--most", type=int, default=10_000, help="cases in which a setting is tried again, drawn at random")
    parser.add_argument("--together", nargs="*", default=[], help="diagnose all watched cases with these settings at once")
    parser.add_argument("--final", action="store_true", help="diagnose all watched cases with the thresholds as they are now")
    parser.add_argument("--name", default="together", help="name of the answers of --together")
    given = parser.parse_args()
    end = time.monotonic() + 60 * given.minutes
    cases = _ordered(stored_cases(given.runs, given.measurements), given.order)
    if not (given.together or given.final):
        for case in cases:
            if time.monotonic() < end:
                watch(case, given.out)
    if given.watch:
        return
    watched = [case for case in cases if (given.out / case.source / case.name / "usual.json").exists()]
    settings = [tuple(each.split("=")) for each in given.together]
    name = "final" if given.final else given.name
    work = [(case, settings, name) for case in watched] if settings or given.final else [
        (case, [setting], "=".join(setting)) for case, setting in jobs(watched, given.out, given.only, given.most)
    ]  # fmt: skip
    for case, some, name in work:
        if time.monotonic() < end:
            again(case, some, name, given.out)
    print(Counter(case.source for case in watched))


def _ordered(cases: list[StoredCase], order: Path | None) -> list[StoredCase]:
    """Return the cases that a file lists, in its order; all cases without a file."""
    if order is None:
        return cases
    by_name = {f"{case.source}/{case.name}": case for case in cases}
    return [by_name[each] for each in order.read_text().split() if each in by_name]


if __name__ == "__main__":
    main()
