"""The search's shared normal equations, against separate least-squares fits of the same columns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j0
from test_gap_shared_noise import NOISE, SIGMA, noisy, raster

from pipeline.change.robust import nmad
from pipeline.gap.mean.candidates import Candidate, SineGrid
from pipeline.gap.mean.design import Design
from pipeline.gap.mean.mean_model import MeanFit, MeanModel, _NormalEquations, _wavy
from pipeline.gap.mean.nonparametric_terms import harmonics, nonparametric_terms
from pipeline.gap.mean.projected_columns import WithinProducts
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.residuals import wall_blocks
from pipeline.gap.residuals.alignment import fit_pose, fit_pose_robustly
from pipeline.gap.residuals.correlated_noise import GridCorrelatedNoise
from scene.common.keyed_random import KeyedRandom


@pytest.fixture(scope="module")
def families() -> list[Candidate | SineGrid]:
    """Free forms along both axes, the linear ones of which stand for effects of the catalogue."""
    pixels = raster(48)
    found = [form for axis, name in enumerate(("image_x", "image_y")) for form in nonparametric_terms(name, pixels[:, axis])]
    return [replace(each, empirical=False) if isinstance(each, Candidate) and each.form == "line" else each for each in found]


@pytest.fixture(scope="module")
def design(families: list[Candidate | SineGrid]) -> Design:
    pixels = raster(48)
    field = GridCorrelatedNoise((NOISE,), pixels).node_field(len(pixels))
    residuals = noisy(1, pixels, np.asarray(field.weights @ np.linalg.cholesky(field.covariance)))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(wall_blocks, "_MOST_CELLS", 100)
        return Design.of(residuals, families, KeyedRandom(1))


def test_every_explanation_gains_beside_others_what_a_fit_of_both_gains(design: Design, monkeypatch: pytest.MonkeyPatch) -> None:
    """The likelihoods of all sets, computed by elimination, are those of all columns solved together.

    The candidates stand beside nothing, an effect, a non-parametric term and a sine. Of the sines every fiftieth is tested; their
    products are computed in another way once they are fixed.
    """

    def unmoved(_: Design, candidates: list[Candidate]) -> tuple[list[Candidate], MeanFit | None]:
        return candidates, None

    monkeypatch.setattr(Design, "fit_refined", unmoved)
    plain = design.families.plain
    effect, form, sine = plain[0], next(each for each in plain if each.form == "parabola"), design.families.sines[7]
    assert not effect.empirical
    for members in ([], [effect], [form], [sine, effect], [form, sine]):
        beside = design
        for each in members:
            beside = beside.conditioned_on(each)
        base = beside.columns(members)
        alone, fixed, searched = beside.equations.profile_log_likelihood(base, beside.plain_columns)
        assert alone[0] == pytest.approx(beside.equations.log_likelihood(base).max(), rel=1e-9)
        others = [row for row, each in enumerate(plain) if each not in members]
        expected = [beside.equations.log_likelihood([*base, *beside.column_numbers[plain[row]]]).max() for row in others]
        np.testing.assert_allclose(fixed[others, 0], expected, atol=1e-5)
        for number in range(30, len(searched), 50):
            one = beside.families.sines[number]
            both = beside.conditioned_on(one)
            assert searched[number, 0] == pytest.approx(
                both.equations.log_likelihood(both.columns([*members, one])).max(), abs=1e-5
            )


def test_a_search_asks_for_a_set_of_effects_once(
    families: list[Candidate | SineGrid], design: Design, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wall_blocks, "_MOST_CELLS", 100)
    search = MeanSearch(design.residuals, families, KeyedRandom(1))
    first = search.score_families(())
    assert search._profile(()) is search._profile(())
    assert search._profile((first[0].candidate,)) is search._profile((first[0].candidate,))
    assert search.score_families(())[0].candidate is first[0].candidate


@pytest.mark.parametrize("told", [6, 4])
def test_the_pose_is_that_of_least_squares_however_many_points(design: Design, told: int) -> None:
    """2,049 to 20,000 points, in blocks and not; also where one pose parameter has no influence and another repeats the first."""
    random = np.random.default_rng(3)
    for count in (2_304, 2_049, 20_000):
        rows = random.integers(0, len(design.residuals), count)
        part = design.residuals.part(rows)
        pose = random.standard_normal((count, 6)) * [1, 10, 1e-3, 1, 1, 1]
        pose[:, told:] = np.stack([np.zeros(count), pose[:, 0]], axis=1)[:, : 6 - told]
        part = replace(part, pose_jacobian=pose, value=pose @ np.arange(1.0, 7.0) + random.standard_normal(count))
        expected = np.linalg.lstsq(pose / SIGMA, part.value / SIGMA, rcond=None)[0]
        np.testing.assert_allclose(fit_pose(part, np.ones(count, dtype=bool)), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("told", [6, 4])
def test_the_robust_pose_is_that_of_repeated_least_squares_without_the_outliers(design: Design, told: int) -> None:
    """One point in ten is an outlier of about 20 sigmas, one in seven is unusable; also with two undetermined parameters."""
    random, rows = np.random.default_rng(4), np.arange(len(design.residuals))
    pose = random.standard_normal((len(rows), 6)) * [1, 10, 1e-3, 1, 1, 1]
    pose[:, told:] = np.stack([np.zeros(len(rows)), pose[:, 0]], axis=1)[:, : 6 - told]
    value = pose @ np.arange(1.0, 7.0) + SIGMA * random.standard_normal(len(rows)) * np.where(rows % 10, 1, 20)
    usable = rows % 7 > 0
    part = replace(design.residuals, pose_jacobian=pose, value=np.where(usable, value, np.nan), usable=usable)
    kept, scale = usable, 1.0
    for _ in range(6):
        found = np.linalg.lstsq(pose[kept], value[kept], rcond=None)[0]
        z = np.abs(value - pose @ found) / SIGMA
        scale = nmad(z[usable], 0.0)
        kept = usable & (z < 3.5 * scale)
    left, expected, ratio = fit_pose_robustly(part)
    assert kept.sum() < 0.95 * usable.sum()
    np.testing.assert_allclose(expected, found, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(left[usable], (value - pose @ found)[usable], atol=1e-9)
    assert ratio == pytest.approx(max(scale, 1.0), rel=1e-9)


def test_covariances_that_are_kept_are_those_that_were_likely(design: Design) -> None:
    """Leaving out unlikely covariances of the reference's error keeps the largest likelihood.

    The reference is wrong by waves of 3.5 cells. The likelihood is that with the pose alone.
    """
    random, at = np.random.default_rng(2), design.residuals.wall_xy
    angle, phase = random.uniform(0, 2 * np.pi, (2, 12))
    waves = np.cos(2 * np.pi / (3.5 * design.cells.side_m) * (at @ np.stack([np.cos(angle), np.sin(angle)])) + phase)
    wrong = design.residuals.value + 0.5 * waves.sum(axis=1)
    whole = MeanModel(design.cells, at, design.residuals.sigma, design.residuals.correlated_noise)
    rows, root = whole.rows, whole.inverse_sigma[:, None]
    of_all = [whole.project(part[rows] * root) for part in (design.residuals.pose_jacobian, wrong[:, None])]
    products = WithinProducts.of(*of_all)
    highest = max(_NormalEquations(*of_all, products).log_likelihood(each) for each in whole.covariances)
    model, covariances, kept = whole.restrict(*of_all, products, of_all[0].within.shape[1])
    assert 0 not in kept
    normal = _NormalEquations(*(each.in_bases(kept) for each in of_all), products)
    assert max(normal.log_likelihood(each) for each in covariances) == pytest.approx(highest, abs=1e-6)
    assert max(normal.log_likelihood(each) for each in model.covariances) == pytest.approx(highest, abs=1e-6)


@pytest.mark.parametrize("count", [100, 100_000])
def test_the_correlation_of_waves_is_exact_whether_interpolated_or_not(count: int) -> None:
    distance = np.random.default_rng(1).uniform(0, 40, count)
    exact = np.mean([j0(2 * np.pi * distance / wave) for wave in 1.7 * np.geomspace(0.7, 1.9, 6)], axis=0)
    np.testing.assert_allclose(_wavy((0.7, 1.9, 6), 1.7, distance), exact, atol=1e-7)


def test_a_term_that_was_added_to_the_model_can_be_fitted_again(design: Design, families: list[Candidate | SineGrid]) -> None:
    """Overtones of a sine are no family, but become columns of the design when others are scored beside them."""
    sine = next(each for each in families if isinstance(each, SineGrid)).candidates[3]
    overtones = harmonics("image_x", sine, 3)
    beside = design.conditioned_on(overtones)
    assert beside.fit([overtones]).log_likelihood == pytest.approx(design.fit([overtones]).log_likelihood, abs=1e-6)
