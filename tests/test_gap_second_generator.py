"""The second generator of measurements for `gap`: casting of rays, no error without effects, reproducibility, scoring."""

import ast
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

from gap_second_generator import cases, laser, laser_effects, score, stereo, stereo_effects
from gap_second_generator.surface import Surface

QUIET = {"share": 0.0, "bushes": 0, "gaps": 0, "double_removed": False}


def imports(file):
    """Return the top-level names of the packages that a file imports."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (each.name.partition(".")[0] for each in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield str(node.module).partition(".")[0]


def farthest(surface, points):
    """Return the largest distance of points (n, 3), wall frame, from the surface, m."""
    i = np.clip(np.searchsorted(surface.x, points[:, 0], side="right") - 1, 0, len(surface.x) - 2)
    j = np.clip(np.searchsorted(surface.z, points[:, 2], side="right") - 1, 0, len(surface.z) - 2)
    above = surface.at(i, j, points[:, 0], points[:, 2]) - points[:, 1]
    return np.abs(above * surface.normal(i, j, points[:, 0], points[:, 2])[:, 1]).max()


def test_a_ray_meets_a_slope_and_a_step_where_it_should():
    x = np.linspace(-5, 5, 21)
    surface = Surface(x, x, 0.2 * x[:, None] + 1.0 * (x[None] > 0.9))
    origin = np.array([[0.1, 10.0, -2.0], [0.1, 10.0, 3.0], [9.0, 10.0, 9.0]])
    hits = surface.cast(origin, np.array([[0.0, -1.0, 0.0]] * 3))
    np.testing.assert_allclose(hits.distance[:2], [10 - 0.02, 10 - 1.02], atol=1e-12)
    assert not hits.found[2]
    np.testing.assert_allclose(hits.normal[0], np.array([-0.2, 1, 0]) / np.hypot(0.2, 1), atol=1e-12)


@pytest.mark.parametrize("seed", [3, 4])
def test_without_effects_and_noise_a_scan_lies_on_the_reference(seed):
    site, pattern = laser.place(np.random.default_rng(seed), 3000, laser.Noise(1e-3, 3e-5), 0)
    site = replace(site, truth=site.reference, standing=site.surveyed)
    scan = laser.scan(site, pattern, laser.Noise(0.0, 0.0), {}, QUIET, 1)
    assert len(scan.points) > 2000
    assert farthest(site.reference, site.wall.inward(site.surveyed.outward(scan.points))) < 1e-6


@pytest.mark.parametrize("straight", [True, False])
def test_without_effects_and_noise_a_pair_gives_the_reference(straight):
    site = stereo.place(np.random.default_rng(5), 0, 0.05, straight)
    site = replace(site, truth=site.reference, standing=site.wall)
    cloud = stereo.reconstruct(site, stereo.Noise(0.0, 0.0, 32.0, 1), {}, QUIET, site.pair.left.width / 60, 1)
    assert len(cloud.points) > 1000
    assert farthest(site.reference, site.wall.inward(cloud.points)) < 1e-6
    np.testing.assert_allclose(site.pair.left.project(cloud.points), cloud.pixels, atol=1e-6)


def test_a_tilt_moves_recorded_angles_against_the_true_rays():
    azimuth, zenith = np.array([0.3, -1.0]), np.array([1.2, 1.7])
    shot = laser_effects.Shot(azimuth, zenith, *[np.ones(2)] * 6)
    off = laser_effects.CATALOGUE["tilt_drift"].act({"rate_x_rad": 1e-6, "rate_y_rad": -2e-6}, shot)
    rays = laser.directions(azimuth, zenith)
    true = rays + np.cross([1e-6, -2e-6, 0.0], rays)
    np.testing.assert_allclose(laser.directions(azimuth - off[0], zenith - off[1]), true, atol=1e-11)


@pytest.mark.parametrize("sensor", cases.SENSORS)
def test_a_case_is_the_same_each_time_and_keeps_its_truth_outside(sensor, tmp_path):
    effect = {"tls": "range_noise", "stereo": "row_jitter"}[sensor]
    case = cases.Case(0, sensor, "one", (effect,))
    truths = [cases.build(case, 1, tmp_path / name, count=1500) for name in "ab"]
    assert json.dumps(truths[0]) == json.dumps(truths[1])
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()
        assert effect.encode() not in file.read_bytes()
    assert truths[0]["clear"][effect]["ratio"] == pytest.approx(truths[0]["clear"][effect]["wanted"], rel=0.05)


def test_every_effect_of_a_catalogue_comes_up_once_in_a_round():
    for sensor, effects in (("tls", laser_effects), ("stereo", stereo_effects)):
        names = [name for case in cases.schedule(2, 60, sensor) if case.kind in ("one", "two") for name in case.names]
        counts = [names.count(each) for each in effects.CATALOGUE]
        assert max(counts) - min(counts) <= 1


def test_it_shares_no_code_with_the_program():
    folder = Path(__file__).resolve().parents[1] / "benchmarks/gap_second_generator"
    imported = {name for file in folder.glob("*.py") for name in imports(file)}
    assert imported <= {*sys.stdlib_module_names, "__future__", "gap_second_generator", "numpy", "scipy", "yaml"}


def test_answers_are_told_apart():
    truth = {"kind": "one", "effects": {"range_offset": {"offset_m": 1.0}}}

    def said(*classes):
        return score.outcome(
            truth, {"verdict": "named", "effects": [{"name": f"tls.{a[0]}", "cannot_be_told_from": list(a[1:])} for a in classes]}
        )

    assert said(["range_offset"]) == "alone"
    assert said(["range_scale", "tls.range_offset"]) == "class"
    assert said(["range_offset"], ["wobble"]) == "more"
    assert said(["wobble"]) == "wrong name"
    assert score.outcome(truth, {"verdict": "no_gap", "effects": []}) == "no_gap"
