"""The columns of every explanation of the mean over one set of points, and their normal equations; nothing of it changes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.mean.candidates import Candidate, SineGrid, moved_to, precision_of
from pipeline.gap.mean.mean_model import Covariance, MeanFit, MeanModel, Projected, column_blocks, fitted
from pipeline.gap.mean.normal_equations import Equations, NoiseDraws, Waves, assembled, extended, wave_products
from pipeline.gap.residuals.cells import Cells
from pipeline.gap.residuals.residuals import Residuals
from scene.common.keyed_random import KeyedRandom
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray

DRAWS = 499
_NULL_ROWS = 8_000


@dataclass(frozen=True, eq=False)
class Families:
    """Explanations with fixed columns, and sines of which a grid of periods is searched."""

    plain: list[Candidate]
    grids: list[SineGrid]

    @classmethod
    def of(cls, families: list[Candidate | SineGrid]) -> Families:
        """Of either kind, in any order; effects of the catalogue come first."""
        plain = sorted((family for family in families if isinstance(family, Candidate)), key=lambda each: each.empirical)
        return cls(plain, [family for family in families if isinstance(family, SineGrid)])

    @cached_property
    def members(self) -> dict[str, tuple[list[int], list[int]]]:
        """Of each family the numbers of its plain candidates and of its sines."""
        families: dict[str, tuple[list[int], list[int]]] = {}
        for row, candidate in enumerate(self.plain):
            families.setdefault(candidate.family, ([], []))[0].append(row)
        start = 0
        for grid in self.grids:
            stop = start + len(grid.frequencies)
            families.setdefault(grid.candidate(0).family, ([], []))[1].extend(range(start, stop))
            start = stop
        return families

    def sine(self, number: int) -> Candidate:
        """One of all sines."""
        for grid in self.grids:
            if number < len(grid.frequencies):
                return grid.candidate(number)
            number -= len(grid.frequencies)
        raise IndexError(number)


@dataclass(frozen=True, eq=False)
class Design:
    """All candidates on one set of points.

    pose: (n, p) orthonormal columns of the pose over sigma, in the model's rows; turn: (p, p) from them to those of the
    residuals; pose_precision: (p,) inverse variance of its coefficients before there are data; value, fixed: the residuals and
    all fixed columns, pose first; place: columns of each candidate; waves: products of the searched sines; drawn: (k,
    DRAWS) products of the fixed columns with draws of the noise within cells; equations: at every likely covariance; sines: the
    columns of those that others stand beside, which are numbered on from the fixed ones, None where there are none.
    """

    residuals: Residuals
    families: Families
    cells: Cells
    model: MeanModel
    pose: FloatArray
    turn: FloatArray
    pose_precision: FloatArray
    grids: list[SineGrid]
    value: Projected
    fixed: Projected
    sines: Projected | None
    place: Mapping[Candidate, list[int]]
    waves: Waves
    drawn: FloatArray
    equations: Equations

    @classmethod
    def of(
        cls,
        residuals: Residuals,
        families: list[Candidate | SineGrid],
        random: KeyedRandom,
        pose_precision: FloatArray | None = None,
    ) -> Design:
        """pose_precision: 0 by default."""
        chosen = Families.of(families)
        cells = Cells.over(residuals.at)
        model = MeanModel(cells, residuals.at, residuals.sigma, residuals.shared_noise)
        rows, root = model.rows, model.root[:, None]
        pose, turn = np.linalg.qr(residuals.pose[rows] * root)
        count = pose.shape[1]
        precision = np.zeros(count) if pose_precision is None else pose_precision
        place = _places(chosen.plain, count)
        fixed = model.project(_columns(model, pose, chosen.plain, place))
        value = model.project(residuals.value[rows, None] * root)
        model, covariances, bases = model.narrowed([fixed.some(list(range(count))), fixed], value)
        fixed, value = fixed.kept(bases), value.kept(bases)
        noise = NoiseDraws.of(model, DRAWS, _NULL_ROWS, random.child("within"))
        grids = [grid.part(rows) for grid in chosen.grids]
        asked = count + sum(len(place[each]) for each in chosen.plain if not each.empirical)  # of free forms few are
        waves = Waves.of(model, grids, fixed.weighed[:, :asked], value, noise)
        known = [np.zeros(count), *(precision_of(each, each.columns.shape[1]) for each in chosen.plain)]
        equations = assembled(model, covariances, fixed, value, waves).with_precision(np.concatenate(known))
        drawn = noise.products(fixed.within[noise.rows], model.noise.on_nodes(fixed.within))
        found = cls(
            residuals, chosen, cells, model, pose, turn, precision, grids, value, fixed, None, place, waves, drawn, equations
        )  # fmt: skip
        return found._crossed(found.base)

    @cached_property
    def base(self) -> list[int]:
        """Numbers of the pose's columns."""
        return list(range(self.pose.shape[1]))

    @cached_property
    def likely(self) -> list[int]:
        """Numbers of the covariances, that under which the pose alone is most likely first."""
        return [int(row) for row in np.argsort(-self.equations.log_likelihood(self.base)[:, 0], kind="stable")]

    @property
    def null(self) -> Covariance:
        """The covariance that is most likely where there is nothing but pose."""
        return self.equations.at[self.likely[0]]

    @property
    def plain_columns(self) -> list[list[int]]:
        """Numbers of the columns of each plain candidate."""
        return [self.place[candidate] for candidate in self.families.plain]

    def holding(self, candidate: Candidate) -> Design:
        """With a candidate for others to stand beside; the columns of a sine are at its period refined."""
        design = self if candidate in self.place else self._with_sine(candidate)
        return design._crossed(design.place[candidate])

    def _crossed(self, columns: list[int]) -> Design:
        """With the products of the sines with some of the fixed columns."""
        held = self._some(columns)
        if max(columns) < self.waves.fixed.shape[1]:
            within = self.waves.fixed[:, columns]
        else:
            within = wave_products(self.grids, held.weighed, self.model.root)
        products = self.waves.at(self.equations.at, within, held.between)
        return replace(self, equations=self.equations.holding(columns, products))

    def _some(self, columns: list[int]) -> Projected:
        """Some of the fixed columns, or of those of sines, which stand behind them."""
        behind = self.fixed.within.shape[1]
        if self.sines is None or columns[0] < behind:
            return self.fixed.some(columns)
        return self.sines.some([column - behind for column in columns])

    def _with_sine(self, candidate: Candidate) -> Design:
        (found,) = self.refined([candidate])[0]
        added = self.model.project(_without(self.pose, self._matrix([found], None)))
        had = [self.fixed] if self.sines is None else [self.fixed, self.sines]
        equations = extended(self.equations, had, self.value, added)
        start = sum(each.within.shape[1] for each in had)
        place = {**self.place, candidate: list(range(start, start + added.within.shape[1]))}
        return replace(self, sines=Projected.of([*had[1:], added]), equations=equations, place=place)

    def columns(self, candidates: Sequence[Candidate]) -> list[int]:
        """Numbers of the pose's columns and of those of candidates that it holds."""
        return [*self.base, *(column for each in candidates for column in self.place[each])]

    def log_likelihood(self, value: FloatArray, candidate: Candidate) -> float:
        """Of other residuals (n,) of the same points, pose and a candidate fitted."""
        columns = self._pose_columns.beside(self.model.project(_without(self.pose, self._matrix([candidate], None))))
        projected = self.model.project(value[self.model.rows, None] * self.model.root[:, None])
        return fitted(self.model.fine, columns, projected).log_likelihood

    def fit(self, candidates: list[Candidate], slopes: list[FloatArray | None] | None = None) -> MeanFit:
        """Pose (the columns of `Residuals.pose`) and some candidates, at their most likely covariance."""
        turned = np.linalg.inv(self.turn)
        if not candidates:
            known = np.asarray(turned.T @ (self.pose_precision[:, None] * turned), dtype=np.float64)
            found = fitted(self.model.fine, self._pose_columns, self.value, known)
            return replace(found, coefficients=turned @ found.coefficients, covariance=turned @ found.covariance @ turned.T)
        matrix = self._matrix(candidates, slopes)
        columns = self._pose_columns.beside(self.model.project(_without(self.pose, matrix)))
        # the columns are fitted without what the pose explains of them, and the pose by orthonormal ones
        back = np.block(
            [[turned, -turned @ (self.pose.T @ matrix)], [np.zeros((matrix.shape[1], len(turned))), np.eye(matrix.shape[1])]]
        )
        widths = [candidate.columns.shape[1] + (slope is not None) for candidate, slope in _with_slopes(candidates, slopes)]
        typical = [precision_of(each, width) for each, width in zip(candidates, widths, strict=True)]
        precision = np.concatenate([self.pose_precision, *typical])
        found = fitted(self.model.fine, columns, self.value, back.T @ (precision[:, None] * back))
        return replace(found, coefficients=back @ found.coefficients, covariance=back @ found.covariance @ back.T)

    def refined(self, candidates: list[Candidate], rounds: int = 4) -> tuple[list[Candidate], MeanFit]:
        """Candidates with their periods at the top of the likelihood (Gauss-Newton), and the fit of pose and all of them.

        Each sine has three columns in that fit: sine, cosine and the change by its frequency.
        """
        found = list(candidates)
        slopes: list[FloatArray | None] = [None] * len(found)
        if any(candidate.wave is not None for candidate in found):
            for number in range(rounds):
                fit = self.fit(found, slopes)
                start = len(self.base)
                for index, candidate in enumerate(found):
                    width = candidate.columns.shape[1] + (slopes[index] is not None)
                    values, start = fit.coefficients[start : start + width], start + width
                    if candidate.wave is None:
                        continue
                    if slopes[index] is not None and number:
                        found[index] = moved_to(candidate, candidate.wave.refined(candidate.period, float(values[2])))
                    slopes[index] = values[:2]
        return found, self.fit(found, slopes)

    def split(self, values: NDArray[Any], candidates: list[Candidate]) -> list[NDArray[Any]]:
        """The part of a fit's coefficients that belongs to each candidate after the pose, a sine's with that of its frequency."""
        widths = [candidate.columns.shape[1] + (candidate.wave is not None) for candidate in candidates]
        return np.split(values[len(self.base) :], np.cumsum(widths)[:-1]) if candidates else []

    def reference_sigma(self, candidates: list[Candidate]) -> float:
        """Standard deviation of the reference's correlated error beside some candidates, in the observable's unit."""
        return float(np.sqrt(self.fit(candidates).at.ratio)) * self.model.typical_sigma

    def without(self, chosen: list[Candidate]) -> FloatArray:
        """(n,) residuals less pose and the chosen candidates at their most likely values."""
        candidates, fit = self.refined(chosen)
        value = self.residuals.value - self.residuals.pose @ fit.coefficients[: len(self.base)]
        for candidate, coefficients in zip(candidates, self.split(fit.coefficients, candidates), strict=True):
            value = value - candidate.columns @ coefficients[: candidate.columns.shape[1]]
        return np.asarray(value)

    def identifiability(self) -> tuple[list[str], FloatArray, FloatArray]:
        """Names of the families, cosines of their signatures after the pose fit, and the share that survives the pose fit."""
        row = self.likely[0]
        names, matrices = [], []
        for name, (plain, sines) in self.families.members.items():
            candidate = self.families.plain[plain[0]] if plain else self.families.sine(sines[len(sines) // 2])
            if not candidate.empirical:
                names.append(name)
                matrices.append(candidate.columns[self.model.rows, :1] * self.model.root[:, None])
        whole = np.concatenate(matrices, axis=1)
        weight = self.equations.at[row].weight[:, None]
        grams = []
        for columns in (whole, left := _without(self.pose, whole)):
            projected = self.model.project(columns)
            between = projected.between[self.null.length]
            grams.append(projected.within.T @ projected.weighed + (between * weight).T @ between)
        count = len(self.base)
        matrix, pose = grams[1], self.equations.fixed[row][:count, :count]
        found, base = self.model.project(left), self.fixed
        cross = base.within[:, :count].T @ found.weighed
        cross += base.between[self.null.length][:, :count].T @ (weight * found.between[self.null.length])
        matrix = matrix - cross.T @ np.linalg.solve(pose, cross)
        size = np.sqrt(np.maximum(np.diag(matrix), 0))
        full = np.sqrt(np.maximum(np.diag(grams[0]), 1e-200))  # a signature may be 0
        scale = np.maximum(size, 1e-12 * full)
        return names, np.clip(matrix / np.outer(scale, scale), -1, 1), size / full

    @cached_property
    def _pose_columns(self) -> Projected:
        return self.fixed.some(self.base)

    def _matrix(self, candidates: list[Candidate], slopes: list[FloatArray | None] | None) -> FloatArray:
        """Columns of some candidates over sigma; of a sine with its change by the frequency where `slopes` say so."""
        rows, root = self.model.rows, self.model.root[:, None]
        matrices = []
        for candidate, slope in _with_slopes(candidates, slopes):
            wave = candidate.wave
            columns = candidate.columns if wave is None or slope is None else wave.with_slope(candidate.period, slope)
            matrices.append(columns[rows] * root)
        return np.concatenate(matrices, axis=1)


def _columns(model: MeanModel, pose: FloatArray, plain: list[Candidate], place: Mapping[Candidate, list[int]]) -> FloatArray:
    """(n, k) those of the pose, and of candidates without what the pose explains of them, over sigma, in the model's rows."""
    count = pose.shape[1]
    found = np.empty((len(pose), count + sum(len(each) for each in place.values())))
    found[:, :count] = pose

    def fill(candidate: Candidate) -> None:
        columns = slice(place[candidate][0], place[candidate][-1] + 1)
        np.multiply(candidate.columns[model.rows], model.root[:, None], out=found[:, columns])

    map_in_threads(fill, plain)
    _take_off(pose, found[:, count:])
    return found


def _without(pose: FloatArray, columns: FloatArray) -> FloatArray:
    """A shift and a turn of a distant sensor are so much alike that the normal equations would lose what tells them apart."""
    found = columns.copy()
    _take_off(pose, found)
    return found


def _take_off(pose: FloatArray, columns: FloatArray) -> None:
    """What the pose explains, of columns (n, k), in their place."""

    def take(some: slice) -> None:
        columns[:, some] -= pose @ (pose.T @ columns[:, some])

    map_in_threads(take, column_blocks(columns.shape[1]))


def _places(plain: list[Candidate], start: int) -> dict[Candidate, list[int]]:
    place: dict[Candidate, list[int]] = {}
    for candidate in plain:
        place[candidate] = list(range(start, start := start + candidate.columns.shape[1]))
    return place


def _with_slopes(
    candidates: list[Candidate], slopes: list[FloatArray | None] | None
) -> Iterator[tuple[Candidate, FloatArray | None]]:
    return zip(candidates, slopes or [None] * len(candidates), strict=True)
