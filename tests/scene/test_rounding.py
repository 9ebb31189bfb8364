"""Rounded coordinates: recognised by their values in any file, refused where they spoil the surface, and only there."""

import numpy as np
import pytest
import trimesh
from scene_files import UTM, rock, sheet, written

from scene.common.errors import InputError
from scene.geometry.mesh import TriangleMesh
from scene.meshes.rounding import rounded_axes, rounding_step
from scene.walls.imported import read_mesh, read_reference


def refused(path, words, **keys):
    with pytest.raises(InputError, match=words) as caught:
        read_mesh(path, **keys)
    assert str(caught.value).startswith(f"{path}: the coordinates were rounded: ")
    assert "\n" not in str(caught.value)
    assert "double precision" in str(caught.value)


@pytest.mark.parametrize("values", [np.float64, np.float32])
@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_the_step_of_continuous_values_is_their_last_bit(values, offset):
    numbers = (offset + np.random.default_rng(1).uniform(0, 50, 4000)).astype(values)
    expected = {(np.float32, 5e6): 0.5, (np.float32, 0.0): 0.0}.get((values, offset), 0.0)
    assert rounding_step(numbers.astype(float)) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("step", [0.5, 0.03125, 0.1, 0.01, 1.0])
def test_the_step_of_rounded_values_is_that_of_the_rounding(step):
    numbers = 123_456.789 + step * np.rint(np.random.default_rng(1).uniform(0, 50, 4000) / step)
    assert rounding_step(numbers) == step


@pytest.mark.parametrize("form", ["ply", "stl", "glb", "double ply", "obj", "off", "subtracted"])
def test_single_precision_far_from_the_origin_is_refused_whatever_holds_it(tmp_path, form):
    """float32 has 24 bits: 2^-1 m between 2^22 and 2^23 m, 2^-5 m between 2^18 and 2^19 m (IEEE 754)."""
    mesh = rock()
    far = mesh.vertices + UTM
    path = tmp_path / f"wall.{form.split()[-1]}"
    if form in ("ply", "stl", "glb"):
        trimesh.Trimesh(far, mesh.faces, process=False).export(path)
    else:
        rounded = far.astype(np.float32).astype(np.float64)
        path = tmp_path / "wall.ply" if form == "subtracted" else path
        written(path, mesh.with_vertices(rounded - (np.floor(UTM) if form == "subtracted" else 0)))
    refused(path, r"x in steps of 0.0312 m.*, [yz] in steps of 0.5 m.*edges are 0.[345]\d* m \(median\)")


def test_the_reason_and_the_unit_are_told(tmp_path):
    mesh = rock()
    path = written(tmp_path / "wall.ply", mesh.with_vertices(((mesh.vertices + UTM) * 1000).astype(np.float32).astype(float)))
    # 5e9 mm lies between 2^32 and 2^33, where float32 steps by 2^9 = 512 mm
    refused(path, r"y in steps of 0.512 m \(single precision of coordinates up to 5,000,0\d\d m\)", unit="mm")


def test_few_decimals_are_refused_by_the_edges_and_told_else(tmp_path):
    mesh = rock()  # the median edge is 0.4 m, a twentieth of it 2 cm
    coarse = written(tmp_path / "coarse.obj", mesh.with_vertices(np.round(mesh.vertices + UTM, 1)))
    refused(coarse, "x in steps of 0.1 m, y in steps of 0.1 m, z in steps of 0.1 m")
    fine = written(tmp_path / "fine.obj", mesh.with_vertices(np.round(mesh.vertices + UTM, 2)))
    assert "x in steps of 0.01 m" in read_mesh(fine)[1][0]
    assert read_mesh(written(tmp_path / "finer.obj", mesh.with_vertices(np.round(mesh.vertices + UTM, 3))))[1] == ()


def raster_tin():
    """Return an irregular network over nodes of a grid of 0.5 m, with heights in float32, as terrain-model files have them."""
    random = np.random.default_rng(5)
    nodes = np.unique(0.5 * random.integers(0, 80, (900, 2)), axis=0)
    from scipy.spatial import Delaunay

    faces = Delaunay(nodes).simplices.astype(np.int32)
    heights = (800 + 4 * np.sin(nodes[:, 0] / 3) * np.cos(nodes[:, 1] / 4)).astype(np.float32)
    return TriangleMesh(np.column_stack([nodes + UTM[:2], heights]), faces)


def box():
    """Return a stepped wall of whole half metres, as one builds by hand."""
    block = trimesh.creation.box((4.0, 1.0, 3.0)).subdivide()
    return TriangleMesh(np.asarray(block.vertices) + UTM, np.asarray(block.faces, np.int32))


FINE = {
    "near the origin": lambda: rock(),
    "near the origin, a millimetre's edges": lambda: rock().with_vertices(rock().vertices * 0.1 + [300, 300, 30]),
    "a regular grid of half metres": lambda: sheet(step=0.5).with_vertices(sheet(step=0.5).vertices + UTM),
    "a regular grid of 0.35 m": lambda: sheet(step=0.35),
    "nodes of a raster": raster_tin,
    "a box": box,
    "double": lambda: rock().with_vertices(rock().vertices + UTM),
}


@pytest.mark.parametrize("name", FINE)
def test_what_was_not_rounded_away_is_read_and_nothing_said(tmp_path, name):
    mesh = FINE[name]()
    if name.startswith("near"):
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / "wall.ply")
    else:
        written(tmp_path / "wall.ply", mesh)
    read, notes = read_mesh(tmp_path / "wall.ply")
    assert notes == ()
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=2e-5)


def test_references_are_read_in_the_same_way(tmp_path):
    mesh = rock()
    trimesh.Trimesh(mesh.vertices + UTM, mesh.faces, process=False).export(tmp_path / "wall.ply")
    with pytest.raises(InputError, match=r"y in steps of 0\.5 m"):
        read_reference(tmp_path / "wall.ply")


def test_axes_of_points_are_told_without_triangles():
    points = np.random.default_rng(2).uniform(0, 40, (5000, 3))
    steps = np.array([0.0625, 0.015625, 1e-5])
    assert [(each.axis, each.step_m) for each in rounded_axes(steps * np.rint(points / steps))] == [
        ("x", 0.0625),
        ("y", 0.015625),
    ]
    assert rounded_axes(points) == []
    assert rounded_axes(points[:0]) == []
