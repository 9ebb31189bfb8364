"""Points that a file has rounded: reported from a tenth of the model's noise on, refused above the noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from gap_cases import SIGMA, write_scan

from pipeline.formats.measurements.measurement import Measurement, read_measurement
from pipeline.formats.measurements.rounded_points import check_rounded_points
from pipeline.formats.meshes.ply import read_ply_points, write_ply_points
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from pipeline.gap.residuals.alignment import compute_residuals
from scene.common.errors import InputError


def rounded(folder: Path, steps: list[float]) -> Measurement:
    """Write a measurement whose points are rounded to steps along the scanner's x, y and z, m."""
    write_scan(folder, 1, step_rad=0.02)
    cloud = read_ply_points(folder / "scan_0.ply")
    write_ply_points(folder / "scan_0.ply", replace(cloud, points=np.rint(cloud.points / steps) * steps))
    return read_measurement(folder)


def test_the_error_along_the_lines_of_sight_is_that_of_uniform_rounding() -> None:
    """Lines of sight along (0.6, 0.8, 0), steps of 0.1 and 0.01 m: sqrt(0.06^2 + 0.008^2) / sqrt(12) = 17.5 mm."""
    points = np.array([600.0, 800.0, 0.0]) + np.random.default_rng(1).uniform(-1, 1, (4000, 3))
    points[:, :2] = np.rint(points[:, :2] / [0.1, 0.01]) * [0.1, 0.01]
    expected = np.hypot(0.6 * 0.1, 0.8 * 0.01) / np.sqrt(12)
    assert f"{1e3 * expected:.2g} mm along the lines of sight" in check_rounded_points(points, np.zeros(3), 0.02, "a.las")[0]
    with pytest.raises(InputError, match=r"^a.las: .*x in steps of 0.1 m, y in steps of 0.01 m: 17 mm .*allowed: up to 17 mm"):
        check_rounded_points(points, np.zeros(3), 0.0170, "a.las")
    assert check_rounded_points(points, np.zeros(3), 0.2, "a.las") == ()


def test_a_centimetre_is_told_and_a_millimetre_is_not(tmp_path: Path) -> None:
    """0.01 / sqrt(12) = 2.9 mm, just below the noise of 3 mm."""
    assert SIGMA == 0.003
    found = rounded(tmp_path, [0.01, 0.01, 0.01])
    (note,) = found.notes
    assert note.startswith("scan_0.ply: the coordinates are rounded, x in steps of 0.01 m")
    assert "2.9 mm along the lines of sight, and the model has a noise of 3 mm" in note
    assert note in compute_residuals(found).notes
    assert rounded(tmp_path, [0.001, 0.001, 0.001]).notes == ()


def test_rounding_that_outweighs_the_noise_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"scan_0.ply: .* x in steps of 0.0625 m.*allowed: up to 3 mm"):
        rounded(tmp_path, [0.0625, 0.015625, 1e-6])


def test_las_in_steps_of_a_centimetre_is_read(tmp_path: Path) -> None:
    write_scan(tmp_path, 1, step_rad=0.02)
    cloud = read_ply_points(tmp_path / "scan_0.ply")
    write_laz(tmp_path / "scan.laz", PointCloud(np.rint(cloud.points * 100) / 100))
    settings = yaml.safe_load((tmp_path / "measurement.yaml").read_text())
    (tmp_path / "measurement.yaml").write_text(yaml.safe_dump({**settings, "points": "scan.laz"}))
    assert "x in steps of 0.01 m" in read_measurement(tmp_path).notes[0]
