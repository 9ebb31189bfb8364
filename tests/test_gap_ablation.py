"""The ablation of the thresholds of `gap` (benchmarks/gap_ablation): its table of settings, its judgements and its page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.gap_ablation import page, run, steps
from benchmarks.gap_ablation.settings import KEPT_OUT, MERGED, OFF, changed, others
from benchmarks.gap_ablation.sources import StoredCase, stored_cases
from pipeline.gap.naming import validation_scores
from pipeline.gap.naming.selection_passes import PassInputs
from pipeline.gap.noise_and_edges import disparity_edges
from pipeline.gap.thresholds import Thresholds

KEYS = [f"{group}.{name}" for group, found in Thresholds().model_dump().items() for name in found]


def test_each_threshold_is_switched_off_or_stays_out_for_a_reason() -> None:
    assert sorted([*OFF, *KEPT_OUT]) == sorted(KEYS)
    assert set(MERGED) <= set(KEYS)


def test_settings_change_one_threshold_even_beyond_its_bounds() -> None:
    found = changed([("variance.least_gain", "off"), ("verdict.least_closed", "off")])
    assert found.variance.least_gain == OFF["variance.least_gain"]
    assert found.verdict.least_closed == OFF["verdict.least_closed"]
    assert found.mean.class_margin == Thresholds().mean.class_margin
    assert ("variance.least_gain", "off") in others("variance.least_gain")
    assert not others("points.most")


def _write(path: Path, found: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(found))


@pytest.fixture
def wall(tmp_path: Path) -> StoredCase:
    """A stored case of the second generator without an effect."""
    (tmp_path / "runs/second/cases/0001").mkdir(parents=True)
    _write(tmp_path / "runs/second/truth/0001.json", {"kind": "none", "effects": {}})
    (case,) = stored_cases(tmp_path / "runs", tmp_path / "measurements")
    return case


def test_a_name_where_there_is_nothing_is_a_false_alarm(wall: StoredCase) -> None:
    assert wall.judged({"verdict": "no_gap", "effects": []}) == ""
    named = {"name": "tls.wobble", "kind": "physical", "cannot_be_told_from": []}
    assert wall.judged({"verdict": "named", "effects": [named]}) == "false alarm"
    assert wall.judged({"verdict": "error", "error": "ValueError()", "effects": []}) == "no answer"


def test_a_case_is_diagnosed_again_only_where_a_decision_would_differ(
    wall: StoredCase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page counts the case in which the rule acts or the step is called, and that its answer becomes wrong."""
    out = tmp_path / "out"
    settings = [("variance.least_gain", "off"), ("step", "heavy tails")]

    def answered(folder: Path, thresholds: Any) -> dict[str, Any]:
        assert folder == wall.folder
        alarm = thresholds.variance.least_gain < 0
        return {"verdict": "unknown" if alarm else "no_gap", "effects": [], "wall_s": 1.0}

    _write(out / "second/0001/asked.json", {"asked": ["variance.least_gain"], "matters": [*map(list, settings)]})
    _write(out / "second/0001/usual.json", answered(wall.folder, Thresholds()))
    monkeypatch.setattr(run, "diagnosed", answered)
    assert run.jobs([wall], out, [], 9) == [(wall, each) for each in settings]
    assert run.jobs([wall], out, ["step=heavy tails"], 9) == [(wall, settings[1])]
    assert not run.jobs([wall], out, [], 0)
    for each in settings:
        run.again(wall, [each], "=".join(each), out)
    results = page.collect(out, [wall])
    assert {step for step, found in results["steps"].items() if found["diagnosed"]} == {"heavy tails"}
    assert results["thresholds"]["variance.least_gain"]["settings"]["off"]["became wrong"] == ["second 0001: false alarm"]
    earlier = {**results, "groups": [], "thresholds": {"mean.gone": results["thresholds"]["mean.class_margin"]}}
    written = page.page(*json.loads(json.dumps([results, earlier])), "make")
    assert "| heavy tails | 1 | 1 | 0 | 0 | 0 |" in written
    assert "| `mean.gone` | 3 | 0 | 0 | 0 | 0 | 0 | 0 | 0 | kept |" in written
    assert "| `variance.least_gain` | 6 | none | 1 | 1 | 1 | 1 | 1 | 0 | kept |" in written
    assert "| `variance.least_gain` | off | second 0001 | right to false alarm |" in written


def test_each_step_of_the_diagnosis_has_a_replacement_of_its_kind() -> None:
    for owner, name, nothing in steps.STEPS.values():
        assert callable(getattr(owner, name)) == callable(nothing), name


def test_steps_that_run_are_noted() -> None:
    """A function, the items of a tuple and a cached property are noted when they are used, and not before."""
    used: set[str] = set()
    with steps.noting_steps(used):
        assert not used
        assert validation_scores._groups([]) == []
        assert used == {"groups of effects validated"}
        assert list(disparity_edges._WINDOWS) == ["disc", "square"]
        inputs = PassInputs.__new__(PassInputs)
        inputs.__dict__["_best_single_effect"] = None
        assert inputs._best_single_effect is None
    assert used == {"groups of effects validated", "windows of edge fattening", "best single effect"}
    assert isinstance(disparity_edges._WINDOWS, tuple)


def test_answers_that_change_without_a_step_are_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("0001", "0002"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "measurement.yaml").touch()
    asked: list[tuple[str, list[str] | None]] = []

    def answer(folder: Path, off: list[str] | None = None) -> str:
        asked.append((folder.name, off))
        return "unknown: nothing named" if off == ["heavy tails"] and folder.name == "0002" else "no_gap: nothing named"

    monkeypatch.setattr(steps, "answer", answer)
    monkeypatch.setattr("sys.argv", ["steps", str(tmp_path), "--step", "heavy tails", "--step", "overtones of a wave"])
    steps.main()
    assert asked == [(name, off) for name in ("0001", "0002") for off in (None, ["heavy tails"], ["overtones of a wave"])]
    assert [line for line in capsys.readouterr().out.splitlines() if line.startswith(" ")] == [
        "  without heavy tails: unknown: nothing named"
    ]
