"""Define the base class of effects by which the real camera differs from the nominal one used in the reconstruction."""

from __future__ import annotations

from sensors.cameras.camera import Side
from sensors.effects.base import Effect, ShowsIn, Stage


class CameraEffect(Effect):
    """An effect on the pair of cameras (`CameraPair`). Its effect on disparities follows from projecting through both pairs."""

    sensor = "stereo"
    stage = Stage.CAMERA
    shows_in = ShowsIn.MEAN
    camera: Side = "both"
