"""Set up the columns of all candidates of the mean model on one set of points.

Their normal equations are part of the design. Designs are immutable.
"""

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
from pipeline.gap.thresholds import thresholds
from scene.common.keyed_random import KeyedRandom
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray

NULL_DRAWS = 499
"""Number of simulations of the null distribution."""
_NULL_ROWS = 8_000
"""Most points on which white noise is drawn."""


@dataclass(frozen=True, eq=False)
class CandidateFamilies:
    """All candidates of a search, divided into those with fixed design columns and sines whose period is searched.

    A family is the set of all variants of one explanation, such as an effect with different cameras or periods.

    Attributes
    ----------
    plain : Candidates with fixed columns; effects of the catalogue come before non-parametric terms.
    grids : Sines, each with a grid of frequencies.
    """

    plain: list[Candidate]
    grids: list[SineGrid]

    @classmethod
    def of(cls, families: list[Candidate | SineGrid]) -> CandidateFamilies:
        """Divide a list of candidates and sine grids into the two kinds."""
        plain = sorted((family for family in families if isinstance(family, Candidate)), key=lambda each: each.empirical)
        return cls(plain, [family for family in families if isinstance(family, SineGrid)])

    @cached_property
    def by_name(self) -> dict[str, tuple[list[int], list[int]]]:
        """For the name of each family, two lists of indices: its candidates in `plain`, and its sines as `sine` counts them."""
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
        """Return one sine as a candidate.

        `number` counts through the frequencies of the first element of `grids`, then through those of the next, from 0. Raises
        IndexError if there are fewer.
        """
        for grid in self.grids:
            if number < len(grid.frequencies):
                return grid.candidate(number)
            number -= len(grid.frequencies)
        raise IndexError(number)


