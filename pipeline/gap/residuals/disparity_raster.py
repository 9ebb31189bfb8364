"""Represent the reference as a disparity raster, so that effects that use neighbouring pixels can be predicted."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter1d

from pipeline.formats.measurements.measurement import StereoMeasurement
from pipeline.gap.residuals.nominal_pair import NominalPair, PixelGeometry, is_hidden, pixel_rays, project, real_pair
from pipeline.gap.residuals.residuals import BoolArray
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Camera
from sensors.effects.base import Effect
from sensors.effects.edge_fattening import EdgeFattening, FatteningTrials
from sensors.effects.raster_effect import RasterEffect
from sensors.effects.smoothing import LowPass, Smoothing

MOST_CELLS, _AT_ONCE = 40_000_000, 2_000_000
"""Most cells of a raster (as many as the largest cameras have pixels), and how many of them are traced at once."""
_SEARCHED, _BANDS, _LEAST_ROWS = 400_000, 4, 64
"""Most cells among which edge effects are searched; a larger raster is searched in this many bands of at least so many rows."""
_MARGIN = 32
"""Cells beyond the outermost points: three standard deviations of the widest low-pass filter that is searched for."""
_BEYOND = 0.01
"""Share of a low-pass filter's weight that may lie outside the area that both cameras see. It is reached 2.3 standard deviations
from a straight border.
"""
_STEPS, _ON_RASTER = range(2, 33), 0.5
"""Spacings of a raster that are tried, px, and how coherent the pixels' phases must be for one to count."""
_STEEP = 0.3
"""Change of disparity per pixel above which neighbouring cells lie on both sides of a depth step."""


