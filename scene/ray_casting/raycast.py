"""Cast rays against one triangle mesh, with hits refined in float64.

Embree and OptiX trace in single precision, with an error of 6 um rms at 100 m. They say which triangle was hit, so the
distance is recomputed in float64 from that triangle's plane. Within some micrometres of an edge, single precision may pick the
wrong one of two triangles; on request this is decided again in float64. All arrays stay on the device and are evaluated
lazily, so that a sensor's whole chain fuses into one kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scene.common.backend import dr, mi
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import DEFAULT_ALBEDO, WALL, FloatArray, IntArray, TriangleMesh
from scene.ray_casting.upload import on_device, vectors_on_device

_LARGEST_COORDINATE = 1e4
"""Distance from the frame's origin, m, beyond which float32 resolves less than a millimetre."""

_EDGE_SHARE = 3e-4
"""Barycentric coordinate below which a hit counts as near an edge: 15 um on a triangle 5 cm high, the error of float32 at 100 m.
"""
_ASIDE = 3e-7
"""Offset of the auxiliary rays from a ray, relative to its length: 30 um at 100 m, more than the rounding of its direction to
float32.
"""
_AROUND = ((1.0, 0.0), (-0.5, 0.75**0.5), (-0.5, -(0.75**0.5)))
"""Directions of the auxiliary rays: some lie on both sides of any line through the ray."""
_ROUNDING = 1e-11
"""Tolerance of barycentric coordinates in float64, so that a ray through an edge hits at least one of its faces."""

_SIGHTS = 4096
"""Number of lines of sight that decide which side of a surface is seen."""


@dataclass(frozen=True)
class Hits:
    """What n rays hit: lazy arrays of the ray-tracing device. Where `valid` is False, the other entries have no meaning.

    Attributes
    ----------
    valid : (n,) bool
        Whether the ray hits anything.
    distance : (n,) float64
        Distance in lengths of the direction vector (m for unit directions).
    face : (n,) uint32
        Index of the face that is hit.
    normal : 3 x (n,) float32
        Unit normal on the side from which the ray comes, as rock is opaque from both sides.
    albedo : (n,) float32
        Mean albedo of the face.
    block : (n,) int32
        Label of the fallen block whose niche the face belongs to; WALL (0) for the wall or a miss.
    """

    valid: mi.Bool
    distance: mi.Float64
    face: mi.UInt32
    normal: mi.Vector3f
    albedo: mi.Float32
    block: mi.Int32


def check_castable(mesh: TriangleMesh) -> None:
    """Check that rays can be cast at a mesh: raise InputError if it has no triangles or lies too far from the origin.

    Far from the origin, single precision is too coarse.
    """
    if len(mesh.faces) == 0:
        raise InputError(
            "the mesh has no triangles", where="ray casting", remedy="give a mesh that contains triangles, not points alone"
        )
    if not np.abs(mesh.bounds).max() < _LARGEST_COORDINATE:
        raise InputError(
            f"coordinates reach {np.abs(mesh.bounds).max():.0f} m, too far from the origin for single precision",
            where="ray casting",
            allowed=f"less than {_LARGEST_COORDINATE:.0f} m",
            remedy="export the mesh in metres, or subtract its centre from the coordinates of mesh and sensor",
        )


