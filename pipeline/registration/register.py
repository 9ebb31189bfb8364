"""Registration of an epoch's points to the reference surface by the iterative closest point algorithm (ICP).

Every iteration pairs each moving point p (at its current pose) with its nearest reference point q (normal n) and takes the step,
a rotation R = exp(w) about the moving points' centroid g and a shift t, that makes the mean square of the residuals r least:

    point_to_plane   r = n . (p + w x (p - g) + t - q)      Chen and Medioni (1992), linearised as Low (2004), equations 3 to 8
    point_to_point   r = R (p - g) + g + t - q              Besl and McKay (1992), R by the SVD of Kabsch (1976), no reflections

Poses are moved by the exact exponential map, so they stay rigid whatever the linearisation. Direction: the result maps moving to
reference coordinates, x_reference = R x_moving + t.

The search starts on a random subset and ends on all the points (coarse to fine).

Where it fails: an offset larger than the roughness is wide ends in a wrong minimum; a shift along a smooth wall is known only as
well as its roughness tells it; normals estimated from noise determine nothing, but look as if they did.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.registration.closest_points import (
    LEAST_POINTS,
    ON_A_LINE,
    Map,
    ReferenceSurface,
    blocks_of,
    checked_cloud,
    scan_order,
)
from pipeline.registration.rigid import RigidTransform, rotation_matrix
from scene.common.config import Config
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.common.threads import executor
from scene.geometry.mesh import FloatArray

_LEVELS = (2**13, 2**17)
"""Sizes of the random subsets that come before all the points; each is used where the points are at least four times as many."""
_UNDETERMINED = 1e-6
"""Motions whose mean squared effect on the residuals, per squared metre moved, is below this share of the largest are left out:
a wall whose normals vary by less than 1 mrad is a plane."""


class IcpConfig(Config):
    """The iterative closest point algorithm; the eight parameters of the thesis (3.6) and the error that is minimised.

    `threshold` and `delta_threshold` both end the search, whichever is met first. `threshold` looks at one number, the error of
    the fit: near the minimum it changes with the square of the motion, so it says when going on no longer pays. `delta_threshold`
    looks at every point's residual and what the last step changed in it: that is in proportion to the motion, so it says when the
    pose stands still. Neither is asked before the outlier threshold has reached its final value. The error counts outliers at the
    outlier threshold, because the inliers' RMS alone stands still, or rises, while a better pose brings more points in.
    """

    method: Literal["point_to_plane", "point_to_point"] = Field(
        "point_to_plane", description="distance that is minimised: along the reference's normals, or between the points"
    )
    max_iteration: int = Field(100, ge=1, description="most iterations, converged or not; the last one uses all the points")
    outlier_distance_threshold: float = Field(
        0.1,
        gt=0,
        description="m; a point farther than this from its nearest reference point is an outlier. "
        "At least three sigma of the noise and the reference's point spacing",
    )
    outlier_threshold_decay_iteration: int = Field(
        5,
        ge=1,
        le=100,
        description="iteration k from which outlier_distance_threshold T applies; at iteration i before it, T 2^(k - i) does. "
        "1: T from the first iteration",
    )
    remove_outlier: bool = Field(True, description="leave outliers out of the fit; false: every point counts")
    threshold: float = Field(
        1e-8,
        ge=0,
        description="m; converged when the RMS error (outliers counted at the outlier threshold) improved by less than this from "
        "one iteration to the next; a rise by more is no end either. 0: never",
    )
    delta_threshold: float = Field(
        1e-4,
        ge=0,
        description="m; converged when a step changed the points' residuals by less than this (RMS over the points). 0: never",
    )
    subsample_points: bool = Field(False, description="fit a random part of the moving points")
    subsample_ratio: float = Field(0.9, ge=0, lt=1, description="share of the moving points that subsampling leaves out")

    def outlier_threshold_m(self, iteration: int) -> float:
        """The outlier threshold, m, at an iteration (counted from 1): T 2^max(k - i, 0), infinite without outlier removal."""
        if not self.remove_outlier:
            return float("inf")
        return self.outlier_distance_threshold * 2.0 ** max(self.outlier_threshold_decay_iteration - iteration, 0)


@dataclass(frozen=True)
class IcpIteration:
    """One iteration: the pairs it found and the step it took.

    points: moving points in use; inliers: those nearer to the reference than outlier_threshold_m; rms_m: of the inliers'
    residuals after the step (point_to_plane: to first order in its rotation), with the pairs found before it; error_m: the same
    with every outlier counted at the outlier threshold; residual_change_m: RMS over the inliers of what the step changed in their
    residuals; step_m: RMS over all the points of how far the step moved them; undetermined: motions left out, of six.
    """

    points: int
    inliers: int
    outlier_threshold_m: float
    rms_m: float
    error_m: float
    residual_change_m: float
    step_m: float
    undetermined: int

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it: an infinite outlier threshold is null."""
        values = dataclasses.asdict(self)
        return values | {"outlier_threshold_m": _finite(self.outlier_threshold_m)}


