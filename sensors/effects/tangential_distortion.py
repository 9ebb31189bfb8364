"""Error of the calibrated tangential distortion."""

from __future__ import annotations

from typing import Literal

from scene.common.keyed_random import KeyedRandom
from sensors.cameras.camera import CameraPair
from sensors.effects.base import parameter
from sensors.effects.camera_effect import CameraEffect


class TangentialDistortion(CameraEffect):
    """The real tangential distortion differs from the calibrated one: p_real = p_nominal + p.

    The parameters are in Metashape's order; OpenCV exchanges p1 and p2.
    """

    name: Literal["tangential_distortion"] = "tangential_distortion"
    means = "The lens's elements are not centred as the calibration says."
    act = "Calibrate the camera again; check that p1 and p2 were not exchanged between two programs."
    sets = (("p1",), ("p2",), ("p1", "p2"))
    p1: float = parameter(
        "real minus calibrated p1, Metashape's order",
        unit="1",
        source="Metashape user manual, appendix D",
        typical=1e-4,
        ge=-10,
        le=10,
    )
    p2: float = parameter(
        "real minus calibrated p2, Metashape's order", unit="1", source="Metashape user manual, appendix D", ge=-10, le=10
    )

    def evaluate(self, state: CameraPair, random: KeyedRandom) -> CameraPair:
        """Return the camera pair with the errors of p1 and p2 added to the real camera's tangential distortion.

        state: the real cameras before this effect. The effect's `camera` says which of them changes, the left, the right or both.
        `random` is not used.
        """
        return state.changed(self.camera, p1=self.p1, p2=self.p2)
