"""What naming starts from, once effects where the surface is not smooth are known, what it names, and those again beside it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement, TlsMeasurement
from pipeline.gap.decisions import decided
from pipeline.gap.naming.entries import Named, from_shape, settled_with, with_effects
from pipeline.gap.naming.families import believes
from pipeline.gap.naming.naming import Naming, name_effects
from pipeline.gap.other.mixed_pixels import find_footprint
from pipeline.gap.other.shapes import ShapeFound
from pipeline.gap.other.stereo_shapes import find_shapes
from pipeline.gap.residuals.alignment import align, compute_residuals, fit_pose_robustly
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.scene_changes import SceneChange, drop_duplicates, find_scene_changes
from pipeline.gap.residuals.sensor_view import SensorView
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from pipeline.gap.residuals.wall_blocks import WallCells
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.beam_divergence import BeamDivergence
from sensors.effects.smoothing import Smoothing

_LEAST = 0, 1
"""One effect, the least complexity that an attempt can have where there is something."""
_MOST_POINTS = 60_000
"""Points that take part in the selection; more add little to 1,100 cells."""


@dataclass(frozen=True)
class State:
    """What naming starts from, once effects where the surface is not smooth are known.

    shaped: the measurement with them in its model; residuals: against that; touched, changed, held_out: (n,) points that they
    touch, that lie in changes of the scene, and that no step before the last may look at; rough: (n,) registered residuals, which
    spread `scale` predicted sigmas; chosen: rows that selection may look at.
    """

    shapes: list[ShapeFound]
    shaped: Measurement
    residuals: Residuals
    touched: BoolArray
    changes: list[SceneChange]
    changed: BoolArray
    rough: FloatArray
    scale: float
    cells: WallCells
    held_out: BoolArray
    chosen: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        there: Measurement,
        plain: Residuals,
        held_points: BoolArray,
        shapes: list[ShapeFound],
        resettled: bool = True,
    ) -> State:
        """held_points: of the measurement, as what shapes touch; resettled: the sensor goes where it stood with the shapes."""
        touched = np.any([np.zeros(len(plain), dtype=bool), *(each.touched[plain.index] for each in shapes)], axis=0)
        trusted = plain.index[~(touched | held_points[plain.index])] if resettled else None
        shaped, residuals = _shaped(there, plain, shapes, touched, trusted)
        rough, _, scale = fit_pose_robustly(residuals)
        sight = SensorView.of(there, residuals)
        changes, changed = find_scene_changes(replace(residuals, value=rough), sight, residuals.on_smooth_surface & ~touched)
        if isinstance(there, TlsMeasurement) and there.scans:
            changes = drop_duplicates(changes)
        rough, _, scale = fit_pose_robustly(replace(residuals, usable=residuals.usable & ~changed))
        cells = WallCells.over(residuals.wall_xy)
        held_out = held_points[residuals.index]
        usable = residuals.usable & ~changed & (np.abs(rough) < decided().points.outlier * scale * residuals.sigma)
        chosen = thinned_rows(np.flatnonzero(usable & ~held_out))
        return cls(shapes, shaped, residuals, touched, changes, changed, rough, scale, cells, held_out, chosen)

    @property
    def fit(self) -> BoolArray:
        """(n,) points on smooth surface that did not change."""
        return np.asarray(self.residuals.usable & ~self.changed)

    @property
    def shown(self) -> BoolArray:
        """(n,) points on which a gap may be measured: on smooth surface, or where an effect was found that shows elsewhere."""
        return np.asarray((self.residuals.usable | self.touched) & ~self.changed)

    @property
    def part(self) -> tuple[Measurement, Residuals]:
        """What selection may look at. What effects on the shape do there, cameras that move by millimetres hardly change."""
        there, residuals = self.shaped, self.residuals
        if isinstance(there, StereoMeasurement) and isinstance(residuals, StereoResiduals):
            shaped = np.zeros(len(there.cloud.points))
            shaped[residuals.index] = residuals.geometry.shaped
            there = there.changed(shaped_px=shaped)
        return few(there, residuals, self.chosen)


@dataclass(frozen=True)
class Attempt:
    """What naming started from and what it named."""

    state: State
    named: list[Named]
    naming: Naming

    @classmethod
    def of(cls, state: State, random: KeyedRandom, left_out: frozenset[tuple[str, bool]]) -> Attempt:
        return cls(state, *name_effects(*state.part, state.scale, random, left_out))

    @property
    def shapes(self) -> set[str]:
        """Effects where the surface is not smooth."""
        return {each.name for each in self.state.shapes}

    @property
    def complexity(self) -> tuple[int, int]:
        """Empirical terms, and all effects and changes of the scene."""
        state = self.state
        return sum(item.kind == "empirical" for item in self.named), len(self.named) + len(state.shapes) + len(state.changes)


@dataclass(frozen=True, eq=False)
class Starts:
    """From what naming may start. there, plain: the measurement and its residuals; held_points: (n,) of its points those that no
    step before the last may look at."""

    there: Measurement
    plain: Residuals
    held_points: BoolArray

    @cached_property
    def _shapes(self) -> list[ShapeFound]:
        return _shapes(self.there, self.plain, self.held_points)

    @cached_property
    def first(self) -> State:
        """Beside the effects where the surface is not smooth."""
        return self.beside(self._shapes)

    @cached_property
    def staying(self) -> State:
        """The same, with the sensor where it stood without them."""
        return State.of(self.there, self.plain, self.held_points, self._shapes, resettled=False)

    @cached_property
    def smooth(self) -> State:
        """Without such effects."""
        return self.beside([])

    def seen_beside(self, named: list[Named]) -> list[ShapeFound]:
        """The effects where the surface is not smooth that show with some others in the model."""
        seen = settled_with(self.there, named, self.plain.index[~self.held_points[self.plain.index]])
        return _shapes(seen.measurement, seen.residuals, self.held_points)

    def beside(self, shapes: list[ShapeFound]) -> State:
        """Beside some of those."""
        return State.of(self.there, self.plain, self.held_points, shapes)


def attempt(starts: Starts, random: KeyedRandom, left_out: frozenset[tuple[str, bool]]) -> Attempt:
    """What the naming started from in the end, and what it named. left_out: as of `name_effects`.

    What moves the rays everywhere hides, or feigns, effects where the surface is not smooth: those are looked for again beside
    what was named; and where there seemed to be some, beside what is named without them. A low-pass moves the sensor, or what
    does so beside it: where the sensor goes along and a term of no effect is left, and no effect explains all by itself, it
    stays. Fewer effects are the explanation, of those attempts that leave about as little spread: noise, if it is large enough,
    takes the place of any effect.
    """

    def beside(found: Attempt) -> Attempt:
        if not found.named:
            return found
        # rays that are not quite where they are thought to be look like a low-pass
        feigned = {Smoothing.tag()} - found.shapes
        shapes = [each for each in starts.seen_beside(found.named) if each.name not in feigned]
        if {each.name for each in shapes} == found.shapes:
            return found
        return Attempt.of(starts.beside(shapes), random, left_out)

    first = Attempt.of(starts.first, random, left_out)
    found = [beside(first)]
    if first.shapes and found[0].complexity > _LEAST:
        smooth = Attempt.of(starts.smooth, random, left_out)
        if smooth.named:
            found.append(beside(smooth))
    simple = found[-1].complexity <= _LEAST and found[-1].naming.spreads <= found[0].naming.spreads
    if Smoothing.tag() in first.shapes and found[0].complexity >= (1, 0) and not simple:
        found.insert(1, beside(Attempt.of(starts.staying, random, left_out)))
    widest = decided().shapes.wider * min(each.naming.spreads for each in found)
    return min((each for each in found if each.naming.spreads <= widest), key=lambda each: each.complexity)


def thinned_rows(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    return rows[:: max(len(rows) // _MOST_POINTS, 1)]


def _shapes(measurement: Measurement, residuals: Residuals, held_points: BoolArray) -> list[ShapeFound]:
    """Effects where the surface is not smooth that the model does not hold, with the measurement's points that they touch.

    held_points: of the measurement's points those that have no say.
    """
    rough, _, scale = fit_pose_robustly(residuals)
    found: list[ShapeFound] = []
    held_out = held_points[residuals.index]
    match measurement, residuals:
        case StereoMeasurement(), StereoResiduals():
            found = find_shapes(measurement, residuals, rough, held_out)
        case TlsMeasurement(), TlsResiduals() if not believes(measurement, BeamDivergence.tag()):
            found = find_footprint(measurement, residuals, rough, scale, held_out)
    touched = np.zeros((len(found), len(measurement.cloud.points)), dtype=bool)
    for row, each in zip(touched, found, strict=True):
        row[residuals.index] = each.touched
    return [replace(each, touched=row) for each, row in zip(found, touched, strict=True)]


def _shaped(
    measurement: Measurement,
    residuals: Residuals,
    shapes: list[ShapeFound],
    touched: BoolArray,
    trusted: NDArray[np.int64] | None,
) -> tuple[Measurement, Residuals]:
    """The measurement with these effects in its model, its sensor where its points say that it stood with them, and the residuals
    of the same points there. touched: (n,) points that the effects move; trusted: rows of the measurement's points that say where
    the sensor stood, None where it stays."""
    if not shapes:
        return measurement, residuals
    entries = [from_shape(shape).entry for shape in shapes]
    shaped = measurement.changed(model=with_effects(measurement.model, entries))
    if trusted is None:
        found = compute_residuals(shaped)
    else:
        shaped, found, _ = align(shaped, trusted)
    place = np.full(len(measurement.cloud.points), -1)
    place[found.index] = np.arange(len(found))
    rows = place[residuals.index]
    known = rows >= 0
    there = residuals.with_rows_from(known, found.part(rows[known]))
    return shaped, replace(there, usable=residuals.usable & ~touched & known)


def few(measurement: Measurement, residuals: Residuals, rows: NDArray[np.int64]) -> tuple[Measurement, Residuals]:
    """The measurement with the points of some rows of its residuals alone, and their residuals."""
    part = residuals.part(rows)
    return measurement.part(part.index), replace(part, index=np.arange(len(rows)), expected_pulses=None)
