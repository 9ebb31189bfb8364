"""Which effects explain the spread: the Gaussian likelihood of deviations within cells, sigma_i^2 = model + theta f_k(i)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.change.robust import nmad
from pipeline.gap.decisions import decided
from pipeline.gap.residuals.residuals import BoolArray, Geometry, Residuals
from pipeline.gap.residuals.wall_blocks import WallCells, wall_block_numbers
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn

DRAWS = 1999
_LEAST_LEFT = 0.3
"""Share of a point's variance that its cell's plane must leave."""
_LEAST_OWN, _SHARE_DRAWS = 0.02, 10
"""Share of a point's variance that counts as its own where a model says there is none; draws of noise that neighbours share."""
_BINS = 8
_CUT = 12.0
"""Sigmas at which a far residual is cut off."""
_HIGHEST = 0.999
"""Quantile of a form of the variance beyond which it is held."""
_ROUNDS = 25


@dataclass(frozen=True)
class SpreadCandidate:
    """variance: (n, k) forms that are scaled by theta (k,); parameters: their square roots times `scale`, by name; cost: free
    parameters; fixed: values that tell variants apart."""

    name: str
    variance: FloatArray
    scale: tuple[float, ...]
    names: tuple[str, ...]
    cost: float = 1.0
    fixed: Mapping[str, float] = field(default_factory=dict)

    def parameters(self, theta: FloatArray) -> dict[str, float]:
        """The effect's values."""
        return dict(zip(self.names, map(float, np.sqrt(theta) * np.array(self.scale)), strict=True)) | dict(self.fixed)

    def errors(self, theta: FloatArray, error: FloatArray) -> dict[str, float]:
        """Their standard deviations, from those of theta; of one that is 0, what it may be."""
        root = np.sqrt(theta)
        std = np.where(theta > error, error / np.maximum(2 * root, 1e-300), np.sqrt(error))
        return dict(zip(self.names, map(float, std * np.array(self.scale)), strict=True))


@dataclass(frozen=True)
class SpreadFound:
    """An effect on the spread.

    effect: the catalogue's that comes nearest, which carries an empirical one; std: of the parameters by the curvature of the
    likelihood; variance: (n,) that it adds.
    """

    name: str
    effect: str
    alike: tuple[str, ...]
    p_value: float
    gain: float
    parameters: dict[str, float]
    std: dict[str, float]
    empirical: bool
    variance: FloatArray

    def everywhere(self, count: int) -> SpreadFound:
        """The same of `count` points: what is no function of the place adds alike to all."""
        return replace(self, variance=np.full(count, float(self.variance.mean())))


@dataclass(frozen=True)
class SpreadTried:
    """What one form of the spread gains in log-likelihood over the model; score: less what it costs; empirical: of no effect."""

    name: str
    gain: float
    score: float
    empirical: bool = False


def standardised(residuals: Residuals, cells: WallCells, value: FloatArray) -> FloatArray:
    """(n,) deviations from the cells' planes over the predicted spread, of unit variance if the model is right; NaN outside.

    A plane in each cell takes away what the reference's error, correlated over metres, does within it.
    """
    inside = cells.cell >= 0
    cell = cells.cell[inside]
    offset = (residuals.wall_xy[inside] - cells.centre[cell]) / cells.side_m
    weight = 1 / residuals.sigma[inside]
    basis = np.stack([np.ones(len(cell)), offset[:, 0], offset[:, 1]], axis=1) * weight[:, None]
    y = value[inside] * weight

    def total(column: FloatArray) -> FloatArray:
        return np.bincount(cell, column, len(cells)).astype(np.float64)

    matrix = np.stack([np.stack([total(basis[:, i] * basis[:, j]) for j in range(3)], axis=-1) for i in range(3)], axis=-2)
    right = np.stack([total(basis[:, i] * y) for i in range(3)], axis=-1)
    inverse = np.linalg.pinv(matrix, rcond=1e-8, hermitian=True)
    fitted = np.einsum("ni,nij,nj->n", basis, inverse[cell], right[cell])
    left = 1 - np.einsum("ni,nij,nj->n", basis, inverse[cell], basis)
    z = np.full(len(residuals), np.nan)
    z[inside] = np.where(left > _LEAST_LEFT, (y - fitted) / np.sqrt(np.maximum(left, _LEAST_LEFT)), np.nan)
    return z


