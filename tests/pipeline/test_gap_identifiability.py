"""`scarpsim gap --identifiability`, before there are data: compared with a rigid fit of points in closed form; its files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gap_cases import HEIGHT, STEP, WIDTH, Array, Field, smooth_noise, unit, write_scan

from pipeline.cli.main import main
from pipeline.config.simulation import load_config
from pipeline.gap.survey.identifiability import Identifiability, format_table, identifiability
from pipeline.gap.survey.survey_views import planned_survey

pytestmark = pytest.mark.usefixtures("undrawn")

POSITION = np.array([WIDTH * 0.42, -34.0, 2.5])
SIGMA = 0.003


@pytest.fixture(scope="module")
def wall() -> Field:
    rng = np.random.default_rng(5)
    shape = int(WIDTH / STEP) + 1, int(HEIGHT / STEP) + 1
    return Field(0.8 * smooth_noise(shape, 9.0, rng))


@pytest.fixture(scope="module")
def found(wall: Field, tmp_path_factory: pytest.TempPathFactory) -> Identifiability:
    folder = tmp_path_factory.mktemp("site")
    wall.write(folder / "wall.ply")
    config = {
        "wall": {"mesh": "wall.ply"},
        "station": {"position_m": POSITION.tolist(), "rotation": np.eye(3).tolist()},
        "scanner": {"azimuth_step_rad": 0.004, "zenith_step_rad": 0.004},
        "sensor": {"sensor": "tls", "noise": {"range_sigma_m": SIGMA, "angle_sigma_rad": 0.0}},
    }
    (folder / "site.yaml").write_text(json.dumps(config))
    return identifiability(planned_survey(load_config(folder / "site.yaml", [], "tls", None), "tls"))


def moved_by(azimuth: Array, zenith: Array, distance: Array, name: str) -> Array:
    """Return recorded minus true points for a unit of an effect, by central differences of the effect's equation."""
    step = 1e-5
    errors = {
        "range_offset": (1.0, 0 * azimuth, 0 * azimuth),
        "vertical_index": (0.0, 0 * azimuth, 1 + 0 * azimuth),
        "collimation": (0.0, 1 / np.sin(zenith), 0 * azimuth),
        "trunnion_tilt": (0.0, 1 / np.tan(zenith), 0 * azimuth),
    }
    radial, across, down = errors[name]
    ahead, behind = (
        unit(azimuth + s * across, zenith + s * down) * (distance + s * radial)[:, None] for s in (step / 2, -step / 2)
    )
    return (ahead - behind) / step


def test_the_table_writes_shares_with_a_space(found: Identifiability) -> None:
    head, *rows = format_table(found).splitlines()
    for row, share in zip(rows, found.survival, strict=True):
        assert row[: head.index("detectable from")].endswith(f" {100 * share:.1f} %  ")


@pytest.mark.parametrize("name", ["range_offset", "vertical_index", "collimation", "trunnion_tilt"])
def test_survival_and_noise_are_those_of_a_rigid_fit_of_points(found: Identifiability, wall: Field, name: str) -> None:
    """Points that the effect has moved are fitted to the wall's planes by a shift and a rotation, weighted along the ray."""
    azimuth, zenith = (g.ravel() for g in np.meshgrid(np.arange(0.9, 2.4, 0.004), np.arange(0.7, 1.7, 0.004), indexing="ij"))
    ray = unit(azimuth, zenith)
    distance, cosine = wall.cast(POSITION, ray)
    kept = np.isfinite(distance) & (cosine > 0.25)
    azimuth, zenith, distance, ray = azimuth[kept], zenith[kept], distance[kept], ray[kept]
    point = distance[:, None] * ray
    there = POSITION + point
    _, by_x, by_z, _ = wall.at(there[:, 0], there[:, 2])
    normal = np.stack([by_x, -np.ones_like(by_x), by_z], axis=1)
    along = 1 / np.einsum("ni,ni->n", ray, normal)  # a displacement's distance from the plane, as range along the ray
    signature = along * np.einsum("ni,ni->n", moved_by(azimuth, zenith, distance, name), normal)
    rigid = along[:, None] * np.concatenate([normal, np.cross(point, normal)], axis=1)
    left = signature - rigid @ np.linalg.lstsq(rigid, signature, rcond=None)[0]
    row = found.names.index(f"tls.{name}")
    assert found.survival[row] == pytest.approx(np.linalg.norm(left) / np.linalg.norm(signature), rel=0.12)
    assert found.detectable_size_without_reference_error[row] == pytest.approx(5 * SIGMA / np.linalg.norm(left), rel=0.12)
    assert found.detectable_size[row] > found.detectable_size_without_reference_error[row]


def test_axis_errors_change_sign_in_the_second_face_and_part_from_the_pose(found: Identifiability) -> None:
    """[S, -S] is orthogonal to [J, J], so with both faces all of S remains: S/N 5 is reached at 5 sigma / (sqrt 2 |S|)."""
    second = next(each for each in found.extensions if "second face" in each.name)
    for name in ("vertical_index", "collimation", "trunnion_tilt"):
        row = found.names.index(f"tls.{name}")
        whole = found.detectable_size_without_reference_error[row] * found.survival[row]
        assert second.detectable_size[row] == pytest.approx(whole / np.sqrt(2), rel=0.05)
    drift, tilt = (found.names.index(f"tls.{name}") for name in ("tilt_drift", "trunnion_tilt"))
    assert second.cosines[drift, tilt] < 1e-6


def test_every_effect_of_the_catalogue_is_spoken_of(found: Identifiability) -> None:
    from sensors.effects import TLS_EFFECTS

    names = [*found.names, *(other.name for other in found.others)]
    assert sorted(names) == sorted(f"tls.{effect.model_fields['name'].default}" for effect in TLS_EFFECTS)


def test_a_config_gives_json_page_and_matrix_for_both_sensors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--set", "wall.width_m=12", "--set", "wall.height_m=9", "--set", "wall.resolution_m=0.08"]
    assert main(["gap", "--identifiability", "configs/demo.yaml", "--out", str(tmp_path), *small]) == 0
    record = json.loads((tmp_path / "identifiability.json").read_text())
    assert [survey["sensor"] for survey in record["surveys"]] == ["stereo", "tls"]
    stereo: dict[str, Any] = record["surveys"][0]
    x, phi = (stereo["names"].index(f"stereo.{name}") for name in ("principal_point_x", "camera_phi"))
    assert stereo["cosines"][x][phi] > 0.95
    assert all(len(pair["with"]) == 4 for survey in record["surveys"] for pair in survey["alike"])
    files = {path.name for path in tmp_path.iterdir()}
    assert files == {"identifiability.json", "identifiability_stereo.png", "identifiability_tls.png", "report.html"}
    assert "look alike" in capsys.readouterr().out


def test_a_measurement_gives_its_own_geometry_and_refuses_overrides(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_scan(tmp_path, 1, step_rad=0.008)
    assert main(["gap", "--identifiability", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out/identifiability.json").read_text())["surveys"][0]["points"] > 10_000
    assert main(["gap", "--identifiability", str(tmp_path), "--set", "seed=2"]) == 2
    assert "a measurement takes neither --set nor another --sensor" in capsys.readouterr().err
