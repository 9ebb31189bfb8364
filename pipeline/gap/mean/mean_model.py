"""Fit the mean model by generalised least squares with a correlated error of the reference.

The residual of a point is y = J p + S b + g + e: pose p, signatures S with sizes b, an error g of the reference that is
correlated over metres, and white noise e with the predicted sigma. Points are gathered in cells of the wall. The cells' means
follow the Gaussian process g plus the noise of a mean. The deviations within cells from a plane, which absorbs g there, are
white. Where neighbours share noise, which is larger than g, they are deviations from the mean, with the covariance of that
noise. Both parts contain information on b.

The correlation of the reference's error is not known. Rough (Matern 3/2), smooth (Gaussian) and wavy ones (isotropic waves
    of about one length, each with the covariance J0 of Bessel) of several lengths are kept as far as the data allow them.
    For each, one eigendecomposition serves every amplitude (Lippert et al. 2011, eq. 4), so that the likelihood of each
    candidate is maximised over the covariance too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from scipy import sparse
from scipy.interpolate import CubicSpline
from scipy.linalg import cholesky, solve_triangular
from scipy.spatial.distance import pdist, squareform
from scipy.special import j0

from pipeline.gap.mean.projected_columns import ProjectedColumns, WithinProducts
from pipeline.gap.mean.within_cell_noise import WithinCellNoise
from pipeline.gap.residuals.correlated_noise import NO_CORRELATED_NOISE, GridCorrelatedNoise
from pipeline.gap.residuals.wall_blocks import WallCells
from scene.common.keyed_random import KeyedRandom
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray

_ROUGH, _SMOOTH, _WAVY, _RINGS = (0.7, 1.5, 3.0, 6.0), (1.0, 2.0), (1.7, 2.5, 3.5, 5.0), (6.5, 9.5)
"""Lengths of the kinds of correlation, in cells. A reference may err by strips or waves as long as a third of the wall."""
_LONGEST = 0.5
"""Longest correlation that is tried, as a share of the side of a square with as many cells: longer ones look like sensor errors.
"""
_BAND, _NARROW_BAND = (0.7, 1.9, 6), (0.8, 1.3, 5)
"""Shortest and longest wavelength of a wavy error relative to its length, and number of waves that represent the band. Only few
long waves fit on a wall, so that their band is narrow: a wide one hides how large single waves get.
"""
_RATIOS = np.geomspace(0.003, 300.0, 25)
"""Variances of the reference's error that are tried, relative to the median variance of a cell's mean."""
_MOST_RATIOS = 6
"""Most amplitudes that are kept for one correlation."""
_WORSE = 12.0
"""A correlation whose log-likelihood is lower than the best by more, with any of the designs, is not kept."""
_RIDGE = 1e-12
"""Relative ridge that keeps normal equations regular."""
_AT_ONCE = 32
"""Columns processed together (15 MB for 60,000 points), whatever the number of threads, so that results do not depend on it."""
_NO_SLOPE = 1e-6
"""Share of a slope's sum of squares that must remain beside the mean and the other slope for a cell to have it."""
_NODE_SPACING = 1 / 128
"""Spacing of the distances, in cells, between which the correlation of waves is interpolated with an error below 1e-7."""
_NOTHING = 1e-14
"""Relative size below which a column is rounding error and counts as absent."""


@dataclass(frozen=True, eq=False)
class CellCovariance:
    """A trial covariance of the mean residuals in m square cells of the wall, under which candidate errors are fitted.

    It is the sum of two parts: the error of the reference surface, which is correlated between cells, and the sensor's noise,
    which has the unit matrix as covariance because cell means are divided by its standard deviations.

    Attributes
    ----------
    basis : Index of the correlation function of the reference's error among those tried. It tells which eigenvectors apply.
    variance_ratio : Variance of the reference's error divided by the median noise variance of a cell mean.
    weight : (m,) inverse eigenvalues of the covariance.
    """

    basis: int
    variance_ratio: float
    weight: FloatArray


@dataclass(frozen=True)
class MeanFit:
    """Result of a generalised least-squares fit of k design columns to residuals.

    Attributes
    ----------
    coefficients : (k,) estimates.
    covariance : (k, k) covariance of the estimates.
    log_likelihood : Log-likelihood of the residuals at the estimates.
    cell_covariance : The most likely trial covariance of the mean residuals in the cells of the wall: reference error plus
        noise.
    """

    coefficients: FloatArray
    covariance: FloatArray
    log_likelihood: float
    cell_covariance: CellCovariance


