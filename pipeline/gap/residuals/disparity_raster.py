"""The reference as the cells of a depth map see it, so that effects that look at neighbouring cells can be predicted."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurement import StereoMeasurement
from pipeline.gap.residuals.nominal_pair import NominalPair, PixelGeometry, is_hidden, project, rays, real_pair
from pipeline.gap.residuals.residuals import BoolArray
from scene.mesh import FloatArray
from sensors.effects.base import Effect
from sensors.effects.raster_effect import RasterEffect

_MOST_CELLS = 1_000_000
_STEPS, _ON_RASTER = range(2, 33), 0.5
_STEEP = 0.3
"""Disparity per pixel along the image beyond which neighbouring cells lie on both sides of a depth step."""


@dataclass(frozen=True)
class DisparityRaster:
    """step: px per cell; disparity: (rows, columns) of the reference, px, NaN where no match can be; hidden: (rows, columns)
    where the left camera sees the reference and the right one does not; row, column: (n,) cell of each point."""

    step: float
    disparity: FloatArray
    hidden: BoolArray
    row: NDArray[np.int64]
    column: NDArray[np.int64]

    @classmethod
    def of(cls, measurement: StereoMeasurement, geometry: PixelGeometry) -> DisparityRaster | None:
        """None where the pixels are on no raster, or on one of more than a million cells."""
        step = spacing(geometry.u)
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
        real = real_pair(nominal, measurement.model.effects, measurement)
        left, right = real.left, real.right
        ray = rays(left, u, v)
        point = left.position + measurement.scene.cast(left.position, ray)[0][:, None] * ray
        seen, hidden = np.isfinite(point).all(axis=1), is_hidden(measurement.scene, right.position, point)
        matched = seen & ~hidden
        if not matched.any():  # the cameras look past the reference
            return None
        disparity = np.full(len(u), np.nan)
        disparity[matched] = nominal.disparity((u[matched], v[matched]), project(right, point[matched]))
        return cls(step, disparity.reshape(shape), (seen & hidden).reshape(shape), row, column)

    @property
    def jump_px(self) -> float:
        """Difference of neighbouring cells beyond which they lie on both sides of a depth step."""
        return max(_STEEP * self.step, 1.0)

    def at_points(self, raster: NDArray[Any]) -> NDArray[Any]:
        """(n,) what a raster holds at the points."""
        return np.asarray(raster[self.row, self.column])

    def after(self, effects: Iterable[Effect]) -> FloatArray:
        """(rows, columns) disparities after those of the effects that look at neighbours, px, NaN where there is no match."""
        found = self.disparity
        filters = (effect for effect in effects if isinstance(effect, RasterEffect))
        for effect in sorted(filters, key=lambda effect: (effect.stage, effect.order)):
            found = effect.filtered(found, self.step, self.jump_px)
        return found

    def moved(self, effects: Iterable[Effect], disparity: FloatArray) -> FloatArray:
        """(n,) what the effects add to the disparities (n,) that the reference has at the points, px; 0 where they say none."""
        plain = self.at_points(self.disparity)
        return np.nan_to_num(self.at_points(self.after(effects)) - np.where(np.isnan(plain), disparity, plain))


def spacing(u: FloatArray) -> float | None:
    """Distance of neighbouring columns of a raster of pixels, px; also where a registration has moved them a little."""
    gaps = np.diff(np.unique(np.round(u, 3)))
    step = float(np.median(gaps)) if len(gaps) > 10 else 0.0
    steps = gaps / max(step, 1e-9)
    if step > 0.9 and np.count_nonzero(np.abs(steps - np.rint(steps)) < 0.01) > 0.99 * len(gaps):
        return step
    whole = [each for each in _STEPS if abs(np.exp(2j * np.pi * u / each).mean()) > _ON_RASTER]
    return float(max(whole)) if whole else None
