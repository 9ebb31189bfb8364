"""Incidence angles on a reference made from points, against closed forms: noise tilts its triangles, but not fitted planes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline.formats.measurements.config import MeasurementConfig
from pipeline.formats.measurements.measurement import TlsMeasurement, read_measurement
from pipeline.gap.naming.workflow import diagnose
from pipeline.gap.residuals.ray_hits import RayGeometry
from pipeline.gap.residuals.scan_simulation import predict_ranges
from pipeline.gap.residuals.tls_residuals import tls_residuals
from pipeline.measurement.build import Request, build
from pipeline.measurement.folder import Interpretation
from scene.common.config import parse
from scene.common.errors import InputError
from scene.geometry.point_planes import PointPlanes
from sensors.effects.range_incidence_bias import RangeIncidenceBias

HEIGHT_M = 1.7
NOISE_M = 0.0025


def scan(path: Path, bias_m: float = 0.0, swell_m: float = 0.0) -> Path:
    """Write a text file of ground 1.7 m below the scanner, line after line, with range noise of 2.5 mm.

    bias_m: adds bias (1 / cos i - 1) to the ranges, with i from the surface's own gradient; swell_m: amplitude of waves of 0.9 m.
    """
    rng = np.random.default_rng(8)
    azimuth, zenith = (
        each.ravel() for each in np.meshgrid(np.arange(-0.5, 0.5, 0.008), np.arange(1.9, 2.4, 0.004), indexing="ij")
    )
    ray = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=1)
    distance, wave = -HEIGHT_M / ray[:, 2], 2 * np.pi / 0.9
    for _ in range(60):
        x, y = (distance * ray[:, axis] for axis in (0, 1))
        distance = (-HEIGHT_M + swell_m * np.sin(wave * x) * np.cos(wave * y)) / ray[:, 2]
    x, y = (distance * ray[:, axis] for axis in (0, 1))
    gradient = swell_m * wave * np.stack([np.cos(wave * x) * np.cos(wave * y), -np.sin(wave * x) * np.sin(wave * y)], axis=1)
    normal = np.column_stack([-gradient, np.ones(len(ray))])
    cosine = -np.einsum("ni,ni->n", ray, normal) / np.linalg.norm(normal, axis=1)
    measured = distance + NOISE_M * rng.standard_normal(len(ray)) + bias_m * (1 / cosine - 1)
    np.savetxt(path, measured[:, None] * ray, fmt="%.6f")
    return path


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Interpretation:
    """The folder of level ground, one half of the points compared with the other."""
    folder = tmp_path_factory.mktemp("level")
    return build(Request([scan(folder / "ground.xyz")], "half", "riegl_vz400i", position=(0.0, 0.0, 0.0)), folder / "out")


@pytest.fixture(scope="module")
def level(built: Interpretation) -> TlsMeasurement:
    measurement = read_measurement(built.folder)
    assert isinstance(measurement, TlsMeasurement)
    return measurement


def slant_error(geometry: RayGeometry) -> np.ndarray:
    """Return the error (n,) of 1 / cos i; on level ground the true value is R / h."""
    return np.asarray(1 / geometry.cos_incidence - geometry.range_m / HEIGHT_M)


def test_planes_tell_the_incidence_where_triangles_lean(level: TlsMeasurement) -> None:
    planes, triangles = (np.std(slant_error(tls_residuals(each).geometry)) for each in (level, level.changed(planes=None)))
    assert triangles > 0.15, "corners 15 mm apart, with noise of 2.5 mm"
    assert planes < triangles / 5


def test_the_simulation_takes_the_same_incidence(level: TlsMeasurement) -> None:
    effect = RangeIncidenceBias(coefficient_m=0.01)
    biased = level.changed(model=level.model.model_copy(update={"effects": (effect,)}))
    geometry = tls_residuals(biased).geometry
    expected = 0.01 * (1 / geometry.cos_incidence - 1)
    np.testing.assert_allclose(predict_ranges(biased, geometry) - geometry.range_m, expected, atol=2e-7)


def test_a_bias_of_the_incidence_is_named_on_half_of_a_scan(tmp_path: Path) -> None:
    """A bias of 6 mm in the half of the scan that is compared is named.

    The waves have 2 cm, and triangle edges are 13 cm long at grazing incidence.
    """
    quiet, biased = (scan(tmp_path / f"{name}.xyz", bias, swell_m=0.02) for name, bias in (("quiet", 0.0), ("biased", 0.006)))
    build(Request([quiet], "half", "riegl_vz400i", position=(0.0, 0.0, 0.0)), tmp_path / "out")
    build(Request([biased], "half", "riegl_vz400i", position=(0.0, 0.0, 0.0)), tmp_path / "other")
    (tmp_path / "other/scan_0.laz").replace(tmp_path / "out/scan_0.laz")
    found = diagnose(read_measurement(tmp_path / "out"))
    (effect,) = found.effects
    assert (effect.name, effect.kind) == ("tls.range_incidence_bias", "physical")
    assert effect.std["coefficient_m"] < 0.0013
    assert abs(effect.entry["coefficient_m"] - 0.006) < 2 * effect.std["coefficient_m"]


def test_references_of_points_ask_for_planes(built: Interpretation) -> None:
    assert "planes through 24 of its points" in built.about["reference"][-1]
    assert yaml.safe_load((built.folder / "measurement.yaml").read_text())["incidence"] == "planes"


def test_planes_are_not_asked_for_where_nothing_looks_at_them() -> None:
    values = {"sensor": "stereo", "reference": "a.ply", "points": "b.ply", "model": "model.yaml", "incidence": "planes"}
    with pytest.raises(InputError, match="for laser scans only; remove it"):
        parse(MeasurementConfig, values, "measurement.yaml")


def test_normals_of_a_sphere_point_to_its_middle() -> None:
    """24 neighbours among 20,000 points on a sphere span 0.06 rad; a plane through them is tilted by a fraction of that."""
    vectors = np.random.default_rng(3).standard_normal((20_000, 3))
    radial = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    cosine = np.abs(np.einsum("ni,ni->n", PointPlanes.of(5 * radial, np.zeros(3)).normal, radial))
    assert np.degrees(np.arccos(np.clip(cosine, 0, 1))).max() < 3
    np.testing.assert_allclose(np.linalg.norm(PointPlanes.of(radial[:10], np.zeros(3)).normal, axis=1), 1, rtol=1e-12)
