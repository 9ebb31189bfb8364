"""The last step of `gap`: named effects that make the model predict worse are removed, those that improve it are kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from gap_cases import Array, Scan, write_scan

from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.naming.gap_score import Gap
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


def test_a_harmful_effect_is_taken_out_and_a_true_one_stays(validation_of: Callable[[float], Validation]) -> None:
    """Beside a true effect a noise of ten times the true one is named that is not there."""
    true, wrong = _named("range_incidence_bias", "coefficient_m", 0.01), _named("range_noise", "sigma_m", 0.03)
    result, words = validation_of(0.01).validate([wrong, true])
    assert result.named == [true]
    assert words == ["tls.range_noise dropped: the model predicts worse with it"]
    assert result.gap is not None
    assert (result.gap.closed or 0.0) > 0.8


@pytest.mark.parametrize(
    ("name", "key", "value", "kind", "kept"),
    [
        ("range_noise", "sigma_m", 0.0015, "physical", 0),
        ("range_noise", "sigma_m", 0.0015, "empirical", 0),
        ("range_incidence_bias", "coefficient_m", -0.02, "empirical", 0),
        ("range_incidence_bias", "coefficient_m", 0.003, "physical", 1),
    ],
)
def test_an_effect_that_does_little_harm_is_taken_out_too(
    validation_of: Callable[[float], Validation], name: str, key: str, value: float, kind: str, kept: int
) -> None:
    """An effect that does slight harm is dropped, and so is an empirical term that does clear harm.

    Noise that is half as large again does no more harm than chance would, and is dropped whether it has a name or not. An effect
    of that size that is real stays.
    """
    result, _ = validation_of(0.003).validate([replace(_named(name, key, value), kind=kind)])
    assert len(result.named) == kept


def test_drops_are_no_harm_to_ranges_on_the_wall(validation_of: Callable[[float], Validation]) -> None:
    """Early returns from rain do no harm to the score of ranges on the wall.

    A fifth of what rain removes comes back from drops before the wall, which say nothing about ranges on the wall.
    """
    true = _named("range_incidence_bias", "coefficient_m", 0.01)
    rain = {"name": "precipitation", "rate_per_m": 2e-3, "early_share": 0.2}
    drops = replace(_named("precipitation", "rate_per_m", 2e-3), entry=rain)
    validation = validation_of(0.01)
    alone, _ = validation.validate([true])
    result, words = validation.validate([true, drops])
    assert (result.named, words) == ([true, drops], [])
    assert result.gap == alone.gap
    assert [effect.name for effect in result.model.effects] == ["range_incidence_bias", "precipitation"]


def test_harm_is_that_of_the_same_points(validation_of: Callable[[float], Validation], monkeypatch: pytest.MonkeyPatch) -> None:
    """An effect brings points near that were too far off to count: without it all of these score 7 mm, with it 3.

    That the others score 1 mm alone, and a few validation edges score worse, does not count against it.
    """
    validation = validation_of(0.003)
    with_it, alone = {True: (0.009, 0.011), False: (0.007, 0.003)}, {True: (0.001, 0.001), False: (0.001, 0.001)}

    def scored(self: Validation, named: list[NamedEffect], versions: object, rows: np.ndarray) -> Gap:
        before, after = (with_it if named else alone)[rows is validation.tested]
        return Gap(before, after, floor=0.0006, error=0.0075, floor_error=0.0075, points=100)

    monkeypatch.setattr(Validation, "_gap", scored)
    effect = _named("range_incidence_bias", "coefficient_m", 0.003)
    result, words = validation.validate([effect])
    assert result.named == [effect]
    assert not words


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
    result, _ = validation.validate([_named("range_incidence_bias", "coefficient_m", 0.01), described])
    assert result.gap is not None
    assert result.gap.after < result.gap.before < 0.012
