"""Read real epochs as difference maps over a wall's plane, from a measurement's points or from existing GeoTIFFs.

The difference of a point p is the z of the reference at p's position in the wall's plane minus p's z. A pixel holds the mean
of its points' differences, so nothing is interpolated between points. Missing rock is positive.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.change.areas import Area, in_areas
from pipeline.change.difference import DifferenceConfig, raster_grid
from pipeline.formats.measurements.measurement import FILE, read_measurement
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.registration.closest_points import ReferenceSurface
from pipeline.registration.register import IcpConfig, Registration, register_to
from scene.common.backend import mi
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster
from scene.ray_casting.upload import on_device

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class MeasuredMaps:
    """Difference maps of really measured (not simulated) epochs, on one grid.

    Attributes
    ----------
    name : str
        Name of the folder that they were read from.
    grid : Grid
        Raster of the maps.
    maps : (e, h, w) float32 array
        Differences of e epochs, reference minus epoch along z of the wall frame, m; NaN without data.
    stable : (h, w) bool array or None
        True in the areas where nothing has changed; None if the measurement does not state any.
    points : tuple of int
        Number of points of each epoch; empty for maps from files.
    registrations : tuple of Registration
        Registration of each epoch to the reference; empty if none was computed.
    """

    name: str
    grid: Grid
    maps: NDArray[np.float32]
    stable: BoolArray | None
    points: tuple[int, ...] = ()
    registrations: tuple[Registration, ...] = ()


def read_measured(folder: Path, config: DifferenceConfig, icp: IcpConfig | None, random: KeyedRandom) -> MeasuredMaps:
    """Read difference maps of really measured epochs from a folder, or compute them from points.

    The folder contains measurement.yaml, which names point clouds and their reference, or GeoTIFFs that share a grid:
    difference_*.tif, or all *.tif if none has such a name.

    Parameters
    ----------
    folder : Path
        The folder.
    config : DifferenceConfig
        Gives the pixel size of maps from points. Pixels are larger if the points are sparser, because most would be empty
        otherwise.
    icp : IcpConfig or None
        Settings for registering each epoch's points to the reference; None: the points are registered already.
    random : KeyedRandom
        Source of the registration's random subsamples.

    Raises
    ------
    InputError
        If the folder contains neither, or its maps differ in their grids.
    """
    if (folder / FILE).is_file():
        return _from_points(folder, config, icp, random)
    files = map_files(folder)
    maps, grids = zip(*map(read_geotiff, files), strict=True)
    for file, grid in zip(files, grids, strict=True):
        if grid != grids[0]:
            raise InputError(
                f"the raster of the map ({grid}) differs from that of {files[0].name} ({grids[0]})",
                where=str(file),
                remedy="resample all maps to the same origin, pixel size and shape",
            )
    return MeasuredMaps(folder.name, grids[0], np.stack(maps), None)


def map_files(folder: Path) -> list[Path]:
    """Return the GeoTIFFs of measured epochs in a folder, by name: difference_*.tif, or all *.tif if none has such a name.

    Raises InputError if there are none.
    """
    files = sorted(folder.glob("difference_*.tif")) or sorted(folder.glob("*.tif"))
    if not files:
        raise InputError(
            "the folder contains no measured epochs",
            where=str(folder),
            remedy="name a folder with measurement.yaml or with difference maps (*.tif)",
        )
    return files


def _from_points(folder: Path, config: DifferenceConfig, icp: IcpConfig | None, random: KeyedRandom) -> MeasuredMaps:
    """Make the maps from a measurement's points."""
    measurement = read_measurement(folder)
    bounds, epochs = measurement.reference.bounds, measurement.epochs
    clouds = [measurement.cloud.points[epochs == number] for number in np.unique(epochs)]
    target = ReferenceSurface.build(measurement.reference.vertices, measurement.reference.vertex_normals()) if icp else None
    registrations = []
    for number, points in enumerate(clouds):
        if target is not None and icp is not None:
            registrations.append(register_to(target, points, icp, random.child("register", number)))
            clouds[number] = registrations[-1].apply(points)
    grid = raster_grid(bounds, DifferenceConfig(gsd_m=max(config.gsd_m, max(map(_spacing, clouds)))))
    maps = np.stack([point_differences(measurement.scene, points, grid) for points in clouds])
    stable = area_mask(measurement.stable_areas, grid) if measurement.stable_areas else None
    return MeasuredMaps(folder.name, grid, maps, stable, tuple(map(len, clouds)), tuple(registrations))


def _spacing(points: FloatArray) -> float:
    """Return the side, m, of the square in the wall's plane that each point has on average."""
    low, high = np.quantile(points[:, :2], [0.01, 0.99], axis=0)
    return float(np.sqrt(np.prod(high - low) / len(points)))


def point_differences(reference: RayCaster, points: FloatArray, grid: Grid) -> NDArray[np.float32]:
    """Return a difference map of points: for each pixel, the mean distance of its points from a reference surface.

    A distance is the surface's z minus the point's z in the wall frame, so missing rock is positive.

    Parameters
    ----------
    reference : RayCaster
        The reference surface, for ray casting.
    points : (n, 3) array
        Points, wall frame, m.
    grid : Grid
        Raster of the map.

    Returns
    -------
    (h, w) float32 array
        Differences, m; NaN without points.
    """
    top = float(reference.mesh.bounds[1, 2]) + 1.0
    x, y = (on_device(mi.Float64, np.ascontiguousarray(points[:, axis])) for axis in (0, 1))
    hits = reference.intersect(mi.Array3f64(x, y, top), mi.Array3f64(0.0, 0.0, -1.0), coherent=False)
    below = np.where(np.array(hits.valid), top - np.array(hits.distance), np.nan) - points[:, 2]
    column, row = np.floor(grid.columns(points[:, 0])), np.floor(grid.rows(points[:, 1]))
    inside = (column >= 0) & (column < grid.width) & (row >= 0) & (row < grid.height) & np.isfinite(below)
    place = (row[inside] * grid.width + column[inside]).astype(np.int64)
    size = grid.width * grid.height
    count, total = np.bincount(place, minlength=size), np.bincount(place, below[inside], size)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32).reshape(grid.shape)


def area_mask(areas: Iterable[Area], grid: Grid) -> BoolArray:
    """Return the pixels of a raster that lie in given areas, for example in stable areas that a user has drawn.

    areas: polygons or boxes in the wall frame, m. grid: the raster. Returns an (h, w) mask, true for pixels with their centre
    in one of the areas.
    """
    x = grid.x_min + (np.arange(grid.width) + 0.5) * grid.gsd
    y = grid.y_max - (np.arange(grid.height) + 0.5) * grid.gsd
    return in_areas(areas, *np.meshgrid(x.astype(np.float64), y.astype(np.float64)))
