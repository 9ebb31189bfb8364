"""Several scans of one instrument in one diagnosis: one pose per set-up, and effects common to all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from gap_cases import WIDTH, write_scan
from numpy.testing import assert_allclose

from pipeline.formats.measurements.measurement import TlsMeasurement, read_measurement
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.e57 import E57Scan, write_e57
from pipeline.formats.points.points import read_points
from pipeline.gap.naming.workflow import diagnose
from pipeline.gap.report.report import to_dict
from pipeline.gap.residuals.alignment import compute_residuals, fit_pose_robustly
from pipeline.gap.residuals.sensor_view import SensorView
from pipeline.gap.residuals.several_scans import simulate_range_errors
from pipeline.gap.residuals.tls_residuals import TlsResiduals, with_scan_order
from pipeline.gap.survey.identifiability import identifiability
from pipeline.gap.survey.survey_views import Survey, measured_survey
from pipeline.measurement.build import Request, build
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from sensors.models.sensor_model import TlsModel

HERE, NEAR = (WIDTH * 0.42, -34.0, 2.5), (WIDTH * 0.55, -20.0, 1.0)


def index(offset_rad: float) -> Any:
    """Return a function that adds an error of the vertical index."""
    return lambda azimuth, zenith, line: (0 * azimuth, offset_rad + 0 * zenith)


def of(folder: Path, *scans: Any, **how: Any) -> TlsMeasurement:
    folder.mkdir()
    write_scan(folder, 5, scans=scans, **how)
    found = read_measurement(folder)
    assert isinstance(found, TlsMeasurement)
    return found


def rows_of(found: TlsResiduals, measurement: TlsMeasurement, number: int) -> Any:
    return measurement.scan_of[found.index] == number


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> TlsMeasurement:
    """Scans from two positions, without an effect."""
    return with_scan_order(of(tmp_path_factory.mktemp("scans") / "pair", (HERE, 1), (NEAR, 1), step_rad=0.02))


@pytest.fixture(scope="module")
def residuals(pair: TlsMeasurement) -> TlsResiduals:
    found = compute_residuals(pair)
    assert isinstance(found, TlsResiduals)
    return found


def test_each_scan_has_the_residuals_that_it_has_alone(pair: TlsMeasurement, residuals: TlsResiduals) -> None:
    for number, (_, rows, one) in enumerate(pair.each_scan()):
        alone = compute_residuals(one)
        here = residuals.part(rows_of(residuals, pair, number))
        assert_allclose(here.value, alone.value)
        assert (here.index == rows[alone.index]).all()
        assert_allclose(here.pose_jacobian[:, 6 * number : 6 * number + 6], alone.pose_jacobian)
        assert not here.pose_jacobian[:, 6 - 6 * number : 12 - 6 * number].any()


def test_every_set_up_is_registered_for_itself(pair: TlsMeasurement, residuals: TlsResiduals) -> None:
    """After each scan is moved by its own pose, the residuals are as linearised, to second order."""
    pose = np.array([0.004, -0.003, 0.002, 1e-5, 2e-5, -3e-5, -0.002, 0.001, 0.003, -2e-5, 1e-5, 4e-5])
    moved = compute_residuals(pair.moved(pose))
    common = np.isin(residuals.index, moved.index) & residuals.usable
    change = moved.values_at(moved.value, residuals.index)[common] - residuals.value[common]
    assert_allclose(np.quantile(np.abs(change + residuals.pose_jacobian[common] @ pose), 0.95), 0, atol=3e-4)
    assert len(fit_pose_robustly(residuals)[1]) == 12


def test_simulation_stands_where_each_scan_did(pair: TlsMeasurement, residuals: TlsResiduals) -> None:
    quiet = TlsModel(noise={"range_sigma_m": 0.0, "angle_sigma_rad": 0.0})
    found = simulate_range_errors(pair, quiet, residuals, KeyedRandom(1))
    assert_allclose(found[residuals.usable], 0, atol=1e-5)


def test_scans_lie_apart_as_the_scanner_sees_them(pair: TlsMeasurement, residuals: TlsResiduals) -> None:
    sight = SensorView.of(pair, residuals)
    first, second = (sight.coordinates[rows_of(residuals, pair, number), 0] for number in (0, 1))
    assert first.max() < second.min()
    assert_allclose(sight.points_at(np.arange(len(residuals)), sight.reference_m)[:, :2], residuals.wall_xy, atol=0.05)


def test_the_second_face_counts_angles_on(tmp_path: Path) -> None:
    """In the second face derivatives by the zenith change sign, those by the pose do not.

    Azimuths are rotated by pi, and zenith angles become 2 pi minus theirs.
    """
    both = of(tmp_path / "faces", (HERE, 1), (HERE, 2), step_rad=0.02)
    found = compute_residuals(both)
    assert isinstance(found, TlsResiduals)
    assert found.pose_jacobian.shape[1] == 6
    first, second = (found.part(rows_of(found, both, number)) for number in (0, 1))
    assert first.geometry.zenith.max() < np.pi < second.geometry.zenith.min()
    assert_allclose(np.median(second.geometry.azimuth) - np.median(first.geometry.azimuth), np.pi, atol=0.02)
    assert_allclose(np.median(second.geometry.by_zenith), -np.median(first.geometry.by_zenith), rtol=0.05)
    assert_allclose(np.median(second.pose_jacobian, axis=0), np.median(first.pose_jacobian, axis=0), rtol=0.1, atol=0.05)


@pytest.mark.slow
def test_an_ambiguous_effect_is_named_with_both_faces(tmp_path: Path) -> None:
    """The effect is a vertical index, which one face alone cannot tell from a vertical eccentricity."""
    how = {"step_rad": 0.012, "angles": index(3e-4)}
    alone = diagnose(of(tmp_path / "one", (HERE, 1), **how))
    assert alone.verdict == "ambiguous"
    assert {alone.effects[0].name, *alone.effects[0].indistinguishable} == {"tls.vertical_index", "tls.vertical_eccentricity"}
    measurement = of(tmp_path / "faces", (HERE, 1), (HERE, 2), **how)
    found = diagnose(measurement)
    assert found.verdict == "named"
    assert found.effects[0].name == "tls.vertical_index"
    assert found.effects[0].indistinguishable == ()
    assert found.effects[0].entry["offset_rad"] == pytest.approx(3e-4, abs=3 * found.effects[0].std["offset_rad"])
    assert "further_registrations" not in to_dict(found, measurement)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"scanners": [{"position_m": [0.0, 0.0, 0.0], "rotation": np.eye(3).tolist()}]}, "1 poses for 2 files"),
        ({"scanner": {"position_m": [0.0, 0.0, 0.0], "rotation": np.eye(3).tolist()}}, "replaces 'scanner'"),
        ({"scanners": [{"position_m": [0.0, 0.0, 0.0], "rotation": np.eye(3).tolist(), "face": 3}] * 2}, "face"),
    ],
)
def test_poses_that_are_not_one_for_each_file_are_refused(keys: dict[str, Any], said: str, tmp_path: Path) -> None:
    write_scan(tmp_path, 5, scans=[(HERE, 1), (HERE, 2)], step_rad=0.05)
    path = tmp_path / "measurement.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | keys))
    with pytest.raises(InputError, match=said):
        read_measurement(tmp_path)


def test_raw_scans_from_two_places_are_one_measurement(tmp_path: Path) -> None:
    """Two E57 scans with poses become one measurement with `scanners`, and a message says so.

    Half of one scan is no reference for the other.
    """
    write_scan(tmp_path, 5, scans=[(HERE, 1), (NEAR, 1)], step_rad=0.02)
    files = []
    for number, pose in enumerate(yaml.safe_load((tmp_path / "measurement.yaml").read_text())["scanners"]):
        cloud, rotation = read_points(tmp_path / f"scan_{number}.ply"), np.array(pose["rotation"])
        files.append(tmp_path / f"{number}.e57")
        write_e57(files[-1], [E57Scan("one", PointCloud(cloud.points, cloud.intensity), np.array(pose["position_m"]), rotation)])
    found = build(Request(files, str(tmp_path / "wall.ply"), "riegl_vz400i"), tmp_path / "out")
    assert "so it has its own pose" in found.summary()
    measurement = read_measurement(tmp_path / "out")
    assert isinstance(measurement, TlsMeasurement)
    assert len(measurement.scans) == 2
    assert measurement.fit.near > 0.95
    with pytest.raises(InputError, match="whose half is the reference"):
        build(Request(files, "half", "riegl_vz400i"), tmp_path / "halves")


def test_a_place_from_which_too_little_is_seen_is_not_asked_for(pair: TlsMeasurement, monkeypatch: pytest.MonkeyPatch) -> None:
    """A set-up with too few points does not prevent an answer."""

    def nothing(*_: Any) -> Any:
        raise InputError("240 of 358 points lie on smooth parts of the wall, 300 are needed", where="station")

    monkeypatch.setattr(Survey, "moved", nothing)
    found = identifiability(measured_survey(pair, 600))
    names = [each.name for each in found.extensions]
    assert names[0] == "the scan repeated in the second face"
    assert len(names) == 2
