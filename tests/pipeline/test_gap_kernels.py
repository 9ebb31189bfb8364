"""A diagnosis needs few small kernels, however many sets of effects are tried; an empty kernel cache has to compile them all."""

from __future__ import annotations

from pathlib import Path

import pytest
from kernels import kernels

from benchmarks.gap_closed_form.cases import Case, make
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.naming.workflow import GapDiagnosis, diagnose


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "kind", "most", "operations", "largest"),
    [("tls", "vertical_index", 25, 5000, 800), ("stereo", "focal_length", 18, 9500, 2400)],
)
def test_a_diagnosis_compiles_few_small_kernels(
    sensor: str, kind: str, most: int, operations: int, largest: int, tmp_path: Path
) -> None:
    """A diagnosis compiles few kernels with few operations.

    An earlier version compiled, for about 75,000 points, 76 kernels of 264,000 operations in all, the largest of 11,300 (laser
    scan), and 83 of 44,000 (stereo).
    """
    make(Case(0, (2, 1), "one", sensor, (kind,), 3_000, 6_000), tmp_path / "case", tmp_path / "truth.json", baselines=False)
    answers: list[GapDiagnosis] = []
    found = kernels(lambda: answers.append(diagnose(read_measurement(tmp_path / "case"))))
    assert f"{sensor}.{kind}" in {name for each in answers[0].effects for name in (each.name, *each.indistinguishable)}
    assert len(found) <= most
    assert sum(found.values()) <= operations
    assert max(found.values()) <= largest
