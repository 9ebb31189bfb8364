"""Noise of the deviations within cells: white, and what neighbours share of it.

In units of the predicted spread the deviations have the covariance R = w I + Z C Z', w the white share, C the covariance of
random numbers on q nodes and Z (n, q) what those do, less its mean in each cell. By Woodbury's identity
R^-1 = (I - Z K^-1 Z') / w with K = w C^-1 + Z'Z, so that products with R^-1 need q by q matrices only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri

from pipeline.gap.residuals.correlated_noise import NodeField
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

_LEAST_WHITE = 0.02
"""Share of the variance that counts as white where a model says there is none."""


@dataclass(frozen=True, eq=False)
class WithinCellNoise:
    """white: w; nodes: (n, q) before the cells' means are taken off; means: (m, q) of the cells, over the standard deviation that
    white noise gives them; prior, root: (q, q) lower Cholesky factors of C and of K."""

    white: float
    nodes: sparse.csr_array
    means: FloatArray
    prior: FloatArray
    root: FloatArray

    @classmethod
    def of(cls, field: NodeField, inverse_sigma: FloatArray, gathered: sparse.csr_array) -> WithinCellNoise:
        """inverse_sigma: (n,) of the points; gathered: (m, n) from columns over sigma to the cells' means."""
        nodes = sparse.csr_array(field.weights.multiply(inverse_sigma[:, None]))
        means = (gathered @ nodes).toarray()
        if not nodes.shape[1]:
            return cls(1.0, nodes, means, field.covariance, field.covariance)
        white = max(1 - field.variance * float(np.mean(inverse_sigma**2)), _LEAST_WHITE)
        prior = cholesky(field.covariance, lower=True)
        matrix = (nodes.T @ nodes).toarray() - means.T @ means + white * inverse_from_cholesky(prior)
        return cls(white, nodes, means, prior, cholesky(matrix, lower=True))

    def mean_covariance(self) -> FloatArray:
        """(m, m) covariance of the cells' means."""
        shared = self.means @ self.prior
        return np.asarray(self.white * np.eye(len(shared)) + shared @ shared.T)

    @property
    def is_white(self) -> bool:
        """Whether neighbours share nothing."""
        return self.nodes.shape[1] == 0

    def to_nodes(self, columns: FloatArray, means: FloatArray | None = None) -> FloatArray:
        """(q, k) Z' of columns (n, k); means: (m, k) of their cells, None where they are deviations already."""
        found = np.asarray(self.nodes.T @ columns)
        return found if means is None else found - self.means.T @ means

    def solve(self, on_nodes: FloatArray) -> FloatArray:
        """(q, k) K^-1 of columns on the nodes."""
        return np.asarray(cho_solve((self.root, True), on_nodes)) if len(self.root) else on_nodes

    def whiten(self, on_nodes: FloatArray) -> FloatArray:
        """(q, k) columns whose products are those of `on_nodes` with K^-1 between them."""
        return np.asarray(solve_triangular(self.root, on_nodes, lower=True)) if len(self.root) else on_nodes

    def draw(self, white: FloatArray, rows: slice, spread: FloatArray, random: KeyedRandom) -> FloatArray:
        """(q, d) what draws of the noise add to the products of columns on the nodes, beside `white` / root w with themselves.

        white: (n', d) draws of white noise on some `rows`; spread: (m, d) their sums over cells, as `means`. For noise
        r = root w e + Z n, c' R^-1 r = c' e / root w + (Z' c)' K^-1 (C^-1 n - Z' e / root w).
        """
        own = random.generator().standard_normal((len(self.root), white.shape[1]))
        if not self.is_white:
            own = solve_triangular(self.prior, own, lower=True, trans="T")
        shared = self.nodes[rows].T @ white - self.means.T @ spread
        return self.solve(own - shared / np.sqrt(self.white))


def inverse_from_cholesky(root: FloatArray) -> FloatArray:
    """(q, q) inverse of the matrix whose lower Cholesky factor is given."""
    half = np.tril(dpotri(root, lower=True)[0])
    return np.asarray(half + np.tril(half, -1).T)
