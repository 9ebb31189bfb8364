"""Error of the calibrated principal point along y."""

from __future__ import annotations

from typing import Literal

from scene.common.keyed_random import KeyedRandom
from sensors.cameras.camera import CameraPair
from sensors.effects.base import parameter
from sensors.effects.camera_effect import CameraEffect


class PrincipalPointY(CameraEffect):
    """The real principal point is shifted along y against the calibrated one: cy_real = cy_nominal + delta."""

    name: Literal["principal_point_y"] = "principal_point_y"
    means = (
        "The principal point has moved across the picture's rows: the lens sits otherwise in its mount, or stabilisation was on."
    )
    act = "Calibrate the camera again; switch image stabilisation off and leave the lens on the camera."
    delta_px: float = parameter(
        "real minus calibrated principal point",
        unit="px",
        source="Metashape user manual, appendix D",
        typical=4.5,
        ge=-1e4,
        le=1e4,
    )

    def evaluate(self, state: CameraPair, random: KeyedRandom) -> CameraPair:
        """Return the camera pair with the real camera's principal point shifted along y by the error, px.

        state: the real cameras before this effect. The effect's `camera` says which of them changes, the left, the right or both.
        `random` is not used.
        """
        return state.changed(self.camera, cy_px=self.delta_px)
