"""Each distribution against its closed-form distribution function (Kolmogorov-Smirnov).

Fixed seeds; significance 1e-3 / 8 per test, so the whole file would fail falsely for one seed in 1000 at most.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from scene.blocks.distributions import Distribution, Histogram
from scene.common.config import Config, parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom

SIGNIFICANCE = 1e-3 / 8
SIZE = 20_000


class Holder(Config):
    value: Distribution = 1.0  # type: ignore[assignment]


def distribution(values: Any) -> Any:
    return parse(Holder, {"value": values}, where="test").value


def draws(values: Any, seed: int = 1) -> np.ndarray:
    return distribution(values).sample(KeyedRandom(seed).child("distribution").generator(), SIZE)


GAUSSIAN = {"kind": "gaussian", "mean": 2.0, "sigma": 0.5}
TRUNCATED = {"kind": "gaussian", "mean": 0.3, "sigma": 0.4, "minimum": 0.1}
FAR_TAIL = {"kind": "gaussian", "mean": 0.0, "sigma": 1.0, "minimum": 4.0}
UNIFORM = {"kind": "uniform", "low": -1.0, "high": 3.0}
LOGNORMAL = {"kind": "lognormal", "median": 0.5, "sigma_log": 0.7}
HISTOGRAM = {"kind": "histogram", "edges": [0.0, 0.1, 0.4, 1.0, 1.2], "counts": [5, 0, 2, 13]}
MIXTURE = {"kind": "mixture", "components": [GAUSSIAN, UNIFORM], "weights": [1, 3]}

CASES = {
    "gaussian": (GAUSSIAN, stats.norm(2.0, 0.5).cdf),
    "truncated": (TRUNCATED, stats.truncnorm(-0.5, np.inf, loc=0.3, scale=0.4).cdf),
    "far tail": (FAR_TAIL, stats.truncnorm(4.0, np.inf).cdf),
    "uniform": (UNIFORM, stats.uniform(-1.0, 4.0).cdf),
    "lognormal": (LOGNORMAL, stats.lognorm(0.7, scale=0.5).cdf),
    "histogram": (HISTOGRAM, lambda x: np.interp(x, [0.0, 0.1, 0.4, 1.0, 1.2], [0.0, 0.25, 0.25, 0.35, 1.0])),
    "mixture": (MIXTURE, lambda x: 0.25 * stats.norm(2.0, 0.5).cdf(x) + 0.75 * stats.uniform(-1.0, 4.0).cdf(x)),
}


@pytest.mark.parametrize("case", CASES)
def test_draws_follow_the_closed_form(case: str) -> None:
    values, cdf = CASES[case]
    assert stats.kstest(draws(values), cdf).pvalue > SIGNIFICANCE


def test_the_test_can_fail() -> None:
    assert stats.kstest(draws(GAUSSIAN), stats.norm(2.0, 0.55).cdf).pvalue < SIGNIFICANCE


def test_a_number_is_a_constant() -> None:
    assert np.all(draws(0.25) == 0.25)
    assert distribution(2).sample(np.random.default_rng(0), 3).tolist() == [2.0, 2.0, 2.0]


def test_the_same_generator_gives_the_same_draws() -> None:
    for values, _ in CASES.values():
        assert np.array_equal(draws(values, seed=7), draws(values, seed=7))


def test_bounds_hold() -> None:
    assert draws(TRUNCATED).min() >= 0.1
    drawn = draws(HISTOGRAM)
    assert not np.any((drawn > 0.1 + 1e-12) & (drawn < 0.4 - 1e-12))
    assert drawn.min() >= 0.0
    assert drawn.max() <= 1.2


def test_a_histogram_with_an_empty_last_bin_never_draws_from_it() -> None:
    drawn = Histogram(edges=(0, 1, 2), counts=(1, 0)).sample(np.random.default_rng(1), 1000)
    assert drawn.max() <= 1.0


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"kind": "gaussian", "mean": 1.0, "sigma": -1.0}, "sigma"),
        ({"kind": "gaussian", "mean": 1.0, "sigma": 0.1, "minimum": 9.0}, "minimum"),
        ({"kind": "gaussian", "mean": 1.0, "sigma": 0.1, "minimun": 0.5}, "did you mean 'minimum'"),
        ({"kind": "uniform", "low": 1.0, "high": 0.0}, "high must not be below low"),
        ({"kind": "histogram", "edges": [0, 1], "counts": [1, 2]}, "3 edges"),
        ({"kind": "histogram", "edges": [0, 2, 1], "counts": [1, 2]}, "increase"),
        ({"kind": "mixture", "components": [1.0], "weights": [1, 2]}, "weights"),
        ({"kind": "weibull"}, "kind"),
        ("wide", "value"),
        (True, "value"),
    ],
)
def test_mistakes_are_named(values: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        distribution(values)
