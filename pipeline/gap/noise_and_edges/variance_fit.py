"""Fit the variance of residuals to their squared deviations: by noise effects, or freely in bins of a covariate."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray

_BINS = 8
_LINE_DIGITS, _FEWEST_IN_LINE, _LONGEST_CYCLE = 3, 10, 16
"""Decimals of the coordinates of image rows and columns; mean number of points in each that is needed to bin by them; longest
cycle of lines, as of the channels of a laser scanner, in which the noise may differ."""
_FISHER_ROUNDS = 25


@dataclass(frozen=True)
class VarianceCandidate:
    """A noise effect to fit: the variance that it adds at each of n points, as a sum of k fitted terms, one for each parameter.

    A fitted factor theta multiplies the variance that a parameter adds at its typical size (1: typical size).

    Attributes
    ----------
    name : name of the effect.
    variance : (n, k) variance that each parameter adds at its typical size, squared unit of the observable (m² or px²).
    sizes : typical size of each of the k parameters, by name, the main one first. A parameter's value is its typical size times
        sqrt(theta).
    fixed : values, by name, of parameters that are not fitted; each of a few trial values makes a candidate of its own.
    """

    name: str
    variance: FloatArray
    sizes: Mapping[str, float]
    fixed: Mapping[str, float]

    @property
    def cost(self) -> float:
        """Penalty subtracted from the log-likelihood ratio: the number of parameters, with those in `fixed`."""
        return float(len(self.sizes) + len(self.fixed))

    def parameters(self, theta: FloatArray) -> dict[str, float]:
        """Convert fitted factors theta (k,) to values of the noise effect's parameters, by name; 1 gives the typical size."""
        return self._by_name(np.sqrt(theta)) | dict(self.fixed)

    def main_parameter(self, theta: float) -> tuple[str, float]:
        """Return name and value of the first parameter if one factor theta applies to the variances of all parameters."""
        name, size = next(iter(self.sizes.items()))
        return name, float(np.sqrt(theta)) * size

    def standard_deviations(self, theta: FloatArray, error: FloatArray) -> dict[str, float]:
        """Convert standard deviations `error` (k,) of the factors theta (k,) to those of the noise effect's parameters, by name.

        If a factor is below its standard deviation, the parameter may be 0. The size at which the factor equals its standard
        deviation is then returned instead.
        """
        return self._by_name(np.where(theta > error, error / np.maximum(2 * np.sqrt(theta), 1e-300), np.sqrt(error)))

    def _by_name(self, relative: FloatArray) -> dict[str, float]:
        """Values of the parameters from multiples (k,) of their typical sizes."""
        return {name: float(each * size) for (name, size), each in zip(self.sizes.items(), relative, strict=True)}


@dataclass(frozen=True)
class VarianceFit:
    """Some noise effects of a list of candidates, fitted together to squared deviations.

    Attributes
    ----------
    members : places of the effects in the list.
    theta, error : for each effect, the (k,) fitted factors of its variance (`VarianceCandidate`) and their standard deviations.
    gain : log-likelihood ratio of the models with and without the effects.
    score : gain minus the penalties of the effects.
    """

    members: tuple[int, ...]
    theta: tuple[FloatArray, ...]
    error: tuple[FloatArray, ...]
    gain: float
    score: float

    @classmethod
    def fitted(
        cls, squares: FloatArray, shapes: list[FloatArray], members: list[int], candidates: list[VarianceCandidate]
    ) -> VarianceFit:
        """Fit the variance 1 + sum theta f to squared deviations by Fisher scoring, with theta >= 0.

        squares : (n,) squared deviations of the residuals over their predicted variance.
        shapes : for each candidate, the (n, k) variance f that its parameters add over the predicted one.
        members : places of the candidates that are fitted.
        candidates : the list of candidates.
        """
        columns = np.concatenate([shapes[number] for number in members], axis=1)
        scale = 1 / np.maximum(columns.mean(axis=0), 1e-300)
        columns = columns * scale
        theta = np.full(len(scale), max(float(np.mean(squares)) - 1, 1e-3) / len(scale))
        information = np.eye(len(scale))
        for _ in range(_FISHER_ROUNDS):
            total = 1 + columns @ theta
            slope = 0.5 * columns.T @ ((squares - total) / total**2)
            information = 0.5 * (columns / total[:, None] ** 2).T @ columns
            free = (theta > 0) | (slope > 0)
            step = np.zeros(len(theta))
            step[free] = np.linalg.lstsq(information[np.ix_(free, free)], slope[free], rcond=1e-10)[0]
            theta = np.maximum(theta + step, 0.0)
        gain = _log_likelihood_gain(squares, columns @ theta)
        error = np.sqrt(np.maximum(np.diag(np.linalg.pinv(information, hermitian=True)), 0.0))
        ends = np.cumsum([shapes[number].shape[1] for number in members])[:-1]
        score = gain - sum(candidates[number].cost for number in members)
        return cls(tuple(members), tuple(np.split(theta * scale, ends)), tuple(np.split(error * scale, ends)), gain, score)

    def added(self, shapes: list[FloatArray]) -> FloatArray:
        """Return the (n,) variance that the effects add, over the predicted one. shapes: the argument of `fitted`."""
        return np.asarray(sum(shapes[number] @ theta for theta, number in zip(self.theta, self.members, strict=True)))


