"""The benchmark of what a diagnosis costs: every part is there, and the parts add up to the whole."""

from __future__ import annotations

from pathlib import Path

import pytest
from gap_cases import write_scan

from benchmarks import gap_cost
from benchmarks.gap_cost import PARTS, cost_of, main


def test_the_parts_of_a_diagnosis_add_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scan(tmp_path, 1, step_rad=0.02)
    found = cost_of(tmp_path)
    assert sum(found.parts.values()) == pytest.approx(found.seconds)
    assert set(found.parts) <= {*PARTS, "rest"}
    assert {"search: design and null", "noise", "gap"} <= set(found.parts)
    monkeypatch.setattr(gap_cost, "cost_of", {tmp_path: found}.__getitem__)
    main([str(tmp_path)])
    assert f"| {tmp_path.name} | tls |" in capsys.readouterr().out