@dataclass(frozen=True)
class Registration:
    """The transform that brings moving points to the reference, x_reference = R x + t, and how it was found.

    rms_m: of the inliers' residuals at the end; points, inliers: in use, and within the outlier threshold, in the last iteration;
    reason: why it stopped, in words; undetermined: how many of the six motions the surface does not determine (0 for a rough
    wall, 3 for a plane with point_to_plane); history: every iteration.
    """

    transform: RigidTransform
    converged: bool
    reason: str
    history: tuple[IcpIteration, ...]

    @property
    def rotation(self) -> FloatArray:
        """(3, 3) R."""
        return self.transform.rotation

    @property
    def translation(self) -> FloatArray:
        """(3,) t, m."""
        return self.transform.translation

    @property
    def iterations(self) -> int:
        return len(self.history)

    @property
    def rms_m(self) -> float:
        return self.history[-1].rms_m

    @property
    def points(self) -> int:
        return self.history[-1].points

    @property
    def inliers(self) -> int:
        return self.history[-1].inliers

    @property
    def undetermined(self) -> int:
        return self.history[-1].undetermined

    def apply(self, points: FloatArray) -> FloatArray:
        """(..., 3) moving points in reference coordinates, m."""
        return self.transform.apply(points)

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it."""
        names = ("rms_m", "iterations", "points", "inliers", "undetermined", "converged", "reason")
        return (
            self.transform.to_dict()
            | {name: getattr(self, name) for name in names}
            | {"history": [record.to_dict() for record in self.history]}
        )

    def summary(self) -> str:
        """One line in millimetres."""
        end = "converged" if self.converged else "not converged"
        return (
            f"{end} after {self.iterations} iterations ({self.reason}), RMS {self.rms_m * 1e3:.2f} mm, "
            f"{self.inliers:,} of {self.points:,} points within the outlier threshold"
        )


@dataclass(frozen=True)
class Fit:
    """How well points fit a reference: `inliers` of `points` within the outlier threshold, their residuals' RMS (NaN: none)."""

    points: int
    inliers: int
    rms_m: float


def register(
    moving: FloatArray,
    reference: FloatArray,
    reference_normals: FloatArray | None,
    config: IcpConfig,
    random: KeyedRandom,
    *,
    threads: int | None = None,
) -> Registration:
    """Find the rigid transform that brings `moving` to `reference`.

    moving: (n, 3), reference: (m, 3), one frame, m, without NaN; reference_normals: (m, 3) of any length, sign irrelevant, or
    None for point_to_point; random draws the subsets; threads: None for all cores, without effect on the result.
    Raises InputError where there are fewer than six points, values that are not finite, points on one line, or fewer than six
    pairs within the outlier threshold.
    """
    return register_to(ReferenceSurface.build(reference, reference_normals), moving, config, random, threads=threads)


def register_to(
    surface: ReferenceSurface, moving: FloatArray, config: IcpConfig, random: KeyedRandom, *, threads: int | None = None
) -> Registration:
    """`register` to a reference that was indexed before, for many runs against one reference."""
    normals = _normals(surface, config)
    moving = checked_cloud(moving, "moving points")
    if threads == 1:  # a pool of one thread would only cost the hand-over
        return _Alignment(surface, normals, moving, config, map).run(random)
    with executor(threads) as pool:
        return _Alignment(surface, normals, moving, config, pool.map).run(random)


def fit(surface: ReferenceSurface, points: FloatArray, config: IcpConfig, *, threads: int | None = None) -> Fit:
    """How well (n, 3) points, m, fit where they are: residuals by `config.method`, inliers by its final outlier threshold."""
    normals = _normals(surface, config)
    local = checked_cloud(points, "points") - surface.origin
    gate = config.outlier_threshold_m(config.outlier_threshold_decay_iteration)
    with executor(threads) as pool:
        blocks = blocks_of(local[scan_order(local)])
        moments = surface.moments(blocks, RigidTransform.identity(), gate, normals, pool.map)
    squares = np.trace(moments[3:6, 3:6]) if normals is None else moments[6, 6]
    inliers = int(moments[-1, -1])
    return Fit(len(local), inliers, float(np.sqrt(squares / inliers)) if inliers else float("nan"))


