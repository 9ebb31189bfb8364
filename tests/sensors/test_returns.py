"""Several returns of one pulse: at a step edge in closed form, and against what the other modes record."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from surfaces import step
from test_beam import LIGHT, axis_at, beam, edge, scan_with, terraces
from test_tls import scanner

from scene.common.keyed_random import KeyedRandom
from scene.ray_casting.raycast import RayCaster
from sensors.laser.tls import Pattern
from sensors.signal_chain.beam import unit_offsets
from sensors.signal_chain.observation import FurtherReturns, Observation

DIVERGENCE = 2e-3
PATTERN = Pattern(-0.03, 2e-4, 240, np.pi / 2 - 0.01, 1e-3, 20)


def further_of(seen: Observation) -> FurtherReturns:
    assert seen.further is not None
    return seen.further


def on_terraces(mode: str, *effects: dict[str, Any], noise: dict[str, float] | None = None, width: float = 3e-9) -> Observation:
    sensor = scanner(noise=noise, effects=[*beam(8e-3, mode=mode, pulse_width_s=width), *effects])
    return scan_with(sensor, terraces(), PATTERN)


@pytest.mark.parametrize("beyond", [1.001, 1.5, 4.0])
def test_a_step_farther_than_the_pulses_length_gives_two_returns_on_its_two_planes(beyond: float) -> None:
    """Where the beam hits both planes there are two returns, the nearer numbered 1."""
    near, far = beyond * LIGHT * 3e-9 / 2, 0.0
    seen = edge(step(near, far), DIVERGENCE, mode="multiple")
    further = further_of(seen)
    z = np.concatenate([further.points[:, 2], seen.points.reshape(-1, 3)[further.cell, 2]])
    number = np.concatenate([further.number, seen.further.grid_number.ravel()[further.cell]])
    assert np.abs(z - np.where(number == 1, near, far)).max() < 5e-4  # R tan i D / 2: a part of the beam lies off its axis
    across = np.sort(unit_offsets(19)[:, 0]) * DIVERGENCE
    angle = axis_at(seen, near)[0] / (axis_at(seen, near)[1])
    clear = np.abs(angle[..., None] - across).min(axis=-1) > 1e-6
    straddles = (angle > across[0]) & (angle < across[-1])
    np.testing.assert_array_equal((further.grid_count == 2)[clear], straddles[clear])
    assert straddles.mean() > 0.2


def test_a_step_within_the_pulses_length_gives_one_merged_centroid() -> None:
    """A step of 0.999 c tau / 2 measured along the beam, which is longer than in z by less than 1e-4 here."""
    mesh = step(0.999 * LIGHT * 3e-9 / 2, 0.0)
    seen, merged = edge(mesh, DIVERGENCE, mode="multiple"), edge(mesh, DIVERGENCE, mode="mean")
    assert seen.further is None
    np.testing.assert_array_equal(seen.depth, merged.depth)


@pytest.mark.parametrize("width", [3e-9, 8e-9])
def test_all_returns_together_are_those_of_the_other_modes(width: float) -> None:
    """The grid is that of `strongest`; number 1 is `first`; powers add up to those of `mean`, and so do ranges weighted
    by power.
    """
    seen, first, strongest, mean = (on_terraces(mode, width=width) for mode in ("multiple", "first", "strongest", "mean"))
    further = further_of(seen)
    assert seen.points.tobytes() == strongest.points.tobytes()
    nearest = np.where(further.grid_number == 1, seen.depth, np.nan).ravel()
    nearest[further.cell[further.number == 1]] = further.depth[further.number == 1]
    np.testing.assert_allclose(nearest, first.depth.ravel(), atol=1e-9)
    power, moment = (np.nan_to_num(values).ravel().astype(float) for values in (seen.intensity, seen.intensity * seen.depth))
    power += np.bincount(further.cell, further.intensity, power.size)
    moment += np.bincount(further.cell, further.intensity * further.depth, power.size)
    valid = mean.valid.ravel()
    np.testing.assert_allclose(power[valid], mean.intensity.ravel()[valid], rtol=1e-5)
    np.testing.assert_allclose((moment / np.where(valid, power, 1))[valid], mean.depth.ravel()[valid], atol=2e-5)
    assert further.grid_count.max() >= 2


def numbers_run_from_one_to_the_count(seen: Observation) -> None:
    further = further_of(seen)
    in_grid = np.flatnonzero(seen.valid)
    cell = np.concatenate([in_grid, further.cell])
    number = np.concatenate([further.grid_number.ravel()[in_grid], further.number])
    depth = np.concatenate([seen.depth.ravel()[in_grid], further.depth])
    order = np.lexsort((number, cell))
    cell, number, depth = cell[order], number[order], depth[order]
    starts = np.flatnonzero(np.diff(cell, prepend=-1))
    np.testing.assert_array_equal(number, np.arange(cell.size) - np.repeat(starts, np.diff(starts, append=cell.size)) + 1)
    np.testing.assert_array_equal(np.bincount(cell)[in_grid], further.grid_count.ravel()[in_grid])
    assert (np.diff(depth)[np.diff(cell) == 0] > 0).all()


def test_numbers_run_from_one_to_the_count_also_where_returns_are_too_weak() -> None:
    whole, limited = on_terraces("multiple"), on_terraces("multiple", {"name": "detection_limit", "minimum_power": 0.3})
    for seen in (whole, limited):
        numbers_run_from_one_to_the_count(seen)
    assert further_of(limited).intensity.min() >= 0.3
    assert 0 < len(limited.further.cell) < len(whole.further.cell)


def test_every_return_has_noise_of_its_own() -> None:
    """Residuals of the two returns of a pulse: standard deviation to 5 standard errors, correlation within 5 of zero (1e-6)."""
    sigma, quiet, noisy = 0.01, *(edge_scan(noise) for noise in (0.0, 0.01))
    further = further_of(noisy)
    np.testing.assert_array_equal(further.cell, further_of(quiet).cell)
    second = (further.depth - quiet.further.depth) / sigma
    first = ((noisy.depth - quiet.depth) / sigma).ravel()[further.cell]
    error = 5 / np.sqrt(len(second))
    assert second.std() == pytest.approx(1, abs=error)
    assert abs(np.mean(first * second)) < error


def edge_scan(range_sigma_m: float) -> Observation:
    sensor = scanner({"range_sigma_m": range_sigma_m, "angle_sigma_rad": 0.0}, effects=beam(DIVERGENCE, mode="multiple"))
    return scan_with(sensor, step(1.5, 0.0), Pattern(0.003, 2e-5, 300, np.pi / 2 - 0.0012, 2e-4, 40))


def test_the_truth_comes_with_every_return_and_a_scan_repeats_to_the_byte() -> None:
    first, second = (on_terraces("multiple", noise={"range_sigma_m": 0.01, "angle_sigma_rad": 1e-4}) for _ in range(2))
    further = further_of(first)
    for name in ("points", "depth", "block", "intensity", "number"):
        assert getattr(further, name).tobytes() == getattr(further_of(second), name).tobytes()
    assert np.abs(further.truth["true_range_m"] - further.depth).max() < 0.06
    assert set(further.block) <= set(range(1, 7))


@pytest.mark.parametrize("changes", [{"sub_rays": 1}, {"ranging": "phase"}])
def test_a_pencil_and_a_phase_scanner_have_one_return(changes: dict[str, Any]) -> None:
    sensor = scanner(effects=beam(DIVERGENCE, mode="multiple", **changes))
    assert sensor.observe(RayCaster(terraces()), KeyedRandom(1)).further is None
