"""Rotation of a camera about its own y axis."""

from __future__ import annotations

from typing import Literal

from scene.common.keyed_random import KeyedRandom
from sensors.cameras.camera import CameraPair
from sensors.effects.base import parameter
from sensors.effects.camera_effect import CameraEffect


class CameraPhi(CameraEffect):
    """A camera is rotated about its own y axis against its nominal orientation.

    R_real = R_nominal R_y(angle), camera to world; right-handed (x right, y down, z forward). If `camera` is `both`, both
    turn by the same angle, so that the angle between their viewing axes stays; if it is left or right, that angle changes.
    """

    name: Literal["camera_phi"] = "camera_phi"
    means = (
        "A camera is turned about its y axis against its surveyed pose. If one camera is, the angle between the viewing axes"
        " (convergence) is wrong; if both turn alike, it is right."
    )
    act = "Survey control points on stable rock and orient both cameras by them in every epoch."
    angle_rad: float = parameter("real minus nominal rotation", unit="rad", source="photogrammetry", typical=5e-5, ge=-1, le=1)

    def evaluate(self, state: CameraPair, random: KeyedRandom) -> CameraPair:
        """Return the camera pair with the real camera rotated by the angle, rad, right-handed, about its own y axis.

        state: the real cameras before this effect. The effect's `camera` says which of them changes, the left, the right or both.
        `random` is not used.
        """
        return state.rotated(self.camera, axis=1, angle_rad=self.angle_rad)
