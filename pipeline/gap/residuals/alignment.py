"""The rigid-body nuisance: where the sensor really stood against the survey."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement, SurfaceMeasurement
from pipeline.gap.decisions import decided
from pipeline.gap.residuals.residuals import BoolArray, Residuals, Rows
from pipeline.gap.residuals.several_scans import residuals_of_scans
from pipeline.gap.residuals.stereo_residuals import stereo_residuals
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals, surface_residuals
from pipeline.gap.residuals.tls_residuals import tls_residuals
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray

_ROUNDS = 6
_AT_ONCE = 2048
"""Rows of a design together, whatever the number of threads: 100 kB of one set-up."""
_BLOCKS = 64
"""Such rows that a thread takes at a time."""
_FEWEST = 100
_FAR_M, _MOST_MOVES = 0.002, 3
_FAR_SIGMAS, _MOST_MOVES_OF_SURFACES = 0.1, 12
"""Of a cloud whose nearest places change as it moves: far in predicted sigmas, on average over its points."""


def fit_pose_robustly(residuals: Residuals) -> tuple[FloatArray, FloatArray, float]:
    """(n,) residuals after a robust registration, the pose (6 k,) of k set-ups, and how many predicted sigmas their spread is (at
    least 1)."""
    kept, scale = residuals.usable.copy(), 1.0
    value, pose, design = residuals.value, np.zeros(residuals.pose_jacobian.shape[1]), _weighed(residuals)
    for _ in range(_ROUNDS):
        before, pose = kept, _solved(design[kept])
        value = residuals.value - residuals.pose_jacobian @ pose
        z = np.abs(value / residuals.sigma)
        scale = max(1.0, nmad(z[residuals.usable], 0.0))
        kept = residuals.usable & (z < decided().points.unregistered * scale)
        if kept.sum() < _FEWEST:
            kept = residuals.usable
        if np.array_equal(kept, before):  # the next rounds would be the same
            break
    return value, pose, scale


def fit_pose(residuals: Residuals, rows: BoolArray | NDArray[np.int64]) -> FloatArray:
    """(6,) shift (m) and turn (rad) by weighted least squares over some rows (a mask or indices)."""
    return _solved(_weighed(residuals, rows))


def _weighed(residuals: Residuals, rows: Rows = slice(None)) -> FloatArray:
    """(m, 6 k + 1) pose of k set-ups and value of some rows, over sigma."""
    design = np.empty((len(residuals.sigma[rows]), residuals.pose_jacobian.shape[1] + 1))
    design[:, :-1], design[:, -1] = residuals.pose_jacobian[rows], residuals.value[rows]
    design /= residuals.sigma[rows, None]
    return design


def _solved(design: FloatArray) -> FloatArray:
    """(6 k,) coefficients of the first columns of (n, 6 k + 1), by least squares for the last."""
    triangle = _triangle(design)
    return np.asarray(np.linalg.lstsq(triangle[:, :-1], triangle[:, -1], rcond=np.finfo(float).eps * len(design))[0])


def _triangle(design: FloatArray) -> FloatArray:
    """(m, k) that has the same products of columns as (n, k), by QR of some rows at a time, which stay in the cache."""
    while len(design) > _AT_ONCE:
        whole = len(design) // _AT_ONCE * _AT_ONCE
        blocks = design[:whole].reshape(-1, _AT_ONCE, design.shape[1])
        triangles = map_in_threads(_factors, [blocks[start : start + _BLOCKS] for start in range(0, len(blocks), _BLOCKS)])
        design = np.concatenate([*triangles, design[whole:]])
    return design


def _factors(blocks: FloatArray) -> FloatArray:
    """(b k, k) the triangles of blocks (b, m, k)."""
    return np.asarray(np.linalg.qr(blocks, mode="r")).reshape(-1, blocks.shape[2])


def compute_raw_residuals(measurement: Measurement) -> Residuals:
    """The raw residuals of a laser scan, of a pair, or of a surface without cameras."""
    if isinstance(measurement, SurfaceMeasurement):
        return surface_residuals(measurement)
    if isinstance(measurement, StereoMeasurement):
        return stereo_residuals(measurement)
    return residuals_of_scans(measurement) if measurement.scans else tls_residuals(measurement)


def compute_residuals(measurement: Measurement) -> Residuals:
    """The raw residuals of either sensor; those of several epochs as if all had been taken from one place."""
    found = compute_raw_residuals(measurement)
    epochs = measurement.epochs[found.index]
    numbers = np.unique(epochs)
    if len(numbers) < 2:
        return found
    poses = np.stack([fit_pose_robustly(found.part(epochs == number))[1] for number in numbers])
    apart = (poses - poses.mean(axis=0))[np.searchsorted(numbers, epochs)]
    away = np.einsum("ni,ni->n", found.pose_jacobian, apart)
    return replace(found, value=found.value - away, epoch_offset=away)


class AlignedMeasurement(NamedTuple):
    """A measurement with its sensor where its points say that it stood, its residuals there, and the pose (6,) that led there."""

    measurement: Measurement
    residuals: Residuals
    pose: FloatArray


def align(
    measurement: Measurement, trusted: NDArray[np.int64] | None = None, found: Residuals | None = None
) -> AlignedMeasurement:
    """The measurement with its sensor where its points say that it stood.

    trusted: rows of the measurement's points by which to register, all where None; found: its residuals, if known. A pose that
    moves the rays by more than some millimetres on the wall is gone along with, a few times at the most, since slopes at the
    first place no longer serve.
    """
    found = compute_residuals(measurement) if found is None else found
    total = np.zeros(found.pose_jacobian.shape[1])
    most = _MOST_MOVES_OF_SURFACES if isinstance(measurement, SurfaceMeasurement) else _MOST_MOVES
    for _ in range(most if len(found) else 0):
        pose = fit_pose_robustly(_only(found, trusted))[1]
        if not _is_far(pose, found):
            break
        there = measurement.moved(pose)
        beyond = compute_residuals(there)
        if not len(beyond.value):  # the pose leads off the wall
            break
        measurement, total, found = there, total + pose, beyond
    return AlignedMeasurement(measurement, found, total)


def _only(residuals: Residuals, trusted: NDArray[np.int64] | None) -> Residuals:
    return residuals if trusted is None else replace(residuals, usable=residuals.usable & np.isin(residuals.index, trusted))


def _is_far(pose: FloatArray, residuals: Residuals) -> bool:
    if isinstance(residuals, SurfaceResiduals):
        return float(np.mean(np.abs(residuals.pose_jacobian @ pose) / residuals.sigma)) > _FAR_SIGMAS
    for start in range(0, len(pose), 6):
        own, columns = pose[start : start + 6], residuals.pose_jacobian[:, start : start + 6]
        turn, shift = (float(np.linalg.norm(columns[:, part], axis=1).mean()) for part in (slice(3, 6), slice(3)))
        if shift > 0 and np.linalg.norm(own[:3]) + turn / shift * np.linalg.norm(own[3:]) > _FAR_M:
            return True
    return False
