"""Shift of the principal point along y."""

from __future__ import annotations

from typing import Literal

from scene.keyed_random import KeyedRandom
from sensors.camera import CameraPair, Side
from sensors.effects.base import Effect, Stage, parameter


class PrincipalPointY(Effect):
    """cy_real = cy_nominal + delta."""

    name: Literal["principal_point_y"] = "principal_point_y"
    sensor = "stereo"
    stage = Stage.CAMERA
    camera: Side = "both"
    delta_px: float = parameter(
        "real minus calibrated principal point",
        unit="px",
        source="Metashape user manual, appendix D",
        typical=4.5,
        ge=-1e4,
        le=1e4,
    )

    def evaluate(self, state: CameraPair, random: KeyedRandom) -> CameraPair:
        return state.changed(self.camera, cy_px=self.delta_px)
