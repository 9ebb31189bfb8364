"""Read surfaces from mesh files: rock walls, which are repaired, and reference surfaces, which stay as they are."""

from __future__ import annotations

import io
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from scene.common.config import Config
from scene.common.errors import InputError, nearest
from scene.common.lengths import METRES
from scene.common.regular_file import check_file
from scene.geometry.mesh import DEFAULT_ALBEDO, TriangleMesh
from scene.meshes import obj
from scene.meshes.cleaning import clean, drop_unused, flip_faces
from scene.meshes.obj_triangles import read_triangles
from scene.meshes.ply import read_elements
from scene.meshes.polygons import triangulate_polygons
from scene.meshes.rounding import check_rounding

logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # its problems raise exceptions or concern textures
_SMALLEST_M, _LARGEST_M = 0.5, 5000.0
"""A wall smaller or larger than this is probably in another unit."""
_FARTHEST_M = 1e8
"""Largest plausible coordinate: geocentric coordinates reach 6.4e6 m, northings 1e7 m."""
_MOST_BYTES = 2_000_000_000
"""Largest file that is given to trimesh, which needs several times its size in memory."""
_Y_UP = {"glb", "gltf"}
"""Formats whose standard says that y points up (glTF 2.0, section 3.4). They are rotated so that z does."""
_ARCHIVES = {"zip", "tar.gz", "tar.bz2", "bz2"}
"""Archive formats that trimesh lists among its mesh formats."""
_CLOUDS = {"las", "laz", "e57", "ptx", "pts", "pcd"}
"""Formats of point clouds."""
_MESH_FIRST = "mesh the points first: scarpsim surface CLOUD --seen-from X Y Z --out wall.ply"
_COLOURS = ("red", "green", "blue")
"""Names of the vertex colours in a PLY file."""
_TEXTURE = {"texcoord", "texture_u", "texture_v", "s", "t", "u", "v"}
"""Names in a PLY file that belong to textures."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""ITU-R BT.709 luminance weights of linear red, green and blue."""


class ImportedWall(Config):
    """A wall from one or several mesh files in any format that trimesh reads.

    Trimesh is a Python library. Survey coordinates are east, north and height; they become the world frame, in m.
    """

    mesh: Path | tuple[Path, ...] = Field(
        description="mesh file (ply, obj, stl, off, glb, ...), or a list of files that make up the scene; in survey coordinates"
    )
    unit: Literal["m", "cm", "mm", "ft", "us-ft"] = Field("m", description="unit of the file's coordinates")
    flipped: bool = Field(
        False,
        description="whether the file's triangles are clockwise seen from the sensors' side; detected automatically if the "
        "sensor's position is given in coordinates",
    )
    albedo: float | None = Field(
        None,
        ge=0.0,
        le=1.0,
        description="albedo of the wall; by default the file's own, or the luminance of its vertex colours",
    )

    @field_validator("mesh")
    @classmethod
    def _different(cls, mesh: Path | tuple[Path, ...]) -> Path | tuple[Path, ...]:
        if isinstance(mesh, tuple) and not mesh:
            raise ValueError("names no file")
        if isinstance(mesh, tuple) and len(set(mesh)) < len(mesh):
            raise ValueError("names a file twice")
        return mesh

    @property
    def files(self) -> tuple[Path, ...]:
        """The mesh files, one or several."""
        return self.mesh if isinstance(self.mesh, tuple) else (self.mesh,)

    def load(self) -> tuple[TriangleMesh, tuple[str, ...]]:
        """Read the configured mesh files, join them into one wall and repair it.

        Returns the mesh in the world frame, m, and the repairs in words. Raises InputError if a file cannot be used.
        """
        where = ", ".join(map(str, self.files))
        meshes, found = zip(*(read_mesh(file, self.unit) for file in self.files), strict=True)
        mesh, notes = join_meshes(meshes), tuple(dict.fromkeys(note for each in found for note in each))
        self._check_extent(mesh, where)
        origin = np.floor(mesh.vertices[mesh.faces[0, 0]])  # whole metres, which are subtracted and added again without rounding
        mesh, repairs = clean(mesh.with_vertices(mesh.vertices - origin), where, origin)
        if self.flipped:
            mesh = flip_faces(mesh, np.ones(len(mesh.faces), bool))
        if self.albedo is not None:
            mesh = replace(mesh, vertex_albedo=np.full(len(mesh.vertices), self.albedo, np.float32))
        return mesh.with_vertices(mesh.vertices + origin), (*repairs, *notes)

    def _check_extent(self, mesh: TriangleMesh, where: str) -> None:
        """Raise InputError if the wall's size is implausible in the stated unit."""
        extent = _extent(mesh)
        if not _SMALLEST_M <= extent <= _LARGEST_M:
            likely = [unit for unit, metres in METRES.items() if 2 <= extent / METRES[self.unit] * metres <= 1000]
            remedy = (
                f"set `unit` to {' or '.join(likely)} if that is the file's unit"
                if likely
                else "export the mesh in the unit that `unit` states, or, if it shows more than the wall, cut it in a mesh editor"
            )
            raise InputError(
                f"the wall is {extent:.4g} m in size with `unit: {self.unit}`",
                where=where,
                allowed=f"{_SMALLEST_M} m to {_LARGEST_M:.0f} m",
                remedy=remedy,
            )


