"""How much of the residuals each named effect accounts for by itself: what a viewer switches on and off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import Measurement, TlsMeasurement
from pipeline.gap.naming.entries import settled_with
from pipeline.gap.naming.workflow import GapDiagnosis
from pipeline.gap.residuals.alignment import fit_pose
from pipeline.gap.residuals.tls_residuals import with_scan_order
from scene.geometry.mesh import FloatArray


def contributions(found: GapDiagnosis, measurement: Measurement) -> FloatArray:
    """(k, n) by how much the residuals fall with each of the k effects alone in the model, each registered for itself, in the
    observable's unit; 0 where a ray then misses the reference.

    Of one effect that is `before - after`. Of several it costs a simulation each; their sum is `before - after` as far as the
    effects do not share what the registration takes up.
    """
    if len(found.effects) < 2:
        return np.array([found.before - found.after for _ in found.effects]).reshape(-1, len(found.before))
    there = with_scan_order(measurement) if isinstance(measurement, TlsMeasurement) else measurement
    there, trusted = there.part(found.residuals.index), np.flatnonzero(found.residuals.usable & ~found.held_out)
    return np.stack([found.before - _alone(found, there, number, trusted) for number in range(len(found.effects))])


def _alone(found: GapDiagnosis, measurement: Measurement, number: int, trusted: NDArray[np.int64]) -> FloatArray:
    """(n,) residuals with one effect in the model, those before where there are none. measurement: of these points alone."""
    _, residuals, _ = settled_with(measurement, [found.effects[number]], trusted)
    rest = fit_pose(residuals, residuals.usable & np.isin(residuals.index, trusted))
    value = residuals.values_at(residuals.value - residuals.pose_jacobian @ rest, np.arange(len(found.before)))
    return np.where(np.isfinite(value), value, found.before)
