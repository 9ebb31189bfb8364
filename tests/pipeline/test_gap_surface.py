"""Clouds from photographs without cameras, against walls in closed form: verdicts, sizes, the scale, changes, and bad input."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy import stats
from surface_cases import HEIGHT, SIGMA, WIDTH, Array, cloud, depth, normals, write_cloud, write_wall

from pipeline.cli.main import main
from pipeline.formats.measurements.measurement import SurfaceMeasurement, read_measurement
from pipeline.formats.measurements.model_file import read_model
from pipeline.formats.meshes.ply import write_ply
from pipeline.formats.rasters.geotiff import write_geotiff
from pipeline.gap.mean.signatures import systematic_families
from pipeline.gap.naming.workflow import GapDiagnosis, diagnose
from pipeline.gap.report.report import to_dict
from pipeline.gap.residuals.alignment import align, compute_residuals
from pipeline.measurement.request import Request
from pipeline.measurement.surface import build_surface
from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh
from sensors.effects.surface_empirical import SurfaceEmpirical

KEYS = ("schema", "verdict", "effects", "where", "scene_changes", "sensor", "registration", "identifiability", "gap", "remaining",
        "seconds")  # fmt: skip
NULLS = 3
BOWL = 0.02


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("wall") / "wall.ply"
    write_wall(path)
    return path


@pytest.fixture(scope="module")
def coarse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same wall with fewer triangles, for tests in which chord errors do not matter."""
    path = tmp_path_factory.mktemp("wall") / "wall.ply"
    write_wall(path, step=0.15)
    return path


def built(wall: Path, folder: Path, points: Array, **asked: Any) -> SurfaceMeasurement:
    write_cloud(folder / "cloud.ply", points)
    build_surface(Request([folder / "cloud.ply"], str(wall), **asked), folder / "measurement")
    found = read_measurement(folder / "measurement")
    assert isinstance(found, SurfaceMeasurement)
    return found


def answered(wall: Path, folder: Path, seed: int, **how: Any) -> tuple[GapDiagnosis, dict[str, Any]]:
    measurement = built(wall, folder, cloud(seed, **how))
    found = diagnose(measurement)
    return found, to_dict(found, measurement)


def bowl(x: Array, z: Array) -> Array:
    """Return a deformation: zero in the wall's middle, BOWL in the middle of each margin, twice that in the corners."""
    return BOWL * (((x - WIDTH / 2) / (WIDTH / 2)) ** 2 + ((z - HEIGHT / 2) / (HEIGHT / 2)) ** 2)


@pytest.mark.slow
def test_clouds_with_noise_alone_leave_no_gap(wall: Path, tmp_path: Path) -> None:
    """The p-values are uniform by Kolmogorov-Smirnov, which one of a hundred right diagnoses fails."""
    p_values = []
    for seed in range(NULLS):
        (tmp_path / str(seed)).mkdir()
        found, answer = answered(wall, tmp_path / str(seed), seed + 1)
        assert answer["verdict"] == "no_gap"
        assert answer["effects"] == answer["scene_changes"] == []
        scale = answer["registration"]["scale_ppm"]
        assert abs(scale["value"]) < 4 * scale["std"]
        np.testing.assert_allclose(np.sqrt(np.mean(found.before**2)), SIGMA, rtol=0.03)
        p_values.append(answer["remaining"]["p_value"])
    assert stats.kstest(p_values, "uniform").pvalue > 0.01


