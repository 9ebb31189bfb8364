"""Rank effects by how small the residuals become with each alone in the sensor model, without linearising."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement
from pipeline.gap.mean.candidates import Candidate, prior_precision
from pipeline.gap.mean.selection import SelectedEffect
from pipeline.gap.naming.named_effects import Estimate, aligned_with, effect_from_estimate, out_of_bounds
from pipeline.gap.residuals.alignment import fit_pose_robustly
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.residuals.stereo_residuals import StereoResiduals, with_shaped_disparities
from pipeline.gap.thresholds import thresholds
from scene.geometry.mesh import FloatArray

_FEWEST_POINTS = 3_000
"""Points of the subsample: at least this many, if there are so many, and less than twice as many. They suffice for a ranking."""
_REFINING_STEPS = 5
"""Most Gauss-Newton steps by which the size of an effect is refined."""


def all_columns(candidates: Sequence[Candidate]) -> FloatArray:
    """Return the design columns of some sensor errors (regression terms) side by side, as an array with n rows."""
    return np.asarray(np.concatenate([each.columns for each in candidates], axis=1))


def gauss_newton_step(at: Residuals, candidates: Sequence[Candidate], values: FloatArray | None = None) -> FloatArray:
    """Compute by how much a Gauss-Newton step changes the sizes of sensor errors (effects), with the sensor's pose free.

    Parameters
    ----------
    at : residuals of n points with the effects at their present sizes in the model.
    candidates : the effects as regression terms; their n design columns are the derivatives of the residuals by the k sizes.
    values : (k,) present sizes, of which large ones are held back by the priors; None: all 0.

    Returns
    -------
    FloatArray : (k,) changes of the sizes.
    """
    start = at.pose_jacobian.shape[1]
    design = np.concatenate([at.pose_jacobian, all_columns(candidates)], axis=1) / at.sigma[:, None]
    known = np.concatenate([np.zeros(start), *(prior_precision(each, each.columns.shape[1]) for each in candidates)])
    right = design.T @ (at.value / at.sigma)
    if values is not None:
        right[start:] -= known[start:] * values
    return np.asarray(np.linalg.solve(design.T @ design + np.diag(known), right)[start:])


def estimate_of_size(candidate: Candidate, values: FloatArray) -> Estimate:
    """Describe a sensor error (effect) of a given size as an estimate, without any evidence for it.

    candidate: the effect as a regression term. values: (k,) coefficients of its k design columns.
    """
    nothing = SelectedEffect(candidate, (), 1.0, 0.0, 0.0, ())
    return Estimate(nothing, candidate, values, np.zeros((len(values), len(values))))


def screen_effects(measurement: Measurement, part: Residuals, candidates: Sequence[Candidate], count: int) -> list[Estimate]:
    """Find the sensor errors (effects) with which the residuals become smallest, when each is put into the sensor model alone.

    A linearised model ranks effects wrongly if the error is so large that rays meet other parts of a rough wall. Here each
    effect gets its size by one Gauss-Newton step, the pose is estimated again with it, and residuals are computed anew. The
    sizes of the best ones are then refined by further steps, from the points that are no outliers beside them. At most about
    6,000 points are used, to save time.

    Parameters
    ----------
    measurement : the measured points with the sensor model that is tested.
    part : residuals of n of its points, measured minus predicted.
    candidates : effects as regression terms at these n points.
    count : number of effects to return: of those with plausible sizes, the ones that leave the smallest median absolute
        residuals, the best one first.
    """
    rows = np.arange(0, len(part), max(len(part) // _FEWEST_POINTS, 1))
    few = part.part(rows)
    points, few = measurement.part(few.index), replace(few, index=np.arange(len(rows)))
    if isinstance(points, StereoMeasurement) and isinstance(few, StereoResiduals):
        points = with_shaped_disparities(points, few)
    at_few = (each.part(rows) for each in candidates)
    fits = (_ScreenedEffect.of(points, few, estimate_of_size(each, gauss_newton_step(few, [each]))) for each in at_few)
    screened = zip(candidates, fits, strict=True)
    possible = [(each, fit) for each, fit in screened if fit is not None and np.isfinite(fit.noise_left)]
    found = []
    for candidate, fit in sorted(possible, key=lambda item: item[1].noise_left)[:count]:
        best, steps = fit, 0
        while steps < _REFINING_STEPS and (better := best.improved(points, few)) is not None:
            best, steps = better, steps + 1
        found.append((best.noise_left, estimate_of_size(candidate, best.estimate.values)))
    return [estimate for _, estimate in sorted(found, key=lambda item: item[0])]


@dataclass(frozen=True)
class _ScreenedEffect:
    """One effect alone in the model. estimate: the effect with its size; residuals: with it in the model; value: registered.

    noise_left: median absolute residual over its predicted standard deviation; points that no longer meet the wall count as
    infinitely far off.
    """

    estimate: Estimate
    residuals: Residuals
    value: FloatArray
    noise_left: float

    @classmethod
    def of(cls, measurement: Measurement, part: Residuals, estimate: Estimate) -> _ScreenedEffect | None:
        """Put an effect into the model of n points; None if its size is implausible."""
        if out_of_bounds(measurement, [estimate], part):
            return None
        found = aligned_with(measurement, [effect_from_estimate(estimate, part)], part.index).residuals
        value, _, _ = fit_pose_robustly(found)
        off = np.full(len(part), np.inf)
        off[np.isin(part.index, found.index)] = np.abs(value / found.sigma)[np.isin(found.index, part.index)]
        return cls(estimate, found, value, float(np.median(off)))

    def improved(self, measurement: Measurement, part: Residuals) -> _ScreenedEffect | None:
        """Change the size by a Gauss-Newton step, computed without the outliers; None if this does not reduce the noise left."""
        z = self.value / self.residuals.sigma
        good = self.residuals.usable & (np.abs(z) < thresholds().points.outlier_sigmas * max(nmad(z, 0.0), 1.0))
        at, candidate = self.residuals.part(good), self.estimate.candidate
        step = gauss_newton_step(at, [candidate.part(at.index)], self.estimate.values)
        found = _ScreenedEffect.of(measurement, part, estimate_of_size(candidate, self.estimate.values + step))
        return found if found is not None and found.noise_left < self.noise_left else None
