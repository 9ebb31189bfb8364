"""Stored cases of the generators with their truths, and what is wrong with an answer."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.gap_closed_form.score import score
from benchmarks.gap_injections.cases import Case
from benchmarks.gap_injections.run import before_injection
from benchmarks.gap_injections.score import scored
from benchmarks.gap_second_generator.score import RIGHT, outcome

Json = dict[str, Any]
SOURCES = {
    "injections": "known effects put into real data",
    "second": "second generator",
    "closed": "simulated in closed form",
    "given": "given measurement folders",
}
_NAMING = ("named", "several", "ambiguous", "unknown")


@dataclass(frozen=True)
class StoredCase:
    """One case: its source, its name there, the folder that is diagnosed, and where the source's runs lie."""

    source: str
    name: str
    folder: Path
    runs: Path

    def judged(self, answer: Json) -> str:
        """Return in words what is wrong with an answer, such as "wrong name"; an empty text if it is right.

        "false alarm" stands for an answer other than `no_gap` about a measurement without an effect.
        """
        if "error" in answer:
            return "no answer"
        if self.source == "closed":
            truth = json.loads((self.runs / "truth" / f"{self.name}.json").read_text())
            return str(score([(truth, answer)])["rows"][0]["wrong"])
        if self.source == "injections":
            stored = json.loads((self.runs / "answers" / f"{self.name}.json").read_text())
            asked = {**answer, "case": stored["case"], "strength": stored["strength"]}
            found = scored(asked, before_injection(Case(**stored["case"]), self.runs))["judgement"]
            return "" if found in ("right", "class") else str(found)
        truth_file = self.folder / "truth.json" if self.source == "given" else self.runs / "truth" / f"{self.name}.json"
        truth = json.loads(truth_file.read_text())
        found = outcome(truth, answer)
        if found in RIGHT[truth["kind"]]:
            return ""
        return "false alarm" if truth["kind"] in ("none", "change") and answer["verdict"] in _NAMING else found


def stored_cases(runs: Path, measurements: Path) -> list[StoredCase]:
    """Return the stored cases of all sources under `runs` (inj, second, closed) and `measurements`."""
    folders = {"injections": runs / "inj", "second": runs / "second", "closed": runs / "closed"}
    found = [
        StoredCase(source, folder.name, folder, where)
        for source, where in folders.items()
        for folder in sorted((where / "cases").glob("*"))
    ]
    given = sorted(path.parent for path in measurements.glob("*/truth.json"))
    return [*found, *(StoredCase("given", folder.name, folder, measurements) for folder in given)]