def spread_candidates(residuals: Residuals) -> list[SpreadCandidate]:
    """The catalogue's forms of the variance of single points, by what is recorded; without noise that neighbours share."""
    found = []
    for effect in residuals.candidates:
        if effect.shows_in == ShowsIn.SPREAD and not effect.shared and effect.known(residuals.geometry):
            key, tried = effect.trials or ("", ())
            found += [_candidate(effect, residuals.geometry, {key: value}) for value in tried] or [
                _candidate(effect, residuals.geometry, {})
            ]
    return found


def _candidate(effect: type[Effect], geometry: Geometry, fixed: dict[str, float]) -> SpreadCandidate:
    """Of the effect at its typical sizes, one column for each of them; a few extreme points must not carry a form alone."""
    sizes = effect.typical_sizes()
    columns = np.stack([effect(**fixed, **{key: size}).variance(geometry) for key, size in sizes.items()], axis=1)
    columns = np.minimum(columns, np.quantile(columns, _HIGHEST, axis=0))
    cost = len(sizes) + decided().spread.cost_of_a_trial * len(fixed)
    return SpreadCandidate(effect.tag(), columns, tuple(sizes.values()), tuple(sizes), cost, fixed)


def find_spread(
    residuals: Residuals, cells: WallCells, value: FloatArray, random: KeyedRandom, left_out: frozenset[str] = frozenset()
) -> tuple[list[SpreadFound], list[SpreadTried], str]:
    """The effects that the spread asks for, at most two, all that were tried, best first, and words for a spread of no effect.

    value: (n,) residuals without the mean effects found; left_out: effects that are no candidates.
    """
    candidates = [each for each in spread_candidates(residuals) if each.name not in left_out]
    if not candidates:
        return [], [], ""
    weighed, predicted = residuals, residuals.sigma**2 * _expected_square(residuals, cells, random)
    for again in (True, False):
        # noisy points move a cell's plane, and with that what its quiet points show, unless they have the weight they deserve
        z = standardised(weighed, cells, value)
        kept = np.isfinite(z) & (np.abs(z) < decided().spread.clip * max(1.0, nmad(z, 0.0)))
        squared = (z * weighed.sigma)[kept] ** 2 / predicted[kept]
        forms = [candidate.variance[kept] / predicted[kept, None] for candidate in candidates]
        singles = [_Joint.fitted(squared, forms, [number], candidates) for number in range(len(forms))]
        best = max(singles, key=lambda fit: fit.score)
        if again:
            added = candidates[best.members[0]].variance @ best.theta[0]
            weighed = replace(residuals, sigma=np.sqrt(residuals.sigma**2 + added))
    excess = float(np.mean(best.added(forms)))
    block = wall_block_numbers(residuals.wall_xy[kept], cells.side_m)
    p_value = null_p_value(squared, [form.sum(axis=1) for form in forms], block, random)
    tried = [SpreadTried(c.name, fit.gain, fit.score) for c, fit in zip(candidates, singles, strict=True)]
    tried = sorted(_best_variants(tried), key=lambda item: -item.score)
    by = decided().spread
    if best.gain < by.least_gain or p_value > by.significance or excess < by.least_excess:
        return [], tried, ""
    # of disparities `stereo_noise` looks at neighbours, which noise on nodes moves alike too
    between = _between_neighbours(residuals, value, kept, best.added(forms)) if residuals.sensor == "tls" else 1.0
    if between < by.least_between:
        return [], tried, _shared_by_neighbours(excess, between, residuals.sigma)
    pairs = [
        _Joint.fitted(squared, forms, [first, second], candidates)
        for first, second in combinations(range(len(forms)), 2)
        if candidates[first].name != candidates[second].name
    ]
    pair = max(pairs, key=lambda fit: fit.score, default=best)
    free_name, free_score, free = _free_form(squared, {name: v[kept] for name, v in residuals.covariates.items()})
    # where one effect leaves something over, a second of the catalogue comes before a form of no effect
    ahead = max(by.free_margin, by.class_share * best.gain)
    needed = by.second_gain if free_score > best.score + ahead else by.least_gain
    agreed = pair.score > best.score + needed and _blocks_agree(squared, best.added(forms), pair.added(forms), block)
    chosen = pair if agreed and all(float(theta.max()) > 0 for theta in pair.theta) else best
    more = free_score > chosen.score + ahead and _blocks_prefer(squared, chosen.added(forms), free, block)
    empirical = more and free_score > chosen.score + by.free_share * chosen.gain
    words = f"the spread varies along {free_name} beyond that: no effect of the catalogue explains that part" if more else ""
    if empirical:
        chosen, words = best, ""
    tried = sorted([*tried, SpreadTried(free_name, free_score + _BINS, free_score, True)], key=lambda item: -item.score)
    margin = max(by.class_margin, by.class_share * chosen.gain)
    found = []
    for place, number in enumerate(chosen.members):
        candidate, theta = candidates[number], chosen.theta[place]
        others = [fit for fit in (singles if len(chosen.members) == 1 else pairs) if _differ_by(fit, chosen, number)]
        near = {candidates[n].name for fit in others if fit.score > chosen.score - margin for n in fit.members}
        alike = near - {candidates[each].name for each in chosen.members}
        parameters = candidate.parameters(theta)
        std = candidate.errors(theta, chosen.error[place])
        gain = chosen.gain - max(
            (fit.gain for fit in singles if fit.members != (number,) and fit.members[0] in chosen.members), default=0.0
        )
        name = f"spread by {free_name}" if empirical else candidate.name
        found.append(
            SpreadFound(
                name,
                candidate.name,
                tuple(sorted(alike)),
                p_value,
                gain,
                parameters,
                std,
                empirical,
                candidate.variance @ theta,
            )
        )
    return found, tried, words


