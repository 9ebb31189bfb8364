"""Align the sensor with the reference: estimate its pose from the residuals by robust least squares.

The surveyed pose is never exact, so the pose is a nuisance parameter of every fit. It has six values for each set-up, or seven
(with a scale) for a surface without cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement, SurfaceMeasurement
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.several_scans import residuals_of_scans
from pipeline.gap.residuals.stereo_residuals import StereoResiduals, stereo_residuals
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals, surface_residuals
from pipeline.gap.residuals.tls_residuals import tls_residuals
from pipeline.gap.thresholds import thresholds
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray
from sensors.effects.raster_effect import RasterEffect

_ROUNDS = 6
"""Most rounds of outlier rejection."""
_AT_ONCE = 2048
"""Rows factored together (100 kB for one set-up), whatever the number of threads, so that results do not depend on it."""
_BLOCKS = 64
"""Such groups of rows that a thread takes at a time."""
_FEWEST = 100
"""Fewest points for outliers to be rejected."""
_RETRACE_FROM_M, _MOST_MOVES = 0.002, 3
"""A pose that moves rays by more than this on the wall, m, needs new residuals; and how often that is repeated at most."""
_RETRACE_PAIR_FROM_SIGMAS = 0.02
"""A stereo pair's pose must also change the disparities by more than this, in predicted standard deviations averaged over the
points: a shift and a rotation of a distant pair can nearly cancel, so that their sizes alone say little.
"""
_RETRACE_FROM_SIGMAS, _MOST_MOVES_OF_SURFACES = 0.1, 12
"""The same for a surface without cameras, where only this counts: its nearest places on the reference change as it moves."""
_MANY, _PART = 250_000, 60_000
"""Number of points from which on the pose is first estimated from a part of them, and the least number of points of that part.
The pose from the part differs little from that of all points, so that the residuals of all are usually computed only once.
"""


def fit_pose_robustly(residuals: Residuals) -> tuple[FloatArray, FloatArray, float]:
    """Fit the pose of the sensor to the residuals by least squares, rejecting outliers in several rounds.

    Parameters
    ----------
    residuals : Residuals of n points with k set-ups (positions of the sensor); only points marked as usable are fitted.

    Returns
    -------
    value : (n,) residuals minus what the fitted change of the pose explains, in the unit of the residuals (m or px).
    pose : (6 k,) correction of each set-up's pose: shift (m) and small rotation (rad), wall frame. For a cloud without cameras:
        one value for each column of `residuals.pose_jacobian`, at most seven (shift, rotation and scale).
    noise_ratio : Robust standard deviation (NMAD) of `value` divided by its predicted standard deviation; at least 1. It is
        above 1 if the residuals scatter more than predicted.
    """
    return RobustPoseFit.of(residuals).fit(residuals.value)


@dataclass(frozen=True, eq=False)
class RobustPoseFit:
    """Least-squares fits of the sensor's pose to several sets of residuals of the same n points, rejecting outliers.

    What does not depend on the residuals is computed once: derivatives by the pose over sigma, combined to r columns that are
    orthonormal over the m usable points. Normal equations of most of these points are then well conditioned, so that they are as
    exact as a QR factorisation, and they follow from the few rejected points. The rank r is less than 6 k if the points do not
    determine the pose.

    Attributes
    ----------
    residuals : Residuals of n points with k set-ups, of which sigma, the usable points and the derivatives by the pose count.
    rows : (m,) numbers of the usable points.
    basis : (m, r) orthonormal columns.
    gram : (r, r) their products with each other, which differ from the unit matrix by rounding.
    back : (6 k, r) matrix that makes these columns from the derivatives, and the pose from their coefficients.
    """

    residuals: Residuals
    rows: NDArray[np.int64]
    basis: FloatArray
    gram: FloatArray
    back: FloatArray

    @classmethod
    def of(cls, residuals: Residuals) -> RobustPoseFit:
        """Prepare the fit of the pose to the usable points of `residuals`; their values do not matter."""
        rows = np.flatnonzero(residuals.usable)
        columns = np.take(residuals.pose_jacobian, rows, axis=0)
        columns /= residuals.sigma[rows, None]
        _, sizes, axes = np.linalg.svd(_triangular_factor(columns), full_matrices=False)
        told = sizes > np.finfo(float).eps * len(rows) * sizes.max(initial=0.0)
        back = axes[told].T / sizes[told]
        basis = columns @ back
        return cls(residuals, rows, basis, basis.T @ basis, back)

    def fit(self, value: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Fit the pose of the sensor to residuals, and reject outliers in several rounds.

        value: (n,) residuals, in the unit of the observable (m, or px of disparity).

        Returns
        -------
        tuple : as `fit_pose_robustly` returns it.
        """
        sigma, most = self.residuals.sigma, thresholds().points.registration_outlier_sigmas
        weighted = np.asarray(value[self.rows] / sigma[self.rows], dtype=np.float64)
        size = whole = weighted @ self.basis
        kept, scale = np.ones(len(weighted), dtype=bool), 1.0
        for _ in range(_ROUNDS):
            rejected = np.flatnonzero(~kept)
            away = self.basis[rejected]
            size = np.linalg.lstsq(self.gram - away.T @ away, whole - weighted[rejected] @ away)[0].astype(np.float64)
            z = np.abs(weighted - self.basis @ size)
            scale = max(1.0, nmad(z, 0.0))
            before, kept = kept, z < most * scale
            if np.count_nonzero(kept) < _FEWEST:
                kept = np.ones(len(weighted), dtype=bool)
            if np.array_equal(kept, before):  # converged
                break
        pose = self.back @ size
        return value - self.residuals.pose_jacobian @ pose, pose, scale


