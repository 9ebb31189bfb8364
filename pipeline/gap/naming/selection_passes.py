"""Selection passes: the input of a pass after edge effects, and the effects that it selects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement, TlsMeasurement
from pipeline.gap.mean.candidates import Candidate
from pipeline.gap.naming.candidate_families import catalogue_families, model_has
from pipeline.gap.naming.effect_screening import screen_effects
from pipeline.gap.naming.effect_selection import SelectionInput, SelectionResult, SelectionStart, select_effects
from pipeline.gap.naming.named_effects import (
    NamedEffect,
    aligned_with,
    effect_from_edges,
    effect_from_estimate,
    with_effects,
)
from pipeline.gap.noise_and_edges.beam_footprint import find_footprint
from pipeline.gap.noise_and_edges.disparity_edges import find_disparity_edge_effects
from pipeline.gap.noise_and_edges.edge_effects import EdgeEffect
from pipeline.gap.residuals.alignment import align, compute_residuals, fit_pose_robustly
from pipeline.gap.residuals.disparity_raster import raster_cell_count, raster_cell_px
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.scene_changes import SceneChange, drop_duplicates, find_scene_changes
from pipeline.gap.residuals.sensor_view import SensorView
from pipeline.gap.residuals.stereo_residuals import StereoResiduals, with_shaped_disparities
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from pipeline.gap.residuals.wall_blocks import BlockGrid
from pipeline.gap.thresholds import thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.beam_divergence import BeamDivergence
from sensors.effects.smoothing import Smoothing

_MOST_POINTS = 60_000
"""Most points that a selection uses; more add little information to about 800 cells."""
_MOST_CELLS = 400_000
"""Largest pixel raster, in cells, on which edge effects are computed anew for each trial of another error. On a raster of this
size one computation takes 0.4 s.
"""

_NEGLIGIBLE = 0.1
"""Largest change of an edge effect's parameter, in its standard deviations, after which the search is not repeated."""


