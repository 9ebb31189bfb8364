"""Define the probability distributions that a config can name. Each draws from the generator it is given and keeps no state.

In YAML a distribution is a mapping with its `kind`, or a plain number for a constant:

    size_m: {kind: gaussian, mean: 0.4, sigma: 0.1, minimum: 0.1}
    irregularity: 0.0

Values carry the unit of the key that they stand under.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from scene.common.config import Config
from scene.geometry.mesh import FloatArray


class Constant(Config):
    """Distribution of a config that always gives the same value."""

    kind: Literal["constant"] = "constant"
    value: float = Field(description="the value")

    def sample(self, generator: np.random.Generator, size: int) -> FloatArray:
        """Return the constant value `size` times, (size,). `generator` is not used."""
        return np.full(size, self.value)


class Gaussian(Config):
    """Normal distribution, truncated from below if a minimum is given.

    A config uses it for quantities that are drawn at random, such as the sizes of blocks (`sample`), in the quantity's unit.
    """

    kind: Literal["gaussian"] = "gaussian"
    mean: float = Field(description="mean, before truncation")
    sigma: float = Field(ge=0, description="standard deviation, before truncation")
    minimum: float | None = Field(default=None, description="smallest value; none by default")

    @model_validator(mode="after")
    def _minimum_is_reachable(self) -> Self:
        if self.minimum is not None and self.minimum > self.mean + 5 * self.sigma:
            raise ValueError("minimum must not exceed mean + 5 sigma")
        return self

    def sample(self, generator: np.random.Generator, size: int) -> FloatArray:
        """Draw `size` values with the random numbers of `generator`, by inversion of the (truncated) distribution function."""
        from scipy import special

        if self.minimum is None or self.sigma == 0:
            return generator.normal(self.mean, self.sigma, size)
        mass = special.ndtr((self.mean - self.minimum) / self.sigma)  # P(value > minimum)
        upper = mass * (1.0 - generator.random(size))  # in (0, mass]
        return np.maximum(self.mean - self.sigma * special.ndtri(upper), self.minimum)


class Uniform(Config):
    """Uniform distribution on [low, high).

    A config uses it for quantities that are drawn at random, such as the sizes of blocks (`sample`), in the quantity's unit.
    """

    kind: Literal["uniform"] = "uniform"
    low: float = Field(description="smallest value")
    high: float = Field(description="largest value")

    @model_validator(mode="after")
    def _is_ordered(self) -> Self:
        if self.high < self.low:
            raise ValueError("high must not be below low")
        return self

    def sample(self, generator: np.random.Generator, size: int) -> FloatArray:
        """Draw `size` values between `low` and `high` with the random numbers of `generator`."""
        return generator.uniform(self.low, self.high, size)


class Lognormal(Config):
    """Lognormal distribution: the natural logarithm is normal with mean ln(median) and standard deviation sigma_log.

    A config uses it for quantities that are drawn at random, such as the sizes of blocks (`sample`), in the quantity's unit.
    """

    kind: Literal["lognormal"] = "lognormal"
    median: float = Field(gt=0, description="median")
    sigma_log: float = Field(ge=0, description="standard deviation of the natural logarithm")

    def sample(self, generator: np.random.Generator, size: int) -> FloatArray:
        """Draw `size` lognormal values with the random numbers of `generator`."""
        return self.median * np.exp(self.sigma_log * generator.standard_normal(size))


class Histogram(Config):
    """Empirical distribution: bins are drawn in proportion to their counts, values uniformly within a bin.

    A config uses it for quantities that are drawn at random, such as measured sizes of blocks (`sample`), in the quantity's
    unit.
    """

    kind: Literal["histogram"] = "histogram"
    edges: tuple[float, ...] = Field(min_length=2, description="bin edges, increasing, one more than counts")
    counts: tuple[Annotated[float, Field(ge=0)], ...] = Field(min_length=1, description="count or weight of each bin")

    @model_validator(mode="after")
    def _is_a_histogram(self) -> Self:
        if len(self.edges) != len(self.counts) + 1:
            raise ValueError(f"{len(self.counts)} counts need {len(self.counts) + 1} edges")
        if not np.all(np.diff(self.edges) > 0):
            raise ValueError("edges must increase")
        if not sum(self.counts) > 0:
            raise ValueError("at least one count must be positive")
        return self

    def sample(self, generator: np.random.Generator, size: int) -> FloatArray:
        """Draw `size` values from the histogram, by inversion of its piecewise linear distribution function.

        `generator` is the source of random numbers.
        """
        edges, counts = np.asarray(self.edges), np.asarray(self.counts)
        filled = counts > 0
        ends = np.cumsum(counts[filled])
        mass = generator.random(size) * ends[-1]
        number = np.minimum(np.searchsorted(ends, mass, side="right"), len(ends) - 1)
        within = 1.0 - (ends[number] - mass) / counts[filled][number]
        return edges[:-1][filled][number] + within * np.diff(edges)[filled][number]


class Mixture(Config):
    """Mixture of distributions: one is chosen for each value, with probability proportional to its weight."""

    kind: Literal["mixture"] = "mixture"
    components: tuple[Distribution, ...] = Field(min_length=1, description="the distributions")
    weights: tuple[Annotated[float, Field(ge=0)], ...] = Field(min_length=1, description="weight of each component")

    @model_validator(mode="after")
    def _is_weighted(self) -> Self:
        if len(self.components) != len(self.weights):
            raise ValueError(f"{len(self.components)} components need as many weights, got {len(self.weights)}")
        if not sum(self.weights) > 0:
            raise ValueError("at least one weight must be positive")
        return self

    def sample(self, generator: np.random.Generator, size: int) -> FloatArray:
        """Draw `size` values, for each first a component of the mixture and then a value of it.

        `generator` is the source of random numbers.
        """
        ends = np.cumsum(self.weights)
        number = np.searchsorted(ends / ends[-1], generator.random(size), side="right")
        drawn = np.stack([component.sample(generator, size) for component in self.components])
        return np.take_along_axis(drawn, number[None], axis=0)[0]


def _constant_from_number(value: Any) -> Any:
    """Convert a plain number to a constant distribution."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return Constant(value=value) if is_number else value


Distribution = Annotated[
    Annotated[Constant | Gaussian | Uniform | Lognormal | Histogram | Mixture, Field(discriminator="kind")],
    BeforeValidator(_constant_from_number),
]
"""Type of a config key that accepts any of the distributions or a plain number."""


def highest(distribution: Distribution) -> float:
    """Return the largest value that a distribution can give, in its unit; infinite if it has no upper limit."""
    match distribution:
        case Constant():
            return distribution.value
        case Uniform():
            return distribution.high
        case Histogram():
            return max(edge for edge, count in zip(distribution.edges[1:], distribution.counts, strict=True) if count > 0)
        case Mixture():
            parts = zip(distribution.components, distribution.weights, strict=True)
            return max(highest(component) for component, weight in parts if weight > 0)
        case Gaussian(sigma=0):
            return distribution.mean
        case _:
            return math.inf


Mixture.model_rebuild()
