"""`scarpsim export` of runs and data sets that were damaged after they were written: one line, and no file is left."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.cli.main import main
from pipeline.export.perspective import PerspectiveView
from pipeline.export.yolo import save_yolo
from pipeline.formats.files.atomic import write_json
from pipeline.formats.meshes.ply import write_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from pipeline.formats.rasters.geotiff import write_geotiff
from pipeline.formats.records.result_records import read_run
from pipeline.report.progress import Progress
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray, TriangleMesh

CORNERS = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [4.0, 3.0, 0.5], [0.0, 3.0, 0.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
FRAME = {"matrix_world_to_wall": np.eye(4).tolist(), "rotation": np.eye(3).tolist(), "origin_m": [0.0, 0.0, 0.0]}
Record = dict[str, Any]


def surface(places: FloatArray = CORNERS, faces: Any = FACES) -> TriangleMesh:
    return TriangleMesh(np.asarray(places, dtype=np.float64), faces)


def write_run(folder: Path, change: Callable[[Record], object] = lambda record: None) -> Path:
    """Write a run of one epoch with two triangles, its record changed by `change`."""
    record: Record = {"sensor": "tls", "config": {}, "wall": {"name": "w"}, "wall_frame": dict(FRAME)}
    record["epochs"] = [{"epoch": 0, "blocks": []}, {"epoch": 1, "blocks": [], "statistics": {"sigma_m": 0.01}}]
    change(record)
    for number in range(2):
        write_ply(folder / f"epoch_{number:03d}/surface.ply", surface())
        points = PointCloud(np.repeat(CORNERS, 30, axis=0), gps_time=np.arange(120.0))
        write_laz(folder / f"epoch_{number:03d}/points.laz", points)
    write_geotiff(folder / "difference_001.tif", np.zeros((30, 40), np.float32), Grid(0.0, 3.0, 0.1, 40, 30))
    write_json(folder / "run.json", record)
    return folder


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["export", *words, "--quiet"]) == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith("error: ")
    assert "\n" not in error
    return error


@pytest.mark.parametrize("form", ["picture", "gltf", "epochs"])
@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (surface(CORNERS * np.nan), "vertices with coordinates that are not numbers"),
        (surface(CORNERS * 1e300), "coordinates up to"),
        (surface(faces=FACES[:0]), "has no triangles"),
    ],
)
def test_a_spoilt_surface(
    mesh: TriangleMesh, message: str, form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run")
    for number in range(2):
        write_ply(run / f"epoch_{number:03d}/surface.ply", mesh)
    before = sorted(tmp_path.rglob("*"))
    out = run / f"a{ {'picture': '.png', 'gltf': '.glb', 'epochs': '.gif'}[form] }"
    assert message in refused([str(run), form, "--out", str(out)], capsys)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (PointCloud(np.empty((0, 3))), "has no points"),
        (PointCloud(np.zeros((5, 3))), "lie on one line of sight"),
        (PointCloud(CORNERS, gps_time=np.full(4, np.nan)), "no valid times"),
        (PointCloud(CORNERS, gps_time=np.array([0.0, 1.0, np.inf, np.inf])), "no valid times"),
        (PointCloud(CORNERS, gps_time=np.array([0.0, 1.0, 2.0, 1e300])), "no valid times"),
    ],
)
def test_spoilt_points(cloud: PointCloud, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "run")
    write_laz(run / "epoch_001/points.laz", cloud)
    assert message in refused([str(run), "scan", "--out", str(tmp_path / "a.gif")], capsys)


def test_few_points_make_few_frames(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    write_laz(run / "epoch_001/points.laz", PointCloud(CORNERS, gps_time=np.arange(4.0)))
    assert main(["export", str(run), "scan", "--out", str(tmp_path / "a.gif"), "--quiet"]) == 0
    with Image.open(tmp_path / "a.gif") as picture:
        assert getattr(picture, "n_frames", 1) <= 5


@pytest.mark.parametrize("change", [lambda epoch: epoch.pop("statistics"), lambda epoch: epoch.update(statistics=None)])
def test_an_epoch_without_statistics(
    change: Callable[[Record], object], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run", lambda record: change(record["epochs"][1]))
    assert "no statistics of epoch 1" in refused([str(run), "gltf", "--out", str(tmp_path / "a.glb")], capsys)


def test_an_epoch_without_a_list_of_blocks_has_none(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", lambda record: record["epochs"][1].pop("blocks"))
    assert [each["blocks"] for each in read_run(run / "run.json", "")["epochs"]] == [[], []]


@pytest.mark.parametrize("products", ["x", {"crs": 3}, {"crs": ["EPSG:28356"]}])
def test_products_that_are_none(products: Any, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", lambda record: record["config"].update(products=products))
    with pytest.raises(InputError, match="products"):
        read_run(run / "run.json", "")


@pytest.mark.parametrize("change", [{"rotation": [[1, 0], [0, 1]]}, {"matrix_world_to_wall": "e"}, {"origin_m": [0, 1e300, 0]}])
def test_a_frame_that_is_none(change: dict[str, Any], tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", lambda record: record["wall_frame"].update(change))
    with pytest.raises(InputError, match=f"wall_frame.{next(iter(change))}"):
        read_run(run / "run.json", "make it again")


@pytest.mark.parametrize("noise", ["low", [1], True, None, -1.0, 0])
def test_a_set_whose_noise_is_no_number(noise: Any, tmp_path: Path) -> None:
    image = {"id": 1, "file_name": "a.tif", "width": 4, "height": 4, "noise_sigma_m": noise}
    content = {"images": [image], "annotations": [], "categories": [{"id": 1, "name": "block"}]}
    (tmp_path / "train").mkdir()
    write_json(tmp_path / "train/annotations.json", content)
    with pytest.raises(InputError, match="--limit-m"):
        save_yolo(tmp_path, tmp_path / "out", None, Progress())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "places", [CORNERS * [1e-5, 100, 1], CORNERS * [0, 1, 0], np.array([[0.0, 0, 0], [1, 0, 0]]), np.eye(3) * [1e5, 1, 1]]
)
def test_a_picture_is_never_far_taller_than_wide(places: FloatArray) -> None:
    view = PerspectiveView.on(places, 400)
    assert view.width == 400
    assert view.height <= 1200
    at, ahead = view.project(places)
    assert (ahead > 0).all()
    assert ((at >= 0) & (at <= [view.width, view.height])).all()


@pytest.mark.parametrize("places", [np.zeros((7, 3)), np.arange(4.0)[:, None] * np.array([-0.42, -0.12, 1.0])])
def test_a_line_of_sight_is_no_picture(places: FloatArray) -> None:
    with pytest.raises(InputError, match="line of sight"):
        PerspectiveView.on(places, 400)
