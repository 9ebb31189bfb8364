"""The gap before and after, on blocks that no step has used, by simulating again through the sensor's own code.

Measure: the continuous ranked probability score of measured patches of the wall against an ensemble of simulated ones, in metres;
a proper score, which neither a wrong mean nor an inflated spread can lower (Gneiting & Raftery 2007, eq. 21, fair ensemble form).
A patch is scored twice, by the mean and by the standard deviation of its residuals: in single points either drowns in noise.
Measured and simulated residuals are cut off alike, far out, so that a few points at depth steps do not stand for the wall.
Floor: the same score of draws of the model itself; no higher than the score after, below which one draw may chance to fall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement, SurfaceMeasurement, TlsMeasurement
from pipeline.gap.decisions import decided
from pipeline.gap.residuals.disparity_simulation import simulate_disparities
from pipeline.gap.residuals.residuals import BoolArray, ExpectedPulses, Residuals
from pipeline.gap.residuals.several_scans import simulate_range_errors
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals, simulate_distances
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from pipeline.gap.residuals.wall_blocks import wall_blocks_by_points
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.models.sensor_model import StereoModel, TlsModel

MEASURE = "mean continuous ranked probability score of patches (mean and spread of their residuals) against simulated ones"
LOSS_MEASURE = "mean Brier score of pulses (lost or not) against the chance of losing them"
_DRAWS = 8
_MOST_POINTS = 30_000
_POINTS_PER_PATCH = 30.0
_FEWEST_POINTS = 8


@dataclass(frozen=True)
class Gap:
    """Scores on held-out points, in `unit`. error: standard error of before - after; floor_error: of before - floor."""

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
        """The three scores by name."""
        return {"before": self.before, "after": self.after, "floor": self.floor}

    @property
    def shown(self) -> tuple[float, str]:
        """By what a score is multiplied where people read it, and the unit that it then has."""
        return (1e3, "mm") if self.unit == "m" else (1.0, "Brier")

    @property
    def closed(self) -> float | None:
        """Share of the gap that the new model closes; None where the gap is within its own uncertainty."""
        return None if self.uncertain else (self.before - self.after) / (self.before - self.floor)

    @property
    def above_floor(self) -> bool:
        """Whether before lies above the floor by more than the uncertainty of that."""
        return self.before - self.floor > decided().verdict.floor_sigmas * self.floor_error

    @property
    def left_open(self) -> bool:
        """Whether after lies above the floor by more than the uncertainty of that."""
        return self.after - self.floor > decided().verdict.floor_sigmas * self.floor_error

    @property
    def uncertain(self) -> bool:
        """Whether before - floor is within its own uncertainty, and before - after, scored on the same patches, within its."""
        return not self.above_floor and self.before - self.after <= decided().verdict.gap_sigmas * self.error

    def to_dict(self) -> dict[str, Any]:
        """As gap.json holds it."""
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


@dataclass(frozen=True)
class Version:
    """A model with its registration (6,), by which the sensor stands shifted (m) and turned (rad) against the survey."""

    model: TlsModel | StereoModel
    pose: FloatArray


def simulated(
    measurement: Measurement, model: TlsModel | StereoModel, residuals: Residuals, randoms: Sequence[KeyedRandom]
) -> FloatArray:
    """(d, n) simulated minus geometric observable of the residuals' points, NaN without a return, for each source of random
    numbers.

    measurement: with its sensor where it stood, against which `residuals` may be those of another place.
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
    before: Version,
    after: Version,
    residuals: Residuals,
    reference_sigma: float,
    largest: float,
    random: KeyedRandom,
) -> Gap | None:
    """Score two versions of the model on held-out residuals, with common random numbers; None where too few points remain.

    reference_sigma: standard deviation of the reference's own error in the observable's unit, which is part of every draw;
    largest: predicted sigmas by which a point may lie off one of the versions; those farther off both are left out.
    """
    patch = wall_blocks_by_points(residuals.wall_xy, _POINTS_PER_PATCH)
    versions = [_draws(measurement, version, residuals, random.child("ensemble")) for version in (before, after)]
    truth, measured = _draws(measurement, after, residuals, random.child("floor")), residuals.total_departure
    usable = np.isfinite(np.concatenate([*versions, truth])).all(axis=0)
    middles, sigma = [np.median(draws, axis=0) for draws in versions], residuals.sigma
    off = np.min([np.abs(measured - middle) for middle in middles], axis=0)
    usable &= off < largest * sigma
    if not usable.any():
        return None
    spread = max(largest, decided().points.outlier * nmad((measured - middles[0])[usable] / sigma[usable], 0.0))
    low, high = middles[0] - spread * sigma, middles[0] + spread * sigma
    measured, truth, *versions = (np.clip(each, low, high) for each in (measured, truth, *versions))
    usable &= np.isin(patch, np.flatnonzero(np.bincount(patch[usable], minlength=patch.max() + 1) >= _FEWEST_POINTS))
    if not usable.any():
        return None
    _, number = np.unique(patch[usable], return_inverse=True)
    unit = np.bincount(number, residuals.unit_m[usable]) / np.bincount(number)
    errors = reference_sigma * random.child("reference").generator().standard_normal((3, _DRAWS, len(unit)))
    value = _summaries(measured[None, usable], number)[:, 0]
    ensembles = [_summaries(drawn[:, usable], number, errors[0]) for drawn in versions]
    drawn = _summaries(truth[:, usable], number, errors[1])
    old, new = (np.sum([_scores(e, v) for e, v in zip(found, value, strict=True)], axis=0) * unit for found in ensembles)
    floors = [np.sum([_scores(e, d[row]) for e, d in zip(ensembles[1], drawn, strict=True)], axis=0) for row in range(_DRAWS)]
    floor, count = np.mean(floors, axis=0) * unit, len(unit)
    floor = floor + min(float(new.mean() - floor.mean()), 0.0)
    return Gap(
        before=float(old.mean()),
        after=float(new.mean()),
        floor=float(floor.mean()),
        error=float((old - new).std() / np.sqrt(count)),
        floor_error=float((old - floor).std() / np.sqrt(count)),
        points=int(usable.sum()),
    )


