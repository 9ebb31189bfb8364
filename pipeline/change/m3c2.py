"""Compute M3C2 distances between two epochs' points, for users who compare clouds instead of rasters.

At each core point on the reference surface, with normal n, the points of both epochs within a cylinder of radius d/2 along n are
averaged. The distance of the averages along n is the change (Lague, Brodu and Leroux 2013). The level of detection at 95 % is

    LoD = 1.96 (sqrt(s_1^2 / n_1 + s_2^2 / n_2) + registration error),       equation 1 there, as py4dgeo computes it,

with the standard deviations s along n and the numbers n of points in the cylinder. The sign is the difference map's: missing rock
is positive. Core points are pixel centres of the difference map, so that labels and annotations can be shared.

Limits: s includes the wall's roughness within the cylinder, so LoD is too large on rough rock. Points count as independent, so it
is too small where noise is correlated over more than a cylinder. Scales are radii, as in py4dgeo; CloudCompare's are diameters.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.change.difference import SurfaceRaster
from scene.common.config import Config
from scene.common.errors import InputError
from scene.common.extras import how_to_install
from scene.geometry.grid import Grid
from scene.geometry.mesh import WALL, FloatArray, IntArray

_LEAST_POINTS = 2
"""Fewest points of each epoch in a cylinder; fewer have no standard deviation."""


class M3c2Config(Config):
    """Settings of M3C2, a comparison of point clouds along local normals (Lague et al. 2013), by py4dgeo (extra `m3c2`)."""

    core_step_px: int = Field(5, ge=1, description="distance between core points, in pixels of the difference map")
    normal_radius_m: float = Field(0.25, gt=0, description="radius of the neighbourhood in which normals are fitted")
    cylinder_radius_m: float = Field(0.08, gt=0, description="radius of the cylinder whose points are averaged (half of d)")
    maximum_distance_m: float = Field(2.0, gt=0, description="half length of the cylinder; deeper changes are not found")
    direction: Literal["normal", "wall"] = Field(
        "normal",
        description="direction of distances: the reference's own normals, or the wall's, as in the difference map",
    )
    registration_error_m: float = Field(0.0, ge=0, description="registration error that is added in the level of detection")


@dataclass(frozen=True)
class M3c2Map:
    """M3C2 distances (changes between two point clouds along normals) at core points, as rasters over the wall's plane.

    Attributes
    ----------
    grid : Grid
        One pixel per core point, the point at which a distance is computed.
    distance, level : (h, w) float32 arrays
        Distance and its level of detection, m; NaN without enough points.
    block : (h, w) array
        Labels of the fallen blocks at the core points, 0 for none.
    points : (n, 3) array
        The core points, wall frame, m.
    place : (n,) array
        Their pixels, numbered row by row.
    """

    grid: Grid
    distance: NDArray[np.float32]
    level: NDArray[np.float32]
    block: IntArray
    points: FloatArray
    place: NDArray[np.int64]

    @property
    def significant(self) -> NDArray[np.bool_]:
        """(h, w) True where the M3C2 distance between the epochs exceeds its level of detection."""
        with np.errstate(invalid="ignore"):
            return np.abs(self.distance) > self.level

    def summary(self) -> dict[str, float | int | None]:
        """Summarise the M3C2 distances for JSON.

        The values are the number of core points with a distance, how many are significant, and the median level of detection,
        m.
        """
        known = ~np.isnan(self.level)
        return {
            "core_points": int(np.count_nonzero(~np.isnan(self.distance))),
            "significant": int(np.count_nonzero(self.significant)),
            "level_of_detection_median_m": float(np.median(self.level[known])) if known.any() else None,
        }


def core_grid(grid: Grid, step: int) -> tuple[Grid, slice]:
    """Return the coarser grid of M3C2's core points, one in the middle of every `step` x `step` pixels of a grid.

    grid: the pixels of the difference map. step: distance of the core points, px.

    Returns the coarser grid, and a slice that selects the rows (and, used again, the columns) of these middle pixels.
    """
    width, height = (max(size // step, 1) for size in (grid.width, grid.height))
    return replace(grid, gsd=grid.gsd * step, width=width, height=height), slice(step // 2, None, step)


def m3c2(reference: FloatArray, epoch: FloatArray, raster: SurfaceRaster, block: IntArray, config: M3c2Config) -> M3c2Map:
    """Compute M3C2 distances, changes along the surface's normals, from the reference's points to an epoch's.

    The result does not depend on the number of threads.

    Parameters
    ----------
    reference, epoch : (n, 3) and (m, 3) arrays
        Registered points, wall frame, m.
    raster : SurfaceRaster
        Raster of the reference. One core point, at which a distance is computed, lies in the middle of every few of its
        pixels.
    block : (h, w) array
        Label of the epoch's fallen block at each pixel of `raster`, 0 for none.
    config : M3c2Config
        Distance of the core points, radii and limits.

    Raises
    ------
    InputError
        If py4dgeo is not installed, or the map is smaller than the distance of the core points.
    """
    grid, every = core_grid(raster.grid, config.core_step_px)
    heights, labels = (full[every, every][: grid.height, : grid.width] for full in (raster.heights, block))
    if heights.shape != grid.shape:
        raise InputError(
            f"the step of {config.core_step_px} px is so large that no core point (place where M3C2 is computed) lies in the map",
            where="m3c2.core_step_px",
            remedy="lower m3c2.core_step_px",
        )
    place = np.flatnonzero(np.isfinite(heights))
    row, column = np.divmod(place, grid.width)
    offset = (config.core_step_px // 2 + 0.5) * raster.grid.gsd  # of the selected pixel's centre from its cell's corner
    x, y = grid.x_min + column * grid.gsd + offset, grid.y_max - row * grid.gsd - offset
    core = np.stack([x, y, heights.ravel()[place].astype(np.float64)], axis=1)
    distance, level = np.full((2, grid.height * grid.width), np.nan, dtype=np.float32)
    if len(core):
        distance[place], level[place] = _distances(reference, epoch, core, config)
    distance, level = distance.reshape(grid.shape), level.reshape(grid.shape)
    return M3c2Map(grid, distance, level, np.where(np.isnan(distance), WALL, labels).astype(np.int32), core, place)


def _distances(
    reference: FloatArray, epoch: FloatArray, core: FloatArray, config: M3c2Config
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return distances (n,), missing rock positive, and levels of detection, m, by py4dgeo; NaN with too few points."""
    py4dgeo = _py4dgeo()
    up = np.array([0.0, 0.0, 1.0])
    algorithm = py4dgeo.M3C2(
        epochs=(py4dgeo.Epoch(reference), py4dgeo.Epoch(epoch)),
        corepoints=core,
        cyl_radius=config.cylinder_radius_m,
        normal_radii=[config.normal_radius_m],
        orientation_vector=up,
        corepoint_normals=up[None] if config.direction == "wall" else None,
        max_distance=config.maximum_distance_m,
        registration_error=config.registration_error_m,
    )
    outward, uncertainty = algorithm.run()
    enough = (uncertainty["num_samples1"] >= _LEAST_POINTS) & (uncertainty["num_samples2"] >= _LEAST_POINTS)
    level = uncertainty["lodetection"]
    return tuple(np.where(enough, values, np.nan).astype(np.float32) for values in (-outward, level))  # type: ignore[return-value]


def _py4dgeo() -> Any:
    """Import py4dgeo. Raises InputError if it is not installed."""
    try:
        import py4dgeo
    except ImportError as error:
        raise InputError(
            f"the method M3C2 needs the package py4dgeo, which does not load ({error})",
            where="m3c2",
            remedy=how_to_install("m3c2"),
        ) from None
    py4dgeo.set_py4dgeo_logfile(os.devnull)  # by default it writes py4dgeo.log into the current folder
    logging.getLogger("py4dgeo").setLevel(logging.WARNING)
    return py4dgeo
