"""Set up the columns of all candidates of the mean model on one set of points.

Their normal equations are part of the design. Designs are immutable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.mean.candidates import Candidate, SineGrid, prior_precision, with_period
from pipeline.gap.mean.mean_model import CellCovariance, MeanFit, MeanModel, column_chunks, fit_reml
from pipeline.gap.mean.normal_equations import NoiseDraws, NormalEquations, SineProducts, assemble, extend, sine_products
from pipeline.gap.mean.projected_columns import ProjectedColumns, WithinProducts
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
_REFINING_ROUNDS = 4
"""Gauss-Newton steps by which the period of a sine is refined."""


@dataclass(frozen=True, eq=False)
class CandidateFamilies:
    """All candidate explanations of the residuals, divided into those with known design columns and sines of unknown period.

    A family is the set of all variants of one explanation, such as an effect with different cameras or periods. The search
    compares families by their best variants.

    Attributes
    ----------
    plain : Candidates with known design columns; effects of the catalogue come before terms that name no cause.
    grids : Sines of unknown period, each with its grid of trial frequencies.
    """

    plain: list[Candidate]
    grids: list[SineGrid]

    @cached_property
    def sines(self) -> list[Candidate]:
        """All trial sines: the first sine of `grids` at each of its trial frequencies, then the second one, and so on."""
        return [candidate for grid in self.grids for candidate in grid.candidates]

    @cached_property
    def by_name(self) -> dict[str, tuple[list[int], list[int]]]:
        """Variants of each family of candidate errors, by the family's name: indices into `plain`, and indices into `sines`.

        A family is one explanation of the residuals with all its variants, such as an effect with each camera or period.
        """
        families: dict[str, tuple[list[int], list[int]]] = {}
        for kind, candidates in enumerate((self.plain, self.sines)):
            for row, candidate in enumerate(candidates):
                families.setdefault(candidate.family, ([], []))[kind].append(row)
        return families


@dataclass(frozen=True, eq=False)
class Design:
    """The regression problem of one search for systematic errors: n residuals, and the columns of pose and all candidates.

    A candidate is a possible sensor error, or a term that names no cause. Residuals and columns are divided by the predicted
    standard deviation sigma of each point ("over sigma"). Each is then split into its means over square cells of the wall and
    its deviations within these cells: a `ProjectedColumns`. Designs are immutable.

    Attributes
    ----------
    residuals : Residuals of the n points, with the derivatives by the pose (position and orientation of the sensor).
    families : The candidates.
    cells : The square cells of the wall, with the points in each.
    model : Generalised least squares with the covariances of the reference surface's error and of the noise.
    pose_basis : (n, p) orthonormal basis of the p pose columns over sigma; points in the order of `model.rows`.
    pose_transform : (p, p) matrix R with pose columns over sigma = pose_basis R.
    pose_precision : (p,) prior inverse variances of the pose parameters; 0: no prior.
    grids : Sines of unknown period with their trial frequencies; points in the order of `model.rows`.
    value : The residuals over sigma, split.
    fixed : The columns of the pose, then of the candidates with known columns, split.
    sine_columns : Split columns of sines that stay in the model at one period, numbered after those of `fixed`; None without
        any.
    column_numbers : For each candidate the numbers of its columns.
    sine_products : Inner products of the columns of all trial sines with the other columns.
    noise_products : (k, d) inner products of the k columns in `fixed` with d = 499 draws of simulated noise within cells.
    equations : Normal equations of all columns, under each covariance of the reference error that the residuals allow.
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
        """Build the regression problem in which all candidate explanations of some residuals are compared.

        Parameters
        ----------
        residuals : Residuals of the points, with their standard deviations and derivatives by the pose.
        families : Candidates to compare; a sine of unknown period is one `SineGrid`.
        random : Source of the random numbers for the simulated noise.
        pose_precision : (p,) prior inverse variances of the coefficients of `residuals.pose_jacobian`; None: no prior.
        """
        plain = sorted((family for family in families if isinstance(family, Candidate)), key=lambda each: each.empirical)
        chosen = CandidateFamilies(plain, [family for family in families if isinstance(family, SineGrid)])
        cells = WallCells.over(residuals.wall_xy)
        model = MeanModel(cells, residuals.wall_xy, residuals.sigma, residuals.correlated_noise)
        rows, root = model.rows, model.inverse_sigma[:, None]
        pose, turn = np.linalg.qr(residuals.pose_jacobian[rows] * root)
        count = pose.shape[1]
        precision = np.zeros(count) if pose_precision is None else pose_precision
        place = _number_columns(plain, count)
        fixed = model.project(_columns(model, pose, plain, place))
        value = model.project(residuals.value[rows, None] * root)
        most_sigma = thresholds().mean.most_reference_error / float(np.median(residuals.unit_m))
        within = WithinProducts.of(fixed, value)
        model, covariances, bases = model.restrict(fixed, value, within, count, most_sigma)
        fixed, value = fixed.in_bases(bases), value.in_bases(bases)
        noise = NoiseDraws.of(model, NULL_DRAWS, _NULL_ROWS, random.child("within"))
        grids = [grid.part(rows) for grid in chosen.grids]
        held_count = count + sum(len(place[each]) for each in plain if not each.empirical)  # few non-parametric ones are held
        waves = SineProducts.of(model, grids, fixed.within_weighted[:, :held_count], value, noise)
        known = [np.zeros(count), *(prior_precision(each, len(place[each])) for each in plain)]
        equations = assemble(covariances, fixed, value, within, waves, np.concatenate(known))
        drawn = noise.products(fixed.within[noise.rows], model.within_noise.to_nodes(fixed.within))
        found = cls(
            residuals, chosen, cells, model, pose, turn, precision, grids, value, fixed, None, place, waves, drawn, equations
        )  # fmt: skip
        return found._with_products(found.pose_columns)

    @cached_property
    def pose_columns(self) -> list[int]:
        """Numbers of the design columns of the sensor's p pose parameters, 0 to p - 1; every fitted model contains them."""
        return list(range(self.pose_basis.shape[1]))

    @cached_property
    def ranked_covariances(self) -> list[int]:
        """Trial covariances of the reference surface's error, as indices into `equations.covariances`, the most likely first.

        The likelihood is that of a fit of the sensor's pose alone, without any candidate error.
        """
        return [int(row) for row in np.argsort(-self.equations.log_likelihood(self.pose_columns)[:, 0], kind="stable")]

    @property
    def null_covariance(self) -> CellCovariance:
        """The covariance of the cell means (reference error plus noise) that is most likely if only the pose is fitted."""
        return self.equations.covariances[self.ranked_covariances[0]]

    @property
    def plain_columns(self) -> list[list[int]]:
        """For each candidate of `families.plain` (known design columns) in that order, the numbers of its columns."""
        return [self.column_numbers[candidate] for candidate in self.families.plain]

    def conditioned_on(self, candidate: Candidate) -> Design:
        """Return the regression problem with one candidate error in the model, so that further ones can be scored beside it.

        Its coefficients are then fitted together with those of each further candidate. The period of a sine is first refined
        from the trial frequency to the maximum of the likelihood, and stays fixed from then on.

        candidate: the candidate to put into the model, at the same n points; it need not be one of `families`.
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
        added = self._split(found, *self._matrices([found]))
        had = [self.fixed] if self.sine_columns is None else [self.fixed, self.sine_columns]
        equations = extend(self.equations, had, self.value, added)
        start = sum(each.within.shape[1] for each in had)
        place = {**self.column_numbers, candidate: list(range(start, start + added.within.shape[1]))}
        return replace(
            self, sine_columns=ProjectedColumns.concatenate([*had[1:], added]), equations=equations, column_numbers=place
        )

    def columns(self, candidates: Sequence[Candidate]) -> list[int]:
        """Return the numbers of all design columns of a model: those of the sensor's pose, then those of the candidate errors.

        candidates: candidate errors in the model. A sine must have been put into this design by `conditioned_on`.
        """
        return [*self.pose_columns, *(column for each in candidates for column in self.column_numbers[each])]

    def log_likelihood(self, value: FloatArray, candidates: list[Candidate]) -> float:
        """Return the log-likelihood of other residuals of the same points, with the pose and some candidate errors fitted.

        It tells whether residuals become more likely when effects are refitted without linearisation.

        value: (n,) the other residuals, in the unit of the observable (m, or px of disparity). candidates: the candidate errors.
        """
        columns = self._with_pose(candidates, self._matrices(candidates))
        projected = self.model.project(value[self.model.rows, None] * self.model.inverse_sigma[:, None])
        return fit_reml(self.model.covariances, columns, projected).log_likelihood

    def fit(self, candidates: list[Candidate], wave_coefficients: Sequence[FloatArray | None] = ()) -> MeanFit:
        """Fit the sensor's pose and some candidate errors jointly to the residuals by generalised least squares.

        The covariance of the reference surface's error is the one that is most likely for this model.

        Parameters
        ----------
        candidates : Candidate errors to fit; none: the pose alone.
        wave_coefficients : One entry for each candidate. For a sine whose frequency is to be corrected as well: its present (2,)
            sine and cosine coefficients. For any other candidate: None. Empty if no frequency is corrected.

        Returns
        -------
        The fit. Its coefficients are those of the pose parameters, as in `residuals.pose_jacobian`, then those of each candidate
        in order. A sine whose frequency is corrected has the correction as its third coefficient.
        """
        turned = np.linalg.inv(self.pose_transform)
        matrices = self._matrices(candidates, wave_coefficients)
        matrix = np.concatenate([np.empty((len(self.pose_basis), 0)), *matrices], axis=1)
        # the fit uses orthonormal columns of the pose, projected out of the candidates; this matrix transforms back
        below = np.zeros((matrix.shape[1], len(turned)))
        back = np.block([[turned, -turned @ (self.pose_basis.T @ matrix)], [below, np.eye(matrix.shape[1])]])
        typical = [prior_precision(each, own.shape[1]) for each, own in zip(candidates, matrices, strict=True)]
        precision = np.concatenate([self.pose_precision, *typical])
        columns = self._with_pose(candidates, matrices)
        found = fit_reml(self.model.covariances, columns, self.value, back.T @ (precision[:, None] * back))
        return replace(found, coefficients=back @ found.coefficients, covariance=back @ found.covariance @ back.T)

    def fit_refined(self, candidates: list[Candidate]) -> tuple[list[Candidate], MeanFit]:
        """Fit the sensor's pose and some candidate errors jointly, and refine the periods of sines.

        Periods are refined by Gauss-Newton from a trial value to the maximum of the likelihood.

        Returns
        -------
        The candidates with refined periods, and the joint fit. In it each sine has three coefficients: sine, cosine, and a
        remaining correction of the frequency.
        """
        found = list(candidates)
        wave_coefficients: list[FloatArray | None] = [None] * len(found)
        for _ in range(_REFINING_ROUNDS if any(candidate.wave is not None for candidate in found) else 0):
            fit = self.fit(found, wave_coefficients)
            start = len(self.pose_columns)
            for index, candidate in enumerate(found):
                wave, present = candidate.wave, wave_coefficients[index]
                width = candidate.columns.shape[1] + (present is not None)
                values, start = fit.coefficients[start : start + width], start + width
                if wave is not None and present is not None:
                    period = wave.stepped_period(candidate.period, float(values[2]))
                    values = wave.with_folded_step(values[:2], 1 / period - 1 / candidate.period)
                    found[index] = with_period(candidate, period)
                wave_coefficients[index] = None if wave is None else values
        return found, self.fit(found, wave_coefficients)

    def split_coefficients(self, values: NDArray[Any], candidates: list[Candidate]) -> list[NDArray[Any]]:
        """Divide the coefficients of a joint fit into one array for each candidate error, without those of the pose.

        A sine has three values: sine, cosine and correction of the frequency.

        values: (k,) coefficients, as `fit_refined` returns them; or any other array with one value for each coefficient.
        candidates: the fitted candidates, in the order of the fit.
        """
        widths = [candidate.columns.shape[1] + (candidate.wave is not None) for candidate in candidates]
        return np.split(values[len(self.pose_columns) :], np.cumsum(widths)[:-1]) if candidates else []

    def reference_sigma(self, candidates: list[Candidate]) -> float:
        """Estimate the standard deviation of the reference surface's spatially correlated error, m (or px of disparity).

        candidates: candidate sensor errors that are fitted jointly with the pose, so that they do not count as reference error.
        """
        return float(np.sqrt(self.fit(candidates).cell_covariance.variance_ratio)) * self.model.typical_sigma

    def residuals_after(self, chosen: list[Candidate]) -> FloatArray:
        """Return the (n,) residuals minus the fitted pose and some fitted errors, m (or px), to see what these leave unexplained.

        chosen: candidate errors to fit jointly with the pose; the periods of sines are refined.
        """
        candidates, fit = self.fit_refined(chosen)
        value = self.residuals.value - self.residuals.pose_jacobian @ fit.coefficients[: len(self.pose_columns)]
        for candidate, coefficients in zip(candidates, self.split_coefficients(fit.coefficients, candidates), strict=True):
            value = value - candidate.columns @ coefficients[: candidate.columns.shape[1]]
        return np.asarray(value)

    @cached_property
    def identifiability(self) -> tuple[list[str], FloatArray, FloatArray]:
        """Similarity of the signatures of all effects, which shows which sensor errors this measurement cannot tell apart.

        An effect's signature is the pattern of residuals that it makes. Two effects whose signatures have a cosine near 1 in
        magnitude cannot be distinguished. If a change of the sensor's pose makes nearly the same residuals, the effect cannot be
        told from a wrong pose.

        Returns
        -------
        names : The names of f effects, each represented by one variant and its first coefficient.
        cosines : (f, f) cosines between the signatures, after the part that the pose can imitate is taken out of each.
        shares : (f,) share of each signature's norm that is left then, from 0 to 1.
        """
        names: list[str] = []
        matrices = []
        for name, (plain, sines) in self.families.by_name.items():
            candidate = self.families.plain[plain[0]] if plain else self.families.sines[sines[len(sines) // 2]]
            if not candidate.empirical:
                names.append(name)
                matrices.append(candidate.columns[self.model.rows, :1] * self.model.inverse_sigma[:, None])
        if not names:
            return [], np.zeros((0, 0)), np.zeros(0)
        whole = np.concatenate(matrices, axis=1)
        row, count = self.ranked_covariances[0], len(self.pose_columns)
        basis, weight = self.null_covariance.basis, self.null_covariance.weight[:, None]
        parts = [self.model.project(columns) for columns in (whole, _projected(self.pose_basis, whole))]
        before, matrix = (
            each.within.T @ each.within_weighted + (each.between[basis] * weight).T @ each.between[basis] for each in parts
        )
        cross = self.fixed.within[:, :count].T @ parts[1].within_weighted
        cross += self.fixed.between[basis][:, :count].T @ (weight * parts[1].between[basis])
        matrix = matrix - cross.T @ np.linalg.solve(self.equations.fixed[row][:count, :count], cross)
        size = np.sqrt(np.maximum(np.diag(matrix), 0))
        full = np.sqrt(np.maximum(np.diag(before), 1e-200))  # avoids dividing by a signature of 0
        scale = np.maximum(size, 1e-12 * full)
        return names, np.clip(matrix / np.outer(scale, scale), -1, 1), size / full

    @cached_property
    def _projected_pose(self) -> ProjectedColumns:
        """Projected columns of the pose."""
        return self.fixed.select(self.pose_columns)

    def _with_pose(self, candidates: list[Candidate], matrices: list[FloatArray]) -> ProjectedColumns:
        """Split columns of the pose, and of candidates, whose columns (n, k) over sigma are given."""
        split = (self._split(each, own) for each, own in zip(candidates, matrices, strict=True))
        return ProjectedColumns.concatenate([self._projected_pose, *split])

    def _split(self, candidate: Candidate, matrix: FloatArray) -> ProjectedColumns:
        """Split columns of a candidate, with the pose projected out. matrix: (n, k) its columns over sigma."""
        if candidate.wave is None and candidate in self.column_numbers:
            return self._select(self.column_numbers[candidate])
        return self.model.project(_projected(self.pose_basis, matrix))

    def _matrices(self, candidates: list[Candidate], wave_coefficients: Sequence[FloatArray | None] = ()) -> list[FloatArray]:
        """Columns of each candidate over sigma, with a sine's derivative by its frequency if its coefficients are given."""
        rows, root, given = self.model.rows, self.model.inverse_sigma[:, None], wave_coefficients or [None] * len(candidates)
        return [each.columns_with_derivative(known)[rows] * root for each, known in zip(candidates, given, strict=True)]


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