@dataclass(frozen=True)
class PassInput:
    """Input of one run of the search for sensor errors: the measurement and its residuals, with edge effects in the model.

    Edge effects are errors at depth steps: edge fattening, smoothing, filled occlusions and the beam footprint.

    Attributes
    ----------
    edge_effects : edge effects that are in the model.
    measurement : the measurement with these effects in its model.
    residuals : residuals of n points against that model, measured minus predicted.
    touched : (n,) true for points that edge effects move by an uncertain amount, so that a search leaves them out.
    changes : regions where the rock itself changed since the reference.
    changed : (n,) true for points in these regions.
    registered_residuals : (n,) residuals after a robust pose fit, in the unit of the observable (m or px).
    noise_ratio : observed over predicted standard deviation of the registered residuals, at least 1.
    held_out : (n,) true for points that are kept for validation.
    training_rows : (k,) rows of the residuals that the search may use.
    excluded_share : share of the points on smooth rock that the search may not use, because they count as changed or as outliers.
    large_effect : an error so large that without it much of the rock would count as changed. It was in the model while changes,
        outliers and `registered_residuals` were computed, and is not in `residuals`. None if there is none.
    """

    edge_effects: list[EdgeEffect]
    measurement: Measurement
    residuals: Residuals
    touched: BoolArray
    changes: list[SceneChange]
    changed: BoolArray
    registered_residuals: FloatArray
    noise_ratio: float
    held_out: BoolArray
    training_rows: NDArray[np.int64]
    excluded_share: float
    large_effect: NamedEffect | None = None

    @classmethod
    def of(
        cls,
        aligned: Measurement,
        plain: Residuals,
        held_out_points: BoolArray,
        edge_effects: list[EdgeEffect],
        large_effect: NamedEffect | None = None,
    ) -> PassInput:
        """Build the input of one run of the search for sensor errors, with certain edge effects in the sensor model.

        Regions where the rock changed are found and set aside.

        Parameters
        ----------
        aligned : measurement of N points; the pose of its sensor was estimated without edge effects.
        plain : its residuals without edge effects.
        held_out_points : (N,) true for points that are kept for validation.
        edge_effects : edge effects to put into the model. Their attribute `touched` must have a value for each of the N points.
        large_effect : see the attribute.
        """
        touched = np.any([np.zeros(len(plain), dtype=bool), *(each.touched[plain.index] for each in edge_effects)], axis=0)
        registration_rows = plain.index[~(touched | held_out_points[plain.index])]
        entries = [effect_from_edges(each).entry for each in edge_effects]
        modelled, residuals, _ = _with_effects(aligned, plain, entries, touched, registration_rows)
        large = [] if large_effect is None else [large_effect.entry]
        _, judged, smooth = _with_effects(modelled, residuals, large, touched, registration_rows)
        judged = replace(judged, usable=judged.usable & smooth)
        registered_residuals, _, noise_ratio = fit_pose_robustly(judged)
        sight = SensorView.of(aligned, judged)
        changes, changed = find_scene_changes(
            replace(judged, value=registered_residuals), sight, judged.on_smooth_surface & smooth & ~touched
        )
        if isinstance(aligned, TlsMeasurement) and aligned.scans:
            changes = drop_duplicates(changes)
        registered_residuals, _, noise_ratio = fit_pose_robustly(replace(judged, usable=judged.usable & ~changed))
        held_out = held_out_points[residuals.index]
        inlier = np.abs(registered_residuals) < thresholds().points.outlier_sigmas * noise_ratio * judged.sigma
        usable = judged.usable & ~changed & inlier
        return cls(
            edge_effects,
            modelled,
            residuals,
            touched,
            changes,
            changed,
            registered_residuals,
            noise_ratio,
            held_out,
            subsample_rows(np.flatnonzero(usable & ~held_out)),
            1 - float(usable.sum()) / max(int(judged.usable.sum()), 1),
            large_effect,
        )

    @property
    def stable(self) -> BoolArray:
        """(n,) true for points on smooth surface, and outside of the regions where the rock changed."""
        return np.asarray(self.residuals.usable & ~self.changed)

    @property
    def measurable(self) -> BoolArray:
        """(n,) true for points at which the fit of model and measurement may be scored.

        The rock did not change there, and the surface is smooth or an effect at depth steps moves the point.
        """
        return np.asarray((self.residuals.usable | self.touched) & ~self.changed)

    @property
    def training_part(self) -> tuple[Measurement, Residuals]:
        """The measurement and the residuals of the training points alone, from which sensor errors are selected.

        On a large raster of pixels the shift of these points by edge effects (errors at depth steps) is not computed again while
        other errors are put into the model, to save time. It is then a little wrong beside errors that move the rays.
        """
        measurement, residuals = self.measurement, self.residuals
        if isinstance(measurement, StereoMeasurement) and isinstance(residuals, StereoResiduals):
            at = residuals.geometry
            if raster_cell_count(at.u, at.v, raster_cell_px(at.u, at.v) or 1.0) > _MOST_CELLS:
                measurement = with_shaped_disparities(measurement, residuals)
        return subsample(measurement, residuals, self.training_rows)

    def start(self, random: KeyedRandom, excluded: frozenset[tuple[str, bool]]) -> SelectionStart:
        """Set up the linearised search for sensor errors (effects), with which a selection starts.

        Parameters
        ----------
        random : source of random numbers for the null distributions.
        excluded : effects that are not tried, as pairs (name, whether it is an empirical term).
        """
        noise = None if self.large_effect is None else self.registered_residuals[self.training_rows]
        return SelectionStart.of(SelectionInput(*self.training_part, self.noise_ratio, random, excluded, noise))


@dataclass(frozen=True)
class SelectionPass:
    """One run of the search for sensor errors, with its input and its result.

    Attributes
    ----------
    pass_input : the measurement and its residuals, with certain effects at depth steps (edge effects) in the sensor model.
    named : sensor errors that were selected.
    selection : scores and tests of the search.
    """

    pass_input: PassInput
    named: list[NamedEffect]
    selection: SelectionResult


def _names(effects: list[EdgeEffect]) -> set[str]:
    """Names of edge effects."""
    return {each.name for each in effects}


