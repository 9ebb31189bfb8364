"""Compute how much of the residuals each named effect explains alone, for viewers that switch effects on and off."""

from __future__ import annotations

import numpy as np

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.naming.named_effects import aligned_with
from pipeline.gap.naming.workflow import GapDiagnosis, prepared
from pipeline.gap.residuals.alignment import fit_pose
from scene.geometry.mesh import FloatArray


def contributions(found: GapDiagnosis, measurement: Measurement) -> FloatArray:
    """Compute what part of the residuals each named effect (sensor error) explains, for viewers that switch effects on and off.

    The part is the residual without any effect minus that with this effect alone in the model, each after its own pose fit. The
    parts add up to nearly `before - after` of the diagnosis; a pose fit may absorb several effects together.

    Parameters
    ----------
    found : diagnosis with k named effects and n points.
    measurement : measurement that was diagnosed.

    Returns
    -------
    FloatArray : (k, n) parts in the unit of the observable (m or px); 0 where a ray misses the reference.
    """
    there = prepared(measurement)
    there, registration_rows = there.part(found.residuals.index), np.flatnonzero(found.residuals.usable & ~found.held_out)
    parts = []
    for effect in found.effects:
        _, residuals, _ = aligned_with(there, [effect], registration_rows)
        rest = fit_pose(residuals, residuals.usable & np.isin(residuals.index, registration_rows))
        value = residuals.values_at(residuals.value - residuals.pose_jacobian @ rest, np.arange(len(found.before)))
        parts.append(np.where(np.isfinite(value), found.before - value, 0.0))
    return np.reshape(parts, (len(parts), len(found.before)))
