"""Simulate a stereo pair vertex by vertex: the reconstruction of the reference implementation (thesis 3.4, method 2).

1  Every vertex of the wall is projected into the real pair (nominal calibration plus camera effects); image rows are displaced.
2  Both pixels are undistorted and rectified with the nominal calibration, which gives a disparity; matching effects are added.
3  The disparity is reprojected with the nominal calibration. The triangles stay the same, so rims and floors of niches do too.

Effects that depend on neighbouring pixels act on the ray-traced depth map; a vertex takes their change at its position.
Limits: parts that only one camera sees are not left out, as in the reference implementation. Each vertex has its own white noise,
however dense the vertices are, so a surface of fine triangles averages over more noise values than one of coarse triangles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scene.common.backend import dr, mi
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import WALL, FloatArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from scene.ray_casting.upload import on_device, vectors_on_device
from sensors.cameras.camera import Camera
from sensors.cameras.rectification import rectify
from sensors.effects.base import Effect, Stage, apply_stage
from sensors.numerics.device import cell_index, rotated, vector
from sensors.signal_chain.matches import Matches, fill_gaps
from sensors.signal_chain.observation import packed
from sensors.stereo.point_errors import active_point_effects, point_shifts
from sensors.stereo.stereo_pair import REDUCTION, StereoPair, rectified_disparity, reproject, row_displacement, row_tangent


def observe_vertices(pair: StereoPair, scene: RayCaster, random: KeyedRandom) -> TriangleMesh:
    """Return the wall as a stereo pair reconstructs it: a mesh with the true triangles and labels, and vertices with errors.

    `scene` is the wall; positions are in the wall frame. Vertices outside one of the images or behind a camera are left out.
    The same `random` draws the same orientation and row displacement as `pair.observe`; the matching noise of a vertex depends
    on its number. Raises InputError if nothing is left.
    """
    mesh = scene.mesh
    effects = pair.model.chain(random)
    nominal = pair.cameras.in_wall_frame(pair.frame)
    real = pair.real_pair(effects, random).in_wall_frame(pair.frame)
    point = vectors_on_device(mesh.vertices)
    u, v, depth, in_left = _projected(real.left, point)
    right_u, right_v, _, in_right = _projected(real.right, point)
    u += row_displacement(effects, "left", v, random)
    right_u += row_displacement(effects, "right", right_v, random)
    geometry = rectify(nominal)
    left_u, left_v, disparity = rectified_disparity(nominal, geometry, (u, v), (right_u, right_v))
    albedo = None if mesh.vertex_albedo is None else on_device(mi.Float32, mesh.vertex_albedo)
    block = mi.Int32(WALL) if mesh.vertex_block is None else on_device(mi.Int32, mesh.vertex_block)
    index, size = dr.arange(mi.UInt32, len(mesh.vertices)), (nominal.left.width, nominal.left.height, REDUCTION[pair.quality])
    rows = row_tangent(geometry, left_v), float(geometry.offset)
    matches: Matches = VertexMatches(
        index,
        u,
        v,
        disparity,
        in_left & in_right,
        block,
        depth,
        albedo,
        *size,
        *rows,
        _TracedCells(pair, scene, effects, random),
    )
    for stage in (Stage.MATCH, Stage.FILL):
        matches = apply_stage(effects, stage, matches, random)
    local = reproject(geometry, left_u, left_v, matches.disparity)
    recorded = packed(rotated(nominal.left.rotation, local) + vector(nominal.left.position))
    kept = matches.matched & (local.z > 0)
    dr.eval(recorded, kept)
    vertices = recorded.numpy().reshape(-1, 3)
    if moving := active_point_effects(effects):
        vertices = vertices + point_shifts(mesh, moving, mesh.vertices, random)
    return _kept(mesh.with_vertices(vertices), kept.numpy().astype(bool))


def _projected(camera: Camera, point: mi.Array3f64) -> tuple[mi.Float64, mi.Float64, mi.Float64, mi.Bool]:
    """Project points 3 x (n,), wall frame: return pixel (u, v), depth along the axis, m, and whether they are in the image."""
    local = rotated(camera.rotation.T, point - vector(camera.position))
    u, v = camera.on_device().pixel(local.x / local.z, local.y / local.z)
    return u, v, local.z, (local.z > 0) & (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)


def _kept(mesh: TriangleMesh, kept: np.ndarray) -> TriangleMesh:
    """Return the mesh of the triangles whose vertices are all `kept` (n,). Raises InputError if there is none."""
    chosen = kept[mesh.faces].all(axis=1)
    if not chosen.any():
        raise InputError(
            "no part of the wall is seen by both cameras",
            where="cameras",
            remedy="correct position_m and rotation of both cameras (camera to world; x right, y down, z "
            "forward) so that they look at the front of the wall",
        )
    if chosen.all() and kept.all():
        return mesh
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces[chosen]] = True
    number = np.cumsum(used, dtype=np.int32) - np.int32(1)
    channels = {name: getattr(mesh, name) for name in ("vertex_albedo", "vertex_block")}
    return TriangleMesh(
        mesh.vertices[used],
        number[mesh.faces[chosen]],
        **{name: None if channel is None else channel[used] for name, channel in channels.items()},
        face_block=None if mesh.face_block is None else mesh.face_block[chosen],
    )


class _TracedCells:
    """The ray-traced depth map of the observation whose vertices are simulated, computed only if an effect needs it."""

    def __init__(self, pair: StereoPair, scene: RayCaster, effects: tuple[Effect, ...], random: KeyedRandom) -> None:
        self._look = pair, scene, effects, random

    @cached_property
    def matches(self) -> Matches:
        """The matches of the depth map's cells."""
        pair, scene, effects, random = self._look
        return pair.traced(scene, effects, random)[0]


