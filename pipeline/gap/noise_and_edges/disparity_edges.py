"""Find edge effects of a disparity map: edge fattening, smoothing (low-pass), and filled half-occluded strips.

Each effect is predicted on the reference's own raster. It is accepted if the measured disparities are nearer to the prediction
with the effect than to that without, in wall blocks all over the wall.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import StereoMeasurement
from pipeline.gap.noise_and_edges.edge_effects import EdgeEffect, WallBlocks, log_density, maximise_gain
from pipeline.gap.residuals.alignment import fit_pose_robustly
from pipeline.gap.residuals.disparity_raster import DisparityRaster
from pipeline.gap.residuals.residuals import BoolArray
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.thresholds import thresholds
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect
from sensors.effects.edge_fattening import EdgeFattening
from sensors.effects.occlusion_fill import OcclusionFill
from sensors.effects.raster_effect import RasterEffect
from sensors.effects.smoothing import Smoothing

_RADII = (1, 2, 3, 4, 5, 6, 8)
_STEPS = (1.0, 2.0, 4.0)
_SIGMAS = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0)
"""Radii of edge fattening in cells, depth steps in the smallest one that counts, and standard deviations of the low-pass in
cells."""
_REFINEMENT_FACTORS = (1.1, 1.03)
_FILLED_SHARE, _STRAY_SHARE = 0.9, 0.02
"""Probability that a cell of a strip holds a point where strips of its width are filled, and where they are not."""
_EDGE_MARGIN_CELLS, _REGISTRATIONS = 2, 3
"""Cells beyond the radius of edge fattening that are unpredictable too, and registrations beside a low-pass."""
_COPY_TOLERANCE = 0.02
"""Difference of neighbours, in standard deviations of the noise, up to which one is a copy of the other; 1 % are by chance."""
_SMOOTHING_UNCERTAINTY = 0.02
"""Relative uncertainty of a low-pass, because the reference is filtered in place of the rock, at its own cells and borders."""


@dataclass(frozen=True)
class _EdgeData:
    """What is needed to test an edge effect beside known ones.

    Attributes
    ----------
    residuals : residuals without edge effects.
    raster : raster of the measured disparities.
    disparity : (n,) disparities of the reference, px.
    registered_residuals : (n,) residuals after a robust pose fit, px.
    sigma : (n,) their standard deviations, px.
    blocks : wall blocks.
    held_out : (n,) points that must not be used.
    beside : known edge effects.
    """

    residuals: StereoResiduals
    raster: DisparityRaster
    disparity: FloatArray
    registered_residuals: FloatArray
    sigma: FloatArray
    blocks: WallBlocks
    held_out: BoolArray
    beside: list[Effect]

    @cached_property
    def shift_without(self) -> FloatArray:
        """(n,) change of the disparities by the known effects alone, px."""
        return self.shift([])

    @cached_property
    def density(self) -> FloatArray:
        """(n,) log density of the residuals with the known effects alone."""
        return log_density(self.registered_residuals, self.shift_without, self.sigma)

    def shift(self, effects: list[Effect]) -> FloatArray:
        """(n,) change of the disparities by the known effects and further ones, px."""
        return self.raster.added_by([*self.beside, *effects], self.disparity)

    def gains(self, effect: Effect) -> FloatArray:
        """(n,) log-likelihood ratio of an effect beside the known ones."""
        shift = self.shift([effect])
        counts = (shift != self.shift_without) & ~self.held_out
        if isinstance(effect, EdgeFattening):
            clear = np.maximum(
                thresholds().edges.clear_sigmas * self.sigma, thresholds().edges.clear_step * self.raster.depth_step_px
            )
            counts &= np.abs(shift - self.shift_without) > clear
        rows = np.flatnonzero(counts)
        gains = np.zeros(len(shift))
        gains[rows] = log_density(self.registered_residuals[rows], shift[rows], self.sigma[rows]) - self.density[rows]
        return gains

    def edge_effect(self, effect: Effect, std: dict[str, float], gain: float) -> EdgeEffect:
        """Return the result for an effect that was accepted beside the known ones."""
        return EdgeEffect(effect, std, gain, _unpredictable_points(effect, self.beside, self.raster, self.residuals))

    @property
    def noise_ratio(self) -> float:
        """Observed over predicted standard deviation of the residuals."""
        return float(self.sigma[0] / self.residuals.sigma[0])

    def registered_with(self, effect: Effect) -> _EdgeData:
        """Repeat the registration and the noise estimate with an effect beside the known ones."""
        shift = np.nan_to_num(self.shift([effect]))
        value, _, scale = fit_pose_robustly(replace(self.residuals, value=self.residuals.value - shift))
        return replace(self, registered_residuals=value + shift, sigma=scale * self.residuals.sigma)

    def likelier(self, found: list[EdgeEffect]) -> EdgeEffect:
        """Return the more likely of effects that can imitate each other, judged by the points that any of them moves clearly."""
        shift = [self.shift([each.effect]) for each in found]
        least = thresholds().edges.clear_sigmas * self.sigma
        clear = ~self.held_out & np.any([np.abs(each - self.shift_without) > least for each in shift], axis=0)
        registered_data = [self.registered_with(each.effect) for each in found]
        gains = [
            log_density(w.registered_residuals, each, w.sigma)[clear].sum()
            for w, each in zip(registered_data, shift, strict=True)
        ]
        return found[int(np.argmax(gains))]


_EffectSearch = Callable[[_EdgeData], EdgeEffect | None]


def find_disparity_edge_effects(
    measurement: StereoMeasurement, residuals: StereoResiduals, registered_residuals: FloatArray, held_out: BoolArray
) -> list[EdgeEffect]:
    """Find effects of the stereo matcher at depth steps: edge fattening, smoothing and filled occlusions.

    A matcher displaces or invents points there, which is neither noise nor a change of the rock. Effects are searched one after
    another, each with those found before in the model.

    Parameters
    ----------
    measurement : stereo measurement with the pose that was estimated by fitting it to the reference surface.
    residuals : its n disparity residuals (measured minus predicted from the reference), px.
    registered_residuals : (n,) these residuals after a small correction of the pose, fitted robustly, px.
    held_out : (n,) true for validation points, which are not used.

    Returns
    -------
    list : significant effects that the sensor model lacks; empty if the points lie on no pixel raster.
    """
    raster = DisparityRaster.of(measurement, residuals.geometry)
    if raster is None:
        return []
    scale = nmad((registered_residuals / residuals.sigma)[residuals.usable], 0.0)
    known_effects: list[Effect] = [effect for effect in measurement.model.effects if isinstance(effect, RasterEffect)]
    disparity = residuals.geometry.disparity
    known_shift = raster.added_by(known_effects, disparity)
    search_raster, points = raster.search_part()
    part = residuals.part(points)
    data = _EdgeData(
        replace(part, value=part.value + known_shift[points]),
        search_raster,
        part.geometry.disparity,
        (registered_residuals + known_shift)[points],
        scale * part.sigma,
        WallBlocks.over(part.wall_xy),
        held_out[points],
        known_effects,
    )
    found: list[EdgeEffect] = []

    def smoothing(untouched: _EdgeData) -> EdgeEffect | None:
        touched = np.any([np.zeros(len(points), dtype=bool), *(each.touched for each in found)], axis=0)
        return _find_smoothing(replace(untouched, held_out=untouched.held_out | touched))

    searches: dict[str, _EffectSearch] = {
        EdgeFattening.tag(): _find_fattening,
        Smoothing.tag(): smoothing,
        OcclusionFill.tag(): _find_filling,
    }
    for name in {effect.name for effect in known_effects}:
        del searches[name]
    while searches:
        current = replace(data, beside=[*known_effects, *(each.effect for each in found)])
        results = zip(searches, map_in_threads(partial(_run_search, current), searches.values()), strict=True)
        tried = {name: each for name, each in results if each is not None}
        if not tried:
            break
        similar = [tried.pop(name) for name in (EdgeFattening.tag(), Smoothing.tag()) if name in tried]
        likelier = [current.likelier(similar)] if similar else []
        found.append(max([*likelier, *tried.values()], key=lambda each: each.gain))
        del searches[found[-1].name]
    if len(points) == len(registered_residuals):
        return found
    effects = [*known_effects, *(each.effect for each in found)]
    before = (effects[: len(known_effects) + count] for count in range(len(found)))
    return [
        replace(each, touched=_unpredictable_points(each.effect, others, raster, residuals))
        for each, others in zip(found, before, strict=True)
    ]


def _run_search(data: _EdgeData, search: _EffectSearch) -> EdgeEffect | None:
    """Run one search; the order of arguments suits `functools.partial`."""
    return search(data)


def _unpredictable_points(effect: Effect, beside: list[Effect], raster: DisparityRaster, residuals: StereoResiduals) -> BoolArray:
    """(n,) points whose residuals cannot be predicted to the noise beside an effect.

    What fills half-occluded strips fills other gaps too; of those filled points nothing but their neighbours is seen.
    """
    at = residuals.geometry
    match effect:
        case EdgeFattening():
            wider = effect.model_copy(update={"radius_px": effect.radius_px + _EDGE_MARGIN_CELLS * raster.step})
            return np.asarray(raster.added_by([wider], at.disparity) != 0)
        case Smoothing():
            return raster.near_border(effect.sigma_px)
    return raster.in_filled_occlusions(beside) | raster.copied_from_neighbour(
        at.found, _COPY_TOLERANCE * float(np.median(residuals.sigma))
    )


def _find_fattening(data: _EdgeData) -> EdgeEffect | None:
    """Find edge fattening. Radii are whole cells, because the radii in between do the same.

    What a matcher takes for a depth step, rather than for a slope, is not recorded, so several steps are tried. Outlines that do
    not grow equally make the radius uncertain.
    """
    raster = data.raster

    def gains(radius: float) -> FloatArray:
        return current.gains(_fattening_of(int(radius), height, raster)) if radius else np.zeros(len(data.registered_residuals))

    def gain_of(outline: tuple[int, float]) -> float:
        return float(data.gains(_fattening_of(*outline, raster)).sum())

    current = data
    outlines = [(radius, height) for height in _STEPS for radius in _RADII]
    found = dict(zip(outlines, map_in_threads(gain_of, outlines), strict=True))
    radius, height = max(outlines, key=lambda each: found[each])
    if data.noise_ratio > thresholds().edges.overdispersion:
        # strong edge fattening spoils the registration and the noise estimate, and with them the test itself
        registered_data = map_in_threads(lambda each: data.registered_with(_fattening_of(*each, raster)), outlines)
        outline, best = min(zip(outlines, registered_data, strict=True), key=lambda each: each[1].noise_ratio)
        if best.noise_ratio < data.noise_ratio / thresholds().edges.overdispersion:
            (radius, height), current = outline, best
    gain = data.blocks.total_if_agreed(gains(radius), by_signs=True)  # depth steps may occur in few places only
    if gain is None:
        return None
    radius_error = min(current.blocks.std(gains, radius, 1.0), float(radius))
    std = {"radius_px": raster.step * float(np.hypot(np.sqrt(1 / 12), radius_error))}
    return data.edge_effect(_fattening_of(radius, height, raster), std, gain)


def _fattening_of(radius: int, height: float, raster: DisparityRaster) -> EdgeFattening:
    """The effect of a radius in cells and a depth step in units of the smallest one that counts."""
    reach = (radius + 0.5) * raster.step
    return (
        EdgeFattening(radius_px=reach) if height == 1 else EdgeFattening(radius_px=reach, step_px=height * raster.depth_step_px)
    )


def _find_smoothing(data: _EdgeData) -> EdgeEffect | None:
    """Find a low-pass, with the standard deviation of largest likelihood."""
    step = data.raster.step

    def gains(sigma: float) -> FloatArray:
        return data.gains(Smoothing(sigma_px=sigma))

    sigma = maximise_gain(gains, [step * each for each in _SIGMAS], _REFINEMENT_FACTORS)
    if data.blocks.total_if_agreed(gains(sigma)) is None:
        return None
    for _ in range(_REGISTRATIONS):  # the first registration and noise estimate absorb part of the low-pass
        data = data.registered_with(Smoothing(sigma_px=sigma))
        sigma = maximise_gain(gains, [sigma], _REFINEMENT_FACTORS)
    gain = data.blocks.total_if_agreed(gains(sigma))
    if gain is None:
        return None
    std = float(np.hypot(data.blocks.std(gains, sigma), _SMOOTHING_UNCERTAINTY * sigma))
    return data.edge_effect(Smoothing(sigma_px=sigma), {"sigma_px": std}, gain)


def _find_filling(data: _EdgeData) -> EdgeEffect | None:
    """Find filled occlusions: points where the right camera sees nothing, at the disparity of the background beside them.

    Without the effect few of those cells hold a point, at most a fifth, where edges are not exactly where the reference has them.
    """
    raster = data.raster
    points = raster.in_filled_occlusions(data.beside)
    gain = float(data.gains(OcclusionFill(reach_px=1e5))[points].sum())
    if points.sum() < thresholds().edges.fewest_filled or gain < thresholds().edges.least_filled_gain:
        return None
    widths, held = _occluded_strips(raster.apply(data.beside), raster)
    reach, std = _estimate_reach(widths, held, raster.step)
    narrow = held[widths <= reach / raster.step]
    if narrow.mean() < thresholds().edges.least_filled_share:
        return None
    return data.edge_effect(OcclusionFill(reach_px=reach), {"reach_px": std}, gain)


def _occluded_strips(before: FloatArray, raster: DisparityRaster) -> tuple[NDArray[np.int64], BoolArray]:
    """Width in cells of the strip of each half-occluded cell, and whether the cell holds a point."""
    held = np.zeros(before.shape, dtype=bool)
    held[raster.row, raster.column] = True
    width = _gap_widths(before)
    inside = (width > 0) & raster.hidden
    return width[inside], held[inside]


def _estimate_reach(widths: NDArray[np.int64], held: BoolArray, step: float) -> tuple[float, float]:
    """Widest strip that is filled and its standard deviation, px, from which strips hold points.

    If all do, the widest strip is a lower bound. The excess over it has an exponential prior with the typical size as mean.
    """
    tried = np.unique(widths)
    best = int(np.argmax([_log_likelihood(held, widths <= each) for each in tried]))
    low = float(tried[best])
    if best + 1 == len(tried):
        typical = OcclusionFill.typical_sizes()["reach_px"]
        return (low + 0.5) * step + typical, typical
    return (low + tried[best + 1]) / 2 * step, (tried[best + 1] - low) / np.sqrt(12) * step


def _log_likelihood(held: BoolArray, filled: BoolArray) -> float:
    """Log-likelihood of cells that hold points or not, given which strips are filled."""
    chance = np.where(filled, _FILLED_SHARE, _STRAY_SHARE)
    return float(np.sum(np.log(np.where(held, chance, 1 - chance))))


def _gap_widths(disparity: FloatArray) -> NDArray[np.int64]:
    """(rows, columns) width in cells of the unmatched run between two matched cells, 0 elsewhere."""
    columns = disparity.shape[1]
    matched, column = ~np.isnan(disparity), np.arange(columns)
    before = np.maximum.accumulate(np.where(matched, column, -1), axis=1)
    after = np.minimum.accumulate(np.where(matched, column, columns)[:, ::-1], axis=1)[:, ::-1]
    return np.where(~matched & (before >= 0) & (after < columns), after - before - 1, 0)
