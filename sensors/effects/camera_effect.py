"""The real camera departs from the nominal one, whose calibration the reconstruction uses."""

from __future__ import annotations

from sensors.cameras.camera import Side
from sensors.effects.base import Effect, ShowsIn, Stage


class CameraEffect(Effect):
    """Acts on the pair of cameras (`CameraPair`); what that does to disparities follows from projecting through both pairs."""

    sensor = "stereo"
    stage = Stage.CAMERA
    shows_in = ShowsIn.MEAN
    camera: Side = "both"
