"""Varied settings (benchmarks/varied.py): a value that carries alternatives notes the decisions made with it, and what it cannot
follow.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from benchmarks.varied import Setting, Varied

LOW, HIGH = ("limit", 0.7), ("limit", 1.4)


def limit(matters: set[Setting], value: float = 10.0) -> Varied:
    return Varied(value, {LOW: 0.7 * value, HIGH: 1.4 * value}, matters)


@pytest.mark.parametrize(
    ("measured", "expected"),
    [
        (3.0, set()),  # below all three
        (20.0, set()),
        (8.0, {LOW}),
        (12.0, {HIGH}),
        (np.array([3.0, 20.0]), set()),
        (np.array([3.0, 8.0]), {LOW}),
        (np.array([8.0, 12.0]), {LOW, HIGH}),
    ],
)
def test_a_comparison_notes_the_values_that_would_decide_otherwise(measured: object, expected: set[Setting]) -> None:
    matters: set[Setting] = set()
    assert_array_equal(measured > limit(matters), measured > 10.0)  # type: ignore[operator]
    assert_array_equal(limit(matters) <= measured, measured >= 10.0)  # type: ignore[operator]
    assert matters == expected


def test_what_is_computed_with_it_carries_all_values() -> None:
    """2 (limit + 1) - 3, by the array and by the scalar: 19, 13 and 27; also a root, a maximum and a power."""
    matters: set[Setting] = set()
    shifted = np.float64(2.0) * (limit(matters) + 1) - 3
    assert isinstance(shifted, Varied)
    assert shifted.value == 19.0
    assert shifted.others == {LOW: pytest.approx(13.0), HIGH: pytest.approx(27.0)}
    assert not shifted > 30.0
    assert not matters
    assert np.sqrt(np.maximum(limit(matters), [1.0, 2.0])).value == pytest.approx(np.sqrt(10.0))
    assert (1 / limit(matters) ** 2 < 0.02 * np.ones(3)).all()
    assert matters == {LOW}  # 1 / 49 is no longer below 0.02


def test_of_two_settings_each_is_noted_for_itself() -> None:
    matters: set[Setting] = set()
    share = Varied(0.1, {("share", 1.4): 0.14}, matters)
    assert max(limit(matters), share * 50.0).value == 10.0
    assert not matters  # 10 beats 5, 7 beats 5, 10 beats 7
    assert max(limit(matters), share * 80.0).value == 10.0
    assert matters == {LOW, ("share", 1.4)}


@pytest.mark.parametrize("look", [float, np.asarray, str, hash, lambda each: np.linspace(0.0, each, 5), lambda each: each.real])
def test_what_cannot_be_followed_counts_as_making_a_difference(look: object) -> None:
    matters: set[Setting] = set()
    look(limit(matters))  # type: ignore[operator]
    assert matters == {LOW, HIGH}
