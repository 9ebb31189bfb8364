"""The closed-form generator of measurements for `gap` (docs/validation/gap_closed_form.md), its scores, and a small run of it."""

from __future__ import annotations

import ast
import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.optimize import least_squares

from benchmarks.gap_closed_form import cases, stereo_cases, tls_effects
from benchmarks.gap_closed_form.casting import Surface
from benchmarks.gap_closed_form.run import run
from benchmarks.gap_closed_form.score import score
from benchmarks.gap_closed_form.stereo_cameras import INTERIOR, Frame, Pair, Rectified, looking_at
from benchmarks.gap_closed_form.stereo_effects import real_pair
from benchmarks.gap_closed_form.strength import Whitener, loss_distance, mean_strength, spread_distance
from benchmarks.gap_closed_form.table import markdown
from benchmarks.gap_closed_form.tls_effects import MEAN, SECOND, Rays
from benchmarks.gap_closed_form.walls import small_turn

FOLDER = Path(__file__).parents[1] / "benchmarks/gap_closed_form"
SQUARE = Surface(np.array([[-50.0, 0, -50], [50, 0, -50], [50, 0, 50], [-50, 0, 50]]), np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.py")), ids=lambda file: file.name)
def test_it_shares_no_code_with_the_sensors_or_the_diagnosis(file: Path) -> None:
    tree = ast.parse(file.read_text())
    modules = {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    modules |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert not {module.split(".")[0] for module in modules} & {
        "scene",
        "sensors",
        "pipeline",
        "mitsuba",
        "drjit",
        "importlib.util",
    }


def rays_on_the_square(n: int = 400) -> tuple[Rays, Any]:
    """Return rays from (3, -40, 2) to the plane y = 0, whose range is 40 / (sin z sin az), and that range as a function."""
    random = np.random.default_rng(1)
    az, ze = np.pi / 2 + random.uniform(-0.6, 0.6, n), np.pi / 2 + random.uniform(-0.5, 0.5, n)

    def range_at(azimuth: Any, zenith: Any) -> Any:
        return 40 / (np.sin(zenith) * np.sin(azimuth))

    R = range_at(az, ze)
    share = np.linspace(0, 1, n)
    return Rays(az, ze, R, 40 / R, 1 + share, np.floor(share * 60), share, -R / np.tan(az), -R / np.tan(ze)), range_at


def test_rays_meet_the_plane_where_they_should() -> None:
    rays, _ = rays_on_the_square()
    direction = np.stack([np.sin(rays.ze) * np.cos(rays.az), np.sin(rays.ze) * np.sin(rays.az), np.cos(rays.ze)], axis=1)
    distance, normal = SQUARE.cast(np.array([3.0, -40.0, 2.0]), direction)
    np.testing.assert_allclose(distance, rays.R, rtol=1e-12)
    np.testing.assert_allclose(normal, np.tile([0.0, -1.0, 0.0], (len(normal), 1)), atol=1e-12)


@pytest.mark.parametrize("name", MEAN)
def test_a_signature_is_the_change_of_the_recorded_range(name: str) -> None:
    """The beam leaves in the recorded direction minus the error; to first order, 1 arcsec leaves less than 1e-8 m."""
    rays, range_at = rays_on_the_square()
    p = tls_effects.shape(name, rays, np.random.default_rng(2))
    p = tls_effects.times(p, SECOND / (10 * SECOND))
    azimuth, zenith = tls_effects.angle_errors(name, p, rays)
    exact = range_at(rays.az - azimuth, rays.ze - zenith) - rays.R + tls_effects.range_errors(name, p, rays)
    assert np.abs(exact).max() > 1e-6
    np.testing.assert_allclose(tls_effects.signature(name, p, rays), exact, atol=1e-8)


@pytest.mark.parametrize("name", MEAN)
def test_each_effect_lies_in_its_own_family(name: str) -> None:
    """If its period is one of the grid's, an effect is a linear combination of its candidate's columns."""
    rays, _ = rays_on_the_square()
    families = tls_effects.families(rays, {"intensity", "pattern", "gps_time"})
    p = tls_effects.shape(name, rays, np.random.default_rng(3))
    if "lines_per_cycle" in p:
        p["lines_per_cycle"] = 7.0
    if "period_m" in p:
        p["period_m"] = 0.4
    shown = tls_effects.signature(name, p, rays)
    left = [shown - design @ np.linalg.lstsq(design, shown, rcond=None)[0] for design in families[name]]
    assert min(np.linalg.norm(each) for each in left) < 1e-9 * np.linalg.norm(shown)


def cameras() -> Pair:
    interior = dict.fromkeys(INTERIOR, 0.0) | {
        "f_px": 2500.0,
        "cx_px": 5.0,
        "b1": 0.7,
        "b2": -0.3,
        "k1": -0.06,
        "k2": 0.03,
        "p1": 2e-4,
    }
    stands = (np.array([-5.0, -60.0, 1.0]), np.array([5.0, -60.0, 0.0]))
    return Pair(*(Frame(1840, 1228, interior, stand, looking_at(stand, np.zeros(3), 0.01)) for stand in stands))


def test_pixels_and_rays_are_inverse_and_nominal_cameras_give_the_surface_back() -> None:
    pair = cameras()
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(100, 1700, 30), np.linspace(100, 1100, 20)))
    back = pair.left.project(pair.left.position + 50 * pair.left.rays(u, v))
    np.testing.assert_allclose(back, (u, v), atol=1e-8)
    nominal = Rectified(pair, 2500.0)
    u_right, v_right, points = pair.matches(SQUARE, u, v)
    seen = np.isfinite(points[:, 1])
    found = nominal.points(u, v, nominal.disparity(u, v, u_right, v_right))
    np.testing.assert_allclose(found[seen], points[seen], atol=1e-9)
    assert np.abs(points[seen, 1]).max() < 1e-9


