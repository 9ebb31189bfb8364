"""`scarpsim export`: exported files show the contents of the run or the data set."""

from __future__ import annotations

import hashlib
import io
import json
import sys
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image
from pycocotools import mask as coco_mask

from pipeline.change.annotate import BLOCK_CATEGORY, run_length_encoding
from pipeline.cli.main import main
from pipeline.config.simulation import SimulationConfig
from pipeline.export import pictures
from pipeline.export.perspective import PerspectiveView, draw_wall
from pipeline.export.yolo import grey_values, outline
from pipeline.formats.files.atomic import write_json
from pipeline.formats.meshes.ply import read_ply
from pipeline.formats.rasters.geotiff import read_tiff, write_geotiff
from pipeline.formats.records.run_files import RunFiles
from pipeline.run.simulation import simulate
from scene.common.config import parse
from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh

pytestmark = pytest.mark.usefixtures("undrawn")

SMALL: dict[str, Any] = {
    "seed": 3,
    "epochs": 2,
    "icp": None,
    "wall": {"style": "glendale", "width_m": 6.0, "height_m": 4.0, "resolution_m": 0.1, "seed": 1},
    "rockfall": {"count": 2, "size_m": {"kind": "gaussian", "mean": 0.5, "sigma": 0.05, "minimum": 0.3}},
    "station": {"distance_m": 20.0},
    "scanner": {"azimuth_step_rad": 0.003, "zenith_step_rad": 0.003},
    "difference": {"gsd_m": 0.06},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "run"
    simulate(parse(SimulationConfig, SMALL, "test"), "tls", out)
    return out


def export(*words: Any) -> int:
    return main(["export", *map(str, words), "--quiet"])


def test_a_place_is_drawn_where_it_projects() -> None:
    """A plane of 10 x 6 m with a square of 60 mm missing rock at about (7, 4): the square's colour appears at its projection."""
    corners = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [10.0, 6.0, 0.0], [0.0, 6.0, 0.0]])
    plane, grid = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)), Grid(0.0, 6.0, 0.1, 100, 60)
    difference = np.zeros(grid.shape)
    difference[15:25, 65:75] = 0.06
    view = PerspectiveView.on(corners, 400)
    pixels = draw_wall(view, plane, difference, grid, 0.03)
    assert pixels.shape == (view.height, 400, 3)
    (missing, calm), _ = view.project(np.array([[7.0, 4.0, 0.0], [2.0, 2.0, 0.0]]))
    red, _, blue = pixels[int(missing[1]), int(missing[0])].astype(int)
    assert red > blue + 50
    assert np.ptp(pixels[int(calm[1]), int(calm[0])]) < 12
    at, ahead = view.project(corners)
    assert (ahead > 0).all()
    assert (at >= 0).all()
    assert (at <= [view.width, view.height]).all()
    assert (pixels[0, 0] == 255).all()


