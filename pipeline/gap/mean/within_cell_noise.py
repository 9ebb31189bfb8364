"""Model the noise of deviations within cells: white noise and grid-correlated noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import cho_solve, cholesky, solve_triangular

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
    noise, plus node values with covariance C. Z are the bilinear weights over sigma, minus their cell means. By Woodbury's
    identity the inverse only needs (q, q) matrices: R^-1 = (I - Z K^-1 Z') / w with K = w C^-1 + Z'Z.

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
        """Compute the covariance of the noise within wall cells from the noise that neighbouring points share.

        Parameters
        ----------
        field : The shared noise: the covariance of the values at the nodes of a pixel grid, and their bilinear weights at n
            points.
        inverse_sigma : (n,) inverse standard deviations of the points.
        gathered : (m, n) matrix that maps a column of n values, each divided by its standard deviation, to its means in m
            cells of the wall, divided by theirs.
        """
        nodes = sparse.csr_array(field.weights.multiply(inverse_sigma[:, None]))
        means = (gathered @ nodes).toarray()
        if not nodes.shape[1]:
            return cls(1.0, nodes, means, field.covariance, field.covariance)
        white = max(1 - field.variance * float(np.mean(inverse_sigma**2)), _LEAST_WHITE)
        matrix = (nodes.T @ nodes).toarray() - means.T @ means + white * field.precision
        return cls(white, nodes, means, field.root, cholesky(matrix, lower=True))

    def mean_covariance(self) -> FloatArray:
        """Return the (m, m) covariance of the noise in the means of m wall cells, over the variance from white noise alone."""
        shared = self.means @ self.prior
        return np.asarray(self.white * np.eye(len(shared)) + shared @ shared.T)

    @property
    def is_white(self) -> bool:
        """Whether the noise is white: neighbouring points share none of it."""
        return self.nodes.shape[1] == 0

    def to_nodes(self, columns: FloatArray, means: FloatArray | None = None) -> FloatArray:
        """Project k design columns on the q nodes of the pixel grid whose noise neighbouring points share: Z' times the columns.

        It is the first step of weighting the columns by the inverse covariance of the noise. Z holds the bilinear weights with
        which the noise at the nodes acts on the n points, minus their means in each wall cell. The products are (q, k).

        columns: (n, k) columns, divided by the standard deviation of each point. means: (m, k) their means in the m cells; None
        if cell means are subtracted from the columns already.
        """
        found = np.asarray(self.nodes.T @ columns)
        return found if means is None else found - self.means.T @ means

    def solve(self, on_nodes: FloatArray) -> FloatArray:
        """Solve K a = b for k columns over the q nodes of the pixel grid: a step of weighting columns by R^-1 (see the class).

        on_nodes: (q, k) columns b: design columns projected on the nodes by `to_nodes`. The columns a are returned, (q, k).
        """
        return np.asarray(cho_solve((self.root, True), on_nodes)) if len(self.root) else on_nodes

    def whiten(self, on_nodes: FloatArray) -> FloatArray:
        """Transform k columns b over the q nodes of the pixel grid to a = L^-1 b with K = L L', so that a' a = b' K^-1 b.

        It serves inner products of design columns that are weighted by the inverse covariance R^-1 of the noise (see the class).

        on_nodes: (q, k) columns b: design columns projected on the nodes by `to_nodes`. The columns a are returned, (q, k).
        """
        return np.asarray(solve_triangular(self.root, on_nodes, lower=True)) if len(self.root) else on_nodes

    def draw(self, white: FloatArray, rows: slice, cell_sums: FloatArray, random: KeyedRandom) -> FloatArray:
        """Simulate noise that neighbouring points share, in a form that quickly gives its effect on any fitted coefficient.

        The noise r = sqrt(w) e + Z v of n points has the covariance R of the class. It consists of white noise e and of values v
        at the q nodes of a pixel grid. Its effect on the coefficient of a design column c (n,) follows from the inner product

            c' R^-1 r = c' e / sqrt(w) + (Z' c)' f,  with  f = K^-1 (C^-1 v - Z' e / sqrt(w))  and  K = w C^-1 + Z'Z.

        The vector f (q,) does not depend on the column, so it is drawn once, here. `NoiseDraws.products` then adds both terms.

        Parameters
        ----------
        white : (n', d) d draws of the white noise e at a subsample of n' points, scaled to stand for all n.
        rows : Slice that selects these n' points from all n.
        cell_sums : (m, d) means of these draws in the m cells of the wall, divided by their standard deviations. They are needed
            because cell means are subtracted from the weights Z.
        random : Source of the random numbers for v.
        """
        own = random.generator().standard_normal((len(self.root), white.shape[1]))
        if not self.is_white:
            own = solve_triangular(self.prior, own, lower=True, trans="T")
        shared = self.nodes[rows].T @ white - self.means.T @ cell_sums
        return self.solve(own - shared / np.sqrt(self.white))
