"""Try all bad inputs on their commands and count good responses.

    python benchmarks/bad_inputs/run.py [--listed] [--only WORD ...] [--jobs 2] [--state FOLDER]
        [--table docs/validation/robustness.md]

Each input runs as its own process, for some seconds, on copies of small good inputs that are made first; those of listed.txt come
first. Prints the bad responses (see case.py) and counts by command; the exit status is 1 if there are any.

--state keeps the good inputs and each response in a folder, so that an interrupted run continues. With --again, bad responses are
tried once more; with --kept, nothing is tried and kept responses are counted. --table writes the counts into the page.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.bad_inputs import (
    camera_cases,
    coco_cases,
    dataset_cases,
    exchange_cases,
    export_cases,
    foreign_content_cases,
    further_cases,
    gap_cases,
    measurement_cases,
    odd_argument_cases,
    odd_results_cases,
    raw_cases,
    site_cases,
    user_mistake_cases,
)
from benchmarks.bad_inputs.case import Case, Outcome, tried
from benchmarks.bad_inputs.materials import make_materials
from benchmarks.bad_inputs.preloaded import Preloaded

BEGIN, END = "<!-- bad inputs: begin -->", "<!-- bad inputs: end -->"


def all_cases() -> list[Case]:
    return [
        *gap_cases.cases(),
        *coco_cases.cases(),
        *dataset_cases.cases(),
        *site_cases.cases(),
        *raw_cases.cases(),
        *measurement_cases.cases(),
        *further_cases.cases(),
        *exchange_cases.cases(),
        *camera_cases.cases(),
        *odd_results_cases.cases(),
        *odd_argument_cases.cases(),
        *export_cases.cases(),
        *foreign_content_cases.cases(),
        *user_mistake_cases.cases(),
    ]


def listed_cases() -> list[Case]:
    """Return the cases of listed.txt; raise KeyError for an unknown name."""
    known = {case.name: case for case in all_cases()}
    lines = (Path(__file__).parent / "listed.txt").read_text(encoding="utf-8").splitlines()
    return [known[name] for name in lines if not name.startswith("#")]


def listed_first(cases: Sequence[Case]) -> list[Case]:
    """Return the cases with those of listed.txt first."""
    listed = {case.name for case in listed_cases()}
    return sorted(cases, key=lambda case: case.name not in listed)


def run(
    cases: Sequence[Case],
    jobs: int,
    materials: Path | None = None,
    *,
    here: bool = False,
    fresh: bool = True,
    heard: Callable[[Outcome], object] = lambda outcome: None,
) -> list[Outcome]:
    """Try each case, in order; `heard` gets each outcome as it comes. fresh: see `Preloaded`."""
    with tempfile.TemporaryDirectory(prefix="bad_inputs_") as name:
        folder = Path(name)
        good = materials or folder / "materials"
        if not good.exists():
            make_materials(good)
        idle: Queue[Preloaded | None] = Queue()
        for _ in range(1 if here else jobs):
            idle.put(None if here else Preloaded(folder / "bytecode", rooms=not fresh))

        def one(numbered: tuple[int, Case]) -> Outcome:
            number, case = numbered
            place, taken = folder / str(number), idle.get()
            try:
                return tried(case, good, place, taken)
            finally:
                idle.put(taken)
                shutil.rmtree(place, ignore_errors=True)

        found = []
        with ThreadPoolExecutor(jobs) as pool:
            for outcome in map(one, enumerate(cases)) if here else pool.map(one, enumerate(cases)):
                found.append(outcome)
                heard(outcome)
        while not idle.empty():
            if started := idle.get():
                started.close()
        return found


class Kept:
    """Outcomes in a file, one line of JSON each; if a case is tried again, its last line counts."""

    def __init__(self, file: Path) -> None:
        self._file = file

    def add(self, outcome: Outcome) -> None:
        values = {**vars(outcome), "case": outcome.case.name}
        with self._file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(values) + "\n")

    def outcomes(self, cases: Iterable[Case]) -> list[Outcome]:
        """Return the outcomes of these cases that were tried."""
        lines = self._file.read_text(encoding="utf-8").splitlines() if self._file.exists() else []
        found = {values["case"]: values for values in map(json.loads, lines)}
        tried_ = [(case, found[case.name]) for case in cases if case.name in found]
        return [Outcome(**{**values, "case": case, "problems": tuple(values["problems"])}) for case, values in tried_]


def said(outcome: Outcome) -> str:
    took = f"{outcome.code:>4} {outcome.seconds:6.1f} s ({outcome.wall_s:.0f} s) {outcome.gigabytes:5.2f} GB"
    return f"{took} [{outcome.case.name}] {', '.join(outcome.problems) or 'well'}: {outcome.line}"


def table(outcomes: Sequence[Outcome]) -> str:
    """Return a Markdown table of inputs tried and good responses, by command."""
    tried_, good = Counter(each.case.command for each in outcomes), Counter(o.case.command for o in outcomes if not o.problems)
    rows = [f"| `{name}` | {count} | {good[name]} |" for name, count in sorted(tried_.items())]
    total = f"| all | {len(outcomes)} | {sum(good.values())} |"
    return "\n".join(["| command | bad inputs | answered well |", "|---|---|---|", *rows, total])


def main() -> int:
    parser = argparse.ArgumentParser(description="bad inputs, each to its command")
    parser.add_argument("--only", nargs="+", default=[], help="cases whose names hold one of these words")
    parser.add_argument("--listed", action="store_true", help="those of listed.txt alone, which were answered badly once")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--materials", type=Path, help="keep the good inputs here, or take those that are here")
    parser.add_argument("--table", type=Path, help="a page with the two marks between which the table goes")
    parser.add_argument("--state", type=Path, help="keep the good inputs and all answers in this folder, and go on with them")
    parser.add_argument("--again", action="store_true", help="with --state: those answered badly once more")
    parser.add_argument("--kept", action="store_true", help="with --state: count the answers there and try nothing")
    parser.add_argument("--show", action="store_true", help="print the good answers too")
    parser.add_argument("--here", action="store_true", help="in this process: faster, and memory is not looked at")
    parser.add_argument("--fresh", action="store_true", help="each process imports the program and ends by itself: slower")
    arguments = parser.parse_args()
    chosen = listed_cases() if arguments.listed else listed_first(all_cases())
    cases = [case for case in chosen if not arguments.only or any(word in case.name for word in arguments.only)]
    outcomes = _counted(cases, arguments)
    print(table(outcomes))
    if arguments.table:
        page = arguments.table.read_text(encoding="utf-8")
        before, after = page.split(BEGIN)[0], page.split(END)[1]
        arguments.table.write_text(f"{before}{BEGIN}\n{table(outcomes)}\n{END}{after}", encoding="utf-8")
    return 1 if any(each.problems for each in outcomes) else 0


def _counted(cases: Sequence[Case], arguments: argparse.Namespace) -> list[Outcome]:
    """Outcomes of the cases, those kept from before among them."""
    kept: Kept | None = None
    materials, left = arguments.materials, list(cases)
    if arguments.state:
        arguments.state.mkdir(parents=True, exist_ok=True)
        materials = materials or arguments.state / "materials"
        kept = Kept(arguments.state / "outcomes.jsonl")
        done = {each.case.name for each in kept.outcomes(cases) if not (arguments.again and each.problems)}
        left = [case for case in cases if case.name not in done]
        if arguments.kept:
            print(f"{len(cases) - len(left)} of {len(cases)} were tried")
            return kept.outcomes(cases)

    def heard(outcome: Outcome) -> None:
        if kept:
            kept.add(outcome)
        if outcome.problems or arguments.show:
            print(said(outcome), flush=True)

    found = run(left, arguments.jobs, materials, here=arguments.here, fresh=arguments.fresh, heard=heard)
    return kept.outcomes(cases) if kept else found


if __name__ == "__main__":
    raise SystemExit(main())