@dataclass(frozen=True)
class VertexMatches(Matches):
    """The n vertices of the wall's mesh as matches of a stereo pair, in place of a depth map's cells.

    `index` is the number of the vertex, and (u, v) its pixel in the left image.

    An effect that depends on neighbouring pixels, such as smoothing, cannot act on vertices. It acts on the ray-traced depth
    map of the same observation, and each vertex takes over the change of disparity that the effect made at its pixel.

    Attributes
    ----------
    cells : _TracedCells
        The ray-traced depth map, computed when an effect first needs it.
    before : (rows, columns) array, optional
        Disparities of that depth map after the effects so far, px; None before the first effect.
    """

    cells: _TracedCells
    before: FloatArray | None = None

    def raster(self) -> FloatArray:
        """Return the disparities (rows, columns), px, of the ray-traced depth map after the effects so far.

        They are NaN without a match. Effects that depend on neighbouring pixels act on this map, because the vertices have no
        neighbours in rows and columns.
        """
        return self.cells.matches.raster() if self.before is None else self.before

    def albedo_raster(self) -> FloatArray | None:
        """Return the albedo (rows, columns) of the rock that each cell of the depth map sees; None for a wall without albedo."""
        return self.cells.matches.albedo_raster()

    def sampled(self, raster: FloatArray) -> mi.Float64:
        """Read a raster (rows, columns) over the depth map at the n vertices, (n,), in the cell in which each lies."""
        columns, rows = (cell_index(place / self.reduction, count) for place, count in self._axes())
        return dr.gather(mi.Float64, on_device(mi.Float64, raster), rows * dr.opaque(mi.UInt32, self.shape[1]) + columns)

    def with_raster(self, disparity: FloatArray) -> Matches:
        """Transfer an effect on the depth map to the mesh's vertices: return matches whose disparities contain its change.

        The change of a cell is `disparity` minus `raster()`. A vertex takes the bilinear mean of the changes of the four cells
        round its pixel if all four see the vertex's surface, that is if their disparities differ from its own by less than one
        cell. Otherwise, as at a depth step, it takes the change of the cell whose disparity is closest. Cells without a match,
        which are half-occluded, count as background.

        disparity: (rows, columns) disparities of the depth map after the effect, px; NaN without a match.
        """
        was = fill_gaps(self.raster(), np.inf)
        change = on_device(mi.Float64, np.nan_to_num(disparity - was))
        old = on_device(mi.Float64, np.where(np.isnan(was), np.inf, was))
        stride, step = dr.opaque(mi.UInt32, self.shape[1]), dr.opaque(mi.Float64, self.reduction)
        least, nearest, mean = mi.Float64(np.inf), mi.Float64(0.0), mi.Float64(0.0)
        one_surface = dr.full(mi.Bool, True, dr.width(self.u))
        for across in (0, 1):
            for down in (0, 1):
                (column, weight), (row, other) = (
                    self._beside(place / step, count, side)
                    for (place, count), side in zip(self._axes(), (across, down), strict=True)
                )
                cell = row * stride + column
                distance, value = dr.abs(dr.gather(mi.Float64, old, cell) - self.disparity), dr.gather(mi.Float64, change, cell)
                nearer = distance < least
                nearest, least = dr.select(nearer, value, nearest), dr.select(nearer, distance, least)
                one_surface &= distance < step
                mean += weight * other * value
        return replace(self, disparity=self.disparity + dr.select(one_surface, mean, nearest), before=disparity)

    def _beside(self, place: mi.Float64, count: int, side: int) -> tuple[mi.UInt32, mi.Float64]:
        """Return the neighbouring cell (n,) along one axis for a linear interpolation, and its weight (n,).

        Parameters
        ----------
        place : mi.Float64, (n,)
            Position of the vertices along the axis, in cells from the edge of the frame.
        count : int
            Number of cells.
        side : int
            0 for the cell whose centre is before `place`, 1 for the one after.
        """
        first = dr.floor(place - 0.5)
        share = place - 0.5 - first
        return cell_index(first + side, count), share if side else 1 - share

    def _axes(self) -> tuple[tuple[mi.Float64, int], tuple[mi.Float64, int]]:
        """Return (u, number of columns) and (v, number of rows): left pixels of the vertices, px, and size of the depth map."""
        u, v = (dr.select(self.matched, place, 0.0) for place in (self.u, self.v))
        return (u, self.shape[1]), (v, self.shape[0])
