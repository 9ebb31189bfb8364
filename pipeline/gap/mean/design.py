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

    @classmethod
    def of(cls, families: list[Candidate | SineGrid]) -> CandidateFamilies:
        """Divide a list of candidate explanations of residuals into those with known columns and sines of unknown period.

        families: the candidates, in any order; a sine of unknown period is one `SineGrid` with all its trial frequencies.
        """
        plain = sorted((family for family in families if isinstance(family, Candidate)), key=lambda each: each.empirical)
        return cls(plain, [family for family in families if isinstance(family, SineGrid)])

    @cached_property
    def by_name(self) -> dict[str, tuple[list[int], list[int]]]:
        """Variants of each family, by the family's name, so that the search can find the best variant of each.

        A family is one explanation of the residuals with all its variants, such as an effect with each camera or period.

        The value is two lists of indices. The first one holds indices into the list `plain` of candidates with known design
        columns. The second one holds numbers of trial sines, as the method `sine` takes them.
        """
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
        """Return a sinusoidal error at one of its trial frequencies as a candidate.

        number: running number of the trial sine, from 0. It counts the trial frequencies of the first sine in the list `grids`,
        then those of the second one, and so on. Raises IndexError if there are fewer.
        """
        for grid in self.grids:
            if number < len(grid.frequencies):
                return grid.candidate(number)
            number -= len(grid.frequencies)
        raise IndexError(number)


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
        within = WithinProducts.of(fixed, value)
        model, covariances, bases = model.restrict(fixed, value, within, count, most_sigma)
        fixed, value = fixed.in_bases(bases), value.in_bases(bases)
        noise = NoiseDraws.of(model, NULL_DRAWS, _NULL_ROWS, random.child("within"))
        grids = [grid.part(rows) for grid in chosen.grids]
        held_count = count + sum(
            len(place[each]) for each in chosen.plain if not each.empirical
        )  # few non-parametric ones are held
        waves = SineProducts.of(model, grids, fixed.within_weighted[:, :held_count], value, noise)
        known = [np.zeros(count), *(prior_precision(each, each.columns.shape[1]) for each in chosen.plain)]
        equations = assemble(covariances, fixed, value, within, waves).with_precision(np.concatenate(known))
        drawn = noise.products(fixed.within[noise.rows], model.within_noise.to_nodes(fixed.within))
        found = cls(
            residuals, chosen, cells, model, pose, turn, precision, grids, value, fixed, None, place, waves, drawn, equations
        )  # fmt: skip
        return found._with_products(found.pose_columns)

    @cached_property
    def pose_columns(self) -> list[int]:
        """Numbers of the design columns of the sensor's pose: 0 to p - 1 for p pose parameters.

        Every model that is fitted contains them; the columns of candidate errors come after them.
        """
        return list(range(self.pose_basis.shape[1]))

    @cached_property
    def ranked_covariances(self) -> list[int]:
        """Trial covariances of the reference surface's error, ranked from the most to the least likely.

        They are indices into `equations.covariances`. The likelihood is that of a fit of the sensor's pose alone, without any
        candidate error. Simulations without an effect save time by using only the first ones.
        """
        return [int(row) for row in np.argsort(-self.equations.log_likelihood(self.pose_columns)[:, 0], kind="stable")]

    @property
    def null_covariance(self) -> CellCovariance:
        """The covariance of the cell means that is most likely if only the sensor's pose is fitted, without any candidate error.

        It is the sum of the reference surface's error, correlated between the cells of the wall, and noise. Simulations
        without a sensor error are drawn under it.
        """
        return self.equations.covariances[self.ranked_covariances[0]]

    @property
    def plain_columns(self) -> list[list[int]]:
        """For each candidate with known design columns, the numbers of its columns, by which it is scored.

        One list for each candidate of `families.plain`, in that order. Sines of unknown period are not among them.
        """
        return [self.column_numbers[candidate] for candidate in self.families.plain]

    def conditioned_on(self, candidate: Candidate) -> Design:
        """Return the regression problem with one candidate error in the model, so that further ones can be scored beside it.

        Its coefficients are then fitted together with those of each further candidate. The period of a sine is first refined
        from the trial frequency to the maximum of the likelihood, and stays fixed from then on.

        Parameters
        ----------
        candidate : The candidate to put into the model, at the same n points. It need not be one of `families`.
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
        added = self._split(found, None)
        had = [self.fixed] if self.sine_columns is None else [self.fixed, self.sine_columns]
        equations = extend(self.equations, had, self.value, added)
        start = sum(each.within.shape[1] for each in had)
        place = {**self.column_numbers, candidate: list(range(start, start + added.within.shape[1]))}
        return replace(
            self, sine_columns=ProjectedColumns.concatenate([*had[1:], added]), equations=equations, column_numbers=place
        )

    def columns(self, candidates: Sequence[Candidate]) -> list[int]:
        """Return the numbers of all design columns of a model, with which its normal equations are solved.

        The columns of the sensor's pose come first, then those of the candidate errors.

        candidates: candidate errors in the model. A sine must have been put into this design by `conditioned_on`.
        """
        return [*self.pose_columns, *(column for each in candidates for column in self.column_numbers[each])]

    def log_likelihood(self, value: FloatArray, candidates: list[Candidate]) -> float:
        """Return the log-likelihood of other residuals of the same points, with the pose and some candidate errors fitted.

        It tells whether residuals become more likely when effects are refitted without linearisation.

        Parameters
        ----------
        value : (n,) the other residuals, in the unit of the observable (m, or px of disparity).
        candidates : The candidate errors.
        """
        columns = ProjectedColumns.concatenate([self._projected_pose, *(self._split(each, None) for each in candidates)])
        projected = self.model.project(value[self.model.rows, None] * self.model.inverse_sigma[:, None])
        return fit_reml(self.model.covariances, columns, projected).log_likelihood

    def fit(self, candidates: list[Candidate], wave_coefficients: list[FloatArray | None] | None = None) -> MeanFit:
        """Fit the sensor's pose and some candidate errors jointly to the residuals by generalised least squares.

        The covariance of the reference surface's error is the one that is most likely for this model.

        Parameters
        ----------
        candidates : Candidate errors to fit; none: the pose alone.
        wave_coefficients : One entry for each candidate. For a sine whose frequency is to be corrected as well: its present (2,)
            sine and cosine coefficients. For any other candidate: None. If None is given instead of a list, no frequency is
            corrected.

        Returns
        -------
        The fit. Its coefficients are those of the pose parameters, as in `residuals.pose_jacobian`, then those of each candidate
        in order. A sine whose frequency is corrected has the correction as its third coefficient.
        """
        turned = np.linalg.inv(self.pose_transform)
        if not candidates:
            known = np.asarray(turned.T @ (self.pose_precision[:, None] * turned), dtype=np.float64)
            found = fit_reml(self.model.covariances, self._projected_pose, self.value, known)
            return replace(found, coefficients=turned @ found.coefficients, covariance=turned @ found.covariance @ turned.T)
        paired = list(zip(candidates, wave_coefficients or [None] * len(candidates), strict=True))
        matrix = np.concatenate([self._over_sigma(*each) for each in paired], axis=1)
        columns = ProjectedColumns.concatenate([self._projected_pose, *(self._split(*each) for each in paired)])
        # the fit uses orthonormal columns of the pose, projected out of the candidates; this matrix transforms back
        back = np.block(
            [
                [turned, -turned @ (self.pose_basis.T @ matrix)],
                [np.zeros((matrix.shape[1], len(turned))), np.eye(matrix.shape[1])],
            ]
        )
        typical = [prior_precision(each, each.columns.shape[1] + (present is not None)) for each, present in paired]
        precision = np.concatenate([self.pose_precision, *typical])
        found = fit_reml(self.model.covariances, columns, self.value, back.T @ (precision[:, None] * back))
        return replace(found, coefficients=back @ found.coefficients, covariance=back @ found.covariance @ back.T)

    def fit_refined(self, candidates: list[Candidate], rounds: int = 4) -> tuple[list[Candidate], MeanFit]:
        """Fit the sensor's pose and some candidate errors jointly, and refine the periods of sines.

        Periods are refined by Gauss-Newton from a trial value to the maximum of the likelihood.

        Parameters
        ----------
        candidates : Candidate errors to fit.
        rounds : Largest number of Gauss-Newton steps.

        Returns
        -------
        The candidates with refined periods, and the joint fit. In it each sine has three coefficients: sine, cosine, and a
        remaining correction of the frequency.
        """
        found = list(candidates)
        wave_coefficients: list[FloatArray | None] = [None] * len(found)
        if any(candidate.wave is not None for candidate in found):
            for _ in range(rounds):
                fit = self.fit(found, wave_coefficients)
                start = len(self.pose_columns)
                for index, candidate in enumerate(found):
                    wave, present = candidate.wave, wave_coefficients[index]
                    width = candidate.columns.shape[1] + (present is not None)
                    values, start = fit.coefficients[start : start + width], start + width
                    if wave is None:
                        continue
                    if present is None:
                        wave_coefficients[index] = values
                        continue
                    period = wave.stepped_period(candidate.period, float(values[2]))
                    wave_coefficients[index] = wave.with_folded_step(values[:2], 1 / period - 1 / candidate.period)
                    found[index] = with_period(candidate, period)
        return found, self.fit(found, wave_coefficients)

    def split_coefficients(self, values: NDArray[Any], candidates: list[Candidate]) -> list[NDArray[Any]]:
        """Divide the coefficients of a joint fit into one array for each candidate error, without those of the pose.

        Parameters
        ----------
        values : (k,) coefficients, as `fit_refined` returns them; or any other array with one value for each coefficient.
        candidates : The fitted candidates, in the order of the fit.

        Returns
        -------
        One array for each candidate; a sine has three values: sine, cosine and correction of the frequency.
        """
        widths = [candidate.columns.shape[1] + (candidate.wave is not None) for candidate in candidates]
        return np.split(values[len(self.pose_columns) :], np.cumsum(widths)[:-1]) if candidates else []

    def reference_sigma(self, candidates: list[Candidate]) -> float:
        """Estimate the standard deviation of the reference surface's spatially correlated error.

        It is in the unit of the observable (m, or px of disparity).

        candidates: candidate sensor errors that are fitted jointly with the pose, so that they do not count as reference
        error.
        """
        return float(np.sqrt(self.fit(candidates).cell_covariance.variance_ratio)) * self.model.typical_sigma

    def residuals_after(self, chosen: list[Candidate]) -> FloatArray:
        """Return the (n,) residuals minus the fitted pose and some fitted errors, to see what these leave unexplained.

        They are in the unit of the observable (m, or px of disparity).

        chosen: candidate errors to fit jointly with the pose; the periods of sines are refined.
        """
        candidates, fit = self.fit_refined(chosen)
        value = self.residuals.value - self.residuals.pose_jacobian @ fit.coefficients[: len(self.pose_columns)]
        for candidate, coefficients in zip(candidates, self.split_coefficients(fit.coefficients, candidates), strict=True):
            value = value - candidate.columns @ coefficients[: candidate.columns.shape[1]]
        return np.asarray(value)

    def identifiability(self) -> tuple[list[str], FloatArray, FloatArray]:
        """Compare the signatures of all effects, to show which sensor errors this measurement cannot tell apart.

        An effect's signature is the pattern of residuals that it makes. Two effects whose signatures have a cosine near 1 in
        magnitude cannot be distinguished. If a change of the sensor's pose makes nearly the same residuals, the effect cannot be
        told from a wrong pose.

        Returns
        -------
        names : The names of f effects, each represented by one variant and its first coefficient.
        cosines : (f, f) cosines between the signatures, after the part that the pose can imitate is taken out of each.
        shares : (f,) share of each signature's norm that is left then, from 0 to 1.
        """
        row = self.ranked_covariances[0]
        names: list[str] = []
        matrices = []
        for name, (plain, sines) in self.families.by_name.items():
            candidate = self.families.plain[plain[0]] if plain else self.families.sine(sines[len(sines) // 2])
            if not candidate.empirical:
                names.append(name)
                matrices.append(candidate.columns[self.model.rows, :1] * self.model.inverse_sigma[:, None])
        if not names:
            return [], np.zeros((0, 0)), np.zeros(0)
        whole = np.concatenate(matrices, axis=1)
        weight = self.equations.covariances[row].weight[:, None]
        whole_split, found = (self.model.project(columns) for columns in (whole, _projected(self.pose_basis, whole)))
        basis, count = self.null_covariance.basis, len(self.pose_columns)

        def products(one: ProjectedColumns, other: ProjectedColumns) -> FloatArray:
            return np.asarray(one.within.T @ other.within_weighted + one.between[basis].T @ (weight * other.between[basis]))

        cross = products(self._projected_pose, found)
        matrix = products(found, found) - cross.T @ np.linalg.solve(self.equations.fixed[row][:count, :count], cross)
        size = np.sqrt(np.maximum(np.diag(matrix), 0))
        full = np.sqrt(np.maximum(np.diag(products(whole_split, whole_split)), 1e-200))  # avoids dividing by a signature of 0
        scale = np.maximum(size, 1e-12 * full)
        return names, np.clip(matrix / np.outer(scale, scale), -1, 1), size / full

    @cached_property
    def _projected_pose(self) -> ProjectedColumns:
        """Projected columns of the pose."""
        return self.fixed.select(self.pose_columns)

    def _split(self, candidate: Candidate, wave_coefficients: FloatArray | None) -> ProjectedColumns:
        """Split columns of a candidate, with the pose projected out. wave_coefficients: as for `_over_sigma`."""
        if candidate.wave is None and candidate in self.column_numbers:
            return self.fixed.select(self.column_numbers[candidate])
        return self.model.project(_projected(self.pose_basis, self._over_sigma(candidate, wave_coefficients)))

    def _over_sigma(self, candidate: Candidate, wave_coefficients: FloatArray | None) -> FloatArray:
        """Columns of a candidate over sigma.

        wave_coefficients: of a sine, its coefficients if its derivative by the frequency is wanted too; else None.
        """
        wave = candidate.wave
        if wave is None or wave_coefficients is None:
            columns = candidate.columns
        else:
            columns = wave.with_frequency_derivative(candidate.period, wave_coefficients)
        return np.asarray(columns[self.model.rows] * self.model.inverse_sigma[:, None])


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
