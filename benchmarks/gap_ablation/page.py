"""Write the page of the ablation: what each threshold of `gap` changes, and what was done with it.

    python benchmarks/gap_ablation/page.py --results docs/validation/gap_ablation.json --page docs/validation/gap_ablation.md
    python benchmarks/gap_ablation/page.py --collect OUT --runs RUNS --measurements DIR --results FILE

The second form makes the results file from the answers that `run.py` left in OUT.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks.gap_ablation.decisions import DONE
from benchmarks.gap_ablation.run import noted
from benchmarks.gap_ablation.settings import KEPT_OUT, MERGED, OFF
from benchmarks.gap_ablation.sources import SOURCES, StoredCase, stored_cases
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
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    wrong = Counter(f"{case.source}: {answer['judged']}" for case, answer in usual.items() if answer and answer["judged"])
    together = _changes(cases, "final", usual, out)
    return {
        "cases": Counter(case.source for case in cases),
        "wrong": wrong,
        "commit": commit,
        "together": together,
        "thresholds": rows,
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


def page(results: Json, command: str) -> str:
    """Return the page in Markdown."""
    total = sum(results["cases"].values())
    sources = "\n".join(f"| {SOURCES[source]} | {count} |" for source, count in results["cases"].items())
    wrong = sum(results["wrong"].values())
    lines = [
        "| threshold | value | off at | uses it | acts | diagnosed | other answer | became wrong | became right | done |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    merged = [
        "| threshold | value | tried | acts | diagnosed | other answer | became wrong | became right |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for key, row in results["thresholds"].items():
        off, other = row["settings"].get("off"), row["settings"].get("merged")
        done = DONE.get(key, f"kept: {KEPT_OUT[key]}" if key in KEPT_OUT else "kept")
        cells = _cells(off) if off else "- | - | - | - | -"
        value = "-" if off is None else _number(off["value"])
        lines.append(f"| `{key}` | {_number(row['value'])} | {value} | {row['asked']} | {cells} | {done} |")
        if other and other["diagnosed"] == other["acts"]:
            merged.append(f"| `{key}` | {_number(row['value'])} | {_number(other['value'])} | {_cells(other)} |")
    before, after = len(results["thresholds"]), sum(len(group) for group in Thresholds().model_dump().values())
    return _PAGE.format(
        total=total, sources=sources, wrong=wrong, before=before, after=after, commit=results["commit"], command=command,
        table="\n".join(lines), merged="\n".join(merged), flips=_flips(results), together=_together(results),
        groups=_groups(results.get("groups", [])), final_commit=results.get("final_commit", results["commit"]),
    )  # fmt: skip


def _cells(found: Json) -> str:
    """Return the cells that count what one setting of a threshold changes."""
    if found["acts"] and not found["diagnosed"]:
        return f"{found['acts']} | 0 | - | - | -"
    return (
        f"{found['acts']} | {found['diagnosed']} | {found['other answers']} | {len(found['became wrong'])} | "
        f"{len(found['became right'])}"
    )


def _together(results: Json) -> str:
    """Return a paragraph on the cases that were diagnosed with the thresholds that are left."""
    said = f"With the thresholds that are left, {_turned(results['together'], 'of the cases were diagnosed again')}"
    fresh = results.get("fresh")
    return said if fresh is None else f"{said} {_turned(fresh, 'further cases in closed form were diagnosed with both')}"


def _turned(found: Json, cases: str) -> str:
    """Say how many answers differ, become wrong and become right; cases: what follows their number."""
    changes = ", ".join([*found["became wrong"], *found["became right"], *found["other errors"]])
    return (
        f"{found['diagnosed']} {cases}: {found['other answers']} have another verdict or other names, "
        f"{len(found['became wrong'])} became wrong, and {len(found['became right'])} became right{changes and f' ({changes})'}."
    )


def _groups(found: list[Json]) -> str:
    """Return a table of settings in a group that changed an answer, and what was done therefore."""
    rows = [f"| `{each['threshold']}` | {each['tried']} | {each['case']} | {each['change']} | {each['done']} |" for each in found]
    return "\n".join(["| threshold | tried | case | change | done |", "|---|---|---|---|---|", *rows])


def _number(value: float) -> str:
    return "none" if abs(value) >= 1e9 else f"{value:g}"


def _flips(results: Json) -> str:
    """Return a table of all answers that become wrong or right."""
    lines = ["| threshold | setting | case | change |", "|---|---|---|---|"]
    for key, row in results["thresholds"].items():
        for setting, found in row["settings"].items():
            for kind in ("became wrong", "became right", "other errors"):
                for each in found[kind]:
                    case, _, what = each.partition(": ")
                    words = {"became wrong": f"right to {what}", "became right": f"{what} to right", "other errors": what}[kind]
                    lines.append(f"| `{key}` | {'off' if setting == 'off' else found['value']} | {case} | {words} |")
    return "\n".join(lines)


_PAGE = """# What `gap` needs its thresholds for

This page is for developers of `scarpsim gap`. It shows for each threshold what the diagnosis loses without the rule behind
it, and which thresholds were deleted or merged therefore: there were {before}, now there are {after}. [What each threshold
does](gap_thresholds.md) says how far answers depend on the value of a threshold, and what each decides.

Each case was diagnosed with the usual thresholds, which named a wrong effect, missed one or gave a false alarm in {wrong}
of {total} cases. The diagnosis also carried, for each threshold, the value with which its rule never acts, and recorded
whether a decision would differ. Only then was the case diagnosed again, with that rule off. As each case was diagnosed only
so often as time allowed, the column "diagnosed" can be smaller than "acts".

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

{together}

{table}

## Values that were tried in place of others

Thresholds of the same kind can share one value. These values were tried. Where no answer became wrong, the threshold could be
merged with the one whose value it shares.

{merged}

## Thresholds that were changed in groups

A diagnosis takes up to a minute, so most rules that act could not be switched off one by one. They were changed in two groups:
deleted, or set to the value of a threshold of the same kind. Where an answer of a case differed, halves of the group were tried
until the cause was found, or the notes of the answer told it. These settings were a cause:

{groups}

## Answers that change

{flips}

## How it was made

Made at commit {commit} by:

    {command}

The answers with the thresholds that are left were made at commit {final_commit}, with `--final` and an `--order` of some cases.
"""


def main() -> None:
    """Collect the results, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--collect", type=Path, metavar="OUT")
    parser.add_argument("--runs", type=Path)
    parser.add_argument("--measurements", type=Path)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--page", type=Path)
    given = parser.parse_args()
    if given.collect:
        results = collect(given.collect, stored_cases(given.runs, given.measurements))
        given.results.write_text(json.dumps(results, indent=1) + "\n")
    if given.page:
        command = "python benchmarks/gap_ablation/run.py --runs RUNS --measurements DIR --out OUT"
        given.page.write_text(page(json.loads(given.results.read_text()), command))


if __name__ == "__main__":
    main()
