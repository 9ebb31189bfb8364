"""Register an epoch's points to the reference surface by the iterative closest point algorithm (ICP).

Every iteration pairs each moving point p (at its current pose) with its nearest reference point q (normal n). It then takes the
step, a rotation R = exp(w) about the moving points' centroid g and a shift t, that minimises the mean square of the residuals r:

    point_to_plane   r = n . (p + w x (p - g) + t - q)      Chen and Medioni (1992), linearised as Low (2004), equations 3 to 8
    point_to_point   r = R (p - g) + g + t - q              Besl and McKay (1992), R by the SVD of Kabsch (1976), no reflections

Poses are updated with the exact exponential map, so they remain rigid despite the linearisation. The result maps moving to
reference coordinates, x_reference = R x_moving + t. The search starts with a random subsample and ends with all points (coarse to
fine).

Limits: an initial offset larger than the width of the wall's features may end in a wrong minimum. A shift along a smooth wall is
determined only by its roughness. Normals that were estimated from noise seem to determine a motion but do not.
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
    ReferenceSurface,
    centroid_of,
    checked_cloud,
    scan_order,
)
from pipeline.registration.pairs import Map, NearestPairs, Part, parts_of
from pipeline.registration.rigid import RigidTransform
from pipeline.registration.steps import plane_step, point_step
from scene.common.config import Config
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.common.threads import executor
from scene.geometry.mesh import FloatArray

_LEVELS = (2**13, 2**17)
"""Sizes of the random subsamples used before all points; each is used if there are at least four times as many points."""


class IcpConfig(Config):
    """Settings of the iterative closest point algorithm (ICP), which moves one point cloud onto another.

    `threshold` and `delta_threshold` both end the search, whichever is met first. `threshold` applies to the error of the fit.
    Near the minimum this changes with the square of the motion, so it tells when further iterations no longer pay.
    `delta_threshold` applies to the change of the points' residuals in the last step. This is proportional to the motion, so it
    tells when the pose is stationary. Neither is checked before the outlier threshold has reached its final value. The error
    counts outliers at the outlier threshold, because the RMS of the inliers alone stays constant, or rises, when a better pose
    turns outliers into inliers.
    """

    method: Literal["point_to_plane", "point_to_point"] = Field(
        "point_to_plane", description="distance that is minimised: along the reference's normals, or between the points"
    )
    max_iteration: int = Field(100, ge=1, description="most iterations, converged or not; the last one uses all points")
    outlier_distance_threshold: float = Field(
        0.1,
        gt=0,
        description="m; a point farther than this from its nearest reference point is an outlier. "
        "Use at least three sigma of the noise, and the reference's point spacing",
    )
    outlier_threshold_decay_iteration: int = Field(
        5,
        ge=1,
        le=100,
        description="iteration k from which outlier_distance_threshold T applies; at iteration i before it, T 2^(k - i) does. "
        "1: T from the first iteration",
    )
    remove_outlier: bool = Field(True, description="exclude outliers from the fit; false: every point is used")
    threshold: float = Field(
        1e-8,
        ge=0,
        description="m; converged when the RMS error (outliers counted at the outlier threshold) changed by less than this from "
        "one iteration to the next. 0: never",
    )
    delta_threshold: float = Field(
        1e-4,
        ge=0,
        description="m; converged when a step changed the points' residuals by less than this (RMS over the points). 0: never",
    )
    subsample_points: bool = Field(False, description="fit a random subsample of the moving points")
    subsample_ratio: float = Field(0.9, ge=0, lt=1, description="share of the moving points that subsampling leaves out")

    def outlier_threshold_m(self, iteration: int) -> float:
        """Return the distance, m, beyond which ICP ignores pairs of points in an iteration: T 2^max(k - i, 0).

        T is `outlier_distance_threshold`, k is `outlier_threshold_decay_iteration`, and i is `iteration`, counted from 1. Without
        outlier removal the distance is infinite.
        """
        if not self.remove_outlier:
            return float("inf")
        return self.outlier_distance_threshold * 2.0 ** max(self.outlier_threshold_decay_iteration - iteration, 0)


@dataclass(frozen=True)
class IcpIteration:
    """Record one iteration of ICP (iterative closest point): the pairs of points that it found, and the step that it took.

    Attributes
    ----------
    points, inliers : int
        Number of moving points in use, and of those closer to the reference than the outlier threshold.
    outlier_threshold_m : float
        Outlier threshold of this iteration, m.
    rms_m : float
        RMS of the inliers' residuals after the step, with the pairs found before it, m (point_to_plane: to first order in
        the rotation).
    error_m : float
        RMS of the residuals of all points in use, where an outlier counts with the outlier threshold as its residual, m.
    residual_change_m : float
        RMS over the inliers of the change of their residuals in the step, m.
    step_m : float
        RMS over all points of the distance that the step moved them, m.
    undetermined : int
        How many of the six components of the motion were not estimated, because the surface does not determine them.
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
        """Return the record of an ICP iteration as a dictionary for JSON; an infinite outlier threshold becomes null."""
        values = dataclasses.asdict(self)
        return values | {"outlier_threshold_m": _finite(self.outlier_threshold_m)}


