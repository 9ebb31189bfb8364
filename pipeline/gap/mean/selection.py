"""Which effects explain the mean: sets of up to three, the null distribution of the largest gain, classes, a check by free forms.

The score of a candidate is its gain in log-likelihood less twice what it gains on average where there is nothing (for k free
columns k, as Akaike's criterion; more where a period is searched): the expected gain on new data. Sets are grown from the few
best of each size, so that two effects are found too where neither, or a third that looks like their sum, is best alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.mean.candidates import PLACE, SURFACE, Candidate, Explanation, Grid, moved_to, precision_of
from pipeline.gap.mean.mean_model import Fit, MeanModel, Projected, fitted
from pipeline.gap.mean.normal_equations import Waves, assembled, extended, wave_products
from pipeline.gap.residuals.cells import Cells
from pipeline.gap.residuals.residuals import Residuals
from scene.keyed_random import KeyedRandom
from scene.mesh import FloatArray
from sensors.effects.range_offset import RangeOffset

ALPHA = 0.004
DRAWS = 499
CLASS_MARGIN = 3.0
"""Scores within this of the best belong to its class: e^-3 in likelihood, which bounds by 5 % how often the truth is left out."""
FREE_MARGIN = 5.0
"""A free form must score as much more than the catalogue's best to be called unknown."""
_LEAST_SCORE = 4.0
_LEAST_FREE_SCORE = 12.0
"""Of a free form: the reference's error is not quite as its model says, and a flexible form takes that up first."""
_LEAST_SURFACE_SCORE, _SURFACE_RATIO = 15.0, 1.15
"""Of a form of two covariates, and how many times that of one it has to score."""
_WAVE_RATIO = 2.0
"""A wave along a covariate must score so many times what waves in slanting directions do: the reference's error has some too."""
_WAVE_SIGMAS = 1.0
"""Standard deviations of the reference's error that a wave without a name has to have at least."""
_KIN = 0.95
"""Correlation from which on two covariates are one to a free form."""
_MOST_EFFECTS = 3
_LEADING, _LARGE, _MOST_LEADING = 0.5, 50.0, 8
"""Share of the largest gain that an effect must gain to be taken exactly too; the gain below which none is; how many at most."""
_WIDTH = 5
"""Sets of one size that are grown further."""
_NULL_ROWS = 8_000
_NEAR_NULL = 8
_NOT_PLACES = ("intensity", "disparity_fraction")
"""Covariates that do not change along the wall."""
_PRACTICAL = 0.02
"""Share of what a candidate gains by itself that it has to gain beside others: less is what those are not exact in (8 degrees off
the truth they leave so much), which is significant with enough points; an explanation of its own keeps about all."""


@dataclass(frozen=True)
class Tried:
    """What a family of candidates gained beside the effects of a set. candidate: its best variant; slight: whether the gain only
    makes up for what those are not exact in."""

    name: str
    empirical: bool
    score: float
    gain: float
    candidate: Candidate
    slight: bool = False


@dataclass(frozen=True)
class Chosen:
    """One explanation that was accepted. alike: others that score as well; tried: all that stood beside it."""

    candidate: Candidate
    alike: tuple[str, ...]
    p_value: float
    gain: float
    score: float
    tried: tuple[Tried, ...]


@dataclass(frozen=True)
class _Set:
    """Some effects of the catalogue together, and what was tried beside them. score: of all together."""

    members: tuple[Tried, ...]
    score: float
    tried: tuple[Tried, ...]

    @property
    def names(self) -> frozenset[str]:
        return frozenset(member.name for member in self.members)

    @property
    def candidates(self) -> list[Candidate]:
        return [member.candidate for member in self.members]

    @property
    def catalogue(self) -> list[Tried]:
        """Of what was tried, the effects of the catalogue that are not in the set yet, best first."""
        return [item for item in self.tried if not (item.empirical or item.slight) and item.name not in self.names]

    @property
    def decoy(self) -> float:
        """Score of mere places."""
        return max([0.0, *(item.score for item in self.tried if item.name.startswith(PLACE))])

    @property
    def free(self) -> Tried | None:
        """The best free form; of a covariate that changes along the wall only where it does better than mere places do."""
        decoy = self.decoy
        free = [item for item in self.tried if item.empirical and not (item.slight or item.name.startswith(PLACE))]
        found = [item for item in free if _stands_out(item, decoy)]
        plain = next((item for item in found if item.candidate.form != SURFACE), None)
        if plain is None or (found[0].score > plain.score + FREE_MARGIN and found[0].score > _SURFACE_RATIO * plain.score):
            return found[0] if found else None
        return plain