def _normals(surface: ReferenceSurface, config: IcpConfig) -> FloatArray | None:
    """The normals that the method uses: those of the reference, or None for point_to_point."""
    if config.method == "point_to_point":
        return None
    if surface.normals is None:
        raise InputError(
            "point_to_plane needs the reference's normals", where="icp.method", remedy="give them or use point_to_point"
        )
    return surface.normals


@dataclass(frozen=True)
class _Step:
    """A rotation (3, 3) about the centroid and a shift (3,), m, the mean square that they leave and the change that they make."""

    rotation: FloatArray
    shift: FloatArray
    mean_squares: float
    residual_change_m: float
    undetermined: int = 0


class _Alignment:
    """One registration: the moving points about their centroid, coarse to fine."""

    def __init__(
        self, surface: ReferenceSurface, normals: FloatArray | None, moving: FloatArray, config: IcpConfig, map_blocks: Map
    ) -> None:
        self.surface, self.normals, self.config, self.map_blocks = surface, normals, config, map_blocks
        self.centroid = moving.mean(axis=0)
        self.local = moving[scan_order(moving)] - self.centroid
        self.covariance = np.einsum("ni,nj->ij", self.local, self.local) / len(self.local)

    def run(self, random: KeyedRandom) -> Registration:
        """Iterate on each level until it converges, on the last until the end."""
        levels = self._levels(random)
        pose = RigidTransform(np.eye(3), self.centroid - self.surface.origin)
        history: list[IcpIteration] = []
        level, reason = 0, ""
        for iteration in range(1, self.config.max_iteration + 1):
            if iteration == self.config.max_iteration:
                level = len(levels) - 1
            pose, record = self._iterate(levels[level], pose, self.config.outlier_threshold_m(iteration))
            history.append(record)
            reason = self._stop_reason(history)
            if reason and level == len(levels) - 1:
                break
            level += bool(reason)
        converged = bool(reason)
        reason = reason or f"max_iteration = {self.config.max_iteration} reached"
        return Registration(self._in_full_coordinates(pose), converged, reason, tuple(history))

    def _levels(self, random: KeyedRandom) -> list[list[FloatArray]]:
        """Blocks of nested random subsets, the last one of all the points in use."""
        total = len(self.local)
        used = round(total * (1 - self.config.subsample_ratio)) if self.config.subsample_points else total
        if used < LEAST_POINTS:
            raise InputError(
                f"leaves {used} of {total:,} points",
                where="icp.subsample_ratio",
                allowed=f"at most {1 - LEAST_POINTS / total:.6g}",
            )
        draw = random.generator().random(total)
        sizes = [size for size in _LEVELS if 4 * size <= used] + [used]
        return [blocks_of(self.local if size == total else self.local[_smallest(draw, size)]) for size in sizes]

    def _iterate(self, blocks: list[FloatArray], pose: RigidTransform, gate: float) -> tuple[RigidTransform, IcpIteration]:
        """Pair, solve, move: the next pose and the record of it."""
        moments = self.surface.moments(blocks, pose, gate, self.normals, self.map_blocks)
        points, inliers = sum(map(len, blocks)), int(moments[-1, -1])
        if inliers < LEAST_POINTS:
            raise self._too_few(blocks, pose, gate, inliers)
        step = _point_step(moments) if self.normals is None else self._plane_step(moments)
        outliers = points - inliers
        squares = step.mean_squares * inliers + (outliers * gate**2 if outliers else 0.0)
        turn = (step.rotation - np.eye(3)) @ pose.rotation
        moved = np.trace(turn @ self.covariance @ turn.T) + step.shift @ step.shift
        record = IcpIteration(
            points=points,
            inliers=inliers,
            outlier_threshold_m=gate,
            rms_m=float(np.sqrt(step.mean_squares)),
            error_m=float(np.sqrt(squares / points)),
            residual_change_m=step.residual_change_m,
            step_m=float(np.sqrt(max(moved, 0.0))),
            undetermined=step.undetermined,
        )
        return RigidTransform(step.rotation @ pose.rotation, pose.translation + step.shift), record

    def _plane_step(self, moments: FloatArray) -> _Step:
        """Gauss-Newton on (w, t), with w scaled by the cloud's radius so that all six unknowns are metres moved."""
        radius = float(np.sqrt(np.trace(self.covariance)))
        scale = np.repeat([1 / radius, 1.0], 3)
        count = moments[-1, -1]
        normal = moments[:6, :6] / count * np.outer(scale, scale)
        gradient = moments[:6, 6] / count * scale
        unknowns, undetermined = _least_norm(normal, -gradient)
        change = float(unknowns @ normal @ unknowns)
        squares = float(moments[6, 6] / count + 2 * gradient @ unknowns) + change
        rotation = rotation_matrix(unknowns[:3] / radius)
        return _Step(rotation, unknowns[3:], max(squares, 0.0), float(np.sqrt(max(change, 0.0))), undetermined)

    def _stop_reason(self, history: list[IcpIteration]) -> str:
        """Why the level of the last iteration has converged, in words; empty while it has not."""
        last, before = history[-1], history[-2] if len(history) > 1 else None
        if len(history) < self.config.outlier_threshold_decay_iteration and self.config.remove_outlier:
            return ""
        if last.residual_change_m < self.config.delta_threshold:
            return f"the residuals changed by less than delta_threshold = {self.config.delta_threshold:g} m"
        if before is None or (before.points, before.outlier_threshold_m) != (last.points, last.outlier_threshold_m):
            return ""
        if abs(before.error_m - last.error_m) < self.config.threshold:
            return f"the RMS error changed by less than threshold = {self.config.threshold:g} m"
        return ""

    def _too_few(self, blocks: list[FloatArray], pose: RigidTransform, gate: float, inliers: int) -> InputError:
        distance, _ = self.surface.tree.query(pose.apply(blocks[0]))
        return InputError(
            f"only {inliers} of {sum(map(len, blocks)):,} points lie within {gate:g} m of the reference, "
            f"the median distance is {np.median(distance):.3g} m",
            where="icp.outlier_distance_threshold",
            remedy="raise it, or raise icp.outlier_threshold_decay_iteration to begin with a wider one",
        )

    def _in_full_coordinates(self, pose: RigidTransform) -> RigidTransform:
        return RigidTransform(pose.rotation, pose.translation + self.surface.origin - pose.rotation @ self.centroid)


