"""Compute how much of the residuals each named effect explains alone, for viewers that switch effects on and off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import Measurement, TlsMeasurement
from pipeline.gap.naming.named_effects import aligned_with
from pipeline.gap.naming.workflow import GapDiagnosis
from pipeline.gap.residuals.alignment import fit_pose
from pipeline.gap.residuals.tls_residuals import with_scan_order
from scene.geometry.mesh import FloatArray


def contributions(found: GapDiagnosis, measurement: Measurement) -> FloatArray:
    """Compute what part of the residuals each named effect (sensor error) explains, for viewers that switch effects on and off.

    The part is the residual without any effect minus that with this effect alone in the model, each after its own pose fit. The
    parts of all effects add up to nearly `before - after` of the diagnosis, the change of the residuals by all of them. They
    differ a little, because a pose fit may absorb several effects together.

    Parameters
    ----------
    found : diagnosis with k named effects (at least one) and n points.
    measurement : measurement that was diagnosed.

    Returns
    -------
    FloatArray : (k, n) parts in the unit of the observable (m or px); 0 where a ray misses the reference.
    """
    there = with_scan_order(measurement) if isinstance(measurement, TlsMeasurement) else measurement
    there, registration_rows = there.part(found.residuals.index), np.flatnonzero(found.residuals.usable & ~found.held_out)
    return np.stack(
        [found.before - _residuals_with_one(found, there, number, registration_rows) for number in range(len(found.effects))]
    )


def _residuals_with_one(
    found: GapDiagnosis, measurement: Measurement, number: int, registration_rows: NDArray[np.int64]
) -> FloatArray:
    """(n,) residuals with one effect in the model, or those before where a ray misses. measurement: of these points alone."""
    _, residuals, _ = aligned_with(measurement, [found.effects[number]], registration_rows)
    rest = fit_pose(residuals, residuals.usable & np.isin(residuals.index, registration_rows))
    value = residuals.values_at(residuals.value - residuals.pose_jacobian @ rest, np.arange(len(found.before)))
    return np.where(np.isfinite(value), value, found.before)