@dataclass(frozen=True)
class Registration:
    """Store the result of a registration by ICP: the transform x_reference = R x_moving + t, and how it was found.

    Attributes
    ----------
    transform : RigidTransform
        Rotation R and translation t from moving to reference coordinates.
    converged, reason : bool, str
        Whether a convergence threshold was met, and why the search stopped, in words.
    history : tuple of IcpIteration
        All iterations in order.
    """

    transform: RigidTransform
    converged: bool
    reason: str
    history: tuple[IcpIteration, ...]

    @property
    def rotation(self) -> FloatArray:
        """Rotation matrix R (3, 3) of the registration, from moving to reference coordinates."""
        return self.transform.rotation

    @property
    def translation(self) -> FloatArray:
        """Translation t (3,) of the registration in x_reference = R x_moving + t, m."""
        return self.transform.translation

    @property
    def iterations(self) -> int:
        """Number of iterations of the registration."""
        return len(self.history)

    @property
    def rms_m(self) -> float:
        """RMS of the inliers' residuals in the last iteration of the registration, m."""
        return self.history[-1].rms_m

    @property
    def points(self) -> int:
        """Number of moving points in use in the last iteration of the registration."""
        return self.history[-1].points

    @property
    def inliers(self) -> int:
        """Number of moving points within the outlier threshold in the last iteration of the registration."""
        return self.history[-1].inliers

    @property
    def undetermined(self) -> int:
        """How many of the six components of the registration's motion the surface does not determine.

        It is 0 for a rough wall, and 3 for a plane if point-to-plane distances are minimised.
        """
        return self.history[-1].undetermined

    def apply(self, points: FloatArray) -> FloatArray:
        """Transform points (..., 3) of the moving cloud to reference coordinates by the registration, m."""
        return self.transform.apply(points)

    def to_dict(self) -> dict[str, Any]:
        """Return the registration's transform, its outcome and all iterations as a dictionary for JSON."""
        names = ("rms_m", "iterations", "points", "inliers", "undetermined", "converged", "reason")
        return (
            self.transform.to_dict()
            | {name: getattr(self, name) for name in names}
            | {"history": [record.to_dict() for record in self.history]}
        )

    def summary(self) -> str:
        """Describe the registration on one line for the terminal: residuals, inliers and iterations."""
        end = "converged" if self.converged else "not converged"
        return (
            f"{end} after {self.iterations} iterations ({self.reason}), RMS {self.rms_m * 1e3:.2f} mm, "
            f"{self.inliers:,} of {self.points:,} points within the outlier threshold"
        )


@dataclass(frozen=True)
class FitQuality:
    """Store how well points fit a reference surface without being moved.

    Attributes
    ----------
    points, inliers : int
        Number of points, and of those closer to the reference than the outlier threshold.
    rms_m : float
        RMS of the inliers' distances from the reference, m; NaN if there are none.
    """

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
    """Find the rigid transform that brings a cloud to a reference cloud, by the iterative closest point algorithm (ICP).

    Parameters
    ----------
    moving, reference : (n, 3) and (m, 3) arrays
        Points in the same frame, roughly aligned, m, without NaN.
    reference_normals : (m, 3) array or None
        Normals of the reference points, of any length and sign; may be None if `config.method` is point_to_point.
    config : IcpConfig
        Settings of the algorithm.
    random : KeyedRandom
        Source of random numbers for the subsamples of the moving points.
    threads : int, optional
        Number of threads, by default one per core. It does not affect the result.

    Raises
    ------
    InputError
        If there are fewer than six points, values that are not finite, points on one line, or fewer than six pairs within the
        outlier threshold.
    """
    if threads == 1:
        return register_to(ReferenceSurface.build(reference, reference_normals), moving, config, random, threads=1)
    with executor(threads) as pool:
        surface = pool.submit(ReferenceSurface.build, reference, reference_normals)
        cloud = _MovingCloud(moving, config, random)
        return _Alignment(surface.result(), cloud, config, pool.map).run()


