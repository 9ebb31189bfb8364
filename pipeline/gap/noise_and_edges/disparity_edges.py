"""Find edge effects of a disparity map: edge fattening, smoothing (low-pass), and filled half-occluded strips.

Each effect is predicted on the reference's own raster. It is accepted if the measured disparities are nearer to the prediction
with the effect than to that without, in wall blocks all over the wall.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import call

import numpy as np
from numpy.typing import NDArray

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement
from pipeline.gap.noise_and_edges.edge_effects import EdgeEffect, agreed_gain, block_std, edge_blocks, log_density, maximise_gain
from pipeline.gap.noise_and_edges.missing_returns import bernoulli_log_likelihood
from pipeline.gap.residuals.alignment import AlignedMeasurement, RobustPoseFit, align, compute_residuals, fit_pose_robustly
from pipeline.gap.residuals.disparity_raster import DisparityRaster
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.stereo_residuals import StereoResiduals, with_surroundings
from pipeline.gap.thresholds import thresholds
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect
from sensors.effects.edge_fattening import EdgeFattening
from sensors.effects.occlusion_fill import OcclusionFill
from sensors.effects.smoothing import Smoothing

_TRIED = 50_000
"""Points at which values of an effect's parameters are tried: at least so many if there are so many, and less than twice."""
_RADII = (1, 2, 3, 4, 5, 6, 8, 10)
_RIM_STEPS, _WINDOW_STEPS_PX = (2.0, 4.0), (0.5, 1.0, 2.0, 4.0)
_SIGMAS = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0)
"""Radii of edge fattening, cells; depth steps of rims, in the smallest one that counts (which is tried too), and of windows, px;
standard deviations of the low-pass, cells."""
_REFINEMENT_FACTORS = (1.1, 1.03)
_WINDOWS = ("disc", "square")
_LARGEST_STEP_PX = 1000.0
"""Largest depth step that the effect accepts, px."""
_STEP_FACTORS = (1.2, 1.05)
"""Ratios of neighbouring steps in the refinements of a rim's step."""
_ROUNDED_CELLS = 0.25, 1.5 / np.sqrt(12)
"""Mean and standard deviation, cells, of a radius minus the whole cells that it reaches: a matcher may round it down, or to the
nearest number, so that it lies between -0.5 and 1."""
_FILLED_SHARE, _STRAY_SHARE = 0.9, 0.02
"""Probability that a cell of a strip holds a point where strips of its width are filled, and where they are not."""
_EDGE_MARGIN_CELLS, _REGISTRATIONS = 2, 3
"""Cells beyond the radius of edge fattening that are unpredictable too, and registrations beside a low-pass."""
_SPOILT = 0.01
"""Least gain in log-likelihood per point for which another pose is tried. A wrong pose costs much more, all over the wall."""
_STEP_MARGIN = 1.1
"""Ratio of steps between which it is uncertain whether a matcher counts a difference as a step."""
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
    whole, raster : raster of the measured disparities, and the part of it that is searched.
    registered_residuals : (n,) residuals after a robust pose fit, px.
    sigma : (n,) their standard deviations, px.
    held_out : (n,) points that must not be used.
    beside : known effects, of which the edge effects count.
    """

    residuals: StereoResiduals
    whole: DisparityRaster
    raster: DisparityRaster
    registered_residuals: FloatArray
    sigma: FloatArray
    held_out: BoolArray
    beside: list[Effect]

    @classmethod
    def of(
        cls, measurement: StereoMeasurement, residuals: StereoResiduals, registered_residuals: FloatArray, held_out: BoolArray
    ) -> _EdgeData | None:
        """Gather what a search needs, of a large raster from a part of the points; None if the points lie on no pixel raster."""
        whole = DisparityRaster.of(measurement, residuals.geometry)
        if whole is None:
            return None
        scale = nmad((registered_residuals / residuals.sigma)[residuals.usable], 0.0)
        known: list[Effect] = [*measurement.model.effects]
        known_shift = whole.added_by(known, residuals.geometry.disparity)
        raster, points = whole.search_part()
        part = residuals.part(points)
        part = replace(part, value=part.value + known_shift[points])
        registered = (registered_residuals + known_shift)[points]
        return cls(part, whole, raster, registered, scale * part.sigma, held_out[points], known)

    def for_trials(self) -> _EdgeData:
        """Return the data at evenly spaced ones of many points, at which values of an effect's parameters are tried."""
        every = np.arange(0, len(self.sigma), max(len(self.sigma) // _TRIED, 1))
        return replace(
            self,
            residuals=self.residuals.part(every),
            raster=replace(self.raster, row=self.raster.row[every], column=self.raster.column[every]),
            registered_residuals=self.registered_residuals[every],
            sigma=self.sigma[every],
            held_out=self.held_out[every],
        )

    @cached_property
    def block(self) -> NDArray[np.int64]:
        """(n,) number of each point's wall block; wall blocks must agree on an effect."""
        return edge_blocks(self.residuals.wall_xy)

    @cached_property
    def shift_without(self) -> FloatArray:
        """(n,) change of the disparities by the known effects alone, px."""
        return self.shift([])

    @cached_property
    def _pose_fit(self) -> RobustPoseFit:
        return RobustPoseFit.of(self.residuals)

    def shift(self, effects: list[Effect]) -> FloatArray:
        """(n,) change of the disparities by the known effects and further ones, px."""
        return self.raster.added_by([*self.beside, *effects], self.residuals.geometry.disparity)

    def gains(self, effect: Effect) -> FloatArray:
        """(n,) log-likelihood ratio of an effect beside the known ones."""
        shift = self.shift([effect])
        rows = np.flatnonzero((shift != self.shift_without) & ~self.held_out)
        gains = np.zeros(len(shift))
        value, sigma = self.registered_residuals[rows], self.sigma[rows]
        gains[rows] = log_density(value, shift[rows], sigma) - log_density(value, self.shift_without[rows], sigma)
        return gains

    def _registered(self, effects: list[Effect]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (n,) after a pose fit with further effects in the model, their shift, and standard deviations, px."""
        shift = self.shift(effects)
        value, _, scale = self._pose_fit.fit(self.residuals.value - shift)
        return value + shift, shift, scale * self.residuals.sigma

    def registered_density(self, effects: list[Effect]) -> FloatArray:
        """(n,) log density with further effects, and with the pose and the noise that are fitted beside them; 0 if held out."""
        return np.where(self.held_out, 0.0, log_density(*self._registered(effects)))

    @cached_property
    def registered_density_without(self) -> FloatArray:
        """(n,) the same with the known effects alone."""
        return self.registered_density([])

    def clear_gains(self, effect: EdgeFattening) -> FloatArray:
        """(n,) log-likelihood ratio of an effect beside the known ones; pose and noise are fitted to either model.

        It is 0 at points that the effect does not move; for a rim, also where it moves them little, because matchers disagree on
        small steps.
        """
        least = self.raster.depth_step_px if effect.window == "rim" else 0.0
        clear = np.abs(self.shift([effect]) - self.shift_without) > least
        return (self.registered_density([effect]) - self.registered_density_without) * clear

    def likeliest_step(self, window: EdgeFattening) -> float | None:
        """Return the depth step from which on a window takes effect, px, with the largest likelihood at the present pose.

        window: the effect with the smallest step to try. None if no step makes the residuals more likely.
        """
        shift = self.shift([window]) - self.shift_without
        gains = self.gains(window)
        order = np.argsort(-shift)[: np.count_nonzero(shift > window.step_px)]
        total = np.cumsum(gains[order])
        if not len(total) or total.max() <= 0:
            return None
        last = int(np.argmax(total))
        lower = shift[order[last + 1]] if last + 1 < len(order) else window.step_px
        return float(min((shift[order[last]] + lower) / 2, _LARGEST_STEP_PX))

    def edge_effect(self, effect: Effect, std: dict[str, float], gain: float) -> EdgeEffect:
        """Return the result for an effect that was accepted beside the known ones."""
        return EdgeEffect(effect, std, gain, _unpredictable_points(effect, self.beside, self.raster, self.residuals))

    def registered_with(self, effect: Effect) -> _EdgeData:
        """Repeat the registration and the noise estimate with an effect beside the known ones."""
        value, _, sigma = self._registered([effect])
        return replace(self, registered_residuals=value, sigma=sigma)


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
    data = _EdgeData.of(measurement, residuals, registered_residuals, held_out)
    if data is None:
        return []
    found = _search(data)
    if len(data.sigma) == len(registered_residuals):
        return found
    before = ([*data.beside, *(each.effect for each in found[:count])] for count in range(len(found)))
    return [
        replace(each, touched=_unpredictable_points(each.effect, others, data.whole, residuals))
        for each, others in zip(found, before, strict=True)
    ]


def _search(data: _EdgeData) -> list[EdgeEffect]:
    """Find the edge effects of some data, each beside those found before."""
    found: list[EdgeEffect] = []
    searches: dict[str, Callable[[_EdgeData], EdgeEffect | None]] = {
        EdgeFattening.tag(): _find_fattening,
        Smoothing.tag(): _find_smoothing,
        OcclusionFill.tag(): _find_filling,
    }
    for effect in data.beside:
        searches.pop(effect.name, None)
    while searches:
        current = replace(data, beside=[*data.beside, *(each.effect for each in found)])
        untouched = replace(current, held_out=np.any([data.held_out, *(each.touched for each in found)], axis=0))
        calls = [partial(find, untouched if find is _find_smoothing else current) for find in searches.values()]
        # no prediction is exact, so a further effect must explain more than the inexact part of those before
        needed = thresholds().mean.class_share * max([0.0, *(each.gain for each in found)])
        tried = {each.name: each for each in map_in_threads(call, calls) if each is not None and each.gain > needed}
        if not tried:
            break
        similar = [tried.pop(name) for name in (EdgeFattening.tag(), Smoothing.tag()) if name in tried]
        likelier = sorted(similar, key=lambda each: -float(current.registered_density([each.effect]).sum()))[:1]
        found.append(max([*likelier, *tried.values()], key=lambda each: each.gain))
        del searches[found[-1].name]
    return found


def align_beside_fattening(
    measurement: StereoMeasurement, initial: StereoResiduals, aligned: AlignedMeasurement, trusted: NDArray[np.int64]
) -> AlignedMeasurement:
    """Estimate the pose again with edge fattening in the model, where that fits better at the surveyed pose.

    A window that takes the nearest rock changes most disparities of a steep wall. Without it in the model, the pose that fits
    best can be off by decimetres, and nothing is predicted rightly there.

    Parameters
    ----------
    measurement : the stereo pair at its surveyed pose.
    initial : its residuals.
    aligned : the pair at the pose that fits best without any effect.
    trusted : rows of the measurement's points from which the pose is estimated.

    Returns
    -------
    AlignedMeasurement : the pair at the better one of both poses, without edge fattening in its model.
    """
    if not aligned.pose.any() or any(isinstance(effect, EdgeFattening) for effect in measurement.model.effects):
        return aligned
    measurement = with_surroundings(measurement, initial)
    given, plain = _gather_trusted(measurement, initial, trusted), _gather_trusted(*aligned[:2], trusted)
    if given is None or plain is None:
        return aligned
    best, least = most_likely_fattening(given.for_trials()), thresholds().edges.least_gain
    _, here, there_too = np.intersect1d(given.residuals.index, plain.residuals.index, assume_unique=True, return_indices=True)
    gains = given.registered_density([best])[here] - plain.registered_density([])[there_too]
    if gains.sum() < least + _SPOILT * len(gains):
        return aligned
    fattened = measurement.changed(model=measurement.model.model_copy(update={"effects": (*measurement.model.effects, best)}))
    pose = align(fattened, trusted, compute_residuals(fattened)).pose
    moved = measurement.moved(pose)
    there = AlignedMeasurement(moved, compute_residuals(moved), pose)
    both = plain, _gather_trusted(*there[:2], trusted)
    before, after = (_log_likelihood_with_edge_effects(each, len(trusted)) for each in both)
    return there if after > before + least else aligned


def _gather_trusted(measurement: Measurement, residuals: Residuals, trusted: NDArray[np.int64]) -> _EdgeData | None:
    """Gather what a search needs, from trusted points alone; None if the points lie on no pixel raster."""
    if not isinstance(measurement, StereoMeasurement) or not isinstance(residuals, StereoResiduals):
        return None
    held_out = ~np.isin(residuals.index, trusted)
    return _EdgeData.of(measurement, residuals, fit_pose_robustly(residuals)[0], held_out)


def _log_likelihood_with_edge_effects(data: _EdgeData | None, count: int) -> float:
    """Log-likelihood of the disparities at one pose, beside the edge effects that a search finds there.

    data: the disparities at this pose; None: -inf. The sum over its points is scaled to `count` points, so that poses at which
    other points are used can be compared.
    """
    if data is None:
        return -np.inf
    density = data.registered_density([each.effect for each in _search(data)])
    return float(density.sum() / max(np.count_nonzero(~data.held_out), 1) * count)


def _unpredictable_points(effect: Effect, beside: list[Effect], raster: DisparityRaster, residuals: StereoResiduals) -> BoolArray:
    """(n,) points whose residuals cannot be predicted to the noise beside an effect.

    What fills half-occluded strips fills other gaps too; of those filled points nothing but their neighbours is seen.
    """
    at = residuals.geometry
    match effect:
        case EdgeFattening(window="rim"):
            wider = effect.model_copy(update={"radius_px": effect.radius_px + _EDGE_MARGIN_CELLS * raster.step})
            return np.asarray(raster.added_by([wider], at.disparity) != 0)
        case EdgeFattening():
            return _uncertain_in_window(effect, raster, residuals)
        case Smoothing():
            return raster.near_border(effect.sigma_px)
    return raster.in_filled_occlusions(beside) | raster.copied_from_neighbour(
        at.found, _COPY_TOLERANCE * float(np.median(residuals.sigma))
    )


def _uncertain_in_window(effect: EdgeFattening, raster: DisparityRaster, residuals: StereoResiduals) -> BoolArray:
    """(n,) points whose change by a window is uncertain by more than the noise.

    On smooth rock the change is as well known as the rock itself. It is not where the window reaches over a depth step, or
    where the largest disparity is so near the step that counts that a little more or less decides.
    """

    def shift(**changed: float) -> FloatArray:
        return raster.added_by([effect.model_copy(update=changed)], residuals.geometry.disparity)

    here = shift()
    around = [shift(step_px=effect.step_px * factor) for factor in (_STEP_MARGIN, 1 / _STEP_MARGIN)]
    uncertain = np.any([np.abs(each - here) > residuals.sigma for each in around], axis=0)
    rim = EdgeFattening(radius_px=effect.radius_px)
    return np.asarray(uncertain | _unpredictable_points(rim, [], raster, residuals))


def _find_fattening(data: _EdgeData) -> EdgeEffect | None:
    """Find edge fattening: the most likely outline, with the pose and the noise fitted beside it.

    Radii are whole cells, because the radii in between do the same.
    """
    best = most_likely_fattening(data.for_trials())

    def gains(cells: float) -> FloatArray:
        trial = best.model_copy(update={"radius_px": (cells + _ROUNDED_CELLS[0]) * data.raster.step})
        return data.clear_gains(trial) if cells >= 1 else np.zeros(len(data.residuals))

    radius = float(int(best.radius_px / data.raster.step))
    gain = agreed_gain(gains(radius), data.block, by_signs=True)  # depth steps may occur in few places only
    if gain is None:
        return None
    radius_error = min(block_std(gains, data.block, radius, 1.0), radius)
    std = {"radius_px": data.raster.step * float(np.hypot(_ROUNDED_CELLS[1], radius_error))}
    return data.edge_effect(best, std, gain)


def most_likely_fattening(data: _EdgeData) -> EdgeFattening:
    """Return the edge fattening of largest likelihood, with the pose and the noise fitted beside each trial.

    What a matcher takes for a depth step, rather than for a slope, is not recorded, nor the form of its window, so several are
    tried: rims that grow, discs and squares.
    """
    cell, smallest = data.raster.step, data.raster.depth_step_px

    def trial(window: str, radius: int, step_px: float) -> EdgeFattening:
        chosen = {"step_px": step_px, **({} if window == "rim" else {"window": window})}
        return EdgeFattening(radius_px=(radius + _ROUNDED_CELLS[0]) * cell, **(chosen if step_px else {}))

    def most_likely(trials: list[EdgeFattening]) -> EdgeFattening:
        sums = map_in_threads(lambda each: float(data.registered_density([each]).sum()), trials)
        return trials[int(np.argmax(sums))]

    def with_best_step(at: _EdgeData, window: str, radius: int) -> list[EdgeFattening]:
        step = at.likeliest_step(trial(window, radius, _WINDOW_STEPS_PX[0]))
        return [] if step is None else [trial(window, radius, step)]

    def refined(best: EdgeFattening) -> EdgeFattening:
        for factor in _STEP_FACTORS:
            radius = int(best.radius_px / cell)
            radii = [each for each in (radius - 1, radius, radius + 1) if each]
            if best.window == "rim":
                tried = [max(best.step_px, smallest) * factor**power for power in range(-3, 4)]
                trials = [trial("rim", each, step) for each in radii for step in tried if step >= smallest]
            else:
                registered = data.registered_with(best)
                trials = [each for radius in radii for each in with_best_step(registered, best.window, radius)]
            best = most_likely([best, *trials])
        return best

    rim = (0.0, *(height * smallest for height in _RIM_STEPS))
    best_of_each = [most_likely([trial("rim", radius, step) for step in rim for radius in _RADII])]
    for window in _WINDOWS:
        trials = [trial(window, radius, step) for step in _WINDOW_STEPS_PX for radius in _RADII]
        best_of_each.append(most_likely(trials + [each for radius in _RADII for each in with_best_step(data, window, radius)]))
    best = most_likely(best_of_each)
    if data.registered_density([best]).sum() <= data.registered_density_without.sum():
        return best
    return most_likely([refined(each) for each in best_of_each])


def _find_smoothing(data: _EdgeData) -> EdgeEffect | None:
    """Find a low-pass, with the standard deviation of largest likelihood."""
    few, step = data.for_trials(), data.raster.step

    def gains(sigma: float, at: _EdgeData) -> FloatArray:
        return at.gains(Smoothing(sigma_px=sigma))

    sigma = maximise_gain(partial(gains, at=few), [step * each for each in _SIGMAS], _REFINEMENT_FACTORS)
    if agreed_gain(gains(sigma, data), data.block) is None:
        return None
    for _ in range(_REGISTRATIONS):  # the first registration and noise estimate absorb part of the low-pass
        few = few.registered_with(Smoothing(sigma_px=sigma))
        sigma = maximise_gain(partial(gains, at=few), [sigma], _REFINEMENT_FACTORS)
    data = data.registered_with(Smoothing(sigma_px=sigma))
    gain = agreed_gain(gains(sigma, data), data.block)
    if gain is None:
        return None
    std = float(np.hypot(block_std(partial(gains, at=data), data.block, sigma), _SMOOTHING_UNCERTAINTY * sigma))
    return data.edge_effect(Smoothing(sigma_px=sigma), {"sigma_px": std}, gain)


def _find_filling(data: _EdgeData) -> EdgeEffect | None:
    """Find filled occlusions: points where the right camera sees nothing, at the disparity of the background beside them.

    Without the effect at most a fifth of those cells hold a point, where edges are not exactly where the reference has them.
    """
    raster = data.raster
    points = raster.in_filled_occlusions(data.beside)
    gain = float(data.gains(OcclusionFill(reach_px=1e5))[points].sum())
    if points.sum() < thresholds().changes.fewest or gain < thresholds().edges.least_gain:
        return None
    held = np.zeros(raster.disparity.shape, dtype=bool)
    held[raster.row, raster.column] = True
    widths = _gap_widths(raster.apply(data.beside))
    inside = (widths > 0) & raster.hidden
    reach, std = _estimate_reach(widths[inside], held[inside], raster.step)
    if held[inside & (widths <= reach / raster.step)].mean() < thresholds().edges.least_filled_share:
        return None
    return data.edge_effect(OcclusionFill(reach_px=reach), {"reach_px": std}, gain)


def _estimate_reach(widths: NDArray[np.int64], held: BoolArray, step: float) -> tuple[float, float]:
    """Widest strip that is filled and its standard deviation, px, from which half-occluded cells hold points.

    If all do, the widest strip is a lower bound. The excess over it has an exponential prior with the typical size as mean.

    widths: (k,) widths in cells of the strips in which the cells lie; held: (k,) whether each holds a point.
    """
    tried = np.unique(widths)
    chances = (np.where(widths <= each, _FILLED_SHARE, _STRAY_SHARE) for each in tried)
    best = int(np.argmax([bernoulli_log_likelihood(held, chance) for chance in chances]))
    low = float(tried[best])
    if best + 1 == len(tried):
        typical = OcclusionFill.typical_sizes()["reach_px"]
        return (low + 0.5) * step + typical, typical
    return (low + tried[best + 1]) / 2 * step, (tried[best + 1] - low) / np.sqrt(12) * step


def _gap_widths(disparity: FloatArray) -> NDArray[np.int64]:
    """(rows, columns) width in cells of the unmatched run between two matched cells, 0 elsewhere."""
    columns = disparity.shape[1]
    matched, column = ~np.isnan(disparity), np.arange(columns)
    before = np.maximum.accumulate(np.where(matched, column, -1), axis=1)
    after = np.minimum.accumulate(np.where(matched, column, columns)[:, ::-1], axis=1)[:, ::-1]
    return np.where(~matched & (before >= 0) & (after < columns), after - before - 1, 0)
