"""Errors of the recorded angles that the catalogue lacks: they are described as empirical curves of an angle, exactly in the
model.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gap_cases import write_scan

from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.naming.workflow import diagnose
from sensors.effects.angle_empirical import AngleEmpirical
from sensors.numerics.curve import Axis, interpolate_on_host

CYCLES, AMPLITUDE = 20, 4e-4
"""Of the azimuth's error on the whole circle; it moves points by 15 mm along the wall."""


@pytest.mark.slow
def test_an_unevenly_divided_circle_is_described_by_its_own_curve(tmp_path: Path) -> None:
    """No other effect may be named, although the range changes look like the wall's slopes and like several effects."""
    write_scan(tmp_path, 11, step_rad=0.008, angles=lambda az, ze, line: (AMPLITUDE * np.sin(CYCLES * az + 0.5), 0.0 * az))
    found = diagnose(read_measurement(tmp_path))
    assert found.verdict == "unknown"
    (term,) = found.effects
    assert (term.effect, term.entry["angle"], term.entry["covariate"]) == (AngleEmpirical, "azimuth", "azimuth")
    assert term.entry["along"]["period"] == pytest.approx(2 * np.pi / CYCLES, rel=0.005)
    azimuth = np.linspace(1.0, 2.2, 200)
    curve = interpolate_on_host(azimuth, azimuth, Axis(**term.entry["along"]), Axis(), term.entry["values_rad"])
    np.testing.assert_allclose(curve, AMPLITUDE * np.sin(CYCLES * azimuth + 0.5), atol=0.1 * AMPLITUDE)
    assert found.gap is not None
    assert found.gap.closed is not None
    assert found.gap.closed > 0.9
