"""Mean effects by generalised least squares, with a correlated error of the reference.

The residual of a point is y = J p + S b + g + e: pose p, signatures S, an error g of the reference that is correlated over
metres, white noise e of the predicted spread. Points are gathered in cells. The cells' means follow a Gaussian process with a
Matern 3/2 covariance of unknown amplitude and length plus the noise of a mean; the deviations within cells are white. Both parts
add their information on b. For each length one eigendecomposition serves every amplitude (Lippert et al. 2011, eq. 4), so that
the likelihood of each candidate is maximised over the covariance too, and the null distribution of the largest gain over all
candidates is simulated with the same maximisation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.distance import cdist

from pipeline.gap.cells import Cells
from scene.keyed_random import KeyedRandom
from scene.mesh import FloatArray

_LENGTHS_IN_CELLS = (1.0, 2.0, 4.0, 8.0)
_RATIOS = np.concatenate([[0.0], np.geomspace(0.003, 300.0, 14)])
"""Variance of the reference's error over the median variance of a cell's mean."""
_RIDGE = 1e-12


@dataclass(frozen=True)
class Covariance:
    """One covariance of the cell means. length_m, ratio: of the correlated part; weight: (m,) inverse eigenvalues."""

    length: int
    ratio: float
    weight: FloatArray


@dataclass(frozen=True)
class Fit:
    """Coefficients (k,) and covariance (k, k) of the design's columns; log_likelihood and the covariance it was reached with."""

    coefficients: FloatArray
    covariance: FloatArray
    log_likelihood: float
    at: Covariance


class MeanModel:
    """The linear algebra of one set of points: values and columns are projected once, candidates are then cheap."""

    def __init__(self, cells: Cells, sigma: FloatArray) -> None:
        self._cells, self._inside = cells, cells.cell >= 0
        self._cell = cells.cell[self._inside]
        self._root = 1 / sigma[self._inside]
        self._total = np.bincount(self._cell, self._root**2, len(cells))
        scale = 1 / np.sqrt(self._total)
        self.typical_sigma = typical = float(np.median(scale))
        distance = cdist(cells.centre, cells.centre)
        self._bases: list[tuple[FloatArray, FloatArray]] = []
        for length in _LENGTHS_IN_CELLS:
            reach = np.sqrt(3.0) * distance / (length * cells.side_m)
            kernel = (1 + reach) * np.exp(-reach) * (typical**2 / np.outer(scale, scale))
            values, vectors = eigh(kernel, driver="evd")
            self._bases.append((np.maximum(values, 0.0), vectors))

    @property
    def covariances(self) -> list[Covariance]:
        """The grid of covariances."""
        found = [Covariance(0, 0.0, np.ones(len(self._cells)))]
        for length, (values, _) in enumerate(self._bases):
            found += [Covariance(length, float(ratio), 1 / (1 + ratio * values)) for ratio in _RATIOS[1:]]
        return found

    def project(self, columns: FloatArray) -> Projected:
        """Columns (n, k) as deviations within cells and as whitened cell means in each basis."""
        chosen = columns[self._inside] * self._root[:, None]
        total = np.sqrt(self._total)[:, None]
        sums = np.stack([np.bincount(self._cell, self._root * column, len(self._cells)) for column in chosen.T], axis=1)
        means = sums / total
        within = chosen - (means / total)[self._cell] * self._root[:, None]
        return Projected(within, [np.einsum("ij,ik->jk", vectors, means) for _, vectors in self._bases])

    def null_draws(self, at: Covariance, count: int, random: KeyedRandom) -> list[FloatArray]:
        """Draws of the cell means under the covariance `at`, (m, count) in each basis."""
        draws = random.generator().standard_normal((len(self._cells), count)) / np.sqrt(at.weight)[:, None]
        vectors = self._bases[at.length][1]
        return [draws if index == at.length else other.T @ (vectors @ draws) for index, (_, other) in enumerate(self._bases)]


@dataclass(frozen=True)
class Projected:
    """Columns on both parts of the data. within: (n, k); between: (m, k) per basis."""

    within: FloatArray
    between: list[FloatArray]

    def columns(self, chosen: list[int]) -> Projected:
        return Projected(self.within[:, chosen], [part[:, chosen] for part in self.between])


@dataclass(frozen=True)
class Normal:
    """Normal equations at one covariance, of all columns with each other and with the value."""

    at: Covariance
    matrix: FloatArray
    right: FloatArray
    constant: FloatArray

    @classmethod
    def all(cls, model: MeanModel, columns: Projected, value: Projected) -> list[Normal]:
        """Over the model's grid. Several values at once: right (k, v), constant (v,), log-likelihood without any column."""
        gram_within = columns.within.T @ columns.within
        right_within = columns.within.T @ value.within
        square_within = np.einsum("nv,nv->v", value.within, value.within)
        found = []
        for at in model.covariances:
            basis, y = columns.between[at.length], value.between[at.length]
            weighted = basis * at.weight[:, None]
            constant = np.log(at.weight).sum() - np.einsum("mv,m,mv->v", y, at.weight, y) - square_within
            found.append(cls(at, gram_within + weighted.T @ basis, right_within + weighted.T @ y, 0.5 * constant))
        return found


def gain(normal: Normal, base: list[int], added: list[int]) -> tuple[FloatArray, FloatArray]:
    """(v,) log-likelihood with the columns `base`, and with `base` and `added`."""
    return _explained(normal, base), _explained(normal, base + added)


def _explained(normal: Normal, chosen: list[int]) -> FloatArray:
    if not chosen:
        return normal.constant
    matrix, right = normal.matrix[np.ix_(chosen, chosen)], normal.right[chosen]
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    regular = matrix * np.outer(scale, scale) + _RIDGE * np.eye(len(chosen))
    solved = np.linalg.solve(regular, right * scale[:, None])
    return np.asarray(normal.constant + 0.5 * np.einsum("kv,kv->v", right * scale[:, None], solved))


def solve(normal: Normal, chosen: list[int]) -> Fit:
    """Coefficients of the chosen columns for the first value."""
    matrix, right = normal.matrix[np.ix_(chosen, chosen)], normal.right[chosen, 0]
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    inverse = np.linalg.inv(matrix * np.outer(scale, scale) + _RIDGE * np.eye(len(chosen))) * np.outer(scale, scale)
    return Fit(inverse @ right, inverse, float(_explained(normal, chosen)[0]), normal.at)
