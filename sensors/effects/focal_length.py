"""Error of the calibrated principal distance."""

from __future__ import annotations

from typing import Literal

from scene.common.keyed_random import KeyedRandom
from sensors.cameras.camera import CameraPair
from sensors.effects.base import parameter
from sensors.effects.camera_effect import CameraEffect


class FocalLength(CameraEffect):
    """The real principal distance differs from the calibrated one: f_real = f_nominal + delta.

    Causes are a change of temperature or focus (46 mm of depth at 100 m for 20 K with Glendale's lens).
    """

    name: Literal["focal_length"] = "focal_length"
    means = "The principal distance is another than the calibration's: refocused, another temperature, or a weak calibration."
    act = "Calibrate the camera again at the site's distance and fix the focus ring."
    delta_px: float = parameter(
        "real minus calibrated principal distance",
        unit="px",
        source="Metashape user manual, appendix D",
        typical=2.5,
        ge=-1e4,
        le=1e4,
    )

    def evaluate(self, state: CameraPair, random: KeyedRandom) -> CameraPair:
        """Return the camera pair with the error, px, added to the real camera's principal distance.

        state: the real cameras before this effect. The effect's `camera` says which of them changes, the left, the right or both.
        `random` is not used.
        """
        return state.changed(self.camera, f_px=self.delta_px)
