"""The ray-casting interface: rays against one triangle mesh, with hits refined in float64.

Embree and OptiX trace in single precision (6 um rms at 100 m). The triangle that was hit is known, so the distance is computed
again in float64 against that triangle's plane; what remains of the single precision is which of two triangles a ray within
some micrometres of their common edge belongs to. All arrays stay on the device, lazily, so that a sensor's whole chain fuses
into one kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scene.backend import dr, mi
from scene.errors import InputError
from scene.grid import Grid
from scene.mesh import WALL, FloatArray, IntArray, TriangleMesh

DEFAULT_ALBEDO = 0.5
_LARGEST_COORDINATE = 1e4
"""Metres from the frame's origin beyond which float32 leaves less than a millimetre."""

_CHUNK = 1 << 20
"""Faces prepared at a time, which bounds the memory of float64 intermediates."""


@dataclass(frozen=True)
class Hits:
    """What n rays hit, as lazy device arrays; entries of rays that hit nothing are meaningless where `valid` is False.

    valid: (n,) bool; distance: (n,) float64, in lengths of the direction vector (m for unit directions); face: (n,) uint32;
    normal: 3 x (n,) float32 unit vectors, outside; albedo: (n,) float32; block: (n,) int32 label of the face, WALL for a miss.
    """

    valid: mi.Bool
    distance: mi.Float64
    face: mi.UInt32
    normal: mi.Vector3f
    albedo: mi.Float32
    block: mi.Int32


