"""The search for noise parameters: which ones give simulated maps whose statistics are those of the measured maps.

The cost of parameters theta (their logarithms x) is the squared Mahalanobis distance of the statistics s (`signature`),

    J(x) = (s_obs - m(x))^T S^-1 (s_obs - m(x)),

m the statistics' mean over simulations and S their covariance for so many epochs as were measured: indirect inference
(Gourieroux, Monfort and Renault 1993), or a synthetic likelihood (Wood 2010). m is a quadratic polynomial fitted to simulations
around the minimum, which rounds of simulations approach: the first over all bounds (Sobol points), each further one drawn
around the last minimum with twice its covariance. J is minimised by SciPy's trust region (Branch, Coleman and Li 1999). A
polynomial over all bounds can lead to where a parameter is too small to matter, and no way back shows there: a minimum that the
misfit rejects is sought a second time from more points, and the better of the two is kept.

Intervals. Every simulation of the last round is estimated like the measurement, by a surface that was fitted without it (five
folds); what comes out minus what went in is the distribution of the estimate's error, bias included: a parametric bootstrap. To
it is added, in quadrature, by how much the fast simulation in windows differs from the whole one (`MODEL_SIGMA`).

Where it fails: a parameter to which no statistic responds keeps the interval of its bounds; noise of another kind than the
model's shows in `misfit_p`, the share of simulated sets that fit their own surface worse than the measurement does.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, stats

from pipeline.calibration.parameters import Parameters
from pipeline.report.progress import Progress
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

MODEL_SIGMA = 0.003
"""Standard deviation of the logarithm of a length that the simulation in windows gives against the whole simulation."""
_FOLDS = 5
_APPROACHES = 3
_MORE_ROUNDS = 2
_REJECTED = 0.01
_DENSITIES = (1, 4)
"""A minimum of misfit_p below `_REJECTED` is sought a second time, from four times as many points over all bounds."""
_WIDEN = 2.0
_LEAST_SPREAD = 0.03
_SHRINK, _SHRINK_LIMITS = 0.5, (0.05, 0.9)
"""Share of the diagonal in the covariance of the statistics, times their number over the degrees of freedom: few simulations know
their variances, but not which combinations of them hardly vary."""
_LEAST_SETS = 30
"""In a round of the approach."""
OBSERVATION_S = 0.3
"""What the plan of the progress takes for one simulated observation; a map is the difference of two."""

Simulate = Callable[[FloatArray, int, KeyedRandom], FloatArray]
"""Statistics (m,) of one set of epochs simulated with k parameter values."""


@dataclass(frozen=True)
class Simulations:
    """Simulations: x (n, k) logarithms of the parameters, s (n, m) statistics."""

    x: FloatArray
    s: FloatArray

    def with_more(self, other: Simulations) -> Simulations:
        return Simulations(np.concatenate([self.x, other.x]), np.concatenate([self.s, other.s]))

    def at(self, rows: NDArray[Any]) -> Simulations:
        return Simulations(self.x[rows], self.s[rows])


@dataclass(frozen=True)
class Surface:
    """The mean of the statistics as a quadratic polynomial of z = (x - centre) / scale, and their scatter about it.

    coefficients: (terms, m); covariance: (m, m) of one simulated set; whitening: L^-1 with L L^T = covariance.
    """

    centre: FloatArray
    scale: FloatArray
    coefficients: FloatArray
    covariance: FloatArray
    whitening: FloatArray

    @classmethod
    def fit(cls, sample: Simulations) -> Surface:
        """Least squares over a sample."""
        centre, scale = np.mean(sample.x, axis=0), np.maximum(np.std(sample.x, axis=0), 1e-6)
        design = _design((sample.x - centre) / scale)
        coefficients = np.asarray(np.linalg.lstsq(design, sample.s, rcond=None)[0], dtype=np.float64)
        left = sample.s - design @ coefficients
        freedom = max(len(left) - design.shape[1], 1)
        covariance = left.T @ left / freedom
        share = float(np.clip(_SHRINK * len(covariance) / freedom, *_SHRINK_LIMITS))
        covariance = (1 - share) * covariance + np.diag(share * np.diag(covariance) + MODEL_SIGMA**2)
        factor = np.linalg.cholesky(covariance)
        return cls(centre, scale, coefficients, covariance, linalg.solve_triangular(factor, np.eye(len(factor)), lower=True))

    def mean(self, x: FloatArray) -> FloatArray:
        """(m,) statistics to be expected of (k,) logarithms."""
        return _design(((x - self.centre) / self.scale)[None])[0] @ self.coefficients

    def misfit(self, x: FloatArray, observed: FloatArray) -> FloatArray:
        """(m,) whitened differences, whose squares add up to the cost."""
        return self.whitening @ (observed - self.mean(x))

    def jacobian(self, x: FloatArray) -> FloatArray:
        """(m, k) of the whitened differences."""
        return -self.whitening @ (_gradient((x - self.centre) / self.scale) @ self.coefficients).T / self.scale

    def minimum(self, observed: FloatArray, start: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        """(k,) logarithms of least cost within bounds."""
        found = optimize.least_squares(
            lambda x: self.misfit(x, observed), np.clip(start, low + 1e-9, high - 1e-9), lambda x: self.jacobian(x), (low, high)
        )
        return found.x

    def spread(self, x: FloatArray) -> FloatArray:
        """(k, k) covariance of the minimum, to first order."""
        jacobian = self.jacobian(x)
        return np.asarray(np.linalg.pinv(jacobian.T @ jacobian + 1e-6 * np.eye(len(x))), dtype=np.float64)


@dataclass(frozen=True)
class Found:
    """What a search found. All logarithms.

    x: (k,) the estimate, bias removed; low, high: (k,) of its interval; errors: (n, k) of the estimates of simulated sets;
    correlation: (k, k) of these; surface: of the last round; cost: J at the minimum; misfit_p: see the module; misfit: (m,)
    measured minus expected statistics in standard deviations; history: maps simulated and minimum, after each round;
    settled: whether the minimum lies among the simulations of the last round.
    """

    x: FloatArray
    low: FloatArray
    high: FloatArray
    errors: FloatArray
    surface: Surface
    cost: float
    misfit_p: float
    misfit: FloatArray
    history: tuple[tuple[int, FloatArray], ...]
    maps: int
    settled: bool

    @property
    def correlation(self) -> FloatArray:
        """(k, k) of the errors of the estimate."""
        return np.atleast_2d(np.corrcoef(self.errors.T))


class NoiseSearch:
    """One search. simulate: see Simulate; epochs: of the measurement; random: keys the simulations by their number.

    approached: (m,) statistics of every simulation in its order, with the number of maps simulated up to it.
    """

    def __init__(self, simulate: Simulate, parameters: Parameters, epochs: int, random: KeyedRandom, progress: Progress) -> None:
        self.simulate, self.epochs, self.random, self.progress = simulate, epochs, random, progress
        self.parameters = parameters
        self.low, self.high = np.log(parameters.low), np.log(parameters.high)
        self.simulated = self.maps = 0
        self.approached: list[tuple[int, FloatArray]] = []
        count = len(parameters.names)
        self.terms = 1 + count + count * (count + 1) // 2

    def run(self, observed: FloatArray, simulations: int, confidence: float) -> Found:
        """Approach the minimum and measure how well it is known. observed: (m,) statistics of the measurement."""
        found = self._run_once(observed, simulations, confidence, _DENSITIES[0])
        for density in _DENSITIES[1:]:
            if found.misfit_p >= _REJECTED:
                break
            again = self._run_once(observed, simulations, confidence, density)
            better = min(found, again, key=lambda each: (-each.misfit_p, each.cost))
            found = replace(better, history=(*found.history, *again.history), maps=self.maps)
        return found

    def _run_once(self, observed: FloatArray, simulations: int, confidence: float, density: int) -> Found:
        last = OBSERVATION_S * (self.epochs + 1) * simulations
        self.progress.plan({f"round {number}": 2 * OBSERVATION_S * self._round_size for number in range(2, _APPROACHES + 1)})
        self.progress.plan({"round 1": 2 * OBSERVATION_S * self._first_size(density), "last round": last})
        x, spread, history = self._approach(observed, density)
        for attempt in range(1 + _MORE_ROUNDS):
            stage = f"last round{' again' * attempt}"
            self.progress.plan({stage: last})
            with self.progress.stage(stage):
                sample = self._sample(self._around(x, spread, simulations), self.epochs)
            surface = Surface.fit(sample)
            minimum = surface.minimum(observed, _nearest(surface, sample, observed), self.low, self.high)
            history.append((self.maps, minimum))
            inside = bool(np.abs((minimum - sample.x.mean(axis=0)) / sample.x.std(axis=0)).max() < _WIDEN)
            x, spread = minimum, surface.spread(minimum)
            if inside:
                break
        return self._judged(observed, sample, surface, minimum, confidence, tuple(history), inside)

    @property
    def _round_size(self) -> int:
        """Simulated sets of a round of the approach."""
        return max(3 * self.terms, _LEAST_SETS)

    def _first_size(self, density: int) -> int:
        """Simulated sets of the first round, Sobol points over all bounds: a power of 2."""
        return int(2 ** np.ceil(np.log2(density * self._round_size)))

    def _approach(self, observed: FloatArray, density: int) -> tuple[FloatArray, FloatArray, list[tuple[int, FloatArray]]]:
        """Rounds with one later epoch, which is enough for the mean of the statistics; density: of the first round's points."""
        size = self._round_size
        generator = np.random.default_rng(self.random.child("sobol").key)
        sobol = stats.qmc.Sobol(len(self.low), rng=generator).random(self._first_size(density))
        sample = Simulations(np.empty((0, len(self.low))), np.empty((0, len(observed))))
        points, history = self.low + sobol * (self.high - self.low), []
        for number in range(_APPROACHES):
            with self.progress.stage(f"round {number + 1}"):
                sample = sample.with_more(self._sample(points, 1))
            near = sample.at(np.argsort(_distance(sample.s, observed))[:size])
            surface = Surface.fit(near)
            x = surface.minimum(observed, near.x[0], self.low, self.high)
            x = np.clip(x, near.x.min(axis=0), near.x.max(axis=0))  # a polynomial holds where it was fitted
            history.append((self.maps, x))
            spread = surface.spread(x)
            if number < _APPROACHES - 1:
                spread = spread + np.diag(near.x[: self.terms].var(axis=0)) / 4
                points = self._around(x, spread, size)
        return x, spread, history

    def _around(self, x: FloatArray, spread: FloatArray, count: int) -> FloatArray:
        """(count, k) points drawn around x with twice the standard deviations, within the bounds."""
        widest = (self.high - self.low) / 4
        sigma = np.sqrt(np.diag(spread))
        limited = np.clip(_WIDEN * sigma, _LEAST_SPREAD, widest) / np.maximum(sigma, 1e-12)
        covariance = spread * np.outer(limited, limited)
        draws = self.random.child("points", self.simulated).generator()
        normal = draws.multivariate_normal(np.zeros(len(x)), covariance, count, check_valid="ignore")
        mirrored = x + normal
        mirrored = np.where(mirrored < self.low, 2 * self.low - mirrored, mirrored)
        mirrored = np.where(mirrored > self.high, 2 * self.high - mirrored, mirrored)
        return np.clip(mirrored, self.low, self.high)

    def _sample(self, points: FloatArray, epochs: int) -> Simulations:
        """Simulate; points at which the pipeline gives up, as noise leaves nothing to register, drop out."""
        used, found = [], []
        for number, x in enumerate(points):
            with suppress(InputError):
                found.append(self.simulate(self.parameters.values(x), epochs, self.random.child("set", self.simulated)))
                used.append(x)
                self.approached.append((self.maps + epochs, found[-1]))
            self.simulated += 1
            self.maps += epochs
            self.progress.advance((number + 1) / len(points))
        if len(found) < len(points) / 2:
            raise InputError("most simulations fail", where="calibration", remedy="simulate the site once to see why")
        return Simulations(np.array(used), np.array(found))

    def _judged(
        self,
        observed: FloatArray,
        sample: Simulations,
        surface: Surface,
        minimum: FloatArray,
        confidence: float,
        history: tuple[tuple[int, FloatArray], ...],
        settled: bool,
    ) -> Found:
        """The estimate with its interval from the errors of simulated sets, and how well the model fits at all."""
        errors, costs = np.empty_like(sample.x), np.empty(len(sample.x))
        fold = np.arange(len(sample.x)) % _FOLDS
        for number in range(_FOLDS):
            kept = sample.at(fold != number)
            without = Surface.fit(kept)
            for row in np.flatnonzero(fold == number):
                own = without.minimum(sample.s[row], _nearest(without, kept, sample.s[row]), self.low, self.high)
                errors[row] = own - sample.x[row]
                costs[row] = np.sum(without.misfit(own, sample.s[row]) ** 2)
        misfit = surface.misfit(minimum, observed)
        cost = float(np.sum(misfit**2))
        bias, sigma = errors.mean(axis=0), np.hypot(errors.std(axis=0, ddof=1), MODEL_SIGMA)
        half = stats.t.ppf((1 + confidence) / 2, len(errors) - 1) * sigma * np.sqrt(1 + 1 / len(errors))
        x = np.clip(minimum - bias, self.low, self.high)
        scaled = (observed - surface.mean(minimum)) / np.sqrt(np.diag(surface.covariance))
        low, high = np.clip(x - half, self.low, self.high), np.clip(x + half, self.low, self.high)
        return Found(x, low, high, errors, surface, cost, float(np.mean(costs >= cost)), scaled, history, self.maps, settled)