class MeanModel:
    """Generalised least squares for residuals with independent noise and a reference error that is correlated over metres.

    Points are gathered in m square cells of the wall. The class splits design columns over the points into cell means, which
    follow the correlated error, and deviations within cells, which are nearly independent. All columns are divided by the
    predicted standard deviation of each point first.

    Attributes
    ----------
    rows : (n,) numbers of the points that lie in cells, cell by cell; all arrays over n points are in this order.
    inverse_sigma : (n,) inverse predicted standard deviations.
    within_noise : Covariance of the noise in deviations within cells.
    typical_sigma : Median standard deviation of the noise of a cell mean, in the unit of the observable (m, or px of
        disparity).
    """

    def __init__(
        self, cells: WallCells, at: FloatArray, sigma: FloatArray, correlated_noise: GridCorrelatedNoise = NO_CORRELATED_NOISE
    ) -> None:
        """Set up the covariances.

        Parameters
        ----------
        cells : The cells of the wall.
        at : (n, 2) all points, wall frame, m.
        sigma : (n,) predicted standard deviations.
        correlated_noise : The part of the noise that neighbours share.
        """
        inside = np.flatnonzero(cells.cell >= 0)
        self.rows = inside[np.argsort(cells.cell[inside], kind="stable")]
        self._cell = cells.cell[self.rows]
        self._starts = np.flatnonzero(np.diff(self._cell, prepend=-1))
        self.inverse_sigma = 1 / sigma[self.rows]
        self._total = np.add.reduceat(self.inverse_sigma**2, self._starts)
        field = correlated_noise.part(self.rows).node_field(len(self.rows))
        offsets = (at[self.rows] - cells.centre[self._cell]).T / cells.side_m
        self._planes = self._orthonormal_planes([] if field.weights.shape[1] else list(offsets))
        self._across = sparse.csr_array(self._planes.T)
        self.within_noise = WithinCellNoise.of(field, self.inverse_sigma, self._planes[: len(cells)])
        variance = self.within_noise.mean_covariance()
        self._root = cholesky(variance, lower=True)
        self.typical_sigma = typical = float(np.median(np.sqrt(np.diag(variance) / self._total)))
        scale = typical * np.sqrt(self._total)
        distance = pdist(cells.centre / cells.side_m)

        def basis(correlation: Callable[[FloatArray], FloatArray]) -> tuple[FloatArray, FloatArray]:
            found = squareform(correlation(distance))
            np.fill_diagonal(found, 1.0)
            half = self._whitened(found * np.outer(scale, scale))
            values, vectors = np.linalg.eigh(self._whitened(half.T))  # SciPy's would hold up the other threads
            return np.maximum(values, 0.0), vectors

        short = [each for length, each in _CORRELATIONS if length <= _LONGEST * np.sqrt(len(cells))]
        self._bases: list[tuple[FloatArray, FloatArray]] = map_in_threads(basis, short)
        self._ratios = [0.0, *map(float, _RATIOS)]
        self._white = CellCovariance(0, 0.0, np.ones(len(self._total)))

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def cells(self) -> int:
        """Number of square cells of the wall into which the points are gathered."""
        return len(self._total)

    def _covariance(self, length: int, ratio: float) -> CellCovariance:
        """The covariance with one correlation and amplitude."""
        return CellCovariance(length, ratio, 1 / (1 + ratio * self._bases[length][0])) if ratio else self._white

    def restrict(
        self,
        columns: ProjectedColumns,
        value: ProjectedColumns,
        within: WithinProducts,
        fewest: int,
        most_sigma: float = np.inf,
    ) -> tuple[MeanModel, list[CellCovariance], list[int]]:
        """Drop trial covariances of the reference surface's error under which the residuals are unlikely, to save time later.

        A correlation function is kept if the residuals are likely under it with the smallest or with the largest model fitted.
        Of its amplitudes, only those near the most likely ones are kept.

        Parameters
        ----------
        columns : Design columns of the largest model: the pose and all candidates.
        value : The residuals, as one column.
        within : Products of these columns and residuals within cells.
        fewest : Number of leading columns that are the smallest model: the pose.
        most_sigma : Largest standard deviation of the reference's error, in the unit of the observable (m, or px of
            disparity).

        Returns
        -------
        model : The model with the kept correlation functions.
        covariances : The kept trial covariances.
        kept : Indices of the kept correlation functions among all; `ProjectedColumns.in_bases` reduces columns to them.
        """
        ratios = [ratio for ratio in self._ratios if ratio <= (most_sigma / self.typical_sigma) ** 2]
        smallest = _NormalEquations(columns.select(list(range(fewest))), value, within.first(fewest))
        normals = [smallest, _NormalEquations(columns, value, within)]

        def highest(which: tuple[_NormalEquations, int]) -> tuple[int, float]:
            normal, basis = which
            return _maximum([partial(normal.log_likelihood, self._covariance(basis, ratio)) for ratio in ratios])

        shape = len(normals), len(self._bases)
        found = map_in_threads(highest, product(normals, range(len(self._bases))))
        tops, heights = (np.reshape(part, shape) for part in zip(*found, strict=True))
        kept = [int(basis) for basis in np.flatnonzero((heights > heights.max(axis=1, keepdims=True) - _WORSE).any(axis=0))]
        narrower = copy(self)
        narrower._bases, narrower._ratios = [self._bases[basis] for basis in kept], ratios
        chosen: list[CellCovariance] = []
        for number, basis in enumerate(kept):
            low, high = max(tops[:, basis].min() - 1, 0), min(tops[:, basis].max() + 1, len(ratios) - 1)
            places = np.unique(np.rint(np.linspace(low, high, min(_MOST_RATIOS, high - low + 1))).astype(int))
            chosen += [narrower._covariance(number, ratios[place]) for place in places]
        return narrower, [*dict.fromkeys(chosen)], kept

    @property
    def covariances(self) -> list[CellCovariance]:
        """The trial covariances of the mean residuals in the cells of the wall, for fits that pick the most likely one.

        There is one for each pair of a correlation function and an amplitude of the reference surface's error that is tried.
        """
        return [self._covariance(basis, float(ratio)) for basis in range(len(self._bases)) for ratio in self._ratios]

    def _orthonormal_planes(self, offsets: list[FloatArray]) -> sparse.csr_array:
        """(3 m, n) orthonormal rows of a plane in each cell: means, and slopes along each of the offsets (n,)."""
        found: list[FloatArray] = []
        for plain in (np.ones(len(self.rows)), *offsets):
            row = plain * self.inverse_sigma
            size = self._cell_sums(row**2)
            for other in found:
                row = row - other * self._cell_sums(other * row)[self._cell]
            left = self._cell_sums(row**2)
            told = left > _NO_SLOPE * size
            found.append(row * (told / np.sqrt(np.where(told, left, 1.0)))[self._cell])
        points = np.arange(len(self.rows))
        parts = [sparse.csr_array((row, (self._cell, points)), shape=(len(self._total), len(points))) for row in found]
        return sparse.csr_array(sparse.vstack(parts))

    def _cell_sums(self, column: FloatArray) -> FloatArray:
        """(m,) sums over cells."""
        return np.asarray(np.add.reduceat(column, self._starts))

    def plane_coefficients(self, weighted: FloatArray, rows: slice = slice(None)) -> FloatArray:
        """Fit a plane to each design column in each cell of the wall, by weighted least squares.

        A plane takes up the reference surface's error within a cell, so that the deviations from it are nearly independent. If
        neighbouring points share noise, a constant is fitted instead.

        weighted: (n', k) columns at n' points, divided by the standard deviation of each point. rows: slice that selects these
        points from all n.

        Returns
        -------
        (3 m, k) coefficients: first the means of the m cells, then their m slopes along x, then those along y, each divided
        by its standard deviation. Only the (m, k) means if neighbouring points share noise.
        """
        return np.asarray((self._planes if rows == slice(None) else self._planes[:, rows]) @ weighted)

    def deviations(self, weighted: FloatArray, planes: FloatArray, rows: slice = slice(None)) -> FloatArray:
        """Return the deviations of design columns from their fitted plane (or mean) in each cell of the wall.

        The error of the reference surface, which is correlated over metres, hardly affects them; their noise is nearly
        independent.

        Parameters
        ----------
        weighted : (n, k) columns, divided by the standard deviation of each point.
        planes : Coefficients of the planes, as `plane_coefficients` returns them for these columns.
        rows : Slice of the n points for which deviations are returned.

        Returns
        -------
        (n', k) deviations at the n' points of the slice, divided by the standard deviation of each point.
        """
        return np.asarray(weighted[rows] - self._across[rows] @ planes)

    def in_bases(self, means: FloatArray) -> list[FloatArray]:
        """Transform cell means of design columns so that they are uncorrelated under each trial covariance.

        They become coordinates in the eigenvectors of each trial correlation function of the reference surface's error: one
        (m, k) array for each. A fit then only needs the eigenvalues, whatever the amplitude of that error.

        means: (m, k) means of k columns in the m cells of the wall, divided by their standard deviations.
        """
        white = self._whitened(means)
        return map_in_threads(lambda basis: np.asarray(basis[1].T @ white), self._bases)

    def _whitened(self, means: FloatArray) -> FloatArray:
        """Cell means (m, k) transformed so that their noise is independent with variance 1."""
        if self.within_noise.is_white:
            return means
        return np.asarray(solve_triangular(self._root, means, lower=True, check_finite=False))

    def project(self, weighted: FloatArray) -> ProjectedColumns:
        """Divide design columns into cell means and deviations within cells, in the form that all fits use.

        weighted: (n, k) columns at the n points in `rows`, divided by the standard deviation of each point.
        """
        within = np.empty(weighted.shape)
        weighed = within if self.within_noise.is_white else np.empty(weighted.shape)
        between = [np.empty((self.cells, weighted.shape[1])) for _ in self._bases]

        def project(some: slice) -> None:
            planes = self.plane_coefficients(weighted[:, some])
            within[:, some] = self.deviations(weighted[:, some], planes)
            if weighed is not within:
                weighed[:, some] = self._weighted(within[:, some])
            for basis, means in zip(between, self.in_bases(planes[: self.cells]), strict=True):
                basis[:, some] = means

        map_in_threads(project, column_chunks(weighted.shape[1]))
        return ProjectedColumns(within, weighed, between)

    def _weighted(self, within: FloatArray) -> FloatArray:
        """Deviations within cells (n, k), multiplied by the inverse covariance of their noise."""
        if self.within_noise.is_white:
            return within
        shared = self.within_noise.nodes @ self.within_noise.solve(self.within_noise.to_nodes(within))
        return np.asarray((within - self.deviations(shared, self.plane_coefficients(shared))) / self.within_noise.white)

    def null_draws(self, at: CellCovariance, count: int, random: KeyedRandom) -> list[FloatArray]:
        """Simulate mean residuals in the m cells of the wall that contain only noise and the reference surface's error.

        They show how well candidate errors explain residuals by chance. There are `count` draws, made under the covariance `at`.

        Returns
        -------
        One (m, count) array for each trial correlation function of the reference's error, because fits are made under each. All
        hold the same draws, as coordinates in the eigenvectors of that function (see `in_bases`).
        """
        draws = random.generator().standard_normal((len(self._total), count)) / np.sqrt(at.weight)[:, None]
        means = self._bases[at.basis][1] @ draws
        return map_in_threads(
            lambda index: draws if index == at.basis else self._bases[index][1].T @ means, range(len(self._bases))
        )


