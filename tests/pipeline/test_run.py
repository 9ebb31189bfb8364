"""Whole, small runs: the folder, repeatability, resuming, survey coordinates, and errors that stop a run."""

from __future__ import annotations

import hashlib
import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import trimesh
from pictures import ENVIRONMENT, command
from pycocotools.coco import COCO

from pipeline.cli.main import main
from pipeline.config.simulation import SensorName, SimulationConfig, load_config
from pipeline.formats.meshes.ply import read_ply, write_ply
from pipeline.formats.points.e57 import read_e57
from pipeline.formats.points.laz import read_laz
from pipeline.formats.points.points import read_points
from pipeline.run import simulation as pipeline_run
from pipeline.run.simulation import simulate
from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.walls.procedural import ProceduralWall

pytestmark = pytest.mark.usefixtures("undrawn")

SMALL: dict[str, Any] = {
    "seed": 3,
    "wall": {"style": "glendale", "width_m": 8.0, "height_m": 5.0, "resolution_m": 0.08, "seed": 1},
    "rockfall": {"count": 5, "size_m": {"kind": "gaussian", "mean": 0.5, "sigma": 0.05, "minimum": 0.3}},
    "cameras": {"distance_m": 20.0, "base_m": 5.0},
    "depth_map": "low",
    "station": {"distance_m": 20.0},
    "scanner": {"azimuth_step_rad": 0.0025, "zenith_step_rad": 0.0025},
    "difference": {"gsd_m": 0.03},
}
FACING_AWAY = {
    "width": 1840,
    "height": 1228,
    "f_px": 2500.0,
    "position_m": [0.0, -20.0, 2.0],
    "rotation": [[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]],
}
SENSORS: tuple[SensorName, ...] = ("stereo", "tls")
TIMED = {"run.json"}
"""Files that hold wall times, and so differ from run to run."""


def config(**changes: Any) -> SimulationConfig:
    return parse(SimulationConfig, {**SMALL, **changes}, "test")


def digests(folder: Path) -> dict[str, str]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in TIMED)
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture(scope="module", params=SENSORS)
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[SensorName, Path]:
    out = tmp_path_factory.mktemp("run") / request.param
    simulate(config(), request.param, out)
    return request.param, out


@pytest.fixture(scope="module")
def two_epochs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("two_epochs") / "tls"
    simulate(config(epochs=2), "tls", out)
    return out


def test_the_folder_is_the_contracts(finished: tuple[SensorName, Path]) -> None:
    sensor, out = finished
    for epoch in ("epoch_000", "epoch_001"):
        present = {path.name for path in (out / epoch).iterdir()}
        assert {"points.laz", "surface.ply", "truth.ply", "blocks.json"} <= present
        assert ("depth_left.tif" in present) == (sensor == "stereo")
    assert json.loads((out / "epoch_000/blocks.json").read_text()) == []
    run = json.loads((out / "run.json").read_text())
    assert run["seed"] == 3
    assert run["complete"]
    assert run["backend"].startswith(("llvm", "cuda"))
    assert {"versions", "config", "wall_frame", "epochs", "seconds"} <= run.keys()
    html = (out / "report.html").read_text(encoding="utf-8")
    assert "data:image/png;base64," in html
    assert not list(out.rglob(".*"))


def test_the_difference_map_shows_the_blocks_with_the_right_sign_and_volume(finished: tuple[SensorName, Path]) -> None:
    _, out = finished
    with rasterio.open(out / "difference_001.tif") as raster:
        difference, transform = raster.read(1), raster.transform
        assert np.isnan(raster.nodata)
    assert (transform.a, transform.e) == pytest.approx((0.03, -0.03))
    record = json.loads((out / "run.json").read_text())["epochs"][1]
    assert record["statistics"]["inside_blocks"]["median_m"] > 0.05
    assert abs(record["statistics"]["outside_blocks"]["median_m"]) < 0.005
    for block in json.loads((out / "epoch_001/blocks.json").read_text()):
        assert block["volume_m3"] > 0
        assert block["measured_volume_m3"] == pytest.approx(block["volume_m3"], rel=0.35, abs=0.003)
        x, y, _ = block["position_m"]
        column, row = (round(float(value)) for value in ~transform @ (x, y))
        assert np.nanmax(difference[row - 3 : row + 3, column - 3 : column + 3]) > 0.03
    assert abs(record["volume_balance_m3"]) < 1e-9 * record["wall_volume_m3"]


