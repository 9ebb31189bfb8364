"""Measure F1 of detectors against the number of training windows, to see what more training would give.

    python benchmarks/detector_curve.py --set runs/test [--set another] 38448=before 54468=later 70488=default [--write]

Each detector is given as its number of windows and its folder. Sets and detections are as in detector_table.py; detections are
kept in a folder beside each set's, named by the windows. Mirrored views are not used. F1 is the mean over the cells of both
sensors at a score of 0.95, for masks. --write puts the table into docs/validation/detector_training.md.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from detector_table import DOCS, DRAWN, FOUND, SENSORS, SIZES, Bar, Tested, detections, placement_of
from documents import printed, write_between

MARKS = "<!-- curve -->", "<!-- end of curve -->"
BARS = Bar(FOUND, "segm"), Bar(DRAWN, "segm")


def tested(folder: Path, model: str, windows: str) -> Tested:
    """A set and what a detector finds in it."""
    truth = json.loads((folder / "test" / "annotations.json").read_text(encoding="utf-8"))
    out = folder.with_name(f"{folder.name}_found_{windows}")
    return Tested(placement_of(folder), truth, detections(model, folder / "test", out), [])


def f1(test: Tested, bar: Bar, size: str) -> float:
    """Mean over walls, levels of noise and sensors, %."""
    found = [score.f1 for sensor in SENSORS for cell, score in test.on(sensor).network(bar).items() if cell.endswith(f" {size}")]
    return 100 * sum(found) / len(found)


def rows(folders: Sequence[Path], detectors: Sequence[str]) -> Iterator[str]:
    """Yield the rows of the table, in Markdown."""
    yield f"| windows | {' | '.join(f'{placement_of(folder)}, {size}: 0.25, 0.75' for folder in folders for size in SIZES)} |"
    yield "|---" * (1 + len(folders) * len(SIZES)) + "|"
    for windows, _, model in (each.partition("=") for each in detectors):
        tests = [tested(folder, model, windows) for folder in folders]
        cells = [", ".join(f"{f1(test, bar, size):.1f}" for bar in BARS) for test in tests for size in SIZES]
        yield f"| {int(windows):,} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("detectors", nargs="+", metavar="WINDOWS=DETECTOR")
    parser.add_argument("--set", type=Path, required=True, action="append", dest="folders", help="what detector_test.yaml makes")
    parser.add_argument("--write", action="store_true", help="put the table into docs/validation/detector_training.md")
    arguments = parser.parse_args()
    table = printed(rows(arguments.folders, arguments.detectors))
    if arguments.write:
        write_between(DOCS / "detector_training.md", MARKS, table)


if __name__ == "__main__":
    main()
