"""Read what trimesh's OBJ reader leaves out: indices that count backwards, concave polygons, and a unit named in a comment."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from scene.geometry.mesh import FloatArray
from scene.meshes.polygons import fan_fills, triangulated

_OTHER_FACE = re.compile(rb"^[ \t]*f[ \t](?:[^\r\n]*-\d|[ \t]*(?:[^ \t\r\n]+[ \t]+){3}[^ \t\r\n])", re.MULTILINE)
"""A face that counts backwards or has more than three corners."""
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
"""Comments on the unit stand at the beginning of a file."""


def is_plain(text: bytes) -> bool:
    """Say whether all faces are triangles whose indices count forwards, which trimesh reads as they are meant."""
    return _OTHER_FACE.search(text) is None


def made_plain(text: bytes) -> bytes:
    """Replace negative indices by positive ones, and polygons that a fan of triangles would not fill by triangles.

    An index of -1 names the vertex that stands last before the face, not the last one of the file (Wavefront, "Object Files",
    section on referencing vertices). Texture coordinates and normals are counted in the same way, each by themselves.
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
    """Return the triangles of those polygons that a fan would not fill, by line; corners as in the file, v/vt/vn."""
    divided = {}
    for count in {len(corners) for corners in faces.values()}:
        places = [place for place, corners in faces.items() if len(corners) == count]
        polygons = np.array([[int(corner.split(b"/")[0]) - 1 for corner in faces[place]] for place in places])
        for row in np.flatnonzero(~fan_fills(vertices, polygons)):
            number = dict(zip(polygons[row], faces[places[row]], strict=True))
            triangles = triangulated(vertices, polygons[row : row + 1])
            divided[places[row]] = [[number[vertex] for vertex in triangle] for triangle in triangles]
    return divided


def _absolute(corner: bytes, counts: tuple[int, ...]) -> bytes:
    """Return one corner of a face, as v/vt/vn, with positive indices; `counts`: how many of each stand before it."""
    indices = zip(corner.split(b"/"), counts, strict=False)
    return b"/".join(b"%d" % (count + 1 + int(index)) if index.startswith(b"-") else index for index, count in indices)


def stated_unit(text: bytes) -> tuple[str, str] | None:
    """Return the unit that a comment at the beginning names, a key of `METRES`, and the comment; None where none does.

    Comments of the kinds "# units: mm" and "# ..., where 1 unit = 1.000000 mm" are understood; a count other than 1 is not.
    """
    for found in _UNIT_IN_COMMENT.finditer(text[:_HEAD_BYTES]):
        unit = _UNITS.get(found["unit"].decode().lower())
        if unit is not None and (found["count"] is None or float(found["count"]) == 1.0):
            line = text[found.start() :].split(b"\n", 1)[0]
            return unit, line.decode(errors="replace").strip().lstrip("# ").strip()
    return None
