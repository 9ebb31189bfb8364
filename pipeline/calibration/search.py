"""Search for the noise parameters whose simulated maps have the same summary statistics as the measured maps.

The cost of parameters theta (their logarithms x) is the squared Mahalanobis distance of the statistics s
    (`summary_statistics`),

    J(x) = (s_obs - m(x))^T S^-1 (s_obs - m(x)),

with the mean m and the covariance S of the statistics over simulations of as many epochs as were measured. This is indirect
inference (Gourieroux, Monfort and Renault 1993), or a synthetic likelihood (Wood 2010).

m is a response surface: a quadratic polynomial fitted to simulations near the minimum. Rounds of simulations approach the
    minimum. The first covers all bounds (Sobol points); each later one draws around the last minimum with twice its
    standard deviations. J is minimised by SciPy's trust region method (Branch, Coleman and Li 1999). A polynomial over all
    bounds may lead to where a parameter is too small to matter, and the way out is then invisible. A minimum with a
    significant misfit is therefore searched for a second time, from more points, and the better of the two is kept.

Intervals come from a parametric bootstrap. Every simulation of the last round is estimated like the measurement, by a surface
fitted without it (five folds). Estimate minus true value is the distribution of the estimate's error, bias included. The
difference between the fast simulation in windows and the whole one (`MODEL_SIGMA`) is added in quadrature.

Limits: a parameter to which no statistic responds gets an interval as wide as its bounds. Noise of another kind than the
    model's shows as a small `misfit_p`, the share of simulated sets that fit worse than the measurement does.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, stats

from pipeline.calibration.parameters import NoiseParameters
from pipeline.report.progress import Progress
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

MODEL_SIGMA = 0.003
"""Standard deviation of the logarithmic ratio between lengths from the simulation in windows and from the whole simulation."""
_FOLDS = 5
"""Folds of the cross-validation that gives the errors of the estimate."""
_APPROACHES = 3
"""Rounds that approach the minimum, before the last round."""
_MORE_ROUNDS = 2
"""Largest number of repetitions of the last round, while the minimum lies outside its simulations."""
_REJECTED = 0.01
"""Significance level of the misfit below which the minimum is searched for a second time."""
_DENSITIES = (1, 4)
"""Relative number of Sobol points over all bounds in the first and in the second search."""
_WIDEN = 2.0
"""Standard deviations of the drawn points over those of the estimate."""
_LEAST_SPREAD = 0.03
"""Smallest standard deviation of drawn points, in logarithms."""
_SHRINK, _SHRINK_LIMITS = 0.5, (0.05, 0.9)
"""Weight of the diagonal in the covariance of the statistics, per ratio of their number to the degrees of freedom, and its
limits.