@dataclass(frozen=True, eq=False)
class PassInputs:
    """Prepares the input of a search for sensor errors, with any choice of edge effects (`PassInput`) in the sensor model.

    Other errors can hide or imitate edge effects, so these are searched again beside the errors that a search has named.

    Attributes
    ----------
    measurement : measurement of N points; the pose of its sensor was estimated without edge effects.
    plain : its residuals without edge effects.
    held_out_points : (N,) true for points that are kept for validation.
    blocks : the large squares of the wall, each of which is kept for validation, or used in fits, as a whole.
    """

    measurement: Measurement
    plain: Residuals
    held_out_points: BoolArray
    blocks: BlockGrid

    @cached_property
    def _without_effects(self) -> PassInput:
        """Input of a search with neither edge effects nor a large effect in the sensor model."""
        return PassInput.of(self.measurement, self.plain, self.held_out_points, [])

    @cached_property
    def large_effect(self) -> NamedEffect | None:
        """A sensor error so large that much of the rock counts as changed while the model lacks it; None if there is none.

        It is searched if a search would exclude as large a share of the points as the threshold `changes.moved_share`. The effect
        that alone makes the residuals smallest is the reason if the share is less than half as large beside it.
        """
        excluded, effect = self._without_effects.excluded_share, None
        if excluded >= thresholds().changes.moved_share and (effect := self._best_single_effect) is not None:
            beside = PassInput.of(self.measurement, self.plain, self.held_out_points, [], effect)
            return effect if 2 * beside.excluded_share < excluded else None
        return None

    @cached_property
    def _best_single_effect(self) -> NamedEffect | None:
        """The effect of the catalogue that alone makes the residuals smallest; None if each would be implausibly large."""
        part = subsample(self.measurement, self.plain, np.flatnonzero(self.plain.usable & ~self._held_out))
        candidates = [each for each in catalogue_families(*part) if isinstance(each, Candidate)]
        return next((effect_from_estimate(each, part[1]) for each in screen_effects(*part, candidates, 1)), None)

    @property
    def _held_out(self) -> BoolArray:
        """(n,) true for points of the plain residuals that are kept for validation."""
        return self.held_out_points[self.plain.index]

    @cached_property
    def edge_effects(self) -> list[EdgeEffect]:
        """The effects at depth steps (edge effects) that the residuals show beside a large effect, if there is one.

        A small error of the rays' directions looks like smoothing. Smoothing must therefore also show beside the effect that
        alone makes the residuals smallest.
        """
        if self.large_effect is not None:
            return self._edge_effects_beside([self.large_effect], [])
        found = _find_edge_effects(self.measurement, self.plain, self.held_out_points)
        if Smoothing.tag() in _names(found) and self._best_single_effect is not None:
            beside = self._edge_effects_beside([self._best_single_effect], [])
            return found if Smoothing.tag() in _names(beside) else beside
        return found

    def edge_effects_given(self, named: list[NamedEffect]) -> list[EdgeEffect]:
        """Search effects at depth steps (edge effects) again, with other errors in the model that can hide or imitate them.

        The pose is estimated with the edge effects of the first search in the model too, because edge fattening shifts it.

        named: the sensor errors to put into the model first.
        """
        return self._edge_effects_beside(named, [effect_from_edges(each) for each in self.edge_effects])

    def _edge_effects_beside(self, named: list[NamedEffect], known: list[NamedEffect]) -> list[EdgeEffect]:
        """Find edge effects beside other effects. known: edge effects that are in the model while the pose is estimated."""
        seen, found, _ = aligned_with(self.measurement, [*named, *known], self.plain.index[~self._held_out])
        if known:
            seen = seen.changed(model=with_effects(self.measurement.model, [item.entry for item in named]))
            found = compute_residuals(seen)
        return _find_edge_effects(seen, found, self.held_out_points)

    def with_these(self, edge_effects: list[EdgeEffect]) -> PassInput:
        """Return the input of a search for sensor errors, with effects at depth steps in the model and the pose fitted again."""
        if not edge_effects and self.large_effect is None:
            return self._without_effects
        return PassInput.of(self.measurement, self.plain, self.held_out_points, edge_effects, self.large_effect)


def select_beside_edge_effects(inputs: PassInputs, random: KeyedRandom, excluded: frozenset[tuple[str, bool]]) -> SelectionPass:
    """Search for sensor errors, with those effects at depth steps (edge effects) in the model that the residuals show.

    Other errors can hide or imitate edge effects, or change their sizes. These are therefore searched again with the errors in
    the model that a linearised search finds, before the search proper.

    Parameters
    ----------
    inputs : makes the input of a search with given edge effects.
    random : source of random numbers for the null distributions.
    excluded : sensor errors that are not tried, as pairs (name, whether it is an empirical term).
    """
    pass_input = inputs.with_these(inputs.edge_effects)
    start = pass_input.start(random, excluded)
    if outline := start.outline():
        imitated = {Smoothing.tag()} - _names(pass_input.edge_effects)  # a small error of the rays' directions looks like it
        edge_effects = [each for each in inputs.edge_effects_given(outline) if each.name not in imitated]
        if not _much_the_same(pass_input.edge_effects, edge_effects):
            pass_input = inputs.with_these(edge_effects)
            start = pass_input.start(random, excluded)
    return SelectionPass(pass_input, *select_effects(start))


