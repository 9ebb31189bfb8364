"""Which effects explain the spread: the Gaussian likelihood of deviations within cells, sigma_i^2 = model + theta f_k(i)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.cells import Cells, block_numbers
from pipeline.gap.residuals import Residuals
from pipeline.gap.tls_spread import slant
from scene.keyed_random import KeyedRandom
from scene.mesh import FloatArray

DRAWS = 1999
_ALPHA = 0.004
_LEAST_GAIN = 6.0
_LEAST_EXCESS = 0.03
"""Added variance, as a share of the model's, below which the reference's own small errors may be meant."""
_CLIP = 4.5
_LEAST_LEFT = 0.3
"""Share of a point's variance that its cell's plane must leave."""
_CLASS_MARGIN = 3.0
_FREE_MARGIN = 6.0
_BINS = 8
_EXPONENTS = (-0.5, -0.75, -1.0)
_THETAS = np.concatenate([[0.0], np.geomspace(1e-3, 1e2, 60)])


@dataclass(frozen=True)
class SpreadCandidate:
    """variance: (n,) form that is scaled by theta; parameters: from theta to the effect's values; cost: free parameters."""

    name: str
    variance: FloatArray
    parameters: Callable[[float], dict[str, float]]
    names: tuple[str, ...]
    cost: float = 1.0
    fixed: Mapping[str, float | str] = field(default_factory=dict)


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
    tried: tuple[tuple[str, float], ...]


def standardised(residuals: Residuals, cells: Cells, value: FloatArray) -> FloatArray:
    """(n,) deviations from the cells' planes over the predicted spread, of unit variance if the model is right; NaN outside.

    A plane in each cell takes away what the reference's error, correlated over metres, does within it.
    """
    inside = cells.cell >= 0
    cell = cells.cell[inside]
    offset = (residuals.at[inside] - cells.centre[cell]) / cells.side_m
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


def tls_candidates(residuals: Residuals) -> list[SpreadCandidate]:
    """The catalogue's forms of a laser range's variance."""
    g = residuals.geometry
    one = np.ones(len(residuals))

    def root(name: str, scale: float = 1.0, **fixed: float) -> Callable[[float], dict[str, float]]:
        return lambda theta: {name: float(np.sqrt(theta)) * scale, **fixed}

    across, along = g.by_azimuth**2, g.by_zenith**2
    found = [
        SpreadCandidate("range_noise", one, root("sigma_m"), ("sigma_m",)),
        SpreadCandidate("range_noise_proportional", g.range_m**2, root("ppm", 1e6), ("ppm",)),
        SpreadCandidate("range_noise_incidence", slant(g) ** 2, root("sigma_m"), ("sigma_m",)),
        SpreadCandidate("angle_noise", across, root("azimuth_sigma_rad"), ("azimuth_sigma_rad",), 1.5),
        SpreadCandidate("angle_noise", along, root("zenith_sigma_rad"), ("zenith_sigma_rad",), 1.5),
        SpreadCandidate("angle_noise", across + along, _both_angles, ("azimuth_sigma_rad", "zenith_sigma_rad"), 1.5),
    ]
    if g.power is not None:
        power = np.maximum(g.power, 1e-9)
        for exponent in _EXPONENTS:
            form = np.minimum(power ** (2 * exponent), np.quantile(power ** (2 * exponent), 0.999))
            found.append(SpreadCandidate("range_noise_intensity", form, root("a_m", exponent=exponent), ("a_m",), 1.5))
    return found


def _both_angles(theta: float) -> dict[str, float]:
    return dict.fromkeys(("azimuth_sigma_rad", "zenith_sigma_rad"), float(np.sqrt(theta)))


def stereo_candidates(residuals: Residuals) -> list[SpreadCandidate]:
    """The catalogue's forms of a disparity's variance that need no image."""
    return [
        SpreadCandidate(
            "parallax_noise", np.ones(len(residuals)), lambda theta: {"sigma_px": float(np.sqrt(theta))}, ("sigma_px",)
        )
    ]