def _shared_by_neighbours(excess: float, between: float, sigma: FloatArray) -> str:
    """Words for a spread that neighbours share, which is no noise. excess: added variance over the predicted one."""
    times, more = float(np.sqrt(1 + excess)), 1e3 * float(np.median(sigma)) * float(np.sqrt(excess))
    shared = 100 * min(max(1 - between, 0.0), 1.0)
    return (
        f"the residuals spread {times:.2g} times what the model predicts ({more:.2g} mm more), and neighbours share {shared:.0f} "
        "% of that: an error of the reference, a change of the scene or wrong coordinates, not noise of the sensor"
    )


def _between_neighbours(residuals: Residuals, value: FloatArray, kept: BoolArray, added: FloatArray) -> float:
    """Share of an added variance, of the points `kept` and over the predicted one, that differences of neighbours show."""
    part = residuals.part(kept)
    value, predicted = value[kept], part.sigma**2
    other = cKDTree(part.wall_xy).query(part.wall_xy, k=2)[1][:, 1]
    variance = predicted + predicted[other] - 2 * part.reference_covariance_with(other)
    more = (added * predicted + (added * predicted)[other]) / variance
    weight = more / (1 + more) ** 2
    return float(np.sum(weight * ((value - value[other]) ** 2 / variance - 1)) / np.sum(weight * more))


@dataclass(frozen=True)
class TimesPredicted:
    """How many of the predicted standard deviations residuals really spread within cells. below: whether blocks all over the wall
    agree that it is less."""

    value: float
    below: bool

    @classmethod
    def of(cls, residuals: Residuals, cells: WallCells, value: FloatArray, random: KeyedRandom) -> TimesPredicted:
        """Of residuals (n,) without the effects on the mean; a few that are far off do not make it more."""
        z = standardised(residuals, cells, value)
        kept = np.isfinite(z)
        squared = np.minimum(z[kept] ** 2, _CUT**2) / _expected_square(residuals, cells, random)
        means = np.bincount(
            np.unique(wall_block_numbers(residuals.wall_xy[kept], cells.side_m), return_inverse=True)[1], squared - 1
        )
        below = float(means.sum()) < -decided().spread.block_sigmas * float(np.linalg.norm(means))
        return cls(float(np.sqrt(squared.mean())), below)

    @property
    def share(self) -> float:
        """The same where it is clearly less than 1, else 1: no effect takes noise away, the model's own is too large."""
        return self.value if self.below and self.value < decided().spread.too_noisy else 1.0


