"""Measure the gap before and after on validation blocks, by simulating again through the sensor's own code.

Measure: the continuous ranked probability score (CRPS) of measured patches of the wall against an ensemble of simulated ones, in
metres. The score is proper: neither a wrong mean nor an inflated noise can lower it (Gneiting & Raftery 2007, eq. 21, fair
ensemble form). A patch is scored twice, by the mean and by the standard deviation of its residuals, because in single points the
noise hides both. Measured and simulated residuals are clipped at the same values, so that a few points at depth steps do not
dominate.

Floor: the same score of draws of the model itself. It is limited to the score after, because one draw may fall below.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement, SurfaceMeasurement, TlsMeasurement
from pipeline.gap.residuals.disparity_simulation import simulate_disparities
from pipeline.gap.residuals.residuals import BoolArray, ExpectedPulses, Residuals
from pipeline.gap.residuals.several_scans import simulate_range_errors
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals, simulate_distances
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from pipeline.gap.residuals.wall_blocks import wall_blocks_by_points
from pipeline.gap.thresholds import thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.models.sensor_model import StereoModel, TlsModel

MEASURE = (
    "mean continuous ranked probability score of patches (mean and standard deviation of their residuals) against simulations"
)
LOSS_MEASURE = "mean Brier score of pulses (lost or not) against their predicted probability of loss"
_ENSEMBLE_SIZE = 8
"""Simulations of an ensemble, points of a patch, and fewest points of a patch that is scored."""
_POINTS_PER_PATCH = 30.0
_FEWEST_POINTS = 8


@dataclass(frozen=True)
class Gap:
    """How much worse a measurement fits its sensor model than noise explains, without and with the named sensor errors.

    The score is measured on validation points, which no fit used; smaller is better. The gap is the score minus the floor.

    Attributes
    ----------
    before, after : mean score of the model without and with the named effects (sensor errors).
    floor : mean score of data that the model with the effects has simulated: what noise alone leaves.
    error : standard error of before - after.
    floor_error : standard error of before - floor.
    points : number of points that were scored.
    measure : what the score is, in words.
    unit : unit of the scores: "m", or "1" for the Brier score of missing returns.
    """

    before: float
    after: float
    floor: float
    error: float
    floor_error: float
    points: int
    measure: str = MEASURE
    unit: str = "m"

    @property
    def scores(self) -> dict[str, float]:
        """Scores by name: `before` and `after` (model without and with named effects), and `floor` (noise alone)."""
        return {"before": self.before, "after": self.after, "floor": self.floor}

    @property
    def display_unit(self) -> tuple[float, str]:
        """Factor that converts a score to the unit in which reports show it, and that unit: 1000 and "mm", or 1 and "Brier"."""
        return (1e3, "mm") if self.unit == "m" else (1.0, "Brier")

    @property
    def closed(self) -> float | None:
        """Share of the gap that the named effects close: (before - after) / (before - floor). None if the gap is `uncertain`."""
        return None if self.uncertain else (self.before - self.after) / (self.before - self.floor)

    @property
    def above_floor(self) -> bool:
        """Whether the model without named effects fits worse than noise explains.

        That is so if its score (`before`) exceeds the score that noise alone leaves (`floor`) by more than the uncertainty of
        their difference, at half the significance level `verdict.rejection_p`: 2.6 standard errors `floor_error` by default.
        """
        return self.before - self.floor > _floor_sigmas() * self.floor_error

    @property
    def left_open(self) -> bool:
        """Whether the model fits worse than noise explains even with the named effects, by the same test as `above_floor`."""
        return self.after - self.floor > _floor_sigmas() * self.floor_error

    @property
    def uncertain(self) -> bool:
        """Whether the gap is too small to be measured: `before` - `floor` and `before` - `after` are within their uncertainty."""
        return not self.above_floor and self.before - self.after <= thresholds().verdict.gap_sigmas * self.error

    def to_dict(self) -> dict[str, Any]:
        """Return the entry `gap` of gap.json: scores without and with the named effects, closed share, and standard errors."""
        note = "before - floor is within its own uncertainty" if self.uncertain else ""
        return {
            "measure": self.measure,
            "unit": self.unit,
            "before": self.before,
            "after": self.after,
            "floor": self.floor,
            "closed": self.closed,
            "evaluated_on": "held-out blocks",
            "points": self.points,
            "standard_error": {"before_minus_after": self.error, "before_minus_floor": self.floor_error},
            "note": note,
        }


def _floor_sigmas() -> float:
    """Standard errors beyond which a score lies above the noise floor: the one-sided quantile of half the significance level."""
    return float(-ndtri(thresholds().verdict.rejection_p / 2))


@dataclass(frozen=True)
class RegisteredModel:
    """A sensor model, and the sensor's pose with which its predictions fit the measurement best.

    Attributes
    ----------
    model : the sensor model.
    pose : (6 k,) shift (m) and small rotation (rad) of each of k set-ups from the pose in the measurement, wall frame. For a
        surface without cameras: (q,) amounts of those combinations of shift, rotation and scale that its points determine, as
        the attribute `datum` of its residuals defines them.
    """

    model: TlsModel | StereoModel
    pose: FloatArray


def simulate_errors(
    measurement: Measurement, model: TlsModel | StereoModel, residuals: Residuals, randoms: Sequence[KeyedRandom]
) -> FloatArray:
    """Simulate the sensor's errors (d, n) at measured points, to see which residuals a sensor model makes.

    An error is the simulated observable minus the one that geometry gives: range (m), disparity (px) or distance (m). It is NaN
    where a simulated pulse does not return.

    Parameters
    ----------
    measurement : the measured points, with the sensor at the pose to simulate from.
    model : sensor model to simulate, of the same sensor; that of the measurement is not used.
    residuals : residuals of the n points, which tell where rays meet the reference; they may belong to another pose.
    randoms : d sources of random numbers, one for each simulation.
    """
    match measurement, model, residuals:
        case TlsMeasurement(), TlsModel(), TlsResiduals():
            return np.stack([simulate_range_errors(measurement, model, residuals, random) for random in randoms])
        case StereoMeasurement(), StereoModel(), StereoResiduals():
            return simulate_disparities(measurement, model, residuals, randoms)
        case SurfaceMeasurement(), StereoModel(), SurfaceResiduals():
            return np.stack([simulate_distances(model, residuals, random) for random in randoms])
    raise TypeError("measurement, model and residuals are of different sensors")


def measure_gap(
    measurement: Measurement,
    before: RegisteredModel,
    after: RegisteredModel,
    residuals: Residuals,
    reference_sigma: float,
    most_sigmas: float,
    random: KeyedRandom,
) -> Gap | None:
    """Compare how well two sensor models, without and with the named sensor errors, predict validation points.

    The measurement is simulated with each model. The wall is divided into patches of about 30 points, and the mean and the
    standard deviation of the residuals in each are predicted. The score is their continuous ranked probability score (CRPS).
    Both models use the same random numbers, so that their difference is less noisy.

    Parameters
    ----------
    measurement : the measured points, with the sensor at its aligned pose.
    before, after : the models without and with the named effects (sensor errors).
    residuals : residuals of the validation points, which no fit used.
    reference_sigma : standard deviation of the error of the reference surface, in the unit of the observable (m or px); such an
        error is added to every patch of a simulation.
    most_sigmas : points farther than this many predicted standard deviations from both models are left out. If too few remain,
        None is returned.
    random : source of random numbers.
    """
    patch = wall_blocks_by_points(residuals.wall_xy, _POINTS_PER_PATCH)
    versions = [_draw_ensemble(measurement, version, residuals, random.child("ensemble")) for version in (before, after)]
    truth, measured = _draw_ensemble(measurement, after, residuals, random.child("floor")), residuals.total_departure
    usable = np.isfinite(np.concatenate([*versions, truth])).all(axis=0)
    medians, sigma = [np.median(draws, axis=0) for draws in versions], residuals.sigma
    off = np.min([np.abs(measured - median) for median in medians], axis=0)
    usable &= off < most_sigmas * sigma
    if not usable.any():
        return None
    spread = max(most_sigmas, thresholds().points.outlier_sigmas * nmad((measured - medians[0])[usable] / sigma[usable], 0.0))
    low, high = medians[0] - spread * sigma, medians[0] + spread * sigma
    measured, truth, *versions = (np.clip(each, low, high) for each in (measured, truth, *versions))
    usable &= np.isin(patch, np.flatnonzero(np.bincount(patch[usable], minlength=patch.max() + 1) >= _FEWEST_POINTS))
    if not usable.any():
        return None
    _, number = np.unique(patch[usable], return_inverse=True)
    unit = np.bincount(number, residuals.unit_m[usable]) / np.bincount(number)
    errors = reference_sigma * random.child("reference").generator().standard_normal((3, _ENSEMBLE_SIZE, len(unit)))
    value = _patch_statistics(measured[None, usable], number)[:, 0]
    ensembles = [_patch_statistics(drawn[:, usable], number, errors[0]) for drawn in versions]
    drawn = _patch_statistics(truth[:, usable], number, errors[1])
    old, new = (np.sum([_crps(e, v) for e, v in zip(found, value, strict=True)], axis=0) * unit for found in ensembles)
    floors = [
        np.sum([_crps(e, d[row]) for e, d in zip(ensembles[1], drawn, strict=True)], axis=0) for row in range(_ENSEMBLE_SIZE)
    ]
    return _mean_scores(old, new, np.mean(floors, axis=0) * unit, int(usable.sum()), MEASURE, "m")


def _mean_scores(old: FloatArray, new: FloatArray, floor: FloatArray, points: int, measure: str, unit: str) -> Gap:
    """Return the means of the scores (p,) of p patches. The floor is limited to the score after; one draw may fall below."""
    floor = floor + min(float(new.mean() - floor.mean()), 0.0)
    error, floor_error = (float((old - each).std() / np.sqrt(len(old))) for each in (new, floor))
    return Gap(float(old.mean()), float(new.mean()), float(floor.mean()), error, floor_error, points, measure, unit)


def measure_losses(missing: ExpectedPulses, chance: FloatArray, held_out: BoolArray) -> Gap | None:
    """Score how well an explanation of missing laser returns predicts which validation pulses are lost (Brier score).

    Three scores are computed. `before` is that of one probability for all pulses: the share that is lost of the pulses to which
    the explanation was fitted. `after` is that of the explanation. `floor` is the score to expect if pulses are lost with exactly
    the probability that the explanation predicts.

    Parameters
    ----------
    missing : m pulses that should have hit the wall, and whether each returned.
    chance : (m,) probability of losing each pulse that the explanation predicts.
    held_out : (m,) true for validation pulses, to which the explanation was not fitted. For fewer than 100, None is returned.
    """
    if held_out.sum() < 100:
        return None
    lost, p = missing.lost[held_out].astype(np.float64), chance[held_out]
    patch = wall_blocks_by_points(missing.wall_xy[held_out], _POINTS_PER_PATCH)
    count = np.bincount(patch)
    share = float(missing.lost[~held_out].mean())
    old, new, floor = (np.bincount(patch, each) / count for each in ((lost - share) ** 2, (lost - p) ** 2, p * (1 - p)))
    return _mean_scores(old, new, floor, len(lost), LOSS_MEASURE, "1")


def _draw_ensemble(measurement: Measurement, version: RegisteredModel, residuals: Residuals, random: KeyedRandom) -> FloatArray:
    """(d, n) simulated errors of one model at its pose, including errors of the reference."""
    registered = measurement.moved(version.pose)
    draws = simulate_errors(registered, version.model, residuals, [random.child(number) for number in range(_ENSEMBLE_SIZE)])
    if isinstance(residuals, TlsResiduals):
        return draws - np.stack(
            [residuals.draw_reference_error(random.child("vertices", number)) for number in range(_ENSEMBLE_SIZE)]
        )
    # a cloud without cameras cannot be simulated at another pose: its datum enters by the Jacobian
    return draws + residuals.pose_jacobian @ version.pose if isinstance(residuals, SurfaceResiduals) else draws


def _patch_statistics(draws: FloatArray, patch: NDArray[np.int64], error: FloatArray | None = None) -> FloatArray:
    """Return the mean and the standard deviation of each of p patches, (2, d, p), in d simulated draws of residuals (d, n).

    patch: (n,) patch of each point. error: (d, p) error of the reference of each patch, in each draw.
    """
    count = np.bincount(patch)
    mean = np.stack([np.bincount(patch, row) for row in draws]) / count
    square = np.stack([np.bincount(patch, (row - m[patch]) ** 2) for row, m in zip(draws, mean, strict=True)])
    return np.stack([mean if error is None else mean + error, np.sqrt(square / np.maximum(count - 1, 1))])


def _crps(draws: FloatArray, value: FloatArray) -> FloatArray:
    """(n,) fair ensemble CRPS: mean |x - y| - mean |x - x'| / 2."""
    ordered, count = np.sort(draws, axis=0), len(draws)
    weight = (2 * np.arange(count) - count + 1)[:, None]
    spread = 2 * np.sum(weight * ordered, axis=0) / (count * (count - 1))
    return np.asarray(np.abs(draws - value).mean(axis=0) - spread / 2)
