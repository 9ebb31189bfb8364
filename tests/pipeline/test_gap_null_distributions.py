"""The p-values of all statistics that the diagnosis tests are (nearly) uniform where the model is right.

Each is tested by Kolmogorov-Smirnov at 0.1 %, which the right distribution fails for one seed in a thousand. Each statistic must
also reject an error that is present.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.stats import kstest
from threadpoolctl import threadpool_limits

from pipeline.gap.mean.nonparametric_terms import nonparametric_terms
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.noise_and_edges.grid_noise import _variogram
from pipeline.gap.noise_and_edges.sign_flips import null_p_value
from pipeline.gap.residuals import wall_blocks
from pipeline.gap.residuals.correlated_noise import GridCorrelatedNoise
from pipeline.gap.residuals.nominal_pair import PixelGeometry
from pipeline.gap.residuals.ray_hits import RayGeometry
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from pipeline.gap.residuals.wall_blocks import BlockGrid
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.regularization_noise import RegularizationNoise
from sensors.models.sensor_model import StereoModel, StereoNoise

SIDE = 50
SIGMA = 0.003


def over_the_wall(side: int = SIDE, step: float = 0.1) -> FloatArray:
    """Return slightly irregular places (n, 2) on the wall, m."""
    at = step * np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    return np.asarray(at + np.random.default_rng(1).uniform(-0.4 * step, 0.4 * step, at.shape))


def ranges(value: FloatArray, at: FloatArray) -> TlsResiduals:
    """Return residuals of a scan; the pose is a plane over the wall."""
    nothing, every = np.zeros(len(at)), np.ones(len(at), dtype=bool)
    pose = np.stack([np.ones(len(at)), at[:, 0], at[:, 1]], axis=1)
    covariates = {"azimuth": 0.02 * at[:, 0], "zenith": 0.02 * at[:, 1]}
    geometry = RayGeometry(*[nothing] * 6, nothing, nothing)
    unit, number = np.ones(len(at)), np.arange(len(at))
    return TlsResiduals(value, np.full(len(at), SIGMA), unit, every, every, pose, at, covariates, number, geometry)


def of_the_mean(count: int, reference: float, length_m: float, added: float = 0.0) -> list[float]:
    """Return p-values of the remainder, for white noise beside an error of the reference; added: a curve of the azimuth."""
    at = over_the_wall()
    root = np.linalg.cholesky(np.exp(-0.5 * (cdist(at, at) / length_m) ** 2) + 1e-8 * np.eye(len(at)))
    found = []
    for seed in range(count):
        random = np.random.default_rng(seed)
        value = SIGMA * random.standard_normal(len(at)) + reference * root @ random.standard_normal(len(at))
        residuals = ranges(value + added * np.sin(2 * np.pi * at[:, 0] / 1.7), at)
        families = [form for name, values in residuals.covariates.items() for form in nonparametric_terms(name, values)]
        with threadpool_limits(1, "blas"):  # as `diagnose` has it
            search = MeanSearch(residuals, families, KeyedRandom(seed))
            found.append(search.p_value(search.score_families(())[0].score))
    return found


@pytest.mark.parametrize(("reference", "length_m"), [(0.0, 1.0), (0.002, 1.0)])
def test_of_a_mean_of_ranges(monkeypatch: pytest.MonkeyPatch, reference: float, length_m: float) -> None:
    """Cells of 0.5 m, ranges of 3 mm; the reference's error (m) is correlated over two cells.

    The second is what is reached: it passes, but 11 of its 40 lie below 0.05.
    """
    monkeypatch.setattr(wall_blocks, "_MOST_CELLS", 100)
    found = of_the_mean(40, reference, length_m)
    assert kstest(found, "uniform").pvalue > 0.001, sorted(found)


def test_of_a_mean_that_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wall_blocks, "_MOST_CELLS", 100)
    assert max(of_the_mean(4, 0.002, 1.0, added=0.002)) < 0.01


def of_long_waves(count: int, length_m: float, amplitude: float) -> list[float]:
    """Return p-values of the remainder, for white noise beside waves of the reference in all directions.

    The waves have nearly one length, like the error of a surface whose longer waves were fitted away. They are summed directly,
    without any covariance of the mean model.
    """
    at = over_the_wall()
    found = []
    for seed in range(count):
        random = np.random.default_rng(seed)
        angle, phase = random.uniform(0, np.pi, 40), random.uniform(0, 2 * np.pi, 40)
        turns = 2 * np.pi / (length_m * random.uniform(0.9, 1.1, 40))
        waves = np.sin(at @ (turns * np.stack([np.cos(angle), np.sin(angle)])) + phase)
        error = amplitude * waves @ random.standard_normal(40) / np.sqrt(20)
        residuals = ranges(SIGMA * random.standard_normal(len(at)) + error, at)
        families = [form for name, values in residuals.covariates.items() for form in nonparametric_terms(name, values)]
        with threadpool_limits(1, "blas"):  # as `diagnose` has it
            search = MeanSearch(residuals, families, KeyedRandom(seed))
            found.append(search.p_value(search.score_families(())[0].score))
    return found


def test_of_a_mean_beside_long_waves_of_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells of 0.25 m; the waves of the reference are 9 cells long, and as large as the noise of a range."""
    monkeypatch.setattr(wall_blocks, "_MOST_CELLS", 400)
    found = of_long_waves(20, 2.25, SIGMA)
    assert kstest(found, "uniform").pvalue > 0.001, sorted(found)


