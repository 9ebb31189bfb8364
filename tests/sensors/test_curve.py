"""Interpolation of empirical terms, compared with NumPy's own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.interpolate import RegularGridInterpolator

from scene.common.backend import mi
from scene.common.config import parse
from scene.common.errors import InputError
from sensors.effects.range_empirical import RangeEmpirical
from sensors.numerics.curve import Axis, interpolate, interpolate_on_host


@dataclass(frozen=True)
class Case:
    """A curve or surface, the places where it is evaluated, and the expected values."""

    along: Axis
    across: Axis
    values: tuple[tuple[float, ...], ...]
    expected: Any


def cases(x: Any, y: Any) -> dict[str, Case]:
    """Return cases of a curve, of a periodic one and of a surface."""
    rng = np.random.default_rng(1)
    row, table = rng.standard_normal(7), rng.standard_normal((4, 6))
    grid = RegularGridInterpolator((np.linspace(-1, 1, 4), np.linspace(-2, 2, 6)), table)
    inside = np.clip(y, -1, 1), np.clip(x, -2, 2)
    return {
        "curve": Case(Axis(low=-1.5, high=2), Axis(), (tuple(row),), np.interp(x, np.linspace(-1.5, 2, 7), row)),
        "cycle": Case(
            Axis(low=0, high=0.7, period=0.7), Axis(), (tuple(row),), np.interp(np.mod(x, 0.7), np.linspace(0, 0.7, 7), row)
        ),
        "surface": Case(Axis(low=-2, high=2), Axis(low=-1, high=1), tuple(map(tuple, table)), grid(inside)),
    }


@pytest.mark.parametrize("name", ["curve", "cycle", "surface"])
def test_values_between_nodes_and_beyond(name: str) -> None:
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-3, 3, 500), rng.uniform(-1.5, 1.5, 500)
    case = cases(x, y)[name]
    on_device = interpolate(mi.Float64(x), mi.Float64(y), case.along, case.across, case.values)
    np.testing.assert_allclose(np.array(on_device), case.expected, atol=1e-12)
    np.testing.assert_allclose(interpolate_on_host(x, y, case.along, case.across, case.values), case.expected, atol=1e-12)


def test_rows_of_different_length_are_an_error_that_says_so() -> None:
    entry = {"name": "range_empirical", "values_m": [[0.0, 1.0], [0.0]]}
    with pytest.raises(InputError, match="rows of one length"):
        parse(RangeEmpirical, entry, "model.yaml")


def test_an_axis_that_runs_backwards_is_an_error() -> None:
    with pytest.raises(InputError, match="low < high"):
        parse(RangeEmpirical, {"name": "range_empirical", "along": {"low": 1.0, "high": 0.0}}, "model.yaml")


def test_what_is_not_known_stays_unknown_on_the_host():
    """A ray that misses the reference has no covariate and gets no value; its neighbours keep theirs."""
    axis = Axis(low=0.0, high=1.0)
    x = np.array([0.25, np.nan, 0.75])
    assert_allclose(interpolate_on_host(x, x, axis, Axis(), [[0.0, 1.0]]), x)
