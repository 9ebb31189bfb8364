"""Find the highest face of a mesh at each pixel of a raster by drawing its triangles one by one.

Ray casting needs a tree of all triangles first, which takes several times as long as the raster itself. Here each triangle visits
the pixels in its bounding box. In a first pass each pixel keeps the greatest height, in a second one the face that has it. All
tests are in float64, and a centre on an edge lies in both triangles, so that no pixel inside a closed surface is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from scene.common.backend import dr, mi
from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh
from scene.ray_casting.raycast import check_castable, label_of_nearest_vertex
from scene.ray_casting.upload import on_device

_NONE = 0xFFFFFFFF
"""Number of no face."""
_STEPS = 4.29e9
"""Steps into which heights are divided to find the greatest one: 32 bits."""
_ON_EDGE = 1e-9
"""Tolerance of barycentric coordinates and, in pixels, of a triangle's bounding box."""
_MOST_TESTS = 16.0
"""Pixels in the bounding box of a face, on average, up to which drawing is quicker than casting rays, which needs a tree."""


@dataclass(frozen=True)
class TopFaces:
    """The face that a viewer above sees in each pixel of a raster of h x w pixels, looking along -z: the highest one.

    The arrays, on the ray-tracing device, have one entry a pixel, row by row.

    Attributes
    ----------
    valid : (h w,) bool
        Whether there is a face; the other entries have no meaning where there is none.
    face : (h w,) uint32
        Number of the face.
    point : 3 x (h w,) float64
        The place on the face at the pixel's centre, m.
    """

    valid: mi.Bool
    face: mi.UInt32
    point: mi.Array3f64