def of_the_spread(count: int, excess: float) -> list[float]:
    """Return p-values of a variance that grows over the wall, of one that is constant and of one of few points."""
    at = over_the_wall()
    block = BlockGrid(np.zeros(2), 0.45).numbers(at)
    forms = [np.ones(len(at)), at[:, 0], np.exp(-at[:, 1])]
    found = []
    for seed in range(count):
        z = np.random.default_rng(seed).standard_normal(len(at)) * np.sqrt(1 + excess * at[:, 0] / at[:, 0].max())
        found.append(null_p_value(z**2, forms, block, KeyedRandom(seed)))
    return found


def test_of_a_spread() -> None:
    found = of_the_spread(200, 0.0)
    assert kstest(found, "uniform").pvalue > 0.001, sorted(found)


def test_of_a_spread_that_is_there() -> None:
    assert max(of_the_spread(4, 0.5)) < 0.01


def of_nodes(count: int, sigma_px: float) -> list[float]:
    """Return p-values of grid noise in disparities that have only the model's white noise."""
    pixels = 4.0 * np.stack(np.meshgrid(np.arange(120.0), np.arange(120.0)), axis=-1).reshape(-1, 2)
    number, every = np.arange(len(pixels)), np.ones(len(pixels), dtype=bool)
    zero = np.zeros(len(pixels))
    geometry = PixelGeometry(pixels[:, 0], pixels[:, 1], *[zero] * 10)
    model = StereoModel(noise=StereoNoise(parallax_sigma_px=0.3, regularization_sigma_px=0.0))
    field = GridCorrelatedNoise((RegularizationNoise(sigma_px=1.0, step_px=32.0),), pixels).node_field(len(pixels))
    nodes = sigma_px * np.linalg.cholesky(field.covariance)
    found = []
    for seed in range(count):
        random = np.random.default_rng(seed)
        value = 0.3 * random.standard_normal(len(pixels)) + field.weights @ nodes @ random.standard_normal(len(nodes))
        part = StereoResiduals(
            value, np.full(len(pixels), 0.3), np.full(len(pixels), 0.01), every, every, np.ones((len(pixels), 1)),
            pixels / 40, {}, number, geometry,
        )  # fmt: skip
        variogram = _variogram(part, value, model)
        assert variogram is not None
        found.append(variogram.p_value(KeyedRandom(seed)))
    return found


@pytest.mark.parametrize("count", [12, 60])
def test_of_noise_on_nodes(count: int) -> None:
    found = of_nodes(count, 0.0)
    assert kstest(found, "uniform").pvalue > 0.001, sorted(found)


def test_of_noise_on_nodes_that_is_there() -> None:
    assert max(of_nodes(4, 0.25)) < 0.01