def _much_the_same(before: list[EdgeEffect], after: list[EdgeEffect]) -> bool:
    """Whether the same edge effects were found, with values that differ by a small part of their standard deviations."""

    def settings(each: EdgeEffect) -> dict[str, Any]:
        return each.effect.model_dump(exclude=set(each.std))

    def near(one: EdgeEffect, other: EdgeEffect) -> bool:
        change = {key: getattr(other.effect, key) - getattr(one.effect, key) for key in one.std}
        return settings(one) == settings(other) and all(abs(change[key]) <= _NEGLIGIBLE * std for key, std in one.std.items())

    return len(before) == len(after) and all(near(*pair) for pair in zip(before, after, strict=True))


def subsample_rows(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return evenly spaced ones of the row numbers (k,) of points, so that a search stays quick.

    All are returned if they are fewer than 120,000, else 60,000 to 90,000.
    """
    return rows[:: max(len(rows) // _MOST_POINTS, 1)]


def _find_edge_effects(measurement: Measurement, residuals: Residuals, held_out_points: BoolArray) -> list[EdgeEffect]:
    """Find edge effects that the model lacks; their `touched` refers to the points of the measurement.

    held_out_points: (N,) points of the measurement that must not be used.
    """
    registered_residuals, _, noise_ratio = fit_pose_robustly(residuals)
    found: list[EdgeEffect] = []
    held_out = held_out_points[residuals.index]
    match measurement, residuals:
        case StereoMeasurement(), StereoResiduals():
            found = find_disparity_edge_effects(measurement, residuals, registered_residuals, held_out)
        case TlsMeasurement(), TlsResiduals() if _can_show_footprints(measurement):
            found = find_footprint(measurement, residuals, registered_residuals, noise_ratio, held_out)
    touched = np.zeros((len(found), len(measurement.cloud.points)), dtype=bool)
    for row, each in zip(touched, found, strict=True):
        row[residuals.index] = each.touched
    return [replace(each, touched=row) for each, row in zip(found, touched, strict=True)]


def _can_show_footprints(measurement: TlsMeasurement) -> bool:
    """Whether the beam's footprint is to be found: not over noisy vertices, which a wide beam would seem to average."""
    noisy = measurement.reference_error_m > 0 and not measurement.error_is_relief
    return not noisy and not model_has(measurement, BeamDivergence.tag())


def _with_effects(
    measurement: Measurement,
    residuals: Residuals,
    entries: list[dict[str, Any]],
    touched: BoolArray,
    registration_rows: NDArray[np.int64],
) -> tuple[Measurement, Residuals, BoolArray]:
    """Put effects into the model, as entries of a config, and estimate the pose again from `registration_rows` of the points.

    It returns the measurement, the residuals of the same n points, and (n,) true for those that see smooth surface with the
    effects. touched: (n,) points that the effects move, which then may not be used.
    """
    if not entries:
        return measurement, residuals, residuals.on_smooth_surface
    modelled = measurement.changed(model=with_effects(measurement.model, entries))
    modelled, found, _ = align(modelled, registration_rows)
    rows = found.values_at(np.arange(len(found), dtype=np.float64), residuals.index)
    known = np.isfinite(rows)
    own = found.part(rows[known].astype(np.int64))
    smooth = np.zeros(len(residuals), dtype=bool)
    smooth[known] = own.on_smooth_surface
    matched = residuals.with_rows_from(known, own)
    return modelled, replace(matched, usable=residuals.usable & ~touched & known), smooth


def subsample(measurement: Measurement, residuals: Residuals, rows: NDArray[np.int64]) -> tuple[Measurement, Residuals]:
    """Restrict a measurement and its residuals to the same k points, so that a fit uses these alone.

    Parameters
    ----------
    measurement : the measured points with their sensor model.
    residuals : residuals of n of its points, measured minus predicted.
    rows : (k,) rows of the residuals to keep.
    """
    part = residuals.part(rows)
    return measurement.part(part.index), replace(part, index=np.arange(len(rows)), expected_pulses=None)