class RayCaster:
    """A mesh prepared for ray casting, in a frame whose origin is near (the wall frame)."""

    def __init__(self, mesh: TriangleMesh) -> None:
        if len(mesh.faces) == 0:
            raise InputError("the mesh has no triangles", where="ray casting")
        if not np.abs(mesh.bounds).max() < _LARGEST_COORDINATE:
            raise InputError(
                f"coordinates reach {np.abs(mesh.bounds).max():.0f} m", where="ray casting", remedy="work in the wall frame"
            )
        self.mesh = mesh
        shape = mi.Mesh("surface", len(mesh.vertices), len(mesh.faces))
        parameters = mi.traverse(shape)
        parameters["vertex_positions"] = mi.Float(mesh.vertices.astype(np.float32).ravel())
        parameters["faces"] = mi.UInt32(mesh.faces.astype(np.uint32).ravel())
        parameters.update()
        self._scene = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "surface": shape})

    @cached_property
    def _records(self) -> mi.Float32:
        """(8 m,) float32, one record per face: unit normal n, albedo; then plane distance n . v as a sum of two float32, block.

        One record is half a cache line, so a hit costs one visit to memory. The float32 normal moves a hit by nanometres at most
        (its error times the distance from the face's first vertex v, which the plane passes through); the plane distance keeps
        48 bits.
        """
        faces, vertices, albedo = self.mesh.faces, self.mesh.vertices, self.mesh.vertex_albedo
        record = np.zeros((len(faces), 8), dtype=np.float32)
        for start in range(0, len(record), _CHUNK):
            rows = slice(start, start + _CHUNK)
            corners = vertices[faces[rows]]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            record[rows, :3] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
            record[rows, 3] = DEFAULT_ALBEDO if albedo is None else albedo[faces[rows]].mean(axis=1)
            plane = np.einsum("ij,ij->i", record[rows, :3].astype(np.float64), corners[:, 0])
            record[rows, 4] = plane
            record[rows, 5] = plane - record[rows, 4]
        if self.mesh.face_block is not None:
            record[:, 6] = self.mesh.face_block  # exact: labels stay far below 2^24
        return mi.Float32(record.ravel())

    def intersect(self, origin: mi.Array3f64, direction: mi.Array3f64, *, coherent: bool = True) -> Hits:
        """Cast rays; origin, direction: 3 x (n,) float64, m. The direction need not be of unit length."""
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
        found = self._scene.ray_intersect_preliminary(ray, coherent=coherent)
        valid = found.is_valid()
        first = dr.gather(mi.Array4f, self._records, 2 * found.prim_index, valid)
        second = dr.gather(mi.Array4f, self._records, 2 * found.prim_index + 1, valid)
        normal = mi.Array3f64(first.x, first.y, first.z)
        plane = mi.Float64(second.x) + mi.Float64(second.y)
        distance = (plane - dr.dot(normal, origin)) / dr.dot(normal, direction)
        block = dr.select(valid, mi.Int32(second.z), WALL)
        return Hits(valid, distance, found.prim_index, mi.Vector3f(first.x, first.y, first.z), first.w, block)

    def occluded(self, origin: mi.Array3f64, direction: mi.Array3f64, length: mi.Float64, *, coherent: bool = True) -> mi.Bool:
        """Whether something lies on each ray before `length` (n,), m for unit directions."""
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
        ray.maxt = mi.Float(length)
        return self._scene.ray_test(ray, coherent=coherent)

    def nearest_vertex_label(self, hits: Hits, point: mi.Array3f64, labels: mi.Int32) -> mi.Int32:
        """(n,) the label, out of one per vertex, of the hit face's vertex that is nearest to `point` (3 x (n,), m)."""
        nearest, result = mi.Float32(np.inf), mi.Int32(WALL)
        for corner in range(3):
            vertex = dr.gather(mi.UInt32, self._face_vertices, 3 * hits.face + corner, hits.valid)
            position = dr.gather(mi.Array3f64, self._vertices, vertex, hits.valid)
            distance = mi.Float32(dr.squared_norm(position - point))
            nearer = distance < nearest
            result = dr.select(nearer, dr.gather(mi.Int32, labels, vertex, hits.valid), result)
            nearest = dr.select(nearer, distance, nearest)  # dr.minimum aborts in LLVM 15
        return dr.select(hits.valid, result, WALL)

    @cached_property
    def _face_vertices(self) -> mi.UInt32:
        return mi.UInt32(self.mesh.faces.astype(np.uint32).ravel())

    @cached_property
    def _vertices(self) -> mi.Float64:
        return mi.Float64(self.mesh.vertices.ravel())

    def cast(self, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, IntArray]:
        """Cast rays given as NumPy arrays, (n, 3) each, m; returns distance and face (n,); a miss is NaN and -1."""
        columns = (np.ascontiguousarray(np.broadcast_to(array, directions.shape).T) for array in (origins, directions))
        hits = self.intersect(*(mi.Array3f64(column) for column in columns), coherent=False)
        distance = dr.select(hits.valid, hits.distance, np.nan)
        face = dr.select(hits.valid, mi.Int32(hits.face), -1)
        dr.eval(distance, face)
        return np.array(distance), np.array(face)

    def look_down(self, grid: Grid) -> tuple[Hits, mi.Array3f64]:
        """Cast one ray per pixel centre of `grid` along -z from above the mesh, row by row; returns hits and points."""
        index = dr.arange(mi.UInt32, grid.width * grid.height)
        row, column = index // grid.width, index % grid.width
        top = float(self.mesh.bounds[1, 2]) + 1.0
        x_min, y_max, gsd, start = (dr.opaque(mi.Float64, value) for value in (grid.x_min, grid.y_max, grid.gsd, top))
        origin = mi.Array3f64(x_min + (column + 0.5) * gsd, y_max - (row + 0.5) * gsd, start)
        hits = self.intersect(origin, mi.Array3f64(0.0, 0.0, -1.0))
        return hits, mi.Array3f64(origin.x, origin.y, origin.z - hits.distance)


def heights(caster: RayCaster, grid: Grid) -> NDArray[np.float32]:
    """(height, width) raster of the highest z of the mesh at each pixel centre, m; NaN where there is no surface."""
    hits, point = caster.look_down(grid)
    z = mi.Float32(dr.select(hits.valid, point.z, np.nan))
    return np.array(z).reshape(grid.shape)