def join_meshes(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Join the meshes of several files into one, in order.

    If any of them has an albedo, those without one get the default albedo.
    """
    if len(meshes) == 1:
        return meshes[0]
    start = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = np.concatenate([mesh.faces + np.int32(first) for mesh, first in zip(meshes, start, strict=True)])
    albedo = None
    if any(mesh.vertex_albedo is not None for mesh in meshes):
        usual = [np.full(len(mesh.vertices), DEFAULT_ALBEDO, np.float32) for mesh in meshes]
        own = [each if mesh.vertex_albedo is None else mesh.vertex_albedo for mesh, each in zip(meshes, usual, strict=True)]
        albedo = np.concatenate(own)
    return TriangleMesh(np.concatenate([mesh.vertices for mesh in meshes]), faces, albedo)


def read_reference(path: Path) -> tuple[TriangleMesh, tuple[str, ...]]:
    """Read a mesh file with the surface that measurements are compared with; return the mesh, m, and notes on it for a report.

    Vertices stay as in the file, because repairs could move what is measured against. Raises InputError if the file cannot be
    used.
    """
    mesh, notes = read_mesh(path)
    if (extent := _extent(mesh)) > _LARGEST_M:
        raise InputError(
            f"the surface is {extent:.4g} m in size",
            where=str(path),
            allowed=f"up to {_LARGEST_M:.0f} m",
            remedy="export the surface in metres, and cut it to the wall and what is near it",
        )
    mesh, words = drop_unused(mesh)
    return mesh, (*notes, *([words] if words else []))


def check_mesh_file(path: Path) -> None:
    """Raise InputError if a file is no mesh, or if its coordinates are not finite.

    Size and position are not checked, because they need the unit of the coordinates.
    """
    mesh = _read(path, None)
    _require(np.all(np.isfinite(mesh.vertices), axis=1), mesh, "are not finite", str(path), "finite coordinates")


def read_mesh(path: Path, unit: str = "m") -> tuple[TriangleMesh, tuple[str, ...]]:
    """Read a triangle mesh from a file; return it, converted to m, and notes on its coordinates for a report.

    `unit` is the unit of the file's coordinates, such as "mm". Raises InputError if the file cannot be read, or if coordinates
    are not finite, implausibly large or spoilt by rounding.
    """
    where, metres = str(path), METRES[unit]
    mesh = _read(path, unit)
    _check_coordinates(mesh, metres, where)
    turned = ("y is up in glTF: turned so that z is",) if _format(path) in _Y_UP else ()
    notes = (*turned, *check_rounding(mesh, metres, where))
    return (mesh if metres == 1 else mesh.with_vertices(mesh.vertices * metres)), notes


def _extent(mesh: TriangleMesh) -> float:
    """Return the longest side of the bounding box of all triangles, m."""
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces] = True
    return max(float(np.ptp(column[used])) for column in mesh.vertices.T)


def _read(path: Path, unit: str | None) -> TriangleMesh:
    """Read a file's triangles unchanged, in the file's unit; all meshes of a scene are joined.

    Raises InputError if the file cannot be read or states another unit than `unit`; None: any unit is accepted.
    """
    where, kind = str(path), _format(path)
    if not path.exists():
        raise InputError("there is no such file", where=where, remedy="give the path of an existing mesh")
    check_file(path)
    if kind == "ply" and (plain := _plain_ply(path)) is not None:
        return plain
    check_file(path, most_bytes=_MOST_BYTES, if_too_large="export it as a binary PLY of triangles, which can have any size")
    options: dict[str, Any] = {"skip_materials": True} if kind == "obj" else {}
    try:
        source = _obj_text(path, unit) if kind == "obj" else b""
        if source and (triangles := read_triangles(source)) is not None:
            return triangles
        import trimesh

        loaded = trimesh.load(_for_trimesh(path, source), file_type=kind, process=False, resolver=_beside(path), **options)
        mesh = loaded.to_mesh() if isinstance(loaded, trimesh.Scene) else loaded
    except InputError:
        raise
    except OSError as error:
        raise InputError(
            f"the file cannot be read ({error.strerror or error})",
            where=where,
            remedy="give yourself the permission to read the file",
        ) from None
    except Exception as error:  # trimesh's readers may raise any exception on malformed data
        problem = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(
            f"the file is not a valid {kind} file: {problem}",
            where=where,
            remedy="copy the complete file again, or export it again from the program that made it",
        ) from None
    faces = np.asarray(getattr(mesh, "faces", np.empty((0, 3))))
    if not len(faces):
        raise InputError(
            "the file contains no triangles",
            where=where,
            remedy=_MESH_FIRST,
        )
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    if kind in _Y_UP and vertices.shape[1:] == (3,):
        vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        problem = f"the mesh has vertices of {vertices.shape[-1]} coordinates and faces of {faces.shape[-1]} corners"
        raise InputError(
            problem,
            where=where,
            allowed="3 coordinates and 3 corners",
            remedy="export the mesh again as triangles with x, y and z",
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(
            f"a triangle refers to vertex {faces.max()}, but there are {len(vertices)} vertices, counted from 0",
            where=where,
            remedy="copy the complete file again, or export the mesh again",
        )
    return TriangleMesh(vertices, faces.astype(np.int32), _albedo(mesh))


def _obj_text(path: Path, unit: str | None) -> bytes:
    """Return the text of an OBJ file.

    Raises OSError if the file cannot be read, and InputError if a comment in it names another unit than `unit`.
    """
    text = path.read_bytes()
    stated = None if unit is None else obj.unit_in_comments(text)
    if stated is not None and stated[0] != unit:
        raise InputError(
            f"the file says in a comment that its unit is {stated[0]} ('{stated[1][:80]}'), but `unit` says {unit}",
            where=str(path),
            remedy=f"set `unit` to {stated[0]}, or remove the comment if it is wrong",
        )
    return text


def _for_trimesh(path: Path, obj_text: bytes) -> str | io.BytesIO:
    """Return what trimesh reads: the file's path, or preprocessed text of an OBJ file that trimesh would misread."""
    return io.BytesIO(obj.with_plain_faces(obj_text)) if obj_text and not obj.has_plain_faces(obj_text) else str(path)


def _beside(path: Path) -> Any:
    """Return trimesh's resolver for files that a mesh refers to, such as buffers: regular files in its folder of limited size."""
    from trimesh.resolvers import FilePathResolver

    class Beside(FilePathResolver):
        def absolute(self, name: str) -> Path:
            found: Path = super().absolute(name)
            return check_file(found, most_bytes=_MOST_BYTES) if found.exists() else found

    return Beside(str(path))


def _plain_ply(path: Path) -> TriangleMesh | None:
    """Read a PLY file of triangles with at most an albedo or 8-bit vertex colours; return None if it contains more than that.

    Other files are left to trimesh. The result is the same as trimesh's, without the second that its import takes.
    """
    try:
        elements = read_elements(path)
        vertex, face = elements["vertex"], elements["face"]
        faces = face["vertex_indices" if "vertex_indices" in face else "vertex_index"]
        vertices = np.stack([vertex[axis].astype(np.float64) for axis in "xyz"], axis=1)
    except (InputError, KeyError):
        return None
    colours = [vertex[name] for name in _COLOURS if name in vertex]
    more = "edge" in elements or not {*vertex, *face}.isdisjoint(_TEXTURE) or not set(face).isdisjoint(_COLOURS)
    if more or any(colour.dtype != np.uint8 for colour in colours):
        return None
    if faces.ndim != 2 or faces.shape[1] < 3 or not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
        return None
    if faces.shape[1] > 3:
        faces = triangulate_polygons(vertices, faces)
    albedo = vertex["albedo"].astype(np.float32) if "albedo" in vertex else None
    albedo = _luminance(np.stack(colours, axis=1)) if albedo is None and len(colours) == 3 else albedo
    return TriangleMesh(vertices, np.ascontiguousarray(faces, dtype=np.int32), albedo)


def _format(path: Path) -> str:
    """Return the file's format by its suffix. Raises InputError if trimesh has no mesh reader for it."""
    kind = path.suffix.lower().removeprefix(".")
    if kind in ("ply", "obj"):
        return kind
    import trimesh

    known = sorted(set(trimesh.available_formats()) - _ARCHIVES)
    if kind not in known:
        raise InputError(
            f"'{path.suffix}' is not a mesh format that can be read",
            where=str(path),
            allowed=", ".join(known),
            remedy=_MESH_FIRST if kind in _CLOUDS else nearest(kind, known) or "convert the mesh to one of these formats",
        )
    return kind


def _check_coordinates(mesh: TriangleMesh, metres: float, where: str) -> None:
    """Raise InputError for coordinates that are not finite or implausibly large."""
    finite = np.all(np.isfinite(mesh.vertices), axis=1)
    _require(finite, mesh, "are not finite", where, "finite coordinates")
    near = np.all(np.abs(mesh.vertices) <= _FARTHEST_M / metres, axis=1)
    _require(near, mesh, "are not on earth", where, f"coordinates of up to {_FARTHEST_M:.0e} m")


def _require(good: NDArray[Any], mesh: TriangleMesh, problem: str, where: str, allowed: str) -> None:
    """Raise InputError naming the first vertex that is not `good` (n,)."""
    if not good.all():
        first = int(np.argmin(good))
        coordinates = ", ".join(f"{value:g}" for value in mesh.vertices[first])
        raise InputError(
            f"{int(np.sum(~good))} of {len(good)} vertices {problem}, the first is vertex {first} at ({coordinates})",
            where=where,
            allowed=allowed,
            remedy="remove these vertices and the triangles that use them",
        )


def _albedo(mesh: Any) -> NDArray[np.float32] | None:
    """Return the relative luminance (n,) of the vertex colours (sRGB, IEC 61966-2-1); None if there are none."""
    if getattr(mesh.visual, "kind", None) != "vertex":
        return None
    return _luminance(np.asarray(mesh.visual.vertex_colors)[:, :3])


def _luminance(colours: NDArray[np.integer]) -> NDArray[np.float32]:
    """Return the relative luminance (n,) of 8-bit sRGB colours (n, 3)."""
    colour = colours / 255.0
    linear = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
    return np.einsum("nc,c->n", linear, _LUMINANCE).astype(np.float32)
