"""Which effects explain the mean: greedy, with the null distribution of the largest gain, classes, and a check by free forms.

The score of a candidate is its gain in log-likelihood less twice what it gains on average where there is nothing (for k free
columns k, as Akaike's criterion; more where a period is searched): the expected gain on new data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.gap.candidates import Candidate
from pipeline.gap.cells import Cells
from pipeline.gap.mean_model import Fit, MeanModel, Normal, gain, solve
from pipeline.gap.residuals import Residuals
from scene.keyed_random import KeyedRandom
from scene.mesh import FloatArray

ALPHA = 0.004
DRAWS = 499
CLASS_MARGIN = 3.0
"""Scores within this of the best belong to its class: e^-3 in likelihood."""
_FREE_MARGIN = 5.0
"""A free form must score as much more than the catalogue's best to be called unknown."""
_LEAST_SCORE = 4.0
_MOST_EFFECTS = 3
POSE = tuple(range(6))


@dataclass(frozen=True)
class Tried:
    """What a family of candidates gained. name; score; gain; variant: index of the best candidate in the search's list."""

    name: str
    empirical: bool
    score: float
    gain: float
    variant: int


@dataclass(frozen=True)
class Chosen:
    """One explanation that was accepted. alike: others that score as well; fit: of its columns, beside all else."""

    candidate: Candidate
    alike: tuple[str, ...]
    p_value: float
    gain: float
    score: float
    tried: tuple[Tried, ...]


def _without_pose(columns: FloatArray, sigma: FloatArray) -> FloatArray:
    """The columns with those of the pose made orthonormal and taken out of the others, which keeps every other coefficient.

    A shift and a turn of a distant sensor are so much alike that the normal equations would lose what tells them apart.
    """
    weighted = columns / sigma[:, None]
    pose = np.linalg.qr(weighted[:, POSE])[0]
    rest = weighted[:, len(POSE) :]
    rest = rest - pose @ (pose.T @ rest)
    return np.concatenate([pose, rest], axis=1) * sigma[:, None]