Few simulations determine the variances, but not which combinations of statistics hardly vary.
"""
_LEAST_SETS = 30
"""Smallest number of simulated sets in a round of the approach."""
OBSERVATION_S = 0.3
"""Expected duration of one simulated observation, s, for the progress display; a map needs two."""

Simulate = Callable[[FloatArray, int, KeyedRandom], FloatArray]
"""A function of (k,) parameter values, a number of epochs and a random source that returns (m,) statistics of the
simulated maps.
"""


@dataclass(frozen=True)
class Simulations:
    """Noise parameters of n simulations, and the summary statistics of the simulated difference maps.

    Attributes
    ----------
    x : (n, k) natural logarithms of the noise parameters.
    s : (n, m) summary statistics of size and spatial pattern of the noise (logarithms of lengths in m).
    """

    x: FloatArray
    s: FloatArray

    def with_more(self, other: Simulations) -> Simulations:
        """Return the simulations of this set followed by those of another, to fit a response surface to both.

        other: the further simulations, of the same parameters and statistics.
        """
        return Simulations(np.concatenate([self.x, other.x]), np.concatenate([self.s, other.s]))

    def at(self, rows: NDArray[Any]) -> Simulations:
        """Return a subset of the simulations.

        rows: their indices, or an (n,) mask that is true for those to keep.
        """
        return Simulations(self.x[rows], self.s[rows])


@dataclass(frozen=True)
class ResponseSurface:
    """Response surface: predicts the summary statistics of simulated difference maps from noise parameters.

    The statistics describe size and spatial pattern of the noise. Their mean is a quadratic polynomial of z = (x - centre) /
    scale, where x are the natural logarithms of the parameters. The cost of parameters is the squared Mahalanobis distance of
    the measured statistics from that mean.

    Attributes
    ----------
    centre, scale : (k,) mean and standard deviation of x over the simulations to which the polynomial was fitted.
    coefficients : (terms, m) coefficients of the polynomial, by term (1, z_i, z_i z_j) and statistic.
    covariance : (m, m) covariance of the statistics of one simulation.
    whitening : (m, m) L^-1 with L L^T = covariance.
    """

    centre: FloatArray
    scale: FloatArray
    coefficients: FloatArray
    covariance: FloatArray
    whitening: FloatArray

    @classmethod
    def fit(cls, sample: Simulations) -> ResponseSurface:
        """Fit a response surface, which predicts the summary statistics of simulated maps from noise parameters.

        The mean of the statistics is a quadratic function of the logarithmic parameters, fitted by least squares. Their
        covariance (m, m) is that of the residuals, with off-diagonal elements reduced (shrinkage), as few simulations
        determine them poorly.

        Parameters
        ----------
        sample : Simulations
            Logarithmic parameters of n simulations and the m statistics that each gave.
        """
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
        """Predict the (m,) summary statistics of difference maps that are simulated with given noise parameters.

        x: (k,) natural logarithms of the parameters.
        """
        return _design(((x - self.centre) / self.scale)[None])[0] @ self.coefficients

    def misfit(self, x: FloatArray, observed: FloatArray) -> FloatArray:
        """Return the whitened difference of measured and predicted statistics, whose squares add up to the cost of parameters.

        Parameters
        ----------
        x : (k,) natural logarithms of the noise parameters.
        observed : (m,) statistics of the measurement.

        Returns
        -------
        (m,) uncorrelated differences, in standard deviations.
        """
        return self.whitening @ (observed - self.mean(x))

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Return the derivatives of the whitened misfit of the summary statistics by the logarithmic noise parameters.

        The search for the parameters of least misfit uses them. x: (k,) natural logarithms of the parameters at which to
        differentiate. Returns (m, k): statistics by parameters.
        """
        return -self.whitening @ (_gradient((x - self.centre) / self.scale) @ self.coefficients).T / self.scale

    def minimum(self, observed: FloatArray, start: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        """Find the noise parameters within bounds whose predicted summary statistics are nearest to the measured ones.

        They have the least cost: the sum of squares of the whitened misfit.

        Parameters
        ----------
        observed : (m,) statistics of the measurement.
        start : (k,) natural logarithms of the parameters at which to start.
        low, high : (k,) bounds of the logarithmic parameters.

        Returns
        -------
        (k,) natural logarithms of the parameters of least cost.
        """
        found = optimize.least_squares(
            lambda x: self.misfit(x, observed), np.clip(start, low + 1e-9, high - 1e-9), lambda x: self.jacobian(x), (low, high)
        )
        return found.x

    def covariance_at(self, x: FloatArray) -> FloatArray:
        """Return the covariance of the estimated noise parameters at the minimum of the cost, to first order.

        x: (k,) natural logarithms of the parameters at the minimum. Returns (k, k), for the logarithms.
        """
        jacobian = self.jacobian(x)
        return np.asarray(np.linalg.pinv(jacobian.T @ jacobian + 1e-6 * np.eye(len(x))), dtype=np.float64)


@dataclass(frozen=True)
class SearchResult:
    """Result of a search for noise parameters with which simulated maps are like the measured ones.

    All parameters are natural logarithms.

    Attributes
    ----------
    x : (k,) estimate, corrected for bias.
    low, high : (k,) ends of its confidence interval.
    errors : (n, k) errors of the estimates when n simulations are treated like the measurement (parametric bootstrap).
    surface : Response surface (summary statistics as a function of the parameters) of the last round of simulations.
    cost : Squared Mahalanobis distance of the measured from the expected statistics at the minimum.
    misfit_p : Share of simulations that fit worse than the measurement: a p-value of the goodness of fit.
    misfit : (m,) measured minus expected statistics, in standard deviations.
    history : After each round, the number of maps simulated so far and the minimum, (k,).
    maps : Number of simulated maps.
    converged : Whether the minimum lies among the simulations of the last round.
    """

    x: FloatArray
    low: FloatArray
    high: FloatArray
    errors: FloatArray
    surface: ResponseSurface
    cost: float
    misfit_p: float
    misfit: FloatArray
    history: tuple[tuple[int, FloatArray], ...]
    maps: int
    converged: bool

    @property
    def correlation(self) -> FloatArray:
        """(k, k) correlation of the errors of the estimated noise parameters; near 1 in magnitude, two cannot be separated."""
        return np.atleast_2d(np.corrcoef(self.errors.T))


class NoiseSearch:
    """Search for the noise parameters with which simulated maps have the same summary statistics as the measured ones.

    Parameters
    ----------
    simulate : Function that simulates difference maps from (k,) parameter values, a number of epochs and a random source,
        and returns the (m,) summary statistics of their noise.
    parameters : The k noise parameters and their bounds.
    epochs : Number of measured epochs.
    random : Source of random numbers; each simulation draws its own, by its number.
    progress : Display of the progress.

    Attributes
    ----------
    simulated, maps : Number of simulations, and of the maps in them, so far.
    approached : For every simulation in order, the number of maps simulated so far and its (m,) statistics.
    terms : Number of coefficients of the quadratic polynomial that predicts each statistic from the parameters.
    """

    def __init__(
        self, simulate: Simulate, parameters: NoiseParameters, epochs: int, random: KeyedRandom, progress: Progress
    ) -> None:
        self.simulate, self.epochs, self.random, self.progress = simulate, epochs, random, progress
        self.parameters = parameters
        self.low, self.high = np.log(parameters.low), np.log(parameters.high)
        self.simulated = self.maps = 0
        self.approached: list[tuple[int, FloatArray]] = []
        count = len(parameters.names)
        self.terms = 1 + count + count * (count + 1) // 2

    def run(self, observed: FloatArray, simulations: int, confidence: float) -> SearchResult:
        """Find the noise parameters of least cost and their confidence intervals.

        The cost is the squared Mahalanobis distance of the measured summary statistics from those expected for the parameters.
        If the fit is rejected (p-value below 0.01), a second search with more starting points follows, and the better one
        counts.

        Parameters
        ----------
        observed : (m,) statistics of the measurement.
        simulations : Number of simulations in the last round, near the minimum, which gives the intervals.
        confidence : Confidence level of the intervals, 0 to 1.
        """
        found = self._run_once(observed, simulations, confidence, _DENSITIES[0])
        for density in _DENSITIES[1:]:
            if found.misfit_p >= _REJECTED:
                break
            again = self._run_once(observed, simulations, confidence, density)
            better = min(found, again, key=lambda each: (-each.misfit_p, each.cost))
            found = replace(better, history=(*found.history, *again.history), maps=self.maps)
        return found

    def _run_once(self, observed: FloatArray, simulations: int, confidence: float, density: int) -> SearchResult:
        """Approach the minimum, simulate the last round around it, and repeat that round while the minimum lies outside of it."""
        last = OBSERVATION_S * (self.epochs + 1) * simulations
        self.progress.plan(
            {f"search, round {number}": 2 * OBSERVATION_S * self._round_size for number in range(2, _APPROACHES + 1)}
        )
        self.progress.plan({"search, round 1": 2 * OBSERVATION_S * self._first_size(density), "search, last round": last})
        x, covariance, history = self._approach(observed, density)
        for attempt in range(1 + _MORE_ROUNDS):
            stage = f"search, last round{' again' * attempt}"
            self.progress.plan({stage: last})
            with self.progress.stage(stage):
                sample = self._sample(self._around(x, covariance, simulations), self.epochs)
            surface = ResponseSurface.fit(sample)
            minimum = surface.minimum(observed, _nearest(surface, sample, observed), self.low, self.high)
            history.append((self.maps, minimum))
            inside = bool(np.abs((minimum - sample.x.mean(axis=0)) / sample.x.std(axis=0)).max() < _WIDEN)
            x, covariance = minimum, surface.covariance_at(minimum)
            if inside:
                break
        return self._with_interval_and_fit(observed, sample, surface, minimum, confidence, tuple(history), inside)

    @property
    def _round_size(self) -> int:
        """Simulated sets in a round of the approach."""
        return max(3 * self.terms, _LEAST_SETS)

    def _first_size(self, density: int) -> int:
        """Return the number of simulated sets in the first round: a power of 2, as Sobol points need."""
        return int(2 ** np.ceil(np.log2(density * self._round_size)))

    def _approach(self, observed: FloatArray, density: int) -> tuple[FloatArray, FloatArray, list[tuple[int, FloatArray]]]:
        """Approach the minimum in rounds.

        The sets have one later epoch each, which suffices for the mean of the statistics. Returns the minimum, its
        covariance and the history.
        """
        size = self._round_size
        generator = np.random.default_rng(self.random.child("sobol").key)
        sobol = stats.qmc.Sobol(len(self.low), rng=generator).random(self._first_size(density))
        sample = Simulations(np.empty((0, len(self.low))), np.empty((0, len(observed))))
        points, history = self.low + sobol * (self.high - self.low), []
        for number in range(_APPROACHES):
            with self.progress.stage(f"search, round {number + 1}"):
                sample = sample.with_more(self._sample(points, 1))
            near = sample.at(np.argsort(_distance(sample.s, observed))[:size])
            surface = ResponseSurface.fit(near)
            x = surface.minimum(observed, near.x[0], self.low, self.high)
            x = np.clip(x, near.x.min(axis=0), near.x.max(axis=0))  # a polynomial does not extrapolate
            history.append((self.maps, x))
            covariance = surface.covariance_at(x)
            if number < _APPROACHES - 1:
                covariance = covariance + np.diag(near.x[: self.terms].var(axis=0)) / 4
                points = self._around(x, covariance, size)
        return x, covariance, history

    def _around(self, x: FloatArray, covariance: FloatArray, count: int) -> FloatArray:
        """Draw (count, k) points around x with twice the standard deviations of `covariance`, reflected into the bounds."""
        widest = (self.high - self.low) / 4
        sigma = np.sqrt(np.diag(covariance))
        limited = np.clip(_WIDEN * sigma, _LEAST_SPREAD, widest) / np.maximum(sigma, 1e-12)
        spread = covariance * np.outer(limited, limited)
        draws = self.random.child("points", self.simulated).generator()
        normal = draws.multivariate_normal(np.zeros(len(x)), spread, count, check_valid="ignore")
        mirrored = x + normal
        mirrored = np.where(mirrored < self.low, 2 * self.low - mirrored, mirrored)
        mirrored = np.where(mirrored > self.high, 2 * self.high - mirrored, mirrored)
        return np.clip(mirrored, self.low, self.high)

    def _sample(self, points: FloatArray, epochs: int) -> Simulations:
        """Simulate at each point; leave out points where the pipeline fails because noise leaves nothing to register."""
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
            raise InputError(
                f"{len(points) - len(found)} of {len(points)} simulated measurements failed, more than half",
                where="calibration",
                remedy="run scarpsim simulate with the same config to see the error, and correct the config",
            )
        return Simulations(np.array(used), np.array(found))

    def _with_interval_and_fit(
        self,
        observed: FloatArray,
        sample: Simulations,
        surface: ResponseSurface,
        minimum: FloatArray,
        confidence: float,
        history: tuple[tuple[int, FloatArray], ...],
        converged: bool,
    ) -> SearchResult:
        """Compute the estimate's interval and the p-value of the misfit, from estimates of the simulated sets."""
        errors, costs = np.empty_like(sample.x), np.empty(len(sample.x))
        fold = np.arange(len(sample.x)) % _FOLDS
        for number in range(_FOLDS):
            kept = sample.at(fold != number)
            without = ResponseSurface.fit(kept)
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
        return SearchResult(
            x, low, high, errors, surface, cost, float(np.mean(costs >= cost)), scaled, history, self.maps, converged
        )


def cost_of_new_simulations(
    search: NoiseSearch, surface: ResponseSurface, observed: FloatArray, x: FloatArray, sets: int = 4
) -> float:
    """Compute the cost of noise parameters from new simulations, to compare the results of two searches; lower is better.

    The cost is the squared Mahalanobis distance of the measured summary statistics from the mean statistics of the
    simulations, divided by 1 + 1 / sets for the scatter of that mean.

    Parameters
    ----------
    search : Provides the simulator and the number of measured epochs.
    surface : Response surface, which provides the covariance of the statistics.
    observed : (m,) statistics of the measurement.
    x : (k,) natural logarithms of the parameters.
    sets : Number of simulations; each has as many epochs as the measurement.
    """
    source = replace(search.random, path=(*search.random.path, "fresh"))
    values = search.parameters.values(x)
    drawn = np.array([search.simulate(values, search.epochs, source.child(number)) for number in range(sets)])
    left = surface.whitening @ (observed - drawn.mean(axis=0))
    return float(np.sum(left**2) / (1 + 1 / sets))


def _distance(s: FloatArray, observed: FloatArray) -> FloatArray:
    """Return the RMS difference (n,) of simulated from observed statistics.

    It is unweighted, for use before the covariance of the statistics is known.
    """
    return np.sqrt(np.mean((s - observed) ** 2, axis=1))


def _nearest(surface: ResponseSurface, sample: Simulations, observed: FloatArray) -> FloatArray:
    """Return the parameters of the simulation whose statistics are nearest to the observed ones."""
    return sample.x[np.argmin(np.sum((surface.whitening @ (sample.s - observed).T) ** 2, axis=0))]


def _design(z: FloatArray) -> FloatArray:
    """Return the (n, terms) design matrix of 1, z_i and z_i z_j."""
    i, j = np.triu_indices(z.shape[1])
    return np.concatenate([np.ones((len(z), 1)), z, z[:, i] * z[:, j]], axis=1)


def _gradient(z: FloatArray) -> FloatArray:
    """Return the (k, terms) derivatives of one row of `_design`."""
    k = len(z)
    i, j = np.triu_indices(k)
    unit = np.eye(k)
    return np.concatenate([np.zeros((k, 1)), unit, unit[:, i] * z[j] + unit[:, j] * z[i]], axis=1)
