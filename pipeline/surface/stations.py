"""Several stations of a laser scanner: registered to the first without targets, and merged into one surface.

Every station's grid becomes a mesh of its own. Those of the further stations are registered to the first one's by ICP; what that
finds is how far their surveyed poses were wrong, against the first. Where several stations see the wall, the surface is that of
the one with the best expected precision there; where only one sees it, that one's: the surface covers all that any station saw.
Choosing instead of averaging keeps the seams of other stations' occlusions and errors of registration out of the surface.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.change.difference import DifferenceConfig, raster_grid, surface_raster
from pipeline.precision.surface import Places
from pipeline.precision.tls_geometry import tls_geometry
from pipeline.registration.closest_points import ReferenceSurface
from pipeline.registration.register import IcpConfig, Registration, register_to
from pipeline.surface.mesh import SurfaceConfig, mesh_observation
from scene.common.config import Config
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from scene.geometry.mesh import DEFAULT_ALBEDO, TriangleMesh
from sensors.laser.tls import LaserScanner
from sensors.signal_chain.observation import Observation

_CELL_PX = 16
"""Side of the cells in which precision is compared, in pixels of the difference map: it changes slowly over the wall."""
_FACES = 1 << 20


class StationsConfig(Config):
    """How several stations of a laser scanner become one surface."""

    icp: IcpConfig | None = Field(
        IcpConfig(), description="registration of the further stations to the first; none: surveyed poses as they are"
    )


@dataclass(frozen=True)
class Joined:
    """All stations in the frame of the first one's surveyed pose.

    observations: of each station, points moved by its registration; surface: merged; registrations: of the second station and
    those after it, empty where they were left out.
    """

    observations: tuple[Observation, ...]
    surface: TriangleMesh
    registrations: tuple[Registration, ...]


def join(
    scanners: Sequence[LaserScanner],
    observations: Sequence[Observation],
    config: StationsConfig,
    surface: SurfaceConfig,
    raster: DifferenceConfig,
    random: KeyedRandom,
) -> Joined:
    """Register the observations of `scanners` to the first and merge their surfaces at the resolution of `raster`."""
    meshes = [mesh_observation(observation, surface) for observation in observations]
    registrations = () if config.icp is None else tuple(_registered(meshes, config.icp, random))
    for number, found in enumerate(registrations, start=1):
        meshes[number] = meshes[number].with_vertices(found.apply(meshes[number].vertices))
    moved = [_moved(seen, found) for seen, found in zip(observations[1:], registrations, strict=bool(registrations))]
    return Joined((observations[0], *(moved or observations[1:])), merged(scanners, meshes, raster), registrations)


def _registered(meshes: Sequence[TriangleMesh], config: IcpConfig, random: KeyedRandom) -> Iterator[Registration]:
    """Of every mesh after the first to the first."""
    target = ReferenceSurface.build(meshes[0].vertices, meshes[0].vertex_normals())
    for number, mesh in enumerate(meshes[1:], start=2):
        yield register_to(target, mesh.vertices, config, random.child(number))


def merged(scanners: Sequence[LaserScanner], meshes: Sequence[TriangleMesh], config: DifferenceConfig) -> TriangleMesh:
    """One mesh of the stations' (wall frame): each triangle that some pixel needs whose best station is its own.

    Where two stations meet, their triangles overlap by less than one of them. At every pixel's centre there is a surface if any
    station has one.
    """
    bounds = np.stack([np.min([mesh.bounds[0] for mesh in meshes], axis=0), np.max([mesh.bounds[1] for mesh in meshes], axis=0)])
    grid = raster_grid(bounds, config)
    best, least = np.full(grid.shape, -1, dtype=np.int16), np.full(grid.shape, np.inf, dtype=np.float32)
    for number, (scanner, mesh) in enumerate(zip(scanners, meshes, strict=True)):
        heights = surface_raster(mesh, grid).heights
        variance = np.where(np.isnan(heights), np.float32(np.inf), _variance(scanner, grid, float(np.nanmean(heights))))
        better = variance < least
        best[better], least[better] = number, variance[better]
    parts = [mesh.submesh(_needed(mesh, grid, best == number)) for number, mesh in enumerate(meshes)]
    return _concatenated([part for part in parts if len(part.faces)])


def _moved(seen: Observation, found: Registration) -> Observation:
    further = seen.further and replace(seen.further, points=found.apply(seen.further.points))
    points = found.apply(seen.points)
    offset = None if seen.offset is None else seen.offset + (points - seen.points)[..., :2].astype(np.float32)
    return replace(seen, points=points, viewpoint=found.apply(seen.viewpoint), further=further, offset=offset)


def _variance(scanner: LaserScanner, grid: Grid, height_m: float) -> NDArray[np.float32]:
    """(h, w) variance of the mean of a station's points per area, m4: sigma_n^2 A at the middle of the cell that holds a pixel.

    sigma_n is a point's standard deviation along the wall's normal by the sensor model (`tls_geometry`) and A the wall's area
    per point, R^2 sin z d_az d_ze / cos i, both on the plane z = `height_m`. Huge but finite where seen from behind.
    """
    rows, columns = (-(-size // _CELL_PX) for size in grid.shape)
    side = _CELL_PX * grid.gsd
    x, y = np.meshgrid(grid.x_min + (np.arange(columns) + 0.5) * side, grid.y_max - (np.arange(rows) + 0.5) * side)
    points = np.stack([x, y, np.full_like(x, height_m)], axis=-1).reshape(-1, 3)
    normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    found = tls_geometry(scanner, Places(points, normals, np.full(len(points), DEFAULT_ALBEDO)))
    sin_zenith = np.sqrt(1 - np.square((points - scanner.position) @ scanner.rotation[:, 2] / found.range_m))
    area = found.range_m**2 * sin_zenith * scanner.pattern.azimuth_step * scanner.pattern.zenith_step
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = found.normal_sigma_m**2 * area / np.cos(found.incidence_rad)
    finite = np.where(np.isfinite(variance) & (variance >= 0), variance, 1e30).astype(np.float32)
    return np.repeat(np.repeat(finite.reshape(rows, columns), _CELL_PX, axis=0), _CELL_PX, axis=1)[: grid.height, : grid.width]


def _needed(mesh: TriangleMesh, grid: Grid, own: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(m,) faces within whose bounding box, over the wall's plane, lies a pixel of `own`, or part of one."""
    sums = np.pad(np.cumsum(np.cumsum(own, axis=0, dtype=np.int32), axis=1, dtype=np.int32), ((1, 0), (1, 0)))
    column = np.clip(np.floor(grid.columns(mesh.vertices[:, 0])), 0, grid.width - 1).astype(np.int32)
    row = np.clip(np.floor(grid.rows(mesh.vertices[:, 1])), 0, grid.height - 1).astype(np.int32)
    needed = np.empty(len(mesh.faces), dtype=bool)
    for start in range(0, len(mesh.faces), _FACES):
        faces = mesh.faces[start : start + _FACES]
        (left, right), (top, bottom) = ((place[faces].min(axis=1), place[faces].max(axis=1) + 1) for place in (column, row))
        count = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
        needed[start : start + _FACES] = count > 0
    return needed


def _concatenated(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """One mesh of labelled ones."""
    start = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    labels = [mesh.vertex_block for mesh in meshes if mesh.vertex_block is not None]
    return TriangleMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + np.int32(first) for mesh, first in zip(meshes, start[:-1], strict=True)]),
        vertex_block=np.concatenate(labels) if len(labels) == len(meshes) else None,
    )