def test_a_longer_principal_distance_brings_the_surface_nearer_by_its_share() -> None:
    """Both cameras of a normal pair have f wrong by df: Z_found = Z f / (f + df)."""
    interior = dict.fromkeys(INTERIOR, 0.0) | {"f_px": 2500.0}
    forward = looking_at(np.array([0.0, -60, 0]), np.zeros(3), 0.0)
    pair = Pair(*(Frame(1840, 1228, interior, np.array([x, -60.0, 0.0]), forward) for x in (-5.0, 5.0)))
    nominal, real = Rectified(pair, 2500.0), pair.each("both", lambda c: c.changed(f_px=2.5))
    u, v = np.array([900.0, 1100.0]), np.array([600.0, 700.0])
    u_right, v_right, _ = real.matches(SQUARE, u, v)
    depth = nominal.points(u, v, nominal.disparity(u, v, u_right, v_right))[:, 1] + 60
    np.testing.assert_allclose(depth, 60 * 2500 / 2502.5, rtol=1e-9)


def test_strength_of_an_offset_is_that_of_a_mean() -> None:
    """The signal-to-noise ratio of a constant a under white noise s is a sqrt(n) / s; identical effects are in one class."""
    random = np.random.default_rng(5)
    at, one = random.uniform(0, 30, (4000, 2)), np.ones((4000, 1))
    whiten = Whitener(np.full(4000, 0.003), at, np.zeros((4000, 1)))
    nothing = np.zeros((4000, 0))
    found = mean_strength("a", 0.001 * one[:, 0], nothing, {"a": [one], "b": [at[:, :1]], "c": [one * 2]}, whiten)
    assert found.snr == pytest.approx(0.001 * np.sqrt(4000) / 0.003, rel=1e-6)
    assert (found.alike, found.nearest) == (("c",), "b")


def test_distances_of_small_effects_are_those_of_their_likelihoods() -> None:
    """For a larger spread d^2 = n (excess)^2 / 2; for losses n (dp)^2 / (p (1 - p))."""
    one = np.ones(10_000)
    assert spread_distance(1.02 * one, one) == pytest.approx(np.sqrt(10_000 * 0.02**2 / 2), rel=0.02)
    assert loss_distance(0.103 * one, 0.1 * one) == pytest.approx(np.sqrt(10_000 * 0.003**2 / 0.09), rel=0.02)


def test_the_plan_holds_all_strata_and_tells_nothing_by_its_numbers() -> None:
    plan = cases.plan(300, 7)
    assert sorted(case.number for case in plan) == list(range(300))
    assert cases.plan(300, 7) == plan
    shares = {stratum: sum(case.stratum == stratum for case in plan) / 300 for stratum in cases.STRATA}
    assert shares == pytest.approx({"none": 0.2, "one": 0.4, "two": 0.15, "off": 0.15, "change": 0.1})
    seen = {(case.sensor, kind) for case in plan for kind in case.kinds}
    assert {name for sensor, name in seen if sensor == "tls"} >= set(tls_effects.MEAN) | set(tls_effects.SPREAD)
    order = np.array([case.stratum == "none" for case in plan], dtype=float)
    assert abs(np.corrcoef(order, np.arange(300))[0, 1]) < 0.2  # 3.5 sigma


def made(folder: Path, seed: int, stratum: str, sensor: str, kinds: tuple[str, ...]) -> dict[str, Any]:
    case = cases.Case(3, (seed, 0), stratum, sensor, kinds, 5000, 5000)
    cases.make(case, folder / "case", folder / "truth.json", baselines=False)
    return json.loads((folder / "truth.json").read_text())


