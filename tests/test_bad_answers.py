"""Test bad inputs that crashed, hung or filled the memory when they were first tried.

They are given directly to a single reader or equation.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile
from matplotlib.figure import Figure

from benchmarks.bad_inputs.exchange_cases import zlib_bomb
from pipeline.cli.main import main
from pipeline.comparison.comparison import compare_sensors
from pipeline.comparison.sensor_setups import SensorSetup
from pipeline.config.simulation import SimulationConfig
from pipeline.detection.inference.weights import check_detector
from pipeline.detection.products.run import detector_folder
from pipeline.detection.products.score_files import assess
from pipeline.formats.cameras.camera_files import read_lens
from pipeline.formats.cameras.colmap import read_colmap
from pipeline.formats.files.atomic import write_text
from pipeline.formats.measurements.checks import check_pixels
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.rasters.geotiff import read_tiff
from pipeline.formats.records.coco import read_coco
from pipeline.formats.records.result_records import read_run
from pipeline.measurement.units import check_same_unit
from pipeline.report.pictures import png
from pipeline.surface.mesh import SurfaceConfig, mesh_cloud
from scene.common.config import parse
from scene.common.errors import InputError
from scene.walls.imported import ImportedWall
from sensors.cameras.camera import Camera
from sensors.effects.range_intensity_bias import RangeIntensityBias
from sensors.models.placement import RigConfig, StationConfig

CAMERA = Camera(1000, 800, 1000.0, *[0.0] * 10, position=np.zeros(3), rotation=np.eye(3))


@pytest.mark.parametrize(
    ("values", "nodata", "words"),
    [
        (np.zeros((4, 5), np.complex64), "nan", "complex64"),
        (np.zeros((4, 5), np.float32), "none", "states 'none' as its value for missing data"),
        (np.full((4, 5), 1e300), "nan", "infinite or huge"),
    ],
)
def test_a_map_of_no_numbers_is_named(
    values: np.ndarray, nodata: str, words: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    tifffile.imwrite(tmp_path / "a.tif", values, extratags=[(42113, 2, 0, nodata, False)])
    with pytest.raises(InputError, match=words):
        read_tiff(tmp_path / "a.tif")
    assert capfd.readouterr().err == ""


def test_a_tile_that_becomes_gigabytes_is_refused(tmp_path: Path) -> None:
    """It is refused before decompression: a compressed tile of a few kilobytes can contain any number of zeros."""
    path = tmp_path / "bomb.tif"
    zlib_bomb(path, 0.05)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="becomes more than its 16,384 bytes of pixels"):
        read_tiff(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


@pytest.mark.parametrize("compression", ["zlib", "lzma", None])
def test_maps_of_other_programs_are_read(compression: str | None, tmp_path: Path) -> None:
    values = np.random.default_rng(1).normal(size=(100, 130)).astype(np.float32)
    tifffile.imwrite(tmp_path / "a.tif", values, compression=compression, tile=(64, 64))
    np.testing.assert_array_equal(read_tiff(tmp_path / "a.tif"), values)


@pytest.mark.parametrize("name", ["wall.obj", "wall.stl", "wall.ply"])
def test_a_mesh_of_sixty_gigabytes_is_refused_at_once(name: str, tmp_path: Path) -> None:
    with (tmp_path / name).open("wb") as file:
        file.write(b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n" if name.endswith("ply") else b"")
        file.truncate(60_000_000_000)
    with pytest.raises(InputError, match="has 60,000 MB"):
        ImportedWall(mesh=tmp_path / name).load()


def test_a_pipe_that_a_mesh_names_is_not_read(tmp_path: Path) -> None:
    """Reading it would never end."""
    os.mkfifo(tmp_path / "buffer")
    (tmp_path / "a.gltf").write_text('{"asset": {"version": "2.0"}, "buffers": [{"uri": "buffer"}]}')
    with pytest.raises(InputError, match="is a pipe"):
        ImportedWall(mesh=tmp_path / "a.gltf").load()


def test_a_mesh_of_two_coordinates_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n")
    with pytest.raises(InputError, match="coordinates"):
        ImportedWall(mesh=tmp_path / "a.obj").load()


def test_pixels_of_another_picture_are_named() -> None:
    points = np.random.default_rng(1).uniform([-3, -3, 9], [3, 3, 11], (100, 3))
    u, v = CAMERA.pixel(points[:, 0] / points[:, 2], points[:, 1] / points[:, 2])
    check_pixels(CAMERA, PointCloud(points, extra={"pixel_x": u + 3, "pixel_y": v}), "points")
    for wrong in (u + 60, np.full_like(u, 1e300), np.full_like(u, 5.0)):
        with pytest.raises(InputError, match="px from where the left camera sees"):
            check_pixels(CAMERA, PointCloud(points, extra={"pixel_x": wrong, "pixel_y": v}), "points")


def test_an_octree_finer_than_the_points_is_refused() -> None:
    points = np.random.default_rng(1).uniform([0, 0, 0], [10, 10, 0.1], (500, 3))
    with pytest.raises(InputError, match="smaller than the points' spacing"):
        mesh_cloud(points, np.zeros(500, np.int32), np.array([5, 5, 20.0]), SurfaceConfig(method="poisson", poisson_depth=16))


def test_powers_whose_median_is_0_have_a_reference() -> None:
    assert RangeIntensityBias(coefficient_m=0.01)._about(np.zeros(5)).reference_power == 1.0


def test_a_reference_of_one_place_is_named() -> None:
    points = np.random.default_rng(1).uniform(0, 10, (100, 3))
    with pytest.raises(InputError, match="vertices of the reference are at the same place"):
        check_same_unit(points, np.zeros((7, 3)), "scan", "m", "m")


@pytest.mark.parametrize("values", [{"distance_m": 1e300}, {"distance_m": 20.0, "height_m": -1e300}])
def test_a_sensor_stands_on_the_earth(values: dict[str, float]) -> None:
    for kind in (RigConfig, StationConfig):
        with pytest.raises(ValueError, match="100000"):
            kind(**values)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("surface a.xyz --seen-from 1e300 0 0 --out b.ply", "--seen-from: got '1e300'"),
        ("measurement a.xyz a.xyz --reference b.ply --scanner riegl_vz400i --out out", "a file is given twice"),
        ("measurement a.xyz --reference b.ply --scanner riegl_vz400i --position 1e300,0,0 --out out", "got '1e300,0,0'"),
        ("train a --out used", "add --resume to continue"),
        ("train a --out out --resume", "start a training without --resume"),
        ("detect baseline a.tif a.tif --out out", "is given 2 times"),
        ("gap a --out a.xyz/out", "cannot be used as a folder"),
        ("train a --out used --resume", "there is no training"),
        ("compare a.xyz --epochs=", "--epochs is empty"),
    ],
)
def test_a_bad_word_is_answered_at_once(
    words: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.xyz").write_text("0 0 0\n")
    Path("used").mkdir()
    Path("used/mine").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    assert main(words.split()) == 2
    told = capfd.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert said in told.err
    assert sorted(tmp_path.rglob("*")) == before


def test_an_argument_out_of_an_empty_variable_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    """Otherwise an empty argument would mean the current folder."""
    assert main(["detect", "baseline", "a.tif", "--out", ""]) == 2
    assert "an argument is empty" in capsys.readouterr().err


LENS = """%YAML 1.2
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 900., 0., 320., 0., 900., 240., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0., 0., 0., 0., 0. ]
"""


@pytest.mark.parametrize(
    ("old", "new"), [("640", ".Inf"), ("640", ".Nan"), ("640", "1e30"), ("640", "0.5"), ("900.", "1e300"), ("320.", "1e12")]
)
def test_a_calibration_has_the_bounds_of_our_own(old: str, new: str, tmp_path: Path) -> None:
    path = tmp_path / "lens.yaml"
    path.write_text(LENS)
    assert read_lens(path).width == 640
    path.write_text(LENS.replace(old, new, 1))
    with pytest.raises(InputError):
        read_lens(path)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("images.txt", "1 1e300 1e300 0 0 1 2 3 1 left.jpg"),
        ("images.txt", "1 1 0 0 0 1e300 2 3 1 left.jpg"),
        ("cameras.txt", "1 PINHOLE 1e300 1e300 1000 1000 320 240"),
        ("cameras.txt", "1 PINHOLE 640.5 480 1000 1000 320 240"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_a_colmap_model_has_the_bounds_of_our_own(name: str, line: str, tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 1000 1000 320 240\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 1 2 3 1 left.jpg\n\n")
    assert read_colmap(tmp_path)["left.jpg"].height == 480
    (tmp_path / name).write_text(f"{line}\n\n")
    with pytest.raises(InputError):
        read_colmap(tmp_path)


def test_what_is_no_character_is_written_as_an_escape(tmp_path: Path) -> None:
    """A file name in another encoding, with Python's surrogate characters, appears in a report."""
    write_text(tmp_path / "report.html", "h\udcf6he")
    assert (tmp_path / "report.html").read_text() == r"h\udcf6he"