@dataclass(frozen=True)
class BinnedVariance:
    """A noise variance that is fitted separately in each bin of a covariate.

    Attributes
    ----------
    name : the covariate, such as "range".
    gain : log-likelihood ratio of the models with and without the added variance.
    score : gain minus the number of bins.
    added : (n,) variance that it adds, over the predicted one.
    """

    name: str
    gain: float
    score: float
    added: FloatArray


def best_binned_variance(squares: FloatArray, covariates: Mapping[str, FloatArray]) -> BinnedVariance:
    """Return the covariate along which a variance free in each bin explains most.

    Heavier tails than those of a normal distribution make the variances of bins differ more by chance. What the bins explain
    beside their common mean is therefore divided by a factor that follows from the kurtosis.

    squares : (n,) squared deviations of the residuals over their predicted variance.
    covariates : (n,) values of each covariate, by name.
    """
    mean = float(np.mean(squares))
    tails = max(0.5 * (float(np.mean(squares**2)) / mean**2 - 1), 1.0)
    common = 0.5 * len(squares) * (mean - 1 - np.log(mean))
    best = BinnedVariance("", -np.inf, -np.inf, np.zeros(len(squares)))
    for name, group in _bins(covariates):
        count = np.maximum(np.bincount(group), 1)
        variance = np.maximum(np.bincount(group, squares) / count, 1e-9)
        gain = float(common + 0.5 * np.sum(count * np.log(mean / variance)) / tails)
        if gain - len(count) > best.score:
            best = BinnedVariance(name, gain, gain - len(count), (variance - 1)[group])
    return best


def _bins(covariates: Mapping[str, FloatArray]) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """Yield (n,) bin numbers: equally filled bins of each covariate; scan lines, image rows and columns, and cycles of them."""
    for name, values in covariates.items():
        if name not in ("edge_step", "line"):
            yield name, quantile_group(values, _BINS)
        if name in ("line", "image_x", "image_y"):
            lines, group = np.unique(np.round(values, _LINE_DIGITS), return_inverse=True)
            if 1 < len(lines) < len(values) / _FEWEST_IN_LINE:
                yield name, group
                number = np.rint((values - values.min()) / np.diff(lines).min()).astype(np.int64)
                yield from ((name, number % cycle) for cycle in range(2, _LONGEST_CYCLE + 1))


def quantile_group(values: FloatArray, count: int) -> NDArray[np.int64]:
    """Return the group (n,) of each value, of `count` groups with equally many values."""
    return np.asarray(np.searchsorted(np.quantile(values, np.linspace(0, 1, count + 1)[1:-1]), values))


def _log_likelihood_gain(squares: FloatArray, added: FloatArray) -> float:
    """Log-likelihood ratio of an added variance (n,)."""
    return float(0.5 * np.sum(squares * added / (1 + added) - np.log1p(added)))
