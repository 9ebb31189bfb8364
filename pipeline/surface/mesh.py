"""Make surfaces from points: grid triangulation of an organised observation, Poisson reconstruction of an unorganised cloud.

Grid triangulation connects each sample with its neighbours in the sensor's own rows and columns. Four samples make a cell, and a
cell makes two triangles along its shorter diagonal, or one if a corner is missing. An edge is cut at a depth discontinuity, where
its ends differ in range r (distance from the viewpoint) by more than a step and it lies nearly along the line of sight:

    |r_2 - r_1| > depth_step_m   and   |r_2 - r_1| > |p_2 - p_1| cos(grazing_angle_rad)

The first condition prevents noise from tearing a densely sampled surface; the second preserves a steep but continuous slope.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from scene.common.config import Config
from scene.common.errors import InputError
from scene.common.extras import how_to_install
from scene.common.native_output import suppress_stderr
from scene.geometry.mesh import FloatArray, IntArray, TriangleMesh, area_normals

if TYPE_CHECKING:  # it would import the ray tracer, which a surface from a point cloud does not need
    from sensors.signal_chain.observation import Observation

BoolArray = NDArray[np.bool_]

_POISSON_DEPTH_LIMIT = 12
"""Deepest octree that is chosen automatically: 4,096 cells along the cloud's longest side."""
_FINER = 4
"""Levels of the octree allowed below the one with cells as large as the spacing: finer cells are empty and take hours."""
_NORMAL_NEIGHBOURS = 30
"""Number of neighbours from which Open3D estimates a normal."""
_VOTES = 4096
"""Number of triangles that decide the winding of an organised grid; all but folded ones agree."""


class SurfaceConfig(Config):
    """How the points that a sensor measures are converted to a triangle mesh."""

    method: Literal["grid", "poisson"] = Field("grid", description="grid triangulation, or Open3D's Poisson reconstruction")
    depth_step_m: float = Field(0.3, ge=0, description="edges with a smaller range difference are never cut [m]")
    grazing_angle_rad: float = Field(
        0.15,
        ge=0,
        lt=np.pi / 2,
        description="edges at a larger angle to the line of sight are never cut; 0: no edge is cut [rad]",
    )
    holes: Literal["keep", "fill"] = Field("keep", description="leave holes open, or interpolate small ones")
    maximum_hole_px: int = Field(64, ge=1, description="with holes: fill, the largest hole that is filled, in missing samples")
    poisson_depth: int | None = Field(
        None, ge=4, le=16, description="depth of the octree; null: cells as large as the points' spacing"
    )
    poisson_trim_spacings: float = Field(
        3.0, gt=0, description="the Poisson surface ends this many median point spacings from the nearest point"
    )


def mesh_observation(observation: Observation, config: SurfaceConfig) -> TriangleMesh:
    """Make a triangle mesh from the points that a sensor observed, wall frame, m.

    Triangles are counter-clockwise as seen from the sensor. With the method grid, neighbouring samples are joined, and vertices
    are the samples that belong to a triangle, in the sensor's order. Each vertex has the number of its fallen block in
    `vertex_block`, 0 for the wall.

    Parameters
    ----------
    observation : Observation
        The sensor's samples and its viewpoint, wall frame.
    config : SurfaceConfig
        The method (grid or Poisson reconstruction) and its settings.

    Raises
    ------
    InputError
        If no triangle results.
    """
    points, block = observation.points, observation.block
    if config.method == "poisson":
        return mesh_cloud(points[observation.valid], block[observation.valid], observation.viewpoint, config)
    if config.holes == "fill":
        points, block = _fill_holes(points, block, config.maximum_hole_px)
    cells = _triangulate(points, observation.viewpoint, config)
    used = cells.used(block.shape)
    if not used.any():
        raise InputError(
            f"no triangle was made between the {int(observation.valid.sum()):,} points of the {observation.sensor} observation",
            where="surface",
            remedy="enlarge surface.depth_step_m, choose a smaller sampling step, or turn the sensor towards the wall",
        )
    vertices = points[used]
    faces = _oriented(cells.faces(used), vertices, observation.viewpoint)
    return TriangleMesh(vertices, faces, vertex_block=block[used].astype(np.int32, copy=False))


