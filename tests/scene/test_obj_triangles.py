"""The quick reader of OBJ files: the same triangles as trimesh reads, and nothing of files that it does not understand."""

from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh

from scene.meshes.obj_triangles import read_triangles

SQUARE = b"v 0 0 0\nv 1.5e0 0 -0.25\nv 1 1 0\nv 0 1 .5\n"
READ = {
    "plain": SQUARE + b"f 1 2 3\nf 1 3 4\n",
    "no line feed at the end": SQUARE + b"f 1 2 3\nf 1 3 4",
    "Windows line ends": SQUARE.replace(b"\n", b"\r\n") + b"\r\nf 1 2 3\r\nf 1 3  4 \r\n",
    "faces between vertices": b"v 0 0 0\nv 1.5 0 -0.25\nv 1 1 0\nf 1 2 3\nv 0 1 0.5\nf 1 3 4\n",
    "comments, groups, smoothing": b"# a wall\n\no wall\n" + SQUARE + b"g rock\ns off\nf 1 2 3\ns 1\nf 1 3 4\n",
    "normals": SQUARE + b"vn 0 0 1\nf 1//1 2//1 3//1\nf 1//1 3//1 4//1\n",
    "textures": SQUARE + b"mtllib a.mtl\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\nf 1/1 3/1 4/1\n",
    "textures and normals": SQUARE + b"vt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf 1/1/1 3/1/1 4/1/1\n",
}


@pytest.mark.parametrize("kind", READ)
def test_triangles_are_read_as_by_trimesh(kind: str) -> None:
    found = read_triangles(READ[kind])
    peer = trimesh.load(io.BytesIO(READ[kind]), file_type="obj", process=False, skip_materials=True)
    assert found is not None
    np.testing.assert_array_equal(found.vertices, [[0, 0, 0], [1.5, 0, -0.25], [1, 1, 0], [0, 1, 0.5]])
    np.testing.assert_array_equal(found.vertices[found.faces], peer.vertices[peer.faces])


def test_tabs_separate_too() -> None:
    found = read_triangles(SQUARE.replace(b" ", b"\t") + b"f\t1\t2\t3\n")
    assert found is not None
    np.testing.assert_array_equal(found.vertices[found.faces[0]], [[0, 0, 0], [1.5, 0, -0.25], [1, 1, 0]])


LEFT = {
    "a quad": SQUARE + b"f 1 2 3 4\n",
    "a triangle and a quad": SQUARE + b"f 1 2 3\nf 1 2 3 4\n",
    "two words in one line and four in the next": SQUARE + b"f 1 2\nf 3 1 3 4\n",
    "negative indices": SQUARE + b"f -4 -3 -2\n",
    "an index beyond the vertices": SQUARE + b"f 1 2 5\n",
    "index zero": SQUARE + b"f 0 1 2\n",
    "vertex colours": b"v 0 0 0 1 1 1\nv 1 0 0 1 1 1\nv 1 1 0 1 1 1\nf 1 2 3\n",
    "a vertex of two coordinates beside one of four": b"v 0 0\nv 1 0 0 0\nv 1 1 0\nf 1 2 3\n",
    "corners of different kinds": SQUARE + b"f 1/1 2 3//1\n",
    "a corner of three and corners of none": SQUARE + b"f 1/2/3 2 3\n",
    "letters": b"v 0 0 x\nv 1 0 0\nv 1 1 0\nf 1 2 3\n",
    "a broken number": b"v 0 0 1.2.3\nv 1 0 0\nv 1 1 0\nf 1 2 3\n",
    "a fraction as index": SQUARE + b"f 1 2 3.5\n",
    "a line that goes on": SQUARE + b"f 1 2 \\\n3\n",
    "a curve": SQUARE + b"cstype bezier\nf 1 2 3\n",
    "no faces": SQUARE,
    "no vertices": b"f 1 2 3\n",
    "nothing": b"",
}


@pytest.mark.parametrize("kind", LEFT)
def test_other_files_are_left_to_a_complete_reader(kind: str) -> None:
    assert read_triangles(LEFT[kind]) is None


def test_numbers_are_read_to_the_last_bit() -> None:
    vertices = np.random.default_rng(2).normal(0, 1e6, (300, 3))
    text = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist()) + "f 1 2 300\n"
    found = read_triangles(text.encode())
    assert found is not None
    np.testing.assert_array_equal(found.vertices, vertices)
