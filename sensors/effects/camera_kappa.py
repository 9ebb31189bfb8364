"""Rotation of a camera about its own z axis."""

from __future__ import annotations

from typing import Literal

from scene.common.keyed_random import KeyedRandom
from sensors.cameras.camera import CameraPair
from sensors.effects.base import parameter
from sensors.effects.camera_effect import CameraEffect


class CameraKappa(CameraEffect):
    """A camera is rotated about its own z axis against its nominal orientation.

    R_real = R_nominal R_z(angle), camera to world; right-handed (x right, y down, z forward).
    """

    name: Literal["camera_kappa"] = "camera_kappa"
    means = "A camera is turned about its viewing axis against its surveyed pose."
    act = "Survey control points on stable rock and orient both cameras by them in every epoch."
    angle_rad: float = parameter("real minus nominal rotation", unit="rad", source="photogrammetry", typical=1e-4, ge=-1, le=1)

    def evaluate(self, state: CameraPair, random: KeyedRandom) -> CameraPair:
        """Return the camera pair with the real camera rotated by the angle, rad, right-handed, about its own z (viewing) axis.

        state: the real cameras before this effect. The effect's `camera` says which of them changes, the left, the right or both.
        `random` is not used.
        """
        return state.rotated(self.camera, axis=2, angle_rad=self.angle_rad)