def column_chunks(count: int) -> list[slice]:
    """Divide `count` design columns into slices of 32, which are processed one after the other to limit memory."""
    return [slice(start, start + _AT_ONCE) for start in range(0, count, _AT_ONCE)]


def _matern(length: float, distance: FloatArray) -> FloatArray:
    """Matern 3/2 correlation at a distance, both in cells."""
    reach = np.sqrt(3.0) * distance / length
    return np.asarray((1 + reach) * np.exp(-reach))


def _gaussian(length: float, distance: FloatArray) -> FloatArray:
    """Gaussian correlation at a distance, both in cells."""
    return np.asarray(np.exp(-0.5 * (distance / length) ** 2))


def _wavy(band: tuple[float, float, int], length: float, distance: FloatArray) -> FloatArray:
    """Correlation of isotropic waves in a band around a length, in cells; many are interpolated: Bessel functions take long."""

    def exact(some: FloatArray) -> FloatArray:
        return np.asarray(np.mean([j0(2 * np.pi * some / wave) for wave in length * np.geomspace(*band)], axis=0))

    longest = float(distance.max(initial=1.0)) + 1.0
    if longest / _NODE_SPACING > distance.size:
        return exact(distance)
    at = np.arange(0.0, longest, _NODE_SPACING)
    return np.asarray(CubicSpline(at, exact(at))(distance))


