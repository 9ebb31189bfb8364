"""Public reports about meshes: OBJ, PLY, STL."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.field_reports.report import Report, refused
from scene.geometry.mesh import FloatArray, IntArray, TriangleMesh
from scene.walls.imported import ImportedWall, read_mesh

_ROWS, _COLUMNS = 5, 7


def _corners() -> FloatArray:
    """Vertices of a sheet of 6 m x 4 m, row by row."""
    x, z = np.meshgrid(np.arange(float(_COLUMNS)), np.arange(float(_ROWS)))
    return np.column_stack([x.ravel(), 0.2 * np.sin(x.ravel() + z.ravel()), z.ravel()])


def _quads() -> IntArray:
    """(24, 4) corners of the sheet's quadrilaterals."""
    number = np.arange(_ROWS * _COLUMNS).reshape(_ROWS, _COLUMNS)
    return np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=-1).reshape(-1, 4)


def _triangles() -> IntArray:
    quads = _quads()
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _area(vertices: FloatArray, triangles: IntArray) -> float:
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def _same_sheet(mesh: TriangleMesh) -> str:
    truth, found = _area(_corners(), _triangles()), _area(mesh.vertices, mesh.faces)
    assert np.allclose(mesh.vertices.min(axis=0), _corners().min(axis=0), atol=1e-6), mesh.vertices.min(axis=0)
    assert np.allclose(mesh.vertices.max(axis=0), _corners().max(axis=0), atol=1e-6), mesh.vertices.max(axis=0)
    assert abs(found - truth) < 0.03 * truth, f"{found:.3f} m2 of {truth:.3f}"
    return f"reads {len(mesh.faces)} triangles of {found:.1f} m²"


def _vertex_lines(vertices: FloatArray) -> str:
    return "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices)


def _faces(polygons: Sequence[Sequence[int]]) -> str:
    return "".join("f " + " ".join(map(str, polygon)) + "\n" for polygon in polygons)


def _obj(folder: Path, text: str) -> TriangleMesh:
    (folder / "wall.obj").write_text(text)
    return read_mesh(folder / "wall.obj")[0]


def _negative_at_the_end(folder: Path) -> str:
    count = len(_corners())
    return _same_sheet(_obj(folder, _vertex_lines(_corners()) + _faces((_triangles() - count).tolist())))


def _negative_in_between(folder: Path) -> str:
    """Each triangle behind its own three vertices, counted backwards from where it stands."""
    corners = _corners()
    text = "".join(_vertex_lines(corners[triangle]) + "f -3 -2 -1\n" for triangle in _triangles())
    return _same_sheet(_obj(folder, text))


def _polygons(folder: Path) -> str:
    """Write a flat wall of one L-shaped polygon of six corners, which a fan of triangles from its first corner would not fill."""
    outline = np.array([[0.0, 0, 4], [0, 0, 0], [6, 0, 0], [6, 0, 1], [2, 0, 1], [2, 0, 4]])
    mesh = _obj(folder, _vertex_lines(outline) + "f 1 2 3 4 5 6\n")
    area = _area(mesh.vertices, mesh.faces)
    assert abs(area - 12.0) < 1e-6, f"{area:.3f} m2 of 12"
    return f"reads {len(mesh.faces)} triangles of 12 m²"


def _concave_quads(folder: Path) -> str:
    """Write an arrowhead of four corners, whose diagonal from the first corner lies outside it."""
    outline = np.array([[0.0, 0, 0], [2, 0, 1], [4, 0, 0], [2, 0, 4]])
    path = _ply_text(folder, "4 0 1 2 3\n", "property list uchar int vertex_index\n", outline)
    mesh, _ = read_mesh(path)
    area = _area(mesh.vertices, mesh.faces)
    assert abs(area - 6.0) < 1e-6, f"{area:.3f} m2 of 6"
    return "reads 2 triangles of 6 m²"


def _no_material_file(folder: Path) -> str:
    head = "mtllib C:\\users\\me\\rock face.mtl\nusemtl rock\n"
    return _same_sheet(_obj(folder, head + _vertex_lines(_corners()) + _faces((_triangles() + 1).tolist())))


