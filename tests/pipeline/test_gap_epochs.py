"""Measurements of several epochs, and stable areas given by the user."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from gap_cases import Scan, write_scan

from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.naming.workflow import GapDiagnosis, diagnose
from pipeline.gap.residuals.alignment import compute_residuals


def found_in(folder: Path, seed: int, **how: Any) -> GapDiagnosis:
    write_scan(folder, seed, step_rad=0.007, **how)
    return diagnose(read_measurement(folder))


def test_three_epochs_from_places_of_their_own_leave_no_gap_and_the_last_is_held_out(tmp_path: Path) -> None:
    """Each pose is off by a few millimetres and 30 microradians, which must not be taken for noise of the angles."""
    found = found_in(tmp_path, 21, epochs=3)
    assert (found.verdict, found.effects) == ("no_gap", ())
    epochs = read_measurement(tmp_path).epochs[found.residuals.index]
    assert found.held_out[epochs == 2].all()
    assert 0.05 < found.held_out[epochs < 2].mean() < 0.5


def test_an_effect_on_two_epochs_is_named(tmp_path: Path) -> None:
    found = found_in(tmp_path, 22, epochs=2, ranges=lambda scan: scan.R + 0.01 * (1 / scan.cos_i - 1))
    (effect,) = found.effects
    assert effect.name == "tls.range_incidence_bias"
    assert abs(effect.entry["coefficient_m"] - 0.01) < 4 * effect.std["coefficient_m"]


def half_that_moved(scan: Scan) -> Any:
    """Return ranges of a wall of which one half has crept up to 8 cm towards the scanner."""
    return scan.R - 0.08 * np.clip((scan.az - np.median(scan.az)) / np.ptp(scan.az), 0, None) * (1 + scan.z)


def still_half(folder: Path) -> list[float]:
    """Return the other half as a box in the wall frame."""
    residuals = compute_residuals(read_measurement(folder))
    azimuth = residuals.geometry.azimuth
    x = residuals.wall_xy[azimuth < (azimuth.min() + azimuth.max()) / 2 - 0.03, 0]
    return [float(x.min()), -1e3, float(x.max()), 1e3]


def test_ground_that_may_have_moved_has_no_say(tmp_path: Path) -> None:
    assert found_in(tmp_path, 23, ranges=half_that_moved).verdict != "no_gap"
    found = found_in(tmp_path, 23, ranges=half_that_moved, stable_areas=[still_half(tmp_path)])
    assert (found.verdict, found.effects) == ("no_gap", ())


def test_a_rockfall_beyond_stable_ground_is_reported(tmp_path: Path) -> None:
    write_scan(tmp_path, 16, fall=(20.0, 12.0, 0.4))
    (change,) = diagnose(read_measurement(tmp_path)).changes
    low, high = map(float, change.bounds[:, 0])
    x = compute_residuals(read_measurement(tmp_path)).wall_xy[:, 0]
    sides = ([float(x.min()), low - 1.0], [high + 1.0, float(x.max())])
    start, stop = max(sides, key=lambda side: side[1] - side[0])
    write_scan(tmp_path, 16, fall=(20.0, 12.0, 0.4), stable_areas=[[start, -1e3, stop, 1e3]])
    found = diagnose(read_measurement(tmp_path))
    assert (found.verdict, len(found.changes)) == ("no_gap", 1)
    assert np.allclose(found.changes[0].bounds, change.bounds, atol=0.5)
