"""Outliers: how many there are, where they lie, and what may be concluded about an instrument from them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.gap.naming import workflow
from pipeline.gap.naming.named_effects import NamedEffect
from pipeline.gap.noise_and_edges.heavy_tails import find_heavy_tails
from pipeline.gap.residuals.wall_blocks import BlockGrid
from sensors.effects.range_noise import RangeNoise

POINTS, BLOCKS = 30_000, 100


def _residuals(share: float, uneven: bool, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return normal residuals of which a share is ten times as wide: at random, or in one block of six."""
    rng = np.random.default_rng(seed)
    block = rng.integers(0, BLOCKS, POINTS)
    chance = np.where(block % 6 == 0, 6 * share, 0.0) if uneven else share
    wide = rng.random(POINTS) < chance
    return rng.standard_normal(POINTS) * np.where(wide, 10.0, 1.0), block


def test_normal_residuals_have_no_tails() -> None:
    assert find_heavy_tails(*_residuals(0.0, False)) is None


@pytest.mark.parametrize("uneven", [False, True])
def test_where_far_points_lie_says_whose_they_are(uneven: bool) -> None:
    """Of 3 % with ten times the width a share of 0.689 lies beyond 4: P(|z| > 0.4)."""
    found = find_heavy_tails(*_residuals(0.03, uneven))
    assert found is not None
    assert found.uniform is not uneven
    assert found.share == pytest.approx(0.03 * 0.689, rel=0.15)
    assert ("all over the wall" in found.note) is not uneven
    assert f"{100 * found.share:.2g} % of the points lie beyond 4 standard deviations" in found.note


@pytest.mark.parametrize(("named", "base"), [(False, 0.002), (True, 0.001)])
def test_noise_for_far_points_explains_the_scatter_of_all(monkeypatch: pytest.MonkeyPatch, named: bool, base: float) -> None:
    """Noise added to that of the model without a noise term gives the standard deviation of the residuals.

    They are predicted with 2 mm; the core has 3 mm, and 3 % are ten times as wide. A noise term that is named explains the core
    down to 1 mm, and is replaced.
    """
    z, block = _residuals(0.03, False)
    at = np.stack([block + 0.5, np.full(POINTS, 0.5)], axis=1)

    def smooth(_: Any, effects: list[NamedEffect]) -> tuple[Any, np.ndarray, float]:
        without_term = named and not effects
        sigma = np.full(POINTS, base if without_term else 0.002)
        part = SimpleNamespace(sigma=sigma, wall_xy=at, sensor="tls", white_noise=(RangeNoise, "sigma_m"))
        return part, 0.003 * z, 1.0 if without_term else 1.5

    monkeypatch.setattr(workflow, "_smooth_residuals_with", smooth)
    monkeypatch.setattr(workflow, "only_within_bounds", lambda _, effects: (effects, []))
    noise = [NamedEffect("tls.range_noise_incidence", "physical", {"name": "range_noise_incidence"}, {}, (), None, 9.0)] * named
    there: Any = SimpleNamespace(model=None)
    (heavy,), _ = workflow._with_heavy_tails(there, noise, BlockGrid(np.zeros(2), 1.0))
    scatter = 0.003 * np.sqrt(np.mean(np.minimum(z**2, 144.0)))
    assert np.hypot(base, heavy.entry["sigma_m"]) == pytest.approx(scatter, rel=1e-6)


def test_what_far_points_gain_is_a_log_likelihood_and_not_their_number() -> None:
    """The gain of a mixture over a normal distribution, compared with the same densities written out."""
    z, block = _residuals(0.03, False)
    found = find_heavy_tails(z, block)
    assert found is not None
    cut = np.clip(z, -12, 12)
    far = np.abs(z) > 4
    wide = np.mean(cut[far] ** 2)
    share = far.mean()

    def density(value: Any, variance: float) -> Any:
        return np.exp(-0.5 * value**2 / variance) / np.sqrt(2 * np.pi * variance)

    mixed = (1 - share) * density(cut, 1.0) + share * density(cut, wide)
    assert found.gain == pytest.approx(np.sum(np.log(mixed / density(cut, 1.0))), rel=1e-6)
