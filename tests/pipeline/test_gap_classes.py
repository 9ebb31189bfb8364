"""Equivalence classes: refitted effects are compared on the points that all of them use."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.gap.mean.candidates import Candidate
from pipeline.gap.mean.selection import FamilyScore, SelectedEffect
from pipeline.gap.naming import nonlinear_refit
from pipeline.gap.naming.named_effects import Estimate
from pipeline.gap.naming.nonlinear_refit import (
    _best_variants,
    _gain_over,
    _one_suffices,
    _ranked_on_common_points,
    _Refit,
    _with_equivalence_class,
)
from pipeline.gap.naming.search_outcome import SearchOutcome

CHI2: Any = SimpleNamespace(design=SimpleNamespace(log_likelihood=lambda value, _: -0.5 * float(value @ value)))
"""Stands for a search whose likelihood is that of white noise."""


def estimated(name: str, alike: tuple[str, ...] = (), scores: tuple[FamilyScore, ...] = ()) -> Estimate:
    """Return an effect with a log-likelihood ratio of 200, for which effects within a score of 3 cannot be told apart.

    alike: the class that a search gave it; scores: those of all effects in its place.
    """
    candidate = Candidate(name, np.zeros((1, 1)), lambda _: {}, ("a",))
    return Estimate(SelectedEffect(candidate, alike, 0.002, 200.0, 199.0, scores), candidate, np.zeros(1), np.eye(1))


def fit(name: str, value: list[float], used: list[bool], alike: tuple[str, ...] = ()) -> _Refit:
    """Return a fit with the given residuals; what is not used counts as 0. alike: its class in the linearised search."""
    kept, estimate = np.array(used), estimated(name, alike)
    values, absent = np.where(kept, value, 0.0), Any
    return _Refit((estimate,), absent, absent, values, kept, CHI2.design.log_likelihood(values, None))  # type: ignore[arg-type]


def test_a_fit_that_leaves_out_outliers_is_not_favoured() -> None:
    """By all of its points the first seems better by 11 and alone in its class; on common points the second is, by 1.5."""
    leaves_out = fit("tilt_drift", [2.0, 0.0, 5.0], [True, True, False])
    keeps = fit("trunnion_tilt", [1.0, 0.0, 5.0], [True, True, True])
    assert leaves_out.log_likelihood - keeps.log_likelihood == pytest.approx(11.0)
    ranked = _ranked_on_common_points([leaves_out, keeps], CHI2)
    assert [each.name for each in ranked] == ["trunnion_tilt", "tilt_drift"]
    assert _gain_over(keeps, leaves_out, CHI2) == pytest.approx(1.5)
    assert _with_equivalence_class(ranked).estimates[0].chosen.indistinguishable == ("tilt_drift",)


def test_effects_that_leave_out_points_do_not_keep_a_better_one_from_being_refitted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three effects leave out the second point, where the fourth is wrong by 5, and are worse than it at the first."""
    monkeypatch.setattr(nonlinear_refit, "_converged", lambda _given, _first, each: each)
    found = [*(fit(name, [2.0, 0.0], [True, False]) for name in "abc"), fit("d", [1.0, 5.0], [True, True])]
    given: Any = None
    assert _best_variants(given, CHI2, found)[0].name == "d"


def test_clearly_different_fits_are_no_class() -> None:
    ranked = _ranked_on_common_points([fit("a", [0.0, 5.0], [True, True]), fit("b", [0.0, 1.0], [True, True])], CHI2)
    assert [each.name for each in ranked] == ["b", "a"]
    assert _with_equivalence_class(ranked).estimates[0].chosen.indistinguishable == ()


@pytest.mark.parametrize(("worse", "alike"), [(3.5, ("a",)), (6.5, ())])
def test_what_the_linearised_search_could_not_tell_apart_must_differ_clearly(worse: float, alike: tuple[str, ...]) -> None:
    """Effect a stays in the class of b up to a difference of 6, and effect c, which was told apart before, up to 3."""
    away = float(np.sqrt(2 * worse))
    ranked = [fit("b", [0.0], [True], ("a",)), fit("a", [away], [True]), fit("c", [away], [True])]
    assert _with_equivalence_class(ranked).estimates[0].chosen.indistinguishable == alike


