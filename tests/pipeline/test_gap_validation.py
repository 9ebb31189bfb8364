"""The last step of `gap`: which points count in the scores on validation points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from gap_cases import Array, Scan, write_scan

from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.naming.named_effects import NamedEffect
from pipeline.gap.naming.validation import Validation
from pipeline.gap.residuals.alignment import align
from pipeline.gap.residuals.wall_blocks import WallCells
from scene.common.keyed_random import KeyedRandom


def _biased(coefficient_m: float) -> Callable[[Scan], Array]:
    """Return a function that makes ranges grow with the incidence angle."""
    return lambda scan: scan.R + coefficient_m * (1 / scan.cos_i - 1)


def _validation(folder: Path, ranges: Callable[[Scan], Array]) -> Validation:
    """Return the input for measuring a gap, for a scan with the given ranges."""
    write_scan(folder, 8, ranges=ranges, step_rad=0.007)
    there, residuals, _ = align(read_measurement(folder))
    held_out = WallCells.over(residuals.wall_xy).blocks.for_validation(residuals.wall_xy)
    return Validation(
        measurement=there,
        residuals=residuals,
        registration_rows=np.flatnonzero(residuals.usable & ~held_out),
        tested=residuals.usable & held_out,
        training=residuals.usable & ~held_out,
        losses=None,
        reference_sigma=0.0004,
        most_sigmas=20.0,
        random=KeyedRandom(1),
    )


@pytest.fixture(scope="module")
def validation_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[float], Validation]:
    """`_validation` of a bias by the incidence, once for each coefficient."""
    return cache(lambda coefficient_m: _validation(tmp_path_factory.mktemp("biased"), _biased(coefficient_m)))


def _named(name: str, key: str, value: float) -> NamedEffect:
    return NamedEffect(f"tls.{name}", "physical", {"name": name, key: value}, {}, (), 0.001, 10.0)


def test_drops_are_no_harm_to_ranges_on_the_wall(validation_of: Callable[[float], Validation]) -> None:
    """Early returns from rain do no harm to the score of ranges on the wall.

    A fifth of what rain removes comes back from drops before the wall, which say nothing about ranges on the wall.
    """
    true = _named("range_incidence_bias", "coefficient_m", 0.01)
    rain = {"name": "precipitation", "rate_per_m": 2e-3, "early_share": 0.2}
    drops = replace(_named("precipitation", "rate_per_m", 2e-3), entry=rain)
    validation = validation_of(0.01)
    alone = validation.validate([true])
    result = validation.validate([true, drops])
    assert result.gap == alone.gap
    assert [effect.name for effect in result.model.effects] == ["range_incidence_bias", "precipitation"]


def test_a_few_points_far_off_do_not_stand_for_the_wall(tmp_path: Path) -> None:
    """A term moves a strip of 4 % of the wall by 30 cm, where half of the points are: it neither improves nor harms.

    The gap shows a bias of some millimetres beside it; the strip's own points would make it 23 mm.
    """
    middle, half = 1.5, 0.02

    def moved(scan: Scan) -> Array:
        strip = np.abs(scan.az - middle) < half
        return scan.R + 0.01 * (1 / scan.cos_i - 1) + 0.3 * (strip & (scan.rng.uniform(size=len(strip)) < 0.5))

    validation = _validation(tmp_path, moved)
    along = {"low": middle - half, "high": middle + half}
    strip = {"name": "range_empirical", "covariate": "azimuth", "along": along, "values_m": [[0.0, *[0.3] * 30, 0.0]]}
    described = NamedEffect("tls.range_empirical", "empirical", strip, {}, (), 0.001, 10.0)
    result = validation.validate([_named("range_incidence_bias", "coefficient_m", 0.01), described])
    assert result.gap is not None
    assert result.gap.after < result.gap.before < 0.012