_CORRELATIONS: list[tuple[float, Callable[[FloatArray], FloatArray]]] = [
    (length, partial(kind, length))
    for kind, lengths in (
        (_matern, _ROUGH),
        (_gaussian, _SMOOTH),
        (partial(_wavy, _BAND), _WAVY),
        (partial(_wavy, _NARROW_BAND), _RINGS),
    )
    for length in lengths
]
"""Length of each correlation of two cells, and the correlation as a function of their distance, both in cells."""


@dataclass(frozen=True)
class _NormalEquations:
    """Normal equations of k design columns for residuals (one column), under any covariance; `within`: products within cells."""

    columns: ProjectedColumns
    value: ProjectedColumns
    within: WithinProducts

    def log_likelihood(self, at: CellCovariance) -> float:
        """Log-likelihood of the fit of all columns."""
        matrix, right, constant = self.equations(at)
        scale = _scale(matrix)
        found = np.linalg.solve(_regularised(matrix, scale), scale * right)
        return constant + 0.5 * float(right @ (scale * found))

    def equations(self, at: CellCovariance) -> tuple[FloatArray, FloatArray, float]:
        """Matrix (k, k), right side (k,), and the log-likelihood without any column."""
        root = np.sqrt(at.weight)
        basis, y = self.columns.between[at.basis] * root[:, None], self.value.between[at.basis][:, 0] * root
        constant = 0.5 * (np.log(at.weight).sum() - y @ y - self.within.square[0])
        return self.within.gram + basis.T @ basis, self.within.right[:, 0] + basis.T @ y, float(constant)


