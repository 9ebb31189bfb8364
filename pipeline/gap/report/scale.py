"""The scale of a cloud whose cameras are not known, against the reference's: part of its datum, as shift and turn are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.gap.naming.workflow import GapDiagnosis
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals, datum_covariance

_FEWEST = 100
_CLEAR = 3.0
"""Standard deviations from which on a scale is said to be wrong."""


@dataclass(frozen=True)
class Scale:
    """By how much a cloud is larger than the reference, with its standard deviation, ppm."""

    ppm: float
    std_ppm: float

    @property
    def words(self) -> str:
        """A sentence."""
        std = f"\N{PLUS-MINUS SIGN} {self.std_ppm:.0f} ppm"
        if abs(self.ppm) < _CLEAR * self.std_ppm:
            return f"Its scale agrees with the reference's as far as the relief tells ({self.ppm:+.0f} {std})."
        which = "larger" if self.ppm > 0 else "smaller"
        return (
            f"The cloud is {abs(self.ppm):.0f} {std} {which} than the reference: one of the two has a wrong scale. "
            "That was taken off with the pose."
        )

    def to_dict(self) -> dict[str, Any]:
        """As gap.json holds it."""
        return {"value": self.ppm, "std": self.std_ppm}


def scale_of(found: GapDiagnosis) -> Scale | None:
    """Of a surface without cameras; None of what has no scale of its own, or too few points."""
    residuals = found.residuals
    if not isinstance(residuals, SurfaceResiduals) or not residuals.datum[6].any():
        return None
    rows = residuals.usable & ~found.held_out & (abs(found.after) < found.decisions.points.outlier * residuals.sigma)
    if rows.sum() < _FEWEST:
        return None
    stretch, variance = residuals.datum[6] @ found.pose, datum_covariance(residuals, found.after, rows)[6, 6]
    return Scale(1e6 * (1 / (1 + float(stretch)) - 1), 1e6 * float(np.sqrt(variance)))
