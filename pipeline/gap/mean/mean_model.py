"""Mean effects by generalised least squares, with a correlated error of the reference.

The residual of a point is y = J p + S b + g + e: pose p, signatures S, an error g of the reference that is correlated over
metres, white noise e of the predicted spread. Points are gathered in cells. The cells' means follow a Gaussian process plus the
noise of a mean; the deviations within cells from planes, which take away what g does there, are white. Where neighbours share
noise, which is larger than g, they are deviations from the means, of that noise. Both parts add their information on b. How the
reference's error is correlated is not known: rough (Matern 3/2), smooth (Gaussian) and wavy forms (isotropic waves of about one
length, the covariance of each being Bessel's J0) of several lengths are kept as far as the data allow. For each of them one
eigendecomposition serves every amplitude (Lippert et al. 2011, eq. 4), so that the likelihood of each candidate is maximised over
the covariance too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from scipy import sparse
from scipy.linalg import cholesky, eigh, solve_triangular
from scipy.linalg.lapack import dsysv
from scipy.spatial.distance import pdist, squareform
from scipy.special import j0

from pipeline.gap.mean.within_cell_noise import WithinCellNoise
from pipeline.gap.residuals.correlated_noise import NO_CORRELATED_NOISE, GridCorrelatedNoise
from pipeline.gap.residuals.wall_blocks import WallCells
from scene.common.keyed_random import KeyedRandom
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray

_ROUGH, _SMOOTH, _WAVY = (0.7, 1.5, 3.0), (1.0, 2.0), (1.7, 2.5, 3.5, 5.0)
"""Lengths in cells of the three forms of correlation; of some 30 x 25 cells, so that the longest are still local."""
_BAND = 0.7, 1.9, 6
"""Wavelengths of a wavy error, from and to, of its length, and how many stand for the band."""
_RATIOS = np.geomspace(0.003, 300.0, 25)
"""Variance of the reference's error over the median variance of a cell's mean."""
_MOST_RATIOS = 6
_WORSE = 12.0
"""A length of correlation whose likelihood falls short of the best by more, whatever is fitted, is not carried along."""
_RIDGE = 1e-12
_AT_ONCE = 32
"""Columns together, whatever the number of threads, so that sums are the same: 15 MB of 60,000 points."""
_NO_SLOPE = 1e-6
"""Share of a slope's square that a cell's points have to leave beside its mean and the other slope for it to be one."""
_NOTHING = 1e-14
"""Columns so much smaller than the largest are rounding, and count as absent."""


@dataclass(frozen=True, eq=False)
class CellCovariance:
    """One covariance of the cell means. length: number of the basis; ratio: of the correlated part; weight: (m,) inverse
    eigenvalues."""

    basis: int
    variance_ratio: float
    weight: FloatArray


@dataclass(frozen=True)
class MeanFit:
    """Coefficients (k,) and covariance (k, k) of the design's columns; log_likelihood and the covariance it was reached with."""

    coefficients: FloatArray
    covariance: FloatArray
    log_likelihood: float
    cell_covariance: CellCovariance


