"""Define what a sensor returns from one observation of a scene."""

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
    """Further returns of a scan's pulses: the scan's grid holds one return a pulse, and this the others of pulses with several.

    There are n of them, sorted by cell and then by range.

    Attributes
    ----------
    cell : (n,) int64 array
        Position of the pulse in the grid, row by row.
    number : (n,) uint8 array
        Return number; 1 is the nearest.
    points : (n, 3) float64 array
        Recorded points, wall frame, m.
    depth : (n,) float64 array
        Range, m.
    block : (n,) int32 array
        Label of the fallen block whose niche was hit; 0 is the wall.
    intensity : (n,) float32 array
        Relative received power.
    truth : dict of (n,) arrays
        Error-free quantities by name, as for the returns in the grid.
    grid_number, grid_count : (h, w) uint8 arrays
        Return number of the point in each cell of the grid, and its pulse's number of returns.
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
    """What a sensor records in one observation of the wall: a grid of points in the wall frame.

    Rows and columns are the sensor's: those of the depth map (stereo), or scan lines and the pulses of a line (TLS: azimuth,
    zenith). Cells without a return are NaN in the float arrays and WALL in `block`.

    Attributes
    ----------
    sensor : str
        "tls" or "stereo".
    points : (h, w, 3) float64 array
        Recorded points, m.
    depth : (h, w) float64 array
        Range (TLS) or distance along the camera's axis (stereo), m.
    block : (h, w) int32 array
        The block whose niche was hit; 0 is the wall.
    viewpoint : (3,) array
        Position of the sensor, m.
    intensity : (h, w) float32 array, optional
        Relative received power.
    pulse_interval_s : float, optional
        Time from one cell to the next, in order of rows.
    truth : dict of (h, w) arrays
        Error-free quantities by name, such as `true_range_m`, if the sensor was asked for them.
    further : FurtherReturns, optional
        Returns beyond those in the grid; None if no pulse has any.
    zenith_rad : (w,) array, optional
        Nominal zenith angle of each column of a scanner's grid.
    offset : (h, w, 2) float32 array, optional
        x and y of the recorded minus the true point, m; None if unknown.
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
        """(h, w) mask that is True for cells of the observation with a return (or a match)."""
        return ~np.isnan(self.depth)

    @property
    def gps_time(self) -> FloatArray | None:
        """Time of each cell's measurement, (h, w) float64, s since the start of the scan.

        None for a sensor that records everything at once.
        """
        if self.pulse_interval_s is None:
            return None
        return self.pulse_interval_s * np.arange(self.depth.size, dtype=np.float64).reshape(self.depth.shape)


def packed(point: mi.Array3f64) -> mi.Float64:
    """Flatten points of the ray-tracing device, 3 x (n,), into one array (3 n,), point by point.

    NumPy can then read it as (n, 3) without a transpose.
    """
    return dr.ravel(point)


def offset_of(recorded: mi.Array3f64, true: mi.Array3f64) -> mi.Float32:
    """Return how far recorded points lie from the true ones in x and y, as one array (2 n,), point by point.

    recorded, true: 3 x (n,) points of the ray-tracing device, m.
    """
    return dr.ravel(mi.Array2f(recorded.x - true.x, recorded.y - true.y))


class Sensor(Protocol):
    """Anything that can observe a scene, such as a laser scanner or a stereo pair at its place."""

    def observe(self, scene: RayCaster, random: KeyedRandom) -> Observation:
        """Observe the scene once, and return what the sensor records.

        scene: the wall, wall frame. random: source of random numbers; the same source gives the same observation to the byte.
        """
        ...
