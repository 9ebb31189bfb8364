"""A series: its folder against its truth, resuming, own surfaces, conditions, and times in the files."""

from __future__ import annotations

import hashlib
import json
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.config.simulation import SimulationConfig, load_config
from pipeline.export import pictures
from pipeline.export.exported_run import ExportedRun
from pipeline.export.pictures import save_epochs
from pipeline.formats.meshes.ply import read_ply, write_ply
from pipeline.formats.points.laz import gps_seconds, read_laz
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.monitoring.reading import find_epochs
from pipeline.report.progress import Progress
from pipeline.run.simulation import simulate
from pipeline.view.run_results import RunResults
from scene.common.config import parse
from scene.common.course import Course
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh
from sensors.effects.range_scale import RangeScale
from sensors.models.conditions import with_effects
from sensors.models.sensor_model import TlsModel

pytestmark = pytest.mark.usefixtures("undrawn")

SMALL: dict[str, Any] = {
    "seed": 3,
    "wall": {"style": "glendale", "width_m": 6.0, "height_m": 4.0, "resolution_m": 0.06, "seed": 1},
    "station": {"distance_m": 15.0},
    "scanner": {"azimuth_step_rad": 0.002, "zenith_step_rad": 0.002},
    "difference": {"gsd_m": 0.03},
    "icp": None,
}
TIMES = {"start": "2026-03-01T00:00:00Z", "every_h": 6, "count": 4}
EVENTS = [
    {"after_h": 2, "volume_m3": 0.04, "position_m": [1.5, 3.2]},
    {"time": "2026-03-01T14:00:00Z", "volume_m3": 0.05, "position_m": [3.0, 0.9], "precursor": {"lead_h": 10}},
]
TIMED = {"run.json"}


def config(series: dict[str, Any], **changes: Any) -> SimulationConfig:
    return parse(SimulationConfig, {**SMALL, **changes, "series": {"times": TIMES, **series}}, "test")


def digests(folder: Path) -> dict[str, str]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in TIMED)
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("series") / "run"
    simulate(config({"events": EVENTS, "deposits": {"fragments": 3}, "kinds": True}), "tls", out)
    return out


def test_the_truth_says_when_what_fell_and_how_it_moved_before(finished: Path) -> None:
    truth = json.loads((finished / "series.json").read_text())
    assert truth["times"] == ["2026-03-01T00:00:00Z", "2026-03-01T06:00:00Z", "2026-03-01T12:00:00Z", "2026-03-01T18:00:00Z"]
    first, second = truth["events"]
    assert (first["falls"], first["first_missing_epoch"]) == ("2026-03-01T02:00:00Z", 1)
    assert (second["falls_h"], second["first_missing_epoch"]) == (14.0, 3)
    assert second["displacement_m"][3] is None
    expected = [0.03 * np.log(10 / left) / np.log(100) for left in (8.0, 2.0)]
    assert second["displacement_m"][1:3] == pytest.approx(expected)
    assert [each["volume_m3"] for each in truth["events"]] == pytest.approx([0.04, 0.05], rel=0.02)
    for epoch in truth["volumes"]:
        assert abs(epoch["balance_m3"]) < 1e-9 * epoch["wall_m3"]


def test_what_fell_stays_fallen_and_shows_once_against_the_epoch_before(finished: Path) -> None:
    maps = [read_geotiff(finished / f"difference_{number:03d}.tif")[0] for number in (1, 2, 3)]
    changes = [read_geotiff(finished / f"change_{number:03d}.tif")[0] for number in (1, 2, 3)]
    assert np.array_equal(changes[0], maps[0], equal_nan=True)
    for before, after, change in zip(maps, maps[1:], changes[1:], strict=False):
        known = np.isfinite(before) & np.isfinite(after)
        assert np.abs((after - before - change)[known]).max() < 1e-5
    record = json.loads((finished / "run.json").read_text())["epochs"]
    assert [[block["label"] for block in each["blocks"]] for each in record] == [[], [1], [1], [1, 2]]
    assert [each["time"][11:13] for each in record] == ["00", "06", "12", "18"]


def kinds_of(finished: Path, name: str) -> dict[int, set[tuple[str, int]]]:
    data = json.loads((finished / f"{name}.json").read_text())
    names = {each["id"]: each["name"] for each in data["categories"]}
    epochs = {each["id"]: each["epoch"] for each in data["images"]}
    found: dict[int, set[tuple[str, int]]] = {1: set(), 2: set(), 3: set()}
    for each in data["annotations"]:
        found[epochs[each["image_id"]]].add((names[each["category_id"]], each["block"]))
    return found