def _point_step(moments: FloatArray) -> _Step:
    """Kabsch's rotation (determinant +1) and the shift that goes with it, from the pairs' p - g and d = q - p.

    With d small, everything is written in M = R - I and d: exact to the last digits where points already coincide.
    """
    count = moments[-1, -1]
    mean_p, mean_d = moments[:3, 6] / count, moments[3:6, 6] / count
    spread = moments[:3, :3] / count - np.outer(mean_p, mean_p)
    cross = moments[:3, 3:6] / count - np.outer(mean_p, mean_d)
    u, singular, vt = np.linalg.svd(spread + cross)
    if not singular[1] > ON_A_LINE * singular[0]:
        raise InputError("the pairs left within the outlier threshold lie on one line", where="icp.outlier_distance_threshold")
    rotation = vt.T @ np.diag([1.0, 1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    turn = rotation - np.eye(3)
    shift = mean_d - turn @ mean_p
    moved = float(np.trace(turn @ spread @ turn.T))
    squares = np.trace(moments[3:6, 3:6]) / count - mean_d @ mean_d + moved - 2 * np.trace(turn @ cross)
    return _Step(rotation, shift, max(float(squares), 0.0), float(np.sqrt(max(moved + mean_d @ mean_d, 0.0))))


def _least_norm(matrix: FloatArray, right: FloatArray) -> tuple[FloatArray, int]:
    """The shortest least-squares solution of a symmetric system (6, 6), and how many of its directions are undetermined.

    Eigenvectors whose eigenvalue is below `_UNDETERMINED` times the largest are left out (a pseudo-inverse).
    """
    values, vectors = np.linalg.eigh(matrix)
    kept = values > _UNDETERMINED * values[-1]
    inverse = np.divide(1.0, values, out=np.zeros(len(values)), where=kept)
    return vectors @ (inverse * (vectors.T @ right)), int(np.sum(~kept))


def _smallest(draw: FloatArray, size: int) -> NDArray[np.intp]:
    """(size,) indices of the `size` smallest numbers drawn, in increasing order of the index."""
    return np.sort(np.argpartition(draw, size - 1)[:size])


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
