"""Represent grid-correlated noise of disparities: random values at the nodes of a grid, interpolated bilinearly to the points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cholesky
from scipy.linalg.lapack import dpotri

from scene.geometry.mesh import FloatArray
from sensors.effects.matching_noise import MatchingNoise, NodeNoise
from sensors.signal_chain.node_grid import MEAN_VARIANCE

_MOST_NODES = 2500
"""Most nodes. A finer grid is replaced by a coarser one with the same power at long wavelengths."""
_SAMPLE = 500
"""Points over which the variance is averaged."""
_LEAST_WHITE_SHARE = 0.02
"""Least share of a point's variance that counts as white noise."""
_RIDGE = 1e-4
"""Share of a node's variance that is added to the diagonal of the covariance, to keep it positive definite."""
_REACH = 2.5
"""Distance, in node spacings of an effect, up to which its covariance is evaluated: two spacings apart it is zero."""


@dataclass(frozen=True, eq=False)
class NodeField:
    """Grid-correlated noise in matrix form, for the covariance of n points in a least-squares fit.

    Random values at the q nodes of a grid are interpolated bilinearly to the points. The noise of the points then has the
    covariance weights · covariance · weightsᵀ.

    Attributes
    ----------
    weights : (n, q) sparse matrix of bilinear weights.
    covariance : (q, q) covariance of the nodes' values, px².
    """

    weights: sparse.csr_array
    covariance: FloatArray

    @cached_property
    def root(self) -> FloatArray:
        """(q, q) lower Cholesky factor of the covariance of the nodes' values, px."""
        return np.asarray(cholesky(self.covariance, lower=True))

    @cached_property
    def precision(self) -> FloatArray:
        """(q, q) inverse covariance of the nodes' values, 1/px²; Woodbury's identity inverts that of the points with it."""
        half = np.tril(dpotri(self.root, lower=True)[0])
        return np.asarray(half + np.tril(half, -1).T)

    @cached_property
    def variance(self) -> float:
        """Variance of the grid-correlated noise at a point, averaged over a sample of the points, px²; 0 without nodes."""
        some = self.weights[:: max(self.weights.shape[0] // _SAMPLE, 1)]
        return float(np.mean((some @ self.covariance * some.toarray()).sum(axis=1))) if some.shape[1] else 0.0

    def white_variance(self, sigma: FloatArray) -> FloatArray:
        """Return the variance (n,) of the noise that neighbours do not share, px², at least 2 % of the whole one.

        sigma: (n,) predicted standard deviations of the points, px. A model may have grid-correlated noise only.
        """
        return np.asarray(np.maximum(sigma**2 - self.variance, _LEAST_WHITE_SHARE * sigma**2))


@dataclass(frozen=True)
class GridCorrelatedNoise:
    """The part of a stereo pair's predicted noise that neighbouring points share.

    A stereo matcher that smooths its disparities makes such noise. The model is a grid in the image with random values at its
    nodes, interpolated bilinearly to the points. Fits need it, because points with shared noise are not independent.

    Attributes
    ----------
    effects : The terms of the sensor model for such noise, each with its standard deviation and node spacing.
    pixels : (n, 2) columns and rows of the points in the left image, px; None if there is no such noise.
    """

    effects: tuple[NodeNoise, ...] = ()
    pixels: FloatArray | None = None

    def part(self, rows: Any) -> GridCorrelatedNoise:
        """Return the grid-correlated noise at a subset of the n points, given as row numbers, a mask (n,) or a slice."""
        return self if self.pixels is None else replace(self, pixels=self.pixels[rows])

    def with_effects(self, effects: Sequence[MatchingNoise]) -> GridCorrelatedNoise:
        """Return this noise with the grid-correlated ones among further noise terms of a stereo matcher added."""
        added = (effect for effect in effects if isinstance(effect, NodeNoise) and not effect.is_null)
        return replace(self, effects=(*self.effects, *added))

    def node_field(self, count: int) -> NodeField:
        """Return the grid-correlated noise of all points in matrix form, for the covariance in a least-squares fit.

        Noise whose grid is finer than the mean spacing of the points acts like white noise and is left out. The other effects get
        one grid with half the spacing of the finest effect's grid, whose offset is unknown. If that would be too many nodes, a
        coarser grid gets the same power at long wavelengths, which is 9/4 of the variance times the square of the spacing (for
        bilinear interpolation).

        count: number n of points. Without grid-correlated noise the matrix of weights is (n, 0).
        """
        nothing = NodeField(sparse.csr_array((count, 0)), np.zeros((0, 0)))
        if self.pixels is None or not count:
            return nothing
        area = float(np.prod(np.maximum(np.ptp(self.pixels, axis=0), 1.0)))
        coarse = [effect for effect in self.effects if effect.step_px**2 > area / count]
        if not coarse:
            return nothing
        step = max(min(effect.step_px for effect in coarse) / 2, float(np.sqrt(area / _MOST_NODES)))
        weights, nodes = _bilinear(self.pixels, step)
        place = np.rint(nodes / step).astype(np.int64)
        matrix = np.sum([_covariance_of_nodes(place, _covariance_by_offset(effect, step)) for effect in coarse], axis=0)
        return NodeField(weights, matrix + _RIDGE * matrix[0, 0] * np.eye(len(nodes)))


NO_CORRELATED_NOISE = GridCorrelatedNoise()
"""Nothing that neighbouring points share."""


def _covariance_by_offset(effect: NodeNoise, step: float) -> FloatArray:
    """(k, k) covariance of two nodes by their offset along both axes, up to (k - 1) / 2 grid steps either way."""
    reach = int(np.ceil(_REACH * effect.step_px / step))
    near = step * np.arange(-reach, reach + 1)
    around = np.stack(np.meshgrid(near, near, indexing="ij"), axis=-1).reshape(-1, 2)
    table = effect.covariance(around).reshape(len(near), -1)
    scale = effect.total_variance / MEAN_VARIANCE * effect.step_px**2 / (step**2 * float(table.sum()))
    return np.asarray(scale * table)


def _covariance_of_nodes(place: NDArray[np.int64], table: FloatArray) -> FloatArray:
    """(q, q) covariance of nodes at `place` ((q, 2), in grid steps); nodes beyond the reach of `table` are uncorrelated.

    `table`: (k, k) covariance by the offset along both axes, up to (k - 1) / 2 grid steps either way.
    """
    corner, margin = place.min(axis=0), len(table) // 2
    number = np.full(np.ptp(place, axis=0) + 1 + 2 * margin, -1)
    inside = place - corner + margin
    number[tuple(inside.T)] = np.arange(len(place))
    row, column = (each.ravel() for each in np.indices(table.shape))
    other = number[inside[:, :1] + margin - row, inside[:, 1:] + margin - column]
    node, offset = np.nonzero(other >= 0)
    matrix = np.zeros((len(place), len(place)))
    matrix[node, other[node, offset]] = table.ravel()[offset]
    return matrix


def _bilinear(pixels: FloatArray, step_px: float) -> tuple[sparse.csr_array, FloatArray]:
    """Bilinear weights (n, q) of pixels (n, 2) on a grid at multiples of `step_px`, and the nodes' positions (q, 2), px.

    Nodes without any weight are left out.
    """
    corner = np.floor(pixels / step_px).astype(np.int64)
    share = pixels / step_px - corner
    width = int(np.ptp(corner[:, 0])) + 2
    start = (corner - corner.min(axis=0)) @ np.array([1, width])
    places, weights = [], []
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        places.append(start + right + width * down)
        weights.append(np.abs(1 - right - share[:, 0]) * np.abs(1 - down - share[:, 1]))
    nodes, number = np.unique(np.stack(places, axis=1), return_inverse=True)
    rows = np.repeat(np.arange(len(pixels)), 4)
    found = sparse.csr_array((np.stack(weights, axis=1).ravel(), (rows, number.ravel())), shape=(len(pixels), len(nodes)))
    return found, step_px * (np.stack([nodes % width, nodes // width], axis=1) + corner.min(axis=0))
