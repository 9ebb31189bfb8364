"""Export to Metashape: consistent files, and a script that compiles and runs against a fake of Metashape's API."""

from __future__ import annotations

import ast
import py_compile
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from pipeline.formats.cameras.metashape import read_metashape
from pipeline.formats.rasters.geotiff import read_tiff
from pipeline.surface.depth_maps import DepthMap
from pipeline.surface.metashape_export import SCRIPT, write_metashape_export
from sensors.cameras.camera import Camera

LENS = {"b1": 3.0, "b2": -2.0, "k1": -0.05, "k2": 0.03, "k3": 0.0, "k4": 0.01, "p1": 1e-3, "p2": -7e-4}


def depth_map(x: float) -> DepthMap:
    camera = Camera(61, 41, 90.0, 1.0, -2.0, **LENS, position=np.array([x, 0.0, 100.0]), rotation=np.diag([1.0, -1.0, -1.0]))
    depth = 100 + np.add.outer(np.linspace(0, 1, 41) ** 2, np.linspace(0, 2, 61))
    depth[5:9, 7:20] = np.nan
    return DepthMap(camera, depth)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_metashape_export(tmp_path / "metashape", depth_map(-5.0), depth_map(5.0))
    return tmp_path / "metashape"


def test_depth_and_cameras_give_the_points_back(folder: Path) -> None:
    found = read_metashape(folder / "cameras.xml").cameras
    for side, source in (("left", depth_map(-5.0)), ("right", depth_map(5.0))):
        stored = read_tiff(folder / "depth" / f"{side}.tif").astype(float)
        assert ((stored == 0) == np.isnan(source.depth)).all()
        points = DepthMap(found[side], np.where(stored > 0, stored, np.nan)).points()
        np.testing.assert_allclose(points, source.points(), atol=1e-5)  # float32 at 100 m


def test_images_have_the_depth_maps_names_and_shape(folder: Path) -> None:
    for side in ("left", "right"):
        image = cv2.imread(str(folder / "images" / f"{side}.png"), cv2.IMREAD_UNCHANGED)
        assert image.shape == read_tiff(folder / "depth" / f"{side}.tif").shape
        assert image.std() > 1


class Shot:
    """A fake Metashape.Camera, which is a key of Metashape.DepthMaps."""

    def __init__(self, label: str) -> None:
        self.label, self.transform = label, None


class Chunk:
    """A fake Metashape.Chunk: the calls that the script makes, with the signatures of the Python Reference 2.2."""

    def __init__(self) -> None:
        self.label = ""
        self.cameras: list[Any] = []
        self.depth_maps: dict[Any, str] = {}

    def importDepthImages(  # noqa: N802 (Metashape's name)
        self, format: str = "", filenames: list[str] | None = None, color_filenames: list[str] | None = None,
        image_path: str = "", multiplane: bool = False,
    ) -> None:  # fmt: skip
        for depth, color in zip(filenames or [], color_filenames or [], strict=True):
            assert Path(depth).is_file()
            assert Path(color).stem == Path(depth).stem
            camera = Shot(Path(color).name)
            self.cameras.append(camera)
            self.depth_maps[camera] = depth
        assert Path(image_path.format(filename="left")).parent.is_dir()

    def importCameras(self, path: str, format: str) -> None:  # noqa: N802 (Metashape's name)
        known = read_metashape(Path(path)).cameras
        for camera in self.cameras:
            camera.transform = known[camera.label].rotation if camera.label in known else None


def test_the_script_loads_both_maps(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    chunk = Chunk()
    chunks = [Chunk(), chunk]
    document = SimpleNamespace(addChunk=lambda: chunks.pop())
    stand_in = SimpleNamespace(app=SimpleNamespace(document=document), CamerasFormatXML="xml")
    monkeypatch.setitem(sys.modules, "Metashape", stand_in)
    py_compile.compile(str(folder / "load_depth_maps.py"), doraise=True)
    runpy.run_path(str(folder / "load_depth_maps.py"))
    assert [camera.label for camera in chunk.cameras] == ["left", "right"]
    assert all(camera.transform is not None for camera in chunk.cameras)
    assert "Loaded: left, right" in capsys.readouterr().out
    (folder / "cameras.xml").write_text((folder / "cameras.xml").read_text().replace('label="right"', 'label="other"'))
    with pytest.raises(RuntimeError, match=r"without a pose: \['right'\]"):
        runpy.run_path(str(folder / "load_depth_maps.py"))


def test_the_script_is_python_3_8() -> None:
    """Metashape 2 brings Python 3.8 or newer."""
    ast.parse(SCRIPT, feature_version=(3, 8))
