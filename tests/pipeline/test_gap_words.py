"""Numbers as the reports of `gap` show them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest

from pipeline.gap.naming.named_effects import NamedEffect
from pipeline.gap.report.advice import advice_on, page_of
from pipeline.gap.report.wording import _COVARIATES, covariate_with_unit, format_decimal, format_number, round_entry
from pipeline.gap.residuals import stereo_residuals, tls_residuals
from sensors.effects import STEREO_EFFECTS, TLS_EFFECTS
from sensors.effects.angle_empirical import AngleEmpirical
from sensors.effects.base import Effect
from sensors.effects.disparity_empirical import DisparityEmpirical
from sensors.effects.range_empirical import RangeEmpirical


@pytest.mark.parametrize(
    ("value", "digits", "shown"),
    [(0.0082523077, 4, "0.008252"), (104.0, 2, "100"), (12345.678, 4, "12350"), (2.78e-10, 2, "2.8e-10"), (0.0, 4, "0")],
)
def test_numbers_are_plain_and_short(value: float, digits: int, shown: str) -> None:
    assert format_number(value, digits) == shown


def test_a_gain_has_one_decimal_where_that_means_something() -> None:
    assert [format_decimal(value) for value in (812.0, -0.26, 43139.9, 123456.0)] == [
        "812.0",
        "\N{MINUS SIGN}0.3",
        "43140",
        "123460",
    ]


def test_rounding_goes_into_tables_and_leaves_all_but_fractions_alone() -> None:
    entry = {"name": "empirical", "bins": 8, "values_m": [[0.123456789, 2.0]], "step": {"low": -1.2345678}}
    assert round_entry(entry) == {"name": "empirical", "bins": 8, "values_m": [[0.12346, 2.0]], "step": {"low": -1.2346}}


def test_covariates_have_the_unit_of_their_sensor() -> None:
    assert [covariate_with_unit("edge_step", sensor) for sensor in ("tls", "stereo")] == [
        "step beside the point, m",
        "step beside the point, px",
    ]
    assert covariate_with_unit("zenith", "tls") == "zenith, rad"


def test_every_covariate_has_words() -> None:
    """Those of the residuals of both sensors, and those that empirical effects may be written along."""
    one, axis = np.ones(3), np.tile([0.0, 0.0, 1.0], (3, 1))
    rays = SimpleNamespace(range_m=one, azimuth=one, zenith=one, cos_incidence=one, power=one, line=one, share=one)
    pixels = SimpleNamespace(point=axis, normal=axis, u=one, v=one, radius=one, disparity=one, found=one)
    pair = SimpleNamespace(pair=SimpleNamespace(left=SimpleNamespace(position=np.zeros(3))))
    about = SimpleNamespace(edge_px=one)
    names = {*tls_residuals._covariates(rays, one), *stereo_residuals._covariates(pair, pixels, one, about), "log_power"}
    for kind in (RangeEmpirical, DisparityEmpirical, AngleEmpirical):
        names |= set(get_args(kind.model_fields["covariate"].annotation))
    assert names <= set(_COVARIATES)
    assert not any("_" in words or "_" in unit for words, unit in _COVARIATES.values())


@pytest.mark.parametrize("effect", [*TLS_EFFECTS, *STEREO_EFFECTS], ids=lambda effect: effect.__name__)
def test_every_effect_of_the_catalogue_says_what_it_means_and_what_to_do(effect: type[Effect]) -> None:
    assert all(text[0].isupper() and text.endswith(".") and len(text) > 25 for text in (effect.means, effect.act))
    assert page_of(f"reference/effects/{effect.sensor}.{effect.model_fields['name'].default}").startswith("file://")


def test_a_cause_outside_the_catalogue_has_general_advice() -> None:
    term = NamedEffect("tls.range_empirical", "empirical", {"name": "range_empirical"}, {}, (), None, 9.0)
    assert "not in the catalogue" in advice_on(term).means
    assert (
        "Simulate with model_after.yaml" in advice_on(NamedEffect("tls.range_empirical", "physical", {}, {}, (), None, 9.0)).act
    )
    assert page_of("reference/effects/tls.nothing") == ""
