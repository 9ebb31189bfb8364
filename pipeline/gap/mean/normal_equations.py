"""Hold the normal equations of all candidates under every covariance of the cells' means, to compare any sets of them quickly.

Products of fixed columns with each other are all known. Of each searched sine only the products with itself and with the held
columns are known: those of the effects that others are fitted beside (`with_sine_products`). A sine that is itself to be held
becomes a fixed column first (`extend`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.mean.candidates import SineGrid
from pipeline.gap.mean.mean_model import CellCovariance, MeanModel
from pipeline.gap.mean.projected_columns import ProjectedColumns, WithinProducts
from scene.common.keyed_random import KeyedRandom
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray

_SMALLEST = 1e-9
"""Share of a column's variance that others must leave for its log-likelihood ratio not to be rounding error."""
_RIDGE = 1e-12
"""Relative ridge that keeps matrices regular."""
_AT_ONCE = 8
"""Covariances processed together, whatever the number of threads: fewer would cost more in calls than a second core gains."""


@dataclass(frozen=True)
class SineProducts:
    """Inner products of the design columns of w trial sines with other columns, from which normal equations are built.

    A trial sine is a sinusoidal error at one trial frequency; it has two columns, sine and cosine. Each column is split into
    its means over m cells of the wall and its deviations within the cells. Products "within cells" are those of the deviations,
    weighted by the inverse covariance of their noise. Products of the means depend on the covariance of the reference surface's
    error; the method `at` adds them.

    Attributes
    ----------
    fixed : (2 w, k) products within cells with the first k columns of the pose and of candidates that have known columns.
    own : (w, 2, 2) products within cells of each sine's two columns with each other.
    right : (2 w, v) products within cells with v columns of residuals.
    noise : (2 w, d) products within cells with d draws of simulated noise.
    between : For each trial correlation function of the reference's error, the (m, 2 w) cell means of the sines, as coordinates
        in its eigenvectors.
    """

    fixed: FloatArray
    own: FloatArray
    right: FloatArray
    noise: FloatArray
    between: list[FloatArray]

    @classmethod
    def of(
        cls, model: MeanModel, grids: list[SineGrid], fixed: FloatArray, value: ProjectedColumns, noise: NoiseDraws
    ) -> SineProducts:
        """Compute the inner products of the columns of all trial sines with other design columns, residuals and noise.

        From them a search scores a sinusoidal error at every trial frequency without returning to the points.

        Parameters
        ----------
        model : Generalised least squares with the cells of the wall, the points in them, and the covariances to try.
        grids : Sines of unknown period, each with its trial frequencies; together w trial sines.
        fixed : (n, k) deviations of the other columns within cells at n points, times the inverse covariance of the noise.
        value : v columns of residuals, split into cell means and deviations within cells.
        noise : d draws of simulated noise within cells.
        """
        beside = np.concatenate([fixed, value.within_weighted], axis=1)

        def some(grid: SineGrid) -> tuple[FloatArray, ...]:
            columns = grid.columns(model.inverse_sigma)
            planes = model.plane_coefficients(columns)
            means = planes[: model.cells]
            on_nodes = model.within_noise.to_nodes(columns, means)
            own = (
                _squares(columns) - _squares(planes) - _squares(model.within_noise.whiten(on_nodes))
            ) / model.within_noise.white
            drawn = noise.products(model.deviations(columns, planes, noise.rows), on_nodes)
            return columns.T @ beside, own, drawn, means.T

        parts = map_in_threads(some, [part for grid in grids for part in grid.chunks])
        count = fixed.shape[1]
        if not parts:
            empty = np.zeros((0, count)), np.zeros((0, 2, 2)), np.zeros((0, value.within.shape[1]))
            return cls(*empty, np.zeros((0, noise.white.shape[1])), model.in_bases(np.zeros((model.cells, 0))))
        products, own, drawn, means = (np.concatenate([part[k] for part in parts]) for k in range(4))
        return cls(products[:, :count], own, products[:, count:], drawn, model.in_bases(means.T))

    def at(self, covariances: list[CellCovariance], within: FloatArray, between: list[FloatArray]) -> FloatArray:
        """Return the inner products of w trial sines with other columns under each of C trial covariances, for normal equations.

        Each is the sum of a product of deviations within the cells of the wall, which is given, and one of cell means, which
        depends on the covariance.

        Parameters
        ----------
        covariances : The C trial covariances of the cell means: error of the reference surface plus noise.
        within : (2 w, a) products of the sines' deviations within cells with those of `a` other columns.
        between : For each trial correlation function of the reference's error, the (m, a) means of the other columns in m cells,
            as coordinates in its eigenvectors.

        Returns
        -------
        (C, 2 w, a) products; each sine has two columns, sine and cosine.
        """
        found = np.empty((len(covariances), *within.shape))
        for basis, rows in _by_basis(covariances).items():
            weighted = [between[basis] * covariances[row].weight[:, None] for row in rows]
            products = self.between[basis].T @ np.concatenate(weighted, axis=1)
            found[rows] = within + products.reshape(len(within), len(rows), within.shape[1]).transpose(1, 0, 2)
        return found

    def own_at(self, covariances: list[CellCovariance]) -> FloatArray:
        """Return the (C, w, 2, 2) products of each of w sines' two columns with each other under each of C trial covariances."""
        found = np.empty((len(covariances), *self.own.shape))
        for basis, rows in _by_basis(covariances).items():
            weights = np.stack([covariances[row].weight for row in rows])
            pair = self.between[basis][:, 0::2], self.between[basis][:, 1::2]
            for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
                found[rows, :, i, j] = self.own[:, i, j] + weights @ (pair[i] * pair[j])
        return found


