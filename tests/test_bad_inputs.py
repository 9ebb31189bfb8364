"""The bad inputs of benchmarks/bad_inputs, each given to its command: here, in this process, those that are refused on reading.

Those that need TensorFlow, or that are computed with, are tried by the benchmark, which also measures memory.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks.bad_inputs.case import Case, tried
from benchmarks.bad_inputs.materials import make_materials
from benchmarks.bad_inputs.run import all_cases, listed_cases, said

pytestmark = pytest.mark.usefixtures("undrawn")

AT_THE_DOOR = (
    "ev: ",
    "det: tiff",
    "det: coco",
    "icp: run.json",
    "view: ",
    "cal: run.json",
    "ds: verify ",
    "ds: config",
    "export: yolo",
    "det: frame",
)
LONG = (
    "cal: run.json products",
    "cal: run.json rotation",
    "cal: run.json epoch",
    "cal: run.json sigma",
    "cal: run.json block",
    "cal: run.json wall",
    "ev: 2000 of one place",
    "ev: 20000 of one place",
    "ev: 20000 images",
    "ev: 300 images of 15000",
    "ev: truth of 400 MB",
    "ev: polygon of a million",
    "ev: truth polygon of 100000",
    "ev: RLE of a million",
    "view: run products of a million",
)
"""With these a calibration runs, as it does not look at what is wrong, or seconds of work precede the answer: the benchmark's."""


@pytest.fixture(scope="module")
def materials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bad_inputs") / "materials"
    make_materials(folder, diagnosed=False)
    return folder


def chosen(prefix: str) -> list[Case]:
    return [case for case in all_cases() if case.name.startswith(prefix) and not case.name.startswith(LONG)]


@pytest.mark.slow
@pytest.mark.parametrize("prefix", AT_THE_DOOR)
def test_what_is_refused_on_reading(prefix: str, materials: Path, tmp_path: Path) -> None:
    bad = []
    for number, case in enumerate(chosen(prefix)):
        if set(case.needs) <= {path.name for path in materials.iterdir()}:
            outcome = tried(case, materials, tmp_path / str(number))
            bad += [said(outcome)] if outcome.problems else []
    assert bad == []


def test_every_listed_input_is_a_case() -> None:
    assert len(listed_cases()) == 71
    names = [case.name for case in all_cases()]
    assert len(names) == len(set(names)) > 3300


def test_a_bad_answer_is_told_from_a_good_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def answering(code: int, error: str, left: str = "") -> tuple[str, ...]:
        def main(words: list[str]) -> int:
            sys.stderr.write(error)
            if left:
                Path(left).touch()
            return code

        monkeypatch.setattr("pipeline.cli.main.main", main)
        folder = tmp_path / f"{code}{len(error)}{left}"
        return tried(Case("case", ("doctor",)), tmp_path, folder).problems

    assert answering(2, "error: a.yaml: is wrong; mend it\n") == ()
    assert answering(0, "") == ()
    assert answering(1, "error: a fault\n") == ("exit status 1",)
    assert answering(2, "error: one\nerror: two\n") == ("2 lines of error",)
    assert answering(2, "Traceback\n") == ("a traceback or a warning", "1 lines of error")
    assert answering(2, "error: a.yaml: is wrong\n", "out.json") == ("files were left or changed: out.json",)
