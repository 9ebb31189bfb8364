"""Model the noise of deviations within cells: white noise and grid-correlated noise.

In units of the predicted sigma the deviations have the covariance R = w I + Z C Z', with w the share of white noise, C the
covariance of the values at q nodes, and Z (n, q) their weights minus the cells' means. By Woodbury's identity
R^-1 = (I - Z K^-1 Z') / w with K = w C^-1 + Z'Z, so products with R^-1 only need q x q matrices.
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
"""Smallest share of white noise in the variance, even if the model has none."""


@dataclass(frozen=True, eq=False)
class WithinCellNoise:
    """Covariance of the noise in deviations within cells, in a form in which its inverse is cheap to apply.

    The covariance of n deviations over sigma is R = w I + Z C Z': white noise, and noise with covariance C at q grid nodes. Z are
    the bilinear weights on the nodes over sigma, minus their cell means. Then R^-1 = (I - Z K^-1 Z') / w with K = w C^-1 + Z'Z.

    Attributes
    ----------
    white : Share w of white noise in the variance.
    nodes : (n, q) weights on the nodes over sigma, before cell means are subtracted.
    means : (m, q) cell means of these weights, over the standard deviation that white noise gives a cell mean.
    prior, root : (q, q) lower Cholesky factors of C and of K.
    """

    white: float
    nodes: sparse.csr_array
    means: FloatArray
    prior: FloatArray
    root: FloatArray

    @classmethod
    def of(cls, field: NodeField, inverse_sigma: FloatArray, gathered: sparse.csr_array) -> WithinCellNoise:
        """Compute the factors of the covariance.

        Parameters
        ----------
        field : The grid-correlated noise at n points.
        inverse_sigma : (n,) inverse standard deviations.
        gathered : (m, n) matrix that maps columns over sigma to cell means.
        """
        nodes = sparse.csr_array(field.weights.multiply(inverse_sigma[:, None]))
        means = (gathered @ nodes).toarray()
        if not nodes.shape[1]:
            return cls(1.0, nodes, means, field.covariance, field.covariance)
        white = max(1 - field.variance * float(np.mean(inverse_sigma**2)), _LEAST_WHITE)
        prior = cholesky(field.covariance, lower=True)
        matrix = (nodes.T @ nodes).toarray() - means.T @ means + white * inverse_from_cholesky(prior)
        return cls(white, nodes, means, prior, cholesky(matrix, lower=True))

    def mean_covariance(self) -> FloatArray:
        """Return the (m, m) noise covariance of the cell means, in units of the variance that white noise alone gives them."""
        shared = self.means @ self.prior
        return np.asarray(self.white * np.eye(len(shared)) + shared @ shared.T)

    @property
    def is_white(self) -> bool:
        """Whether there is no grid-correlated noise."""
        return self.nodes.shape[1] == 0

    def to_nodes(self, columns: FloatArray, means: FloatArray | None = None) -> FloatArray:
        """Multiply columns by Z', the transposed weights with which noise at q grid nodes acts on the n deviations.

        Parameters
        ----------
        columns : (n, k) columns over sigma.
        means : (m, k) their cell means; None if cell means are subtracted from the columns already.

        Returns
        -------
        (q, k) products.
        """
        found = np.asarray(self.nodes.T @ columns)
        return found if means is None else found - self.means.T @ means

    def solve(self, on_nodes: FloatArray) -> FloatArray:
        """Return K^-1 times (q, k) columns over the q grid nodes.

        K = w C^-1 + Z'Z is the information matrix of the node values, times the white variance w.
        """
        return np.asarray(cho_solve((self.root, True), on_nodes)) if len(self.root) else on_nodes

    def whiten(self, on_nodes: FloatArray) -> FloatArray:
        """Transform (q, k) columns over the q grid nodes so that their inner products are weighted by K^-1.

        The result is L^-1 times the columns, with K = w C^-1 + Z'Z = L L', the information matrix of the node values, times the
        white variance w.
        """
        return np.asarray(solve_triangular(self.root, on_nodes, lower=True)) if len(self.root) else on_nodes

    def draw(self, white: FloatArray, rows: slice, cell_sums: FloatArray, random: KeyedRandom) -> FloatArray:
        """Draw the part of simulated noise that acts through the grid nodes, once for any number of design columns.

        The noise r = sqrt(w) e + Z n has white noise e and node values n with covariance C. Its inner product with a column c,
        weighted by the inverse of the covariance R = w I + Z C Z', is c' R^-1 r = c' e / sqrt(w) + (Z' c)' f. Returned is f =
        K^-1 (C^-1 n - Z' e / sqrt(w)) with K = w C^-1 + Z'Z.

        Parameters
        ----------
        white : (n', d) draws of the white noise e at some points.
        rows : Slice of the n points at which they are drawn.
        cell_sums : (m, d) sums of the draws over cells, scaled like `means`.
        random : Source of the random numbers.

        Returns
        -------
        (q, d) vectors f, one for each draw.
        """
        own = random.generator().standard_normal((len(self.root), white.shape[1]))
        if not self.is_white:
            own = solve_triangular(self.prior, own, lower=True, trans="T")
        shared = self.nodes[rows].T @ white - self.means.T @ cell_sums
        return self.solve(own - shared / np.sqrt(self.white))


def inverse_from_cholesky(root: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric (q, q) matrix, given its lower Cholesky factor."""
    half = np.tril(dpotri(root, lower=True)[0])
    return np.asarray(half + np.tril(half, -1).T)