def mesh_cloud(points: FloatArray, block: IntArray, viewpoint: FloatArray, config: SurfaceConfig) -> TriangleMesh:
    """Make a triangle mesh from a point cloud whose points are in no order, by screened Poisson reconstruction.

    The method is that of Kazhdan and Hoppe (2013), as in Open3D. It closes the surface also where there are no points, so
    vertices farther from every point than `config.poisson_trim_spacings` times the median point spacing are removed. It runs in
    one thread, because Open3D's result is not reproducible with more.

    Parameters
    ----------
    points : (n, 3) array
        The cloud, wall frame, m.
    block : (n,) array
        Number of the fallen block to which each point belongs; 0 for the wall. A vertex takes that of the nearest point.
    viewpoint : (3,) array
        Position of the sensor, wall frame, m, towards which triangles and normals face.
    config : SurfaceConfig
        Settings of the reconstruction.

    Raises
    ------
    InputError
        If there are too few points, or most coincide, or the octree depth is too large for them, or Open3D is missing.
    """
    if len(points) <= _NORMAL_NEIGHBOURS:
        raise InputError(
            f"{len(points)} points are too few",
            where="Poisson surface",
            allowed=f"more than {_NORMAL_NEIGHBOURS}",
            remedy="give more points, or choose the method grid (for a point cloud: triangulation) instead of poisson",
        )
    usual = octree_depth(points)
    depth = config.poisson_depth or usual
    if depth > usual + _FINER:
        raise InputError(
            f"a depth of {depth} makes the octree's cells {2 ** (depth - usual)} times smaller than the points' spacing",
            where="poisson_depth",
            allowed=f"up to {usual + _FINER} for these points",
            remedy="leave poisson_depth out, which makes cells as large as the spacing",
        )
    vertices, faces = _poisson(points, viewpoint, depth)
    return labelled_surface(vertices, faces, points, (points, block), config)


def labelled_surface(
    vertices: FloatArray, faces: IntArray, points: FloatArray, labels: tuple[FloatArray, IntArray], config: SurfaceConfig
) -> TriangleMesh:
    """Remove the parts of a reconstructed surface that are far from its points, and label its vertices by fallen blocks.

    Poisson reconstruction closes the surface also where there are no points.

    Parameters
    ----------
    vertices, faces : (n, 3) and (m, 3) arrays
        The reconstructed triangle mesh: coordinates, m, and vertex numbers of the triangles.
    points : (k, 3) array
        The points from which it was made, m. Vertices farther from all of them than `config.poisson_trim_spacings` times their
        median spacing are removed.
    labels : (points, blocks)
        Labelled points (l, 3), m, and the number (l,) of the fallen block at each, 0 for the wall. A vertex takes that of the
        nearest point.
    config : SurfaceConfig
        Settings of the reconstruction.

    Raises
    ------
    InputError
        If nothing is left.
    """
    from scipy.spatial import cKDTree

    near = cKDTree(points).query(vertices, workers=-1)[0] <= config.poisson_trim_spacings * median_spacing(points)
    faces = faces[near[faces].all(axis=1)]
    if len(faces) == 0:
        raise InputError(
            "nothing of the Poisson surface lies near the points",
            where="surface",
            remedy="raise surface.poisson_depth or surface.poisson_trim_spacings",
        )
    mesh = TriangleMesh(vertices, faces).submesh()
    nearest = cKDTree(labels[0]).query(mesh.vertices, workers=-1)[1]
    return replace(mesh, vertex_block=labels[1][nearest].astype(np.int32))


def octree_depth(points: FloatArray) -> int:
    """Choose the octree depth of a Poisson reconstruction, such that its cells are about as large as the point spacing.

    The depth is at least 4 and limited above, which keeps memory bounded.

    Parameters
    ----------
    points : (n, 3) array
        The points, m.

    Raises
    ------
    InputError
        If most points coincide.
    """
    longest = float(np.ptp(points, axis=0).max())
    return int(np.clip(np.ceil(np.log2(longest / median_spacing(points))), 4, _POISSON_DEPTH_LIMIT))


