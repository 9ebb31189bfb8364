"""Where the processor time of `scarpsim gap` goes: diagnose measurements and print the slowest with the share of each part.

    python benchmarks/gap_cost.py FOLDER [FOLDER ...] [--write]

A FOLDER is a measurement or holds measurements. Times are processor seconds of all threads, each without the parts inside it.
With --write, the table goes into docs/validation/gap.md.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

from documents import write_between

from pipeline.formats.measurements.measurement import FILE, read_measurement
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.naming import effect_selection, nonlinear_refit, search_beside_effects, selection_passes, workflow
from pipeline.gap.naming.validation import Validation

MOST_ROWS, MOST_PARTS = 10, 3
DOCUMENT = Path(__file__).parents[1] / "docs" / "validation" / "gap.md"
MARKS = ("<!-- cost -->", "<!-- end of cost -->")
PARTS: dict[str, list[tuple[Any, str]]] = {
    "first residuals and pose": [(workflow, "compute_residuals"), (workflow, "align")],
    "residuals beside effects": [
        (nonlinear_refit, "aligned_with_estimates"),
        (search_beside_effects, "aligned_with_estimates"),
        (selection_passes, "aligned_with"),
    ],
    "edge effects": [(selection_passes, "_find_edge_effects"), (selection_passes, "_with_effects")],
    "scene changes": [(selection_passes, "find_scene_changes")],
    "signatures": [
        *((module, "candidate_families") for module in (effect_selection, search_beside_effects)),
        (nonlinear_refit, "catalogue_families"),
    ],
    "outline": [(effect_selection, "outline_effects")],
    "search: design and null": [(MeanSearch, "__init__")],
    "search: selection": [(MeanSearch, "select")],
    "refits": [(nonlinear_refit, name) for name in ("_strongest_single_fits", "_screened_single_fits", "_relinearised")],
    "noise": [(effect_selection, name) for name in ("fit_variance_model", "separate_white_and_grid_noise", "find_grid_noise")],
    "detectable sizes": [(effect_selection, "_detectable_sizes")],
    "validation of effects": [(workflow, "validate_effects")],
    "gap": [(Validation, "validate")],
}
"""Functions whose time is counted, by part of the workflow, in the modules that call them."""


@dataclass(frozen=True)
class DiagnosisCost:
    """Processor seconds of one diagnosis. parts: by part of the workflow."""

    name: str
    sensor: str
    verdict: str
    points: int
    seconds: float
    parts: Counter[str]


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """Count the processor seconds of each part, without the parts that it calls."""
    spent: Counter[str] = Counter()
    inside = [0.0]

    def wrapped(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def call(*values: Any, **named: Any) -> Any:
            start = time.process_time()
            inside.append(0.0)
            try:
                return function(*values, **named)
            finally:
                whole = time.process_time() - start
                spent[part] += whole - inside.pop()
                inside[-1] += whole

        return call

    with ExitStack() as stack:
        for part, places in PARTS.items():
            for owner, name in places:
                stack.enter_context(patch.object(owner, name, wrapped(part, getattr(owner, name))))
        yield spent


def cost_of(folder: Path) -> DiagnosisCost:
    """Diagnose a measurement and return what it cost."""
    measurement, start = read_measurement(folder), time.process_time()
    with counted() as spent:
        found = workflow.diagnose(measurement)
    whole = time.process_time() - start
    spent["rest"] = whole - sum(spent.values())
    return DiagnosisCost(folder.name, measurement.sensor, found.verdict, len(found.residuals), whole, spent)


def table(costs: list[DiagnosisCost]) -> str:
    """Return the slowest diagnoses as a table in Markdown, with the parts that take most of each one's time."""
    seconds = [each.seconds for each in costs]
    lines = [
        f"{len(costs)} measurements: {median(seconds):.0f} s in the median, {max(seconds):.0f} s at most.\n",
        "| measurement | sensor | points | verdict | processor time | most of it |",
        "|---|---|---|---|---|---|",
    ]
    for each in sorted(costs, key=lambda cost: -cost.seconds)[:MOST_ROWS]:
        parts = ", ".join(f"{part} {seconds:.0f} s" for part, seconds in each.parts.most_common(MOST_PARTS))
        lines.append(f"| {each.name} | {each.sensor} | {each.points:,} | `{each.verdict}` | {each.seconds:.0f} s | {parts} |")
    return "\n".join(lines)


def main(words: list[str] | None = None) -> None:
    """Diagnose the measurements that the command line names and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args(words)
    folders = []
    for each in given.folders:
        files = [each / FILE] if (each / FILE).is_file() else sorted(each.glob(f"*/{FILE}"))
        folders += [path.parent for path in files]
    costs = []
    for folder in folders:
        costs.append(cost_of(folder))
        print(f"{costs[-1].seconds:.0f} s  {folder.name}", flush=True)
    found = table(costs)
    print(found)
    if given.write:
        write_between(DOCUMENT, MARKS, found)


if __name__ == "__main__":
    main()
