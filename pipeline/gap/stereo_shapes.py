"""Effects on the shape of a disparity map at depth steps: outlines that grow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.cells import patches
from pipeline.gap.measurement import Measurement
from pipeline.gap.residuals import BoolArray, Residuals
from pipeline.gap.stereo_residuals import NominalPair, StereoGeometry, project, rays
from scene.mesh import FloatArray
from sensors.effects.edge_fattening import fattened

_RADII = (1, 2, 3, 4, 5, 6, 8)
_HIDDEN_SHARE = 0.002
"""A point is hidden where another surface stands before it by this share of its distance."""
_CLEAR = 3.0
"""Predicted sigmas by which an effect must move a point for it to bear witness."""
_LEAST_GAIN, _BLOCK_SIGMAS = 20.0, 4.0
_STRAY = 1e-3
_SLACK = 0.15
"""Share of a depth step by which its height on the reference may be off."""
_MOST_CELLS = 1_000_000
_STEPS, _ON_RASTER = range(2, 33), 0.5
_STEEP = 0.3
"""Disparity per pixel along the image beyond which neighbouring cells lie on both sides of a depth step."""


@dataclass(frozen=True)
class ShapeFound:
    """An effect at depth steps. touched: (n,) points that it may move."""

    name: str
    parameters: dict[str, float]
    std: dict[str, float]
    gain: float
    p_value: float
    touched: BoolArray


@dataclass(frozen=True)
class DisparityRaster:
    """The reference as the depth map's cells see it. step: px per cell; disparity: (rows, columns) px, NaN where no match can be;
    row, column: (n,) cell of each point."""

    step: float
    disparity: FloatArray
    row: NDArray[np.int64]
    column: NDArray[np.int64]

    @classmethod
    def of(cls, measurement: Measurement, geometry: StereoGeometry) -> DisparityRaster | None:
        """None where the pixels are on no raster."""
        step = _spacing(geometry.u)
        if step is None:
            return None
        nominal = NominalPair.of(measurement)
        low = geometry.u.min(), geometry.v.min()
        column, row = (np.rint((x - x0) / step).astype(np.int64) for x, x0 in zip((geometry.u, geometry.v), low, strict=True))
        shape = int(row.max()) + 1, int(column.max()) + 1
        if np.prod(shape) > _MOST_CELLS:
            return None
        rows, columns = np.indices(shape)
        u, v = low[0] + step * columns.ravel(), low[1] + step * rows.ravel()
        left, right = nominal.pair.left, nominal.pair.right
        ray = rays(left, u, v)
        point = left.position + measurement.scene.cast(left.position, ray)[0][:, None] * ray
        seen = np.asarray(np.isfinite(point).all(axis=1))
        there = np.where(seen[:, None], point, 0.0)
        back = there - right.position
        length = np.linalg.norm(back, axis=1)
        first = measurement.scene.cast(right.position, back / length[:, None])[0]
        hidden = seen & (first < length * (1 - _HIDDEN_SHARE))
        disparity = np.where(seen & ~hidden, nominal.disparity((u, v), project(right, there)), np.nan)
        return cls(step, disparity.reshape(shape), row, column)

    def at_points(self, raster: FloatArray) -> FloatArray:
        """(n,) what a raster holds at the points."""
        return np.asarray(raster[self.row, self.column])


def _spacing(u: FloatArray) -> float | None:
    """Distance of neighbouring columns of a raster of pixels, px; also where a registration has moved them a little."""
    gaps = np.diff(np.unique(np.round(u, 3)))
    step = float(np.median(gaps)) if len(gaps) > 10 else 0.0
    steps = gaps / max(step, 1e-9)
    if step > 0.9 and np.count_nonzero(np.abs(steps - np.rint(steps)) < 0.01) > 0.99 * len(gaps):
        return step
    whole = [each for each in _STEPS if abs(np.exp(2j * np.pi * u / each).mean()) > _ON_RASTER]
    return float(max(whole)) if whole else None


def find_shapes(measurement: Measurement, residuals: Residuals, rough: FloatArray, scale: float) -> list[ShapeFound]:
    """Outlines that grow. rough: (n,) registered residuals, px; scale: sigmas that they spread."""
    raster = DisparityRaster.of(measurement, residuals.geometry)
    if raster is None:
        return []
    found = _fattening(raster, residuals, rough, scale)
    return [] if found is None else [found]


def _fattening(raster: DisparityRaster, residuals: Residuals, rough: FloatArray, scale: float) -> ShapeFound | None:
    sigma = scale * residuals.sigma
    block = patches(residuals.at, 100.0)
    best: tuple[float, int, FloatArray, FloatArray] | None = None
    for radius in _RADII:
        moved = raster.at_points(_grown(raster, radius)) - raster.at_points(raster.disparity)
        moved = np.where(np.nan_to_num(moved) > _CLEAR * sigma, np.nan_to_num(moved), 0.0)
        gains = np.where(
            moved > 0, _log_density(rough - moved, np.hypot(sigma, _SLACK * moved)) - _log_density(rough, sigma), 0.0
        )
        if best is None or gains.sum() > best[0]:
            best = float(gains.sum()), radius, gains, moved
    assert best is not None
    total, radius, gains, _ = best
    sums = np.asarray(np.bincount(block, gains))
    sigmas = total / max(float(np.linalg.norm(sums)), 1e-12)
    if total < _LEAST_GAIN or sigmas < _BLOCK_SIGMAS:
        return None
    wider = raster.at_points(_grown(raster, radius + 2)) - raster.at_points(raster.disparity)
    # radii are whole cells: any between this one and the next does the same
    parameters, std = {"radius_px": (radius + 0.5) * raster.step}, {"radius_px": raster.step / np.sqrt(12)}
    p_value = max(float(np.exp(-(sigmas**2) / 2)), 1 / 2000)
    return ShapeFound("edge_fattening", parameters, std, total, p_value, np.nan_to_num(wider) > 0)


def _grown(raster: DisparityRaster, radius: int) -> FloatArray:
    return np.asarray(fattened(raster.disparity, radius, max(_STEEP * raster.step, 1.0)))


def _log_density(value: FloatArray, sigma: FloatArray) -> FloatArray:
    return np.asarray(np.log(np.exp(-0.5 * (value / sigma) ** 2) / sigma + _STRAY))
