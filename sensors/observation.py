"""What a sensor returns from one look at a scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scene.keyed_random import KeyedRandom
from scene.mesh import FloatArray, IntArray
from scene.raycast import RayCaster


@dataclass(frozen=True)
class Observation:
    """One observation with the sensor's own organisation, wall frame.

    Rows and columns are the sensor's: image rows and columns of the depth map (stereo), scan lines and pulses of a line (TLS:
    azimuth, zenith). Cells without a return are NaN in the float arrays and WALL in `block`.

    points: (h, w, 3) float64, m, as recorded; depth: (h, w) float64, m, range (TLS) or distance along the camera's axis (stereo);
    block: (h, w) int32, the block whose niche was hit (0: wall); viewpoint: (3,) m, where the sensor stands;
    intensity: (h, w) float32 relative received power; gps_time: (h, w) float64, s; truth: named (h, w) channels, such as
    `true_range_m`, present where the sensor was asked for them.
    """

    sensor: str
    points: FloatArray
    depth: FloatArray
    block: IntArray
    viewpoint: FloatArray
    intensity: NDArray[np.float32] | None = None
    gps_time: FloatArray | None = None
    truth: dict[str, NDArray[np.floating]] = field(default_factory=dict)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(h, w) where there is a return."""
        return ~np.isnan(self.depth)


class Sensor(Protocol):
    """A sensor: it observes a scene with a keyed source of random numbers."""

    def observe(self, scene: RayCaster, random: KeyedRandom) -> Observation:
        """Look once at `scene` (wall frame); the same `random` gives the same observation to the byte."""
        ...