def median_spacing(points: FloatArray) -> float:
    """Return the median distance of points (n, 3) of a cloud to their nearest neighbour, m.

    Raises InputError if most points coincide with another one.
    """
    from scipy.spatial import cKDTree

    spacing = float(np.median(cKDTree(points).query(points, k=2, workers=-1)[0][:, 1]))
    if not spacing > 0:
        raise InputError(
            "most points of the cloud lie twice in the same place",
            where="surface",
            remedy="remove the duplicate points, for example in CloudCompare",
        )
    return spacing


@dataclass(frozen=True)
class _Cells:
    """The triangles of each cell of an organised (h, w) grid; all arrays are (h-1, w-1) bool.

    A cell has corners a, b in its first row and c, d in its second.

    Attributes
    ----------
    first, second : array
        Which of the cell's two triangles exist.
    falling : array
        Whether the cell is split along a-d into (a, c, d) and (d, b, a), or along b-c into (a, c, b) and (d, b, c).
    """

    first: BoolArray
    second: BoolArray
    falling: BoolArray

    def used(self, shape: tuple[int, ...]) -> BoolArray:
        """Return the samples (h, w) that belong to a triangle."""
        used = np.zeros(shape, dtype=bool)
        used[:-1, :-1] |= self.first | (self.second & self.falling)
        used[:-1, 1:] |= self.second | (self.first & ~self.falling)
        used[1:, :-1] |= self.first | (self.second & ~self.falling)
        used[1:, 1:] |= self.second | (self.first & self.falling)
        return used

    def faces(self, used: BoolArray) -> IntArray:
        """Return the triangles (m, 3) over the numbered `used` samples, consistently wound.

        All first triangles of the cells come first, then the second ones.
        """
        number = _numbers(used)
        a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
        first = [a[self.first], c[self.first], np.where(self.falling, d, b)[self.first]]
        second = [d[self.second], b[self.second], np.where(self.falling, a, c)[self.second]]
        return np.stack([np.concatenate(pair) for pair in zip(first, second, strict=True)], axis=1)


def _triangulate(points: FloatArray, viewpoint: FloatArray, config: SurfaceConfig) -> _Cells:
    """Split every cell of points (h, w, 3) such that most triangles result; in a tie along the shorter diagonal."""
    local = points - viewpoint
    coordinates = np.ascontiguousarray(
        np.moveaxis(local, 2, 0), dtype=np.float32
    )  # float32 suffices for deciding which edges to cut
    distance = np.sqrt(np.einsum("ijk,ijk->ij", local, local))
    edges = _Edges(coordinates, distance.astype(np.float32), config)
    along_rows, _ = edges.join(np.s_[:, :-1], np.s_[:, 1:])
    along_columns, _ = edges.join(np.s_[:-1, :], np.s_[1:, :])
    ad, ad_length = edges.join(np.s_[:-1, :-1], np.s_[1:, 1:])
    bc, bc_length = edges.join(np.s_[:-1, 1:], np.s_[1:, :-1])
    ab, cd, ac, bd = along_rows[:-1], along_rows[1:], along_columns[:, :-1], along_columns[:, 1:]
    acd, dba, acb, dbc = ad & ac & cd, ad & ab & bd, bc & ac & ab, bc & bd & cd
    surplus = (acd.view(np.int8) + dba.view(np.int8)) - (acb.view(np.int8) + dbc.view(np.int8))
    falling = (surplus > 0) | ((surplus == 0) & (ad_length <= bc_length))
    return _Cells(np.where(falling, acd, acb), np.where(falling, dba, dbc), falling)


@dataclass(frozen=True)
class _Edges:
    """Edges between samples. coordinates: (3, h, w) float32, relative to the viewpoint, m; distance: (h, w) from it, m."""

    coordinates: NDArray[np.float32]
    distance: NDArray[np.float32]
    config: SurfaceConfig

    def join(self, start: tuple[slice, ...], end: tuple[slice, ...]) -> tuple[BoolArray, NDArray[np.float32]]:
        """Return whether the edges from `start` to `end` samples are kept (False at NaN), and their squared lengths, m2."""
        squared = np.square(self.coordinates[0][end] - self.coordinates[0][start])
        for axis in (1, 2):
            squared += np.square(self.coordinates[axis][end] - self.coordinates[axis][start])
        jump = np.square(self.distance[end] - self.distance[start])
        step = np.float32(self.config.depth_step_m**2)
        if self.config.grazing_angle_rad == 0:
            return squared < np.inf, squared
        return (jump <= step) | (jump <= np.float32(np.cos(self.config.grazing_angle_rad) ** 2) * squared), squared