def register_to(
    surface: ReferenceSurface, moving: FloatArray, config: IcpConfig, random: KeyedRandom, *, threads: int | None = None
) -> Registration:
    """Find the rigid transform that brings a cloud to a reference whose search tree exists already, by ICP.

    It saves time over `register` when many clouds are registered to one reference, and raises InputError as that does.

    Parameters
    ----------
    surface : ReferenceSurface
        The reference points with their search tree, and with normals if `config.method` is point_to_plane.
    moving : (n, 3) array
        Points in the frame of the reference, roughly aligned, m, without NaN.
    config : IcpConfig
        Settings of the algorithm.
    random : KeyedRandom
        Source of random numbers for the subsamples of the moving points.
    threads : int, optional
        Number of threads, by default one per core. It does not affect the result.
    """
    cloud = _MovingCloud(moving, config, random)
    if threads == 1:  # a pool would only add overhead
        return _Alignment(surface, cloud, config, map).run()
    with executor(threads) as pool:
        return _Alignment(surface, cloud, config, pool.map).run()


def measure_fit(surface: ReferenceSurface, points: FloatArray, config: IcpConfig, *, threads: int | None = None) -> FitQuality:
    """Measure how well points fit a reference surface without moving them.

    Parameters
    ----------
    surface : ReferenceSurface
        The reference points with their search tree.
    points : (n, 3) array
        Points in the frame of the reference, m.
    config : IcpConfig
        Its `method` says whether distances are from points or tangent planes. Points farther than its final outlier threshold
        are not inliers.
    threads : int, optional
        Number of threads, by default one per core. It does not affect the result.
    """
    normals = _normals(surface, config)
    local = checked_cloud(points, "points") - surface.origin
    gate = config.outlier_threshold_m(config.outlier_threshold_decay_iteration)
    with executor(threads) as pool:
        pairs = NearestPairs(surface, local[scan_order(local)])
        moments = pairs.moments(parts_of(len(local)), RigidTransform.identity(), gate, 1, normals, pool.map)
    squares = np.trace(moments[3:6, 3:6]) if normals is None else moments[6, 6]
    inliers = int(moments[-1, -1])
    return FitQuality(len(local), inliers, float(np.sqrt(squares / inliers)) if inliers else float("nan"))


def _normals(surface: ReferenceSurface, config: IcpConfig) -> FloatArray | None:
    """Return the normals that the method needs: those of the reference, or None for point_to_point."""
    if config.method == "point_to_point":
        return None
    if surface.normals is None:
        raise InputError(
            "point_to_plane needs the reference's normals", where="icp.method", remedy="give normals, or use point_to_point"
        )
    return surface.normals


@dataclass(frozen=True)
class _Level:
    """A random subsample of the moving points, or all of them: their number, and their indices in parts."""

    points: int
    parts: list[Part]


class _MovingCloud:
    """Moving points relative to their centroid, in an order that is fast to search, with nested subsamples."""

    def __init__(self, moving: FloatArray, config: IcpConfig, random: KeyedRandom) -> None:
        moving = checked_cloud(moving, "moving points")
        self.centroid = centroid_of(moving)
        self.points = moving[scan_order(moving)] - self.centroid
        self.covariance = np.einsum("ni,nj->ij", self.points, self.points) / len(self.points)
        self.radius = float(np.sqrt(np.trace(self.covariance)))
        self.levels = self._levels(config, random)

    def _levels(self, config: IcpConfig, random: KeyedRandom) -> list[_Level]:
        """Return nested random subsamples; the last one is all points in use."""
        total = len(self.points)
        used = round(total * (1 - config.subsample_ratio)) if config.subsample_points else total
        if used < LEAST_POINTS:
            raise InputError(
                f"the subsample would leave only {used} of {total:,} points",
                where="icp.subsample_ratio",
                allowed=f"at most {1 - LEAST_POINTS / total:.6g}",
                remedy="lower icp.subsample_ratio, the share of points that is left out",
            )
        draw = random.generator().random(total)
        sizes = [size for size in _LEVELS if 4 * size <= used] + [used]
        return [_Level(size, parts_of(total if size == total else _smallest(draw, size))) for size in sizes]


