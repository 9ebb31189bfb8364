"""Camera files against the camera itself: round trips over the frame, OpenCV's own projection, one real lens in two formats."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.config.simulation import CamerasFile
from pipeline.formats.cameras.camera_files import read_lens, read_oriented, stereo_pair
from pipeline.formats.cameras.cameras import read_cameras_yaml, write_cameras_yaml
from pipeline.formats.cameras.colmap import read_colmap, read_map, write_colmap, write_map
from pipeline.formats.cameras.metashape import read_calibration, read_metashape, write_calibration, write_metashape
from pipeline.formats.cameras.opencv import read_opencv, read_opencv_text, write_opencv
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Camera, CameraPair

GLACIER = Path(__file__).parents[3] / "shared" / "data" / "stereo_glacier"
needs_glacier = pytest.mark.skipif(not GLACIER.is_dir(), reason=f"the real lens is not at {GLACIER}")

TANGENTIAL = {"p1": 4.8e-4, "p2": -5.4e-4}
OPENCV_LENS = {"b1": 3.25, "b2": 0.0, "k1": -0.081, "k2": 0.092, "k3": -0.013, "k4": 0.0, **TANGENTIAL}
METASHAPE_LENS = {**OPENCV_LENS, "b2": -1.5, "k4": 0.007}


def camera(lens: dict[str, float] | None = None, x: float = 0.0) -> Camera:
    rotation = Rotation.from_euler("xyz", [1.4, 0.1, 0.03 + x / 100]).as_matrix()
    interior = dict(lens or METASHAPE_LENS)
    return Camera(6013, 4008, 9263.45, 51.417, -44.406, **interior, position=np.array([x, -102.5, 31.25]), rotation=rotation)


def grid(of: Camera) -> tuple[FloatArray, FloatArray]:
    u, v = np.meshgrid(np.linspace(0, of.width, 25), np.linspace(0, of.height, 17))
    return u.ravel(), v.ravel()


def largest_difference_px(one: Camera, other: Camera, posed: bool = True) -> float:
    """Return the largest distance over the frame between where the two cameras image the same points, 100 m away, px."""
    u, v = grid(one)
    x, y = one.tangents(u, v)
    if posed:
        points = 100.0 * np.stack([x, y, np.ones_like(x)], axis=1) @ one.rotation.T + one.position
        local = (points - other.position) @ other.rotation
        x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    other_u, other_v = other.pixel(x, y)
    return float(np.hypot(other_u - u, other_v - v).max())


# ------------------------------------------------------------------ round trips


def test_metashape_camera_xml_round_trip(tmp_path: Path) -> None:
    cameras = {"left": camera(x=-14.0), "right & <co>": camera(OPENCV_LENS, x=14.0)}
    write_metashape(tmp_path / "cameras.xml", cameras)
    found = read_metashape(tmp_path / "cameras.xml")
    assert found.unaligned == ()
    assert list(found.cameras) == list(cameras)
    assert max(largest_difference_px(cameras[label], found.cameras[label]) for label in cameras) < 1e-9


def test_metashape_calibration_round_trip(tmp_path: Path) -> None:
    write_calibration(tmp_path / "lens.xml", camera())
    assert largest_difference_px(camera(), read_calibration(tmp_path / "lens.xml"), posed=False) < 1e-9


@pytest.mark.parametrize("suffix", [".xml", ".yml", ".yaml", ".json"])
def test_opencv_round_trip(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"lens{suffix}"
    write_opencv(path, camera(OPENCV_LENS))
    assert largest_difference_px(camera(OPENCV_LENS), read_opencv(path), posed=False) < 1e-9


@pytest.mark.parametrize(
    ("zero", "model"),
    [((), "FULL_OPENCV"), (("k3",), "OPENCV"), (("k1", "k2", "k3", "p1", "p2"), "PINHOLE")],
)
def test_colmap_round_trip(tmp_path: Path, zero: tuple[str, ...], model: str) -> None:
    lens = {name: 0.0 if name in zero else value for name, value in OPENCV_LENS.items()}
    cameras = {"left.png": camera(lens, x=-14.0), "day 2/right.png": camera(lens, x=14.0)}
    write_colmap(tmp_path, cameras, points=np.array([[0.0, 0.0, 30.0], [4.0, 1.0, 33.0]]))
    assert f" {model} 6013 4008 " in (tmp_path / "cameras.txt").read_text()
    found = read_colmap(tmp_path)
    assert list(found) == list(cameras)
    assert max(largest_difference_px(cameras[name], found[name]) for name in cameras) < 1e-9


def test_cameras_yaml_round_trip_to_the_bit(tmp_path: Path) -> None:
    pair = CameraPair(camera(x=-14.0), replace(camera(x=14.0), p1=1e-5, k4=1e-300))
    write_cameras_yaml(tmp_path / "cameras.yaml", pair)
    found = read_cameras_yaml(tmp_path / "cameras.yaml")
    for side in ("left", "right"):
        for name, value in vars(getattr(pair, side)).items():
            np.testing.assert_array_equal(getattr(getattr(found, side), name), value)


# ------------------------------------------------------------------ the other model, by its own implementation


def test_opencv_projects_where_the_camera_does(tmp_path: Path) -> None:
    """p1 and p2 change places and pixel centres differ by half a pixel: cv2.projectPoints is the oracle."""
    path, ours = tmp_path / "lens.yml", camera(OPENCV_LENS)
    write_opencv(path, ours)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix, distortion = storage.getNode("camera_matrix").mat(), storage.getNode("distortion_coefficients").mat()
    storage.release()
    u, v = grid(ours)
    x, y = ours.tangents(u, v)
    theirs = cv2.projectPoints(np.stack([x, y, np.ones_like(x)], axis=1), np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0]
    np.testing.assert_allclose(theirs + 0.5, np.stack([u, v], axis=1), atol=1e-9)


def test_colmap_keypoints_are_the_projections(tmp_path: Path) -> None:
    points = np.array([[0.0, 0.0, 30.0], [4.0, 1.0, 33.0]])
    write_colmap(tmp_path, {"left.png": camera(OPENCV_LENS)}, points=points)
    keypoints = np.array((tmp_path / "images.txt").read_text().splitlines()[1].split(), dtype=float).reshape(2, 3)
    local = (points - camera().position) @ camera().rotation
    u, v = camera(OPENCV_LENS).pixel(local[:, 0] / local[:, 2], local[:, 1] / local[:, 2])
    np.testing.assert_allclose(keypoints, np.stack([u, v, [1, 2]], axis=1), atol=1e-9)


@pytest.mark.parametrize("parameter", ["b2", "k4"])
def test_a_parameter_without_counterpart_is_named(tmp_path: Path, parameter: str) -> None:
    lens = {**OPENCV_LENS, parameter: METASHAPE_LENS[parameter]}
    for write in (
        lambda: write_opencv(tmp_path / "lens.yml", camera(lens)),
        lambda: write_colmap(tmp_path, {"a": camera(lens)}),
    ):
        with pytest.raises(InputError, match=f"{parameter} = .* has no counterpart"):
            write()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("place", "name"), [(5, "k4"), (7, "k6"), (8, "s1")])
def test_an_opencv_coefficient_without_counterpart_is_named(tmp_path: Path, place: int, name: str) -> None:
    distortion = np.zeros(8 if place < 8 else 12)
    distortion[place] = 0.01
    numbers = [640, 480, 500, 0, 320, 0, 500, 240, 0, 0, 1, *distortion]
    path = tmp_path / "lens.txt"
    path.write_text(" ".join(map(str, numbers)))
    with pytest.raises(InputError, match=f"{name} = 0.01 has no counterpart in Metashape"):
        read_opencv_text(path)
    path.write_text(" ".join(map(str, [*numbers[:11], *np.zeros(8)])))
    assert read_opencv_text(path).f_px == 500


def test_colmap_refuses_models_beyond_ours(tmp_path: Path) -> None:
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    for line, what in (
        ("1 OPENCV_FISHEYE 640 480 500 500 320 240 0 0 0 0", "OPENCV_FISHEYE is not supported"),
        ("1 FULL_OPENCV 640 480 500 500 320 240 0 0 0 0 0 0.5 0 0", "k4 = 0.5"),
        ("1 PINHOLE 640 480 500 500 320", "allowed: width, height and fx, fy, cx, cy"),
        ("2 PINHOLE 640 480 500 500 320 240", "names the camera 1"),
    ):
        (tmp_path / "cameras.txt").write_text(f"# comment\n{line}\n")
        with pytest.raises(InputError, match=what):
            read_colmap(tmp_path)
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_RADIAL 640 480 500 320 240 -0.1\n")
    found = read_colmap(tmp_path)["a.png"]
    assert (found.f_px, found.cx_px, found.cy_px, found.k1) == (500, 0, 0, -0.1)


# ------------------------------------------------------------------ Metashape's conventions

EXPORT = """<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
  <sensors next_id="1"><sensor id="0" label="D810" type="frame">
    <resolution width="7360" height="4912"/>
    <calibration type="frame" class="initial"><resolution width="7360" height="4912"/><f>9999</f></calibration>
    <calibration type="frame" class="adjusted"><resolution width="7360" height="4912"/><f>10250.5</f><k1>-0.05</k1></calibration>
  </sensor></sensors>
  <components next_id="2" active_id="0">
    <component id="0"><transform><rotation locked="true">0 -1 0 1 0 0 0 0 1</rotation>
      <translation locked="true">500000 4000000 1500</translation><scale locked="true">2.5</scale></transform></component>
    <component id="1"/>
  </components>
  <cameras next_id="4" next_group_id="1">
    <camera id="0" sensor_id="0" component_id="0" label="A"><transform>1 0 0 4 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>
    <group id="0" label="g" type="folder">
      <camera id="1" sensor_id="0" component_id="1" label="B"><transform>1 0 0 4 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>
    </group>
    <camera id="2" sensor_id="0" component_id="0" label="C"/>
  </cameras>
  <transform><translation>7 8 9</translation></transform>