def test_annotations_tell_the_kinds_against_the_reference_and_the_epoch_before(finished: Path) -> None:
    since_first, since_last = (kinds_of(finished, name) for name in ("annotations", "annotations_change"))
    assert {("missing", 1), ("moved", 2)} <= since_first[2]
    assert {("missing", 1), ("missing", 2)} <= since_first[3]
    assert ("moved", 2) not in since_first[3]
    assert since_last[2] == {("moved", 2)}
    assert ("missing", 2) in since_last[3]
    assert ("missing", 1) not in since_last[3]


def test_points_carry_the_time_of_their_epoch(finished: Path) -> None:
    start = gps_seconds(datetime(2026, 3, 1, 12, tzinfo=UTC))
    assert start == 1456401600 + 18 - 1e9  # seconds from 1980-01-06 to 2026-03-01 12:00 UTC
    times = read_laz(finished / "epoch_002/points.laz").gps_time
    assert times is not None
    assert start <= times.min() < times.max() < start + 60
    assert [source.time.text for source in find_epochs([finished])] == [
        f"2026-03-01T{hour:02d}:00:00Z" for hour in (0, 6, 12, 18)
    ]


def test_an_interrupted_series_goes_on_to_the_same_bytes(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "run"
    whole = config({"events": EVENTS, "deposits": {"fragments": 3}, "kinds": True})
    stage = Progress.stage

    def interrupted(self: Progress, name: str) -> Any:
        if name == "epoch 2: write":
            raise KeyboardInterrupt
        return stage(self, name)

    with monkeypatch.context() as patched:
        patched.setattr(Progress, "stage", interrupted)
        with pytest.raises(KeyboardInterrupt):
            simulate(whole, "tls", out)
    assert not (out / "epoch_002").exists()
    simulate(whole, "tls", out, resume=True)
    assert digests(out) == digests(finished)


def flat_wall(path: Path, lost_m: float) -> str:
    """Write an upright wall of 4 m x 3 m that faces -y, with a square niche, and return its path."""
    x, y = np.meshgrid(np.arange(0, 4.01, 0.1), np.arange(0, 3.01, 0.1))
    count = x.shape[1]
    first = np.arange(x.size).reshape(x.shape)[:-1, :-1].ravel()
    sides = [np.stack([first, first + 1, first + 1 + count], 1), np.stack([first, first + 1 + count, first + count], 1)]
    depth = np.where((np.abs(x - 2) < 0.6) & (np.abs(y - 1.5) < 0.6), lost_m, 0.0)
    places = np.stack([x, depth, y], axis=-1).reshape(-1, 3)
    write_ply(path, TriangleMesh(places, np.concatenate(sides).astype(np.int32)))
    return str(path)


UPRIGHT = {
    **SMALL,
    "frame": {"normal": [0, -1, 0]},
    "station": {"position_m": [2.0, -15.0, 1.5]},
    "sensor": [{"sensor": "tls", "noise": {"range_sigma_m": 0, "angle_sigma_rad": 0}}],
}


def test_own_surfaces_replace_the_rockfalls(tmp_path: Path) -> None:
    files = [flat_wall(tmp_path / f"{number}.ply", lost) for number, lost in enumerate((0.0, 0.1, 0.25))]
    values = {**UPRIGHT, "series": {"times": {**TIMES, "count": 3}, "surfaces": files}}
    del values["wall"]
    simulate(parse(SimulationConfig, values, "test"), "tls", tmp_path / "run")
    changes = [np.nanmax(read_geotiff(tmp_path / f"run/{name}.tif")[0]) for name in ("difference_002", "change_002")]
    assert changes == pytest.approx([0.25, 0.15], abs=0.002)
    assert json.loads((tmp_path / "run/series.json").read_text())["events"] == []


def test_a_pose_that_drifts_moves_the_points_against_the_drift(tmp_path: Path) -> None:
    pose = {"position_m": [{"drift": 1e-9}, {"drift": 0.04}, {"drift": 1e-9}]}
    times = {"start": "2026-03-01", "every_h": 24, "count": 2}
    wall = {"mesh": flat_wall(tmp_path / "wall.ply", 0.0)}
    values = {**UPRIGHT, "wall": wall, "series": {"times": times, "conditions": {"pose": pose}}}
    simulate(parse(SimulationConfig, values, "test"), "tls", tmp_path / "run")
    assert np.nanmedian(read_geotiff(tmp_path / "run/difference_001.tif")[0]) == pytest.approx(-0.04, abs=1e-5)


def test_conditions_change_effects_and_pose_by_their_courses() -> None:
    hours, random = np.array([0.0, 6.0, 12.0, 30.0]), KeyedRandom(1)
    course = parse(Course, {"drift": 2.0, "cycle": {"amplitude": 3.0}, "table": {"hours": [0, 12], "values": [0, 1]}}, "test")
    assert course.values(hours, random) == pytest.approx([3.0, 0.5 + 0.5, 1.0 - 3.0 + 1.0, 2.5 + 1.0])
    walk = Course(random_walk=2.0)
    ends = [walk.values(np.array([0.0, 10.0, 48.0]), random.child(number))[-1] for number in range(2000)]
    assert np.std(ends) == pytest.approx(2.0 * 2**0.5, rel=0.07)
    model = with_effects(TlsModel(effects=(RangeScale(scale_ppm=4.0),)), {"range_scale": {"scale_ppm": 3.0}})
    assert model.effects == (RangeScale(scale_ppm=7.0),)
    with pytest.raises(InputError, match=r"series.conditions.effects.range_scale: .*scale_ppm"):
        with_effects(TlsModel(), {"range_scale": {"scale_ppm": 1e6}})


def test_a_run_without_a_series_has_none_in_its_record() -> None:
    plain = parse(SimulationConfig, SMALL, "test")
    assert "series" not in plain.model_dump(mode="json")
    assert parse(SimulationConfig, config({"events": EVENTS}).model_dump(mode="json"), "test") == config({"events": EVENTS})


@pytest.mark.parametrize(
    ("series", "message"),
    [
        ({"rockfal": {}}, "unknown key 'series.rockfal'; did you mean 'rockfall'"),
        ({"rockfall": {"rate_per_day": 0}}, "'series.rockfall.rate_per_day': input should be greater than 0"),
        ({"events": [{"volume_m3": 1, "time": "2026-02-01"}]}, "an event at 2026-02-01 00:00:00 is not after the first epoch"),
        ({"conditions": {"effects": {"range_scal": {"drift": 1}}}}, "unknown effect 'range_scal'; did you mean 'range_scale'"),
        ({"surfaces": ["a.ply"]}, "1 surfaces for 4 epochs"),
        ({"conditions": {"snow_m": {}}}, "changes nothing: give random_walk, drift, cycle or table"),
    ],
)
def test_mistakes_are_named(series: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        config(series)


@pytest.mark.usefixtures("drawn")
def test_view_and_export_name_the_times(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "_ANIMATED_PX", 320)
    results = RunResults(finished)
    assert results.steps["2"] == "epoch 2, 2026-03-01 12:00"
    assert [layer.key for layer in results.layers("2")][:2] == ["difference", "change"]
    save_epochs(ExportedRun(finished), tmp_path / "series.gif", Progress())
    with Image.open(tmp_path / "series.gif") as animation:
        assert animation.n_frames == 4


def test_truth_and_points_show_a_deposit(finished: Path) -> None:
    truth = read_ply(finished / "epoch_001/truth.ply")
    without = read_ply(finished / "epoch_000/truth.ply")
    box = np.array(json.loads((finished / "series.json").read_text())["events"][0]["deposit_bbox_m"]).reshape(2, 3)
    inside = [((mesh.vertices >= box[0]) & (mesh.vertices <= box[1])).all(axis=1).sum() for mesh in (truth, without)]
    assert inside[0] > inside[1] + 60


def test_py4dgeo_analyses_the_epochs_as_the_how_to_says(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the second block falls before the last epoch, distances are those of its creep first, and then of its niche."""
    monkeypatch.chdir(tmp_path)  # before py4dgeo is imported, which chooses the place of its log then
    pytest.importorskip("py4dgeo")
    page = (Path(__file__).parents[2] / "docs/howto/series.md").read_text()
    (code,) = (each for each in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "py4dgeo" in each)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs/series").symlink_to(finished)
    names: dict[str, Any] = {}
    exec(code, names)
    analysis = names["analysis"]
    assert [each.total_seconds() / 3600 for each in analysis.timedeltas] == [6, 12, 18]
    second = json.loads((finished / "series.json").read_text())["events"][1]
    places = analysis.corepoints.cloud
    assert analysis.distances.shape == (len(places), 3)
    near = np.linalg.norm(places[:, :2] - second["block"]["position_m"][:2], axis=1) < 0.2
    first, before, after = np.nanmedian(np.abs(analysis.distances[near]), axis=0)
    assert first == pytest.approx(second["displacement_m"][1], abs=0.003)
    assert before == pytest.approx(second["displacement_m"][2], abs=0.003)
    assert after > 0.05


def test_the_how_to_s_config_is_short_and_loads(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/howto/series.md").read_text()
    (text,) = re.findall(r"```yaml title=\"series.yaml\"\n(.*?)```", page, re.DOTALL)
    assert len(text.splitlines()) <= 25
    (tmp_path / "series.yaml").write_text(text)
    series = load_config(tmp_path / "series.yaml", [], "tls", None).series
    assert series is not None
    assert series.count == 31
    assert series.falls_h() == [28.5]