def fresh_cost(search: NoiseSearch, surface: Surface, observed: FloatArray, x: FloatArray, sets: int = 4) -> float:
    """The cost of parameters by sets simulated anew: of their mean, less what the sets' own scatter adds."""
    source = replace(search.random, path=(*search.random.path, "fresh"))
    values = search.parameters.values(x)
    drawn = np.array([search.simulate(values, search.epochs, source.child(number)) for number in range(sets)])
    left = surface.whitening @ (observed - drawn.mean(axis=0))
    return float(np.sum(left**2) / (1 + 1 / sets))


def _distance(s: FloatArray, observed: FloatArray) -> FloatArray:
    """(n,) of simulated statistics to the observed ones, in units of the logarithms' own size: before any scatter is known."""
    return np.sqrt(np.mean((s - observed) ** 2, axis=1))


def _nearest(surface: Surface, sample: Simulations, observed: FloatArray) -> FloatArray:
    """The parameters of the simulation whose statistics are nearest."""
    return sample.x[np.argmin(np.sum((surface.whitening @ (sample.s - observed).T) ** 2, axis=0))]


def _design(z: FloatArray) -> FloatArray:
    """(n, terms) 1, z_i, z_i z_j."""
    i, j = np.triu_indices(z.shape[1])
    return np.concatenate([np.ones((len(z), 1)), z, z[:, i] * z[:, j]], axis=1)


def _gradient(z: FloatArray) -> FloatArray:
    """(k, terms) derivatives of one row of `_design`."""
    k = len(z)
    i, j = np.triu_indices(k)
    unit = np.eye(k)
    return np.concatenate([np.zeros((k, 1)), unit, unit[:, i] * z[j] + unit[:, j] * z[i]], axis=1)
