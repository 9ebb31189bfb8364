"""Equivalence classes: refitted effects are compared on the points that all of them use."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.gap.mean.candidates import Candidate
from pipeline.gap.mean.selection import SelectedEffect
from pipeline.gap.naming.named_effects import Estimate
from pipeline.gap.naming.nonlinear_refit import _gain_over, _ranked_on_common_points, _SingleFit, _with_equivalence_class

CHI2: Any = SimpleNamespace(design=SimpleNamespace(log_likelihood=lambda value, _: -0.5 * float(value @ value)))
"""Stands for a search whose likelihood is that of white noise."""


def fit(name: str, value: list[float], used: list[bool]) -> _SingleFit:
    """Return a fit with the given residuals; what is not used counts as 0."""
    kept, nothing = np.array(used), np.zeros(1)
    candidate = Candidate(name, nothing[:, None], lambda _: {}, ("a",))
    estimate = Estimate(SelectedEffect(candidate, (), 0.002, 200.0, 199.0, ()), candidate, nothing, np.eye(1))
    values, absent = np.where(kept, value, 0.0), Any
    return _SingleFit(estimate, absent, absent, values, kept, CHI2.design.log_likelihood(values, None))  # type: ignore[arg-type]


def test_a_fit_that_leaves_out_outliers_is_not_favoured() -> None:
    """By all of its points the first seems better by 11 and alone in its class; on common points the second is, by 1.5."""
    leaves_out = fit("tilt_drift", [2.0, 0.0, 5.0], [True, True, False])
    keeps = fit("trunnion_tilt", [1.0, 0.0, 5.0], [True, True, True])
    assert leaves_out.log_likelihood - keeps.log_likelihood == pytest.approx(11.0)
    ranked = _ranked_on_common_points([leaves_out, keeps], CHI2)
    assert [each.name for each in ranked] == ["trunnion_tilt", "tilt_drift"]
    assert _gain_over(keeps, leaves_out, CHI2) == pytest.approx(1.5)
    assert _with_equivalence_class(ranked).estimate.chosen.indistinguishable == ("tilt_drift",)


def test_clearly_different_fits_are_no_class() -> None:
    ranked = _ranked_on_common_points([fit("a", [0.0, 5.0], [True, True]), fit("b", [0.0, 1.0], [True, True])], CHI2)
    assert [each.name for each in ranked] == ["b", "a"]
    assert _with_equivalence_class(ranked).estimate.chosen.indistinguishable == ()