class MeanModel:
    """The linear algebra of one set of points. Rows of whatever it takes are those of `rows`: points in cells, cell by cell."""

    def __init__(
        self, cells: WallCells, at: FloatArray, sigma: FloatArray, shared_noise: GridCorrelatedNoise = NO_CORRELATED_NOISE
    ) -> None:
        """at, sigma: (n, 2) m and (n,), of all points."""
        inside = np.flatnonzero(cells.cell >= 0)
        self.rows = inside[np.argsort(cells.cell[inside], kind="stable")]
        self._cell = cells.cell[self.rows]
        self._starts = np.flatnonzero(np.diff(self._cell, prepend=-1))
        self.inverse_sigma = 1 / sigma[self.rows]
        self._total = np.add.reduceat(self.inverse_sigma**2, self._starts)
        field = shared_noise.part(self.rows).node_field(len(self.rows))
        offsets = (at[self.rows] - cells.centre[self._cell]).T / cells.side_m
        self._planes = self._orthonormal([] if field.weights.shape[1] else list(offsets))
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
            values, vectors = eigh(self._whitened(half.T), driver="evd", overwrite_a=True)
            return np.maximum(values, 0.0), vectors

        self._bases: list[tuple[FloatArray, FloatArray]] = map_in_threads(basis, _CORRELATIONS)
        self._white = CellCovariance(0, 0.0, np.ones(len(self._total)))

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def cells(self) -> int:
        """Their number m."""
        return len(self._total)

    def _at(self, length: int, ratio: float) -> CellCovariance:
        return CellCovariance(length, ratio, 1 / (1 + ratio * self._bases[length][0])) if ratio else self._white

    def restrict(
        self, designs: list[ProjectedColumns], value: ProjectedColumns
    ) -> tuple[MeanModel, list[CellCovariance], list[int]]:
        """Covariances under which the value is likely, whichever of the designs is fitted (the least and the most of them).

        Returns the model without the bases that none of them needs, those covariances, and which bases are kept, for
        `Projected.kept` of what there is already.
        """
        ratios = [0.0, *map(float, _RATIOS)]
        normals = [_NormalEquations.of(design, value) for design in designs]

        def highest(which: tuple[_NormalEquations, int]) -> tuple[int, float]:
            normal, basis = which
            return _highest([partial(normal.log_likelihood, self._at(basis, ratio)) for ratio in ratios])

        shape = len(designs), len(self._bases)
        found = map_in_threads(highest, product(normals, range(len(self._bases))))
        tops, heights = (np.reshape(part, shape) for part in zip(*found, strict=True))
        kept = [int(basis) for basis in np.flatnonzero((heights > heights.max(axis=1, keepdims=True) - _WORSE).any(axis=0))]
        narrower = copy(self)
        narrower._bases = [self._bases[basis] for basis in kept]
        chosen: list[CellCovariance] = []
        for number, basis in enumerate(kept):
            low, high = max(tops[:, basis].min() - 1, 0), min(tops[:, basis].max() + 1, len(ratios) - 1)
            places = np.unique(np.rint(np.linspace(low, high, min(_MOST_RATIOS, high - low + 1))).astype(int))
            chosen += [narrower._at(number, ratios[place]) for place in places]
        return narrower, [*dict.fromkeys(chosen)], kept

    @property
    def covariances(self) -> list[CellCovariance]:
        """Every covariance of the bases in use."""
        return [self._at(basis, float(ratio)) for basis in range(len(self._bases)) for ratio in (0.0, *_RATIOS)]

    def _orthonormal(self, offsets: list[FloatArray]) -> sparse.csr_array:
        """(3 m, n) a plane in each cell: rows of the cells' means, and of their slopes by each of the offsets (n,)."""
        found: list[FloatArray] = []
        for plain in (np.ones(len(self.rows)), *offsets):
            row = plain * self.inverse_sigma
            size = self._summed(row**2)
            for other in found:
                row = row - other * self._summed(other * row)[self._cell]
            left = self._summed(row**2)
            told = left > _NO_SLOPE * size
            found.append(row * (told / np.sqrt(np.where(told, left, 1.0)))[self._cell])
        points = np.arange(len(self.rows))
        parts = [sparse.csr_array((row, (self._cell, points)), shape=(len(self._total), len(points))) for row in found]
        return sparse.csr_array(sparse.vstack(parts))

    def _summed(self, column: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(column, self._starts))

    def plane_coefficients(self, weighted: FloatArray, rows: slice = slice(None)) -> FloatArray:
        """(3 m, k) the cells' means over their standard deviations, and their slopes likewise, of columns (n', k) on `rows` that
        are already over sigma; (m, k) means alone where neighbours share noise."""
        return np.asarray((self._planes if rows == slice(None) else self._planes[:, rows]) @ weighted)

    def deviations(self, weighted: FloatArray, planes: FloatArray, rows: slice = slice(None)) -> FloatArray:
        """Deviations from the cells' planes, or means, of `rows`; columns over sigma."""
        return np.asarray(weighted[rows] - self._across[rows] @ planes)

    def in_bases(self, means: FloatArray) -> list[FloatArray]:
        """Cell means (m, k) in each basis."""
        white = self._whitened(means)
        return [vectors.T @ white for _, vectors in self._bases]

    def _whitened(self, means: FloatArray) -> FloatArray:
        """Cell means (m, k) whose noise is independent and of variance 1."""
        return means if self.within_noise.is_white else np.asarray(solve_triangular(self._root, means, lower=True))

    def project(self, weighted: FloatArray) -> ProjectedColumns:
        """Columns (n, k) over sigma as deviations within cells and as cell means in each basis."""
        within = np.empty(weighted.shape)
        weighed = within if self.within_noise.is_white else np.empty(weighted.shape)
        between = [np.empty((self.cells, weighted.shape[1])) for _ in self._bases]

        def project(some: slice) -> None:
            planes = self.plane_coefficients(weighted[:, some])
            within[:, some] = self.deviations(weighted[:, some], planes)
            if weighed is not within:
                weighed[:, some] = self._weighed(within[:, some])
            for basis, means in zip(between, self.in_bases(planes[: self.cells]), strict=True):
                basis[:, some] = means

        map_in_threads(project, column_chunks(weighted.shape[1]))
        return ProjectedColumns(within, weighed, between)

    def _weighed(self, within: FloatArray) -> FloatArray:
        """Deviations within cells (n, k), multiplied with the inverse covariance of their noise."""
        if self.within_noise.is_white:
            return within
        shared = self.within_noise.nodes @ self.within_noise.solve(self.within_noise.to_nodes(within))
        return np.asarray((within - self.deviations(shared, self.plane_coefficients(shared))) / self.within_noise.white)

    def null_draws(self, at: CellCovariance, count: int, random: KeyedRandom) -> list[FloatArray]:
        """Draws of the cell means under the covariance `at`, (m, count) in each basis."""
        draws = random.generator().standard_normal((len(self._total), count)) / np.sqrt(at.weight)[:, None]
        vectors = self._bases[at.basis][1]
        return [draws if index == at.basis else other.T @ (vectors @ draws) for index, (_, other) in enumerate(self._bases)]