</chunk></document>"""


def test_metashape_conventions(tmp_path: Path) -> None:
    """Adjusted calibration, missing tags zero, component before chunk transform, groups, cameras that were not aligned."""
    path = tmp_path / "export.xml"
    path.write_text(EXPORT)
    found = read_metashape(path)
    assert found.unaligned == ("C",)
    a, b = found.cameras["A"], found.cameras["B"]
    assert (a.f_px, a.k1, a.k2, a.cx_px, a.b1) == (10250.5, -0.05, 0, 0, 0)
    np.testing.assert_allclose(a.position, [500000, 4000010, 1500])
    np.testing.assert_allclose(a.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(b.position, [11, 8, 9])
    np.testing.assert_allclose(b.rotation, np.eye(3), atol=1e-12)


def test_metashape_parameters_and_motions_of_zero_change_nothing(tmp_path: Path) -> None:
    path = tmp_path / "export.xml"
    harmless = EXPORT.replace("<k1>", "<p3>0</p3><k1>")
    path.write_text(harmless.replace("</transform></camera>", "</transform><rolling_shutter>0 0 0</rolling_shutter></camera>"))
    assert read_metashape(path).cameras["A"].k1 == -0.05


def test_a_camera_of_a_rig_is_no_unaligned_one(tmp_path: Path) -> None:
    path = tmp_path / "export.xml"
    path.write_text(EXPORT.replace('label="C"', 'label="C" master_id="0"'))
    found = read_metashape(path)
    assert (found.unaligned, found.rigged) == ((), ("C",))
    with pytest.raises(InputError, match="'C' belongs to a rig"):
        stereo_pair(found, "A", "C", "export.xml")


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ('type="frame">\n', 'type="fisheye">\n', "model 'fisheye'"),
        ("<f>10250.5</f>", "", "no f"),
        ("<k1>-0.05</k1>", "<k1>minus</k1>", "the value must have 1 numbers, but is 'minus'"),
        ("<k1>-0.05</k1>", "<k1>-50</k1>", "folds the image"),
        ('label="B"', 'label="A"', "labelled 'A'"),
        ('sensor_id="0" component_id="0" label="A"', 'component_id="0" label="A"', "sensor of camera"),
        ("0 -1 0 1 0 0 0 0 1<", "0 1 0 1 0 0 0 0 1<", "not a rotation"),
        (">2.5<", ">-2.5<", "scale -2.5"),
        ("<document", "<!DOCTYPE x><document", "entities"),
        ("</document>", "", "not valid XML"),
        ("document", "calibration", "not a Metashape camera XML"),
        ("<k1>-0.05</k1>", "<k1>-0.05</k1><p3>0.001</p3>", "lens parameter p3 = 0.001"),
        (
            "0 0 0 1</transform></camera>",
            "0 0 0 1</transform><rolling_shutter>0 0.002 0 0 0 0</rolling_shutter></camera>",
            "camera A: the camera was aligned with rolling shutter compensation",
        ),
    ],
)
def test_metashape_mistakes_are_named(tmp_path: Path, old: str, new: str, what: str) -> None:
    path = tmp_path / "export.xml"
    path.write_text(EXPORT.replace(old, new))
    with pytest.raises(InputError, match=what):
        read_metashape(path)


# ------------------------------------------------------------------ which reader, which pair


def test_a_pair_is_told_by_content(tmp_path: Path) -> None:
    left, right = camera(OPENCV_LENS, x=-14.0), camera(OPENCV_LENS, x=14.0)
    write_metashape(tmp_path / "no_suffix", {"b": right, "a": left})
    write_colmap(tmp_path / "sparse", {"b.png": right, "a.png": left})
    write_cameras_yaml(tmp_path / "cameras.yaml", CameraPair(left, right))
    for name in ("no_suffix", "sparse", "sparse/images.txt", "cameras.yaml"):
        pair = CamerasFile(file=tmp_path / name).pair()
        assert largest_difference_px(left, pair.left) < 1e-9
        assert largest_difference_px(right, pair.right) < 1e-9
    for name in ("sparse", "sparse/images.txt"):
        files = {file.relative_to(tmp_path / "sparse").as_posix() for file in CamerasFile(file=tmp_path / name).files()}
        assert files == {"cameras.txt", "images.txt", "points3D.txt"}
    named = CamerasFile(file=tmp_path / "no_suffix", left="b", right="a").pair()
    assert largest_difference_px(right, named.left) < 1e-9


def test_the_pair_has_to_be_clear(tmp_path: Path) -> None:
    path = tmp_path / "export.xml"
    path.write_text(EXPORT)
    with pytest.warns(UserWarning, match="not aligned: C"):
        CamerasFile(file=path).pair()
    for labels, what in ((("A", "C"), "'C' is not aligned"), (("A", "D"), "'D' is not in the file"), (("A", None), "name both")):
        with pytest.raises(InputError, match=what):
            CamerasFile(file=path, left=labels[0], right=labels[1]).pair()
    path.write_text(EXPORT.replace('label="C"/', 'label="C"><transform>1 0 0 4 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera'))
    with pytest.raises(InputError, match="has 3 aligned cameras"):
        CamerasFile(file=path).pair()


@pytest.mark.parametrize("name", ["lens.xml", "lens.yml", "opencv.xml"])
def test_a_calibration_alone_is_no_pair_but_serves_in_cameras_yaml(tmp_path: Path, name: str) -> None:
    pair = CameraPair(camera(OPENCV_LENS, x=-14.0), camera(OPENCV_LENS, x=14.0))
    (write_calibration if name == "lens.xml" else write_opencv)(tmp_path / name, pair.left)
    with pytest.raises(InputError, match="no poses"):
        read_oriented(tmp_path / name)
    poses = {side: (getattr(pair, side).position.tolist(), getattr(pair, side).rotation.tolist()) for side in ("left", "right")}
    (tmp_path / "cameras.yaml").write_text(
        "".join(f"{side}: {{calibration: {name}, position_m: {p}, rotation: {r}}}\n" for side, (p, r) in poses.items())
    )
    found = read_cameras_yaml(tmp_path / "cameras.yaml")
    assert largest_difference_px(pair.left, found.left) < 1e-9
    assert largest_difference_px(pair.right, found.right) < 1e-9
    assert {*CamerasFile(file=tmp_path / "cameras.yaml").files()} == {tmp_path / "cameras.yaml", tmp_path / name}


def test_unreadable_files_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "lens.yml").write_text("%YAML:1.0\n---\ncamera_matrix: [")
    (tmp_path / "part.yml").write_text("%YAML:1.0\n---\nimage_width: 10\n")
    (tmp_path / "lens.txt").write_text("640 480 wide")
    for name, what in (
        ("none.xml", "cannot be read"),
        ("lens.yml", "FileStorage"),
        ("part.yml", "has no matrix"),
        ("lens.txt", "not a number"),
    ):
        with pytest.raises(InputError, match=what):
            read_lens(tmp_path / name)


def test_depth_and_normal_maps_of_colmap(tmp_path: Path) -> None:
    depth = np.arange(12, dtype=np.float32).reshape(3, 4)
    normals = np.stack([depth, depth + 100, depth + 200], axis=-1)
    write_map(tmp_path / "d.bin", depth)
    write_map(tmp_path / "n.bin", normals)
    assert (tmp_path / "d.bin").read_bytes()[:6] == b"4&3&1&"
    np.testing.assert_array_equal(read_map(tmp_path / "d.bin"), depth)
    np.testing.assert_array_equal(read_map(tmp_path / "n.bin"), normals)
    (tmp_path / "d.bin").write_bytes(b"4&3&1&short")
    with pytest.raises(InputError, match="not a complete depth"):
        read_map(tmp_path / "d.bin")


# ------------------------------------------------------------------ a real lens


@needs_glacier
def test_one_real_lens_in_both_forms() -> None:
    """A 35 mm lens that its owners calibrated once and saved as Metashape's and as OpenCV's XML."""
    metashape = read_lens(GLACIER / "data_calib_35mm_280722_selfcal_all_metashape.xml")
    opencv = read_lens(GLACIER / "data_calib_35mm_280722_selfcal_all_opencv.xml")
    assert largest_difference_px(metashape, opencv, posed=False) < 0.01
    swapped = replace(opencv, p1=opencv.p2, p2=opencv.p1)
    assert largest_difference_px(metashape, swapped, posed=False) > 0.5


@needs_glacier
@pytest.mark.parametrize(("number", "image"), [(1, "IMG_2637"), (2, "IMG_1112")])
def test_real_targets_resect(number: int, image: str) -> None:
    """Four surveyed targets per image: 0.6-1.4 px, as documented with the data (two degrees of freedom are left)."""
    lens = read_lens(GLACIER / f"assets_calib_cam{number}.txt")
    pixel, world = (_table(GLACIER / f"assets_targets_{name}.csv") for name in (image, "target_world"))
    u, v = np.array([pixel[label] for label in pixel]).T
    points = np.array([world[label] for label in pixel])
    centred = points - points.mean(axis=0)
    image_points = np.stack(lens.tangents(u, v), axis=1)
    _, rotation, translation = cv2.solvePnP(centred, image_points, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    local = centred @ cv2.Rodrigues(rotation)[0].T + translation.ravel()
    found_u, found_v = lens.pixel(local[:, 0] / local[:, 2], local[:, 1] / local[:, 2])
    residual = np.hypot(found_u - u, found_v - v)
    assert (local[:, 2] > 0).all()
    assert 0.3 < np.sqrt(np.mean(residual**2)) < 1.4
    assert residual.max() < 1.4


def _table(path: Path) -> dict[str, list[float]]:
    rows = [line.split(",") for line in path.read_text().splitlines()[1:] if line.strip()]
    return {row[0]: [float(word) for word in row[1:]] for row in rows}