def measure_losses(missing: ExpectedPulses, chance: FloatArray, held_out: BoolArray) -> Gap | None:
    """Score a chance (m,) of losing pulses on held-out ones; before, it is the share of losses of all others.

    Floor: the score that pulses lost with that very chance have on average.
    """
    if held_out.sum() < 100:
        return None
    lost, p = missing.lost[held_out].astype(np.float64), chance[held_out]
    patch = wall_blocks_by_points(missing.wall_xy[held_out], _POINTS_PER_PATCH)
    count = np.bincount(patch)
    share = float(missing.lost[~held_out].mean())
    old, new, floor = (np.bincount(patch, each) / count for each in ((lost - share) ** 2, (lost - p) ** 2, p * (1 - p)))
    floor = floor + min(float(new.mean() - floor.mean()), 0.0)
    errors = [float((old - each).std() / np.sqrt(len(count))) for each in (new, floor)]
    return Gap(
        before=float(old.mean()),
        after=float(new.mean()),
        floor=float(floor.mean()),
        error=errors[0],
        floor_error=errors[1],
        points=len(lost),
        measure=LOSS_MEASURE,
        unit="1",
    )


def _draws(measurement: Measurement, version: Version, residuals: Residuals, random: KeyedRandom) -> FloatArray:
    stood = measurement.moved(version.pose)
    draws = simulated(stood, version.model, residuals, [random.child(number) for number in range(_DRAWS)])
    if isinstance(residuals, TlsResiduals):
        return draws - np.stack([residuals.draw_reference_error(random.child("vertices", number)) for number in range(_DRAWS)])
    # a cloud without cameras has no place from which to simulate it: its datum counts by its slopes
    return draws + residuals.pose_jacobian @ version.pose if isinstance(residuals, SurfaceResiduals) else draws


def _summaries(draws: FloatArray, patch: NDArray[np.int64], error: FloatArray | None = None) -> FloatArray:
    """(2, d, p) mean, with an error (d, p) of the reference, and standard deviation of each of p patches in draws (d, n)."""
    count = np.bincount(patch)
    mean = np.stack([np.bincount(patch, row) for row in draws]) / count
    square = np.stack([np.bincount(patch, (row - m[patch]) ** 2) for row, m in zip(draws, mean, strict=True)])
    return np.stack([mean if error is None else mean + error, np.sqrt(square / np.maximum(count - 1, 1))])


def _scores(draws: FloatArray, value: FloatArray) -> FloatArray:
    """(n,) fair ensemble CRPS: mean |x - y| - mean |x - x'| / 2."""
    ordered, count = np.sort(draws, axis=0), len(draws)
    weight = (2 * np.arange(count) - count + 1)[:, None]
    spread = 2 * np.sum(weight * ordered, axis=0) / (count * (count - 1))
    return np.asarray(np.abs(draws - value).mean(axis=0) - spread / 2)


def thinned(count: int) -> slice:
    """Every how-manieth held-out point is simulated."""
    return slice(None, None, max(count // _MOST_POINTS, 1))