@dataclass(frozen=True, eq=False)
class Design:
    """The regression problem of one search: residuals at n points, with the columns of the pose and of all candidates.

    Columns are divided by the predicted standard deviation and projected into two parts: deviations within cells of the
    wall, and cell means (see `ProjectedColumns`). Designs are immutable.

    Attributes
    ----------
    residuals : The residuals.
    families : The candidates.
    cells : The cells into which the wall is divided.
    model : The mean model, with the covariances of reference error and noise.
    pose_basis : (n, p) orthonormal basis of the pose Jacobian over sigma; rows as in `model.rows`.
    pose_transform : (p, p) matrix R with pose Jacobian over sigma = pose_basis R.
    pose_precision : (p,) prior inverse variances of the pose parameters.
    grids : The sine grids; rows as in `model.rows`.
    value : The residuals over sigma, projected.
    fixed : The columns of the pose, then of the candidates with fixed columns, projected.
    sine_columns : Projected columns of sines that are held at one period, numbered after those of `fixed`; None without any.
    column_numbers : For each candidate the numbers of its columns.
    sine_products : Inner products of the columns of the searched sines.
    noise_products : (k, NULL_DRAWS) inner products of the fixed columns with simulated noise within cells.
    equations : Normal equations under each covariance that the residuals allow.
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
        """Build the design of a search.

        Parameters
        ----------
        residuals : Residuals of the points.
        families : Candidates and sine grids to try.
        random : Source of the random numbers for the simulated noise.
        pose_precision : (p,) prior inverse variances of the pose parameters; None: no prior.
        """
        chosen = CandidateFamilies.of(families)
        cells = WallCells.over(residuals.wall_xy)
        model = MeanModel(cells, residuals.wall_xy, residuals.sigma, residuals.correlated_noise)
        rows, root = model.rows, model.inverse_sigma[:, None]
        pose, turn = np.linalg.qr(residuals.pose_jacobian[rows] * root)
        count = pose.shape[1]
        precision = np.zeros(count) if pose_precision is None else pose_precision
        place = _number_columns(chosen.plain, count)
        fixed = model.project(_columns(model, pose, chosen.plain, place))
        value = model.project(residuals.value[rows, None] * root)
        most_sigma = thresholds().mean.most_reference_error / float(np.median(residuals.unit_m))
        model, covariances, bases = model.restrict([fixed.select(list(range(count))), fixed], value, most_sigma)
        fixed, value = fixed.in_bases(bases), value.in_bases(bases)
        noise = NoiseDraws.of(model, NULL_DRAWS, _NULL_ROWS, random.child("within"))
        grids = [grid.part(rows) for grid in chosen.grids]
        held_count = count + sum(
            len(place[each]) for each in chosen.plain if not each.empirical
        )  # few non-parametric ones are held
        waves = SineProducts.of(model, grids, fixed.within_weighted[:, :held_count], value, noise)
        known = [np.zeros(count), *(prior_precision(each, each.columns.shape[1]) for each in chosen.plain)]
        equations = assemble(model, covariances, fixed, value, waves).with_precision(np.concatenate(known))
        drawn = noise.products(fixed.within[noise.rows], model.within_noise.to_nodes(fixed.within))
        found = cls(
            residuals, chosen, cells, model, pose, turn, precision, grids, value, fixed, None, place, waves, drawn, equations
        )  # fmt: skip
        return found._with_products(found.pose_columns)

    @cached_property
    def pose_columns(self) -> list[int]:
        """Numbers of the columns of the pose, which come first."""
        return list(range(self.pose_basis.shape[1]))

    @cached_property
    def ranked_covariances(self) -> list[int]:
        """Indices into `equations.covariances`, by the likelihood of a fit of the pose alone, the most likely first."""
        return [int(row) for row in np.argsort(-self.equations.log_likelihood(self.pose_columns)[:, 0], kind="stable")]

    @property
    def null_covariance(self) -> CellCovariance:
        """The covariance of the cell means that is most likely if only the pose is fitted."""
        return self.equations.covariances[self.ranked_covariances[0]]

    @property
    def plain_columns(self) -> list[list[int]]:
        """For each candidate of `families.plain`, the numbers of its columns."""
        return [self.column_numbers[candidate] for candidate in self.families.plain]

    def conditioned_on(self, candidate: Candidate) -> Design:
        """Return the design in which further candidates can be scored in addition to the given one.

        A sine is held at its period, refined to the maximum of the likelihood.
        """
        design = self if candidate in self.column_numbers else self._with_sine(candidate)
        return design._with_products(design.column_numbers[candidate])

    def _with_products(self, columns: list[int]) -> Design:
        """Add the products of the sines with some of the fixed columns."""
        held = self._select(columns)
        if max(columns) < self.sine_products.fixed.shape[1]:
            within = self.sine_products.fixed[:, columns]
        else:
            within = sine_products(self.grids, held.within_weighted, self.model.inverse_sigma)
        products = self.sine_products.at(self.equations.covariances, within, held.between)
        return replace(self, equations=self.equations.with_sine_products(columns, products))

    def _select(self, columns: list[int]) -> ProjectedColumns:
        """Some of the fixed columns, including those of sines."""
        behind = self.fixed.within.shape[1]
        if self.sine_columns is None or columns[0] < behind:
            return self.fixed.select(columns)
        return self.sine_columns.select([column - behind for column in columns])

    def _with_sine(self, candidate: Candidate) -> Design:
        """Make a sine, with its period refined, a fixed column."""
        (found,) = self.fit_refined([candidate])[0]
        added = self.model.project(_projected(self.pose_basis, self._matrix([found], None)))
        had = [self.fixed] if self.sine_columns is None else [self.fixed, self.sine_columns]
        equations = extend(self.equations, had, self.value, added)
        start = sum(each.within.shape[1] for each in had)
        place = {**self.column_numbers, candidate: list(range(start, start + added.within.shape[1]))}
        return replace(
            self, sine_columns=ProjectedColumns.concatenate([*had[1:], added]), equations=equations, column_numbers=place
        )

    def columns(self, candidates: Sequence[Candidate]) -> list[int]:
        """Return the column numbers of the pose and of candidates on which this design is conditioned."""
        return [*self.pose_columns, *(column for each in candidates for column in self.column_numbers[each])]

    def log_likelihood(self, value: FloatArray, candidate: Candidate) -> float:
        """Return the log-likelihood of a fit of the pose and one candidate to other residuals of the same points.

        Parameters
        ----------
        value : (n,) residuals, in the unit of the observable.
        candidate : The candidate.
        """
        columns = self._projected_pose.append(self.model.project(_projected(self.pose_basis, self._matrix([candidate], None))))
        projected = self.model.project(value[self.model.rows, None] * self.model.inverse_sigma[:, None])
        return fit_reml(self.model.covariances, columns, projected).log_likelihood

    def fit(self, candidates: list[Candidate], wave_coefficients: list[FloatArray | None] | None = None) -> MeanFit:
        """Fit the pose and some candidates jointly, under the covariance of the reference error that is most likely for them.

        Parameters
        ----------
        candidates : Candidates to fit.
        wave_coefficients : For each candidate, the present (2,) coefficients of its sine, if a change of its frequency is to be
            fitted too, else None. None altogether: no frequency is fitted.

        Returns
        -------
        The fit. Its coefficients are those of `Residuals.pose_jacobian`, then those of each candidate.
        """
        turned = np.linalg.inv(self.pose_transform)
        if not candidates:
            known = np.asarray(turned.T @ (self.pose_precision[:, None] * turned), dtype=np.float64)
            found = fit_reml(self.model.covariances, self._projected_pose, self.value, known)
            return replace(found, coefficients=turned @ found.coefficients, covariance=turned @ found.covariance @ turned.T)
        matrix = self._matrix(candidates, wave_coefficients)
        columns = self._projected_pose.append(self.model.project(_projected(self.pose_basis, matrix)))
        # the fit uses orthonormal columns of the pose, projected out of the candidates; this matrix transforms back
        back = np.block(
            [
                [turned, -turned @ (self.pose_basis.T @ matrix)],
                [np.zeros((matrix.shape[1], len(turned))), np.eye(matrix.shape[1])],
            ]
        )
        widths = [
            candidate.columns.shape[1] + (coefficients is not None)
            for candidate, coefficients in _with_wave_coefficients(candidates, wave_coefficients)
        ]
        typical = [prior_precision(each, width) for each, width in zip(candidates, widths, strict=True)]
        precision = np.concatenate([self.pose_precision, *typical])
        found = fit_reml(self.model.covariances, columns, self.value, back.T @ (precision[:, None] * back))
        return replace(found, coefficients=back @ found.coefficients, covariance=back @ found.covariance @ back.T)

    def fit_refined(self, candidates: list[Candidate], rounds: int = 4) -> tuple[list[Candidate], MeanFit]:
        """Fit the pose and some candidates jointly, with the periods of sines refined to the maximum of the likelihood.

        Periods are refined by Gauss-Newton.

        Parameters
        ----------
        candidates : Candidates to fit; sines have a period from the search grid.
        rounds : Largest number of Gauss-Newton steps.

        Returns
        -------
        The candidates with refined periods, and the joint fit. In it each sine has three coefficients: sine, cosine and change of
        the frequency.
        """
        found = list(candidates)
        wave_coefficients: list[FloatArray | None] = [None] * len(found)
        if any(candidate.wave is not None for candidate in found):
            for number in range(rounds):
                fit = self.fit(found, wave_coefficients)
                start = len(self.pose_columns)
                for index, candidate in enumerate(found):
                    width = candidate.columns.shape[1] + (wave_coefficients[index] is not None)
                    values, start = fit.coefficients[start : start + width], start + width
                    if candidate.wave is None:
                        continue
                    if wave_coefficients[index] is not None and number:
                        found[index] = with_period(candidate, candidate.wave.stepped_period(candidate.period, float(values[2])))
                    wave_coefficients[index] = values[:2]
        return found, self.fit(found, wave_coefficients)

    def split_coefficients(self, values: NDArray[Any], candidates: list[Candidate]) -> list[NDArray[Any]]:
        """Divide the coefficients of `fit_refined` by candidate, and drop those of the pose.

        Parameters
        ----------
        values : (k,) coefficients, or any other array with one value for each coefficient.
        candidates : The fitted candidates, in their order.
        """
        widths = [candidate.columns.shape[1] + (candidate.wave is not None) for candidate in candidates]
        return np.split(values[len(self.pose_columns) :], np.cumsum(widths)[:-1]) if candidates else []

    def reference_sigma(self, candidates: list[Candidate]) -> float:
        """Return the standard deviation of the reference's correlated error, estimated with some candidates in the model.

        It is in the unit of the observable (m, or px of disparity).
        """
        return float(np.sqrt(self.fit(candidates).cell_covariance.variance_ratio)) * self.model.typical_sigma

    def residuals_after(self, chosen: list[Candidate]) -> FloatArray:
        """Return the (n,) residuals minus the fitted pose and the fitted candidates, in the unit of the observable."""
        candidates, fit = self.fit_refined(chosen)
        value = self.residuals.value - self.residuals.pose_jacobian @ fit.coefficients[: len(self.pose_columns)]
        for candidate, coefficients in zip(candidates, self.split_coefficients(fit.coefficients, candidates), strict=True):
            value = value - candidate.columns @ coefficients[: candidate.columns.shape[1]]
        return np.asarray(value)

    def identifiability(self) -> tuple[list[str], FloatArray, FloatArray]:
        """Compare the signatures of the effects with each other and with the pose.

        Two effects with a cosine near 1 in magnitude cannot be told apart; an effect with a share near 0 cannot be told
        from the pose.

        Returns
        -------
        Names (f) of the families; (f, f) cosines between their signatures after the pose is projected out; and (f,) the share of
        each signature that is left then.
        """
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
        for columns in (whole, left := _projected(self.pose_basis, whole)):
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
        full = np.sqrt(np.maximum(np.diag(grams[0]), 1e-200))  # avoids dividing by a signature of 0
        scale = np.maximum(size, 1e-12 * full)
        return names, np.clip(matrix / np.outer(scale, scale), -1, 1), size / full

    @cached_property
    def _projected_pose(self) -> ProjectedColumns:
        """Projected columns of the pose."""
        return self.fixed.select(self.pose_columns)

    def _matrix(self, candidates: list[Candidate], wave_coefficients: list[FloatArray | None] | None) -> FloatArray:
        """Columns of some candidates over sigma, with a sine's derivative by its frequency if its coefficients are given."""
        rows, root = self.model.rows, self.model.inverse_sigma[:, None]
        matrices = []
        for candidate, coefficients in _with_wave_coefficients(candidates, wave_coefficients):
            wave = candidate.wave
            columns = (
                candidate.columns
                if wave is None or coefficients is None
                else wave.with_frequency_derivative(candidate.period, coefficients)
            )
            matrices.append(columns[rows] * root)
        return np.concatenate(matrices, axis=1)