@pytest.mark.usefixtures("drawn")
def test_a_run_as_picture_and_animations(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "_ANIMATED_PX", 320)
    monkeypatch.setattr(pictures, "_SCAN_FRAMES", 3)
    assert export(run, "picture", "--epoch", 2, "--width", 400, "--out", tmp_path / "a.png") == 0
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.width == 400
    read: list[int] = []
    surface = RunFiles.surface
    monkeypatch.setattr(RunFiles, "surface", lambda self, number: read.append(number) or surface(self, number))
    assert export(run, "epochs", "--out", tmp_path / "a.gif") == 0
    assert read == [0, 1, 2]
    with Image.open(tmp_path / "a.gif") as animation:
        assert animation.n_frames == 3  # the reference and two epochs
    assert export(run, "scan", "--out", tmp_path / "b.gif") == 0
    lit = []
    with Image.open(tmp_path / "b.gif") as animation:
        for number in (0, animation.n_frames // 2, animation.n_frames - 1):
            animation.seek(number)
            lit.append(int((np.asarray(animation.convert("L")) > 60).sum()))
    assert lit[0] < lit[1] < lit[2]


def test_a_run_as_gltf(run: Path, tmp_path: Path) -> None:
    """The wall and each visible niche are separate meshes; together they are the surface."""
    assert export(run, "gltf", "--out", tmp_path / "wall.glb") == 0
    scene = trimesh.load(tmp_path / "wall.glb")
    surface = read_ply(run / "epoch_001/surface.ply")
    assert set(scene.geometry) == {"wall", *(f"block_{label}" for label in np.unique(surface.face_block) if label)}
    assert sum(len(part.faces) for part in scene.geometry.values()) == len(surface.faces)
    np.testing.assert_allclose(scene.bounds, surface.bounds, atol=1e-5)


def test_a_run_as_copc(run: Path, tmp_path: Path) -> None:
    """It holds each point of points.laz once."""
    assert export(run, "copc", "--epoch", 2, "--out", tmp_path / "wall.copc.laz") == 0
    with laspy.CopcReader.open(tmp_path / "wall.copc.laz") as reader:
        found = reader.query()
    points = laspy.read(run / "epoch_002/points.laz")
    order, given = np.argsort(found.gps_time), np.argsort(points.gps_time)
    np.testing.assert_array_equal(np.asarray(found.block)[order], np.asarray(points.block)[given])
    np.testing.assert_allclose(np.stack([found.x, found.y, found.z], axis=1)[order], points.xyz[given], rtol=0, atol=2e-6)
    assert export(run, "copc", "--out", tmp_path / "wall.laz") == 2


def test_a_package_lists_every_file_with_its_checksum(run: Path, tmp_path: Path) -> None:
    assert export(run, "package", "--out", tmp_path / "datapackage.json") == 0
    made = json.loads((tmp_path / "datapackage.json").read_text())
    listed = {each["path"]: each for each in made["resources"]}
    assert set(listed) == {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}
    data = (run / "difference_001.tif").read_bytes()
    assert listed["difference_001.tif"]["hash"] == f"sha256:{hashlib.sha256(data).hexdigest()}"
    assert listed["difference_001.tif"]["bytes"] == len(data)
    assert len({each["name"] for each in made["resources"]}) == len(listed)


def test_a_package_refuses_links_out_of_its_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, other = tmp_path / "result", tmp_path / "other"
    for each in (folder, other):
        each.mkdir()
        (each / "a.json").write_text("{}")
    (folder / "b.json").symlink_to("a.json")
    assert export(folder, "package") == 0
    for name, target in (("c.json", other / "a.json"), ("d", other)):
        link = folder / name
        link.symlink_to(target)
        assert export(folder, "package", "--out", tmp_path / "package.json") == 2
        assert f"{link}: the path is a link out of the folder, to {target}" in capsys.readouterr().err
        link.unlink()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["epochs", "--epoch", "1"], "--epoch: the option works only with picture, gltf, scan"),
        (["picture", "--epoch", "9"], "--epoch: there is no epoch 9; allowed: 0 to 2"),
        (["gltf", "--out", "wall.obj"], "--out: the file name 'wall.obj' has another ending; allowed: .glb"),
        (["movie"], "got 'movie'; allowed: picture"),
        (["yolo"], "contains no split of a data set"),
    ],
)
def test_what_cannot_be_made_is_told_in_one_line(
    words: list[str], expected: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert export(run, *words) == 2
    told = capsys.readouterr().err
    assert expected in told
    assert told.count("\n") == 1


def masks() -> list[np.ndarray[Any, Any]]:
    """Masks of one part, of two parts, of one pixel, and of one with a bay."""
    blank = np.zeros((30, 40), dtype=bool)
    whole, parted, single, bay = blank.copy(), blank.copy(), blank.copy(), blank.copy()
    whole[5:12, 8:20] = True
    parted[2:9, 3:10] = parted[15:25, 12:30] = True
    single[7, 9] = True
    bay[3:20, 3:20] = True
    bay[8:20, 8:12] = False
    return [whole, parted, single, bay]


@pytest.mark.parametrize("number", range(4))
def test_an_outline_covers_its_mask(number: int) -> None:
    mask = masks()[number]
    points = outline(mask)
    drawn = np.zeros((300, 400), np.uint8)
    cv2.fillPoly(drawn, [np.round(10 * points).astype(np.int32)], 1)
    fine = np.kron(mask, np.ones((10, 10))).astype(bool)
    overlap = (drawn.astype(bool) & fine).sum() / (drawn.astype(bool) | fine).sum()
    assert overlap > (0.5 if mask.sum() == 1 else 0.93)
    rows, columns = np.nonzero(mask)
    np.testing.assert_allclose(points.min(axis=0), [columns.min(), rows.min()], atol=0.15)
    np.testing.assert_allclose(points.max(axis=0), [columns.max() + 1, rows.max() + 1], atol=0.15)
    assert outline(np.zeros((3, 3), dtype=bool)).shape == (0, 2)


@pytest.fixture
def tiles(tmp_path: Path) -> Path:
    """A set of one tile in two splits: 6 mm of added rock, one block of 0.4 m, one pixel without data."""
    values, mask = np.full((30, 40), -0.006, np.float32), masks()[0]
    values[0, 0], values[mask] = np.nan, 0.4
    for split in ("train", "val"):
        write_geotiff(tmp_path / "set" / split / "deep/a.tif", values, Grid(0.0, 3.0, 0.1, 40, 30))
        image = {"id": 7, "file_name": "deep/a.tif", "width": 40, "height": 30, "noise_sigma_m": 0.002}
        mask_of = run_length_encoding(mask, 0, 0, mask.shape)
        block = {"id": 1, "image_id": 7, "category_id": 1, "bbox": [8, 5, 12, 7], "segmentation": mask_of}
        content = {"images": [image], "annotations": [block], "categories": [BLOCK_CATEGORY]}
        write_json(tmp_path / "set" / split / "annotations.json", content)
    return tmp_path / "set"


def test_a_set_as_yolo_reads_it(tiles: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export(tiles, "yolo", "--out", tmp_path / "yolo") == 0
    assert "train: 1 images, 1 blocks" in capsys.readouterr().out
    described = yaml.safe_load((tmp_path / "yolo/data.yaml").read_text())
    assert described == {"train": "images/train", "val": "images/val", "names": {0: "block"}}
    with Image.open(io.BytesIO((tmp_path / "yolo/images/train/deep_a.png").read_bytes())) as picture:
        grey = np.asarray(picture)
    assert (grey[0, 0], grey[1, 1], grey[6, 9]) == (0, 128 - round(127 * 0.006 / 0.012), 255)
    label = [float(word) for word in (tmp_path / "yolo/labels/train/deep_a.txt").read_text().split()]
    assert label[0] == 0
    np.testing.assert_allclose([min(label[1::2]), max(label[1::2])], [8 / 40, 20 / 40], atol=0.15 / 40)
    np.testing.assert_allclose([min(label[2::2]), max(label[2::2])], [5 / 30, 12 / 30], atol=0.15 / 30)
    values = read_tiff(tiles / "train/deep/a.tif")
    np.testing.assert_array_equal(grey_values(values, ~np.isnan(values), 0.012), grey)


def test_a_set_as_hugging_face_reads_it(tiles: Path, tmp_path: Path) -> None:
    """Hugging Face's own library finds the splits, metres and missing data bit for bit, and the blocks' outlines."""
    datasets = pytest.importorskip("datasets", reason="the extra huggingface is not installed")
    assert export(tiles, "huggingface", "--out", tmp_path / "hub") == 0
    loaded = datasets.load_dataset(str(tmp_path / "hub"), cache_dir=str(tmp_path / "cache"))
    assert {split: len(rows) for split, rows in loaded.items()} == {"train": 1, "validation": 1}
    (tile,) = loaded["validation"]
    np.testing.assert_array_equal(np.asarray(tile["image"]), read_tiff(tiles / "val/deep/a.tif"))
    objects = tile["objects"]
    assert (objects["bbox"], objects["ignore"], objects["volume_m3"]) == ([[8.0, 5.0, 12.0, 7.0]], [0], [None])
    assert loaded["train"].features["objects"]["category"].feature.names == ["block"]
    mask = coco_mask.decode({"size": [tile["height"], tile["width"]], "counts": objects["segmentation"][0]})
    np.testing.assert_array_equal(mask.astype(bool), masks()[0])


def test_hugging_face_without_its_library_is_told_in_one_line(
    tiles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "datasets", None)
    assert export(tiles, "huggingface", "--out", tmp_path / "hub") == 2
    assert "make setup EXTRAS=huggingface" in capsys.readouterr().err
    assert not (tmp_path / "hub").exists()
