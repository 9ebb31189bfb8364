"""Estimate the noise of a point cloud without cameras from the semivariogram of its distances to the reference.

The semivariogram is half the mean squared difference of two distances whose points are h apart. It is estimated robustly, from
the median absolute difference, and fitted by

    g(h) = w + r² (4/9 - B(hx / s) B(hy / s)) + c h²

with w the variance of each point's own (white) noise, r and s the standard deviation and the node spacing of grid-correlated
noise, B the cubic B-spline, and c h² slow variation over the wall: an error of the reference, or a wrong shape of the cloud. The
direction of h is averaged over.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial import cKDTree

from pipeline.formats.measurements.measurement import SurfaceMeasurement
from pipeline.gap.residuals.alignment import align, fit_pose_robustly
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals, point_spacing_m
from pipeline.gap.thresholds import thresholds
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from sensors.models.sensor_model import StereoModel, StereoNoise
from sensors.signal_chain.node_grid import node_semivariogram

_LAGS = np.array([1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0])
"""Lags of the semivariogram, in point spacings."""
_STEPS = np.geomspace(1.5, 12.0, 13)
"""Node spacings that are tried, in point spacings."""
_SAMPLE, _FEWEST = 20_000, 200
"""Most points from which pairs start, and fewest pairs or points for an estimate."""
_NORMAL = 1.4826
"""Standard deviation over median absolute value, for a normal distribution."""
_DIRECTIONS = np.linspace(0, np.pi / 2, 8, endpoint=False)
"""Directions of h over which the semivariogram of the nodes is averaged, rad."""


@dataclass(frozen=True)
class SurfaceNoise:
    """Noise of a photogrammetric cloud's distances to a reference surface, as estimated from the cloud itself.

    Part of it is shared by neighbouring points. It is modelled by a grid on the wall with random values at its nodes, which are
    interpolated bilinearly to the points.

    Attributes
    ----------
    sigma_m : Standard deviation of each point's own (white) noise, m.
    node_sigma_m : Standard deviation of the values at the grid's nodes, m; 0 without such noise.
    step_m : Spacing of the nodes, m.
    spacing_m : Typical distance between neighbouring points of the cloud, m.
    correlated_share : Share of the variance that neighbouring points share, 0 to 1.
    """

    sigma_m: float
    node_sigma_m: float
    step_m: float
    spacing_m: float
    correlated_share: float

    @property
    def model(self) -> StereoModel:
        """Return a sensor model with this estimated noise and no systematic errors, to diagnose the cloud with it."""
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
        """One line for the terminal that states the white noise, the correlated noise and the spacing of the points, mm."""
        how = "estimated from the semivariogram of the cloud's distances to the reference"
        own = f"{how}: {1e3 * self.sigma_m:.3g} mm of white noise"
        if not self.node_sigma_m:
            return f"{own}, no grid-correlated noise (points are {1e3 * self.spacing_m:.3g} mm apart)"
        return (
            f"{own} and {1e3 * self.node_sigma_m * 2 / 3:.3g} mm of grid-correlated noise with nodes {1e3 * self.step_m:.3g} mm "
            f"apart (points: {1e3 * self.spacing_m:.3g} mm): {100 * self.correlated_share:.0f} % of the variance is correlated"
        )


def estimate_surface_noise(measurement: SurfaceMeasurement, where: str) -> SurfaceNoise:
    """Estimate the noise of a cloud from photographs by the semivariogram of its distances to the reference, after aligning it.

    It is for clouds whose noise is not known; noise that the measurement's sensor model states is ignored.

    Parameters
    ----------
    measurement : The cloud (without cameras) with its reference surface.
    where : Name of the input file or folder, for the error message.

    Raises
    ------
    InputError
        With fewer than 200 points on smooth parts of the reference.
    """
    found = align(measurement).residuals
    value = fit_pose_robustly(found)[0]
    rows = np.flatnonzero(found.usable)
    if len(rows) < _FEWEST or not isinstance(found, SurfaceResiduals):
        raise InputError(
            f"only {len(rows)} points lie on smooth parts of the reference, too few to estimate their noise",
            where=where,
            allowed=f"{_FEWEST} points or more",
            remedy="use a denser cloud, or a reference that covers the cloud",
        )  # fmt: skip
    return _fit_noise(found.geometry.point[rows], value[rows])


def _fit_noise(points: FloatArray, value: FloatArray) -> SurfaceNoise:
    """Fit the noise to distances (n,) at points (n, 3), m.

    There is grid-correlated noise only if chi² and its share of the variance justify it.
    """
    spacing = point_spacing_m(points)
    lag, gamma, weight = _semivariogram(points, value, spacing)
    root = np.sqrt(weight) / gamma  # the standard error of a variance is proportional to it
    slow = (lag / lag.max()) ** 2

    def fit(*columns: FloatArray) -> tuple[FloatArray, float]:
        """Coefficients of at least 0 of these columns and of slow variation, by weighted least squares, and chi²."""
        values, left = nnls(np.stack([*columns, slow], axis=1) * root[:, None], gamma * root)
        return values, float(left**2)

    white = np.ones(len(lag))
    without, simple = fit(white)
    fits = [(step, *fit(white, _node_semivariogram(lag / step))) for step in _STEPS]
    step, values, square = min(fits, key=lambda each: each[2])
    shared = 4 / 9 * values[1]
    improves = simple - square > 2 * thresholds().variance.least_gain
    if not improves or shared < thresholds().variance.least_excess * values[0]:
        return SurfaceNoise(float(np.sqrt(without[0])), 0.0, 0.1, spacing, 0.0)
    own = max(values[0], 1e-4 * shared)
    return SurfaceNoise(float(np.sqrt(own)), float(np.sqrt(values[1])), step * spacing, spacing, float(shared / (own + shared)))


def _node_semivariogram(lag: FloatArray) -> FloatArray:
    """(k,) semivariogram of nodes with variance 1, averaged over directions, at lags (k,) in node spacings."""
    along = np.stack([np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)], axis=1)
    return np.mean([node_semivariogram(lag[:, None] * each) for each in along], axis=0)


def _semivariogram(points: FloatArray, value: FloatArray, spacing: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lags in point spacings, semivariances, m², and effective numbers of independent differences, each (k,)."""
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
    """(k, 2) pairs of points whose distance is between `low` and `high`, m; at most one for each of the points `start`."""
    angle = 2.399963 * np.arange(len(start))  # the golden angle, so that all directions are equally frequent
    # the other point of a pair is the one nearest to a place at the wanted distance
    towards = 0.5 * (low + high) * np.stack([np.cos(angle), np.sin(angle), np.zeros(len(start))], axis=1)
    other = tree.query(points[start] + towards, workers=-1)[1]
    away = np.linalg.norm(points[other] - points[start], axis=1)
    kept = (away >= low) & (away <= high) & (other != start)
    return np.stack([start[kept], other[kept]], axis=1)


def _rounded(value: float) -> float:
    """Round to three significant digits."""
    return float(f"{value:.3g}")
