"""Write the page of the ablation: what each threshold of `gap` changes, and what was done with it.

    python benchmarks/gap_ablation/page.py --results FILE --deleted docs/validation/gap_ablation_deleted.json --page PAGE
    python benchmarks/gap_ablation/page.py --collect OUT --runs RUNS --measurements DIR --results FILE

The second form makes the results file from the answers that `run.py` left in OUT. The file of `--deleted` holds those of an
earlier run, with thresholds that were deleted or merged since.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks.gap_ablation.decisions import DONE
from benchmarks.gap_ablation.run import STEP, noted
from benchmarks.gap_ablation.settings import KEPT_OUT, MERGED, OFF
from benchmarks.gap_ablation.sources import SOURCES, StoredCase, stored_cases
from benchmarks.gap_ablation.steps import STEPS
from pipeline.gap.thresholds import Thresholds

Json = dict[str, Any]


def collect(out: Path, cases: list[StoredCase]) -> Json:
    """Return the results of a run: cases by source, and for each threshold what its settings change."""
    cases = [case for case in cases if (out / case.source / case.name / "usual.json").exists()]
    values = Thresholds().model_dump()
    usual = {case: _answer(case, "usual", out) for case in cases}
    rows = {}
    for key in [f"{group}.{name}" for group, found in values.items() for name in found]:
        group, name = key.split(".")
        asked = [case for case in cases if key in noted(case, out)["asked"]]
        rows[key] = {"value": values[group][name], "asked": len(asked), "settings": {}}
        for setting, table in (("off", OFF), ("merged", MERGED)):
            if key in table:
                acts = [case for case in asked if [key, setting] in noted(case, out)["matters"]]
                rows[key]["settings"][setting] = {"value": table[key], **_changes(acts, f"{key}={setting}", usual, out)}
    steps = {}
    for step in STEPS:
        called = [case for case in cases if [STEP, step] in noted(case, out)["matters"]]
        steps[step] = _changes(called, f"{STEP}={step}", usual, out)
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    wrong = Counter(f"{case.source}: {answer['judged']}" for case, answer in usual.items() if answer and answer["judged"])
    return {
        "cases": Counter(case.source for case in cases),
        "wrong": wrong,
        "commit": commit,
        "thresholds": rows,
        "steps": steps,
    }


def _answer(case: StoredCase, name: str, out: Path) -> Json | None:
    path = out / case.source / case.name / f"{name}.json"
    if not path.exists():
        return None
    found = json.loads(path.read_text())
    named = sorted(each["name"] for each in found["effects"])
    return {"verdict": found["verdict"], "named": named, "judged": case.judged(found)}


def _changes(acts: list[StoredCase], name: str, usual: dict[StoredCase, Json | None], out: Path) -> Json:
    """Return in how many cases a setting acts, how many were diagnosed with it, and which answers change."""
    pairs = [(case, usual[case], _answer(case, name, out)) for case in acts]
    done = [(case, before, after) for case, before, after in pairs if before is not None and after is not None]
    turned = [(case, before["judged"], after["judged"]) for case, before, after in done if before["judged"] != after["judged"]]
    return {
        "acts": len(acts),
        "diagnosed": len(done),
        "other answers": sum((b["verdict"], b["named"]) != (a["verdict"], a["named"]) for _, b, a in done),
        "became wrong": [f"{case.source} {case.name}: {after}" for case, before, after in turned if after and not before],
        "became right": [f"{case.source} {case.name}: {before}" for case, before, after in turned if before and not after],
        "other errors": [f"{case.source} {case.name}: {b} to {a}" for case, b, a in turned if a and b],
    }


def page(results: Json, deleted: Json, command: str) -> str:
    """Return the page in Markdown. deleted: results of the earlier run, which has the thresholds that were then deleted."""
    now = {f"{group}.{name}" for group, values in Thresholds().model_dump().items() for name in values}
    rows = {key: row for key, row in deleted["thresholds"].items() if key not in now}
    return _PAGE.format(
        total=sum(results["cases"].values()), sources=_sources(results), wrong=sum(results["wrong"].values()),
        before=len(deleted["thresholds"]), after=len(now), commit=results["commit"], command=command,
        table=_table(results["thresholds"]), steps=_steps(results["steps"]), flips=_flips(results),
        total_before=sum(deleted["cases"].values()),
        sources_before=_sources(deleted), table_before=_table(rows), merged=_merged(deleted["thresholds"]),
        groups=_groups(deleted["groups"]), flips_before=_flips(deleted), commit_before=deleted["commit"],
    )  # fmt: skip


def _sources(results: Json) -> str:
    """Return the rows of a table with the number of cases from each source."""
    return "\n".join(f"| {SOURCES[source]} | {count} |" for source, count in results["cases"].items())


def _table(thresholds: Json) -> str:
    """Return a table of what each threshold's rule changes, and what was done with it."""
    lines = [
        "| threshold | value | off at | uses it | acts | diagnosed | other answer | became wrong | became right | done |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for key, row in thresholds.items():
        off = row["settings"].get("off")
        done = DONE.get(key, f"kept: {KEPT_OUT[key]}" if key in KEPT_OUT else "kept")
        cells = _cells(off) if off else "- | - | - | - | -"
        value = "-" if off is None else _number(off["value"])
        lines.append(f"| `{key}` | {_number(row['value'])} | {value} | {row['asked']} | {cells} | {done} |")
    return "\n".join(lines)


def _steps(steps: Json) -> str:
    """Return a table of what each step changes, of those that were switched off in some case."""
    lines = ["| step | called | diagnosed | other answer | became wrong | became right |", "|---|---|---|---|---|---|"]
    lines += [f"| {step} | {_cells(found)} |" for step, found in steps.items() if found["diagnosed"]]
    return "\n".join(lines)


def _merged(thresholds: Json) -> str:
    """Return a table of thresholds that were given the value of a similar one, and of the answers that this changed."""
    lines = [
        "| threshold | value | tried | acts | diagnosed | other answer | became wrong | became right |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for key, row in thresholds.items():
        other = row["settings"].get("merged")
        if other and other["diagnosed"] == other["acts"]:
            lines.append(f"| `{key}` | {_number(row['value'])} | {_number(other['value'])} | {_cells(other)} |")
    return "\n".join(lines)


def _cells(found: Json) -> str:
    """Return the cells that count what one setting of a threshold changes."""
    if found["acts"] and not found["diagnosed"]:
        return f"{found['acts']} | 0 | - | - | -"
    return (
        f"{found['acts']} | {found['diagnosed']} | {found['other answers']} | {len(found['became wrong'])} | "
        f"{len(found['became right'])}"
    )


def _groups(found: list[Json]) -> str:
    """Return a table of settings in a group that changed an answer, and what was done therefore."""
    rows = [f"| `{each['threshold']}` | {each['tried']} | {each['case']} | {each['change']} | {each['done']} |" for each in found]
    return "\n".join(["| threshold | tried | case | change | done |", "|---|---|---|---|---|", *rows])


def _number(value: float) -> str:
    return "none" if abs(value) >= 1e9 else f"{value:g}"


def _flips(results: Json) -> str:
    """Return a table of all answers that become wrong or right."""
    lines = ["| what | setting | case | change |", "|---|---|---|---|"]
    rows = {f"`{key}`": row["settings"] for key, row in results["thresholds"].items()}
    rows |= {step: {"off": found} for step, found in results.get("steps", {}).items()}
    for name, settings in rows.items():
        for setting, found in settings.items():
            for kind in ("became wrong", "became right", "other errors"):
                for each in found[kind]:
                    case, _, what = each.partition(": ")
                    words = {"became wrong": f"right to {what}", "became right": f"{what} to right", "other errors": what}[kind]
                    lines.append(f"| {name} | {'off' if setting == 'off' else found['value']} | {case} | {words} |")
    return "\n".join(lines)


_PAGE = """# What `gap` needs its thresholds for

This page is for developers of `scarpsim gap`. It shows for each threshold what the diagnosis loses without the rule behind
it, and which thresholds were deleted or merged: there were {before}, now there are {after}. [What each threshold
does](gap_thresholds.md) says how far answers depend on the value of a threshold, and what each decides.

Each of {total} cases was diagnosed with the usual thresholds, which named a wrong effect, missed one or gave a false alarm in
{wrong} of them. The diagnosis also carried, for each threshold, the value with which its rule never acts, and recorded whether a
decision would differ. Only then was the case diagnosed again, with that rule off; at most 12 cases of a threshold, drawn at
random, and fewer where time was up. So few cases can show that a rule is needed, but not that it is needless: if no answer
changes in 12 cases, the rule may still change up to 22 % of those in which it acts (95 % confidence).

| source | cases |
|---|---|
{sources}

| column | meaning |
|---|---|
| off at | the value with which the rule never acts; "none": the limit is as good as absent; "-": no value switches one rule off |
| uses it | cases whose diagnosis reads the threshold |
| acts | those in which a decision differs with the rule off |
| diagnosed | those that were diagnosed again with the rule off |
| other answer | those whose verdict or names differ then |
| became wrong, became right | those whose answer was right and is not, or the reverse; false alarms are among them |

A rule that acts in no case changed nothing that could be measured here. It was deleted if cases used it and no test of the
program requires it. It stays if no case came to it, if it limits the damage of measurements that are not among the cases,
or if it belongs to what `gap` promises, such as classes of effects that cannot be told apart.

{table}

## Steps

[What `gap` needs its steps for](gap_steps.md) explains these. They were switched off in some of the same cases. "Called" counts
the cases in which the step is called, whether it then does something or not. The steps that are missing here were not switched
off in these cases.

{steps}

## Answers that change

{flips}

## Thresholds that were deleted or merged

An earlier run had {total_before} cases, and all thresholds that there were. Most rules that act were not switched off one by
one, so "diagnosed" is often 0.

| source | cases |
|---|---|
{sources_before}

{table_before}

### Values that were tried in place of others

Thresholds of the same kind can share one value. These values were tried. Where no answer became wrong, the threshold could be
merged with the one whose value it shares.

{merged}

### Thresholds that were changed in groups

Two groups of rules were changed together: deleted, or set to the value of a threshold of the same kind. Where an answer of a
case differed, halves of the group were tried until the cause was found, or the notes of the answer told it. These settings were a
cause:

{groups}

### Answers that changed

{flips_before}

## How it was made

The first table was made at commit {commit}, the others at commit {commit_before}, by:

    {command}
"""


def main() -> None:
    """Collect the results, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--collect", type=Path, metavar="OUT")
    parser.add_argument("--runs", type=Path)
    parser.add_argument("--measurements", type=Path)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--deleted", type=Path, help="results of the earlier run, for --page")
    parser.add_argument("--page", type=Path)
    given = parser.parse_args()
    if given.collect:
        results = collect(given.collect, stored_cases(given.runs, given.measurements))
        given.results.write_text(json.dumps(results, indent=1) + "\n")
    if given.page:
        command = "python benchmarks/gap_ablation/run.py --runs RUNS --measurements DIR --out OUT --most 12"
        results, deleted = (json.loads(each.read_text()) for each in (given.results, given.deleted))
        given.page.write_text(page(results, deleted, command))


if __name__ == "__main__":
    main()