class RayCaster:
    """A mesh prepared for ray casting, in a frame whose origin is near (the wall frame).

    The ray tracer works in single precision, which needs small coordinates; distances are then refined to double precision.

    Attributes
    ----------
    mesh : TriangleMesh
        The mesh, as given.
    bare : mi.Scene
        Mitsuba's scene of the mesh, which casts rays in single precision without refinement.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        check_castable(mesh)
        self.mesh = mesh
        shape = mi.Mesh("surface", len(mesh.vertices), len(mesh.faces))
        parameters = mi.traverse(shape)
        self._vertices = on_device(mi.Float64, mesh.vertices)
        self._face_vertices = on_device(mi.UInt32, mesh.faces)
        parameters["vertex_positions"] = on_device(mi.Float32, mesh.vertices)
        parameters["faces"] = self._face_vertices
        parameters.update()
        self.bare = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "surface": shape})

    @cached_property
    def _records(self) -> mi.Float32:
        """(8 m,) float32 array with one record per face: half a cache line, so that a hit costs one memory access.

        The face's plane is n . x = d, with n scaled so that its largest component, along `axis`, is +-1. The other two
        components (in cyclic order after the axis) and d are stored as sums of two float32, which keep 48 bits. The order is
        n_1 high, n_1 low, n_2 high, n_2 low, d high, d low, albedo, 6 block + 2 axis + (1 if n's largest component is
        negative).
        """
        index = dr.arange(mi.UInt32, len(self.mesh.faces))
        blocks = self.mesh.face_block
        labels = mi.Int32(WALL) if blocks is None else on_device(mi.Int32, blocks)
        vertex = [dr.gather(mi.UInt32, self._face_vertices, 3 * index + corner) for corner in range(3)]
        corner, second, third = (dr.gather(mi.Array3f64, self._vertices, number) for number in vertex)
        normal = dr.cross(second - corner, third - corner)
        axis, largest = _largest_component(normal)
        # not `/`, which multiplies by a reciprocal that CUDA approximates; NaN for a face without area, which is never hit
        normal *= 1 / dr.abs(largest)
        following = dr.select(axis == 0, normal.y, dr.select(axis == 1, normal.z, normal.x))
        last = dr.select(axis == 0, normal.z, dr.select(axis == 1, normal.x, normal.y))
        code = mi.Float32(6 * labels + 2 * mi.Int32(axis) + dr.select(largest < 0, 1, 0))  # exact below 2^24: 2.7 million blocks
        columns = [part for value in (following, last, dr.dot(normal, corner)) for part in _split(value)]
        records = dr.empty(mi.Float32, 8 * len(self.mesh.faces))
        columns += [self._albedo(vertex), code]
        dr.eval(columns)
        for half in (0, 1):
            dr.scatter(records, mi.Array4f(*columns[4 * half : 4 * half + 4]), 2 * index + half)
        dr.eval(records)
        return records

    def _albedo(self, vertex: list[mi.UInt32]) -> mi.Float32:
        """Return the mean albedo of each face's three vertices."""
        if self.mesh.vertex_albedo is None:
            return mi.Float32(DEFAULT_ALBEDO)
        albedo = on_device(mi.Float32, self.mesh.vertex_albedo)
        return sum((dr.gather(mi.Float32, albedo, number) for number in vertex), mi.Float32(0)) / 3

    def intersect(self, origin: mi.Array3f64, direction: mi.Array3f64, *, coherent: bool = True, exact: bool = False) -> Hits:
        """Cast n rays and return the first face that each hits, with distance, normal and albedo.

        Parameters
        ----------
        origin, direction : 3 x (n,) float64
            Start and direction of the rays, m. The direction need not have unit length.
        coherent : bool
            Whether neighbouring rays are nearly parallel, which the ray tracer exploits.
        exact : bool
            Whether to decide in float64 which face a ray near an edge hits, instead of trusting single precision.
        """
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
        found = self.bare.ray_intersect_preliminary(ray, coherent=coherent)
        valid, face = found.is_valid(), found.prim_index
        if exact:
            u, v = found.prim_uv
            at_edge = valid & ((u < _EDGE_SHARE) | (v < _EDGE_SHARE) | (1 - u - v < _EDGE_SHARE))
            face = self._settle(face, origin, direction, at_edge)
        first = dr.gather(mi.Array4f, self._records, 2 * face, valid)
        second = dr.gather(mi.Array4f, self._records, 2 * face + 1, valid)
        code = mi.UInt32(second.w)
        block, rest = code // 6, code % 6
        normal = _plane_normal(rest >> 1, (rest & 1) == 1, _joined(first.x, first.y), _joined(first.z, first.w))
        slope = dr.dot(normal, direction)
        distance = (_joined(second.x, second.y) - dr.dot(normal, origin)) / slope
        towards = dr.select(slope > 0, -mi.Vector3f(normal), mi.Vector3f(normal))
        return Hits(valid, distance, face, dr.normalize(towards), second.z, mi.Int32(block))

    def _settle(self, face: mi.UInt32, origin: mi.Array3f64, direction: mi.Array3f64, at_edge: mi.Bool) -> mi.UInt32:
        """Find the face that each ray near an edge hits first, in float64.

        The candidates are the face found in single precision and the faces that three auxiliary rays hit. `face` is (n,) as
        found; `at_edge` (n,) marks the rays to decide again, a small share. The others keep their face.
        """
        ahead = dr.normalize(mi.Vector3f(direction))
        side, other = mi.coordinate_system(ahead)
        reach = mi.Float64(_ASIDE) * dr.norm(direction)
        distance, inside = self._meets(face, origin, direction, at_edge)
        nearest = dr.select(at_edge & inside & (distance < np.inf), distance, np.inf)

        def beside(number: mi.UInt32, nearest: mi.Float64, settled: mi.UInt32) -> tuple[mi.UInt32, mi.Float64, mi.UInt32]:
            (right, *rights), (up, *ups) = zip(*_AROUND, strict=True)
            right = dr.select(number == 0, mi.Float32(right), dr.select(number == 1, *(mi.Float32(each) for each in rights)))
            up = dr.select(number == 0, mi.Float32(up), dr.select(number == 1, *(mi.Float32(each) for each in ups)))
            aside = mi.Array3f64(right * side + up * other)
            ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction + reach * aside))
            found = self.bare.ray_intersect_preliminary(ray, active=at_edge)
            candidate = dr.select(found.is_valid(), found.prim_index, face)
            distance, inside = self._meets(candidate, origin, direction, at_edge)
            better = inside & (distance < nearest)
            return number + 1, dr.select(better, distance, nearest), dr.select(better, candidate, settled)

        start = (mi.UInt32(0), nearest, face)
        return dr.while_loop(start, lambda number, *_: at_edge & (number < len(_AROUND)), beside)[2]

    def _meets(
        self, face: mi.UInt32, origin: mi.Array3f64, direction: mi.Array3f64, active: mi.Bool
    ) -> tuple[mi.Float64, mi.Bool]:
        """Return the distance to the plane of `face`, and whether the ray passes through the face.

        The test is that of Moeller and Trumbore (1997), in float64.
        """
        numbers = (dr.gather(mi.UInt32, self._face_vertices, 3 * face + corner, active) for corner in range(3))
        a, b, c = (dr.gather(mi.Array3f64, self._vertices, number, active) for number in numbers)
        b, c, offset = b - a, c - a, origin - a
        across, around = dr.cross(direction, c), dr.cross(offset, b)
        scale = 1 / dr.dot(b, across)
        u, v, distance = scale * dr.dot(offset, across), scale * dr.dot(direction, around), scale * dr.dot(c, around)
        return distance, (u >= -_ROUNDING) & (v >= -_ROUNDING) & (u + v <= 1 + _ROUNDING) & (distance > 0)

    def occluded(self, origin: mi.Array3f64, direction: mi.Array3f64, length: mi.Float64, *, coherent: bool = True) -> mi.Bool:
        """Return whether the mesh blocks each of n rays within `length`, such as a ray towards the sun or the other camera.

        Parameters
        ----------
        origin, direction : 3 x (n,) float64
            Start and direction of the rays, m.
        length : (n,) float64
            Distance in lengths of the direction vector (m for unit directions).
        coherent : bool
            Whether neighbouring rays are nearly parallel, which the ray tracer exploits.
        """
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
        ray.maxt = mi.Float(length)
        return self.bare.ray_test(ray, coherent=coherent)

    def nearest_vertex_label(self, hits: Hits, point: mi.Array3f64, labels: mi.Int32) -> mi.Int32:
        """Return the label of the fallen block at each of n hit points, for a mesh with labels only at its vertices.

        It is the label of the hit face's vertex that is nearest to the hit point.

        Parameters
        ----------
        hits : Hits
            The n hits.
        point : 3 x (n,) float64
            The hit points, m.
        labels : (v,) int32
            Label of each of the mesh's vertices, 0 for the wall.
        """
        return label_of_nearest_vertex(self._vertices, self._face_vertices, hits.face, hits.valid, point, labels)

    def cast(self, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, IntArray]:
        """Cast n rays given as NumPy arrays and return where they hit the mesh first.

        Parameters
        ----------
        origins : (n, 3) or (3,) array
            Starts of the rays, or the common start of all, m.
        directions : (n, 3) array
            Directions of the rays.

        Returns
        -------
        (n,) array and (n,) int array
            Distances in lengths of the direction vectors, and face numbers; NaN and -1 for a miss.
        """
        origin = mi.Array3f64(*(dr.opaque(mi.Float64, x) for x in origins)) if origins.ndim == 1 else vectors_on_device(origins)
        hits = self.intersect(origin, vectors_on_device(directions), coherent=False)
        distance = dr.select(hits.valid, hits.distance, np.nan)
        face = dr.select(hits.valid, mi.Int32(hits.face), -1)
        dr.eval(distance, face)
        return np.array(distance), np.array(face)

    def sides_seen(self, position: FloatArray) -> tuple[IntArray, NDArray[np.bool_]]:
        """Find the faces that a sensor sees, and which of them it sees from behind, to check that it stands before the wall.

        Lines of sight are cast from `position` (3,), m, to some thousands of the mesh's vertices. Returns the numbers (k,) of
        the faces, and a mask (k,) that is True for those seen from behind.
        """
        vertices = self.mesh.vertices[:: max(len(self.mesh.vertices) // _SIGHTS, 1)]
        sight = vertices - position
        _, face = self.cast(position, sight)
        met = face >= 0
        return face[met], np.einsum("ij,ij->i", self.mesh.face_normals(face[met]), sight[met]) > 0

    def labels_down(self, grid: Grid, shift_m: NDArray[np.float32]) -> IntArray:
        """Return the label (h, w) of the fallen block that each pixel of a difference map shows from above; 0 for the wall.

        The view is along -z. grid: the raster. shift_m: (h, w, 2) how far the map is displaced in x and y by errors of
        measurement, m; it is subtracted from each pixel centre before looking down.
        """
        hits, _ = self.look_down(grid, shift_m)
        return np.array(hits.block).reshape(grid.shape)

    def look_down(self, grid: Grid, shift_m: NDArray[np.float32] | None = None) -> tuple[Hits, mi.Array3f64]:
        """Cast one ray along -z through each pixel centre of a raster, row by row, to find the mesh's height and face there.

        Parameters
        ----------
        grid : Grid
            The raster, h x w pixels.
        shift_m : (h, w, 2) array, optional
            Offset of each ray towards -x and -y, m; None: none.

        Returns
        -------
        Hits and mi.Array3f64
            The hits and the hit points, one for each of the h w pixels.
        """
        index = dr.arange(mi.UInt32, grid.width * grid.height)
        row, column = index // grid.width, index % grid.width
        top = float(self.mesh.bounds[1, 2]) + 1.0
        x_min, y_max, gsd, start = (dr.opaque(mi.Float64, value) for value in (grid.x_min, grid.y_max, grid.gsd, top))
        x, y = x_min + (column + 0.5) * gsd, y_max - (row + 0.5) * gsd
        if shift_m is not None:
            x, y = (place - on_device(mi.Float64, shift_m[..., axis]) for axis, place in enumerate((x, y)))
        origin = mi.Array3f64(x, y, start)
        hits = self.intersect(origin, mi.Array3f64(0.0, 0.0, -1.0))
        return hits, mi.Array3f64(origin.x, origin.y, origin.z - hits.distance)


def label_of_nearest_vertex(
    vertices: mi.Float64, face_vertices: mi.UInt32, face: mi.UInt32, valid: mi.Bool, point: mi.Array3f64, labels: mi.Int32
) -> mi.Int32:
    """Return the label of the fallen block at each of n places on faces of a mesh that has labels only at its vertices.

    It is the label of the face's vertex that is nearest to the place.

    Parameters
    ----------
    vertices, face_vertices : (3 v,) float64 and (3 f,) uint32
        Coordinates of the mesh's v vertices, m, and numbers of the vertices of its f faces.
    face, valid : (n,) uint32 and bool
        Number of the face at each place, and whether there is one.
    point : 3 x (n,) float64
        The places, m.
    labels : (v,) int32
        Label of each vertex, 0 for the wall.

    Returns
    -------
    (n,) int32
        The labels; WALL (0) where there is no face.
    """
    nearest, result = mi.Float32(np.inf), mi.Int32(WALL)
    for corner in range(3):
        vertex = dr.gather(mi.UInt32, face_vertices, 3 * face + corner, valid)
        position = dr.gather(mi.Array3f64, vertices, vertex, valid)
        distance = mi.Float32(dr.squared_norm(position - point))
        nearer = distance < nearest
        result = dr.select(nearer, dr.gather(mi.Int32, labels, vertex, valid), result)
        nearest = dr.select(nearer, distance, nearest)  # dr.minimum aborts in LLVM 15
    return dr.select(valid, result, WALL)


def _largest_component(vector: mi.Array3f64) -> tuple[mi.UInt32, mi.Float64]:
    """Return the axis and the value of the vector's component with the largest magnitude."""
    size = dr.abs(vector)
    axis = dr.select(size.x >= size.y, dr.select(size.x >= size.z, 0, 2), dr.select(size.y >= size.z, 1, 2))
    return mi.UInt32(axis), dr.select(axis == 0, vector.x, dr.select(axis == 1, vector.y, vector.z))


def _split(value: mi.Float64) -> tuple[mi.Float32, mi.Float32]:
    """Split a float64 into the sum of two float32."""
    high = mi.Float32(value)
    return high, mi.Float32(value - mi.Float64(high))


def _joined(high: mi.Float32, low: mi.Float32) -> mi.Float64:
    """Join two float32 into the float64 that `_split` came from."""
    return mi.Float64(high) + mi.Float64(low)


def _plane_normal(axis: mi.UInt32, negative: mi.Bool, following: mi.Float64, last: mi.Float64) -> mi.Array3f64:
    """Rebuild a normal from its record: the component along `axis` is +-1, then `following` and `last` in cyclic order."""
    largest = dr.select(negative, mi.Float64(-1.0), mi.Float64(1.0))
    return mi.Array3f64(
        dr.select(axis == 0, largest, dr.select(axis == 1, last, following)),
        dr.select(axis == 1, largest, dr.select(axis == 2, last, following)),
        dr.select(axis == 2, largest, dr.select(axis == 0, last, following)),
    )


def heights(caster: RayCaster, grid: Grid) -> NDArray[np.float32]:
    """Return the heights of a surface as a raster: the highest z of the mesh at each pixel centre, m.

    caster: the mesh, ready for ray casting. grid: the raster, in the mesh's frame. Returns (h, w); NaN where there is no surface.
    """
    hits, point = caster.look_down(grid)
    z = mi.Float32(dr.select(hits.valid, point.z, np.nan))
    return np.array(z).reshape(grid.shape)