def _weak(form: Tried | None) -> float:
    """Score of a free form that is too weak to be said, and that a weak effect of the catalogue has to do better than; else 0."""
    return form.score if form is not None and form.score < _LEAST_FREE_SCORE else 0.0


def _stands_out(item: Tried, decoy: float) -> bool:
    """Whether a free form does better than mere places, of which the best scores `decoy`."""
    if item.candidate.form == SURFACE:
        return item.score > max(decoy + FREE_MARGIN, _LEAST_SURFACE_SCORE)
    least = (_WAVE_RATIO if item.candidate.form == "wave" else 1.0) * decoy + FREE_MARGIN
    return item.name in _NOT_PLACES or item.score > least


class MeanSearch:
    """All candidates on one set of points."""

    def __init__(
        self,
        residuals: Residuals,
        families: list[Candidate | Grid],
        random: KeyedRandom,
        pose_precision: FloatArray | None = None,
        alone: Mapping[Explanation, float] | None = None,
    ) -> None:
        """pose_precision: (p,) inverse variance of the coefficients of `residuals.pose` before there are data, 0 by default;
        alone: gains of explanations by themselves, where `residuals.pose` holds effects too."""
        self._random = random
        self._plain = [family for family in families if isinstance(family, Candidate)]
        self.cells = Cells.over(residuals.at)
        self.model = MeanModel(self.cells, residuals.sigma, residuals.shared_noise)
        self._residuals = residuals
        rows, root = self.model.rows, self.model.root[:, None]
        self._full_grids = [family for family in families if isinstance(family, Grid)]
        self._grids = [grid.part(rows) for grid in self._full_grids]
        self._pose, self._turn = np.linalg.qr(residuals.pose[rows] * root)
        self._base = list(range(residuals.pose.shape[1]))
        self._pose_precision = np.zeros(len(self._base)) if pose_precision is None else pose_precision
        self.value = self.model.project(residuals.value[rows, None] * root)
        matrices = [candidate.columns[rows] * root for candidate in self._plain]
        self._place: dict[int, list[int]] = {}
        start = len(self._base)
        for candidate in self._plain:
            self._place[id(candidate)] = list(range(start, start + candidate.columns.shape[1]))
            start += candidate.columns.shape[1]
        signatures = self._without_pose(np.concatenate(matrices, axis=1))
        self._fixed = self.model.project(np.concatenate([self._pose, signatures], axis=1))
        self._assemble()
        self._promoted: dict[int, tuple[Candidate, list[int]]] = {}
        self.gains_alone = alone or {}
        self.gains_alone = alone or {
            (each.name, each.empirical): each.gain for each in sorted(self.tried(()), key=lambda it: it.gain)
        }

    def _assemble(self) -> None:
        """Normal equations of the data, and the gains of every family where there is nothing."""
        pose = self._base
        covariances, bases = self.model.narrowed([self._fixed.some(pose), self._fixed], self.value)
        self._fixed, self.value = self._fixed.kept(bases), self.value.kept(bases)
        thin = slice(None, None, max(len(self.model) // _NULL_ROWS, 1))
        count = len(self._fixed.within[thin])
        noise = self._random.child("within").generator().standard_normal((count, DRAWS)) * np.sqrt(len(self.model) / count)
        self._waves = Waves.of(self.model, self._grids, self._fixed.within, self.value.within, noise, thin)
        self.equations = assembled(self.model, covariances, self._fixed, self.value, self._waves).with_precision(
            self._precision()
        )
        ranked = np.argsort(-self.equations.log_likelihood(pose)[:, 0], kind="stable")
        self.null = self.equations.at[ranked[0]]
        self._nulls = self._null_gains([int(index) for index in ranked[:_NEAR_NULL]], self._fixed.within[thin].T @ noise)

    def _precision(self) -> FloatArray:
        """(k,) of the fixed columns: none of the pose's and of free forms."""
        known = [precision_of(candidate, candidate.columns.shape[1]) for candidate in self._plain]
        return np.concatenate([np.zeros(len(self._base)), *known])

    def _null_gains(self, chosen: list[int], within: FloatArray) -> dict[str, FloatArray]:
        """Gains of every family where there is nothing but pose, correlated error and noise, (DRAWS,) each."""
        near = self.equations.some(chosen)
        draws = self.model.null_draws(self.null, DRAWS, self._random.child("between"))
        sines = self.model.between(self._waves.means)
        right, constant, waves = [], [], []
        for at in near.at:
            weighted = draws[at.length] * at.weight[:, None]
            constant.append(0.5 * (np.log(at.weight).sum() - np.sum(draws[at.length] * weighted, axis=0)))
            right.append(within + self._fixed.between[at.length].T @ weighted)
            waves.append(self._waves.noise + sines[at.length].T @ weighted)
        plain, fixed, searched = near.of_values(np.stack(right), np.stack(constant), np.stack(waves)).profile(
            self._base, [self._place[id(candidate)] for candidate in self._plain]
        )
        return {
            name: np.maximum(np.concatenate([fixed[rows], searched[sines]]).max(axis=0) - plain, 0.0)
            for name, (rows, sines) in self._families().items()
        }

    def _families(self) -> dict[str, tuple[list[int], list[int]]]:
        """Of each family the numbers of its plain candidates and of its sines."""
        families: dict[str, tuple[list[int], list[int]]] = {}
        for row, candidate in enumerate(self._plain):
            families.setdefault(candidate.family, ([], []))[0].append(row)
        start = 0
        for grid in self._full_grids:
            stop = start + len(grid.frequencies)
            families.setdefault(grid.candidate(0).family, ([], []))[1].extend(range(start, stop))
            start = stop
        return families

    def _sine(self, number: int) -> Candidate:
        for grid in self._full_grids:
            if number < len(grid.frequencies):
                return grid.candidate(number)
            number -= len(grid.frequencies)
        raise IndexError(number)

    def _without_pose(self, columns: FloatArray) -> FloatArray:
        """A shift and a turn of a distant sensor are so much alike that the normal equations would lose what tells them apart."""
        return columns - self._pose @ (self._pose.T @ columns)

    def _columns(self, candidate: Candidate) -> list[int]:
        """Numbers of a candidate's fixed columns; a sine's period is refined and its columns become fixed."""
        if id(candidate) in self._place:
            return self._place[id(candidate)]
        if id(candidate) not in self._promoted:
            (found,) = self.refined([candidate])[0]
            added = self._projected([found])
            start = self._fixed.within.shape[1]
            products = wave_products(self._grids, added.within, self.model.root)
            self.equations = extended(self.model, self.equations, self._fixed, self.value, added, products, self._waves.means)
            self._fixed = self._fixed.beside(added)
            self._promoted[id(candidate)] = candidate, list(range(start, start + added.within.shape[1]))
        return self._promoted[id(candidate)][1]

    def _projected(self, candidates: list[Candidate]) -> Projected:
        """The columns of some candidates, without pose."""
        return self.model.project(self._without_pose(self._matrix(candidates, None)))

    def _matrix(self, candidates: list[Candidate], slopes: list[FloatArray | None] | None) -> FloatArray:
        """Columns of some candidates over sigma; of a sine with its change by the frequency where `slopes` say so."""
        rows, root = self.model.rows, self.model.root[:, None]
        matrices = []
        for candidate, slope in _with_slopes(candidates, slopes):
            wave = candidate.wave
            columns = candidate.columns if wave is None or slope is None else wave.with_slope(candidate.period, slope)
            matrices.append(columns[rows] * root)
        return np.concatenate(matrices, axis=1)

    def tried(self, members: tuple[Tried, ...]) -> tuple[Tried, ...]:
        """Every family's best variant beside some effects, best score first."""
        base = [*self._base, *(column for member in members for column in self._columns(member.candidate))]
        plain, fixed, searched = self.equations.profile(base, [self._place[id(candidate)] for candidate in self._plain])
        found = []
        for name, (rows, sines) in self._families().items():
            gains = np.concatenate([fixed[rows, 0], searched[sines, 0]]) - plain[0]
            best = int(np.argmax(gains))
            candidate = self._plain[rows[best]] if best < len(rows) else self._sine(sines[best - len(rows)])
            penalty = 2 * float(self._nulls[name].mean())
            gain = float(gains[best])
            slight = gain < _PRACTICAL * self.gains_alone.get((candidate.name, candidate.empirical), 0.0)
            found.append(Tried(candidate.name, candidate.empirical, gain - penalty, gain, candidate, slight))
        return tuple(sorted(found, key=lambda item: -item.score))

    def p_value(self, score: float) -> float:
        """Of the largest score over all families where there is nothing: (1 + b) / (1 + N)."""
        scores = np.stack([gains - 2 * gains.mean() for gains in self._nulls.values()])
        return float((1 + np.sum(scores.max(axis=0) >= score)) / (1 + DRAWS))

    def _significant(self, score: float) -> bool:
        return score >= _LEAST_SCORE and self.p_value(score) <= ALPHA

    def select(self) -> tuple[list[Chosen], tuple[Tried, ...]]:
        """Explanations, and what was tried beside all of them."""
        empty = _Set((), 0.0, self.tried(()))
        levels = [[empty]]
        while len(levels) <= _MOST_EFFECTS:
            grown = self._grown(levels[-1])
            if not grown or not self._significant(grown[0].score - levels[-1][0].score):
                break
            levels.append(grown)
        best = levels[-1][0]
        free = self._free(levels)
        if free is not None and not self._may_be_the_reference(*free):
            members, form = free
            chosen = [self._chosen(_Set(members, 0.0, ()), item) for item in members]
            chosen.append(Chosen(form.candidate, (), self.p_value(form.score), form.gain, form.score, empty.tried))
            return chosen, self.tried(members)
        best, chosen = self._beyond_places(best)
        if best.score <= max(empty.decoy, _weak(empty.free)):  # no effect of the catalogue says it as well
            return [], empty.tried
        return chosen, best.tried

    def _beyond_places(self, found: _Set) -> tuple[_Set, list[Chosen]]:
        """A set without effects that, beside its others, say no more than mere places do beside all of them."""
        chosen = [self._chosen(found, item) for item in found.members]
        least = min(chosen, key=lambda each: each.score, default=None)
        if least is None or least.score > found.decoy:
            return found, chosen
        members = tuple(item for item, each in zip(found.members, chosen, strict=True) if each is not least)
        return self._beyond_places(_Set(members, found.score - least.score, self.tried(members)))

    def leading(self) -> list[Candidate]:
        """Effects of the catalogue that are large and explain much by themselves, each variant for itself, best first."""
        plain, fixed, _ = self.equations.profile(self._base, [self._place[id(candidate)] for candidate in self._plain])
        gains = fixed[:, 0] - plain[0]
        found = [(gain, each) for gain, each in zip(gains, self._plain, strict=True) if not each.empirical]
        ranked = sorted(found, key=lambda item: -item[0])
        least = max(_LEADING * ranked[0][0], _LARGE) if ranked else 0.0
        return [each for gain, each in ranked if gain >= least][:_MOST_LEADING]

    def alone(self, candidate: Candidate) -> Chosen:
        """A candidate by itself."""
        best = next(item for item in self.tried(()) if item.name == candidate.name and not item.empirical)
        item = replace(best, candidate=candidate)
        return self._chosen(_Set((item,), item.score, ()), item)

    def log_likelihood(self, value: FloatArray, candidate: Candidate) -> float:
        """Of other residuals (n,) of the same points, pose and a candidate fitted."""
        matrix = self._matrix([candidate], None)
        columns = self._fixed.some(self._base).beside(self.model.project(self._without_pose(matrix)))
        projected = self.model.project(value[self.model.rows, None] * self.model.root[:, None])
        return fitted(self.model.fine, columns, projected).log_likelihood

    def _may_be_the_reference(self, members: tuple[Tried, ...], form: Tried) -> bool:
        """Whether a wave is no larger than the reference's error beside it, which may hold just such a wave."""
        if form.candidate.form != "wave":
            return False
        candidates, fit = self.refined([form.candidate, *(member.candidate for member in members)])
        values = self.split(fit.coefficients, candidates)[0][:2]
        error = float(np.sqrt(fit.at.ratio)) * self.model.typical_sigma
        return float(np.std(candidates[0].columns @ values)) < _WAVE_SIGMAS * error

    def _grown(self, level: list[_Set]) -> list[_Set]:
        """The best sets of one effect more, best first."""
        found: dict[frozenset[str], tuple[Tried, ...]] = {}
        scores: dict[frozenset[str], float] = {}
        for each in level:
            for item in each.catalogue[:_WIDTH]:
                names, score = each.names | {item.name}, each.score + item.score
                if score > scores.get(names, -np.inf):
                    scores[names], found[names] = score, (*each.members, item)
        ranked = sorted(scores, key=lambda names: -scores[names])[:_WIDTH]
        return [_Set(found[names], scores[names], self.tried(found[names])) for names in ranked]

    def _free(self, levels: list[list[_Set]]) -> tuple[tuple[Tried, ...], Tried] | None:
        """A free form that the data ask for beside or in place of effects of the catalogue, and the effects it stands beside."""
        best, empty = levels[-1][0], levels[0][0]
        if best.free is not None and best.free.score >= _LEAST_FREE_SCORE and self._significant(best.free.score):
            found: tuple[_Set, Tried] | None = None
            for state in (level[0] for level in levels):
                form = state.free
                if form is None:
                    continue
                if found is None or self._adds(state, state.score + form.score - found[0].score - found[1].score, found[1]):
                    found = state, form
            assert found is not None
            return found[0].members, found[1]
        alone = empty.free
        margin = FREE_MARGIN if len(best.members) < 2 else 0.0
        if best.members and alone is not None and alone.score > max(best.score, self._score(best.members)) + margin:
            return (), alone
        return None

    def _score(self, members: tuple[Tried, ...]) -> float:
        """Of effects together, their periods at the top of the likelihood: the steps of the search cost a strong sine some."""
        columns = [column for member in members for column in self._columns(member.candidate)]
        with_them, without = (self.equations.log_likelihood(base)[:, 0].max() for base in ([*self._base, *columns], self._base))
        return float(with_them - without - sum(member.gain - member.score for member in members))

    def _adds(self, state: _Set, score: float, form: Tried) -> bool:
        """Whether the data ask for effects of the catalogue beside a free form: no form is exact, nor has it a constant, and so
        each effect has to add more than a second form of the same covariate, one of two covariates, or a constant, does."""
        if not self._significant(score):
            return False
        kin = self._kin(form)
        second = [
            item.score
            for item in self.tried((form,))
            if item.name == RangeOffset.tag() or item.candidate.form == SURFACE or (item.empirical and item.name in kin)
        ]
        return score > len(state.members) * max([0.0, *second])

    def _kin(self, form: Tried) -> set[str]:
        """Covariates that change as that of a free form does."""
        covariates = {name: values for name, values in self._residuals.covariates.items() if np.ptp(values) > 0}
        parts = form.name.split(" and ")
        alike = np.abs(np.corrcoef([*covariates.values(), *(covariates[part] for part in parts)])[:, -len(parts) :])
        return {name for name, row in zip(covariates, alike, strict=False) if row.max() > _KIN}

    def _chosen(self, among: _Set, item: Tried) -> Chosen:
        """An effect with those that would do as well in its place beside the others."""
        others = tuple(member for member in among.members if member is not item)
        beside = [each for each in self.tried(others) if not each.empirical and each.name not in {o.name for o in others}]
        mine = next(each for each in beside if each.name == item.name)
        alike = tuple(each.name for each in beside if each is not mine and each.score > mine.score - CLASS_MARGIN)
        return Chosen(item.candidate, alike, self.p_value(mine.score), mine.gain, mine.score, self.tried(others))

    def fit(self, candidates: list[Candidate], slopes: list[FloatArray | None] | None = None) -> Fit:
        """Pose (the columns of `Residuals.pose`) and some candidates, at their most likely covariance."""
        pose, turned = self._fixed.some(self._base), np.linalg.inv(self._turn)
        if not candidates:
            known = turned.T @ (self._pose_precision[:, None] * turned)
            found = fitted(self.model.fine, pose, self.value, known)
            return replace(found, coefficients=turned @ found.coefficients, covariance=turned @ found.covariance @ turned.T)
        matrix = self._matrix(candidates, slopes)
        columns = pose.beside(self.model.project(self._without_pose(matrix)))
        # the columns are fitted without what the pose explains of them, and the pose by orthonormal ones
        back = np.block(
            [[turned, -turned @ (self._pose.T @ matrix)], [np.zeros((matrix.shape[1], len(turned))), np.eye(matrix.shape[1])]]
        )
        widths = [candidate.columns.shape[1] + (slope is not None) for candidate, slope in _with_slopes(candidates, slopes)]
        typical = [precision_of(each, width) for each, width in zip(candidates, widths, strict=True)]
        precision = np.concatenate([self._pose_precision, *typical])
        found = fitted(self.model.fine, columns, self.value, back.T @ (precision[:, None] * back))
        return replace(found, coefficients=back @ found.coefficients, covariance=back @ found.covariance @ back.T)

    def reference_sigma(self, chosen: list[Chosen]) -> float:
        """Standard deviation of the reference's correlated error, in the observable's unit."""
        at = self.fit([item.candidate for item in chosen]).at
        return float(np.sqrt(at.ratio)) * self.model.typical_sigma

    def without(self, chosen: list[Chosen]) -> FloatArray:
        """(n,) residuals less pose and the chosen effects at their most likely values."""
        found = self._residuals
        candidates, fit = self.refined([item.candidate for item in chosen])
        value = found.value - found.pose @ fit.coefficients[: len(self._base)]
        for candidate, coefficients in zip(candidates, self.split(fit.coefficients, candidates), strict=True):
            value = value - candidate.columns @ coefficients[: candidate.columns.shape[1]]
        return np.asarray(value)

    def refined(self, candidates: list[Candidate], rounds: int = 4) -> tuple[list[Candidate], Fit]:
        """Candidates with their periods at the top of the likelihood (Gauss-Newton), and the fit of pose and all of them.

        Each sine has three columns in that fit: sine, cosine and the change by its frequency.
        """
        found = list(candidates)
        slopes: list[FloatArray | None] = [None] * len(found)
        if any(candidate.wave is not None for candidate in found):
            for number in range(rounds):
                fit = self.fit(found, slopes)
                start = len(self._base)
                for index, candidate in enumerate(found):
                    width = candidate.columns.shape[1] + (slopes[index] is not None)
                    values, start = fit.coefficients[start : start + width], start + width
                    if candidate.wave is None:
                        continue
                    if slopes[index] is not None and number:
                        reach = 0.3 / float(np.ptp(candidate.wave.x))
                        period = 1 / (1 / candidate.period + float(np.clip(values[2], -reach, reach)))
                        found[index] = moved_to(candidate, period)
                    slopes[index] = values[:2]
        return found, self.fit(found, slopes)

    def split(self, values: NDArray[Any], candidates: list[Candidate]) -> list[NDArray[Any]]:
        """The part of a fit's coefficients that belongs to each candidate after the pose, a sine's with that of its frequency."""
        widths = [candidate.columns.shape[1] + (candidate.wave is not None) for candidate in candidates]
        return np.split(values[len(self._base) :], np.cumsum(widths)[:-1]) if candidates else []

    def identifiability(self) -> tuple[list[str], FloatArray, FloatArray]:
        """Names of the families, cosines of their signatures after the pose fit, and the share that survives the pose fit."""
        row = next(row for row, at in enumerate(self.equations.at) if at is self.null)
        names, matrices = [], []
        rows, root = self.model.rows, self.model.root[:, None]
        for name, (plain, sines) in self._families().items():
            candidate = self._plain[plain[0]] if plain else self._sine(sines[len(sines) // 2])
            if not candidate.empirical:
                names.append(name)
                matrices.append(candidate.columns[rows, :1] * root)
        whole, left = np.concatenate(matrices, axis=1), self._without_pose(np.concatenate(matrices, axis=1))
        weight = self.equations.at[row].weight[:, None]
        grams = []
        for columns in (whole, left):
            projected = self.model.project(columns)
            between = projected.between[self.null.length]
            grams.append(projected.within.T @ projected.within + (between * weight).T @ between)
        count = len(self._base)
        matrix, pose = grams[1], self.equations.fixed[row][:count, :count]
        between, base = self.model.project(left), self._fixed
        cross = base.within[:, :count].T @ between.within
        cross += base.between[self.null.length][:, :count].T @ (weight * between.between[self.null.length])
        matrix = matrix - cross.T @ np.linalg.solve(pose, cross)
        size, full = np.sqrt(np.maximum(np.diag(matrix), 0)), np.sqrt(np.maximum(np.diag(grams[0]), 1e-300))
        scale = np.maximum(size, 1e-12 * full)
        return names, np.clip(matrix / np.outer(scale, scale), -1, 1), size / full


def _with_slopes(
    candidates: list[Candidate], slopes: list[FloatArray | None] | None
) -> Iterator[tuple[Candidate, FloatArray | None]]:
    return zip(candidates, slopes or [None] * len(candidates), strict=True)
