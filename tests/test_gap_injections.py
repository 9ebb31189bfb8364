"""Known effects put into real scans: the formulas against closed forms, the scores, and one injection through the diagnosis."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks.gap_injections import bases, cases, formulas, run
from benchmarks.gap_injections.formulas import Matched, Optics, Scan, in_raster, matched, scanned
from benchmarks.gap_injections.score import SIZES, BeforeInjection, scored

RNG = np.random.default_rng(0)
REAL = pytest.mark.skipif(not bases.DATA.exists(), reason="the shared data are not here")


def test_the_formulas_share_no_code_with_the_project() -> None:
    tree = ast.parse(Path(formulas.__file__).read_text())
    modules = {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    modules |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert not {module.split(".")[0] for module in modules} & {"scene", "sensors", "pipeline"}


@pytest.fixture
def scan() -> Scan:
    """A scan of a horizontal plane 1.5 m below the scanner, on which 1 / cos i = R / 1.5."""
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(1, 4, 30), np.linspace(-1, 1, 30)))
    points = np.stack([x, y, np.full(x.shape, -1.5)], axis=1)
    return Scan.of(points, points, np.arange(len(x)) // 30, 2.0 + x)


def test_the_incidence_is_that_of_the_plane(scan: Scan) -> None:
    assert_allclose(1 / scan.cos_i, scan.R / 1.5)
    assert_allclose(scan.local[:, 2], -1.5)


@pytest.mark.parametrize("case", cases.CASES, ids=lambda case: f"{case.number} {case.effect}")
def test_every_case_has_a_formula_and_a_size(case: cases.Case, scan: Scan) -> None:
    assert case.base in bases.BASES
    if not case.effect.startswith("off_"):
        assert SIZES[case.effect] in case.values
    if case.base not in ("light", "matcher"):
        assert np.isfinite(scanned(case.effect, case.values, scan, RNG).local).all()
    elif case.effect in formulas.IN_RASTER:
        assert np.isfinite(in_raster(case.effect, case.values, np.ones((40, 50)), RNG)).all()
    else:
        seen = Matched(np.arange(9.0), np.arange(9.0), np.full(9, 20.3))
        assert np.isfinite(matched(case.effect, case.values, seen, bases.OPTICS, RNG).d).all()


@pytest.mark.parametrize(
    ("name", "values", "column", "expected"),
    [
        ("range_cyclic", {"amplitude_m": 0.1, "period_m": 2.0, "phase_rad": 0.3}, "R", lambda s: 0.1 * np.sin(np.pi * s.R + 0.3)),
        ("range_incidence_bias", {"coefficient_m": 0.1}, "R", lambda s: 0.1 * (s.R / 1.5 - 1)),
        ("trunnion_tilt", {"angle_rad": 0.1}, "az", lambda s: 0.1 * np.cos(s.ze) / np.sin(s.ze)),
        (
            "wobble",
            {"amplitude_rad": 0.1, "lines_per_cycle": 4.0, "phase_rad": 0.0},
            "ze",
            lambda s: 0.1 * np.sin(np.pi / 2 * s.line),
        ),
        ("range_intensity_bias", {"coefficient_m": 0.1}, "R", lambda s: 0.1 * np.log(s.power / np.median(s.power))),
    ],
)  # fmt: skip
def test_recorded_is_true_plus_effect(name: str, values: Any, column: str, expected: Any, scan: Scan) -> None:
    found = scanned(name, values, scan, RNG)
    assert_allclose(getattr(found, column) - getattr(scan, column), expected(scan), atol=1e-12)


def test_a_moved_image_moves_disparity_and_place() -> None:
    seen, optics = Matched(np.array([110.5]), np.array([60.5]), np.array([20.0])), Optics(1000.0, 10.0, 10.0, 0.0)
    found = matched("focal_length", {"delta_px": 10.0}, seen, optics, RNG)
    assert_allclose([found.u[0], found.v[0], found.d[0]], [111.5, 61.0, 21.0])


def answer(effect: str, values: Any, *effects: Any, verdict: str = "named") -> Any:
    case = {"number": 1, "base": "ground_1", "effect": effect, "values": values}
    return {"case": case, "strength": 9.0, "verdict": verdict, "effects": list(effects)}


def said(name: str, key: str, value: float, std: float, alike: Any = (), kind: str = "physical") -> Any:
    parameters = {key: {"value": value, "std": std}}
    return {"name": f"tls.{name}", "kind": kind, "cannot_be_told_from": list(alike), "parameters": parameters}


OFFSET = {"offset_m": 0.01}


@pytest.mark.parametrize(
    ("effects", "expected"),
    [
        ([said("range_offset", "offset_m", 0.011, 1e-4)], "right"),  # within 15 %
        ([said("range_offset", "offset_m", 0.013, 2e-3)], "right"),  # within three standard errors
        ([said("range_offset", "offset_m", 0.013, 1e-4)], "size"),
        ([said("range_scale", "scale_ppm", 9.0, 1.0)], "wrong"),
        ([said("range_scale", "scale_ppm", 9.0, 1.0, ["tls.range_offset"])], "class"),
        ([said("range_offset", "offset_m", 0.01, 1e-4), said("wobble", "amplitude_rad", 1.0, 0.1)], "wrong"),
        ([said("range_offset", "offset_m", 0.01, 1e-4), said("range_empirical", "bins", 1.0, 0.1, (), "empirical")], "right"),
        ([said("range_offset", "offset_m", 0.011, 1e-4, (), "empirical")], "described"),
        ([said("range_empirical", "bins", 1.0, 0.1, (), "empirical")], "missed"),
        ([], "missed"),
    ],
)
def test_answers_are_scored_by_name_and_size(effects: Any, expected: str) -> None:
    assert scored(answer("range_offset", OFFSET, *effects))["judgement"] == expected


def test_what_was_there_before_is_not_blamed_on_the_injection() -> None:
    wobble = said("wobble", "amplitude_rad", 1.0, 0.1)
    both = answer("range_offset", OFFSET, said("range_offset", "offset_m", 0.01, 1e-4), wobble)
    assert scored(both, BeforeInjection({"wobble": wobble}))["judgement"] == "right"
    assert scored(both, BeforeInjection({"collimation": wobble}))["judgement"] == "wrong"
    alike = said("collimation", "angle_rad", 1.0, 0.1, ["tls.wobble"])
    assert scored(both, BeforeInjection({"collimation": alike}))["judgement"] == "right"


def test_what_was_there_before_adds_to_the_injection() -> None:
    found = answer("range_offset", OFFSET, said("range_offset", "offset_m", 0.03, 1e-4))
    assert scored(found)["judgement"] == "size"
    assert scored(found, BeforeInjection({"range_offset": said("range_offset", "offset_m", 0.02, 1e-4)}))["judgement"] == "right"


@pytest.mark.parametrize(("factor", "expected"), [(1.0, "size"), (1.5, "right")])
def test_noise_that_the_model_lacked_before_adds_to_the_injection(factor: float, expected: str) -> None:
    found = answer("range_noise", {"sigma_m": 0.02}, said("range_noise", "sigma_m", 0.03, 1e-4))
    assert scored(found, BeforeInjection(missing_noise=factor))["judgement"] == expected


def test_noises_of_other_exponents_are_compared_at_one_intensity() -> None:
    injected = {"a_m": 0.03 * 201.0**0.7, "exponent": -0.7}
    found = said("range_noise_intensity", "a_m", 0.03 * 201.0**0.5, 1e-4)
    found["parameters"]["exponent"] = {"value": -0.5, "std": None}
    assert scored(answer("range_noise_intensity", injected, found))["judgement"] == "right"


def test_what_is_in_no_catalogue_is_right_where_nothing_is_blamed() -> None:
    assert scored(answer("off_jump", {"size_m": 0.01}, verdict="unknown"))["judgement"] == "right"
    assert scored(answer("off_jump", {"size_m": 0.01}, verdict="no_gap"))["judgement"] == "missed"
    assert scored(answer("off_jump", {"size_m": 0.01}, said("wobble", "amplitude_rad", 1.0, 0.1)))["judgement"] == "wrong"


@REAL
@pytest.mark.slow
def test_a_wobble_put_into_a_real_scan_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scan is 20 degrees of forest ground; the wobble has 0.4 mrad over 6.5 lines."""
    small = bases.Base("small", "", bases.forest((-170, -150), (108, 131)), bases.put_scanned)
    monkeypatch.setitem(bases.BASES, "small", small)
    values = {"amplitude_rad": 4e-4, "lines_per_cycle": 6.5, "phase_rad": 0.5}
    found = scored(run.answered(cases.Case(1, "small", "wobble", values), tmp_path))
    assert found["judgement"] == "right"
    assert found["strength"] > 30