@pytest.mark.slow
def test_the_files_of_a_bowl(wall: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The bowl is described over the place on the wall with its size; a simulation can load the model and then shows the bowl."""
    write_cloud(tmp_path / "cloud.ply", cloud(1, above=bowl))
    words = ["gap", str(tmp_path / "cloud.ply"), "--reference", str(wall), "--photographs", "--out", str(tmp_path / "out")]
    assert main([*words, "--quiet"]) == 0
    answer = json.loads((tmp_path / "out" / "gap.json").read_text())
    assert set(KEYS) <= set(answer)
    assert (answer["verdict"], answer["sensor"]) == ("unknown", "stereo")
    assert {effect["kind"] for effect in answer["effects"]} == {"empirical"}
    assert answer["gap"]["closed"] > 0.9
    assert answer["identifiability"]["names"] == []
    page = (tmp_path / "out" / "report.html").read_text()
    assert "the effects of stereo pairs need them and were not tested" in page
    assert "differs from the reference by more than its noise" in capsys.readouterr().out
    term = next(each for each in read_model(tmp_path / "out" / "model_after.yaml").effects if isinstance(each, SurfaceEmpirical))
    assert {term.covariate, term.second} == {"along", "up"}
    values = np.array(term.values_m)
    middle, corner = values[8, 8], values[[0, 0, -1, -1], [0, -1, 0, -1]].mean()
    assert corner - middle == pytest.approx(2 * BOWL, rel=0.1)
    known = {"verdict": "unknown", "scale": answer["registration"]["scale_ppm"]["value"]}
    assert abs(known["scale"]) < 300, "a bowl is no scale"


@pytest.mark.slow
@pytest.mark.parametrize("ppm", [500.0, -800.0])
def test_a_wrong_scale_is_said(ppm: float, wall: Path, tmp_path: Path) -> None:
    _, answer = answered(wall, tmp_path, 3, scale=1 + 1e-6 * ppm)
    found = answer["registration"]["scale_ppm"]
    assert abs(found["value"] - ppm) < 3 * found["std"]
    assert 10 < found["std"] < 150
    assert answer["verdict"] == "no_gap"


@pytest.mark.slow
def test_a_fallen_block_is_a_change(wall: Path, tmp_path: Path) -> None:
    """The block has 1 m x 1 m x 0.15 m."""
    _, answer = answered(wall, tmp_path, 2, niche=(8.0, 9.0, 0.15))
    (change,) = answer["scene_changes"]
    assert abs(change["volume_m3"] - 0.15) < 2.5 * change["volume_std_m3"]
    low, high = np.array(change["bbox_m"]).reshape(2, 3)
    assert (low[[0, 2]] < [7.7, 8.7]).all()
    assert (high[[0, 2]] > [8.3, 9.3]).all()
    assert answer["verdict"] == "no_gap"


def test_distances_places_and_slopes_are_those_of_the_wall(tmp_path: Path) -> None:
    """The cloud has no noise and lies 5 mm above the wall, at the right place."""
    write_wall(tmp_path / "wall.ply", step=0.08)
    points = cloud(1, sigma=0.0, above=lambda x, z: np.full_like(x, 0.005), moved=(0.0, 0.0, 0.0), turn_rad=0.0, points=4000)
    measurement = built(tmp_path / "wall.ply", tmp_path, points + 1e-4 * np.random.default_rng(2).standard_normal(points.shape))
    found = compute_residuals(measurement)
    assert len(found) == 4000
    np.testing.assert_allclose(np.median(found.value), 0.005, atol=2e-5)
    world = measurement.frame.to_world(found.geometry.point)
    np.testing.assert_allclose(world[:, 1], depth(world[:, 0], world[:, 2]), atol=4e-4)
    true = measurement.frame.direction_to_wall(normals(world[:, 0], world[:, 2]))
    assert np.median(np.einsum("ni,ni->n", true, found.geometry.normal)) > 0.9999
    assert systematic_families(found, measurement) == []


@pytest.fixture(scope="module")
def in_place(coarse: Path, tmp_path_factory: pytest.TempPathFactory) -> SurfaceMeasurement:
    """A cloud at its right place, with noise of 0.1 mm."""
    points = cloud(1, sigma=1e-4, moved=(0.0, 0.0, 0.0), turn_rad=0.0, points=3000)
    return built(coarse, tmp_path_factory.mktemp("in_place"), points)


@pytest.mark.parametrize("column", range(7))
def test_the_datum_is_differentiated(column: int, in_place: SurfaceMeasurement) -> None:
    """The derivatives by each of the seven datum parameters are compared with a cloud that is actually moved."""
    before = compute_residuals(in_place)
    step = np.eye(7)[column] * (2e-3 if column < 3 else 2e-4)
    after = compute_residuals(in_place.moved(step))
    change = after.values_at(after.value, before.index) - before.value
    np.testing.assert_allclose(change, -before.pose_jacobian @ step, atol=2e-4)
    there, _, pose = align(in_place.moved(step))
    np.testing.assert_allclose(there.cloud.points, in_place.cloud.points, atol=1e-3)
    np.testing.assert_allclose(pose, -step, atol=5e-4)


def test_a_plane_tells_no_scale(tmp_path: Path) -> None:
    """On a plane the scale cannot be determined, nor effects of roughness or slope, which differ there only by rounding."""
    x, z = (each.ravel() for each in np.meshgrid(np.linspace(0, 8, 90), np.linspace(0, 5, 60)))
    rng = np.random.default_rng(1)
    flat = np.stack([x, 0 * x, z], axis=1)
    number = np.arange(90 * 60).reshape(60, 90)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = np.concatenate([np.stack(each, axis=-1).reshape(-1, 3) for each in ((a, b, c), (a, c, d))]).astype(np.int32)
    write_ply(tmp_path / "plane.ply", TriangleMesh(flat, faces))
    points = np.stack([rng.uniform(0.3, 7.7, 3000), 0.002 * rng.standard_normal(3000), rng.uniform(0.3, 4.7, 3000)], axis=1)
    measurement = built(tmp_path / "plane.ply", tmp_path, points)
    found = compute_residuals(measurement)
    assert found.pose_jacobian.shape[1] == 3, "a shift and two turns"
    assert set(found.covariates) == {"along", "up", "edge_distance"}
    answer = to_dict(diagnose(measurement), measurement)
    assert answer["registration"]["scale_ppm"] == {"value": None, "std": None}
    assert answer["verdict"] == "no_gap"
    assert "too little relief" in answer["remaining"]["note"]


@pytest.mark.parametrize("share", [0.0, 0.8])
def test_the_noise_of_a_cloud_is_found(share: float, wall: Path, tmp_path: Path) -> None:
    """Both the size of the noise and the share that neighbours have in common are found.

    The common part has values on nodes 0.6 m apart, with the given share of the variance.
    """
    rng = np.random.default_rng(5)
    nodes = rng.standard_normal((60, 60)) * 1.5 * SIGMA * np.sqrt(share)

    def above(x: Array, z: Array) -> Array:
        i, j = (x / 0.6).astype(int), (z / 0.6).astype(int)
        a, b = x / 0.6 - i, z / 0.6 - j
        low = nodes[i, j] * (1 - a) + nodes[i + 1, j] * a
        return low * (1 - b) + (nodes[i, j + 1] * (1 - a) + nodes[i + 1, j + 1] * a) * b

    noise = built(wall, tmp_path, cloud(4, sigma=SIGMA * np.sqrt(1 - share), above=above, points=20_000)).model.noise
    assert noise.point_sigma_m == pytest.approx(SIGMA * np.sqrt(1 - share), rel=0.06)
    assert noise.point_shared_sigma_m == pytest.approx(1.5 * SIGMA * np.sqrt(share), rel=0.15, abs=2e-4)
    if share:
        assert noise.point_shared_step_m == pytest.approx(0.6, rel=0.4)
    assert (noise.parallax_sigma_px, noise.regularization_sigma_px) == (0.0, 0.0)


def test_meshes_and_elevation_models_are_taken_as_they_are(coarse: Path, tmp_path: Path) -> None:
    """The vertices of a mesh and the pixels of an elevation model are used as points."""
    copy = shutil.copy(coarse, tmp_path / "copy.ply")
    found = build_surface(Request([coarse], str(copy)), tmp_path / "mesh")
    assert "the vertices of a mesh" in found.about["points"][0]
    grid = Grid(0.0, 8.0, 0.1, 120, 80)
    x, y = np.meshgrid((np.arange(120) + 0.5) * 0.1, 8.0 - (np.arange(80) + 0.5) * 0.1)
    heights = depth(x, y) + 0.003 * np.random.default_rng(1).standard_normal(x.shape)
    for name, values in (("dem.tif", depth(x, y)), ("epoch.tif", heights)):
        write_geotiff(tmp_path / name, values.astype(np.float32), grid)
    found = build_surface(Request([tmp_path / "epoch.tif"], str(tmp_path / "dem.tif")), tmp_path / "dem")
    assert "the heights of an elevation model" in found.about["points"][0]
    assert read_model(tmp_path / "dem" / "model.yaml").noise.model_dump()["point_sigma_m"] == pytest.approx(0.003, rel=0.1)


BAD = {
    "elsewhere": "lie",
    "beside": "of the points lie near the reference",
    "millimetres": "--unit mm",
    "one point": "has only 1 points",
    "all NaN": "no point with finite values",
    "scanner": "needs laser scans",
    "half": "half works only with laser scans",
    "cameras too": "--photographs: the option cannot be combined with --cameras",
    "a model in pixels": "a model whose noise is in metres",
    "cameras in the model": "the model has effects of cameras (focal_length",
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_said_in_one_line(name: str, coarse: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    points, reference, more = cloud(1, points=2000), str(coarse), ["--photographs"]
    match name:
        case "elsewhere":
            points[:, 0] += 400.0
        case "beside":
            points[:, 1] += 9.0
        case "millimetres":
            points = 1000 * points
        case "one point":
            points = points[:1]
        case "all NaN":
            points = np.full_like(points, np.nan)
        case "scanner":
            more += ["--scanner", "riegl_vz400i"]
        case "half":
            reference = "half"
        case "cameras too":
            more += ["--cameras", "cameras.yaml"]
        case _:
            effects = [{"name": "focal_length", "camera": "left", "delta_px": 1.0}] if "cameras" in name else []
            (tmp_path / "model.yaml").write_text(yaml.safe_dump({"sensor": "stereo", "effects": effects}))
            more += ["--model", str(tmp_path / "model.yaml")]
    write_cloud(tmp_path / "cloud.ply", points)
    words = ["gap", str(tmp_path / "cloud.ply"), "--reference", reference, *more, "--out", str(tmp_path / "out"), "--quiet"]
    assert main(words) == 2
    told = capfd.readouterr().err.strip()
    assert BAD[name] in told
    assert len(told.splitlines()) == 1
    assert not (tmp_path / "out" / "measurement").exists()


def test_points_without_a_number_are_left_out_with_a_word(coarse: Path, tmp_path: Path) -> None:
    points = cloud(1, points=3000)
    points[:7] = np.nan
    write_cloud(tmp_path / "cloud.ply", points)
    found = build_surface(Request([tmp_path / "cloud.ply"], str(coarse)), tmp_path / "out")
    assert "7 points with coordinates that are not numbers are left out" in found.about["points"][0]


def test_what_a_cloud_alone_lacks_is_said(coarse: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """With or without a reference, a cloud does not say what measured it: the message names --photographs."""
    write_cloud(tmp_path / "cloud.ply", cloud(1, points=2000))
    for words in ([], ["--reference", str(coarse)]):
        assert main(["gap", str(tmp_path / "cloud.ply"), *words, "--out", str(tmp_path / "out")]) == 2
        assert "--photographs" in capfd.readouterr().err


def test_a_folder_without_cameras_needs_a_noise_in_metres(
    coarse: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    built(coarse, tmp_path, cloud(1, points=2000))
    (tmp_path / "measurement" / "model.yaml").write_text("sensor: stereo\n")
    assert main(["gap", str(tmp_path / "measurement"), "--out", str(tmp_path / "out")]) == 2
    assert "needs `cameras`, or a model whose noise is in metres" in capfd.readouterr().err
