"""Variogram and effective sample size against brute force, planted noise of known sigma and range, and simulated means."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from pipeline.noise.variogram import (
    Structure,
    Variogram,
    VariogramModel,
    effective_sample_size,
    fit_variogram,
    variance_of_mean,
    variogram,
)
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray


def planted(model: VariogramModel, shape: tuple[int, int], gsd: float, random: KeyedRandom) -> FloatArray:
    """Return a Gaussian field with the model's covariance, by circulant embedding (Dietrich and Newsam 1997)."""
    padded = tuple(3 * size for size in shape)
    row, column = (np.minimum(np.arange(size), size - np.arange(size)) * gsd for size in padded)
    power = np.maximum(np.fft.fft2(model.covariance(np.hypot(row[:, None], column[None]))).real, 0.0)
    generator = random.generator()
    white = generator.standard_normal(padded) + 1j * generator.standard_normal(padded)
    return np.fft.fft2(np.sqrt(power / power.size) * white).real[: shape[0], : shape[1]]


TWO_PARTS = VariogramModel(0.003**2, (Structure("spherical", 0.008**2, 0.4),))


@pytest.mark.parametrize("direction", ["all", "x", "y"])
def test_all_pairs_of_a_raster_with_holes(direction: str) -> None:
    """The result equals the mean over every pair, computed directly, to rounding."""
    generator = KeyedRandom(3).generator()
    values = generator.normal(5.0, 0.1, (17, 23))
    values[generator.random(values.shape) < 0.3] = np.nan
    found = variogram(values, 0.5, largest_lag_m=4.0, direction=direction)  # type: ignore[arg-type]
    place = np.argwhere(np.isfinite(values))
    lag, gamma = 0.5 * pdist(place), pdist(values[np.isfinite(values)][:, None], "sqeuclidean") / 2
    rows, columns = (pdist(place[:, axis : axis + 1]) for axis in (0, 1))
    tangent = np.tan(np.radians(22.5))
    sector = {"all": lag > 0, "x": rows <= tangent * columns, "y": columns <= tangent * rows}[direction]
    used = sector & (lag <= 4.0)
    assert found.pairs.sum() == np.count_nonzero(used)
    assert np.sum(found.pairs * found.semivariance_m2) == pytest.approx(gamma[used].sum(), rel=1e-9)
    assert np.sum(found.pairs * found.lag_m) == pytest.approx(lag[used].sum(), rel=1e-9)


def test_planted_nugget_sill_and_range_are_found() -> None:
    """The mean over four fields of 20 x 20 m; the sill of one field scatters by 5 %, its range by 8 %, so the limits are 3.5
    sigma.
    """
    fits = [fit_variogram(variogram(planted(TWO_PARTS, (200, 200), 0.1, KeyedRandom(seed)), 0.1)) for seed in range(4)]
    assert np.mean([fit.sill_m2 for fit in fits]) == pytest.approx(TWO_PARTS.sill_m2, rel=0.09)
    assert np.mean([fit.structures[0].range_m for fit in fits]) == pytest.approx(0.4, rel=0.14)
    assert np.mean([np.sqrt(fit.nugget_m2) for fit in fits]) == pytest.approx(0.003, abs=0.0012)


def test_two_lengths_are_told_apart() -> None:
    model = VariogramModel(0.0, (Structure("exponential", 4e-6, 0.3), Structure("exponential", 9e-6, 6.0)))
    lag = np.geomspace(0.05, 15, 24)
    fit = fit_variogram(variogram_of(model, lag))
    assert [part.family for part in fit.structures] == ["exponential", "exponential"]
    assert [part.range_m for part in fit.structures] == pytest.approx([0.3, 6.0], rel=0.02)
    assert [part.sill_m2 for part in fit.structures] == pytest.approx([4e-6, 9e-6], rel=0.02)


def variogram_of(model: VariogramModel, lag: FloatArray) -> Variogram:
    return Variogram(lag, model.semivariance(lag), np.ones(len(lag)))


def test_white_noise_is_a_nugget_and_every_pixel_counts() -> None:
    fit = fit_variogram(variogram(KeyedRandom(1).generator().normal(0, 0.01, (300, 300)), 0.02))
    assert fit.sill_m2 == pytest.approx(1e-4, rel=0.02)
    mask = np.ones((40, 50), dtype=bool)
    assert effective_sample_size(VariogramModel(1e-4, ()), mask, 0.02) == pytest.approx(2000)


def test_variance_of_a_mean_by_simulation() -> None:
    """400 planted fields: the variance of their means has a relative standard error of sqrt(2 / 400) = 7 %; the limit is 3.5."""
    generator = KeyedRandom(8).generator()
    mask = generator.random((30, 30)) < 0.7
    means = [planted(TWO_PARTS, mask.shape, 0.05, KeyedRandom(9).child(number))[mask].mean() for number in range(400)]
    assert np.mean(np.square(means)) == pytest.approx(variance_of_mean(TWO_PARTS, mask, 0.05), rel=0.25)
    effective = effective_sample_size(TWO_PARTS, mask, 0.05)
    assert 1 < effective < 0.3 * np.count_nonzero(mask)


def test_nothing_to_compare_is_said() -> None:
    with pytest.raises(InputError, match="fewer than two pixels"):
        variogram(np.full((4, 4), np.nan), 0.1)


def test_several_rasters_are_pooled_within_each() -> None:
    """Constants that differ between rasters add no semivariance; the numbers of pairs are summed."""
    noise = KeyedRandom(4).generator().normal(0, 1, (3, 20, 30))
    one, three = variogram(noise[0], 1.0), variogram(noise + np.array([0.0, 50.0, -9.0])[:, None, None], 1.0)
    assert three.pairs == pytest.approx(3 * one.pairs)
    mean = np.mean([variogram(raster, 1.0).semivariance_m2 for raster in noise], axis=0)
    assert three.semivariance_m2 == pytest.approx(mean)