@pytest.mark.parametrize(("refitted", "linearised", "significant"), [(20.0, 0.0, False), (20.0, 20.0, True), (0.0, 20.0, True)])
def test_a_refitted_effect_must_explain_more_than_chance(refitted: float, linearised: float, significant: bool) -> None:
    """Smaller residuals raise the score of 199, larger ones lower it, to -1, 199 and 399; a score above 10 is significant."""
    search: Any = SimpleNamespace(
        design=CHI2.design, score_alone=lambda _: 199.0, p_value=lambda score: 0.002 if score > 10 else 0.5
    )
    given: Any = SimpleNamespace(part=SimpleNamespace(value=np.array([linearised, 90.0])))
    assert fit("a", [refitted, 0.0], [True, False]).is_significant(given, search) == significant


def outcome(estimates: list[Estimate], together: bool = True, p_value: float | None = None) -> SearchOutcome:
    """Return an explanation of residuals by some effects.

    together: whether one search selected all of them; p_value: of the misfit that it leaves.
    """
    first, search = [each.chosen for each in estimates], SimpleNamespace(goodness_of_fit_p_value=lambda _: p_value)
    return SearchOutcome(first if together else first[:1], estimates, search, Any, [], ())  # type: ignore[arg-type]


@pytest.mark.parametrize(("left_by_a", "left_by_b", "named"), [(0.4, 0.002, "a"), (0.4, 0.3, "b"), (0.002, 0.002, "b")])
def test_fewer_effects_are_no_alternative_if_they_leave_a_misfit_that_more_do_not(
    monkeypatch: pytest.MonkeyPatch, left_by_a: float, left_by_b: float, named: str
) -> None:
    """The best explanation has two effects, another one has one."""
    best = outcome([estimated("a"), estimated("x")], together=False, p_value=left_by_a)
    alone = outcome([estimated("b")], p_value=left_by_b)
    monkeypatch.setattr(nonlinear_refit, "_search_beside", lambda *_: alone)
    monkeypatch.setattr(nonlinear_refit, "_within_bounds", lambda *_: True)
    nothing: Any = None
    assert nonlinear_refit._simpler(nothing, best, alone, ties=False) is (best if named == "a" else alone)


@pytest.mark.parametrize(
    ("left_by_one", "p_value", "strong", "second_is_empirical", "suffices"),
    [
        (1.0, 0.4, True, False, True),
        (5.0, 0.4, True, False, False),
        (5.0, 0.4, False, False, True),
        (1.0, 0.002, False, False, False),
        (5.0, 0.002, True, True, True),
    ],
)
def test_one_effect_stands_for_two_only_if_these_do_not_explain_significantly_more(
    monkeypatch: pytest.MonkeyPatch, left_by_one: float, p_value: float, strong: bool, second_is_empirical: bool, suffices: bool
) -> None:
    """The two leave neither residuals nor a misfit, and the second one costs 1.

    A score of 10 is significant, and residuals of 5 cost 12.5. p_value: of the misfit that the one effect leaves.
    """
    both = [estimated("a"), estimated("b")]
    second = replace(both[1], candidate=replace(both[1].candidate, empirical=second_is_empirical))
    together = replace(fit("a", [0.0], [True]), estimates=(both[0], second))
    monkeypatch.setattr(nonlinear_refit._Refit, "of", lambda *_: together)
    monkeypatch.setattr(nonlinear_refit, "_converged", lambda _given, _first, each: each)
    search: Any = SimpleNamespace(design=CHI2.design, p_value=lambda score: 0.002 if score > 10 else 0.5)
    one, alone = outcome([estimated("c")], p_value=p_value), fit("c", [left_by_one], [True])
    given: Any = None
    linear = outcome([both[0], second], p_value=0.4)
    assert _one_suffices(given, search, linear, one, alone if strong else None) == suffices