class MeanSearch:
    """All candidates on one set of points."""

    def __init__(self, residuals: Residuals, candidates: list[Candidate], random: KeyedRandom) -> None:
        self.candidates, self._random = candidates, random
        self._columns: list[list[int]] = []
        matrices, start = [residuals.pose], len(POSE)
        for candidate in candidates:
            width = candidate.columns.shape[1]
            self._columns.append(list(range(start, start + width)))
            matrices.append(candidate.columns)
            start += width
        self.cells = Cells.over(residuals.at)
        self.model = MeanModel(self.cells, residuals.sigma)
        columns = _without_pose(np.concatenate([*matrices, residuals.value[:, None]], axis=1), residuals.sigma)
        self._matrix, self._values = columns[:, :-1], columns[:, -1]
        self._pose, self._raw, self._sigma = residuals.pose, residuals.value, residuals.sigma
        self._projected, value = self.model.project(columns[:, :-1]), self.model.project(columns[:, -1:])
        self._normals = Normal.all(self.model, self._projected, value)
        self.null = max(self._normals, key=lambda normal: float(gain(normal, list(POSE), [])[0][0])).at
        self._nulls = self._null_gains()

    def _families(self) -> dict[str, list[int]]:
        families: dict[str, list[int]] = {}
        for index, candidate in enumerate(self.candidates):
            families.setdefault(("free " if candidate.empirical else "") + candidate.name, []).append(index)
        return families

    def _profile(self, normals: list[Normal], base: list[int], variants: list[int]) -> FloatArray:
        """(variants, values) largest log-likelihood over the covariances."""
        return np.stack([np.max([gain(normal, base, self._columns[v])[1] for normal in normals], axis=0) for v in variants])

    def _null_gains(self) -> dict[str, FloatArray]:
        """Gains of every family where there is nothing but pose, correlated error and noise, (DRAWS,) each."""
        gram = self._projected.within.T @ self._projected.within
        values, vectors = np.linalg.eigh(gram)
        normal = self._random.child("within").generator().standard_normal((len(gram), DRAWS))
        within = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * normal)
        between = self.model.null_draws(self.null, DRAWS, self._random.child("between"))
        normals = []
        for found in self._near_null():
            at, basis = found.at, self._projected.between[found.at.length]
            weighted = between[at.length] * at.weight[:, None]
            constant = 0.5 * (np.log(at.weight).sum() - np.einsum("mv,mv->v", between[at.length], weighted))
            normals.append(Normal(at, found.matrix, within + basis.T @ weighted, constant))
        plain = np.max([gain(normal, list(POSE), [])[0] for normal in normals], axis=0)
        return {
            name: np.maximum(self._profile(normals, list(POSE), variants).max(axis=0) - plain, 0.0)
            for name, variants in self._families().items()
        }

    def _near_null(self) -> list[Normal]:
        """Covariances that the data allow: those whose likelihood comes within 30 of the best, thinned to a dozen."""
        ranked = sorted(self._normals, key=lambda normal: -float(gain(normal, list(POSE), [])[0][0]))
        return ranked[:8]

    def tried(self, base: list[int]) -> list[Tried]:
        """Every family's best variant over the columns `base`, best score first."""
        plain = max(float(gain(normal, base, [])[0][0]) for normal in self._normals)
        found = []
        for name, variants in self._families().items():
            gains = self._profile(self._normals, base, variants)[:, 0] - plain
            best = int(np.argmax(gains))
            penalty = 2 * float(self._nulls[name].mean())
            found.append(
                Tried(
                    name.removeprefix("free "),
                    name.startswith("free "),
                    float(gains[best]) - penalty,
                    float(gains[best]),
                    variants[best],
                )
            )
        return sorted(found, key=lambda item: -item.score)

    def p_value(self, item: Tried) -> float:
        """Of the largest score over all families where there is nothing: (1 + b) / (1 + N)."""
        scores = np.stack([gains - 2 * gains.mean() for gains in self._nulls.values()])
        return float((1 + np.sum(scores.max(axis=0) >= item.score)) / (1 + DRAWS))

    def fit(self, base: list[int]) -> Fit:
        """The columns `base` at their most likely covariance."""
        best = max(self._normals, key=lambda normal: float(gain(normal, base, [])[0][0]))
        return solve(best, base)

    def columns(self, variants: list[int]) -> list[int]:
        """Pose and the columns of some candidates."""
        return [*POSE, *(column for variant in variants for column in self._columns[variant])]

    def select(self) -> tuple[list[Chosen], list[Tried]]:
        """Explanations in order, and what was tried after the last of them."""
        chosen: list[Chosen] = []
        variants: list[int] = []
        while True:
            had = {item.candidate.name for item in chosen}
            tried = [item for item in self.tried(self.columns(variants)) if item.name not in had]
            best = self._best(tried, variants)
            if best is None or len(chosen) == _MOST_EFFECTS:
                return chosen, tried
            chosen.append(self._chosen(best, tried, variants))
            variants.append(best.variant)
            if best.empirical:
                return chosen, self.tried(self.columns(variants))

    def _best(self, tried: list[Tried], variants: list[int]) -> Tried | None:
        """What to add next: the catalogue's best unless a free form clearly beats it and any pair that starts with it."""
        top = tried[0]
        if top.score < _LEAST_SCORE or self.p_value(top) > ALPHA:
            return None
        named = [item for item in tried if not item.empirical]
        if not top.empirical:
            return top
        if top.score < named[0].score + _FREE_MARGIN:
            return named[0] if self.p_value(named[0]) <= ALPHA and named[0].score >= _LEAST_SCORE else top
        for first in named[:3]:
            pair = [item for item in self.tried(self.columns([*variants, first.variant])) if not item.empirical]
            if first.score + pair[0].score + _FREE_MARGIN > top.score and first.score > _LEAST_SCORE:
                return first
        return top

    def _chosen(self, best: Tried, tried: list[Tried], variants: list[int]) -> Chosen:
        alike = () if best.empirical else self._alike(best, tried)
        return Chosen(self.candidates[best.variant], alike, self.p_value(best), best.gain, best.score, tuple(tried))

    def _alike(self, best: Tried, tried: list[Tried]) -> tuple[str, ...]:
        return tuple(i.name for i in tried if i is not best and not i.empirical and i.score > best.score - CLASS_MARGIN)

    def reference_sigma(self, chosen: list[Chosen]) -> float:
        """Standard deviation of the reference's correlated error, in the observable's unit."""
        at = self.fit(self.columns([self.candidates.index(item.candidate) for item in chosen])).at
        return float(np.sqrt(at.ratio)) * self.model.typical_sigma

    def without(self, chosen: list[Chosen]) -> FloatArray:
        """(n,) residuals less pose and the chosen effects at their most likely values."""
        columns = self.columns([self.candidates.index(item.candidate) for item in chosen])
        return np.asarray(self._values - self._matrix[:, columns] @ self.fit(columns).coefficients)

    def refined(self, chosen: list[Chosen]) -> tuple[list[Candidate], FloatArray, FloatArray]:
        """The chosen candidates with their periods refined between the grid's, coefficients and covariance of all of them."""
        candidates = [self._refined(item.candidate, chosen) for item in chosen]
        columns = np.concatenate([self._pose, *(each.columns for each in candidates), self._raw[:, None]], axis=1)
        clean = _without_pose(columns, self._sigma)
        projected, value = self.model.project(clean[:, :-1]), self.model.project(clean[:, -1:])
        base = list(range(clean.shape[1] - 1))
        normals = Normal.all(self.model, projected, value)
        found = solve(max(normals, key=lambda normal: float(gain(normal, base, [])[0][0])), base)
        return candidates, found.coefficients[len(POSE) :], found.covariance[len(POSE) :, len(POSE) :]

    def _refined(self, candidate: Candidate, chosen: list[Chosen]) -> Candidate:
        """The period at the top of the white likelihood near the grid's best, with its standard error by the curvature."""
        wave = candidate.wave
        if wave is None:
            return candidate
        others = [item.candidate.columns for item in chosen if item.candidate is not candidate]
        base = np.linalg.qr(np.concatenate([self._pose, *others], axis=1) / self._sigma[:, None])[0]
        value = self._raw / self._sigma
        value = value - base @ (base.T @ value)

        def explained(frequency: float) -> float:
            columns = wave.columns(1 / frequency) / self._sigma[:, None]
            columns = columns - base @ (base.T @ columns)
            return float(0.5 * value @ columns @ np.linalg.lstsq(columns, value, rcond=None)[0])

        centre, step = 1 / float(candidate.fixed[wave.key]), 0.5 / float(np.ptp(wave.x))
        for width in (step, step / 10):
            trial = centre + np.linspace(-width, width, 21)
            centre = float(trial[int(np.argmax([explained(each) for each in trial]))])
        width = step / 20
        curvature = (2 * explained(centre) - explained(centre - width) - explained(centre + width)) / width**2
        error = 1 / np.sqrt(max(curvature, 1e-12)) / centre**2
        return replace(
            candidate,
            columns=wave.columns(1 / centre),
            fixed={**candidate.fixed, wave.key: 1 / centre},
            errors={wave.key: float(error)},
        )

    def identifiability(self) -> tuple[list[str], FloatArray, FloatArray]:
        """Names of the families, cosines of their signatures after the pose fit, and the share that survives the pose fit."""
        normal = next(found for found in self._normals if found.at == self.null)
        names, first = [], []
        for name, variants in self._families().items():
            if not name.startswith("free "):
                names.append(name)
                first.append(self._columns[variants[0]][0])
        matrix, pose = normal.matrix, list(POSE)
        cross = np.linalg.lstsq(matrix[np.ix_(pose, pose)], matrix[np.ix_(pose, first)], rcond=None)[0]
        left = matrix[np.ix_(first, first)] - matrix[np.ix_(first, pose)] @ cross
        size, whole = np.sqrt(np.maximum(np.diag(left), 0)), np.sqrt(np.maximum(np.diag(matrix)[first], 1e-300))
        scale = np.maximum(size, 1e-12 * whole)
        return names, np.clip(left / np.outer(scale, scale), -1, 1), size / whole
