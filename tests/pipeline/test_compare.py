"""Comparisons end to end: which sensors are compared, what they share, what the truth says, and the files that are written."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from pipeline.cli.main import main
from pipeline.comparison import report
from pipeline.comparison.assess import assess
from pipeline.comparison.comparison import compare_sensors
from pipeline.comparison.covariates import edge_distance
from pipeline.comparison.sensor_setups import sensor_setups
from pipeline.comparison.trial import Trial, compare, rockfalls
from pipeline.formats.rasters.geotiff import write_geotiff
from pipeline.report.progress import Progress
from scene.blocks.block import RockfallConfig
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from scene.geometry.mesh import WALL

pytestmark = pytest.mark.usefixtures("undrawn")

SMALL: dict[str, Any] = {
    "seed": 3,
    "wall": {"style": "glendale", "width_m": 5.0, "height_m": 4.0, "resolution_m": 0.06, "seed": 1},
    "rockfall": {"count": 8, "size_m": {"kind": "gaussian", "mean": 0.3, "sigma": 0.02}},
    "cameras": {"distance_m": 20.0, "base_m": 5.0},
    "depth_map": "low",
    "station": {"distance_m": 20.0},
    "scanner": {"azimuth_step_rad": 0.002, "zenith_step_rad": 0.002},
    "difference": {"gsd_m": 0.04},
    "sensor": [{"sensor": "stereo"}, {"sensor": "tls", "noise": {"range_sigma_m": 0.002, "angle_sigma_rad": 0.0}}],
}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("compare") / "site.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    return path


@pytest.fixture(scope="module")
def trial(site: Path) -> Trial:
    """The comparison of the scanner with its own noise and with ten times as much."""
    noisy = site.parent / "noisy.yaml"
    noisy.write_text("sensor: tls\nnoise: {range_sigma_m: 0.02, angle_sigma_rad: 0.0}\n")
    sensors = [each for each in sensor_setups([str(site), str(noisy)]) if each.sensor == "tls"]
    return compare(sensors, 2, (0.1, 0.4))


def test_who_is_compared(site: Path) -> None:
    again = site.parent / "again" / site.name
    again.parent.mkdir()
    again.write_text(site.read_text())
    found = sensor_setups([str(site), "riegl_vz400i", "glendale_high", str(again)])
    assert [(each.name, each.sensor) for each in found] == [
        ("site_stereo", "stereo"),
        ("site_tls", "tls"),
        ("riegl_vz400i", "tls"),
        ("glendale_high", "stereo"),
        ("site_stereo_2", "stereo"),
        ("site_tls_2", "tls"),
    ]
    first = found[0].config
    assert all(each.config.wall == first.wall and each.config.seed == 3 for each in found)
    assert found[2].config.scanner != first.scanner
    assert found[2].config.station == first.station
    assert found[3].config.stereo_model() != first.stereo_model()


def test_a_site_beside_another_gets_the_first_ones_wall(site: Path) -> None:
    found = sensor_setups([str(site), "bulga"], ["difference.gsd_m=0.05"])
    assert found[-1].config.wall == found[0].config.wall
    assert found[-1].config.cameras != found[0].config.cameras
    assert {each.config.difference.gsd_m for each in found} == {0.05}


def test_an_unknown_name_is_told_with_the_nearest() -> None:
    with pytest.raises(InputError, match="riegl_vz400i"):
        sensor_setups(["riegl_vz40i"])


def test_presets_scan_with_the_configs_step_unless_asked(site: Path) -> None:
    """The config has 2 mrad for both; the preset names no step, so its own would be the default of 0.5 mrad."""
    shared, own = (sensor_setups([str(site), "riegl_vz400i"], own_step=own_step) for own_step in (False, True))
    assert [each.angular_step_rad for each in shared] == [None, (0.002, 0.002), (0.002, 0.002)]
    assert own[2].angular_step_rad == (0.0005, 0.0005)
    assert shared[2].config.scanner.pulse_rate_hz == own[2].config.scanner.pulse_rate_hz


@pytest.mark.parametrize("again", ["site.yaml", "./site.yaml", "{folder}/site.yaml"])
def test_the_same_file_twice_is_refused(site: Path, monkeypatch: pytest.MonkeyPatch, again: str) -> None:
    monkeypatch.chdir(site.parent)
    with pytest.raises(InputError, match="given twice"):
        sensor_setups(["site.yaml", "riegl_vz400i", again.format(folder=site.parent)])
    with pytest.raises(InputError, match="given twice"):
        sensor_setups(["riegl_vz400i", "riegl_vz400i"])


@pytest.mark.parametrize("epochs", ["0", "1000", "1000000000", "9" * 5000, "1e9", "-1"])
def test_too_many_epochs_are_refused_before_anything_is_done(
    site: Path, tmp_path: Path, epochs: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compare", str(site), "--epochs", epochs, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "a whole number from 1 to 999" in said
    assert len(said) < 300
    assert not (tmp_path / "out").exists()


def test_one_epoch_of_small_blocks_and_a_name_with_dollars(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A figure without data is drawn, and $x^$ in a name does not become a formula.

    The scanner sees less than half of the blocks of 5 cm, so one figure has no data.
    """
    named, out = tmp_path / "a $x^$ \\frac.yaml", tmp_path / "out"
    named.write_text(yaml.safe_dump(SMALL | {"sensor": [SMALL["sensor"][1]]}))
    words = ["compare", str(named), "--epochs", "1", "--out", str(out), "--quiet"]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "a $x^$ \\frac: angular step 2 by 2 mrad" in printed
    assert "blocks" in printed
    record = json.loads((out / "comparison.json").read_text())
    assert record["sensors"][0]["angular_step_rad"] == [0.002, 0.002]
    assert sorted(path.name for path in tmp_path.iterdir()) == [named.name, "out"]


