"""Evaluate `scarpsim gap` on measurements of the second generator: make cases, run the command on each, score the answers.

    python benchmarks/gap_second_generator/run.py --cases 40 --seed 77 --out /tmp/second [--sensor tls|stereo]
        [--table docs/validation/gap_second_generator.md]

In --out, `cases/0007` is the measurement folder, `truth/0007.json` its truth, `answers/0007` what the command wrote. Cases that
were already made or answered are not repeated.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

if __package__ in (None, ""):
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from gap_second_generator import cases, score

LONGEST_S = 900


def make(case: cases.Case, seed: int, out: Path) -> Path:
    """Make the case's folder; its truth is written last, outside of the folders."""
    where, truth = out / "cases" / f"{case.number:04d}", out / "truth" / f"{case.number:04d}.json"
    if not truth.exists():
        cases.save_truth(cases.build(case, seed, where), truth)
    return where


def ask(folder: Path, answer: Path) -> None:
    """Run the command; its exit status, seconds and last words are written to answer/said.json."""
    if (answer / "said.json").exists():
        return
    answer.mkdir(parents=True, exist_ok=True)
    command = [str(Path(sys.executable).parent / "scarpsim"), "gap", str(folder), "--out", str(answer), "--quiet"]
    begin = time.monotonic()
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S, check=False)
        said = {"status": done.returncode, "words": (done.stdout + done.stderr)[-1500:]}
    except subprocess.TimeoutExpired:
        said = {"status": None, "words": f"no answer after {LONGEST_S} s"}
    (answer / "said.json").write_text(json.dumps({**said, "seconds": round(time.monotonic() - begin, 1)}))


def main() -> None:
    """Make all cases, diagnose each and score the answers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=40, help="how many")
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--sensor", choices=cases.SENSORS, help="only one of them (default: both in turn)")
    parser.add_argument("--table", type=Path, metavar="FILE", help="where the Markdown goes (default: DIR/table.md)")
    given = parser.parse_args()
    planned = cases.schedule(given.seed, given.cases, given.sensor)
    folders = [make(case, given.seed, given.out) for case in planned]
    for folder in folders:
        ask(folder, given.out / "answers" / folder.name)
        print(folder.name, flush=True)
    results = [score.scored(given.out, folder.name) for folder in folders]
    sensor = f" --sensor {given.sensor}" if given.sensor else ""
    command = (
        f"python benchmarks/gap_second_generator/run.py --cases {given.cases} --seed {given.seed}{sensor} --out DIR --table FILE"
    )
    revision = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(revision, capture_output=True, text=True, check=False).stdout.strip()
    (given.table or given.out / "table.md").write_text(score.table(results, command, commit))


if __name__ == "__main__":
    main()
