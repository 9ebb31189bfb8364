"""Error of the calibrated radial distortion."""

from __future__ import annotations

from typing import Literal

from scene.common.keyed_random import KeyedRandom
from sensors.cameras.camera import CameraPair
from sensors.effects.base import parameter
from sensors.effects.camera_effect import CameraEffect


class RadialDistortion(CameraEffect):
    """The real radial distortion differs from the calibrated one, which domes or dishes the surface.

    k_real = k_nominal + k. On a rectified pair the doming is in the ratio 3 : 1 along u and v: dZ = -Z k1 [3 (u - b/2)^2 + v^2
    + b^2/4], where Z is the depth, u and v are tangents of the angles from the axis, and b is base / Z (James & Robson 2014).
    """

    name: Literal["radial_distortion"] = "radial_distortion"
    means = "The lens's radial distortion is not what the calibration says: the wall comes out domed or dished."
    act = (
        "Calibrate the camera again, with pictures turned by 90 degrees and the target in the corners; do not let the "
        "adjustment of two parallel pictures find it."
    )
    sets = (("k1",), ("k1", "k2"), ("k1", "k2", "k3"))
    k1: float = parameter(
        "real minus calibrated k1", unit="1", source="Metashape user manual, appendix D", typical=5e-4, ge=-100, le=100
    )
    k2: float = parameter("real minus calibrated k2", unit="1", source="Metashape user manual, appendix D", ge=-100, le=100)
    k3: float = parameter("real minus calibrated k3", unit="1", source="Metashape user manual, appendix D", ge=-100, le=100)
    k4: float = parameter("real minus calibrated k4", unit="1", source="Metashape user manual, appendix D", ge=-100, le=100)

    def evaluate(self, state: CameraPair, random: KeyedRandom) -> CameraPair:
        """Return the camera pair with the errors of k1 to k4 added to the real camera's radial distortion.

        state: the real cameras before this effect. The effect's `camera` says which of them changes, the left, the right or both.
        `random` is not used.
        """
        return state.changed(self.camera, k1=self.k1, k2=self.k2, k3=self.k3, k4=self.k4)