def column_chunks(count: int) -> list[slice]:
    """Some of `count` columns at a time, for what is done to each of them."""
    return [slice(start, start + _AT_ONCE) for start in range(0, count, _AT_ONCE)]


def _rough(length: float, distance: FloatArray) -> FloatArray:
    reach = np.sqrt(3.0) * distance / length
    return np.asarray((1 + reach) * np.exp(-reach))


def _smooth(length: float, distance: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-0.5 * (distance / length) ** 2))


def _wavy(length: float, distance: FloatArray) -> FloatArray:
    waves = length * np.geomspace(*_BAND)
    return np.asarray(np.mean([j0(2 * np.pi * distance / wave) for wave in waves], axis=0))


_CORRELATIONS: list[Callable[[FloatArray], FloatArray]] = [
    *(partial(_rough, length) for length in _ROUGH),
    *(partial(_smooth, length) for length in _SMOOTH),
    *(partial(_wavy, length) for length in _WAVY),
]
"""Correlations of cells at some distances, in cells."""


@dataclass(frozen=True)
class ProjectedColumns:
    """Columns on both parts of the data. within: (n, k); weighed: (n, k) times the inverse covariance of the noise there, so that
    a.within.T @ b.weighed is a product of two; between: (m, k) per basis."""

    within: FloatArray
    within_weighted: FloatArray
    between: list[FloatArray]

    @classmethod
    def concatenate(cls, parts: Sequence[ProjectedColumns]) -> ProjectedColumns:
        """The columns of some, one after another."""
        if len(parts) == 1:
            return parts[0]
        within = np.concatenate([each.within for each in parts], axis=1)
        white = all(each.within_weighted is each.within for each in parts)
        weighed = within if white else np.concatenate([each.within_weighted for each in parts], axis=1)
        bases = zip(*(each.between for each in parts), strict=True)
        return cls(within, weighed, [np.concatenate(basis, axis=1) for basis in bases])

    def select(self, columns: list[int]) -> ProjectedColumns:
        """Some of the columns."""
        within = self.within[:, columns]
        weighed = within if self.within_weighted is self.within else self.within_weighted[:, columns]
        return ProjectedColumns(within, weighed, [part[:, columns] for part in self.between])

    def in_bases(self, bases: list[int]) -> ProjectedColumns:
        """In some of the bases."""
        return ProjectedColumns(self.within, self.within_weighted, [self.between[basis] for basis in bases])

    def append(self, other: ProjectedColumns) -> ProjectedColumns:
        """These columns and then those of another."""
        return ProjectedColumns.concatenate([self, other])


