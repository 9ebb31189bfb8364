"""Register several stations of a laser scanner to the first one without targets, and merge them into one surface.

The grid of every station becomes a mesh. Those of the further stations are registered to the first one's by ICP, which
corrects the errors of their surveyed poses relative to the first. Where several stations see the wall, the surface of the one
with the best expected precision is used; elsewhere that of the only one. The surface thus covers everything that any station
saw. Selecting instead of averaging keeps seams (from occlusions of other stations and registration errors) out of the surface.
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
"""Side of the cells in which precision is compared, in pixels of the difference map; it changes slowly over the wall."""
_FACES = 1 << 20
"""Number of faces processed at a time."""


class StationsConfig(Config):
    """How a wall that a laser scanner measured from several positions (stations) becomes one surface."""

    icp: IcpConfig | None = Field(
        IcpConfig(), description="registration of the further stations to the first; none: surveyed poses are used unchanged"
    )


@dataclass(frozen=True)
class JoinedStations:
    """Store what a laser scanner measured from several positions (stations), joined in the wall frame of the first one's pose.

    Attributes
    ----------
    observations : tuple of Observation
        One per station, with points moved by its registration to the first.
    surface : TriangleMesh
        The triangle mesh of all stations together, m.
    registrations : tuple of Registration
        Registrations of the second and further stations to the first; empty if surveyed poses are used unchanged.
    """

    observations: tuple[Observation, ...]
    surface: TriangleMesh
    registrations: tuple[Registration, ...]


def join_stations(
    scanners: Sequence[LaserScanner],
    observations: Sequence[Observation],
    config: StationsConfig,
    surface: SurfaceConfig,
    raster: DifferenceConfig,
    random: KeyedRandom,
) -> JoinedStations:
    """Register what a scanner observed from several positions (stations) to the first one, and merge it to one surface.

    Parameters
    ----------
    scanners : sequence of LaserScanner
        The scanner at each station.
    observations : sequence of Observation
        What was observed from each station, in the same order, wall frame.
    config : StationsConfig
        Settings of the registration, or that there is none.
    surface : SurfaceConfig
        How each station's points are converted to a triangle mesh.
    raster : DifferenceConfig
        Gives the pixel size at which the best station is chosen for each place.
    random : KeyedRandom
        Source of random numbers for the subsamples of the registration.
    """
    meshes = [mesh_observation(observation, surface) for observation in observations]
    registrations = () if config.icp is None else tuple(_register_to_first(meshes, config.icp, random))
    for number, found in enumerate(registrations, start=1):
        meshes[number] = meshes[number].with_vertices(found.apply(meshes[number].vertices))
    moved = [_moved(seen, found) for seen, found in zip(observations[1:], registrations, strict=bool(registrations))]
    return JoinedStations(
        (observations[0], *(moved or observations[1:])), merge_stations(scanners, meshes, raster), registrations
    )


def _register_to_first(meshes: Sequence[TriangleMesh], config: IcpConfig, random: KeyedRandom) -> Iterator[Registration]:
    """Yield the registration of every mesh after the first to the first."""
    target = ReferenceSurface.build(meshes[0].vertices, meshes[0].vertex_normals())
    for number, mesh in enumerate(meshes[1:], start=2):
        yield register_to(target, mesh.vertices, config, random.child(number))


def merge_stations(scanners: Sequence[LaserScanner], meshes: Sequence[TriangleMesh], config: DifferenceConfig) -> TriangleMesh:
    """Merge the meshes of a wall from several scanner positions (stations), taking each place from the most precise station.

    That is the station whose points, averaged over a small area there, have the smallest expected variance. Where two
    stations meet, their triangles overlap by less than one triangle. Every pixel centre has a surface if any station has
    one there.

    Parameters
    ----------
    scanners : sequence of LaserScanner
        The scanner at each station, whose model gives the precision.
    meshes : sequence of TriangleMesh
        The mesh of each station, wall frame, m.
    config : DifferenceConfig
        Gives the pixel size at which the best station is chosen.
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
    """Apply a registration to an observation."""
    further = seen.further and replace(seen.further, points=found.apply(seen.further.points))
    points = found.apply(seen.points)
    offset = None if seen.offset is None else seen.offset + (points - seen.points)[..., :2].astype(np.float32)
    return replace(seen, points=points, viewpoint=found.apply(seen.viewpoint), further=further, offset=offset)


def _variance(scanner: LaserScanner, grid: Grid, height_m: float) -> NDArray[np.float32]:
    """Return the expected variance (h, w) of the mean of a station's points per unit area, m4, per pixel.

    It is sigma_n^2 A at the centre of the cell that contains the pixel. sigma_n is a point's standard deviation along the
    wall's normal by the sensor model (`tls_geometry`), and A the area of wall per point, R^2 sin z d_az d_ze / cos i, both on
    the plane z = `height_m`. It is very large but finite where the wall is seen from behind.
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
    """Return the faces (m,) whose bounding box, projected on the wall's plane, touches a pixel of `own`."""
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
    """Concatenate labelled meshes."""
    start = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    labels = [mesh.vertex_block for mesh in meshes if mesh.vertex_block is not None]
    return TriangleMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + np.int32(first) for mesh, first in zip(meshes, start[:-1], strict=True)]),
        vertex_block=np.concatenate(labels) if len(labels) == len(meshes) else None,
    )