def test_what_a_pose_leaves_of_an_effect_is_what_the_best_pose_leaves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A principal point is wrong by 10 px.

    What remains must be within a tenth of what scipy's trust region over the six pose parameters leaves.

    Linearised at the calibrated pose, more than three times that remains beside ledges.
    """
    asked: dict[str, Any] = {}

    def left(*of: Any) -> Any:
        asked["of"], asked["left"] = of, left_by_pose(*of)
        return asked["left"]

    left_by_pose = stereo_cases._left_by_pose
    monkeypatch.setattr(stereo_cases, "_left_by_pose", left)
    monkeypatch.setattr(stereo_cases.Target, "of", lambda *_: 1e-6)
    made(tmp_path, 60, "one", "stereo", ("principal_point_y",))
    scene, kind, p, part, base, whiten = asked["of"]
    assert p["delta_px"] == pytest.approx(10)

    def shown(pose: Any) -> Any:
        pair = scene.nominal.pair.moved(pose[:3], small_turn(pose[3:]))
        return whiten(stereo_cases._seen(scene, real_pair(pair, kind, p, scene.world), part))[:, 0]

    scale = np.array([1, 1, 1, 1e-2, 1e-2, 1e-2])
    best = least_squares(lambda units: shown(scale * units), np.zeros(6), diff_step=1e-3).fun
    least = np.linalg.norm(best)
    by_pose = mean_strength(kind, asked["left"], base, {}, whiten).snr
    assert by_pose == pytest.approx(least, rel=0.1)
    assert mean_strength(kind, stereo_cases._shown(scene, kind, p, part), base, {}, whiten).snr > 3 * by_pose


@pytest.mark.parametrize(("sensor", "kind"), [("tls", "range_incidence_bias"), ("stereo", "focal_length")])
def test_a_folder_does_not_tell_what_is_in_it(tmp_path: Path, sensor: str, kind: str) -> None:
    """With and without an effect there are the same files with the same keys; the same seed gives the same bytes."""
    folders = [tmp_path / name for name in ("with", "without", "again")]
    for folder, kinds in zip(folders, ((kind,), (), (kind,)), strict=True):
        folder.mkdir()
        truth = made(folder, 11, "one" if kinds else "none", sensor, kinds)
        assert [effect["name"] for effect in truth["effects"]] == list(kinds)
        assert yaml.safe_load((folder / "case/model.yaml").read_text())["effects"] == []
    settings = [yaml.safe_load((folder / "case/measurement.yaml").read_text()) for folder in folders]
    optional = {"pattern"}
    assert set(settings[0]) - optional == set(settings[1]) - optional
    text = "".join((folders[0] / "case" / name).read_text() for name in ("measurement.yaml", "model.yaml")) + str(settings[0])
    assert not any(word in text for word in (kind, "truth", "one", "effect_"))
    assert digest(folders[0]) == digest(folders[2])


def digest(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in (folder / "case").iterdir()}


def test_a_process_that_diagnoses_cannot_read_the_truth(tmp_path: Path) -> None:
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth/0001.json").write_text("{}")
    program = (
        "import sys; from pathlib import Path; from benchmarks.gap_closed_form.run import _guard\n"
        "hidden = Path(sys.argv[1]).resolve(); sys.addaudithook(_guard(hidden))\n"
        "open(sys.argv[2]).read()\nopen(hidden / '../truth/0001.json')"
    )
    words = [sys.executable, "-c", program, str(tmp_path / "truth"), str(FOLDER / "run.py")]
    result = subprocess.run(words, capture_output=True, text=True, check=False, cwd=FOLDER.parents[1])
    assert "PermissionError: the diagnosis may not look at" in result.stderr


def pair(stratum: str, true: str = "", said: str = "", others: tuple[str, ...] = (), verdict: str = "") -> tuple[Any, Any]:
    effects = (
        [{"name": true, "parameters": {"offset_m": 0.01}, "snr": 30.0, "nearest": "x", "snr_sin_angle": 20.0}] if true else []
    )
    closed = {name: {"fitted": share, "held_out": share} for name, share in ((true, 1.0), ("b", 0.03))}
    truth = {
        "number": 1, "sensor": "tls", "stratum": stratum, "points": 1, "fields": [], "known": [],
        "effects": effects, "changes": [],
        "baselines": {"largest_z": "", "plain_bic": ""}, "closed_by": closed if true else {},
    }  # fmt: skip
    entry = {"name": f"tls.{said}", "kind": "physical", "cannot_be_told_from": [f"tls.{o}" for o in others]}
    entry["parameters"] = {"offset_m": {"value": 0.0101, "std": 0.0001}}
    answer = {"verdict": verdict or ("named" if said else "no_gap"), "effects": [entry] if said else [], "gap": {"closed": 0.97}}
    return truth, answer


def figures_of(*pairs: tuple[Any, Any]) -> dict[str, Any]:
    return {row["what"].split(" at ")[0]: row for row in score(list(pairs))["figures"]}


def test_right_answers_score_well() -> None:
    found = figures_of(pair("one", "a", "a", ("c",)), pair("none"), pair("change"), pair("off", "off_a", verdict="unknown"))
    assert found["right class"]["value"] == 1.0
    assert found["wrong names among committed answers"]["value"] == 0.0
    assert found["false alarms on no-effect cases"]["reached"] == "undecided"  # one quiet case shows no 1 %
    assert found["off-catalogue effects answered unknown"]["value"] == 1.0
    assert found["90 % intervals that contain the true parameter"]["value"] == 1.0
    assert found["gap closed by the best wrong effect outside the class (median)"]["value"] == 0.03


def test_the_control_is_shown_beside_what_the_angle_lets_a_wrong_effect_close() -> None:
    """The nearest other effect can explain 1 - (20 / 30)^2 of the sum of squares.

    The true effect has S/N 30, of which 20 differ from that other effect.
    """
    near, far = pair("one", "a", "a", ("c",)), pair("one", "a", "a", ("c",))
    far[0]["effects"][0]["snr_sin_angle"] = 29.8
    far[0]["closed_by"]["b"] = {"fitted": 0.01, "held_out": 0.01}
    found = figures_of(near)
    by_angle = "the same, as the angle to the nearest other effect lets it (1 - sin^2, median)"
    assert found[by_angle]["value"] == pytest.approx(1 - (20 / 30) ** 2)
    alone = "the same, where that angle leaves it 5 %"
    assert found[alone]["value"] is None
    assert figures_of(near, far)[alone]["value"] == 0.01


@pytest.mark.parametrize(
    ("alarms", "cases", "reached"), [(0, 64, "undecided"), (0, 400, "yes"), (20, 64, "no"), (1, 64, "undecided")]
)
def test_what_an_interval_does_not_settle_is_undecided(alarms: int, cases: int, reached: str) -> None:
    """0 of 64 has the Wilson interval 0 to 5.7 %, 0 of 400 has 0 to 0.95 %."""
    found = figures_of(*([pair("none", said="a")] * alarms + [pair("none")] * (cases - alarms)))
    assert found["false alarms on no-effect cases"]["reached"] == reached


def test_wrong_answers_score_badly() -> None:
    every = (pair("one", "a", "b"), pair("none", said="a"), pair("change", said="a"), pair("off", "off_a", "a"))
    found = figures_of(*every)
    assert found["right class"]["value"] == 0.0
    assert found["wrong names among committed answers"]["value"] == 1.0
    assert found["false alarms on no-effect cases"]["value"] == 1.0
    assert found["real change blamed on the sensor"]["value"] == 1.0
    assert found["off-catalogue effects answered unknown"]["value"] == 0.0
    result = score(list(every))
    assert len(result["failures"]) == 4
    assert "wrong name" in markdown({"settings": {"cases": 4, "seed": 1, "small": False}, **result})


def test_a_small_effect_counts_only_where_it_could_be_told() -> None:
    truth, answer = pair("one", "a")
    truth["effects"][0]["snr_sin_angle"] = 2.0
    assert figures_of((truth, answer))["right class"]["value"] is None


def test_powers_and_slopes_are_part_of_a_ray() -> None:
    rays, _ = rays_on_the_square(10)
    assert replace(rays, power=2 * rays.power).part(slice(3)).power.shape == (3,)


@pytest.mark.slow
def test_a_small_run_over_all_strata_and_both_sensors(tmp_path: Path) -> None:
    """8 cases of a few thousand points.

    The limits leave room for chance: at the target rates (1 % false alarms, 2 % wrong names) each limit fails in less than 4 % of
    draws; the seed is fixed.
    """
    found = run(8, 20, 1, tmp_path, small=True)
    rows = found["rows"]
    assert {row["stratum"] for row in rows} == set(cases.STRATA)
    assert {row["sensor"] for row in rows} == {"tls", "stereo"}
    assert not [row["error"] for row in rows if row["error"]]
    quiet = [row for row in rows if row["stratum"] in ("none", "change")]
    assert sum(row["verdict"] != "no_gap" for row in quiet) <= 1
    committed = [row for row in rows if row["named"]]
    assert len(committed) >= 2
    assert sum(bool(row["wrong_names"]) for row in committed) <= 1
    clear = [row for row in rows if row["stratum"] == "one" and row["true"][0]["snr_sin_angle"] >= 8]
    assert sum(row["hits"][0] for row in clear) >= len(clear) - 1
