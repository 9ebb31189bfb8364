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
    """Covariance of the noise of n points after their mean (or plane) in each of m cells of the wall is subtracted.

    A stereo matcher has noise that neighbouring points share. It is modelled as random values at q nodes of a pixel grid,
    interpolated bilinearly. In units of sigma, the standard deviation of each point, the covariance is R = w I + Z C Z': white
    noise, plus node values with covariance C. Z are the bilinear weights over sigma, minus their cell means. The inverse only
    needs (q, q) matrices: R^-1 = (I - Z K^-1 Z') / w with K = w C^-1 + Z'Z.

    Attributes
    ----------
    white : Share w of white noise in the variance.
    nodes : (n, q) bilinear weights over sigma, before cell means are subtracted; q = 0 if all noise is white.
    means : (m, q) cell means of these weights, divided by the standard deviation that white noise gives a cell mean.
    prior, root : (q, q) lower Cholesky factors of C and of K.
    """

    white: float
    nodes: sparse.csr_array
    means: FloatArray
    prior: FloatArray
    root: FloatArray

    @classmethod
    def of(cls, field: NodeField, inverse_sigma: FloatArray, gathered: sparse.csr_array) -> WithinCellNoise:
        """Compute the covariance of the noise within cells from the noise that neighbouring points share.

        Parameters
        ----------
        field : The shared noise at n points: values at the nodes of a grid with their covariance, and bilinear weights.
        inverse_sigma : (n,) inverse standard deviations of the points.
        gathered : (m, n) matrix that maps a column of n values over sigma to its means in m cells of the wall.
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
        """Return the (m, m) covariance of the noise in the means of m cells of the wall.

        Its unit is the variance that white noise alone gives the mean of each cell; off the diagonal is what cells share.
        """
        shared = self.means @ self.prior
        return np.asarray(self.white * np.eye(len(shared)) + shared @ shared.T)

    @property
    def is_white(self) -> bool:
        """Whether the noise is white: neighbouring points share none of it."""
        return self.nodes.shape[1] == 0

    def to_nodes(self, columns: FloatArray, means: FloatArray | None = None) -> FloatArray:
        """Multiply design columns by Z', which maps them to the q grid nodes whose noise neighbouring points share.

        Z holds the bilinear weights with which the noise at the nodes acts on the n points, minus their means in each wall
        cell.

        Parameters
        ----------
        columns : (n, k) columns, divided by the standard deviation of each point.
        means : (m, k) their means in the m cells; None if cell means are subtracted from the columns already.

        Returns
        -------
        (q, k) products.
        """
        found = np.asarray(self.nodes.T @ columns)
        return found if means is None else found - self.means.T @ means

    def solve(self, on_nodes: FloatArray) -> FloatArray:
        """Return K^-1 times k columns over the q nodes of the grid-correlated noise.

        It is a step of weighting design columns by the inverse covariance of the noise. K = w C^-1 + Z'Z, with the share w of
        white noise, the covariance C of the node values, and their weights Z at the points.

        on_nodes: (q, k) columns, as `to_nodes` returns them.
        """
        return np.asarray(cho_solve((self.root, True), on_nodes)) if len(self.root) else on_nodes

    def whiten(self, on_nodes: FloatArray) -> FloatArray:
        """Transform k columns over the q nodes of the grid-correlated noise so that their inner products are weighted by K^-1.

        It is a step of computing products of design columns under the inverse covariance of the noise.

        The result is L^-1 times the columns, with L L' = K = w C^-1 + Z'Z: the share w of white noise, the covariance C of the
        node values, and their weights Z at the points.

        on_nodes: (q, k) columns, as `to_nodes` returns them.
        """
        return np.asarray(solve_triangular(self.root, on_nodes, lower=True)) if len(self.root) else on_nodes

    def draw(self, white: FloatArray, rows: slice, cell_sums: FloatArray, random: KeyedRandom) -> FloatArray:
        """Simulate the part of the noise that acts through the grid nodes, once for any number of design columns.

        The noise r = sqrt(w) e + Z v has white noise e, and node values v with covariance C that neighbouring points share by
        the weights Z. Its inner product with a column c, weighted by the inverse of its covariance R = w I + Z C Z', is c'
        R^-1 r = c' e / sqrt(w) + (Z' c)' f. Returned is f = K^-1 (C^-1 v - Z' e / sqrt(w)) with K = w C^-1 + Z'Z.

        Parameters
        ----------
        white : (n', d) d draws of the white noise e at n' points.
        rows : Slice that selects these n' points from all n.
        cell_sums : (m, d) means of the draws in the m cells of the wall, divided by their standard deviations.
        random : Source of the random numbers for the node values.

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
    """Return the inverse of a symmetric positive definite (q, q) matrix; root: (q, q) its lower Cholesky factor."""
    half = np.tril(dpotri(root, lower=True)[0])
    return np.asarray(half + np.tril(half, -1).T)
