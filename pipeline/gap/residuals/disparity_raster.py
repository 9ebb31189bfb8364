"""The reference as the cells of a depth map see it, so that effects that look at neighbouring cells can be predicted."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import StereoMeasurement
from pipeline.gap.residuals.nominal_pair import NominalPair, PixelGeometry, is_hidden, pixel_rays, project, real_pair
from pipeline.gap.residuals.residuals import BoolArray
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Camera
from sensors.effects.base import Effect
from sensors.effects.raster_effect import RasterEffect
from sensors.effects.smoothing import LowPass, Smoothing

MOST_CELLS, _AT_ONCE = 40_000_000, 2_000_000
"""Of a raster: the largest cameras' pixels; and of those that are cast at once."""
_SEARCHED, _BANDS, _LEAST_ROWS = 1_000_000, 4, 64
"""Cells among which a search looks, in so many bands of rows, each of so many rows at the least."""
_MARGIN = 32
"""Cells beside the outermost points: three standard deviations of the widest low-pass that is looked for."""
_BEYOND = 0.01
"""Share of a low-pass that may lie beyond what both cameras see: reached 2.3 standard deviations from a straight border."""
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
        """None where the pixels are on no raster, or on one of more than 40 million cells."""
        step = raster_cell_px(geometry.u, geometry.v)
        if step is None or raster_cell_count(geometry.u, geometry.v, step) > MOST_CELLS:
            return None
        nominal = NominalPair.of(measurement)
        real = real_pair(nominal, measurement.model.effects, measurement)
        left, right = real.left, real.right
        (columns, column), (rows, row) = (
            _axis(x, step, size) for x, size in ((geometry.u, left.width), (geometry.v, left.height))
        )
        disparity = np.full((len(rows), len(columns)), np.nan)
        only_left = np.zeros(disparity.shape, dtype=bool)
        for part in np.array_split(np.arange(len(rows)), -(-disparity.size // _AT_ONCE)):
            u, v = (x.ravel() for x in np.meshgrid(columns, rows[part]))
            ray = pixel_rays(left, u, v)
            point = left.position + measurement.scene.cast(left.position, ray)[0][:, None] * ray
            seen, hidden = np.isfinite(point).all(axis=1), is_hidden(measurement.scene, right.position, point)
            matched = seen & ~hidden & _pictured(right, point)
            found = np.full(len(u), np.nan)
            if matched.any():
                found[matched] = nominal.disparity((u[matched], v[matched]), project(right, point[matched]))
            disparity[part], only_left[part] = (x.reshape(len(part), -1) for x in (found, seen & hidden))
        if np.isnan(disparity).all():  # the cameras look past the reference
            return None
        return cls(step, disparity, only_left, row, column)

    @property
    def depth_step_px(self) -> float:
        """Difference of neighbouring cells beyond which they lie on both sides of a depth step."""
        return max(_STEEP * self.step, 1.0)

    def search_part(self) -> tuple[DisparityRaster, NDArray[np.int64]]:
        """The part among which a search looks, and the points in it: all, or of a large raster some bands of rows over all of it.

        Bands lie apart by as many empty rows as they reach beyond their points; `hidden` holds for the rows of points alone.
        """
        from scipy.ndimage import maximum_filter1d

        rows, columns = self.disparity.shape
        if rows * columns <= _SEARCHED:
            return self, np.arange(len(self.row))
        height = max(_SEARCHED // (_BANDS * columns), _LEAST_ROWS)
        first = np.linspace(0, max(rows - height, 0), _BANDS).astype(int)
        inner = np.any([(np.arange(rows) >= each) & (np.arange(rows) < each + height) for each in first], axis=0)
        kept = maximum_filter1d(inner, 2 * _MARGIN + 1, mode="constant")
        place = np.cumsum(kept) - 1 + _MARGIN * (np.cumsum(np.diff(kept, prepend=False) & kept) - 1)
        disparity = np.full((int(place[kept].max()) + 1, columns), np.nan)
        hidden = np.zeros(disparity.shape, dtype=bool)
        disparity[place[kept]], hidden[place[inner]] = self.disparity[kept], self.hidden[inner]
        points = np.flatnonzero(inner[self.row])
        return replace(self, disparity=disparity, hidden=hidden, row=place[self.row[points]], column=self.column[points]), points

    def at_points(self, raster: NDArray[Any]) -> NDArray[Any]:
        """(n,) what a raster holds at the points."""
        return np.asarray(raster[self.row, self.column])

    def near_border(self, sigma_px: float) -> BoolArray:
        """(n,) points for which a low-pass sees beyond what both cameras see of the reference, by more than a hundredth."""
        from scipy.ndimage import gaussian_filter

        inside = (~np.isnan(self.disparity) | self.hidden).astype(np.float64)
        return self.at_points(gaussian_filter(inside, sigma_px / self.step, mode="constant") < 1 - _BEYOND)

    def in_filled_occlusions(self, effects: Iterable[Effect]) -> BoolArray:
        """(n,) points in cells that the left camera alone sees, where no effect that looks at neighbours gives any."""
        return np.asarray(np.isnan(self.at_points(self.apply(effects))) & self.at_points(self.hidden))

    def copied_from_neighbour(self, found: FloatArray, tolerance: float) -> BoolArray:
        """(n,) points whose measured disparity (n,), px, is that of the cell beside them in the row, as fillings leave it."""
        cells = np.full(self.disparity.shape, np.nan)
        cells[self.row, self.column] = found
        same = np.abs(np.diff(cells, axis=1)) < tolerance
        return self.at_points(np.pad(same, ((0, 0), (1, 0))) | np.pad(same, ((0, 0), (0, 1))))

    def apply(self, effects: Iterable[Effect]) -> FloatArray:
        """(rows, columns) disparities after those of the effects that look at neighbours, px, NaN where there is no match."""
        found = self.disparity
        filters = (effect for effect in effects if isinstance(effect, RasterEffect))
        for effect in sorted(filters, key=lambda effect: (effect.stage, effect.order)):
            found = effect.filtered(found, self.step, self.depth_step_px)
        return found

    def added_by(self, effects: Iterable[Effect], disparity: FloatArray) -> FloatArray:
        """(n,) what the effects add to the disparities (n,) that the reference has at the points, px; 0 where they say none."""
        plain = self.at_points(self.disparity)
        return np.nan_to_num(self.at_points(self.apply(effects)) - np.where(np.isnan(plain), disparity, plain))


def apply_smoothing(effects: Iterable[Effect], geometry: PixelGeometry, columns: FloatArray) -> FloatArray:
    """(n, k) what small changes of the disparities (n, k) at the points are after the low-passes among the effects.

    They take the rock's relief off them, by which a move of the cameras changes each disparity. What moves outlines leaves them.
    Of thinned points the low-pass is that over their own cells.
    """
    filters, step = [effect for effect in effects if isinstance(effect, Smoothing)], raster_cell_px(geometry.u, geometry.v)
    if not filters or step is None or raster_cell_count(geometry.u, geometry.v, step) > MOST_CELLS:
        return columns
    row, column = _cell(geometry.v, step), _cell(geometry.u, step)
    matched = np.zeros((int(row.max()) + 1, int(column.max()) + 1), dtype=bool)
    matched[row, column] = np.isfinite(columns).all(axis=1)
    low_passes = [LowPass.over(matched, effect.sigma_px / step) for effect in filters]

    def passed(values: FloatArray) -> FloatArray:
        raster = np.full(matched.shape, np.nan)
        raster[row, column] = values
        for low_pass in low_passes:
            raster = low_pass.of(raster)
        return raster[row, column]

    return np.stack(map_in_threads(passed, columns.T), axis=1)


def raster_cell_count(u: FloatArray, v: FloatArray, step: float) -> int:
    """Of a raster of `step` px, from the first to the last row and column of pixels (n,)."""
    return int(np.prod([np.rint(np.ptp(x) / step) + 1 for x in (u, v)]))


def _pictured(camera: Camera, point: FloatArray) -> BoolArray:
    """(n,) whether points (n, 3) lie within a camera's picture: nothing else can be matched."""
    u, v = project(camera, point)
    with np.errstate(invalid="ignore"):
        return np.asarray((u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height))


def _axis(x: FloatArray, step: float, size: int) -> tuple[FloatArray, NDArray[np.int64]]:
    """Pixels of the rows or columns of the matcher's raster, and of each point (n,) which it is of. size: of the image, px.

    Beyond the outermost points as far as the image goes and a low-pass sees: clouds are cut, and matched before.
    """
    before, after = (int(np.clip(room // step, 0, _MARGIN)) for room in (x.min(), size - x.max()))
    cell = _cell(x, step)
    return np.asarray(x.min() + step * np.arange(-before, int(cell.max()) + 1 + after), dtype=np.float64), cell + before


def _cell(x: FloatArray, step: float) -> NDArray[np.int64]:
    """(n,) number of the row or column of each point, `step` px each, from the first."""
    return np.rint((x - x.min()) / step).astype(np.int64)


def raster_cell_px(u: FloatArray, v: FloatArray) -> float | None:
    """Side of the cells of a raster of pixels (n,), px: the less of the distances of neighbouring columns and rows."""
    steps = [step for step in (raster_spacing_px(u), raster_spacing_px(v)) if step is not None]
    return min(steps, default=None)


def raster_spacing_px(u: FloatArray) -> float | None:
    """Distance of neighbouring columns of a raster of pixels, px; also where a registration has moved them a little."""
    gaps = np.diff(np.unique(np.round(u, 3)))
    step = float(np.median(gaps)) if len(gaps) > 10 else 0.0
    steps = gaps / max(step, 1e-9)
    if step > 0.9 and np.count_nonzero(np.abs(steps - np.rint(steps)) < 0.01) > 0.99 * len(gaps):
        return step
    whole = [each for each in _STEPS if abs(np.exp(2j * np.pi * u / each).mean()) > _ON_RASTER]
    return float(max(whole)) if whole else None
