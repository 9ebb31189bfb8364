"""The columns of every explanation of the mean over one set of points, and their normal equations; nothing of it changes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.mean.candidates import Candidate, SineGrid, prior_precision, with_period
from pipeline.gap.mean.mean_model import CellCovariance, MeanFit, MeanModel, ProjectedColumns, column_chunks, fit_reml
from pipeline.gap.mean.normal_equations import NoiseDraws, NormalEquations, SineProducts, assemble, extend, sine_products
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.residuals.wall_blocks import WallCells
from scene.common.keyed_random import KeyedRandom
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray

NULL_DRAWS = 499
_NULL_ROWS = 8_000


@dataclass(frozen=True, eq=False)
class CandidateFamilies:
    """Explanations with fixed columns, and sines of which a grid of periods is searched."""

    plain: list[Candidate]
    grids: list[SineGrid]

    @classmethod
    def of(cls, families: list[Candidate | SineGrid]) -> CandidateFamilies:
        """Of either kind, in any order; effects of the catalogue come first."""
        plain = sorted((family for family in families if isinstance(family, Candidate)), key=lambda each: each.empirical)
        return cls(plain, [family for family in families if isinstance(family, SineGrid)])

    @cached_property
    def by_name(self) -> dict[str, tuple[list[int], list[int]]]:
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
    families: CandidateFamilies
    cells: WallCells
    model: MeanModel
    pose_basis: FloatArray
    pose_transform: FloatArray
    pose_precision: FloatArray
    grids: list[SineGrid]
    value: ProjectedColumns
    fixed: ProjectedColumns
    sine_columns: ProjectedColumns | None
    column_numbers: Mapping[Candidate, list[int]]
    sine_products: SineProducts
    noise_products: FloatArray
    equations: NormalEquations

    @classmethod
    def of(
        cls,
        residuals: Residuals,
        families: list[Candidate | SineGrid],
        random: KeyedRandom,
        pose_precision: FloatArray | None = None,
    ) -> Design:
        """pose_precision: 0 by default."""
        chosen = CandidateFamilies.of(families)
        cells = WallCells.over(residuals.wall_xy)
        model = MeanModel(cells, residuals.wall_xy, residuals.sigma, residuals.correlated_noise)
        rows, root = model.rows, model.inverse_sigma[:, None]
        pose, turn = np.linalg.qr(residuals.pose_jacobian[rows] * root)
        count = pose.shape[1]
        precision = np.zeros(count) if pose_precision is None else pose_precision
        place = _places(chosen.plain, count)
        fixed = model.project(_columns(model, pose, chosen.plain, place))
        value = model.project(residuals.value[rows, None] * root)
        model, covariances, bases = model.restrict([fixed.select(list(range(count))), fixed], value)
        fixed, value = fixed.in_bases(bases), value.in_bases(bases)
        noise = NoiseDraws.of(model, NULL_DRAWS, _NULL_ROWS, random.child("within"))
        grids = [grid.part(rows) for grid in chosen.grids]
        asked = count + sum(len(place[each]) for each in chosen.plain if not each.empirical)  # of free forms few are
        waves = SineProducts.of(model, grids, fixed.within_weighted[:, :asked], value, noise)
        known = [np.zeros(count), *(prior_precision(each, each.columns.shape[1]) for each in chosen.plain)]
        equations = assemble(model, covariances, fixed, value, waves).with_precision(np.concatenate(known))
        drawn = noise.products(fixed.within[noise.rows], model.within_noise.to_nodes(fixed.within))
        found = cls(
            residuals, chosen, cells, model, pose, turn, precision, grids, value, fixed, None, place, waves, drawn, equations
        )  # fmt: skip
        return found._crossed(found.pose_columns)

    @cached_property
    def pose_columns(self) -> list[int]:
        """Numbers of the pose's columns."""
        return list(range(self.pose_basis.shape[1]))

    @cached_property
    def ranked_covariances(self) -> list[int]:
        """Numbers of the covariances, that under which the pose alone is most likely first."""
        return [int(row) for row in np.argsort(-self.equations.log_likelihood(self.pose_columns)[:, 0], kind="stable")]

    @property
    def null_covariance(self) -> CellCovariance:
        """The covariance that is most likely where there is nothing but pose."""
        return self.equations.covariances[self.ranked_covariances[0]]

    @property
    def plain_columns(self) -> list[list[int]]:
        """Numbers of the columns of each plain candidate."""
        return [self.column_numbers[candidate] for candidate in self.families.plain]

    def conditioned_on(self, candidate: Candidate) -> Design:
        """With a candidate for others to stand beside; the columns of a sine are at its period refined."""
        design = self if candidate in self.column_numbers else self._with_sine(candidate)
        return design._crossed(design.column_numbers[candidate])

    def _crossed(self, columns: list[int]) -> Design:
        """With the products of the sines with some of the fixed columns."""
        held = self._some(columns)
        if max(columns) < self.sine_products.fixed.shape[1]:
            within = self.sine_products.fixed[:, columns]
        else:
            within = sine_products(self.grids, held.within_weighted, self.model.inverse_sigma)
        products = self.sine_products.at(self.equations.covariances, within, held.between)
        return replace(self, equations=self.equations.with_sine_products(columns, products))

    def _some(self, columns: list[int]) -> ProjectedColumns:
        """Some of the fixed columns, or of those of sines, which stand behind them."""
        behind = self.fixed.within.shape[1]
        if self.sine_columns is None or columns[0] < behind:
            return self.fixed.select(columns)
        return self.sine_columns.select([column - behind for column in columns])

    def _with_sine(self, candidate: Candidate) -> Design:
        (found,) = self.fit_refined([candidate])[0]
        added = self.model.project(_without(self.pose_basis, self._matrix([found], None)))
        had = [self.fixed] if self.sine_columns is None else [self.fixed, self.sine_columns]
        equations = extend(self.equations, had, self.value, added)
        start = sum(each.within.shape[1] for each in had)
        place = {**self.column_numbers, candidate: list(range(start, start + added.within.shape[1]))}
        return replace(
            self, sine_columns=ProjectedColumns.concatenate([*had[1:], added]), equations=equations, column_numbers=place
        )

    def columns(self, candidates: Sequence[Candidate]) -> list[int]:
        """Numbers of the pose's columns and of those of candidates that it holds."""
        return [*self.pose_columns, *(column for each in candidates for column in self.column_numbers[each])]

    def log_likelihood(self, value: FloatArray, candidate: Candidate) -> float:
        """Of other residuals (n,) of the same points, pose and a candidate fitted."""
        columns = self._pose_columns.append(self.model.project(_without(self.pose_basis, self._matrix([candidate], None))))
        projected = self.model.project(value[self.model.rows, None] * self.model.inverse_sigma[:, None])
        return fit_reml(self.model.covariances, columns, projected).log_likelihood

    def fit(self, candidates: list[Candidate], slopes: list[FloatArray | None] | None = None) -> MeanFit:
        """Pose (the columns of `Residuals.pose`) and some candidates, at their most likely covariance."""
        turned = np.linalg.inv(self.pose_transform)
        if not candidates:
            known = np.asarray(turned.T @ (self.pose_precision[:, None] * turned), dtype=np.float64)
            found = fit_reml(self.model.covariances, self._pose_columns, self.value, known)
            return replace(found, coefficients=turned @ found.coefficients, covariance=turned @ found.covariance @ turned.T)
        matrix = self._matrix(candidates, slopes)
        columns = self._pose_columns.append(self.model.project(_without(self.pose_basis, matrix)))
        # the columns are fitted without what the pose explains of them, and the pose by orthonormal ones
        back = np.block(
            [
                [turned, -turned @ (self.pose_basis.T @ matrix)],
                [np.zeros((matrix.shape[1], len(turned))), np.eye(matrix.shape[1])],
            ]
        )
        widths = [candidate.columns.shape[1] + (slope is not None) for candidate, slope in _with_slopes(candidates, slopes)]
        typical = [prior_precision(each, width) for each, width in zip(candidates, widths, strict=True)]
        precision = np.concatenate([self.pose_precision, *typical])
        found = fit_reml(self.model.covariances, columns, self.value, back.T @ (precision[:, None] * back))
        return replace(found, coefficients=back @ found.coefficients, covariance=back @ found.covariance @ back.T)

    def fit_refined(self, candidates: list[Candidate], rounds: int = 4) -> tuple[list[Candidate], MeanFit]:
        """Candidates with their periods at the top of the likelihood (Gauss-Newton), and the fit of pose and all of them.

        Each sine has three columns in that fit: sine, cosine and the change by its frequency.
        """
        found = list(candidates)
        slopes: list[FloatArray | None] = [None] * len(found)
        if any(candidate.wave is not None for candidate in found):
            for number in range(rounds):
                fit = self.fit(found, slopes)
                start = len(self.pose_columns)
                for index, candidate in enumerate(found):
                    width = candidate.columns.shape[1] + (slopes[index] is not None)
                    values, start = fit.coefficients[start : start + width], start + width
                    if candidate.wave is None:
                        continue
                    if slopes[index] is not None and number:
                        found[index] = with_period(candidate, candidate.wave.stepped_period(candidate.period, float(values[2])))
                    slopes[index] = values[:2]
        return found, self.fit(found, slopes)

    def split_coefficients(self, values: NDArray[Any], candidates: list[Candidate]) -> list[NDArray[Any]]:
        """The part of a fit's coefficients that belongs to each candidate after the pose, a sine's with that of its frequency."""
        widths = [candidate.columns.shape[1] + (candidate.wave is not None) for candidate in candidates]
        return np.split(values[len(self.pose_columns) :], np.cumsum(widths)[:-1]) if candidates else []

    def reference_sigma(self, candidates: list[Candidate]) -> float:
        """Standard deviation of the reference's correlated error beside some candidates, in the observable's unit."""
        return float(np.sqrt(self.fit(candidates).cell_covariance.variance_ratio)) * self.model.typical_sigma

    def residuals_after(self, chosen: list[Candidate]) -> FloatArray:
        """(n,) residuals less pose and the chosen candidates at their most likely values."""
        candidates, fit = self.fit_refined(chosen)
        value = self.residuals.value - self.residuals.pose_jacobian @ fit.coefficients[: len(self.pose_columns)]
        for candidate, coefficients in zip(candidates, self.split_coefficients(fit.coefficients, candidates), strict=True):
            value = value - candidate.columns @ coefficients[: candidate.columns.shape[1]]
        return np.asarray(value)

    def identifiability(self) -> tuple[list[str], FloatArray, FloatArray]:
        """Names of the families, cosines of their signatures after the pose fit, and the share that survives the pose fit."""
        row = self.ranked_covariances[0]
        names, matrices = [], []
        for name, (plain, sines) in self.families.by_name.items():
            candidate = self.families.plain[plain[0]] if plain else self.families.sine(sines[len(sines) // 2])
            if not candidate.empirical:
                names.append(name)
                matrices.append(candidate.columns[self.model.rows, :1] * self.model.inverse_sigma[:, None])
        whole = np.concatenate(matrices, axis=1)
        weight = self.equations.covariances[row].weight[:, None]
        grams = []
        for columns in (whole, left := _without(self.pose_basis, whole)):
            projected = self.model.project(columns)
            between = projected.between[self.null_covariance.basis]
            grams.append(projected.within.T @ projected.within_weighted + (between * weight).T @ between)
        count = len(self.pose_columns)
        matrix, pose = grams[1], self.equations.fixed[row][:count, :count]
        found, base = self.model.project(left), self.fixed
        cross = base.within[:, :count].T @ found.within_weighted
        cross += base.between[self.null_covariance.basis][:, :count].T @ (weight * found.between[self.null_covariance.basis])
        matrix = matrix - cross.T @ np.linalg.solve(pose, cross)
        size = np.sqrt(np.maximum(np.diag(matrix), 0))
        full = np.sqrt(np.maximum(np.diag(grams[0]), 1e-200))  # a signature may be 0
        scale = np.maximum(size, 1e-12 * full)
        return names, np.clip(matrix / np.outer(scale, scale), -1, 1), size / full

    @cached_property
    def _pose_columns(self) -> ProjectedColumns:
        return self.fixed.select(self.pose_columns)

    def _matrix(self, candidates: list[Candidate], slopes: list[FloatArray | None] | None) -> FloatArray:
        """Columns of some candidates over sigma; of a sine with its change by the frequency where `slopes` say so."""
        rows, root = self.model.rows, self.model.inverse_sigma[:, None]
        matrices = []
        for candidate, slope in _with_slopes(candidates, slopes):
            wave = candidate.wave
            columns = (
                candidate.columns if wave is None or slope is None else wave.with_frequency_derivative(candidate.period, slope)
            )
            matrices.append(columns[rows] * root)
        return np.concatenate(matrices, axis=1)


def _columns(model: MeanModel, pose: FloatArray, plain: list[Candidate], place: Mapping[Candidate, list[int]]) -> FloatArray:
    """(n, k) those of the pose, and of candidates without what the pose explains of them, over sigma, in the model's rows."""
    count = pose.shape[1]
    found = np.empty((len(pose), count + sum(len(each) for each in place.values())))
    found[:, :count] = pose

    def fill(candidate: Candidate) -> None:
        columns = slice(place[candidate][0], place[candidate][-1] + 1)
        np.multiply(candidate.columns[model.rows], model.inverse_sigma[:, None], out=found[:, columns])

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

    map_in_threads(take, column_chunks(columns.shape[1]))


def _places(plain: list[Candidate], start: int) -> dict[Candidate, list[int]]:
    place: dict[Candidate, list[int]] = {}
    for candidate in plain:
        place[candidate] = list(range(start, start := start + candidate.columns.shape[1]))
    return place


def _with_slopes(
    candidates: list[Candidate], slopes: list[FloatArray | None] | None
) -> Iterator[tuple[Candidate, FloatArray | None]]:
    return zip(candidates, slopes or [None] * len(candidates), strict=True)
