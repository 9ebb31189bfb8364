"""What each effect is worth on blocks that no step of naming has used: the Gaussian log score with it less that without it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.cells import patches
from pipeline.gap.entries import Named, with_effects
from pipeline.gap.measurement import Measurement
from pipeline.gap.registration import pose_of, settled
from pipeline.gap.residuals import BoolArray, Residuals
from scene.mesh import FloatArray

NOT_SCORED = (
    *("range_quantization", "pixel_locking", "detection_limit", "precipitation"),
    *("edge_fattening", "occlusion_fill", "beam_divergence"),
)
"""Effects that show in other things than mean and spread of residuals."""
_POINTS_PER_PATCH = 30.0
_LARGEST = 5.0
"""Deviations are cut off at so many sigmas: an outlier has no more to say."""
_LEAST, _LEAST_OF_SMOOTHING = 0.0, 5.0
"""A score that does not rise speaks against an effect; a little low-pass also makes up for rays that are not quite where they are
thought to be."""


@dataclass(frozen=True)
class Scored:
    """Effects with their held-out gains, and those that failed."""

    named: list[Named]
    failed: list[Named]


def score_effects(
    measurement: Measurement, residuals: Residuals, named: list[Named], trained: BoolArray, reference_sigma: float
) -> Scored:
    """Score each effect with all others in the model. trained: (n,) points by which to register; the others are scored."""
    scored = [item for item in named if item.name.partition(".")[2] not in NOT_SCORED]
    if not scored or (~trained).sum() < 100:
        return Scored(named, [])
    whole = _value(measurement, named, residuals, trained)
    gains = {}
    for item in scored:
        others = [each for each in named if each is not item]
        without = _value(measurement, others, residuals, trained)
        rows = ~trained & np.isfinite(whole[0]) & np.isfinite(without[0])
        patch = patches(residuals.at[rows], _POINTS_PER_PATCH)
        scores = [_log_score(value[rows], sigma[rows], patch, reference_sigma) for value, sigma in (whole, without)]
        gains[item.name] = scores[0] - scores[1]
    failed = [item for item in named if item.name in gains and gains[item.name] <= _least(item)]
    return Scored([replace(item, gain=gains.get(item.name, item.gain)) for item in named if item not in failed], failed)


def _least(item: Named) -> float:
    return _LEAST_OF_SMOOTHING if item.name == "stereo.smoothing" else _LEAST


def _value(
    measurement: Measurement, named: list[Named], residuals: Residuals, trained: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """(n,) residuals, registered by the points `trained`, and predicted sigma against the model with some effects."""
    model = with_effects(measurement.model, [item.entry for item in named])
    found = settled(measurement.changed(model=model), residuals.index[trained])[1]
    count = len(measurement.cloud.points)
    place = np.full(count, -1)
    place[found.index[found.smooth]] = np.flatnonzero(found.smooth)  # an edge where the beam goes by this model says nothing
    rows = place[residuals.index]
    known = rows >= 0
    value, sigma = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    pose = pose_of(found.part(rows[trained & known]))
    value[known], sigma[known] = (found.value - found.pose @ pose)[rows[known]], found.sigma[rows[known]]
    return value, sigma


def _log_score(value: FloatArray, sigma: FloatArray, patch: NDArray[np.int64], reference_sigma: float) -> float:
    """Of the patches' means, with the reference's error in their variance, and of the deviations from them."""
    weight = 1 / sigma**2
    total = np.bincount(patch, weight)
    mean = np.bincount(patch, weight * value) / total
    variance = 1 / total + reference_sigma**2
    left = np.clip((value - mean[patch]) / sigma, -_LARGEST, _LARGEST)
    among = -0.5 * np.sum(left**2) - np.sum(np.log(sigma)) + 0.5 * np.sum(np.log(1 / total))
    return float(among - 0.5 * np.sum(mean**2 / variance + np.log(variance)))