@dataclass(frozen=True)
class DisparityRaster:
    """Disparities of the reference surface on the raster of pixels at which a stereo matcher measured.

    It is used to predict errors in which a pixel is affected by its neighbours: edge fattening, smoothing and filled
    occlusions. Such errors cannot be predicted from scattered points.

    Attributes
    ----------
    step : Spacing of the raster's cells, px of the left image.
    disparity : (rows, columns) disparity of the reference, px; NaN where nothing can be matched.
    hidden : (rows, columns) true where the left camera sees the reference and the right one does not (an occlusion).
    row, column : (n,) row and column of the cell in which each measured point lies.
    """

    step: float
    disparity: FloatArray
    hidden: BoolArray
    row: NDArray[np.int64]
    column: NDArray[np.int64]

    @classmethod
    def of(cls, measurement: StereoMeasurement, geometry: PixelGeometry) -> DisparityRaster | None:
        """Compute the disparities of the reference surface on the pixel raster of a measured stereo pair.

        geometry: the matched pixels of its n points, which determine the spacing of the raster. Returns None if the pixels lie on
        no raster, if it has more than 40 million cells, or if the cameras miss the reference.
        """
        step = raster_cell_px(geometry.u, geometry.v)
        if step is None or raster_cell_count(geometry.u, geometry.v, step) > MOST_CELLS:
            return None
        nominal = NominalPair.of(measurement)
        real = real_pair(measurement.model.effects, measurement)
        left, right = real.left, real.right
        (columns, column), (rows, row) = (
            _raster_axis(x, step, size) for x, size in ((geometry.u, left.width), (geometry.v, left.height))
        )
        disparity = np.full((len(rows), len(columns)), np.nan)
        only_left = np.zeros(disparity.shape, dtype=bool)
        for part in np.array_split(np.arange(len(rows)), -(-disparity.size // _AT_ONCE)):
            u, v = (x.ravel() for x in np.meshgrid(columns, rows[part]))
            ray = pixel_rays(left, u, v)
            point = left.position + measurement.scene.cast(left.position, ray)[0][:, None] * ray
            seen, hidden = np.isfinite(point).all(axis=1), is_hidden(measurement.scene, right.position, point)
            matched = seen & ~hidden & _in_image(right, point)
            found = np.full(len(u), np.nan)
            if matched.any():
                found[matched] = nominal.disparity((u[matched], v[matched]), project(right, point[matched]))
            disparity[part], only_left[part] = (x.reshape(len(part), -1) for x in (found, seen & hidden))
        if np.isnan(disparity).all():  # the cameras miss the reference
            return None
        return cls(step, disparity, only_left, row, column)

    @property
    def depth_step_px(self) -> float:
        """Threshold of depth steps of the rock, px: there is one between neighbouring cells whose disparities differ by more."""
        return max(_STEEP * self.step, 1.0)

    def search_part(self) -> tuple[DisparityRaster, NDArray[np.int64]]:
        """Return a part of the raster, to save time when edge effects (such as edge fattening) are searched for.

        Returns
        -------
        raster : The whole raster if it has at most 400,000 cells, else four bands of its rows. Empty rows between the bands
            keep them from affecting each other. In rows without points `hidden` is not valid.
        points : (k,) row numbers of those of the n measured points that lie in it.
        """
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
        """Look up the values (n,) of an array with the shape of this raster in the cells of the n measured points."""
        return np.asarray(raster[self.row, self.column])

    def near_border(self, sigma_px: float) -> BoolArray:
        """Tell which points (n,) are so near the border of the common field of view that smoothing cannot be predicted there.

        A Gaussian low-pass filter with standard deviation `sigma_px`, px, would use disparities beyond the border, which are
        unknown. A point is near if more than 1 % of the filter's weight lies there. Occlusions do not count as beyond the border.
        """
        inside = (~np.isnan(self.disparity) | self.hidden).astype(np.float64)
        return self.at_points(gaussian_filter(inside, sigma_px / self.step, mode="constant") < 1 - _BEYOND)

    def in_filled_occlusions(self, effects: Iterable[Effect]) -> BoolArray:
        """Tell which measured points (n,) lie in occlusions, where a matcher can only have filled in a disparity.

        In an occlusion only the left camera sees the reference. Cells to which effects of the sensor model, such as edge
        fattening, carry a disparity do not count.
        """
        return np.asarray(np.isnan(self.at_points(self.apply(effects))) & self.at_points(self.hidden))

    def copied_from_neighbour(self, found: FloatArray, tolerance: float) -> BoolArray:
        """Tell which of the measured disparities `found` (n,), px, equal that of a neighbouring cell in the raster's row.

        A stereo matcher that fills occlusions copies disparities from a neighbouring pixel, so equal values reveal it. tolerance:
        largest difference that counts as equal, px.
        """
        cells = np.full(self.disparity.shape, np.nan)
        cells[self.row, self.column] = found
        same = np.abs(np.diff(cells, axis=1)) < tolerance
        return self.at_points(np.pad(same, ((0, 0), (1, 0))) | np.pad(same, ((0, 0), (0, 1))))

    def apply(self, effects: Iterable[Effect]) -> FloatArray:
        """Predict the disparities that a matcher with edge fattening, smoothing or filled occlusions gives on the reference.

        effects: effects of the sensor model; those in which neighbouring pixels play no part are ignored. Returns (rows, columns)
        disparities, px; NaN without a match.
        """
        found = self.disparity
        for effect in _filters(effects):
            found = effect.filtered(found, self.step, self.depth_step_px)
        return found

    def added_by(self, effects: Iterable[Effect], disparity: FloatArray) -> FloatArray:
        """Return by how much (n,), px, edge fattening, smoothing and filled occlusions change the disparity at the points.

        effects: effects of the sensor model, as for `apply`. disparity: (n,) disparity of the reference at the points, px, which
        stands in for the raster's value in cells that are NaN. The result is 0 where the effects give no match.
        """
        plain = self.at_points(self.disparity)
        match _filters(effects):
            case [EdgeFattening() as fattening]:  # gives the same, and many are tried
                found = self._fattening_trials.fattened(fattening, self.step, self.depth_step_px)
            case filters:
                found = self.at_points(self.apply(filters))
        return np.nan_to_num(found - np.where(np.isnan(plain), disparity, plain))

    @cached_property
    def _fattening_trials(self) -> FatteningTrials:
        """Edge fattening of the reference at the points, as the only effect."""
        return FatteningTrials(self.disparity, self.at_points)


def _filters(effects: Iterable[Effect]) -> list[RasterEffect]:
    """The effects in which neighbouring pixels play a part, in the order in which a matcher applies them."""
    chosen = (effect for effect in effects if isinstance(effect, RasterEffect))
    return sorted(chosen, key=lambda effect: (effect.stage, effect.order))


def apply_smoothing(effects: Iterable[Effect], geometry: PixelGeometry, columns: FloatArray) -> FloatArray:
    """Smooth small changes of the disparities, such as a pose Jacobian, as the stereo matcher smooths its disparities.

    A move of the cameras changes the disparities in a pattern that follows the rock's relief, and the matcher smooths it. If
    the points are a subsample, only the pixels that are present are averaged.

    effects: effects of the sensor model; only smoothing is used. columns: (n, k) changes of the disparity at the n points by k
    parameters, px per unit of the parameter. They are returned unchanged without smoothing, if the pixels lie on no raster, or if
    it has over 40 million cells.
    """
    filters = [effect for effect in effects if isinstance(effect, Smoothing)]
    step = raster_cell_px(geometry.u, geometry.v) if filters else None
    if step is None or raster_cell_count(geometry.u, geometry.v, step) > MOST_CELLS:
        return columns
    row, column = cell_numbers(geometry.v, step), cell_numbers(geometry.u, step)
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
    """Return the number of cells, `step` px wide, of a raster that covers all pixels, to tell whether it would be too large.

    u, v: (n,) columns and rows of the pixels, px.
    """
    return int(np.prod([np.rint(np.ptp(x) / step) + 1 for x in (u, v)]))


def _in_image(camera: Camera, point: FloatArray) -> BoolArray:
    """(n,) whether points (n, 3) lie within a camera's image: others cannot be matched."""
    u, v = project(camera, point)
    with np.errstate(invalid="ignore"):
        return np.asarray((u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height))


def _raster_axis(x: FloatArray, step: float, size: int) -> tuple[FloatArray, NDArray[np.int64]]:
    """Positions of the rows or columns of the matcher's raster, px, and the number of that of each point (n,).

    The raster extends beyond the outermost points, as far as the image (of `size` px) and a low-pass filter reach, because
    clouds are cropped after matching.
    """
    before, after = (int(np.clip(room // step, 0, _MARGIN)) for room in (x.min(), size - x.max()))
    cell = cell_numbers(x, step)
    return np.asarray(x.min() + step * np.arange(-before, int(cell.max()) + 1 + after), dtype=np.float64), cell + before


def cell_numbers(x: FloatArray, step: float) -> NDArray[np.int64]:
    """Return the number (n,) of the column (or row) of a raster in which each point lies, counted from the first.

    x: (n,) columns (or rows) of the points' pixels, px; step: spacing of the raster's cells, px.
    """
    return np.rint((x - x.min()) / step).astype(np.int64)


def raster_cell_px(u: FloatArray, v: FloatArray) -> float | None:
    """Find the spacing of the pixel raster on which a stereo matcher measured, such as every second or fourth pixel.

    u, v: (n,) columns and rows of the measured pixels, px. Returns the spacing of the columns or of the rows, whichever is
    smaller, px; None if the pixels lie on no raster.
    """
    steps = [step for step in (raster_spacing_px(u), raster_spacing_px(v)) if step is not None]
    return min(steps, default=None)


def raster_spacing_px(u: FloatArray) -> float | None:
    """Find the spacing of the columns, or of the rows, of a raster on which measured pixels lie, px; None without a raster.

    Pixels that a registration has shifted a little still count. u: (n,) columns (or rows) of the pixels, px.
    """
    gaps = np.diff(np.unique(np.rint(1000 * u).astype(np.int64))) / 1000  # integers are quicker to tell apart
    step = float(np.median(gaps)) if len(gaps) > 10 else 0.0
    steps = gaps / max(step, 1e-9)
    if step > 0.9 and np.count_nonzero(np.abs(steps - np.rint(steps)) < 0.01) > 0.99 * len(gaps):
        return step
    whole = [each for each in _STEPS if abs(np.exp(2j * np.pi * u / each).mean()) > _ON_RASTER]
    return float(max(whole)) if whole else None