def _numbers(used: BoolArray) -> IntArray:
    """Return the new index of each used element, in order; without meaning where `used` is False."""
    return (np.cumsum(used, dtype=np.int32) - np.int32(1)).reshape(used.shape)


def _oriented(faces: IntArray, vertices: FloatArray, viewpoint: FloatArray) -> IntArray:
    """Reverse all faces if most of a sample of them are clockwise as seen from the viewpoint."""
    corners = vertices[faces[:: max(len(faces) // _VOTES, 1)]]
    normal = area_normals(corners)
    towards = np.einsum("ij,ij->i", normal, viewpoint - corners[:, 0])
    return faces if np.median(towards) >= 0 else np.ascontiguousarray(faces[:, ::-1])


def _fill_holes(points: FloatArray, block: IntArray, maximum_px: int) -> tuple[FloatArray, IntArray]:
    """Interpolate holes of at most `maximum_px` missing samples that do not touch the border of the grid.

    A filled point is the mean of linear interpolations along its row and its column, weighted by the inverse width of the
    hole. This is an affine combination, so a hole in a plane is filled exactly. Its label is that of the nearest of the four
    ends.
    """
    missing = np.isnan(points[..., 0])
    rows, columns = np.nonzero(_small_holes(missing, maximum_px))
    weighted, weights = np.zeros((len(rows), 3)), np.zeros((len(rows), 1))
    label, reach = np.zeros(len(rows), dtype=block.dtype), np.full(len(rows), np.iinfo(np.int32).max)
    for axis, place in enumerate((rows, columns)):
        before, after = (ends[rows, columns] for ends in _ends(missing, axis))
        fraction = ((place - before) / (after - before))[:, None]
        first, last = ((end, columns) if axis == 0 else (rows, end) for end in (before, after))
        weight = 1.0 / (after - before)[:, None]
        weighted += weight * ((1 - fraction) * points[first] + fraction * points[last])
        weights += weight
        for end, sample in ((before, first), (after, last)):
            nearer = np.abs(end - place) < reach
            label, reach = np.where(nearer, block[sample], label), np.where(nearer, np.abs(end - place), reach)
    points, block = points.copy(), block.copy()
    points[rows, columns], block[rows, columns] = weighted / weights, label
    return points, block


def _small_holes(missing: BoolArray, maximum_px: int) -> BoolArray:
    """Return the missing samples (h, w) in 4-connected holes of at most `maximum_px`, away from the border."""
    from scipy import ndimage

    holes, _ = ndimage.label(missing)
    small = np.bincount(holes.ravel()) <= maximum_px
    for border in (holes[0], holes[-1], holes[:, 0], holes[:, -1]):
        small[border] = False
    return small[holes] & missing


def _ends(missing: BoolArray, axis: int) -> tuple[IntArray, IntArray]:
    """Find the samples with data on both sides of each position, along `axis`.

    Returns the index (h, w) of the last at or before the position, and of the next at or after it; -1 and n if there is none.
    """
    size = missing.shape[axis]
    place = np.arange(size, dtype=np.int32).reshape((-1, 1) if axis == 0 else (1, -1))
    before = np.maximum.accumulate(np.where(missing, np.int32(-1), place), axis=axis)
    after = np.flip(np.minimum.accumulate(np.flip(np.where(missing, np.int32(size), place), axis), axis=axis), axis)
    return before, after


def _poisson(points: FloatArray, viewpoint: FloatArray, depth: int) -> tuple[FloatArray, IntArray]:
    """Run Open3D's reconstruction with normals that point to the viewpoint. Returns vertices and faces."""
    try:
        import open3d  # slow to load, and only needed here
    except ImportError as error:
        how = how_to_install("poisson")
        raise InputError(
            f"the method poisson needs the package Open3D, which does not load ({error})",
            where="surface.method",
            remedy=f"install it: {how}",
        ) from None

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
    cloud.orient_normals_towards_camera_location(np.asarray(viewpoint, dtype=float))
    with suppress_stderr():
        surface, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    return np.asarray(surface.vertices).copy(), np.asarray(surface.triangles, dtype=np.int32).copy()
