"""The thresholds of `gap`: each has a unit, a description and a source, can be set, is recorded, and is used."""

from __future__ import annotations

import ast
import functools
import json
import re
from pathlib import Path

import pytest
from gap_cases import write_scan
from pydantic import BaseModel

from pipeline.cli.main import main
from pipeline.gap.naming.gap_score import Gap
from pipeline.gap.thresholds import Thresholds, read_thresholds, thresholds, use_thresholds

GAP = Path(__file__).parents[2] / "pipeline" / "gap"


@functools.cache
def _read() -> set[tuple[str, str]]:
    """Return the thresholds that code reads, from its syntax tree.

    They appear as thresholds().group.key, or as by.key where `by` was set to thresholds().group before.
    """
    found: set[tuple[str, str]] = set()
    for path in GAP.rglob("*.py"):
        group_of_by = ""
        for line in (
            ast.unparse(ast.parse(path.read_text())) if path.name not in ("thresholds.py", "noise_thresholds.py") else ""
        ).splitlines():
            if named := re.search(r"\bby = thresholds\(\)\.(\w+)$", line):
                group_of_by = named[1]
            found |= {(group, key) for group, key in re.findall(r"\b(?:thresholds\(\)|found\.thresholds)\.(\w+)\.(\w+)", line)}
            found |= {(group_of_by, key) for key in re.findall(r"\bby\.(\w+)", line)}
    return found


EVERY = [(group, key) for group, found in Thresholds().model_dump().items() for key in found]


@pytest.mark.parametrize(("group", "key"), EVERY)
def test_each_says_its_unit_what_it_decides_and_where_it_comes_from(group: str, key: str) -> None:
    model: type[BaseModel] = type(getattr(Thresholds(), group))
    field = model.model_fields[key]
    assert isinstance(field.json_schema_extra, dict)
    assert field.description
    assert field.description.endswith(".")
    assert field.json_schema_extra["unit"]
    assert field.json_schema_extra["source"]


@pytest.mark.parametrize(("group", "key"), EVERY)
def test_each_is_used_by_the_diagnosis(group: str, key: str) -> None:
    """A threshold that nothing reads would decide nothing."""
    assert (group, key) in _read()


def test_thresholds_hold_within_the_block_that_sets_them() -> None:
    gap = Gap(before=0.0015, after=0.0015, floor=0.001, error=0.0, floor_error=0.0001, points=100)
    assert gap.above_floor
    with use_thresholds(read_thresholds(["verdict.rejection_p=1e-8"])):
        assert thresholds().verdict.rejection_p == 1e-8
        assert not gap.above_floor
    assert gap.above_floor


def test_thresholds_are_set_by_the_command_and_written_down(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    case = tmp_path / "case"
    case.mkdir()
    write_scan(case, 1, step_rad=0.05)
    assert main(["gap", str(case), "--out", str(tmp_path / "out"), "--set", "points.fewest=900", "--quiet"]) == 0
    assert "900 are needed" in capsys.readouterr().out
    assert json.loads((tmp_path / "out/gap.json").read_text())["decisions"]["points"]["fewest"] == 900


@pytest.mark.parametrize("wrong", ["points.few=3", "mean.significance=2", "variance.least_gain=much", "mean.class_margin=.inf"])
def test_a_threshold_that_cannot_be_is_answered_in_a_sentence(
    wrong: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["gap", str(tmp_path), "--out", str(tmp_path / "out"), "--set", wrong]) == 2
    told = capsys.readouterr().err
    assert wrong.split("=")[0] in told
    assert "Traceback" not in told
    assert not (tmp_path / "out").exists()