def _expected_square(residuals: Residuals, cells: WallCells, random: KeyedRandom) -> float:
    """Mean square of standardised deviations from cells where the model is right: of noise that neighbours share, planes take
    away more than of white noise, by draws of it."""
    field = residuals.correlated_noise.node_field(len(residuals))
    if not field.weights.shape[1]:
        return 1.0
    own = np.sqrt(np.maximum(residuals.sigma**2 - field.variance, _LEAST_OWN * residuals.sigma**2))
    root, draws = np.linalg.cholesky(field.covariance), random.child("share").generator()
    squares = []
    for _ in range(_SHARE_DRAWS):
        shared = field.weights @ (root @ draws.standard_normal(len(root)))
        squares.append(np.nanmean(standardised(residuals, cells, shared + own * draws.standard_normal(len(own))) ** 2))
    return float(np.mean(squares))


def _best_variants(tried: list[SpreadTried]) -> list[SpreadTried]:
    """One of each name: of an effect with variants the one that scores most."""
    best: dict[str, SpreadTried] = {}
    for item in tried:
        if item.name not in best or item.score > best[item.name].score:
            best[item.name] = item
    return list(best.values())


@dataclass(frozen=True)
class _Joint:
    """Some candidates fitted together. theta, error: of each; gain in log-likelihood over the model; score: less cost."""

    members: tuple[int, ...]
    theta: tuple[FloatArray, ...]
    error: tuple[FloatArray, ...]
    gain: float
    score: float

    @classmethod
    def fitted(
        cls, squared: FloatArray, forms: list[FloatArray], members: list[int], candidates: list[SpreadCandidate]
    ) -> _Joint:
        """By Fisher scoring on 1 + sum theta f, theta at least 0."""
        columns = np.concatenate([forms[number] for number in members], axis=1)
        scale = 1 / np.maximum(columns.mean(axis=0), 1e-300)
        columns = columns * scale
        theta = np.full(len(scale), max(float(np.mean(squared)) - 1, 1e-3) / len(scale))
        information = np.eye(len(scale))
        for _ in range(_ROUNDS):
            total = 1 + columns @ theta
            slope = 0.5 * columns.T @ ((squared - total) / total**2)
            information = 0.5 * (columns / total[:, None] ** 2).T @ columns
            free = (theta > 0) | (slope > 0)
            step = np.zeros(len(theta))
            step[free] = np.linalg.lstsq(information[np.ix_(free, free)], slope[free], rcond=1e-10)[0]
            theta = np.maximum(theta + step, 0.0)
        gain = _gain(squared, columns @ theta)
        error = np.sqrt(np.maximum(np.diag(np.linalg.pinv(information, hermitian=True)), 0.0))
        ends = np.cumsum([forms[number].shape[1] for number in members])[:-1]
        score = gain - sum(candidates[number].cost for number in members)
        return cls(tuple(members), tuple(np.split(theta * scale, ends)), tuple(np.split(error * scale, ends)), gain, score)

    def added(self, forms: list[FloatArray]) -> FloatArray:
        """(n,) variance that it adds, over the predicted one."""
        return np.asarray(sum(forms[number] @ theta for theta, number in zip(self.theta, self.members, strict=True)))


def _differ_by(fit: _Joint, chosen: _Joint, number: int) -> bool:
    """Whether a fit has another form in place of one of the chosen."""
    return number not in fit.members and set(chosen.members) - {number} <= set(fit.members)


def _blocks_agree(squared: FloatArray, first: FloatArray, second: FloatArray, block: NDArray[np.int64]) -> bool:
    """Whether the gain of one variance over another is common to the blocks and not due to a few."""
    gain, sigmas = _gain_over(squared, first, second, block)
    return gain > 0 and sigmas > decided().spread.block_sigmas


def _blocks_prefer(squared: FloatArray, first: FloatArray, free: FloatArray, block: NDArray[np.int64]) -> bool:
    """The same of a free form, which only has to say that the named one does not fit."""
    gain, sigmas = _gain_over(squared, first, free, block)
    return gain > decided().spread.free_gain and sigmas > decided().spread.free_block_sigmas