def find_spread(residuals: Residuals, cells: Cells, value: FloatArray, random: KeyedRandom) -> SpreadFound | None:
    """The effect that the spread asks for, if any. value: (n,) residuals without the mean effects found."""
    z = standardised(residuals, cells, value)
    kept = np.isfinite(z) & (np.abs(z) < _CLIP * max(1.0, 1.4826 * float(np.nanmedian(np.abs(z)))))
    squared = z[kept] ** 2
    candidates = tls_candidates(residuals) if residuals.sensor == "tls" else stereo_candidates(residuals)
    forms = [candidate.variance[kept] / residuals.sigma[kept] ** 2 for candidate in candidates]
    fits = [_most_likely(squared, form) for form in forms]
    scores = np.array([gain - candidate.cost for (_, gain, _), candidate in zip(fits, candidates, strict=True)])
    best = int(np.argmax(scores))
    theta, gain, error = fits[best]
    excess = float(np.mean(theta * forms[best]))
    p_value = _p_value(squared, forms, block_numbers(residuals.at[kept], cells.side_m), random)
    if gain < _LEAST_GAIN or p_value > _ALPHA or excess < _LEAST_EXCESS:
        return None
    free_name, free_score = _free_form(squared, {name: v[kept] for name, v in residuals.covariates.items()}, residuals.sensor)
    alike = {c.name for c, s in zip(candidates, scores, strict=True) if s > scores[best] - _CLASS_MARGIN} - {
        candidates[best].name
    }
    tried = tuple(sorted(((c.name, float(s)) for c, s in zip(candidates, scores, strict=True)), key=lambda item: -item[1]))
    parameters = candidates[best].parameters(theta)
    std = {key: abs(parameters[key]) * error / (2 * theta) for key in candidates[best].names}
    empirical = free_score > scores[best] + _FREE_MARGIN
    name = f"spread by {free_name}" if empirical else candidates[best].name
    return SpreadFound(
        name,
        candidates[best].name,
        tuple(sorted(alike)),
        p_value,
        gain,
        parameters,
        std,
        empirical,
        theta * candidates[best].variance,
        tried,
    )


def _most_likely(squared: FloatArray, form: FloatArray) -> tuple[float, float, float]:
    """theta >= 0, the gain in log-likelihood over theta = 0, and theta's standard error."""
    scale = 1 / max(float(np.mean(form)), 1e-300)
    gains = [_gain(squared, theta * scale * form) for theta in _THETAS]
    index = int(np.argmax(gains))
    low, high = _THETAS[max(index - 1, 0)] * scale, _THETAS[min(index + 1, len(_THETAS) - 1)] * scale
    for _ in range(30):  # golden section
        first, second = high - 0.618 * (high - low), low + 0.618 * (high - low)
        low, high = (low, second) if _gain(squared, first * form) > _gain(squared, second * form) else (first, high)
    theta = (low + high) / 2
    information = 0.5 * float(np.sum((form / (1 + theta * form)) ** 2))
    return theta, _gain(squared, theta * form), 1 / np.sqrt(max(information, 1e-300))


def _gain(squared: FloatArray, added: FloatArray) -> float:
    return float(0.5 * np.sum(squared * added / (1 + added) - np.log1p(added)))


def _p_value(squared: FloatArray, forms: list[FloatArray], block: NDArray[np.int64], random: KeyedRandom) -> float:
    """Of the largest standardised score over the forms, by signs drawn block by block: (1 + b) / (1 + N)."""
    _, number = np.unique(block, return_inverse=True)
    scores = np.stack([np.bincount(number, (squared - 1) * form) for form in forms])
    size = np.sqrt(np.sum(scores**2, axis=1))
    signs = random.child("spread").generator().choice([-1.0, 1.0], size=(scores.shape[1], DRAWS))
    largest = np.max(scores @ signs / size[:, None], axis=0)
    return float((1 + np.sum(largest >= np.max(scores.sum(axis=1) / size))) / (1 + DRAWS))


def _free_form(squared: FloatArray, covariates: Mapping[str, FloatArray], sensor: str) -> tuple[str, float]:
    """The covariate along which a variance free in each of some bins explains most, with its score."""
    best = ("", -np.inf)
    for name, values in covariates.items():
        if name in ("edge_step", "line"):
            continue
        edges = np.quantile(values, np.linspace(0, 1, _BINS + 1)[1:-1])
        group = np.searchsorted(edges, values)
        count = np.maximum(np.bincount(group, minlength=_BINS), 1)
        variance = np.bincount(group, squared, _BINS) / count
        score = float(0.5 * np.sum(count * (variance - 1 - np.log(np.maximum(variance, 1e-9))))) - _BINS
        best = max(best, (name, score), key=lambda item: item[1])
    return best
