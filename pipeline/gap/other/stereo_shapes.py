"""Effects on the shape of a disparity map: outlines that grow, a low-pass, half-occluded strips that are filled.

Each is predicted on the reference's own raster; what bears witness is that the measured disparities lie nearer to the shape
with the effect than to that without, in blocks all over the wall.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import StereoMeasurement
from pipeline.gap.decisions import decided
from pipeline.gap.other.shapes import ShapeFound, WallBlocks, log_density, refined
from pipeline.gap.residuals.alignment import fit_pose_robustly
from pipeline.gap.residuals.disparity_raster import DisparityRaster
from pipeline.gap.residuals.residuals import BoolArray
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
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
"""Cells that outlines grow by, at steps so many times the least that is one; standard deviations of the low-pass in cells."""
_FINER = (1.1, 1.03)
_FILLED, _STRAY_FILLED = 0.9, 0.02
"""Chances that a cell of a strip holds a point where strips of its width are filled, and where they are not."""
_NEAR_STEPS, _REGISTRATIONS = 2, 3
_COPIED = 0.02
"""Difference of neighbours, in standard deviations of the noise, up to which one is a copy of the other: of 1 % by chance."""
_FILTERED = 0.02
"""Share by which a low-pass is off since the reference is filtered for the rock, at its own cells and up to its own borders."""


@dataclass(frozen=True)
class _Witnesses:
    """residuals: without effects on the shape; raster; disparity: (n,) of the reference; rough: (n,) registered residuals, px;
    sigma: (n,) their spread; blocks; held_out: (n,) points that have no say; beside: effects that are known."""

    residuals: StereoResiduals
    raster: DisparityRaster
    disparity: FloatArray
    rough: FloatArray
    sigma: FloatArray
    blocks: WallBlocks
    held_out: BoolArray
    beside: list[Effect]

    @cached_property
    def without(self) -> FloatArray:
        """(n,) what the known effects alone add to the disparities, px."""
        return self.moved([])

    @cached_property
    def density(self) -> FloatArray:
        """(n,) log density of the residuals with the known effects alone."""
        return log_density(self.rough, self.without, self.sigma)

    def moved(self, effects: list[Effect]) -> FloatArray:
        """(n,) what effects beside the known ones add to the disparities, px."""
        return self.raster.added_by([*self.beside, *effects], self.disparity)

    def gains(self, effect: Effect) -> FloatArray:
        """(n,) log-likelihood with an effect beside the known ones less that of these alone."""
        moved = self.moved([effect])
        counts = (moved != self.without) & ~self.held_out
        if isinstance(effect, EdgeFattening):
            clear = np.maximum(
                decided().shapes.clear_sigmas * self.sigma, decided().shapes.clear_step * self.raster.depth_step_px
            )
            counts &= np.abs(moved - self.without) > clear
        rows = np.flatnonzero(counts)
        gains = np.zeros(len(moved))
        gains[rows] = log_density(self.rough[rows], moved[rows], self.sigma[rows]) - self.density[rows]
        return gains

    def found(self, effect: Effect, std: dict[str, float], gain: float) -> ShapeFound:
        """An effect that the points ask for beside the known ones."""
        return ShapeFound(effect, std, gain, _touched(effect, self.beside, self.raster, self.residuals))

    @property
    def times_predicted(self) -> float:
        """How many predicted sigmas the residuals spread."""
        return float(self.sigma[0] / self.residuals.sigma[0])

    def registered_with(self, effect: Effect) -> _Witnesses:
        """With the registration and the spread that the residuals have where an effect beside the known ones is in the model."""
        moved = np.nan_to_num(self.moved([effect]))
        value, _, scale = fit_pose_robustly(replace(self.residuals, value=self.residuals.value - moved))
        return replace(self, rough=value + moved, sigma=scale * self.residuals.sigma)

    def likelier(self, found: list[ShapeFound]) -> ShapeFound:
        """Of effects that may feign each other, the one that explains more of the points that any of them moves clearly."""
        moved = [self.moved([each.effect]) for each in found]
        least = decided().shapes.clear_sigmas * self.sigma
        clear = ~self.held_out & np.any([np.abs(each - self.without) > least for each in moved], axis=0)
        settled = [self.registered_with(each.effect) for each in found]
        gains = [log_density(w.rough, each, w.sigma)[clear].sum() for w, each in zip(settled, moved, strict=True)]
        return found[int(np.argmax(gains))]


_Trial = Callable[[_Witnesses], ShapeFound | None]


def find_shapes(
    measurement: StereoMeasurement, residuals: StereoResiduals, rough: FloatArray, held_out: BoolArray
) -> list[ShapeFound]:
    """The effects on the shape that the points ask for, one after another. rough: (n,) registered residuals, px; held_out: (n,)
    points that have no say.

    None where the points are on no raster, or where the model holds the effect already.
    """
    raster = DisparityRaster.of(measurement, residuals.geometry)
    if raster is None:
        return []
    scale = nmad((rough / residuals.sigma)[residuals.usable], 0.0)
    believed: list[Effect] = [effect for effect in measurement.model.effects if isinstance(effect, RasterEffect)]
    disparity = residuals.geometry.disparity
    had = raster.added_by(believed, disparity)
    searched, points = raster.search_part()
    part = residuals.part(points)
    witnesses = _Witnesses(
        replace(part, value=part.value + had[points]),
        searched,
        part.geometry.disparity,
        (rough + had)[points],
        scale * part.sigma,
        WallBlocks.over(part.wall_xy),
        held_out[points],
        believed,
    )
    found: list[ShapeFound] = []

    def smoothing(untouched: _Witnesses) -> ShapeFound | None:
        touched = np.any([np.zeros(len(points), dtype=bool), *(each.touched for each in found)], axis=0)
        return _smoothing(replace(untouched, held_out=untouched.held_out | touched))

    trials: dict[str, _Trial] = {
        EdgeFattening.tag(): _fattening,
        Smoothing.tag(): smoothing,
        OcclusionFill.tag(): _filling,
    }
    for name in {effect.name for effect in believed}:
        del trials[name]
    while trials:
        there = replace(witnesses, beside=[*believed, *(each.effect for each in found)])
        shapes = zip(trials, map_in_threads(partial(_asked, there), trials.values()), strict=True)
        tried = {name: each for name, each in shapes if each is not None}
        if not tried:
            break
        feigned = [tried.pop(name) for name in (EdgeFattening.tag(), Smoothing.tag()) if name in tried]
        likely = [there.likelier(feigned)] if feigned else []
        found.append(max([*likely, *tried.values()], key=lambda each: each.gain))
        del trials[found[-1].name]
    if len(points) == len(rough):
        return found
    effects = [*believed, *(each.effect for each in found)]
    before = (effects[: len(believed) + count] for count in range(len(found)))
    return [
        replace(each, touched=_touched(each.effect, others, raster, residuals))
        for each, others in zip(found, before, strict=True)
    ]


def _asked(witnesses: _Witnesses, trial: _Trial) -> ShapeFound | None:
    return trial(witnesses)


def _touched(effect: Effect, beside: list[Effect], raster: DisparityRaster, residuals: StereoResiduals) -> BoolArray:
    """(n,) points where an effect beside others cannot be predicted to the noise.

    What fills half-occluded strips fills other gaps too: of those filled points nothing but their neighbours is seen.
    """
    at = residuals.geometry
    match effect:
        case EdgeFattening():
            wider = effect.model_copy(update={"radius_px": effect.radius_px + _NEAR_STEPS * raster.step})
            return np.asarray(raster.added_by([wider], at.disparity) != 0)
        case Smoothing():
            return raster.near_border(effect.sigma_px)
    return raster.in_filled_occlusions(beside) | raster.copied_from_neighbour(
        at.found, _COPIED * float(np.median(residuals.sigma))
    )


def _fattening(witnesses: _Witnesses) -> ShapeFound | None:
    """Radii are whole cells: any between one and the next does the same. Outlines that do not grow alike make it unsure.

    What a matcher takes for a depth step, rather than for a slope that it follows, is in no measurement: several are tried.
    """
    raster = witnesses.raster

    def gains(radius: float) -> FloatArray:
        return there.gains(_grown(int(radius), height, raster)) if radius else np.zeros(len(witnesses.rough))

    def gain_of(outline: tuple[int, float]) -> float:
        return float(witnesses.gains(_grown(*outline, raster)).sum())

    there = witnesses
    outlines = [(radius, height) for height in _STEPS for radius in _RADII]
    found = dict(zip(outlines, map_in_threads(gain_of, outlines), strict=True))
    radius, height = max(outlines, key=lambda each: found[each])
    if witnesses.times_predicted > decided().shapes.wide:
        # outlines that grow far spoil the registration and the spread by which points would bear witness of them
        settled = map_in_threads(lambda each: witnesses.registered_with(_grown(*each, raster)), outlines)
        far, best = min(zip(outlines, settled, strict=True), key=lambda each: each[1].times_predicted)
        if best.times_predicted < witnesses.times_predicted / decided().shapes.wide:
            (radius, height), there = far, best
    gain = witnesses.blocks.tested(gains(radius), by_signs=True)  # outlines may stand in few places
    if gain is None:
        return None
    uneven = min(there.blocks.std(gains, radius, 1.0), float(radius))
    std = {"radius_px": raster.step * float(np.hypot(np.sqrt(1 / 12), uneven))}
    return witnesses.found(_grown(radius, height, raster), std, gain)


def _grown(radius: int, height: float, raster: DisparityRaster) -> EdgeFattening:
    """radius: cells; height: of a depth step, in the least that is one."""
    reach = (radius + 0.5) * raster.step
    return (
        EdgeFattening(radius_px=reach) if height == 1 else EdgeFattening(radius_px=reach, step_px=height * raster.depth_step_px)
    )


def _smoothing(witnesses: _Witnesses) -> ShapeFound | None:
    """The standard deviation at the top of the likelihood."""
    step = witnesses.raster.step

    def gains(sigma: float) -> FloatArray:
        return witnesses.gains(Smoothing(sigma_px=sigma))

    sigma = refined(gains, [step * each for each in _SIGMAS], _FINER)
    if witnesses.blocks.tested(gains(sigma)) is None:
        return None
    for _ in range(_REGISTRATIONS):  # that of the first trial, and its spread, make up for some of the low-pass
        witnesses = witnesses.registered_with(Smoothing(sigma_px=sigma))
        sigma = refined(gains, [sigma], _FINER)
    gain = witnesses.blocks.tested(gains(sigma))
    if gain is None:
        return None
    std = float(np.hypot(witnesses.blocks.std(gains, sigma), _FILTERED * sigma))
    return witnesses.found(Smoothing(sigma_px=sigma), {"sigma_px": std}, gain)


def _filling(witnesses: _Witnesses) -> ShapeFound | None:
    """Points where the right camera sees nothing, at the disparity of the background beside them.

    Without it hardly any of those cells holds a point (up to a fifth, by edges that are not quite where the reference has them).
    """
    raster = witnesses.raster
    points = raster.in_filled_occlusions(witnesses.beside)
    gain = float(witnesses.gains(OcclusionFill(reach_px=1e5))[points].sum())
    if points.sum() < decided().shapes.fewest_filled or gain < decided().shapes.least_filled_gain:
        return None
    widths, held = _strips(raster.apply(witnesses.beside), raster)
    reach, std = _reach(widths, held, raster.step)
    narrow = held[widths <= reach / raster.step]
    if narrow.mean() < decided().shapes.least_held:
        return None
    return witnesses.found(OcclusionFill(reach_px=reach), {"reach_px": std}, gain)


def _strips(before: FloatArray, raster: DisparityRaster) -> tuple[NDArray[np.int64], BoolArray]:
    """Of the half-occluded cells: how wide the strip is in which each lies, in cells, and whether it holds a point."""
    held = np.zeros(before.shape, dtype=bool)
    held[raster.row, raster.column] = True
    width = _widths(before)
    inside = (width > 0) & raster.hidden
    return width[inside], held[inside]


def _reach(widths: NDArray[np.int64], held: BoolArray, step: float) -> tuple[float, float]:
    """Widest strip that is filled and its standard deviation, px: by which strips hold points.

    Where all of them do, the widest is the least that the reach may be; how much more it is, is known as before: as much as is
    typical, give or take that (an exponential distribution).
    """
    tried = np.unique(widths)
    best = int(np.argmax([_log_chance(held, widths <= each) for each in tried]))
    low = float(tried[best])
    if best + 1 == len(tried):
        typical = OcclusionFill.typical_sizes()["reach_px"]
        return (low + 0.5) * step + typical, typical
    return (low + tried[best + 1]) / 2 * step, (tried[best + 1] - low) / np.sqrt(12) * step


def _log_chance(held: BoolArray, filled: BoolArray) -> float:
    """Of cells that hold points or not, where strips are filled or not."""
    chance = np.where(filled, _FILLED, _STRAY_FILLED)
    return float(np.sum(np.log(np.where(held, chance, 1 - chance))))


def _widths(disparity: FloatArray) -> NDArray[np.int64]:
    """(rows, columns) width in cells of the unmatched run between two matched ones in which a cell lies, 0 elsewhere."""
    columns = disparity.shape[1]
    matched, column = ~np.isnan(disparity), np.arange(columns)
    before = np.maximum.accumulate(np.where(matched, column, -1), axis=1)
    after = np.minimum.accumulate(np.where(matched, column, columns)[:, ::-1], axis=1)[:, ::-1]
    return np.where(~matched & (before >= 0) & (after < columns), after - before - 1, 0)
