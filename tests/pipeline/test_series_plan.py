"""What `inspect --series` promises: its regression against known laws, its numbers against geometry, and the command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.cli.main import main
from pipeline.planning import series as planning
from pipeline.planning.series import DetectionLaw, EpochPromise, SeriesPlan
from scene.series.config import Motion

SMALL: dict[str, Any] = {
    "seed": 3,
    "wall": {"style": "glendale", "width_m": 10.0, "height_m": 7.0, "resolution_m": 0.06, "seed": 1},
    "station": {"distance_m": 20.0},
    "scanner": {"azimuth_step_rad": 0.002, "zenith_step_rad": 0.002},
    "sensor": [{"sensor": "tls", "noise": {"range_sigma_m": 0.002}}],
    "series": {
        "times": {"start": "2026-03-01T00:00:00Z", "every_h": 2, "count": 4},
        "rockfall": {"rate_per_day": 10, "volume_m3": {"power_law": {"smallest": 0.03, "largest": 0.3}}},
        "precursor": {"lead_h": 48, "displacement_m": 0.05},
    },
}


def test_the_regression_finds_a_known_law_and_its_interval_holds_it() -> None:
    random = np.random.default_rng(4)
    volume, moved = np.exp(random.uniform(-6, 0, 3000)), np.exp(random.uniform(-7, -3, 3000))
    design = planning._design(volume, moved, 3)
    truth = np.array([12.0, 0.8, 2.0])
    listed = (random.random(3000) < 1 / (1 + np.exp(-design @ truth))).astype(float)
    fit = planning._fit(design, listed)
    assert fit == pytest.approx(truth, rel=0.12)
    rows = random.integers(3000, size=(60, 3000))
    law = DetectionLaw(fit, np.array([planning._fit(design[each], listed[each]) for each in rows]), 3000, 1.0)
    expected = np.exp((np.log(19.0) - 12.0 - 0.8 * np.log(0.1)) / 2.0)
    value, low, high = law.displacement_m(0.1)
    assert low < expected < high
    assert low < value < high
    assert law.probability(np.array([0.1]), np.array([value])) == pytest.approx([0.95])


def test_lead_times_follow_from_displacement_law_and_schedule() -> None:
    law = DetectionLaw(np.array([30.0, 1.0, 6.0]), np.array([[30.0, 1.0, 6.0]]), 100, 1.0)
    promise = EpochPromise(1, 0.003, law, law)
    motion = Motion(law="linear", lead_h=100.0, displacement_m=0.05)
    plan = SeriesPlan("tls", 0.05, 1.0, (promise,), (0.2,), motion)
    shows = law.displacement_m(0.2)[0]
    least, usual = plan.lead_h(0.2, 1.0, promise)
    assert least == pytest.approx(100 * (1 - shows / 0.05) - 1.0)
    assert usual > least
    assert plan.lead_h(0.2, 168.0, promise)[0] == 0.0
    assert plan.schedules_h == [1.0, 24.0, 168.0]


def test_the_command_promises_what_a_series_shows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planning, "_ENOUGH", 10)
    monkeypatch.setattr(planning, "_MOST_TRIALS", 3)
    monkeypatch.setattr(planning, "AVERAGED", (1,))
    file = tmp_path / "series.yaml"
    file.write_text(json.dumps(SMALL))
    words = ["inspect", str(file), "--series", "--sensor", "tls", "--out", str(tmp_path / "plan"), "--quiet"]
    assert main(words) == 0
    told = capsys.readouterr().out
    assert "are listed in 95 % of cases" in told
    (series,) = json.loads((tmp_path / "plan/plan.json").read_text())["series"]
    (epoch,) = series["epochs"]
    smallest = epoch["smallest_rockfall_m3"]
    pixels = 16 * series["gsd_m"] ** 2  # `monitor` lists no smaller area, and a niche is not deeper than it is wide
    assert 0.1 * pixels * series["gsd_m"] < smallest["value"] < 4 * pixels**1.5
    assert smallest["interval_95"][0] <= smallest["value"] <= smallest["interval_95"][1]
    shows = [each["shows_from_m"]["value"] for each in epoch["precursors"]]
    assert shows == sorted(shows, reverse=True)  # larger blocks show earlier
    assert (tmp_path / "plan/report.html").read_text().count("are listed in 95 % of cases") == 1


def test_a_config_without_a_series_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "plain.yaml"
    file.write_text(json.dumps({key: value for key, value in SMALL.items() if key != "series"}))
    assert main(["inspect", str(file), "--series", "--sensor", "tls", "--out", str(tmp_path / "plan"), "--quiet"]) == 2
    assert "the config has no series of rockfalls" in capsys.readouterr().err
