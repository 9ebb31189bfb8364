"""Read the triangles of a plain OBJ file with NumPy, many times as fast as line by line."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import TriangleMesh

_IGNORED = b"#vgosuml\r\n"
"""First characters of lines without influence on triangles: comments, vt and vn, groups, materials, lines, empty lines."""
_BLANK = 32
"""Bytes up to this one separate numbers."""
_WITHOUT_SLASHES = bytes.maketrans(b"vf/", b"   ")
_WITHOUT_LETTERS = bytes.maketrans(b"vf", b"  ")


def read_triangles(text: bytes) -> TriangleMesh | None:
    """Read an OBJ file of triangles with positive indices, quickly; vertices and triangles keep the file's order.

    `text` is the file's contents. Texture coordinates, normals, groups and materials are ignored. Returns None for a file with
    anything else, such as polygons, negative indices, vertex colours, curves or malformed lines; a complete reader then has to
    judge it.
    """
    if b"\\" in text:  # lines that go on in the next one
        return None
    lines = _ObjLines(text)
    vertex, face = lines.which(b"v"), lines.which(b"f")
    other = np.unique(lines.first[~(vertex | face)])
    if not vertex.any() or not face.any() or not set(other.tolist()) <= set(_IGNORED):
        return None
    vertices = _numbers(lines.text_of(vertex).translate(_WITHOUT_LETTERS), np.float64, 3)
    corners = lines.text_of(face)
    if vertices is None or not _has_columns(corners.translate(_WITHOUT_LETTERS), 3):
        return None
    indices = _numbers(corners.translate(_WITHOUT_SLASHES), np.int64, None)
    if indices is None or indices.shape[1] not in (3, 6, 9):
        return None
    faces = indices[:, :: indices.shape[1] // 3] - 1
    if faces.min() < 0 or faces.max() >= len(vertices):
        return None
    return TriangleMesh(vertices, faces.astype(np.int32))


class _ObjLines:
    """The lines of a text. first: (n,) their first bytes."""

    def __init__(self, text: bytes) -> None:
        self._text, letters = text, np.frombuffer(text, np.uint8)
        starts = np.concatenate([[0], np.flatnonzero(letters == ord("\n")) + 1])
        self._bounds = starts if starts[-1] == len(text) else np.append(starts, len(text))
        self.first = letters[self._bounds[:-1]]
        self._second = letters[np.minimum(self._bounds[:-1] + 1, len(text) - 1)]

    def which(self, word: bytes) -> NDArray[np.bool_]:
        """Return which lines (n,) begin with a word of one letter."""
        return (self.first == ord(word)) & ((self._second == ord(" ")) | (self._second == ord("\t")))

    def text_of(self, chosen: NDArray[np.bool_]) -> bytes:
        """Return the chosen lines (n,), joined."""
        change = np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8))
        spans = zip(self._bounds[np.flatnonzero(change > 0)], self._bounds[np.flatnonzero(change < 0)], strict=True)
        return b"".join(self._text[start:end] for start, end in spans)


def _numbers(text: bytes, kind: type, columns: int | None) -> NDArray[Any] | None:
    """Parse lines of equally many numbers into an array (lines, columns); None if they are not. columns: None for any."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # NumPy warns if it cannot read to the end
        try:
            values: NDArray[Any] = np.fromstring(text, kind, sep=" ")
        except (DeprecationWarning, ValueError):
            return None
    columns = columns or len(values) // (text.count(b"\n") + (not text.endswith(b"\n")))
    return values.reshape(-1, columns) if columns and _has_columns(text, columns) else None


def _has_columns(text: bytes, columns: int) -> bool:
    """Return whether every line has this many words."""
    letters = np.frombuffer(text, np.uint8)
    solid = letters > _BLANK
    words = np.flatnonzero(solid & ~np.concatenate([[False], solid[:-1]]))
    ends = np.append(np.flatnonzero(letters == ord("\n")), len(text))
    before = np.searchsorted(words, ends)
    counts = np.diff(before, prepend=0)
    return bool(np.all(counts[:-1] == columns) and counts[-1] in (0, columns))