def fit_reml(
    covariances: list[CellCovariance], columns: ProjectedColumns, value: ProjectedColumns, precision: FloatArray | None = None
) -> MeanFit:
    """Fit design columns to residuals by generalised least squares, under the most likely trial covariance.

    Covariances (reference error plus noise) are compared by their restricted likelihood (REML, Patterson & Thompson 1971).

    Parameters
    ----------
    covariances : Trial covariances of the mean residuals in the cells of the wall.
    columns : The k design columns to fit.
    value : The residuals, as one column.
    precision : (k, k) prior inverse covariance of the coefficients; None: no prior.

    Returns
    -------
    The fit under the most likely covariance. Only its covariance of the coefficients is an average over all trial covariances,
    weighted by their likelihood, and includes how much the estimates differ between them: the true covariance is not known.
    """
    normal = _NormalEquations(columns, value, WithinProducts.of(columns, value))
    matrices, rights, constants = map(np.stack, zip(*map(normal.equations, covariances), strict=True))
    if precision is not None:
        matrices = matrices + precision
    scales = _scale(matrices)
    inverses = np.linalg.inv(_regularised(matrices, scales)) * (scales[:, :, None] * scales[:, None, :])
    coefficients = np.einsum("fij,fj->fi", inverses, rights)
    log_likelihoods = constants + 0.5 * np.sum(rights * coefficients, axis=1)
    likelihood = log_likelihoods + 0.5 * np.linalg.slogdet(inverses)[1]
    best = int(np.argmax(likelihood))
    weights = np.exp(likelihood - likelihood.max())
    weights /= weights.sum()
    moves = coefficients - coefficients[best]
    covariance = np.einsum("f,fij->ij", weights, inverses) + np.einsum("f,fi,fj->ij", weights, moves, moves)
    return MeanFit(coefficients[best], covariance, float(log_likelihoods[best]), covariances[best])


def _maximum(heights: Sequence[Callable[[], float]]) -> tuple[int, float]:
    """Number and height of the maximum of a sequence: every fourth value is computed, then those beside the best.

    The likelihood as a function of the reference error's amplitude is assumed to have one maximum. A second one that is narrower
    than four trial amplitudes is missed.
    """
    found = {number: heights[number]() for number in range(0, len(heights), 4)}
    for step in (2, 1):
        best = max(sorted(found), key=lambda number: found[number])
        for number in {best - step, best + step} & set(range(len(heights))):
            found[number] = heights[number]()
    top = max(sorted(found), key=lambda number: found[number])
    return top, found[top]


def _scale(matrix: FloatArray) -> FloatArray:
    """(..., k) factors that scale the diagonal of normal equations (..., k, k) to 1; 0 for columns that vanish."""
    size = np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))
    return np.divide(1.0, size, out=np.zeros_like(size), where=size > _NOTHING * size.max(axis=-1, keepdims=True))


def _regularised(matrix: FloatArray, scale: FloatArray) -> FloatArray:
    """Scale normal equations (..., k, k) by factors (..., k), and add a small ridge so that they can always be solved."""
    return np.asarray(matrix * (scale[..., :, None] * scale[..., None, :]) + _RIDGE * np.eye(scale.shape[-1]))