def test_annotations_load_in_pycocotools_and_lie_on_the_niches(finished: tuple[SensorName, Path]) -> None:
    _, out = finished
    data_set = COCO(out / "annotations.json")
    assert [image["file_name"] for image in data_set.loadImgs(data_set.getImgIds())] == ["difference_001.tif"]
    with rasterio.open(out / "difference_001.tif") as raster:
        difference = raster.read(1)
    annotations = data_set.loadAnns(data_set.getAnnIds())
    assert sorted(annotation["block"] for annotation in annotations) == [1, 2, 3, 4, 5]
    volume = {block["label"]: block["volume_m3"] for block in json.loads((out / "epoch_001/blocks.json").read_text())}
    for annotation in annotations:
        depth = difference[data_set.annToMask(annotation) == 1]
        assert depth.sum() * 0.03**2 == pytest.approx(volume[annotation["block"]], rel=0.35, abs=0.003)


def test_points_and_surfaces_load_elsewhere_and_carry_the_truth(finished: tuple[SensorName, Path]) -> None:
    sensor, out = finished
    cloud = read_laz(out / "epoch_001/points.laz")
    assert ("true_range_m" if sensor == "tls" else "true_depth_m") in cloud.extra
    assert set(np.unique(cloud.extra["block"])) == {0, 1, 2, 3, 4, 5}
    assert (cloud.intensity is not None) == (cloud.gps_time is not None) == (sensor == "tls")
    for name in ("surface.ply", "truth.ply"):
        mesh = trimesh.load(out / "epoch_001" / name, process=False)
        assert len(mesh.faces) > 1000
        assert mesh.bounds[1][0] == pytest.approx(8.0, abs=0.3)


def test_the_same_seed_gives_the_same_bytes_with_one_and_two_threads(finished: tuple[SensorName, Path], tmp_path: Path) -> None:
    sensor, first = finished
    file = tmp_path / "config.yaml"
    file.write_text(json.dumps(SMALL))  # JSON is YAML
    words = ["--sensor", sensor, "--config", str(file), "--out", str(tmp_path / "one"), "--threads", "1", "--quiet"]
    subprocess.run(command("simulate", *words), check=True, env=ENVIRONMENT, timeout=300)
    assert digests(tmp_path / "one") == digests(first)


def test_run_json_is_the_config_of_the_same_run_again(finished: tuple[SensorName, Path]) -> None:
    sensor, out = finished
    again = load_config(out / "run.json", [], sensor, None)
    assert again == config()
    assert again.model_dump(mode="json") == json.loads((out / "run.json").read_text())["config"]