def fit_pose(residuals: Residuals, rows: BoolArray | NDArray[np.int64]) -> FloatArray:
    """Fit the pose of the sensor to the residuals of points that are known to be good, by weighted least squares.

    rows: the points to use, as a mask (n,) or as row numbers. Returns the correction of the pose (6 k,), as
    `fit_pose_robustly` does, but rejects no outliers.
    """
    design = np.column_stack([residuals.pose_jacobian[rows], residuals.value[rows]])
    design /= residuals.sigma[rows, None]
    triangle = _triangular_factor(design)
    return np.asarray(np.linalg.lstsq(triangle[:, :-1], triangle[:, -1], rcond=np.finfo(float).eps * len(design))[0])


def _triangular_factor(design: FloatArray) -> FloatArray:
    """(k, k) triangle with the same products of columns as `design` (n, k), by repeated QR of rows that fit the cache."""
    while len(design) > _AT_ONCE:
        whole = len(design) // _AT_ONCE * _AT_ONCE
        blocks = design[:whole].reshape(-1, _AT_ONCE, design.shape[1])
        groups = [blocks[start : start + _BLOCKS] for start in range(0, len(blocks), _BLOCKS)]
        triangles = map_in_threads(lambda group: np.asarray(np.linalg.qr(group, mode="r")), groups)
        design = np.concatenate([*(each.reshape(-1, design.shape[1]) for each in triangles), design[whole:]])
    return np.asarray(np.linalg.qr(design, mode="r"))


def compute_residuals(measurement: Measurement) -> Residuals:
    """Compute the residuals (measured minus predicted observable) of a measurement, with the sensor at its surveyed pose.

    If there are several epochs (repetitions), the sensor may stand a little differently in each. A pose is therefore fitted to
    each epoch, and the effect of its difference from the mean pose is subtracted.

    Parameters
    ----------
    measurement : One laser scan or several, a stereo pair or a cloud without cameras. It contains the reference surface and the
        sensor model, by which the observables are predicted.

    Returns
    -------
    Residuals of all points that can be compared with the reference: of ranges (m), of disparities (px), or of distances from the
    reference surface (m).
    """
    found: Residuals
    if isinstance(measurement, SurfaceMeasurement):
        found = surface_residuals(measurement)
    elif isinstance(measurement, StereoMeasurement):
        found = stereo_residuals(measurement)
    else:
        found = residuals_of_scans(measurement) if measurement.scans else tls_residuals(measurement)
    epochs = measurement.epochs[found.index]
    numbers = np.unique(epochs)
    if len(numbers) < 2:
        return found
    poses = np.stack([fit_pose_robustly(found.part(epochs == number))[1] for number in numbers])
    apart = (poses - poses.mean(axis=0))[np.searchsorted(numbers, epochs)]
    away = np.einsum("ni,ni->n", found.pose_jacobian, apart)
    return replace(found, value=found.value - away, epoch_offset=away)


class AlignedMeasurement(NamedTuple):
    """A measurement whose sensor was moved to the pose that fits the reference surface best.

    Attributes
    ----------
    measurement : The measurement with the sensor at this pose.
    residuals : Its residuals at this pose.
    pose : (6 k,) by how much each of k set-ups (positions of the sensor) was moved from its surveyed pose, as
        `fit_pose_robustly` returns it.
    """

    measurement: Measurement
    residuals: Residuals
    pose: FloatArray