def _columns(model: MeanModel, pose: FloatArray, plain: list[Candidate], place: Mapping[Candidate, list[int]]) -> FloatArray:
    """(n, k) columns over sigma, in the model's rows: the pose, and candidates with the pose projected out."""
    count = pose.shape[1]
    found = np.empty((len(pose), count + sum(len(each) for each in place.values())))
    found[:, :count] = pose

    def fill(candidate: Candidate) -> None:
        columns = slice(place[candidate][0], place[candidate][-1] + 1)
        np.multiply(candidate.columns[model.rows], model.inverse_sigma[:, None], out=found[:, columns])

    map_in_threads(fill, plain)
    _project_out(pose, found[:, count:])
    return found


def _projected(pose: FloatArray, columns: FloatArray) -> FloatArray:
    """Columns with the pose projected out.

    Shift and rotation of a distant sensor are so similar that the normal equations alone would lose their difference.
    """
    found = columns.copy()
    _project_out(pose, found)
    return found


def _project_out(pose: FloatArray, columns: FloatArray) -> None:
    """Project the pose out of columns (n, k), in place."""

    def take(some: slice) -> None:
        columns[:, some] -= pose @ (pose.T @ columns[:, some])

    map_in_threads(take, column_chunks(columns.shape[1]))


def _number_columns(plain: list[Candidate], start: int) -> dict[Candidate, list[int]]:
    """Numbers of the columns of each candidate, from `start`."""
    place: dict[Candidate, list[int]] = {}
    for candidate in plain:
        place[candidate] = list(range(start, start := start + candidate.columns.shape[1]))
    return place


def _with_wave_coefficients(
    candidates: list[Candidate], wave_coefficients: list[FloatArray | None] | None
) -> Iterator[tuple[Candidate, FloatArray | None]]:
    """Pair candidates with the coefficients of their sines."""
    return zip(candidates, wave_coefficients or [None] * len(candidates), strict=True)
