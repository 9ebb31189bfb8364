"""Bad inputs that crashed, hung or filled the memory when they were first tried: what is asked of a single reader or equation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from pipeline.cli.main import main
from pipeline.formats.geotiff import read_tiff
from pipeline.formats.measurement_checks import check_pixels
from pipeline.formats.point_cloud import PointCloud
from pipeline.measurement.units import check_same_unit
from pipeline.surface.mesh import SurfaceConfig, mesh_cloud
from scene.errors import InputError
from sensors.camera import Camera
from sensors.effects.range_intensity_bias import RangeIntensityBias
from sensors.placement import RigConfig, StationConfig

CAMERA = Camera(1000, 800, 1000.0, *[0.0] * 10, position=np.zeros(3), rotation=np.eye(3))


@pytest.mark.parametrize(
    ("values", "nodata", "words"),
    [
        (np.zeros((4, 5), np.complex64), "nan", "complex64"),
        (np.zeros((4, 5), np.float32), "none", "states 'none' for no data"),
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


def test_pixels_of_another_picture_are_named() -> None:
    points = np.random.default_rng(1).uniform([-3, -3, 9], [3, 3, 11], (100, 3))
    u, v = CAMERA.pixel(points[:, 0] / points[:, 2], points[:, 1] / points[:, 2])
    check_pixels(CAMERA, PointCloud(points, extra={"pixel_x": u + 3, "pixel_y": v}), "points")
    for wrong in (u + 60, np.full_like(u, 1e300), np.full_like(u, 5.0)):
        with pytest.raises(InputError, match="px from where the left camera sees"):
            check_pixels(CAMERA, PointCloud(points, extra={"pixel_x": wrong, "pixel_y": v}), "points")


def test_an_octree_finer_than_the_points_is_refused() -> None:
    points = np.random.default_rng(1).uniform([0, 0, 0], [10, 10, 0.1], (500, 3))
    with pytest.raises(InputError, match="of the points' spacing"):
        mesh_cloud(points, np.zeros(500, np.int32), np.array([5, 5, 20.0]), SurfaceConfig(method="poisson", poisson_depth=16))


def test_powers_whose_median_is_0_have_a_reference() -> None:
    assert RangeIntensityBias(coefficient_m=0.01)._about(np.zeros(5)).reference_power == 1.0


def test_a_reference_of_one_place_is_named() -> None:
    points = np.random.default_rng(1).uniform(0, 10, (100, 3))
    with pytest.raises(InputError, match="vertices of the reference are the same place"):
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
        ("measurement a.xyz a.xyz --reference b.ply --scanner riegl_vz400i --out out", "names a file twice"),
        ("measurement a.xyz --reference b.ply --scanner riegl_vz400i --position 1e300,0,0 --out out", "got '1e300,0,0'"),
        ("train a --out used", "add --resume to go on"),
        ("train a --out out --resume", "begin it without --resume"),
        ("detect baseline a.tif a.tif --out out", "is given 2 times"),
        ("gap a --out a.xyz/out", "cannot be a folder to write into"),
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
