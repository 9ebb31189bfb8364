"""Noise of disparities that neighbours share, as random numbers on the nodes of a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scene.geometry.mesh import FloatArray
from sensors.effects.matching_noise import MatchingNoise, NodeNoise
from sensors.models.sensor_model import StereoModel
from sensors.signal_chain.node_grid import MEAN_VARIANCE

_MOST_NODES = 2500
"""What is finer is represented by nodes farther apart, of the same power at long wavelengths."""
_SAMPLE = 500
_RIDGE = 1e-4
_REACH = 2.5
"""Steps of an effect over which its nodes' noise is followed: disparities two steps apart share none."""


@dataclass(frozen=True, eq=False)
class NodeField:
    """Noise as random values on the nodes of a grid, interpolated bilinearly. weights: (n, q); covariance: (q, q), px2."""

    weights: sparse.csr_array
    covariance: FloatArray

    @property
    def variance(self) -> float:
        """Of a point on average, px2."""
        some = self.weights[:: max(self.weights.shape[0] // _SAMPLE, 1)]
        return float(np.mean((some @ self.covariance * some.toarray()).sum(axis=1))) if some.shape[1] else 0.0


@dataclass(frozen=True)
class GridCorrelatedNoise:
    """What of the predicted noise neighbours share. effects: what makes it; pixels: (n, 2) columns and rows of the points."""

    effects: tuple[NodeNoise, ...] = ()
    pixels: FloatArray | None = None

    @classmethod
    def of(cls, model: StereoModel, pixels: FloatArray) -> GridCorrelatedNoise:
        """What a model predicts of it."""
        return cls(_shared(model.matching_noise), pixels)

    def part(self, rows: Any) -> GridCorrelatedNoise:
        """Of some of the points."""
        return self if self.pixels is None else replace(self, pixels=self.pixels[rows])

    def with_effects(self, effects: Sequence[MatchingNoise]) -> GridCorrelatedNoise:
        """With further noise."""
        return replace(self, effects=(*self.effects, *_shared(effects)))

    def node_field(self, count: int) -> NodeField:
        """As values on nodes; of `count` points.

        What is finer than the points' own spacing is as good as white, and left out.
        """
        if self.pixels is None or not count:
            return _none(count)
        area = float(np.prod(np.maximum(np.ptp(self.pixels, axis=0), 1.0)))
        coarse = [effect for effect in self.effects if effect.step_px**2 > area / count]
        return _on_nodes(coarse, self.pixels, area) if coarse else _none(count)


NO_CORRELATED_NOISE = GridCorrelatedNoise()


def _none(count: int) -> NodeField:
    return NodeField(sparse.csr_array((count, 0)), np.zeros((0, 0)))


def _on_nodes(effects: list[NodeNoise], pixels: FloatArray, area: float) -> NodeField:
    """The covariance of all of them together on nodes half as far apart as those of the finest, where they lie not being known.

    Nodes so far apart that they miss some of it are given its power at long wavelengths, which is 9/4 of the variance times the
    square of the step (that of bilinear interpolation).
    """
    step = max(min(effect.step_px for effect in effects) / 2, float(np.sqrt(area / _MOST_NODES)))
    weights, nodes = _bilinear(pixels, step)
    place = np.rint(nodes / step).astype(np.int64)
    matrix = sum((_stationary(place, _table(effect, step)) for effect in effects), np.zeros((len(nodes), len(nodes))))
    return NodeField(weights, matrix + _RIDGE * matrix[0, 0] * np.eye(len(nodes)))


def _table(effect: NodeNoise, step: float) -> FloatArray:
    """(k, k) covariance of two nodes that are apart by up to (k - 1) / 2 steps along either axis."""
    reach = int(np.ceil(_REACH * effect.step_px / step))
    near = step * np.arange(-reach, reach + 1)
    around = np.stack(np.meshgrid(near, near, indexing="ij"), axis=-1).reshape(-1, 2)
    table = effect.covariance(around).reshape(len(near), -1)
    scale = effect.total_variance / MEAN_VARIANCE * effect.step_px**2 / (step**2 * float(table.sum()))
    return np.asarray(scale * table)


def _stationary(place: NDArray[np.int64], table: FloatArray) -> FloatArray:
    """(q, q) covariance of nodes at `place` ((q, 2), in steps of their grid), which is 0 but for those near each other.

    table: (k, k) of two that are apart by up to (k - 1) / 2 steps along either axis.
    """
    corner, margin = place.min(axis=0), len(table) // 2
    number = np.full(np.ptp(place, axis=0) + 1 + 2 * margin, -1)
    inside = place - corner + margin
    number[tuple(inside.T)] = np.arange(len(place))
    matrix = np.zeros((len(place), len(place)))
    for (row, column), covariance in np.ndenumerate(table):
        other = number[inside[:, 0] + margin - row, inside[:, 1] + margin - column]
        there = other >= 0
        matrix[np.flatnonzero(there), other[there]] = covariance
    return matrix


def _bilinear(pixels: FloatArray, step_px: float) -> tuple[sparse.csr_array, FloatArray]:
    """Bilinear weights (n, q) of pixels (n, 2) on the nodes of a grid at multiples of `step_px`, and their places (q, 2), px.

    Only nodes are given that have some weight.
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


def _shared(effects: Sequence[MatchingNoise]) -> tuple[NodeNoise, ...]:
    return tuple(effect for effect in effects if isinstance(effect, NodeNoise) and not effect.is_null)
