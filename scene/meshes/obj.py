"""Preprocess OBJ files for what trimesh's reader does not handle: negative indices, concave polygons, and a unit in a comment."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from scene.geometry.mesh import FloatArray
from scene.meshes.polygons import fan_is_valid, triangulate_polygons

_OTHER_FACE = re.compile(rb"^[ \t]*f[ \t](?:[^\r\n]*-\d|[ \t]*(?:[^ \t\r\n]+[ \t]+){3}[^ \t\r\n])", re.MULTILINE)
"""A face with a negative index or with more than three corners."""
_UNIT_IN_COMMENT = re.compile(
    rb"^[ \t]*#[^\r\n]*?\bunits?\b[ \t:=]*(?:(?P<count>\d+(?:\.\d*)?)[ \t]*)?(?P<unit>[a-z-]+)\b", re.MULTILINE | re.IGNORECASE
)
_UNITS = {
    "m": "m", "meter": "m", "meters": "m", "metre": "m", "metres": "m",
    "cm": "cm", "centimeter": "cm", "centimeters": "cm", "centimetre": "cm", "centimetres": "cm",
    "mm": "mm", "millimeter": "mm", "millimeters": "mm", "millimetre": "mm", "millimetres": "mm",
    "ft": "ft", "foot": "ft", "feet": "ft",
}  # fmt: skip
_HEAD_BYTES = 4096
"""Length of the beginning of a file in which a comment on the unit is expected."""


def has_plain_faces(text: bytes) -> bool:
    """Return whether all faces of an OBJ file are triangles with positive indices, which the library trimesh reads correctly.

    text: the contents of the file.
    """
    return _OTHER_FACE.search(text) is None


def with_plain_faces(text: bytes) -> bytes:
    """Rewrite an OBJ file's text so that other readers understand it: positive indices, and triangles for concave polygons.

    An index of -1 refers to the last vertex before the face, not to the last one of the file (Wavefront, "Object Files",
    section on referencing vertices). Texture coordinates and normals are counted separately in the same way. Only polygons that
    a fan of triangles would not fill are divided.
    """
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    vertices: list[list[bytes]] = []
    faces: dict[int, list[bytes]] = {}
    lines = text.splitlines()
    for place, line in enumerate(lines):
        words = line.split()
        if not words:
            continue
        if words[0] in counts:
            counts[words[0]] += 1
            vertices += [words[1:4]] if words[0] == b"v" else []
        elif words[0] == b"f":
            before = tuple(counts.values())
            corners = [_absolute(corner, before) for corner in words[1:]] if b"-" in line else words[1:]
            lines[place] = b" ".join([b"f", *corners])
            if len(corners) > 3:
                faces[place] = corners
    for place, triangles in _divided(np.array(vertices, dtype=np.float64), faces).items():
        lines[place] = b"\n".join(b" ".join([b"f", *triangle]) for triangle in triangles)
    return b"\n".join(lines) + b"\n"


def _divided(vertices: FloatArray, faces: Mapping[int, Sequence[bytes]]) -> dict[int, list[list[bytes]]]:
    """Divide the polygons that a fan would not fill.

    Returns their triangles by line number, with corners as in the file (v/vt/vn).
    """
    divided = {}
    for count in {len(corners) for corners in faces.values()}:
        places = [place for place, corners in faces.items() if len(corners) == count]
        polygons = np.array([[int(corner.split(b"/")[0]) - 1 for corner in faces[place]] for place in places])
        for row in np.flatnonzero(~fan_is_valid(vertices, polygons)):
            number = dict(zip(polygons[row], faces[places[row]], strict=True))
            triangles = triangulate_polygons(vertices, polygons[row : row + 1])
            divided[places[row]] = [[number[vertex] for vertex in triangle] for triangle in triangles]
    return divided


def _absolute(corner: bytes, counts: tuple[int, ...]) -> bytes:
    """Convert one corner of a face (v/vt/vn) to positive indices.

    counts: how many vertices, texture coordinates and normals precede it.
    """
    indices = zip(corner.split(b"/"), counts, strict=False)
    return b"/".join(b"%d" % (count + 1 + int(index)) if index.startswith(b"-") else index for index, count in indices)


def unit_in_comments(text: bytes) -> tuple[str, str] | None:
    """Find the unit of length that a comment at the beginning of an OBJ file states.

    Comments such as "# units: mm" and "# ..., where 1 unit = 1.000000 mm" are understood; a count other than 1 is not. `text`
    is the file's contents. Returns the unit, such as "mm", and the comment, or None.
    """
    for found in _UNIT_IN_COMMENT.finditer(text[:_HEAD_BYTES]):
        unit = _UNITS.get(found["unit"].decode().lower())
        if unit is not None and (found["count"] is None or float(found["count"]) == 1.0):
            line = text[found.start() :].split(b"\n", 1)[0]
            return unit, line.decode(errors="replace").strip().lstrip("# ").strip()
    return None
