"""Compare the fitted noise of a laser scanner with the scatter of single ranges, from which `scarpsim gap` judges noise.

A calibration fits the noise to difference maps, whose pixels are means of points. Where errors of neighbouring points are
independent, both tell the same noise. Where they differ, the sign of the difference tells why.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import Measurement, TlsMeasurement
from pipeline.gap.residuals.alignment import compute_residuals, fit_pose_robustly
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from sensors.models.sensor_model import TlsModel

_AGREES = 0.1
"""Share by which both may differ: about twice the uncertainty of the estimated error of a reference made of points."""


@dataclass(frozen=True)
class SingleRanges:
    """Scatter of single ranges about the reference on smooth rock, measured and as the fitted noise predicts it.

    Attributes
    ----------
    measured_m : Robust standard deviation of the ranges after their pose is fitted, m.
    predicted_m : What the fitted noise and the error of the reference predict for it, m.
    reference_m : Part of the prediction that is the error of the reference, m; 0 for a reference that is taken as exact.
    """

    measured_m: float
    predicted_m: float
    reference_m: float

    @classmethod
    def of(cls, measurement: Measurement | None, model: object) -> SingleRanges | None:
        """Compare the ranges of a measurement with a fitted model of the scanner's noise.

        Returns None if there is no laser scan, or if it has no point on smooth rock.
        """
        if not isinstance(measurement, TlsMeasurement) or not isinstance(model, TlsModel):
            return None
        found = compute_residuals(measurement.changed(model=model))
        if not isinstance(found, TlsResiduals) or not found.usable.any():
            return None
        value, smooth = fit_pose_robustly(found)[0], found.usable
        sigma = float(np.median(found.sigma[smooth]))
        reference = float(np.sqrt(np.median(found.reference_variance[smooth])))
        return cls(nmad((value / found.sigma)[smooth]) * sigma, sigma, reference)

    @property
    def agrees(self) -> bool:
        """Whether both differ by no more than a tenth."""
        return abs(self.measured_m / self.predicted_m - 1) <= _AGREES

    @property
    def words(self) -> str:
        """State both as a sentence, and why they differ if they do."""
        error = f" and the reference's error of {1e3 * self.reference_m:.2g} mm predict" if self.reference_m else " predicts"
        told = (
            f"Single ranges on the same rock, as `scarpsim gap` compares them, scatter by {1e3 * self.measured_m:.2g} mm; the "
            f"fitted noise{error} {1e3 * self.predicted_m:.2g} mm"
        )
        if self.agrees:
            return f"{told}, so both find the same noise."
        if self.measured_m < self.predicted_m:
            why = "the maps vary more than independent errors of ranges would make them: neighbouring points share errors"
        else:
            why = (
                "single ranges have errors, such as relief between the points of the reference, that vanish in means over a pixel"
            )
        return f"{told}, because {why}."

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as `calibration.json` stores it; lengths in m."""
        return {**self.__dict__, "agrees": self.agrees, "words": self.words}