def _unit_in_a_comment(folder: Path) -> str:
    head = "# vertex coordinates are measured in units, where 1 unit = 1.000000 mm\n"
    text = head + _vertex_lines(_corners() * 300.0) + _faces((_triangles() + 1).tolist())
    (folder / "wall.obj").write_text(text)
    return refused(lambda: ImportedWall(mesh=folder / "wall.obj").load(), folder, "unit is mm")


def _ply_text(folder: Path, faces: str, properties: str, vertices: FloatArray | None = None) -> Path:
    corners = _corners() if vertices is None else vertices
    count = faces.count("\n")
    head = f"ply\nformat ascii 1.0\nelement vertex {len(corners)}\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element face {count}\n{properties}end_header\n"
    (folder / "wall.ply").write_text(head + "".join(f"{x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in corners) + faces)
    return folder / "wall.ply"


def _ply_quads(folder: Path) -> str:
    faces = "".join("4 " + " ".join(map(str, quad)) + "\n" for quad in _quads())
    return _same_sheet(read_mesh(_ply_text(folder, faces, "property list uchar int vertex_index\n"))[0])


def _ply_number_before_the_list(folder: Path) -> str:
    faces = "".join("7 3 " + " ".join(map(str, triangle)) + "\n" for triangle in _triangles())
    properties = "property uchar material_index\nproperty list uchar int vertex_indices\n"
    return _same_sheet(read_mesh(_ply_text(folder, faces, properties))[0])


def _ply_vertex_not_a_number(folder: Path) -> str:
    corners = _corners()
    corners[-1] = np.nan
    faces = "".join("3 " + " ".join(map(str, triangle)) + "\n" for triangle in _triangles())
    path = _ply_text(folder, faces, "property list uchar int vertex_index\n", corners)
    return refused(lambda: read_mesh(path), folder, "wall.ply")


def _stl(folder: Path, metres: float) -> Path:
    corners = _corners()[_triangles()] / metres
    records = b"".join(struct.pack("<12fH", 0, 0, 0, *triangle.ravel(), 0) for triangle in corners)
    (folder / "wall.stl").write_bytes(b"solid exported by a CAD program".ljust(80) + struct.pack("<I", len(corners)) + records)
    return folder / "wall.stl"


def _stl_in_millimetres(folder: Path) -> str:
    path = _stl(folder, 0.001)
    message = refused(lambda: ImportedWall(mesh=path).load(), folder, "mm")
    mesh, _ = ImportedWall(mesh=path, unit="mm").load()
    assert abs(np.ptp(mesh.vertices[:, 0]) - 6.0) < 1e-5
    return message


REPORTS = (
    Report("mikedh/trimesh#1448", "OBJ faces with negative indices", "read the triangles", _negative_at_the_end),
    Report("mikedh/trimesh#2364", "negative indices between an OBJ file's vertices", "read the triangles", _negative_in_between),
    Report("3dgeo-heidelberg/helios#239", "a concave OBJ polygon of six corners", "fill it with triangles", _polygons),
    Report("GIScience/helios#31", "an OBJ file whose material file is not there", "read the triangles", _no_material_file),
    Report("Slicer/Slicer#9360", "an OBJ file in millimetres by a comment in it", "not take them as metres", _unit_in_a_comment),
    Report("isl-org/Open3D#2120", "PLY faces of four corners", "read them as triangles", _ply_quads),
    Report("isl-org/Open3D#4517", "a concave PLY face of four corners", "fill it with triangles", _concave_quads),
    Report("open4dfoundation/Open4D#22", "a number before a PLY face's list", "read the triangles", _ply_number_before_the_list),
    Report("mikedh/trimesh#37", "a PLY vertex that is no number", "refuse it", _ply_vertex_not_a_number),
    Report("prusa3d/PrusaSlicer#11925", "an STL file in millimetres, not stated", "ask for the unit", _stl_in_millimetres),
)