def align(
    measurement: Measurement, trusted: NDArray[np.int64] | None = None, found: Residuals | None = None
) -> AlignedMeasurement:
    """Move the sensor to the pose that fits the residuals best, and compute the residuals there.

    The fit is linear in the pose. After a larger move the residuals are therefore computed again and the fit is repeated: if
    rays move by more than 2 mm on the wall, up to three times; for a stereo pair only if disparities also change by more than 2 %
    of their predicted standard deviations on average. For a cloud without cameras: if the points move by more than a tenth of
    their predicted standard deviations on average, up to twelve times. Without `found`, the pose of a laser scan or a stereo pair
    of at least 250,000 points is first estimated from about 60,000 of them, to save time.

    Parameters
    ----------
    measurement : The measurement with the sensor at its surveyed pose.
    trusted : Row numbers of the measurement's points to which the pose is fitted, for example those on stable rock; None for
        all.
    found : Residuals at the surveyed pose, if they are known; None: they are computed.

    Returns
    -------
    The measurement, its residuals at the fitted pose, and the pose. A move is undone if no ray would hit the wall after it.
    """
    if found is None and (pose := _pose_from_part(measurement, trusted)) is not None:
        there = measurement.moved(pose)
        rest = align(there, trusted, compute_residuals(there))
        return AlignedMeasurement(rest.measurement, rest.residuals, pose + rest.pose)
    found = compute_residuals(measurement) if found is None else found
    total = np.zeros(found.pose_jacobian.shape[1])
    most = _MOST_MOVES_OF_SURFACES if isinstance(measurement, SurfaceMeasurement) else _MOST_MOVES
    for _ in range(most if len(found) else 0):
        usable = found.usable if trusted is None else found.usable & np.isin(found.index, trusted)
        pose = fit_pose_robustly(replace(found, usable=usable))[1]
        if not _moves_far(pose, found):
            break
        aligned = measurement.moved(pose)
        new_residuals = compute_residuals(aligned)
        if not len(new_residuals.value):  # no ray meets the wall from there
            break
        measurement, total, found = aligned, total + pose, new_residuals
    return AlignedMeasurement(measurement, found, total)


def _pose_from_part(measurement: Measurement, trusted: NDArray[np.int64] | None) -> FloatArray | None:
    """Estimate the pose, as `align` does, from evenly spaced ones of many points; None if all points are needed.

    They are needed if there are few, without cameras (the points then define the pose's parameters), and for effects by which
    neighbouring pixels influence each other. trusted: see `align`.
    """
    count = len(measurement.cloud.points)
    by_neighbours = any(isinstance(effect, RasterEffect) for effect in measurement.model.effects)
    if count < _MANY or by_neighbours or isinstance(measurement, SurfaceMeasurement):
        return None
    rows = np.arange(count) if trusted is None else trusted
    return align(measurement.part(rows[:: max(len(rows) // _PART, 1)])).pose


def _moves_far(pose: FloatArray, residuals: Residuals) -> bool:
    """Tell whether a pose moves the sensor so far that the residuals must be computed again."""
    change = float(np.mean(np.abs(residuals.pose_jacobian @ pose) / residuals.sigma))
    if isinstance(residuals, SurfaceResiduals):
        return change > _RETRACE_FROM_SIGMAS
    if isinstance(residuals, StereoResiduals) and change <= _RETRACE_PAIR_FROM_SIGMAS:
        return False
    for start in range(0, len(pose), 6):
        own, columns = pose[start : start + 6], residuals.pose_jacobian[:, start : start + 6]
        turn, shift = (float(np.linalg.norm(columns[:, part], axis=1).mean()) for part in (slice(3, 6), slice(3)))
        if shift > 0 and np.linalg.norm(own[:3]) + turn / shift * np.linalg.norm(own[3:]) > _RETRACE_FROM_M:
            return True
    return False


def at_points_of(found: Residuals, part: Residuals) -> Residuals:
    """Restrict residuals to the points of other residuals, to compare two sensor models on the same points.

    Points that `found` marks as unusable for fitting (for example at edges) are left out, and so are its outliers.

    Parameters
    ----------
    found : Residuals to restrict, for example those under a sensor model with one more effect.
    part : Residuals of the points to keep, of the same measurement.

    Returns
    -------
    The residuals `found` at the remaining points, in the order of `part`.
    """
    registered_residuals, _, noise_ratio = fit_pose_robustly(found)
    good = found.usable & (np.abs(registered_residuals) < thresholds().points.outlier_sigmas * noise_ratio * found.sigma)
    rows = found.values_at(np.where(good, np.arange(len(good)), np.nan), part.index)
    return found.part(rows[np.isfinite(rows)].astype(np.int64))