class Recorded(Progress):
    """A progress that notes the share that is done whenever a stage begins or ends."""

    def __init__(self) -> None:
        super().__init__()
        self.shares: list[float] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[Recorded]:
        with super().stage(name):
            self.shares.append(self.share)
            yield self
        self.shares.append(self.share)


def test_the_progress_ends_with_the_figures(site: Path) -> None:
    progress = Recorded()
    compare_sensors(sensor_setups([str(site)])[1:], (), 2, (0.1, 0.4), progress)
    assert progress.shares[0] < 0.01
    assert progress.shares == sorted(progress.shares)
    assert progress.shares[-1] == pytest.approx(1.0)
    assert len(set(progress.shares)) > 6
    assert progress.shares[-2] < 0.9


def test_sizes_grow_and_leave_room() -> None:
    bounds = np.array([[0.0, 0.0, 0.0], [10.0, 5.0, 1.0]])
    plans = rockfalls(RockfallConfig(count=100), bounds, 3, (0.1, 0.9))
    sides = [plan.size_m.mean for plan in plans]  # type: ignore[union-attr]
    assert sides == pytest.approx([0.1, 0.3, 0.9])
    assert [plan.count for plan in plans] == [100, 24, 3]  # 15 % of 50 m2 over (1.5 s + 0.1)^2
    assert rockfalls(RockfallConfig(), bounds, 2, None) == [RockfallConfig()] * 2
    with pytest.raises(InputError, match="smallest <= largest"):
        compare_sensors((), sizes_m=(0.5, 0.1))


def test_all_see_the_same_wall_and_blocks(trial: Trial) -> None:
    quiet, noisy = trial.seen
    assert quiet.changes.shape == noisy.changes.shape == (2, *trial.grid.shape)
    for number, epoch in enumerate(trial.epochs):
        assert not (epoch.stable & (epoch.change != 0)).any()
        assert not (epoch.stable & (epoch.block != WALL)).any()
        niche = epoch.change > (0.0, 0.03)[number]
        assert np.count_nonzero(niche & ~np.isnan(quiet.changes[number])) > 10
        assert np.nanmedian((quiet.changes[number] - epoch.change)[niche]) == pytest.approx(0, abs=0.02)