class _Alignment:
    """One registration of a moving cloud to a reference surface, coarse to fine."""

    def __init__(self, surface: ReferenceSurface, cloud: _MovingCloud, config: IcpConfig, map_blocks: Map) -> None:
        self.surface, self.normals = surface, _normals(surface, config)
        self.cloud, self.config, self.map_blocks = cloud, config, map_blocks
        self.pairs = NearestPairs(surface, cloud.points)

    def run(self) -> Registration:
        """Iterate on each subsample until it converges, and on all points until the end."""
        levels = self.cloud.levels
        pose = RigidTransform(np.eye(3), self.cloud.centroid - self.surface.origin)
        history: list[IcpIteration] = []
        level, reason = 0, ""
        for iteration in range(1, self.config.max_iteration + 1):
            if iteration == self.config.max_iteration:
                level = len(levels) - 1
            first = not history or history[-1].points != levels[level].points
            neighbours = 1 if first and level == len(levels) - 1 else 2  # one iteration with all points often suffices
            pose, record = self._iterate(levels[level], pose, self.config.outlier_threshold_m(iteration), neighbours)
            history.append(record)
            reason = self._stop_reason(history)
            if reason and level == len(levels) - 1:
                break
            level += bool(reason)
        converged = bool(reason)
        reason = reason or f"max_iteration = {self.config.max_iteration} reached"
        return Registration(self._in_full_coordinates(pose), converged, reason, tuple(history))

    def _iterate(self, level: _Level, pose: RigidTransform, gate: float, neighbours: int) -> tuple[RigidTransform, IcpIteration]:
        """Take one iteration: pair the points, solve for the step, and return the next pose and its record."""
        moments = self.pairs.moments(level.parts, pose, gate, neighbours, self.normals, self.map_blocks)
        points, inliers = level.points, int(moments[-1, -1])
        if inliers < LEAST_POINTS:
            raise self._too_few(level, pose, gate, inliers)
        step = point_step(moments) if self.normals is None else plane_step(moments, self.cloud.radius)
        outliers = points - inliers
        squares = step.mean_squares * inliers + (outliers * gate**2 if outliers else 0.0)
        turn = (step.rotation - np.eye(3)) @ pose.rotation
        moved = np.trace(turn @ self.cloud.covariance @ turn.T) + step.shift @ step.shift
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

    def _stop_reason(self, history: list[IcpIteration]) -> str:
        """Return why the present subsample has converged, in words; "" if it has not."""
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

    def _too_few(self, level: _Level, pose: RigidTransform, gate: float, inliers: int) -> InputError:
        """Make the error for too few pairs within the outlier threshold."""
        median_m = np.median(self.surface.tree.query(pose.apply(self.cloud.points[level.parts[0]]), 1)[0])
        return InputError(
            f"only {inliers} of {level.points:,} points lie within {gate:g} m of the reference; "
            f"the median distance is {median_m:.3g} m",
            where="icp.outlier_distance_threshold",
            remedy=f"raise this threshold above {median_m:.3g} m, or raise icp.outlier_threshold_decay_iteration to begin wider",
        )

    def _in_full_coordinates(self, pose: RigidTransform) -> RigidTransform:
        """Convert a pose between local coordinates to full coordinates."""
        return RigidTransform(pose.rotation, pose.translation + self.surface.origin - pose.rotation @ self.cloud.centroid)


def _smallest(draw: FloatArray, size: int) -> NDArray[np.intp]:
    """Return the indices (size,) of the smallest numbers drawn, in ascending order."""
    return np.sort(np.argpartition(draw, size - 1)[:size])


def _finite(value: float) -> float | None:
    """Return None for an infinite value, which JSON cannot hold."""
    return value if np.isfinite(value) else None
