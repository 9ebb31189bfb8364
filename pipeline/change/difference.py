"""Rasterise surfaces over the wall's plane, subtract them, and compute statistics of the difference."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import psutil
from numpy.typing import NDArray
from pydantic import Field

from pipeline.change.robust import nmad
from scene.common.backend import dr, mi
from scene.common.config import Config
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import WALL, FloatArray, IntArray, TriangleMesh
from scene.ray_casting.rasterise import FlatMesh
from scene.ray_casting.raycast import RayCaster
from scene.ray_casting.upload import on_device

_BYTES_PER_PIXEL = 64
"""Peak memory per pixel: reference, epoch, difference, labels, and copies for statistics and pictures."""
_MOST_PIXELS = 2**32 - 1
"""Dr.Jit numbers the elements of an array with 32 bits."""


class DifferenceConfig(Config):
    """How the surfaces of two epochs are compared in a difference map."""

    gsd_m: float = Field(0.02, gt=0, description="side of a pixel of the difference map [m]")


@dataclass(frozen=True)
class SurfaceRaster:
    """Heights of a surface seen from the sensors' side along the wall's normal, as a raster.

    Attributes
    ----------
    grid : Grid
        Position of the pixels.
    heights : (h, w) float32 array
        z of the highest surface at each pixel centre, wall frame, m; NaN where there is none.
    block : (h, w) int32 array
        Label of the fallen block whose niche is seen there (the label of the face or, for a surface with labels only at its
        vertices, of the nearest vertex); 0 where there is none.
    """

    grid: Grid
    heights: NDArray[np.float32]
    block: IntArray


def raster_grid(bounds: FloatArray, config: DifferenceConfig) -> Grid:
    """Return the grid of pixels for difference maps of a wall: all that lie inside the reference surface's bounding box.

    bounds: (2, 3) smallest and largest coordinates of the box, wall frame, m. config: gives the size of a pixel. Raises
    InputError if a pixel would be larger than the surface, or if the rasters would not fit into the free memory.
    """
    width, height = (float(extent) for extent in (bounds[1] - bounds[0])[:2])
    available = psutil.virtual_memory().available
    most = min(available / _BYTES_PER_PIXEL, _MOST_PIXELS)
    finest, coarsest = np.sqrt(width * height / most), min(width, height)
    allowed = f"{_rounded_up(finest):g} to {coarsest:.3g} m for a surface of {width:.1f} x {height:.1f} m"
    if config.gsd_m > coarsest:
        raise InputError(
            f"a pixel of {config.gsd_m:g} m is larger than the surface",
            where="difference.gsd_m",
            allowed=allowed,
            remedy="choose a smaller gsd_m",
        )
    pixels = width * height / config.gsd_m**2
    if pixels > most:
        raise InputError(
            f"pixels of {config.gsd_m:g} m would take {pixels:.3g} pixels and "
            f"{pixels * _BYTES_PER_PIXEL / 1e9:,.0f} GB of memory, "
            f"but only {available / 1e9:.1f} GB are free",
            where="difference.gsd_m",
            allowed=allowed,
            remedy="choose a larger gsd_m",
        )
    return Grid.over(bounds, config.gsd_m)


def surface_raster(mesh: TriangleMesh, grid: Grid) -> SurfaceRaster:
    """Rasterise a mesh by looking along -z at every pixel centre, to compare it with another epoch.

    mesh: wall frame, m; the block labels of its faces, or else of its vertices, are rasterised too. grid: the pixels.
    """
    dr.flush_malloc_cache()  # frees the observation's memory: rasterising the surface is the peak of an epoch
    flat = FlatMesh(mesh, grid)
    if not flat.is_quick:
        return cast_raster(RayCaster(mesh), grid)
    top = flat.top_faces()
    if mesh.face_block is not None:
        block = dr.gather(mi.Int32, on_device(mi.Int32, mesh.face_block), top.face, top.valid)
    elif mesh.vertex_block is not None:
        block = flat.labels(top, on_device(mi.Int32, mesh.vertex_block))
    else:
        block = mi.Int32(WALL)
    return _as_raster(grid, top.valid, top.point.z, dr.select(top.valid, block, WALL))


def cast_raster(caster: RayCaster, grid: Grid) -> SurfaceRaster:
    """Rasterise a mesh that is already prepared for ray casting, by one ray through the centre of each pixel.

    caster: the mesh in the wall frame, m. grid: the pixels.

    Returns a raster that has for each pixel the height z of the surface, m (NaN where there is none), and the label of the
    fallen block whose niche is seen there (0 where there is none).
    """
    hits, point = caster.look_down(grid)
    block = hits.block
    if caster.mesh.face_block is None and caster.mesh.vertex_block is not None:
        block = caster.nearest_vertex_label(hits, point, on_device(mi.Int32, caster.mesh.vertex_block))
    return _as_raster(grid, hits.valid, point.z, block)


def _as_raster(grid: Grid, valid: mi.Bool, z: mi.Float64, block: mi.Int32) -> SurfaceRaster:
    """Bring heights, m, and labels of all pixels from the device; NaN where there is no surface."""
    height = mi.Float32(dr.select(valid, z, np.nan))
    dr.eval(height, block)  # one kernel
    return SurfaceRaster(grid, np.array(height).reshape(grid.shape), np.array(block).reshape(grid.shape))


def difference(reference: SurfaceRaster, epoch: SurfaceRaster) -> NDArray[np.float32]:
    """Return the difference map of two epochs: reference minus epoch in z, (h, w), wall frame, m.

    It is positive where rock is missing, negative where it was added, and NaN without data. Both rasters have the same grid.
    """
    if reference.grid != epoch.grid:
        raise InputError(
            f"the epoch's raster has the grid {epoch.grid}, the reference's has {reference.grid}",
            where="difference",
            remedy="make both rasters on the same grid",
        )
    return reference.heights - epoch.heights


@dataclass(frozen=True)
class DifferenceStatistics:
    """Statistics of the differences in a difference map, m; NaN if there are none.

    Attributes
    ----------
    count : int
        Number of differences.
    median, mean, standard_deviation : float
        Their median, mean and standard deviation, m.
    rmse : float
        Root mean square of the differences, m.
    nmad : float
        Robust standard deviation 1.4826 median(|d - median|) of the differences d, m.
    """

    count: int
    median: float
    mean: float
    standard_deviation: float
    rmse: float
    nmad: float

    def to_dict(self) -> dict[str, float | int | None]:
        """Return the statistics of a difference map for JSON: keys of lengths end in _m, NaN becomes null."""
        lengths = {f"{name}_m": value for name, value in dataclasses.asdict(self).items() if name != "count"}
        return {"count": self.count} | {name: None if np.isnan(value) else value for name, value in lengths.items()}

    def summary(self) -> str:
        """Describe the statistics of a difference map on one line, in millimetres."""
        values = (self.median, self.standard_deviation, self.rmse, self.nmad)
        median, deviation, rmse, nmad = (f"{value * 1e3:.1f} mm" for value in values)
        return f"median {median}, StD {deviation}, RMSE {rmse}, NMAD {nmad} ({self.count:,} pixels)"


def statistics(values: NDArray[np.floating]) -> DifferenceStatistics:
    """Compute the statistics (median, standard deviation, NMAD, ...) of a difference map.

    values: any shape, m; NaN is ignored.
    """
    values = values[~np.isnan(values)]
    if values.size == 0:
        return DifferenceStatistics(0, *[float("nan")] * 5)
    median, mean = np.median(values), np.mean(values, dtype=np.float64)
    variance = np.var(values, dtype=np.float64)
    return DifferenceStatistics(
        count=int(values.size),
        median=float(median),
        mean=float(mean),
        standard_deviation=float(np.sqrt(variance)),
        rmse=float(np.sqrt(variance + mean**2)),
        nmad=nmad(values, median),
    )


@dataclass(frozen=True)
class BlockStatistics:
    """Statistics of a difference map apart for fallen blocks and the rest of the wall, where only noise is expected.

    Attributes
    ----------
    inside, outside : DifferenceStatistics
        Statistics of the pixels inside the niches of the blocks, and outside of them.
    """

    inside: DifferenceStatistics
    outside: DifferenceStatistics


def block_statistics(values: NDArray[np.floating], block: IntArray) -> BlockStatistics:
    """Compute the statistics of a difference map inside the niches of fallen blocks and outside of them.

    values: (h, w) differences, m; NaN is ignored. block: (h, w) label of the block at each pixel, 0 outside.
    """
    return BlockStatistics(statistics(values[block != WALL]), statistics(values[block == WALL]))


def _rounded_up(value: float) -> float:
    """Round `value` up to two significant digits."""
    unit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(np.ceil(value / unit) * unit)
