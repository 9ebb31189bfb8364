"""Walls and references whose triangles face away from the sensor, and other unusable meshes: one treatment for both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from gap_cases import write_scan
from scene_files import UTM, rock, sheet, written
from surfaces import sphere

from pipeline.config.simulation import SensorName, SimulationConfig
from pipeline.formats.measurements.measurement import Measurement, read_measurement
from pipeline.formats.meshes.ply import read_ply, write_ply
from pipeline.gap.residuals.alignment import compute_residuals
from pipeline.run.site import prepare_site
from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh
from scene.meshes.cleaning import flip_faces
from scene.meshes.winding import orient_to_sensors
from scene.ray_casting.raycast import RayCaster
from sensors.models.placement import look_at

CENTRE = np.array([3.5, 0.3, 2.5])
EYE = CENTRE - [0.0, 15.0, 0.0]
SENSORS: tuple[SensorName, ...] = ("tls", "stereo")


def camera(shift: float) -> dict[str, Any]:
    position = EYE + np.array([shift, 0.0, 0.0])
    rotation = look_at(position, CENTRE).tolist()
    return {"width": 400, "height": 300, "f_px": 500.0, "position_m": position.tolist(), "rotation": rotation}


SITE: dict[str, Any] = {
    "cameras": {"left": camera(-1.0), "right": camera(1.0)},
    "depth_map": "low",
    "station": {"position_m": EYE.tolist()},
    "scanner": {"azimuth_step_rad": 0.01, "zenith_step_rad": 0.01},
}


def seen(path: Path, sensor: SensorName, **changes: Any) -> tuple[TriangleMesh, tuple[str, ...], Any]:
    """Return the wall of a site, the notes of what was repaired in it, and the points that the sensor observes."""
    config = parse(SimulationConfig, {**SITE, "wall": {"mesh": str(path)}, **changes}, "test")
    site = prepare_site(config, sensor, KeyedRandom(1))
    return site.mesh, site.repairs, site.sensor.observe(RayCaster(site.mesh), KeyedRandom(2)).points


def wound(mesh: TriangleMesh, which: Any = slice(None)) -> TriangleMesh:
    turned = np.zeros(len(mesh.faces), bool)
    turned[which] = True
    return flip_faces(mesh, turned)


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("which", [slice(None), slice(0, 60), [3, 10, 11]], ids=["all", "most", "some"])
def test_a_wall_wound_the_wrong_way_is_turned_told_and_observed_to_the_same_values(
    tmp_path: Path, sensor: SensorName, which: Any
) -> None:
    right = seen(written(tmp_path / "right.ply", sheet()), sensor)
    other = seen(written(tmp_path / "wrong.ply", wound(sheet(), which)), sensor)
    assert np.isfinite(right[2]).all(axis=-1).any()
    assert right[1] == ()
    assert "wound" in " ".join(other[1])
    np.testing.assert_array_equal(other[0].faces, right[0].faces)
    np.testing.assert_array_equal(other[2], right[2])


def test_a_piece_is_turned_by_itself_and_vertices_stay() -> None:
    near, far = sheet(), sheet().with_vertices(sheet().vertices + np.array([10.0, 0.0, 0.0]))
    vertices = np.concatenate([near.vertices, far.vertices])
    right = np.concatenate([near.faces, far.faces + len(near.vertices)])
    both = replace(near, vertices=vertices, faces=np.concatenate([near.faces, far.faces[:, ::-1] + len(near.vertices)]))
    turned, words = orient_to_sensors(both, [EYE], "wall")
    np.testing.assert_array_equal(turned.faces, right)
    assert turned.vertices is both.vertices
    assert words == "a piece of 70 triangles turned, as they were wound away from the sensor"


def test_triangles_without_common_vertices_are_one_surface() -> None:
    mesh = sheet()
    soup = TriangleMesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces), dtype=np.int32).reshape(-1, 3))
    turned, words = orient_to_sensors(wound(soup), [EYE], "wall")
    np.testing.assert_array_equal(turned.faces, soup.faces)
    assert words.startswith("all 70 triangles turned")
    assert words.endswith("check that the sensor stands in front of the wall, not behind it")


def test_a_closed_surface_is_turned_only_where_it_is_wound_inwards() -> None:
    ball = sphere(CENTRE, 2.0, 3)
    inside = TriangleMesh(ball.vertices, ball.faces[:, ::-1])
    assert orient_to_sensors(ball, [EYE], "ball")[1] == ""
    np.testing.assert_array_equal(orient_to_sensors(inside, [EYE], "ball")[0].faces, ball.faces)
    assert orient_to_sensors(inside, [CENTRE], "tunnel")[1] == ""  # a tunnel, seen from within
    with pytest.raises(InputError, match="stands inside a closed solid"):
        orient_to_sensors(ball, [CENTRE], "ball")


def turned_reference(folder: Path, which: Any = slice(None)) -> Measurement:
    """Write the measurement of `folder` with a reference of which the triangles `which` are reversed."""
    mesh = read_ply(folder / "wall.ply")
    write_ply(folder / "other.ply", wound(mesh, which))
    settings = yaml.safe_load((folder / "measurement.yaml").read_text())
    (folder / "measurement.yaml").write_text(yaml.safe_dump({**settings, "reference": "other.ply"}))
    return read_measurement(folder)


@pytest.mark.parametrize("which", [slice(None), slice(0, 50)], ids=["all", "some"])
def test_a_reference_wound_the_wrong_way_gives_the_same_residuals_and_gap(tmp_path: Path, which: Any) -> None:
    write_scan(tmp_path, 1, step_rad=0.02)
    right = read_measurement(tmp_path)
    other = turned_reference(tmp_path, which)
    assert right.notes == ()
    assert "triangles" in other.notes[0]
    assert other.notes[0] in compute_residuals(other).notes
    np.testing.assert_array_equal(other.reference.faces, right.reference.faces)
    np.testing.assert_array_equal(compute_residuals(other).value, compute_residuals(right).value)


def moebius() -> TriangleMesh:
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    half, centre = angle / 2, np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    across = 0.3 * np.stack([np.cos(half) * np.cos(angle), np.sin(half), np.cos(half) * np.sin(angle)], axis=1)
    near, far = 2 * np.arange(24), 2 * np.arange(24) + 1
    following = np.append(near[1:], far[0]), np.append(far[1:], near[0])
    faces = [np.stack([near, far, following[0]], 1), np.stack([far, following[1], following[0]], 1)]
    vertices = np.stack([centre + across, centre - across], axis=1).reshape(-1, 3)
    return TriangleMesh(10 * vertices, np.concatenate(faces).astype(np.int32))


def changed(**values: Any) -> TriangleMesh:
    """Return a sheet with some vertices moved."""
    mesh = sheet()
    for number, value in values.items():
        mesh.vertices[int(number[1:])] = value
    return mesh


NOTHING = "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nelement face 0\n"
NOTHING += "property list uchar int vertex_indices\nend_header\n"
BAD = {
    "nothing in it": (NOTHING, "contains no triangles|is not a valid ply file"),
    "points alone": (replace(sheet(), faces=np.empty((0, 3), np.int32)), "contains no triangles"),
    "nan": (changed(v7=np.nan), r"1 of 48 vertices are not finite, the first is vertex 7 at \(nan, nan, nan\)"),
    "infinite": (changed(v7=np.inf), "1 of 48 vertices are not finite"),
    "1e300": (changed(v7=1e300), r"1 of 48 vertices are not on earth, the first is vertex 7 at \(1e\+300"),
    "1e9": (sheet().with_vertices(sheet().vertices * 1e9), r"are not on earth.*allowed: coordinates of up to 1e\+08 m"),
    "1e7": (sheet().with_vertices(sheet().vertices * 1e6), r"7e\+06 m in size"),
    "far away": (sheet().with_vertices(sheet().vertices + UTM), r"stands 5,0\d\d km from the surface.*one coordinate system"),
    "rounded": (rock().with_vertices((rock().vertices + UTM).astype(np.float32).astype(float)), "were rounded"),
    "one-sided": (moebius(), "only one side"),
    "a loop of links": (None, "no such file|cannot be read"),
}


def bad_file(folder: Path, name: str) -> tuple[Path, str]:
    content, words = BAD[name]
    path = folder / "bad.ply"
    if content is None:
        path.symlink_to(path)
    elif isinstance(content, str):
        path.write_text(content)
    else:
        written(path, content)
    return path, words


@pytest.mark.parametrize("name", BAD)
def test_a_bad_mesh_is_answered_alike_as_a_wall_and_as_a_reference(tmp_path: Path, name: str) -> None:
    path, words = bad_file(tmp_path, name)
    (tmp_path / "model.yaml").write_text("sensor: tls\nnoise: {range_sigma_m: 0.003, angle_sigma_rad: 0.00004}\neffects: []\n")
    (tmp_path / "scan.xyz").write_text("0 10 0 1\n1 10 0 1\n")
    scanner = {"position_m": EYE.tolist(), "rotation": np.eye(3).tolist()}
    measurement = {"sensor": "tls", "reference": path.name, "points": "scan.xyz", "model": "model.yaml", "scanner": scanner}
    (tmp_path / "measurement.yaml").write_text(yaml.safe_dump(measurement))
    for read in (lambda: seen(path, "tls"), lambda: read_measurement(tmp_path)):
        with pytest.raises(InputError, match=words) as caught:
            read()
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 500


def test_quads_and_unused_vertices_of_a_reference_are_no_hindrance(tmp_path: Path) -> None:
    write_scan(tmp_path, 1, step_rad=0.02)
    mesh = read_ply(tmp_path / "wall.ply")
    right = read_measurement(tmp_path)
    lost = mesh.with_vertices(np.concatenate([mesh.vertices, [[1e4, 1e4, 1e4]]]))
    write_ply(tmp_path / "wall.ply", lost)
    found = read_measurement(tmp_path)
    assert found.notes == ("wall.ply: 1 unused vertices removed",)
    np.testing.assert_array_equal(found.frame.matrix, right.frame.matrix)
    assert trimesh.Trimesh(found.reference.vertices, found.reference.faces, process=False).area > 0
