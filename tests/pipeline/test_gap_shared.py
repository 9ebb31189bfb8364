"""`scarpsim gap` on the shared measurements: the corrected model, measured against again, leaves no gap."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.formats.measurement import read_measurement, read_model
from pipeline.gap.naming.workflow import diagnose
from pipeline.gap.report.report import write

SHARED = Path(__file__).parents[3] / "shared" / "measurements"


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.exists(), reason="the shared measurements are not part of the project")
@pytest.mark.parametrize(("name", "verdict"), [("tls_one_effect", "named"), ("tls_outside_catalogue", "unknown")])
def test_a_second_gap_on_the_corrected_model_answers_no_gap(name: str, verdict: str, tmp_path: Path) -> None:
    measurement = read_measurement(SHARED / name)
    found = diagnose(measurement)
    assert found.verdict == verdict
    write(tmp_path, found, measurement)
    again = diagnose(measurement.changed(model=read_model(tmp_path / "model_after.yaml")))
    assert again.verdict == "no_gap"
    assert again.model_after == found.model_after
