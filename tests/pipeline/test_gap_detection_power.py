"""Detectable sizes: against the noncentral chi-square distribution, and by effects of that size put into new measurements."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gap_cases import write_scan
from scipy.stats import ncx2
from threadpoolctl import threadpool_limits

from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.mean.candidates import Candidate, SineGrid
from pipeline.gap.mean.detection_power import DetectableSize, noncentrality
from pipeline.gap.mean.nonparametric_terms import nonparametric_terms, spatial_null_candidates
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.naming.workflow import diagnose
from pipeline.gap.residuals import wall_blocks
from pipeline.gap.residuals.nominal_pair import PixelGeometry
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.thresholds import Thresholds, read_thresholds, use_thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

SIDE, SIGMA = 48, 0.3
NAME = "affinity_skew"
CALM = read_thresholds(["mean.most_reference_error=1e-9"])


def bump(at: FloatArray) -> FloatArray:
    """Return the signature of the effect: a wide bump beside the middle, which the pose does not absorb."""
    return np.exp(-0.5 * ((at - np.array([3.0, 2.0])) ** 2).sum(axis=1))


def measured(seed: int, size: float, reference: float) -> StereoResiduals:
    """Return residuals of white noise, an error of the reference in random waves of 1 to 2 m, and the effect in a given size."""
    random = np.random.default_rng(seed)
    at = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), axis=-1).reshape(-1, 2) / 8.0
    waves = 0.5 + 0.5 * random.uniform(size=30)
    angle, phase = random.uniform(0, 2 * np.pi, (2, 30))
    along = at @ np.stack([np.cos(angle), np.sin(angle)])
    error = np.sqrt(2 / 30) * np.sin(2 * np.pi * waves * along + phase).sum(axis=1)
    value = SIGMA * random.standard_normal(len(at)) + reference * error + size * bump(at)
    pose = np.stack([np.ones(len(at)), at[:, 0], at[:, 1]], axis=1)
    every, count = np.ones(len(at), dtype=bool), len(at)
    geometry = PixelGeometry(*[np.zeros(count)] * 12)
    covariates = {"image_x": at[:, 0], "image_y": at[:, 1]}
    sigma, unit = np.full(count, SIGMA), np.full(count, 0.1)
    return StereoResiduals(value, sigma, unit, every, every, pose, at, covariates, np.arange(count), geometry)


def searched(residuals: StereoResiduals, seed: int) -> MeanSearch:
    """Return a search of the effect, non-parametric terms and spatial null candidates."""
    at = residuals.wall_xy
    effect = Candidate(NAME, bump(at)[:, None], lambda c: {"b1_px": float(c[0])}, ("b1_px",))
    families: list[Candidate | SineGrid] = [effect, *nonparametric_terms("image_x", at[:, 0]), *spatial_null_candidates(at)]
    with threadpool_limits(1, "blas"):
        return MeanSearch(residuals, families, KeyedRandom(seed))


def size_of(search: MeanSearch) -> DetectableSize:
    """Return the detectable size of the effect."""
    found = search.detectable_sizes([], search.score_families(()), KeyedRandom(9))
    return next(each for each in found if each.name == NAME)


@pytest.fixture
def few_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wall_blocks, "_MOST_CELLS", 100)


@pytest.mark.parametrize("columns", [1, 2, 6])
def test_the_noncentrality_gives_the_power(columns: int) -> None:
    draws = np.random.default_rng(1).standard_normal((200_000, columns))
    shift = np.sqrt(noncentrality(9.0, columns))
    assert np.mean(0.5 * ((draws[:, 0] + shift) ** 2 + (draws[:, 1:] ** 2).sum(axis=1)) >= 9.0) == pytest.approx(0.95, abs=0.002)
    assert ncx2.sf(18.0, columns, shift**2) == pytest.approx(0.95, abs=1e-6)


@pytest.mark.usefixtures("few_cells")
def test_without_an_error_of_the_reference_the_size_is_that_of_the_noncentral_distribution() -> None:
    """The information of the bump beside the pose, by least squares; 499 simulations give the size to 4 %."""
    residuals = measured(1, 0.0, 0.0)
    with use_thresholds(CALM):
        search = searched(residuals, 1)
        found = size_of(search)
        score = search._null.critical_score(Thresholds().verdict.rejection_p)
    design = np.concatenate([residuals.pose_jacobian, bump(residuals.wall_xy)[:, None]], axis=1) / SIGMA
    std = np.sqrt(np.linalg.inv(design.T @ design)[3, 3])
    expected = std * np.sqrt(noncentrality(score + search._null.penalty(NAME), 1))
    assert found.size == pytest.approx(expected, rel=0.1)
    assert found.parameter == "b1_px"


def rejected_share(seeds: range, of_size: float) -> float:
    """Return the share of new measurements with an effect that reject the model. of_size: its size over the detectable one."""
    found = 0
    for seed in seeds:
        size = size_of(searched(measured(seed, 0.0, 0.08), seed)).size
        search = searched(measured(1000 + seed, of_size * size, 0.08), seed)
        p_value = search.goodness_of_fit_p_value(search.score_families(()))
        found += p_value is not None and p_value <= Thresholds().verdict.rejection_p
    return found / len(seeds)


@pytest.mark.usefixtures("few_cells")
def test_an_effect_of_the_detectable_size_shows() -> None:
    """Fewer than six of seven would be a chance of 4 %."""
    assert rejected_share(range(7), 1.0) >= 6 / 7


@pytest.mark.usefixtures("few_cells")
def test_of_effects_of_the_detectable_size_95_percent_show() -> None:
    """The share of 120 scatters by 2 %; at a third of the size few show."""
    assert 0.90 <= rejected_share(range(120), 1.0) <= 0.99
    assert rejected_share(range(40), 1 / 3) < 0.4


@pytest.mark.usefixtures("few_cells")
def test_a_better_reference_shows_smaller_effects() -> None:
    """The error of a reference that is known to be better is limited in the fit too."""
    rough, calm = (searched(measured(3, 0.0, error), 3) for error in (0.2, 0.0))
    assert size_of(calm).size < 0.7 * size_of(rough).size
    assert rough.design.reference_sigma([]) > 0.1
    with use_thresholds(read_thresholds(["mean.most_reference_error=0.002"])):
        assert searched(measured(3, 0.0, 0.2), 3).design.reference_sigma([]) <= 0.02 + 1e-9


def test_effects_of_the_detectable_size_are_not_answered_by_no_gap(tmp_path: Path) -> None:
    """Whole diagnoses of scans: of 24 with an effect of its detectable size at least 20 are not answered by no_gap.

    Fewer would be a chance of 1 in 700 where 95 % show.
    """
    shown = 0
    for seed in range(12):
        write_scan(tmp_path, seed, step_rad=0.008)
        sizes = {each.name: each.size for each in diagnose(read_measurement(tmp_path)).unseen}
        offset, bias = sizes["range_offset"], sizes["range_incidence_bias"]
        for ranges in (lambda scan: scan.R + offset, lambda scan: scan.R + bias * (1 / scan.cos_i - 1)):  # noqa: B023
            write_scan(tmp_path, seed, step_rad=0.008, ranges=ranges)
            shown += diagnose(read_measurement(tmp_path)).verdict != "no_gap"
    assert shown >= 20
