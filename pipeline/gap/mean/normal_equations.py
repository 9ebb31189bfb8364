"""The normal equations of all candidates at every covariance of the cell means, so that any set of them can be compared at once.

Columns are of two kinds: fixed ones, whose products with each other are all known, and searched sines, of each of which only the
products with itself and with the fixed columns are. A sine that is to stand beside others becomes fixed first (`extended`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.gap.mean.candidates import SineGrid
from pipeline.gap.mean.mean_model import Covariance, MeanModel, Projected
from scene.keyed_random import KeyedRandom
from scene.mesh import FloatArray
from scene.threads import side_by_side

_SMALLEST = 1e-9
"""Share of a column that others have to leave of it, in variance, for its gain to be told from rounding."""
_RIDGE = 1e-12
_AT_ONCE = 8
"""Covariances together, whatever the number of threads: fewer would cost more in calls than a second core gains."""


@dataclass(frozen=True)
class Waves:
    """Products of w sines (2 w columns) on the deviations within cells, by the inverse covariance of their noise. fixed: (2 w, k)
    with fixed columns; own: (w, 2, 2); right: (2 w, v) with the values; noise: (2 w, d) with draws of noise; means: (m, 2 w) of
    the cells."""

    fixed: FloatArray
    own: FloatArray
    right: FloatArray
    noise: FloatArray
    means: FloatArray

    @classmethod
    def of(cls, model: MeanModel, grids: list[SineGrid], fixed: Projected, value: Projected, noise: NoiseDraws) -> Waves:
        """Of all sines of some grids."""
        beside = np.concatenate([fixed.weighed, value.weighed], axis=1)

        def some(grid: SineGrid) -> tuple[FloatArray, ...]:
            columns = grid.columns(model.root)
            planes = model.planes(columns)
            means = planes[: model.cells]
            on_nodes = model.noise.on_nodes(columns, means)
            own = (_squares(columns) - _squares(planes) - _squares(model.noise.halved(on_nodes))) / model.noise.white
            drawn = noise.products(model.within(columns, planes, noise.rows), on_nodes)
            return columns.T @ beside, own, drawn, means.T

        parts = side_by_side(some, [part for grid in grids for part in grid.chunks])
        count = fixed.within.shape[1]
        if not parts:
            empty = np.zeros((0, count)), np.zeros((0, 2, 2)), np.zeros((0, value.within.shape[1]))
            return cls(*empty, np.zeros((0, noise.white.shape[1])), np.zeros((model.cells, 0)))
        products, own, drawn, means = (np.concatenate([part[k] for part in parts]) for k in range(4))
        return cls(products[:, :count], own, products[:, count:], drawn, means.T)


@dataclass(frozen=True, eq=False)
class NoiseDraws:
    """Draws of the noise within cells. rows: some n' of the points; white: (n', d) on them; on_nodes: (q, d) by `WithinNoise`."""

    rows: slice
    white: FloatArray
    on_nodes: FloatArray

    @classmethod
    def of(cls, model: MeanModel, count: int, most_rows: int, random: KeyedRandom) -> NoiseDraws:
        """`count` draws; white noise on some of the rows stands for that on all."""
        rows = slice(None, None, max(len(model) // most_rows, 1))
        few = len(model.root[rows])
        white = random.generator().standard_normal((few, count)) * np.sqrt(len(model) / few)
        on_nodes = model.noise.drawn(white, rows, model.planes(white, rows)[: model.cells], random.child("nodes"))
        return cls(rows, white / np.sqrt(model.noise.white), on_nodes)

    def products(self, within: FloatArray, on_nodes: FloatArray) -> FloatArray:
        """(k, d) of columns with the draws, by the inverse covariance. within: (n', k); on_nodes: (q, k)."""
        return np.asarray(within.T @ self.white + on_nodes.T @ self.on_nodes)


def _squares(columns: FloatArray) -> FloatArray:
    """(w, 2, 2) products of each pair of columns (n, 2 w) with itself."""
    pairs = columns.T.reshape(columns.shape[1] // 2, 2, len(columns))
    return np.asarray(pairs @ pairs.transpose(0, 2, 1))


def wave_products(grids: list[SineGrid], weighed: FloatArray, root: FloatArray) -> FloatArray:
    """(2 w, k) of all sines with further columns (n, k), which are within cells and weighed."""
    found = side_by_side(lambda part: part.columns(root).T @ weighed, [part for grid in grids for part in grid.chunks])
    return np.concatenate(found) if found else np.zeros((0, weighed.shape[1]))


@dataclass(frozen=True)
class Equations:
    """For each of C covariances. fixed: (C, k, k); right: (C, k, v); constant: (C, v) log-likelihood without any column;
    wave_fixed: (C, 2 w, k); wave_own: (C, w, 2, 2); wave_right: (C, 2 w, v); at: the covariances."""

    at: list[Covariance]
    fixed: FloatArray
    right: FloatArray
    constant: FloatArray
    wave_fixed: FloatArray
    wave_own: FloatArray
    wave_right: FloatArray

    def with_precision(self, precision: FloatArray) -> Equations:
        """The same where the fixed columns' coefficients are known to lie about 0. precision: (k,) inverse variances."""
        return replace(self, fixed=self.fixed + np.diag(precision))

    def of_values(self, right: FloatArray, constant: FloatArray, wave_right: FloatArray) -> Equations:
        """The same columns with other values."""
        return replace(self, right=right, constant=constant, wave_right=wave_right)

    def some(self, chosen: list[int]) -> Equations:
        """At some of the covariances."""
        return Equations([self.at[index] for index in chosen], *(array[chosen] for array in self._arrays))

    def _part(self, rows: slice) -> Equations:
        return Equations(self.at[rows], *(array[rows] for array in self._arrays))

    @property
    def _arrays(self) -> tuple[FloatArray, ...]:
        return self.fixed, self.right, self.constant, self.wave_fixed, self.wave_own, self.wave_right

    def log_likelihood(self, base: list[int]) -> FloatArray:
        """(C, v) with the fixed columns `base`."""
        right = self.right[:, base]
        return np.asarray(self.constant + 0.5 * np.einsum("ckv,ckv->cv", right, self._solved(base, right)))

    def _solved(self, base: list[int], right: FloatArray) -> FloatArray:
        matrix = self.fixed[:, base][:, :, base]
        scale = 1 / np.sqrt(np.maximum(np.einsum("ckk->ck", matrix), 1e-300))
        regular = matrix * scale[:, :, None] * scale[:, None, :] + _RIDGE * np.eye(len(base))
        return np.asarray(np.linalg.solve(regular, right * scale[:, :, None]) * scale[:, :, None])

    def profile(self, base: list[int], fixed: list[list[int]]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Largest log-likelihoods over the covariances: (v,) of `base`, (f, v) with each list of columns added, (w, v) with each
        sine added."""
        parts = [self._part(slice(start, start + _AT_ONCE)) for start in range(0, len(self.at), _AT_ONCE)]
        found = side_by_side(lambda part: part._profile(base, fixed), parts)
        plain, gains, waves = (np.max([each[kind] for each in found], axis=0) for kind in range(3))
        return plain, gains, waves

    def _profile(self, base: list[int], fixed: list[list[int]]) -> tuple[FloatArray, FloatArray, FloatArray]:
        count = self.right.shape[2]
        wanted = sorted({column for columns in fixed for column in columns})
        place = {column: row for row, column in enumerate(wanted)}
        beside = self.fixed[:, base][:, :, wanted]
        waves = self.wave_fixed[:, :, base].transpose(0, 2, 1)
        solved = self._solved(base, np.concatenate([self.right[:, base], beside, waves], axis=2))
        value, others, sines = np.split(solved, [count, count + len(wanted)], axis=2)
        plain = self.constant + 0.5 * np.einsum("ckv,ckv->cv", self.right[:, base], value)
        left = self.right[:, wanted] - beside.transpose(0, 2, 1) @ value
        own = self.fixed[:, wanted][:, :, wanted]
        rest = own - beside.transpose(0, 2, 1) @ others
        gains = np.stack(
            [(plain + _gain(rest, own, left, [place[column] for column in columns])).max(axis=0) for columns in fixed]
        ) if fixed else np.zeros((0, count))  # fmt: skip
        turned = self.wave_right - self.wave_fixed[:, :, base] @ value
        return plain.max(axis=0), gains, self._wave_profile(plain, turned, sines, base)

    def _wave_profile(self, plain: FloatArray, right: FloatArray, solved: FloatArray, base: list[int]) -> FloatArray:
        """Two columns at a time: the explained square by the inverse of a 2 x 2 matrix."""
        count = self.wave_own.shape[1]
        crossed = self.wave_fixed[:, :, base].reshape(len(self.at), count, 2, len(base))
        mine = solved.transpose(0, 2, 1).reshape(len(self.at), count, 2, len(base))
        matrix = self.wave_own - crossed @ mine.transpose(0, 1, 3, 2)
        a, b, d = (matrix[:, :, i, j][..., None] for i, j in ((0, 0), (0, 1), (1, 1)))
        r, s = right[:, 0::2], right[:, 1::2]
        determinant = a * d - b * b
        whole = (self.wave_own[:, :, 0, 0] * self.wave_own[:, :, 1, 1])[..., None]
        explained = np.where(determinant > _SMALLEST * whole, 0.5 * (r * r * d - 2 * r * s * b + s * s * a), 0.0)
        gains = explained / np.where(determinant > _SMALLEST * whole, determinant, 1.0)
        return np.asarray((plain[:, None] + np.maximum(gains, 0.0)).max(axis=0))


def _gain(rest: FloatArray, own: FloatArray, left: FloatArray, columns: list[int]) -> FloatArray:
    """(C, v) explained by some columns of what the base leaves: `rest` of their products `own`, `left` of the right side."""
    matrix, right = rest[:, columns][:, :, columns], left[:, columns]
    scale = np.sqrt(np.maximum(np.einsum("ckk->ck", own)[:, columns], 1e-300))
    values, vectors = np.linalg.eigh(matrix / scale[:, :, None] / scale[:, None, :])
    turned = vectors.transpose(0, 2, 1) @ (right / scale[:, :, None])
    share = np.where(values > _SMALLEST, 1 / np.maximum(values, _SMALLEST), 0.0)
    return np.asarray(0.5 * np.einsum("ck,ckv->cv", share, turned**2))


def assembled(model: MeanModel, at: list[Covariance], fixed: Projected, value: Projected, waves: Waves) -> Equations:
    """The equations at the covariances `at`."""
    between = model.between(waves.means)
    gram, right = fixed.within.T @ fixed.weighed, fixed.within.T @ value.weighed
    square = np.einsum("nv,nv->v", value.within, value.weighed)

    def at_one(each: Covariance) -> tuple[FloatArray, ...]:
        basis, y, sines = fixed.between[each.length], value.between[each.length], between[each.length]
        weight = each.weight[:, None]
        turned = (sines * weight).T
        pairs = turned.reshape(-1, 2, len(weight)), sines.T.reshape(-1, 2, len(weight))
        constant = 0.5 * (np.log(each.weight).sum() - np.sum(y * weight * y, axis=0) - square)
        return (
            gram + (basis * weight).T @ basis,
            right + (basis * weight).T @ y,
            constant,
            waves.fixed + turned @ basis,
            waves.own + pairs[0] @ pairs[1].transpose(0, 2, 1),
            waves.right + turned @ y,
        )

    return Equations(at, *(np.stack(parts) for parts in zip(*side_by_side(at_one, at), strict=True)))


def extended(
    model: MeanModel,
    equations: Equations,
    had: Projected,
    value: Projected,
    added: Projected,
    waves: FloatArray,
    means: FloatArray,
) -> Equations:
    """With further fixed columns. had: the fixed columns so far; waves: (2 w, a) products with the sines; means: theirs."""
    between = model.between(means)
    cross, own = had.within.T @ added.weighed, added.within.T @ added.weighed
    right = added.within.T @ value.weighed
    fixed, sides, sines = [], [], []
    for row, each in enumerate(equations.at):
        weighted = added.between[each.length] * each.weight[:, None]
        beside = cross + had.between[each.length].T @ weighted
        fixed.append(np.block([[equations.fixed[row], beside], [beside.T, own + added.between[each.length].T @ weighted]]))
        sides.append(np.concatenate([equations.right[row], right + weighted.T @ value.between[each.length]]))
        sines.append(np.concatenate([equations.wave_fixed[row], waves + between[each.length].T @ weighted], axis=1))
    return replace(equations, fixed=np.stack(fixed), right=np.stack(sides), wave_fixed=np.stack(sines))
