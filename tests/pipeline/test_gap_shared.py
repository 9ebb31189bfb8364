"""`scarpsim gap` on the shared measurements: the corrected model, measured against again, leaves no gap."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.formats.measurements.measurement import read_measurement
from pipeline.formats.measurements.model_file import read_model
from pipeline.gap.naming.workflow import diagnose
from pipeline.gap.report.report import write_report

SHARED = Path(__file__).parents[3] / "shared" / "measurements"


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.exists(), reason="the shared measurements are not part of the project")
def test_a_second_gap_on_the_corrected_model_answers_no_gap(tmp_path: Path) -> None:
    """The effect is outside the catalogue; test_gap.py tests one of the catalogue."""
    measurement = read_measurement(SHARED / "tls_outside_catalogue")
    found = diagnose(measurement)
    assert found.verdict == "unknown"
    write_report(tmp_path, found, measurement)
    again = diagnose(measurement.changed(model=read_model(tmp_path / "model_after.yaml")))
    assert again.verdict == "no_gap"
    assert again.model_after == found.model_after
