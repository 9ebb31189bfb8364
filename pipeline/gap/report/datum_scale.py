"""Estimate the scale of a cloud without cameras against the reference's; it is part of the datum, like shift and rotation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.gap.naming.workflow import GapDiagnosis
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals, datum_covariance

_FEWEST_POINTS = 100
_SIGNIFICANT_SIGMAS = 3.0
"""Standard deviations from which on a scale is reported as wrong."""


@dataclass(frozen=True)
class DatumScale:
    """How much larger a cloud from unknown cameras is than the reference. If significant, one of them has a wrong scale.

    Attributes
    ----------
    ppm : difference of the scales, ppm, positive if the cloud is larger.
    std_ppm : its standard deviation, ppm.
    """

    ppm: float
    std_ppm: float

    @property
    def words(self) -> str:
        """The scale of a cloud from unknown cameras relative to the reference, as a sentence for the report."""
        std = f"\N{PLUS-MINUS SIGN} {self.std_ppm:.0f} ppm"
        if abs(self.ppm) < _SIGNIFICANT_SIGMAS * self.std_ppm:
            return f"Its scale agrees with that of the reference, as far as the relief shows ({self.ppm:+.0f} {std})."
        which = "larger" if self.ppm > 0 else "smaller"
        return (
            f"The cloud is {abs(self.ppm):.0f} {std} {which} than the reference: one of the two has a wrong scale. "
            "The difference was removed with the pose."
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the entry `scale_ppm` of gap.json: relative scale of a cloud and its standard deviation, ppm."""
        return {"value": self.ppm, "std": self.std_ppm}


def estimate_scale(found: GapDiagnosis) -> DatumScale | None:
    """Estimate how much larger a cloud from unknown cameras is than the reference, from shift, rotation and scale fitted to it.

    found: diagnosis of the cloud. Returns None for measurements with known cameras or of a laser scanner, if the wall has too
    little relief to show a scale, and for fewer than 100 points.
    """
    residuals = found.residuals
    if not isinstance(residuals, SurfaceResiduals) or not residuals.datum[6].any():
        return None
    rows = residuals.usable & ~found.held_out & (abs(found.after) < found.thresholds.points.outlier_sigmas * residuals.sigma)
    if rows.sum() < _FEWEST_POINTS:
        return None
    stretch, variance = residuals.datum[6] @ found.pose, datum_covariance(residuals, found.after, rows)[6, 6]
    return DatumScale(1e6 * (1 / (1 + float(stretch)) - 1), 1e6 * float(np.sqrt(variance)))