def _by_basis(covariances: list[CellCovariance]) -> dict[int, list[int]]:
    """For each basis in use the numbers of its covariances."""
    found: dict[int, list[int]] = {}
    for row, each in enumerate(covariances):
        found.setdefault(each.basis, []).append(row)
    return found


@dataclass(frozen=True, eq=False)
class NoiseDraws:
    """Simulated noise of n points, from which the random error of the coefficient of any design column is computed.

    It shows how well candidate errors explain noise by chance. The noise consists of white noise, and of noise that
    neighbouring points share: random values at q nodes of a pixel grid, interpolated between them.

    Attributes
    ----------
    rows : Slice that selects the n' points on which white noise is drawn, a subsample that saves time.
    white : (n', d) white noise of d draws (realisations), scaled as `products` needs it; in single precision, which is enough.
    on_nodes : (q, d) what the shared noise adds to the random error of a coefficient, per grid node (`WithinCellNoise.draw`).
    """

    rows: slice
    white: NDArray[np.float32]
    on_nodes: FloatArray

    @classmethod
    def of(cls, model: MeanModel, count: int, most_rows: int, random: KeyedRandom) -> NoiseDraws:
        """Draw d independent realisations of the noise of n points, as the null simulations need it.

        To save time, white noise is drawn at n' of the n points only and multiplied by sqrt(n / n'). The inner product of a
        design column with it then has the same variance as over all points.

        Parameters
        ----------
        model : The mean model, which has the points and the covariance of the noise.
        count : Number d of draws.
        most_rows : Approximate largest number n' of points on which white noise is drawn.
        random : Source of the random numbers.
        """
        rows = slice(None, None, max(len(model) // most_rows, 1))
        subsample_size = len(model.inverse_sigma[rows])
        white = random.generator().standard_normal((subsample_size, count)) * np.sqrt(len(model) / subsample_size)
        on_nodes = model.within_noise.draw(
            white, rows, model.plane_coefficients(white, rows)[: model.cells], random.child("nodes")
        )
        return cls(rows, (white / np.sqrt(model.within_noise.white)).astype(np.float32), on_nodes)

    def products(self, within: FloatArray, on_nodes: FloatArray) -> FloatArray:
        """Return the inner products of k design columns with d draws of simulated noise.

        The (k, d) products are weighted by the inverse covariance of the noise. They are what noise alone adds to the right-hand
        side of the normal equations.

        within: (n', k) columns minus their mean (or plane) in each cell of the wall, at the n' points on which white noise is
        drawn. on_nodes: (q, k) columns projected on the q nodes of the pixel grid (`WithinCellNoise.to_nodes`).
        """
        return np.asarray(within.astype(np.float32).T @ self.white + on_nodes.T @ self.on_nodes)


def _squares(columns: FloatArray) -> FloatArray:
    """(w, 2, 2) products of each pair of columns (n, 2 w) with itself."""
    pairs = columns.T.reshape(columns.shape[1] // 2, 2, len(columns))
    return np.asarray(pairs @ pairs.transpose(0, 2, 1))


def sine_products(grids: list[SineGrid], weighed: FloatArray, root: FloatArray) -> FloatArray:
    """Compute the (2 w, k) products of the sine and cosine columns of w trial sines with k columns, such as those of an effect.

    With them, sinusoidal errors are scored beside that effect. Only the part within the cells of the wall is computed.

    Parameters
    ----------
    grids : Sines of unknown period, each with its trial frequencies; together w trial sines.
    weighed : (n, k) deviations of the other columns within cells at n points, times the inverse covariance of the noise.
    root : (n,) inverse standard deviations of the points.
    """
    found = map_in_threads(lambda part: part.columns(root).T @ weighed, [part for grid in grids for part in grid.chunks])
    return np.concatenate(found) if found else np.zeros((0, weighed.shape[1]))


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations X' V^-1 X b = X' V^-1 y of pose and all candidate errors, under each of C trial covariances V.

    X are design columns, b their coefficients and y residuals. From the equations, any set of candidates is scored without
    returning to the points. There are k fixed columns, of the pose and of candidates with known columns, and w sines at trial
    frequencies. A sine is only scored beside held columns: the h fixed columns of the pose and of effects that stay in the
    model.

    Attributes
    ----------
    covariances : The C trial covariances of the mean residuals in the cells of the wall: reference error plus noise.
    fixed : (C, k, k) inner products of the k fixed columns.
    right : (C, k, v) inner products of the fixed columns with v columns of residuals, measured or simulated.
    constant : (C, v) log-likelihood of the residuals without any column.
    wave_fixed : (C, 2 w, h) inner products of the sine and cosine columns of w sines with the held columns.
    wave_own : (C, w, 2, 2) inner products of each sine's two columns with each other.
    wave_right : (C, 2 w, v) inner products of the sines with the residuals.
    held_columns : Numbers of the h held columns among the fixed ones.
    """

    covariances: list[CellCovariance]
    fixed: FloatArray
    right: FloatArray
    constant: FloatArray
    wave_fixed: FloatArray
    wave_own: FloatArray
    wave_right: FloatArray
    held_columns: tuple[int, ...] = ()

    def with_sine_products(self, columns: list[int], products: FloatArray) -> NormalEquations:
        """Return normal equations with which sines can also be scored beside further columns, such as those of a selected effect.

        columns: numbers of the `a` further design columns. products: (C, 2 w, a) inner products of these columns with the sine
        and cosine columns of w trial sines, under each of C trial covariances.
        """
        return replace(
            self, wave_fixed=np.concatenate([self.wave_fixed, products], axis=2), held_columns=(*self.held_columns, *columns)
        )

    def at_covariances(self, chosen: list[int] | slice) -> NormalEquations:
        """Return the normal equations under only some of the trial covariances, such as the most likely ones, to save time.

        chosen: indices into `covariances`, in the wanted order, or a slice of them.
        """
        at = self.covariances[chosen] if isinstance(chosen, slice) else [self.covariances[index] for index in chosen]
        names = ("fixed", "right", "constant", "wave_fixed", "wave_own", "wave_right")
        return replace(self, covariances=at, **{name: getattr(self, name)[chosen] for name in names})

    def log_likelihood(self, base: list[int]) -> FloatArray:
        """Return the (C, v) log-likelihoods of v columns of residuals under C trial covariances, with some columns fitted.

        base: numbers of the design columns of which the model consists.
        """
        right = self.right[:, base]
        return np.asarray(self.constant + 0.5 * np.einsum("ckv,ckv->cv", right, self.solved(base, right)))

    def solved(self, base: list[int], right: FloatArray) -> FloatArray:
        """Solve the normal equations of some design columns under each of C trial covariances for (C, b, a) coefficients.

        base: numbers of the b columns to fit. right: (C, b, a) right-hand sides: inner products of these columns with the `a`
        vectors that are to be fitted, such as residuals, under each covariance.
        """
        matrix = self.fixed[:, base][:, :, base]
        scale = 1 / np.sqrt(np.maximum(np.einsum("ckk->ck", matrix), 1e-300))
        regular = matrix * scale[:, :, None] * scale[:, None, :] + _RIDGE * np.eye(len(base))
        return np.asarray(np.linalg.solve(regular, right * scale[:, :, None]) * scale[:, :, None])

    def profile_log_likelihood(self, base: list[int], fixed: list[list[int]]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute how likely the residuals are with each candidate error added to a base model, to score the candidates.

        The profile log-likelihood is the maximum over the coefficients and over the C trial covariances.

        base: numbers of the design columns of the base model, such as those of the pose; they must be in `held_columns`. fixed:
        for each of f candidates with known columns, the numbers of its columns.

        Returns
        -------
        plain : (v,) log-likelihoods of the base model alone, for v columns of residuals.
        added : (f, v) log-likelihoods with each candidate added.
        waves : (w, v) log-likelihoods with each of the w trial sines added.
        """
        parts = [self.at_covariances(slice(start, start + _AT_ONCE)) for start in range(0, len(self.covariances), _AT_ONCE)]
        found = map_in_threads(lambda part: part._profile_chunk(base, fixed), parts)
        plain, added, waves = (np.max([each[kind] for each in found], axis=0) for kind in range(3))
        return plain, added, waves

    def _profile_chunk(self, base: list[int], fixed: list[list[int]]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute `profile_log_likelihood` for a few covariances at once."""
        count, whole = self.right.shape[2], self.fixed.shape[2]
        waves = self.wave_fixed[:, :, [self.held_columns.index(column) for column in base]]
        beside = self.fixed[:, base]
        solved = self.solved(base, np.concatenate([self.right[:, base], beside, waves.transpose(0, 2, 1)], axis=2))
        value, others, sines = np.split(solved, [count, count + whole], axis=2)
        plain = self.constant + 0.5 * np.einsum("ckv,ckv->cv", self.right[:, base], value)
        left = self.right - beside.transpose(0, 2, 1) @ value
        heights = np.zeros((len(fixed), count))
        for size in {len(columns) for columns in fixed}:
            rows = [row for row, columns in enumerate(fixed) if len(columns) == size]
            columns = np.array([fixed[row] for row in rows])
            own = self.fixed[:, columns[:, :, None], columns[:, None, :]]
            rest = own - beside[:, :, columns].transpose(0, 2, 3, 1) @ others[:, :, columns].transpose(0, 2, 1, 3)
            heights[rows] = (plain[:, None] + _explained(rest, own, left[:, columns])).max(axis=0)
        return plain.max(axis=0), heights, self._wave_profile(plain, self.wave_right - waves @ value, sines, waves)

    def _wave_profile(self, plain: FloatArray, right: FloatArray, solved: FloatArray, crossed: FloatArray) -> FloatArray:
        """The part for sines: the explained sum of squares of two columns follows from the inverse of a 2 x 2 matrix."""
        shape = len(self.covariances), self.wave_own.shape[1], 2, crossed.shape[2]
        crossed, mine = crossed.reshape(shape), solved.transpose(0, 2, 1).reshape(shape)
        matrix = self.wave_own - crossed @ mine.transpose(0, 1, 3, 2)
        a, b, d = (matrix[:, :, i, j][..., None] for i, j in ((0, 0), (0, 1), (1, 1)))
        r, s = right[:, 0::2], right[:, 1::2]
        determinant = a * d - b * b
        whole = (self.wave_own[:, :, 0, 0] * self.wave_own[:, :, 1, 1])[..., None]
        explained = np.where(determinant > _SMALLEST * whole, 0.5 * (r * r * d - 2 * r * s * b + s * s * a), 0.0)
        ratios = explained / np.where(determinant > _SMALLEST * whole, determinant, 1.0)
        return np.asarray((plain[:, None] + np.maximum(ratios, 0.0)).max(axis=0))


def _explained(rest: FloatArray, own: FloatArray, left: FloatArray) -> FloatArray:
    """(C, f, v) half the sums of squares that sets of n columns explain beside the base.

    `rest`: (C, f, n, n) products of the columns after the base is projected out, and `own` before; `left`: (C, f, n, v) right
    sides.
    """
    scale = np.sqrt(np.maximum(np.einsum("cfkk->cfk", own), 1e-300))
    values, vectors = np.linalg.eigh(rest / scale[..., :, None] / scale[..., None, :])
    turned = vectors.swapaxes(2, 3) @ (left / scale[..., None])
    share = np.where(values > _SMALLEST, 1 / np.maximum(values, _SMALLEST), 0.0)
    return np.asarray(0.5 * np.einsum("cfk,cfkv->cfv", share, turned**2))


def assemble(
    at: list[CellCovariance],
    fixed: ProjectedColumns,
    value: ProjectedColumns,
    within: WithinProducts,
    waves: SineProducts,
    precision: FloatArray,
) -> NormalEquations:
    """Build the normal equations of pose and candidate errors under each of C trial covariances.

    From them, any set of candidates is scored without returning to the points.

    Parameters
    ----------
    at : The C trial covariances of the mean residuals in the cells of the wall.
    fixed : The k design columns of the pose and of all candidates but the sines of unknown period.
    value : v columns of residuals: one of measured residuals, or several of simulated ones.
    within : Products of these columns and residuals within cells.
    waves : Inner products of the columns of w trial sines with the other columns and the residuals.
    precision : (k,) prior inverse variances of the coefficients, whose prior is Gaussian with mean 0; 0: no prior.

    Returns
    -------
    The equations. Their list `held_columns`, the columns beside which sines can be scored, is still empty.
    """

    def at_one(each: CellCovariance) -> tuple[FloatArray, ...]:
        root = np.sqrt(each.weight)[:, None]
        basis, y = fixed.between[each.basis] * root, value.between[each.basis] * root
        constant = 0.5 * (np.log(each.weight).sum() - np.sum(y**2, axis=0) - within.square)
        return within.gram + basis.T @ basis, within.right + basis.T @ y, constant

    products, sides, constant = (np.stack(part) for part in zip(*map_in_threads(at_one, at), strict=True))
    products += np.diag(precision)
    nothing = np.empty((len(at), len(waves.right), 0))
    return NormalEquations(at, products, sides, constant, nothing, waves.own_at(at), waves.at(at, waves.right, value.between))


def extend(
    equations: NormalEquations, had: list[ProjectedColumns], value: ProjectedColumns, added: ProjectedColumns
) -> NormalEquations:
    """Return normal equations with further design columns appended, such as those of a sine whose period is now known.

    Parameters
    ----------
    equations : The present equations.
    had : Their columns of pose and candidates, as one or more sets, in the order of the equations.
    value : The residuals of the equations, as columns.
    added : Columns to append. Their products with trial sines are not computed; `with_sine_products` adds them.
    """
    cross, own = np.concatenate([each.within.T @ added.within_weighted for each in had]), added.within.T @ added.within_weighted
    right = added.within.T @ value.within_weighted
    count = equations.fixed.shape[1]
    fixed = np.empty((len(equations.covariances), count + len(own), count + len(own)))
    sides = np.empty((*fixed.shape[:2], equations.right.shape[2]))
    fixed[:, :count, :count], sides[:, :count] = equations.fixed, equations.right
    for row, each in enumerate(equations.covariances):
        weighted = added.between[each.basis] * each.weight[:, None]
        beside = cross + np.concatenate([part.between[each.basis].T @ weighted for part in had])
        fixed[row, :count, count:], fixed[row, count:, :count] = beside, beside.T
        fixed[row, count:, count:] = own + added.between[each.basis].T @ weighted
        sides[row, count:] = right + weighted.T @ value.between[each.basis]
    return replace(equations, fixed=fixed, right=sides)
