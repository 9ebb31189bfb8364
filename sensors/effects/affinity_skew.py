"""Error of the calibrated affinity and skew."""

from __future__ import annotations

from typing import Literal

from scene.common.keyed_random import KeyedRandom
from sensors.cameras.camera import CameraPair
from sensors.effects.base import parameter
from sensors.effects.camera_effect import CameraEffect


class AffinitySkew(CameraEffect):
    """Pixels are not square, or rows and columns not perpendicular, other than the calibration says: b_real = b_nominal + b.

    Affinity b1 stretches the columns against the rows, and skew b2 shifts columns in proportion to the row.
    """

    name: Literal["affinity_skew"] = "affinity_skew"
    means = "Pixels are not square or rows not at right angles to columns as calibrated: often a scanned or resampled picture."
    act = "Work from the original pictures; calibrate the camera again with b1 and b2 free."
    sets = (("b1_px",), ("b2_px",), ("b1_px", "b2_px"))
    b1_px: float = parameter(
        "real minus calibrated affinity", unit="px", source="Metashape user manual, appendix D", typical=1.0, ge=-1e4, le=1e4
    )
    b2_px: float = parameter("real minus calibrated skew", unit="px", source="Metashape user manual, appendix D", ge=-1e4, le=1e4)

    def evaluate(self, state: CameraPair, random: KeyedRandom) -> CameraPair:
        """Return the camera pair with the errors of affinity and skew, px, added to b1 and b2 of the real camera.

        state: the real cameras before this effect. The effect's `camera` says which of them changes, the left, the right or both.
        `random` is not used.
        """
        return state.changed(self.camera, b1=self.b1_px, b2=self.b2_px)