@pytest.mark.filterwarnings("error")
def test_a_figure_takes_any_name() -> None:
    figure = Figure()
    figure.suptitle("cost$x_{ \x1b[31m \udcf6 \U0001f9d7\nsecond line")
    assert png(figure).startswith(b"\x89PNG")


def test_maps_measured_twice_are_named(tmp_path: Path) -> None:
    site = parse(SimulationConfig, {}, "test")
    (tmp_path / "a").mkdir()
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(InputError, match="is given twice"):
        compare_sensors([SensorSetup("site", "tls", site)], [tmp_path / "a", tmp_path / "b"])


def test_what_is_no_number_in_a_key_of_others_is_left_out(tmp_path: Path) -> None:
    """`detect` copies the images with all their keys, and JSON has no NaN."""
    image = {"id": 1, "file_name": "a.tif", "width": 2, "height": 2, "gsd_m": float("nan"), "more": {"a": [float("inf")]}}
    (tmp_path / "a.json").write_text(json.dumps({"images": [image], "annotations": [], "categories": []}))
    assert read_coco(tmp_path / "a.json").images[0] | {"id": 1} == {**image, "gsd_m": None, "more": {"a": [None]}}


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("external", "data in other files"),
        ("soft", "data in other files"),
        ("storage", "data in other files"),
        ("claims", "claims 4,00"),
    ],
)
def test_weights_hold_their_own_numbers(kind: str, said: str, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    folder = tmp_path / "detector"
    shutil.copytree(detector_folder("default"), folder)
    check_detector(folder)
    with h5py.File(folder / "model.weights.h5", "r+") as file:
        match kind:
            case "external":
                file["more"] = h5py.ExternalLink("/etc/passwd", "/a")
            case "soft":
                file["more"] = h5py.SoftLink("/none")
            case "storage":
                file.create_dataset("more", (10,), "f4", external=[("/etc/passwd", 0, 40)])
            case "claims":
                file.create_dataset("more", (10**9,), "f4", chunks=(1000,))
    with pytest.raises(InputError, match=said):
        check_detector(folder)


def test_more_pairs_than_memory_has_room_for_are_named(tmp_path: Path) -> None:
    image = {"id": 1, "file_name": "a.tif", "width": 20, "height": 20}
    block = {"image_id": 1, "category_id": 1, "bbox": [1, 1, 2, 2], "score": 0.9}
    entries = [{**block, "id": number} for number in range(1, 6000)]
    content = {"images": [image], "annotations": entries, "categories": [{"id": 1}]}
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="image 1 has 5,999 detections and 5,999 true blocks"):
        assess(tmp_path / "a.json", tmp_path / "a.json", kinds=("bbox",))


@pytest.mark.parametrize("rotation", [np.zeros((3, 3)), 2 * np.eye(3), 1e300 * np.eye(3), np.diag([1.0, 1.0, -1.0])])
@pytest.mark.filterwarnings("error")
def test_a_registration_in_a_record_is_a_rigid_motion(rotation: np.ndarray, tmp_path: Path) -> None:
    motion = {"rotation": rotation.tolist(), "translation_m": [0.0, 0.0, 0.0]}
    record = {"sensor": "tls", "config": {}, "epochs": [{"epoch": 1, "registration": motion}]}
    (tmp_path / "run.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"registration\.rotation"):
        read_run(tmp_path / "run.json", "run it again")


@pytest.mark.parametrize("content", ["", "\n", "\ufeff", "# nothing\n"])
def test_an_empty_config_is_not_taken_for_one(content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "site.yaml").write_text(content, encoding="utf-8")
    words = ["simulate", "--sensor", "tls", "--config", str(tmp_path / "site.yaml"), "--out", str(tmp_path / "out")]
    assert main(words) == 2
    assert "contains no key" in capsys.readouterr().err
