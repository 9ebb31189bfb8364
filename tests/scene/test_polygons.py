"""Polygons of more than three corners, in meshes and in OBJ files, whose areas are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scene.common.errors import InputError
from scene.geometry.mesh import TriangleMesh
from scene.meshes.cleaning import triangle_areas
from scene.meshes.obj import has_plain_faces, unit_in_comments, with_plain_faces
from scene.meshes.polygons import fan_is_valid, triangulate_polygons
from scene.walls.imported import read_mesh

L_SHAPE = np.array([[0.0, 0, 4], [0, 0, 0], [6, 0, 0], [6, 0, 1], [2, 0, 1], [2, 0, 4]])
"""Its area is 12."""


@pytest.mark.parametrize("first", range(6))
@pytest.mark.parametrize("turn", [1, -1])
def test_a_concave_polygon_is_filled_once(first: int, turn: int) -> None:
    """From any starting corner and in either direction, tilted in space; normals point to the polygon's own side."""
    rotation, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))
    corners = np.roll(L_SHAPE, -first, axis=0)[::turn] @ rotation.T
    triangles = triangulate_polygons(corners, np.arange(6)[None])
    assert triangle_areas(TriangleMesh(corners, triangles)).sum() == pytest.approx(12.0)
    a, b, c = (corners[triangles[:, corner]] for corner in range(3))
    assert np.linalg.norm(np.cross(b - a, c - a).sum(axis=0)) / 2 == pytest.approx(12.0)


def test_a_convex_polygon_becomes_a_fan() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    assert fan_is_valid(square, np.arange(4)[None]).all()
    assert triangulate_polygons(square, np.arange(4)[None]).tolist() == [[0, 1, 2], [0, 2, 3]]


def test_obj_indices_count_back_from_their_face_each_kind_by_itself() -> None:
    text = b"v 0 0 0\nv 1 0 0\nvn 0 1 0\nv 0 0 1\nf -3//-1 -2//-1 -1//-1\nv 5 5 5\nf 1 -1 2/-1\n"
    assert not has_plain_faces(text)
    lines = with_plain_faces(text).splitlines()
    assert lines[4] == b"f 1//1 2//1 3//1"
    assert lines[6].startswith(b"f 1 4 2/")


def test_a_plain_obj_file_is_left_alone() -> None:
    assert has_plain_faces(b"# exported -1\nv -1 -2 -3\nf 1 2 3\nf 1/2/3 4/5/6 7/8/9\n")
    assert not has_plain_faces(b"f 1 2 3 4\n")


def test_a_concave_obj_polygon_keeps_its_corners(tmp_path: Path) -> None:
    rows = "".join(f"v {x} {y} {z}\n" for x, y, z in L_SHAPE)
    (tmp_path / "wall.obj").write_text(rows + "vn 0 1 0\nf " + " ".join(f"{corner}//1" for corner in range(1, 7)) + "\n")
    mesh, _ = read_mesh(tmp_path / "wall.obj")
    assert triangle_areas(mesh).sum() == pytest.approx(12.0)


@pytest.mark.parametrize(
    ("comment", "unit"),
    [
        (b"# units: mm\n", "mm"),
        (b"# vertex coordinates are measured in units, where 1 unit = 1.000000 mm\n", "mm"),
        (b"#Unit=feet\n", "ft"),
        (b"# 1000 units\n", None),
        (b"# a unit test of mine\n", None),
        (b"# Blender v3.0.0 OBJ File\n", None),
        (b"# units: parsec\n", None),
    ],
)
def test_a_unit_in_a_comment_is_read(comment: bytes, unit: str | None) -> None:
    found = unit_in_comments(comment + b"v 0 0 0\n")
    assert (found and found[0]) == unit


def test_a_unit_that_contradicts_is_refused_and_one_that_agrees_is_not(tmp_path: Path) -> None:
    (tmp_path / "wall.obj").write_text("# units: cm\nv 0 0 0\nv 900 0 0\nv 0 0 900\nf 1 2 3\n")
    with pytest.raises(InputError, match="unit is cm"):
        read_mesh(tmp_path / "wall.obj")
    mesh, _ = read_mesh(tmp_path / "wall.obj", "cm")
    assert triangle_areas(mesh).sum() == pytest.approx(40.5)
