"""Define the base class of effects by which the real camera differs from the nominal one used in the reconstruction."""

from __future__ import annotations

from sensors.cameras.camera import Side
from sensors.effects.base import Effect, ShowsIn, Stage


class CameraEffect(Effect):
    """Base class of effects by which the real cameras differ from the calibrated (nominal) ones; `camera` says which.

    Depths are computed with the nominal cameras. The effect on disparities is therefore the difference between projecting the
    rock into the real and into the nominal pair.
    """

    sensor = "stereo"
    stage = Stage.CAMERA
    shows_in = ShowsIn.MEAN
    camera: Side = "both"
