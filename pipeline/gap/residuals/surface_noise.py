"""The noise of a cloud, from the cloud itself: how its distances from the reference differ between neighbours.

Half the mean squared difference of two points h apart (the semivariogram), from the median absolute one so that outliers do not
count, is

    g(h) = w + r^2 (4/9 - B(hx / s) B(hy / s)) + c h^2

w the variance of each point's own noise, r and s the standard deviation and the step of nodes whose values neighbours share, B
the cubic B-spline, and c h^2 what changes slowly over the wall: an error of the reference, a wrong shape of the cloud. The
direction of h is averaged over.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial import cKDTree

from pipeline.formats.measurements.measurement import SurfaceMeasurement
from pipeline.gap.decisions import decided
from pipeline.gap.residuals.alignment import align, fit_pose_robustly
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals, point_spacing_m
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from sensors.models.sensor_model import StereoModel, StereoNoise
from sensors.signal_chain.node_grid import node_semivariogram

_LAGS = np.array([1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0])
"""Of points, in spacings."""
_STEPS = np.geomspace(1.5, 12.0, 13)
"""Of nodes, in spacings."""
_SAMPLE, _FEWEST = 20_000, 200
_NORMAL = 1.4826
_DIRECTIONS = np.linspace(0, np.pi / 2, 8, endpoint=False)


@dataclass(frozen=True)
class SurfaceNoise:
    """Standard deviations in metres of each point's own noise, and at nodes `step_m` apart that neighbours share; spacing_m: of
    the points; share: of the variance that neighbours share."""

    sigma_m: float
    node_sigma_m: float
    step_m: float
    spacing_m: float
    correlated_share: float

    @property
    def model(self) -> StereoModel:
        """A model with this noise and nothing else."""
        return StereoModel(
            noise=StereoNoise(
                parallax_sigma_px=0.0,
                regularization_sigma_px=0.0,
                point_sigma_m=_rounded(self.sigma_m),
                point_shared_sigma_m=_rounded(self.node_sigma_m),
                point_shared_step_m=_rounded(self.step_m),
            )
        )

    @property
    def summary(self) -> str:
        """Size and correlation, in a line."""
        how = "estimated from how the cloud's distances from the reference differ between neighbours"
        own = f"{how}: {1e3 * self.sigma_m:.3g} mm of each point"
        if not self.node_sigma_m:
            return f"{own}, nothing that neighbours share ({1e3 * self.spacing_m:.3g} mm apart)"
        return (
            f"{own} and {1e3 * self.node_sigma_m * 2 / 3:.3g} mm that neighbours share over {1e3 * self.step_m:.3g} mm "
            f"({1e3 * self.spacing_m:.3g} mm apart): {100 * self.correlated_share:.0f} % of the variance"
        )


def estimate_surface_noise(measurement: SurfaceMeasurement, where: str) -> SurfaceNoise:
    """The noise of a cloud's points, registered first; whatever its model says. Raises InputError for too few points."""
    found = align(measurement).residuals
    value = fit_pose_robustly(found)[0]
    rows = np.flatnonzero(found.usable)
    if len(rows) < _FEWEST or not isinstance(found, SurfaceResiduals):
        raise InputError(
            f"{len(rows)} points on smooth parts of the reference", where=where, allowed=f"{_FEWEST} and more",
            remedy="give a denser cloud, or a reference that is as wide as it",
        )  # fmt: skip
    return _fitted(found.geometry.point[rows], value[rows])


def _fitted(points: FloatArray, value: FloatArray) -> SurfaceNoise:
    """Of distances (n,) at points (n, 3), m."""
    spacing = point_spacing_m(points)
    lag, gamma, weight = _semivariogram(points, value, spacing)
    root = np.sqrt(weight) / gamma  # the error of a variance is in proportion to it
    slow = (lag / lag.max()) ** 2
    best = None
    plain = _solved(np.stack([np.ones(len(lag)), slow], axis=1), gamma, root)
    for step in _STEPS:
        form = np.stack([np.ones(len(lag)), _nodes(lag / step), slow], axis=1)
        found = _solved(form, gamma, root)
        if best is None or found[1] < best[1][1]:
            best = step, found
    step, (values, square) = best if best is not None else (1.0, plain)
    shared = 4 / 9 * values[1]
    gains = plain[1] - square > decided().nodes.least_gain
    if not gains or shared < decided().spread.least_excess * values[0]:
        return SurfaceNoise(float(np.sqrt(plain[0][0])), 0.0, 0.1, spacing, 0.0)
    own = max(values[0], 1e-4 * shared)
    return SurfaceNoise(float(np.sqrt(own)), float(np.sqrt(values[1])), step * spacing, spacing, float(shared / (own + shared)))


def _solved(form: FloatArray, gamma: FloatArray, root: FloatArray) -> tuple[FloatArray, float]:
    """Values at least 0, and chi^2."""
    values, left = nnls(form * root[:, None], gamma * root)
    return values, float(left**2)


def _nodes(lag: FloatArray) -> FloatArray:
    """(k,) semivariogram of nodes of variance 1 at lags in steps, the mean over directions."""
    return np.mean(
        [node_semivariogram(np.stack([lag * np.cos(angle), lag * np.sin(angle)], axis=1)) for angle in _DIRECTIONS], axis=0
    )


def _semivariogram(points: FloatArray, value: FloatArray, spacing: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lags in spacings, half the mean squared differences, m2, and how many differences count as independent, (k,) each."""
    tree = cKDTree(points)
    start = np.arange(0, len(points), max(len(points) // _SAMPLE, 1), dtype=np.int64)
    found = []
    for lag in _LAGS:
        low, high = (lag - 0.25) * spacing, (lag + 0.25) * spacing if lag < 4 else 1.1 * lag * spacing
        pairs = _pairs(tree, points, start, max(low, 1e-12), high)
        if len(pairs) >= _FEWEST:
            off = value[pairs[:, 0]] - value[pairs[:, 1]]
            away = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
            found.append((float(away.mean()) / spacing, 0.5 * (_NORMAL * float(np.median(np.abs(off)))) ** 2, len(pairs) / 6))
    lag, gamma, weight = (np.array(column) for column in zip(*found, strict=True))
    return lag, np.maximum(gamma, 1e-18), weight


def _pairs(tree: cKDTree, points: FloatArray, start: NDArray[np.int64], low: float, high: float) -> NDArray[np.int64]:
    """(k, 2) numbers of pairs of points between two distances, one for each of `start` that has one."""
    angle = 2.399963 * np.arange(len(start))  # the golden angle: all directions alike
    # towards any direction in the tangent plane the nearest point to that place
    towards = 0.5 * (low + high) * np.stack([np.cos(angle), np.sin(angle), np.zeros(len(start))], axis=1)
    other = tree.query(points[start] + towards, workers=-1)[1]
    away = np.linalg.norm(points[other] - points[start], axis=1)
    kept = (away >= low) & (away <= high) & (other != start)
    return np.stack([start[kept], other[kept]], axis=1)


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")
