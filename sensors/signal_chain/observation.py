"""What a sensor returns from one look at a scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, IntArray
from scene.ray_casting.raycast import RayCaster


@dataclass(frozen=True)
class FurtherReturns:
    """The returns of a scan beside those in its grid, of pulses that have several; n of them, by cell, then by range.

    cell: (n,) int64 the pulse's place in the grid, counted in rows; number: (n,) uint8 return number, 1 the nearest; points:
    (n, 3) float64, m; depth: (n,) float64 range, m; block: (n,) int32; intensity: (n,) float32; truth: named (n,) channels, as
    the grid's; grid_number, grid_count: (h, w) uint8 return number of the point in the grid, and the pulse's number of returns.
    """

    cell: NDArray[np.int64]
    number: NDArray[np.uint8]
    points: FloatArray
    depth: FloatArray
    block: IntArray
    intensity: NDArray[np.float32]
    truth: dict[str, NDArray[np.floating]]
    grid_number: NDArray[np.uint8]
    grid_count: NDArray[np.uint8]


@dataclass(frozen=True)
class Observation:
    """One observation with the sensor's own organisation, wall frame.

    Rows and columns are the sensor's: image rows and columns of the depth map (stereo), scan lines and pulses of a line (TLS:
    azimuth, zenith). Cells without a return are NaN in the float arrays and WALL in `block`.

    points: (h, w, 3) float64, m, as recorded; depth: (h, w) float64, m, range (TLS) or distance along the camera's axis (stereo);
    block: (h, w) int32, the block whose niche was hit (0: wall); viewpoint: (3,) m, where the sensor stands;
    intensity: (h, w) float32 relative received power; pulse_interval_s: time from one cell to the next, in order of rows; truth:
    named (h, w) channels, such as `true_range_m`, present where the sensor was asked for them; further: returns beside those in
    the grid, of a scanner that records several; None where no pulse has any; zenith_rad: (w,) nominal zenith angle of each column
    of a scanner's grid; offset: (h, w, 2) float32, m, x and y of the recorded minus the
    true point, None where it is not known.
    """

    sensor: str
    points: FloatArray
    depth: FloatArray
    block: IntArray
    viewpoint: FloatArray
    intensity: NDArray[np.float32] | None = None
    pulse_interval_s: float | None = None
    truth: dict[str, NDArray[np.floating]] = field(default_factory=dict)
    further: FurtherReturns | None = None
    zenith_rad: FloatArray | None = None
    offset: NDArray[np.float32] | None = None

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(h, w) where there is a return."""
        return ~np.isnan(self.depth)

    @property
    def gps_time(self) -> FloatArray | None:
        """(h, w) float64, s since the scan's start; None for a sensor that sees everything at once."""
        if self.pulse_interval_s is None:
            return None
        return self.pulse_interval_s * np.arange(self.depth.size, dtype=np.float64).reshape(self.depth.shape)


def packed(point: mi.Array3f64) -> mi.Float64:
    """The 3 x (n,) device points as one (3 n,) array, point by point, so that it is written once and needs no transpose."""
    return dr.ravel(point)


def offset_of(recorded: mi.Array3f64, true: mi.Array3f64) -> mi.Float32:
    """(2 n,) x and y of the recorded minus the true points, point by point."""
    return dr.ravel(mi.Array2f(recorded.x - true.x, recorded.y - true.y))


class Sensor(Protocol):
    """A sensor: it observes a scene with a keyed source of random numbers."""

    def observe(self, scene: RayCaster, random: KeyedRandom) -> Observation:
        """Look once at `scene` (wall frame); the same `random` gives the same observation to the byte."""
        ...