@dataclass(frozen=True)
class _NormalEquations:
    """What the normal equations of one design hold at any covariance."""

    columns: ProjectedColumns
    value: ProjectedColumns
    gram: FloatArray
    right: FloatArray
    square: float

    @classmethod
    def of(cls, columns: ProjectedColumns, value: ProjectedColumns) -> _NormalEquations:
        y = value.within_weighted[:, 0]
        return cls(
            columns, value, columns.within.T @ columns.within_weighted, columns.within.T @ y, float(value.within[:, 0] @ y)
        )

    def log_likelihood(self, at: CellCovariance) -> float:
        """All columns fitted."""
        matrix, right, constant = self._equations(at)
        scale = _scale(matrix)
        found = dsysv(_ridged(matrix, scale), scale * right)[2]
        return constant + 0.5 * float(right @ (scale * found))

    def at(self, at: CellCovariance, precision: FloatArray | None = None) -> MeanFit:
        """All columns fitted. precision: (k, k) inverse covariance of the coefficients, around 0, before there are data."""
        matrix, right, constant = self._equations(at)
        return _solve(matrix if precision is None else matrix + precision, right, constant, at)

    def _equations(self, at: CellCovariance) -> tuple[FloatArray, FloatArray, float]:
        """Matrix (k, k), right side (k,), and the log-likelihood without the columns."""
        root = np.sqrt(at.weight)
        basis, y = self.columns.between[at.basis] * root[:, None], self.value.between[at.basis][:, 0] * root
        constant = 0.5 * (np.log(at.weight).sum() - y @ y - self.square)
        return self.gram + basis.T @ basis, self.right + basis.T @ y, float(constant)


def fit_reml(
    covariances: list[CellCovariance], columns: ProjectedColumns, value: ProjectedColumns, precision: FloatArray | None = None
) -> MeanFit:
    """All columns fitted to one value, at the most likely of the covariances. precision: (k, k) as in `_Normal.at`.

    The likelihood is that of what the columns leave (REML, Patterson & Thompson 1971), and the coefficients' covariance is a mean
    over all covariances by it, with what they differ: which of them is true is not known.
    """
    normal = _NormalEquations.of(columns, value)
    fits = [normal.at(each, precision) for each in covariances]
    likelihood = np.array([fit.log_likelihood + 0.5 * np.linalg.slogdet(fit.covariance)[1] for fit in fits])
    best = fits[int(np.argmax(likelihood))]
    weights = np.exp(likelihood - likelihood.max())
    weights /= weights.sum()
    moves = np.stack([fit.coefficients - best.coefficients for fit in fits])
    covariance = np.einsum("f,fij->ij", weights, np.stack([fit.covariance for fit in fits]))
    return replace(best, covariance=covariance + np.einsum("f,fi,fj->ij", weights, moves, moves))


def _highest(heights: Sequence[Callable[[], float]]) -> tuple[int, float]:
    """Number and height of the highest on a curve with one top: every second one is asked for, then those beside the best."""
    found = {number: heights[number]() for number in range(0, len(heights), 2)}
    best = max(found, key=lambda number: found[number])
    for number in {best - 1, best + 1} & set(range(len(heights))):
        found[number] = heights[number]()
    top = max(sorted(found), key=lambda number: found[number])
    return top, found[top]


def _solve(matrix: FloatArray, right: FloatArray, constant: float, at: CellCovariance) -> MeanFit:
    scale = _scale(matrix)
    inverse = np.linalg.inv(_ridged(matrix, scale)) * np.outer(scale, scale)
    coefficients = inverse @ right
    return MeanFit(coefficients, inverse, constant + 0.5 * float(right @ coefficients), at)


def _scale(matrix: FloatArray) -> FloatArray:
    """(k,) of columns to size 1, 0 of those that are absent."""
    size = np.sqrt(np.diag(matrix))
    return np.divide(1.0, size, out=np.zeros_like(size), where=size > _NOTHING * size.max())


def _ridged(matrix: FloatArray, scale: FloatArray) -> FloatArray:
    return matrix * np.outer(scale, scale) + _RIDGE * np.eye(len(scale))