def test_an_interrupted_run_is_usable_and_resumes_to_the_same_bytes(
    two_epochs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    two = config(epochs=2)
    real = pipeline_run.observe_epoch

    def interrupted(settings: Any, site: Any, reference: Any, number: int, *rest: Any) -> Any:
        if number == 2:
            raise KeyboardInterrupt
        return real(settings, site, reference, number, *rest)

    out = tmp_path / "broken"
    monkeypatch.setattr(pipeline_run, "observe_epoch", interrupted)
    with pytest.raises(KeyboardInterrupt):
        simulate(two, "tls", out)
    assert COCO(out / "annotations.json").getImgIds() == [1]
    assert not json.loads((out / "run.json").read_text())["complete"]
    monkeypatch.setattr(pipeline_run, "observe_epoch", real)
    (out / ".epoch_002").mkdir()  # what a killed process leaves
    (out / ".epoch_002/points.laz").write_bytes(b"half")
    simulate(two, "tls", out, resume=True)
    assert digests(out) == digests(two_epochs)


def test_an_epoch_does_not_depend_on_the_epochs_before_it(
    finished: tuple[SensorName, Path], two_epochs: Path, tmp_path: Path
) -> None:
    sensor, one = finished
    two = two_epochs if sensor == "tls" else tmp_path / "two"
    if sensor != "tls":
        simulate(config(epochs=2), sensor, two)
    first, second = digests(one), digests(two)
    assert all(second[name] == digest for name, digest in first.items() if "001" in name)
    assert first["difference_001.tif"] != second["difference_002.tif"]


def test_a_wall_in_utm_coordinates_gives_products_in_those_coordinates(tmp_path: Path) -> None:
    offset = np.array([652_000.25, 4_921_000.5, 830.125])
    wall = ProceduralWall(style="glendale", width_m=8.0, height_m=5.0, resolution_m=0.05).mesh(KeyedRandom(1))
    write_ply(tmp_path / "wall.ply", wall.with_vertices(wall.vertices + offset))
    quiet = [{"sensor": "tls", "noise": {"range_sigma_m": 0.0, "angle_sigma_rad": 0.0}}]
    settings = config(wall={"mesh": str(tmp_path / "wall.ply")}, sensor=quiet)
    simulate(settings, "tls", tmp_path / "run")
    world, local = (read_laz(tmp_path / "run/epoch_000" / name).points for name in ("points_world.laz", "points.laz"))
    assert (world.min(axis=0) > wall.bounds[0] + offset - 0.01).all()
    assert (world.max(axis=0) < wall.bounds[1] + offset + 0.01).all()
    matrix = np.array(json.loads((tmp_path / "run/run.json").read_text())["wall_frame"]["matrix_world_to_wall"])
    np.testing.assert_allclose(world @ matrix[:3, :3].T + matrix[:3, 3], local, atol=5e-6)
    surface = read_ply(tmp_path / "run/epoch_001/surface_world.ply")
    assert np.abs(surface.bounds.mean(axis=0) - wall.bounds.mean(axis=0) - offset).max() < 0.2


def test_the_four_meshes_of_each_block_are_written_on_request(tmp_path: Path) -> None:
    simulate(config(products={"block_meshes": True}), "tls", tmp_path / "run")
    folder = tmp_path / "run/epoch_001/blocks"
    assert len(list(folder.iterdir())) == 5 * 4
    volumes = {block["label"]: block["volume_m3"] for block in json.loads((tmp_path / "run/epoch_001/blocks.json").read_text())}
    for label, volume in volumes.items():
        removed = trimesh.load(folder / f"block_{label:04d}_intersection.ply")
        assert removed.is_watertight
        assert removed.volume == pytest.approx(volume, rel=1e-3)


def test_points_are_written_in_other_formats_on_request(tmp_path: Path) -> None:
    simulate(config(products={"formats": ["ply", "xyz", "e57"]}), "tls", tmp_path / "run")
    folder = tmp_path / "run/epoch_000"
    expected = read_laz(folder / "points.laz")
    for suffix in ("ply", "xyz", "e57"):
        np.testing.assert_allclose(read_points(folder / f"points.{suffix}").points, expected.points, rtol=0, atol=2e-6)
    (scan,) = read_e57(folder / "points.e57")
    run = json.loads((tmp_path / "run/run.json").read_text())
    assert np.linalg.norm(scan.position[:2] - expected.points.mean(axis=0)[:2]) < 20
    assert set(scan.cloud.extra) == {"row", "column"}
    angle = expected.extra["scan_angle_rad"]  # of the nominal direction, from straight down, in steps of 0.006 degrees
    vertical = np.array(run["wall_frame"]["rotation"]) @ [0.0, 0.0, 1.0]
    ray = expected.points - scan.position
    zenith = np.arccos(ray @ vertical / np.linalg.norm(ray, axis=1))
    np.testing.assert_allclose(angle, np.pi - zenith, atol=1e-4)


def test_tiles_become_the_images_of_the_data_set(tmp_path: Path) -> None:
    simulate(config(tiles={"size_px": 64, "minimum_valid_share": 0.1}), "tls", tmp_path / "run")
    data_set = COCO(tmp_path / "run/annotations.json")
    for image in data_set.loadImgs(data_set.getImgIds()):
        with rasterio.open(tmp_path / "run" / image["file_name"]) as tile:
            assert tile.shape == (64, 64)
            assert tile.transform.c == pytest.approx(image["x_min_m"])


def test_a_folder_in_use_is_refused_with_the_way_on(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="choose another --out"):
        simulate(config(), "tls", tmp_path)
    with pytest.raises(InputError, match="contains no run"):
        simulate(config(), "tls", tmp_path / "nothing", resume=True)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_run_is_not_resumed_with_another_config(finished: tuple[SensorName, Path]) -> None:
    sensor, out = finished
    with pytest.raises(InputError, match="another config"):
        simulate(config(epochs=2), sensor, out, resume=True)


@pytest.mark.parametrize(
    ("sensor", "changes", "message"),
    [
        ("tls", {"station": {"position_m": [4.0, 30.0, 2.0]}}, "stands in or behind it"),
        ("stereo", {"cameras": {"left": {**FACING_AWAY, "position_m": [5.0, -20.0, 2.0]}, "right": FACING_AWAY}}, "both cameras"),
        ("tls", {"rockfall": {"count": 5, "size_m": 20.0}}, "larger than the wall"),
        ("tls", {"rockfall": {"count": 3000, "size_m": 0.5}}, "take 1,236 m2"),
        ("tls", {"difference": {"gsd_m": 1e-5}}, "GB"),
        ("tls", {"scanner": {"azimuth_step_rad": 1e-7, "zenith_step_rad": 1e-7}}, "pulses"),
        ("tls", {"wall": {"mesh": "nowhere.ply"}}, "no such file"),
    ],
)
def test_what_cannot_be_simulated_ends_in_one_clear_line(
    sensor: SensorName, changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        simulate(config(**changes), sensor, tmp_path / "run")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scaner: {}", "did you mean 'scanner'"),
        ("scanner: {azimuth_step: 1}", "did you mean 'azimuth_step_rad'"),
        ("scanner: {azimuth_step_rad: -1}", "greater than 0"),
        ("sensor: {sensor: tls, noise: {range_sigma_m: -0.001}}", "greater than or equal to 0"),
        ("sensor: {sensor: tls, effects: [{name: range_ofset}]}", "did you mean 'range_offset'"),
        ("sensor: {sensor: lidar}", "sensor: tls"),
        ("sensor: {sensor: stereo}", "give the other sensor with --sensor"),
        ("rockfall: {count: many}", "valid integer"),
        ("wall: {style: glendele}", "glendale"),
        ("wall: {style: glendale, mesh: a.ply}", "style"),
        ("[1, 2]", "not a mapping"),
        ("seed: [", "not valid YAML"),
        ("seed: .nan", "seed"),
    ],
)
def test_a_wrong_config_is_answered_with_the_right_key(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        load_config(file, [], "tls", None)


def test_a_bare_sensor_model_is_a_config(tmp_path: Path) -> None:
    """`simulate` accepts model_after.yaml, which `gap` writes, as --config and as --set sensor=FILE."""
    model = tmp_path / "model_after.yaml"
    model.write_text("sensor: tls\nnoise: {range_sigma_m: 0.004}\neffects: [{name: range_offset, offset_m: 0.002}]\n")
    full = tmp_path / "config.yaml"
    full.write_text("seed: 9\n")
    for loaded in (load_config(model, [], "tls", None), load_config(full, [f"sensor={model}"], "tls", None)):
        assert loaded.tls_model().noise.range_sigma_m == 0.004
        assert loaded.tls_model().effects[0].offset_m == 0.002


def test_paths_in_a_config_are_relative_to_its_folder(tmp_path: Path) -> None:
    (tmp_path / "site").mkdir()
    file = tmp_path / "site/config.yaml"
    file.write_text("wall: {mesh: wall.ply}\ncameras: cameras.yaml\n")
    loaded = load_config(file, [], "stereo", None)
    assert loaded.wall.mesh == tmp_path / "site/wall.ply"
    assert loaded.cameras.file == tmp_path / "site/cameras.yaml"


def test_a_path_that_is_a_loop_of_links_is_no_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "wall.ply").symlink_to("other.ply")
    (tmp_path / "other.ply").symlink_to("wall.ply")
    (tmp_path / "config.yaml").write_text("wall: {mesh: wall.ply}\n")
    command = ["simulate", "--sensor", "tls", "--config", str(tmp_path / "config.yaml"), "--out", str(tmp_path / "run")]
    assert main(command) == 2
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert message.startswith(f"error: {tmp_path}")
    assert "there is no such file" in message