def _gain_over(squared: FloatArray, first: FloatArray, second: FloatArray, block: NDArray[np.int64]) -> tuple[float, float]:
    """Gain in log-likelihood of one variance over another, and how many times it is that of blocks with signs drawn at random."""
    terms = 0.5 * (squared * (second - first) / ((1 + first) * (1 + second)) + np.log1p(first) - np.log1p(second))
    sums = np.bincount(np.unique(block, return_inverse=True)[1], terms)
    return float(sums.sum()), float(sums.sum() / max(float(np.linalg.norm(sums)), 1e-300))


def _gain(squared: FloatArray, added: FloatArray) -> float:
    return float(0.5 * np.sum(squared * added / (1 + added) - np.log1p(added)))


def null_p_value(squared: FloatArray, forms: list[FloatArray], block: NDArray[np.int64], random: KeyedRandom) -> float:
    """Of the largest standardised score over the forms, by signs drawn block by block: (1 + b) / (1 + N)."""
    _, number = np.unique(block, return_inverse=True)
    scores = np.stack([np.bincount(number, (squared - 1) * form) for form in forms])
    size = np.sqrt(np.sum(scores**2, axis=1))
    signs = random.child("spread").generator().choice([-1.0, 1.0], size=(scores.shape[1], DRAWS))
    largest = np.max(scores @ signs / size[:, None], axis=0)
    return float((1 + np.sum(largest >= np.max(scores.sum(axis=1) / size))) / (1 + DRAWS))


@dataclass(frozen=True)
class Tails:
    """Residuals farther out than normal noise of the predicted spread leaves them.

    share: of all residuals, beyond `beyond` predicted sigmas; sigma: to how many predicted ones they raise the standard
    deviation; gain: in log-likelihood, of that share being distributed so widely; even: whether they lie all over the wall, as an
    instrument's own do, and not in parts of it, as at edges, in plants or where something moved.
    """

    share: float
    beyond: float
    sigma: float
    gain: float
    even: bool

    @property
    def words(self) -> str:
        """As the report notes it."""
        where = "all over the wall" if self.even else "in parts of the wall, as edges, plants and what moved leave them"
        return f"{100 * self.share:.2g} % of the points lie beyond {self.beyond:g} predicted sigmas, {where}"


def find_tails(z: FloatArray, block: NDArray[np.int64]) -> Tails | None:
    """What lies farther out than it should, None where that is no more than normal noise and small faults of a reference leave.

    z: (n,) residuals over the spread that all effects together predict; of normal ones 6e-5 lie beyond 4.
    """
    by = decided().spread
    far = np.abs(z) > by.far
    share = float(far.mean())
    if share < by.most_far:
        return None
    square = np.minimum(z**2, _CUT**2)
    wide = max(float(square[far].mean()), 1.0)
    mixed = np.log(1 - share + share / np.sqrt(wide) * np.exp(0.5 * square * (1 - 1 / wide)))
    sigma = float(np.sqrt(max(float(square.mean()) - 1, 0.0)))
    return Tails(share, by.far, sigma, float(mixed.sum()), _unevenness(far, block) < by.most_uneven)


def _unevenness(far: BoolArray, block: NDArray[np.int64]) -> float:
    """How much the share of far points differs between blocks beyond chance: its standard deviation over its mean."""
    _, number = np.unique(block, return_inverse=True)
    expected = np.bincount(number) * far.mean()
    beyond_chance = np.sum((np.bincount(number, far) - expected) ** 2 - expected * (1 - far.mean()))
    return float(np.sqrt(max(float(beyond_chance), 0.0) / np.sum(expected**2)))


def _free_form(squared: FloatArray, covariates: Mapping[str, FloatArray]) -> tuple[str, float, FloatArray]:
    """The covariate along which a variance free in each of some bins explains most, its score, and what it adds (n,)."""
    best: tuple[str, float, FloatArray] = ("", -np.inf, np.zeros(len(squared)))
    for name, values in covariates.items():
        if name in ("edge_step", "line"):
            continue
        edges = np.quantile(values, np.linspace(0, 1, _BINS + 1)[1:-1])
        group = np.searchsorted(edges, values)
        count = np.maximum(np.bincount(group, minlength=_BINS), 1)
        variance = np.maximum(np.bincount(group, squared, _BINS) / count, 1e-9)
        score = float(0.5 * np.sum(count * (variance - 1 - np.log(variance)))) - _BINS
        if score > best[1]:
            best = name, score, (variance - 1)[group]
    return best
