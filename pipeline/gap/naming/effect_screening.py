"""Rank effects by how small the residuals become with each alone in the sensor model, without linearising."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.mean.candidates import Candidate, prior_precision
from pipeline.gap.mean.selection import SelectedEffect
from pipeline.gap.naming.named_effects import Estimate, aligned_with, effect_from_estimate, out_of_bounds
from pipeline.gap.residuals.alignment import fit_pose_robustly
from pipeline.gap.residuals.residuals import Residuals
from scene.geometry.mesh import FloatArray

_FEWEST_POINTS = 3_000
"""Points of the subsample: at least this many, if there are so many, and less than twice as many. They suffice for a ranking."""


def gauss_newton_step(at: Residuals, columns: FloatArray, precision: FloatArray, values: FloatArray) -> FloatArray:
    """Compute by how much a Gauss-Newton step changes the sizes of sensor errors (effects), with the sensor's pose free.

    Parameters
    ----------
    at : residuals of n points with the effects at their present sizes in the model.
    columns : (n, k) derivatives of the residuals by the k sizes.
    precision : (k,) inverse variances of the sizes' Gaussian priors, which have mean 0.
    values : (k,) present sizes.

    Returns
    -------
    FloatArray : (k,) changes of the sizes.
    """
    design = np.concatenate([at.pose_jacobian, columns], axis=1) / at.sigma[:, None]
    known, pull = np.zeros(design.shape[1]), np.zeros(design.shape[1])
    start = at.pose_jacobian.shape[1]
    known[start:], pull[start:] = precision, precision * values
    found = np.linalg.solve(design.T @ design + np.diag(known), design.T @ (at.value / at.sigma) - pull)
    return np.asarray(found[start:])


def estimate_of_size(candidate: Candidate, values: FloatArray) -> Estimate:
    """Describe a sensor error (effect) of a given size as an estimate, without any evidence for it.

    Parameters
    ----------
    candidate : the effect as a regression term.
    values : (k,) coefficients of its k design columns.
    """
    nothing = SelectedEffect(candidate, (), 1.0, 0.0, 0.0, ())
    return Estimate(nothing, candidate, values, np.zeros((len(values), len(values))))


def rank_by_noise_left(measurement: Measurement, part: Residuals, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Rank sensor errors (effects) by how small the residuals become when each is put into the sensor model alone.

    A linearised model ranks effects wrongly if the error is so large that rays meet other parts of a rough wall. Here each
    effect gets its size by one Gauss-Newton step, the pose is estimated again with it, and residuals are computed anew. At most
    about 6,000 points are used, to save time.

    Parameters
    ----------
    measurement : the measured points with the sensor model that is tested.
    part : residuals of n of its points, measured minus predicted.
    candidates : effects as regression terms at these n points.

    Returns
    -------
    list : the effects with plausible sizes, the one that leaves the smallest median absolute residual first.
    """
    rows = np.arange(0, len(part), max(len(part) // _FEWEST_POINTS, 1))
    few = part.part(rows)
    points = measurement.part(few.index)
    few = replace(few, index=np.arange(len(rows)))
    noise = {candidate: _noise_left(points, few, candidate.part(rows)) for candidate in candidates}
    return sorted((each for each in noise if np.isfinite(noise[each])), key=lambda each: noise[each])


def _noise_left(measurement: Measurement, part: Residuals, candidate: Candidate) -> float:
    """Median absolute residual over its predicted standard deviation with one effect in the model; infinite if it is implausible.

    Points that no longer meet the wall count as infinitely far off.
    """
    width = candidate.columns.shape[1]
    size = gauss_newton_step(part, candidate.columns, prior_precision(candidate, width), np.zeros(width))
    estimate = estimate_of_size(candidate, size)
    if out_of_bounds(measurement, [estimate], part):
        return np.inf
    found = aligned_with(measurement, [effect_from_estimate(estimate, part)], part.index).residuals
    value, _, _ = fit_pose_robustly(found)
    off = np.full(len(part), np.inf)
    off[np.isin(part.index, found.index)] = np.abs(value / found.sigma)[np.isin(found.index, part.index)]
    return float(np.median(off))
