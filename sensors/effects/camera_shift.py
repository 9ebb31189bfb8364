"""Shift of a camera's perspective centre."""

from __future__ import annotations

from typing import Literal

import numpy as np

from scene.common.keyed_random import KeyedRandom
from sensors.cameras.camera import CameraPair
from sensors.effects.base import parameter
from sensors.effects.camera_effect import CameraEffect


class CameraShift(CameraEffect):
    """A camera's perspective centre is not where it was surveyed: X_real = X_nominal + (x, y, z)."""

    name: Literal["camera_shift"] = "camera_shift"
    means = "A camera does not stand where it was surveyed: the base is wrong, and all depths with it."
    act = "Survey control points on stable rock and orient both cameras by them in every epoch; measure the base."
    x_m: float = parameter(
        "real minus nominal perspective centre, world x", unit="m", source="photogrammetry", typical=0.01, ge=-10, le=10
    )
    y_m: float = parameter("real minus nominal perspective centre, world y", unit="m", source="photogrammetry", ge=-10, le=10)
    z_m: float = parameter("real minus nominal perspective centre, world z", unit="m", source="photogrammetry", ge=-10, le=10)

    def evaluate(self, state: CameraPair, random: KeyedRandom) -> CameraPair:
        """Return the camera pair with the real camera's perspective centre shifted by (x, y, z), m, world frame.

        state: the real cameras before this effect. The effect's `camera` says which of them changes, the left, the right or both.
        `random` is not used.
        """
        return state.shifted(self.camera, np.array([self.x_m, self.y_m, self.z_m]))