class FlatMesh:
    """A mesh whose triangles are ready to be drawn on a raster, seen along -z, to find the highest face in each pixel.

    It gives heights and block labels of a surface, often quicker than ray casting. It takes the mesh (wall frame, m) and the
    raster. Raises InputError if the mesh has no triangles or lies too far from the origin.
    """

    def __init__(self, mesh: TriangleMesh, grid: Grid) -> None:
        check_castable(mesh)
        self._mesh, self._grid = mesh, grid
        self._vertices = on_device(mi.Float64, mesh.vertices)
        self._face_vertices = on_device(mi.UInt32, mesh.faces)
        self._x_min, self._y_max, self._gsd = (dr.opaque(mi.Float64, each) for each in (grid.x_min, grid.y_max, grid.gsd))
        self._columns, self._rows = (dr.opaque(mi.Int32, each) for each in grid.shape[::-1])
        low, high = (float(each) for each in mesh.bounds[:, 2])
        self._lowest, self._steps = dr.opaque(mi.Float64, low), dr.opaque(mi.Float64, _STEPS / max(high - low, 1e-9))
        index = dr.arange(mi.UInt32, len(mesh.faces))
        corners = self._corners(index)
        self._u = [(corner.x - self._x_min) / self._gsd - 0.5 for corner in corners]
        self._v = [(self._y_max - corner.y) / self._gsd - 0.5 for corner in corners]
        self._height = [(corner.z - self._lowest) * self._steps for corner in corners]
        self._first_column, self._width = _span(self._u, self._columns)
        self._first_row, rows = _span(self._v, self._rows)
        self._count = mi.UInt32(self._width * rows)
        self._width = dr.select(self._width > 0, self._width, 1)  # divides also where nothing is drawn
        self._index = index

    @property
    def is_quick(self) -> bool:
        """Whether the mesh's faces are so small that drawing them on the raster is quicker than casting a ray for each pixel."""
        return float(dr.sum(mi.Float64(self._count))[0]) <= _MOST_TESTS * len(self._mesh.faces)

    def top_faces(self) -> TopFaces:
        """Draw all triangles of the mesh on the raster and return the highest face in each pixel, seen along -z."""
        pixels = self._grid.width * self._grid.height
        highest, face = dr.zeros(mi.UInt32, pixels), dr.full(mi.UInt32, _NONE, pixels)

        def keep_height(pixel: mi.UInt32, height: mi.UInt32, inside: mi.Bool) -> None:
            dr.scatter_reduce(dr.ReduceOp.Max, highest, height, pixel, inside)

        def keep_face(pixel: mi.UInt32, height: mi.UInt32, inside: mi.Bool) -> None:
            top = inside & (height == dr.gather(mi.UInt32, highest, pixel, inside))
            dr.scatter_reduce(dr.ReduceOp.Min, face, self._index, pixel, top)

        for keep, result in ((keep_height, highest), (keep_face, face)):
            self._visit(keep)
            dr.eval(result)
        valid = face != _NONE
        return TopFaces(valid, face, self._points(face, valid))

    def labels(self, top: TopFaces, labels: mi.Int32) -> mi.Int32:
        """Return the label of the fallen block that each pixel of the raster shows, for a mesh with labels only at its vertices.

        It is the label of the face's vertex that is nearest to the place seen in the pixel. top: the highest faces, as
        `top_faces` returns them. labels: (v,) int32, the label of each of the mesh's vertices, 0 for the wall.
        """
        return label_of_nearest_vertex(self._vertices, self._face_vertices, top.face, top.valid, top.point, labels)

    def _visit(self, keep: Callable[[mi.UInt32, mi.UInt32, mi.Bool], None]) -> None:
        """Call keep(pixel, height in steps, inside) for all pixels in each triangle's bounding box."""
        (u, *_), (v, *_), (height, *_) = self._u, self._v, self._height
        (ux, uy), (vx, vy), (hx, hy) = (
            [each - corners[0] for each in corners[1:]] for corners in (self._u, self._v, self._height)
        )
        area = ux * vy - uy * vx
        scale = dr.select(area != 0, 1 / area, 0.0)

        def body(number: mi.UInt32) -> tuple[mi.UInt32]:
            column = self._first_column + mi.Int32(number) % self._width
            row = self._first_row + mi.Int32(number) // self._width
            across, down = mi.Float64(column) - u, mi.Float64(row) - v
            first, second = (across * vy - down * uy) * scale, (ux * down - vx * across) * scale
            inside = (area != 0) & (first >= -_ON_EDGE) & (second >= -_ON_EDGE) & (first + second <= 1 + _ON_EDGE)
            steps = height + first * hx + second * hy
            keep(mi.UInt32(row * self._columns + column), mi.UInt32(dr.select(steps > 0, steps, 0.0)), inside)
            return (number + 1,)

        dr.while_loop((mi.UInt32(0),), lambda number: number < self._count, body)

    def _points(self, face: mi.UInt32, valid: mi.Bool) -> mi.Array3f64:
        """Return the places on the faces' planes at the pixels' centres."""
        index = dr.arange(mi.UInt32, self._grid.width * self._grid.height)
        row, column = index // self._grid.width, index % self._grid.width
        x, y = self._x_min + (column + 0.5) * self._gsd, self._y_max - (row + 0.5) * self._gsd
        corner, second, third = self._corners(face, valid)
        normal = dr.cross(second - corner, third - corner)
        return mi.Array3f64(x, y, corner.z - (normal.x * (x - corner.x) + normal.y * (y - corner.y)) / normal.z)

    def _corners(self, face: mi.UInt32, valid: mi.Bool | bool = True) -> list[mi.Array3f64]:
        """Return the three vertices of faces, m."""
        numbers = [dr.gather(mi.UInt32, self._face_vertices, 3 * face + corner, valid) for corner in range(3)]
        return [dr.gather(mi.Array3f64, self._vertices, number, valid) for number in numbers]


def _span(places: list[mi.Float64], size: mi.Int32) -> tuple[mi.Int32, mi.Int32]:
    """Return the first of `size` pixels whose centres lie between three places, px, and how many there are."""
    low, high = places[0], places[0]
    for place in places[1:]:  # dr.minimum aborts in LLVM 15
        low, high = dr.select(place < low, place, low), dr.select(place > high, place, high)
    first, last = mi.Int32(dr.ceil(low - _ON_EDGE)), mi.Int32(dr.floor(high + _ON_EDGE))
    first, last = dr.select(first > 0, first, 0), dr.select(last < size, last, size - 1)
    return first, dr.select(last >= first, last - first + 1, 0)