def test_planted_noise_is_measured(trial: Trial) -> None:
    """Ranges have 2 and 20 mm of noise in two epochs, interpolated on triangles.

    On stable ground the NMAD of z lies between sqrt(2 / 3) (middle of a triangle) and sqrt(2) (vertex) times sigma over the
    cosine between ray and normal (0.9 and more). Ten times the noise gives ten times the NMAD to a fifth, because the range steps
    on slopes and ICP add to both.
    """
    found = [assess(trial, seen, KeyedRandom(1)) for seen in trial.seen]
    quiet, noisy = found
    for each, sigma in ((quiet, 0.002), (noisy, 0.02)):
        assert np.sqrt(2 / 3) * sigma < each.noise.stable.nmad < 1.15 * np.sqrt(2) * sigma
        assert each.noise.stable.count > 5000
        assert each.noise.model.sill_m2 == pytest.approx(each.noise.stable.nmad**2, rel=0.5)
        assert 0.5 < each.complete_of_visible <= 1
        parts = each.visible * each.complete_of_visible + (1 - each.visible) * each.complete_of_hidden
        assert parts == pytest.approx(each.complete)
    assert noisy.noise.stable.nmad / quiet.noise.stable.nmad == pytest.approx(10, rel=0.2)
    assert sum(block.seen for block in quiet.detection.blocks) >= sum(block.seen for block in noisy.detection.blocks)
    limits = [np.median([block.limit_m for block in each.detection.blocks if block.limit_m]) for each in found]
    assert limits[1] / limits[0] == pytest.approx(10, rel=0.35)
    assert quiet.noise.median_level_m is not None
    assert quiet.noise.median_level_m == pytest.approx(1.96 * quiet.noise.stable.nmad, rel=0.35)
    assert quiet.detection.alarms / quiet.detection.trials < 0.12


def test_edges_are_steps() -> None:
    heights = np.zeros((5, 8))
    heights[:, 4:] = 1.0
    distance = edge_distance(heights, 0.1)
    assert distance[2] == pytest.approx(0.1 * np.array([3, 2, 1, 0, 0, 1, 2, 3]))
    assert np.isinf(edge_distance(np.zeros((3, 3)), 0.1)).all()


def test_the_command_and_its_folder(site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maps, out = tmp_path / "real", tmp_path / "out"
    grid = Grid(0.0, 2.0, 0.05, 50, 40)
    for number in (1, 2):
        values = KeyedRandom(number).generator().normal(0, 0.005, grid.shape)
        write_geotiff(maps / f"difference_{number:03d}.tif", values, grid)
    words = [
        "compare",
        str(site),
        "--measured",
        str(maps),
        "--epochs",
        "2",
        "--sizes-m",
        "0.1",
        "0.4",
        "--out",
        str(out),
        "--quiet",
    ]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "site_tls" in printed
    assert str(out / "report.html") in printed
    record = json.loads((out / "comparison.json").read_text())
    assert [each["name"] for each in record["sensors"]] == ["site_stereo", "site_tls"]
    assert record["measured"][0]["noise"]["stable"]["nmad_m"] == pytest.approx(0.005, rel=0.05)
    names = {"maps", "level_of_detection", "noise", "by_covariate", "detection", "size_and_depth"}
    assert {path.stem for path in out.glob("*.png")} == names
    assert (out / "report.html").read_text().count("<img") == len(names)
    with (out / "blocks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(each["detection"]["blocks"] for each in record["sensors"])
    assert (out / "site_tls/difference_002.tif").exists()
    assert main(words) == 2
    assert "not an empty folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("seconds", "words"), [(None, report._NOTHING), (0.0299, "0.03 s"), (4.92, "4.9 s"), (600.0, "10 min 0 s")]
)
def test_times_have_their_unit_and_no_false_zero(seconds: float | None, words: str) -> None:
    assert report._seconds(seconds) == words
