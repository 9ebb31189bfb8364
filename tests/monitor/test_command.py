"""`scarpsim monitor` from files to products: what a user with two scans gets."""

from __future__ import annotations

import csv
import json
import pickle
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from monitor_cases import NOISE_M, STATION, UTM, las, points
from pictures import ENVIRONMENT, command
from pycocotools.coco import COCO

from pipeline import monitor
from pipeline.cli import main as cli
from pipeline.formats.meshes.ply import write_ply
from pipeline.formats.points import laz_chunks
from pipeline.formats.points.laz import read_laz
from pipeline.formats.rasters.georeference import GEO_KEYS, georeference
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.monitoring import reading, run
from pipeline.monitoring.follow import follow
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.run import monitor_paths
from pipeline.monitoring.times import SIDECAR
from pipeline.surface.raster_mesh import mesh_of_raster
from scene.common.errors import InputError
from scene.geometry.grid import Grid

pytestmark = pytest.mark.usefixtures("undrawn")

BLOCKS = ((4.0, 3.0, 0.7, 0.2), (11.0, 6.5, 0.9, 0.1))
VOLUME = 0.7**2 * 0.2 + 0.9**2 * 0.1
COUNT = 60_000
_UTM_KEYS = (1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 25832)
"""GeoTIFF keys: projected coordinates, EPSG:25832."""


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scans")
    las(folder / "site_2026-03-01_0600.las", points(COUNT, 1))
    moved = points(COUNT, 2, BLOCKS) + np.array([0.02, -0.03, 0.01])
    las(folder / "site_2026-04-01_0600.las", moved)
    las(folder / "site_2026-05-01_0600.las", points(COUNT, 3, (*BLOCKS, (8.0, 8.0, 0.6, 0.3))))
    return folder


@pytest.fixture(scope="module")
def result(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("result") / "out"
    words = [
        "monitor",
        *map(str, sorted(scans.glob("*.las"))),
        "--position",
        ",".join(STATION.split()),
        "--out",
        str(out),
        "--quiet",
    ]
    assert cli.main(words) == 0
    return out


def test_the_table_says_what_fell_where_and_when(result: Path) -> None:
    rows = list(csv.DictReader((result / "events.csv").open()))
    first = [row for row in rows if row["epoch"] == "1"]
    assert len(first) == 2
    assert {row["kind"] for row in rows} == {"missing"}
    assert sum(float(row["volume_m3"]) for row in first) == pytest.approx(VOLUME, rel=0.1)
    for row, (x, z, _, _) in zip(sorted(first, key=lambda each: float(each["world_x_m"])), BLOCKS, strict=True):
        assert float(row["world_x_m"]) == pytest.approx(UTM[0] + x, abs=0.1)
        assert float(row["world_z_m"]) == pytest.approx(UTM[2] + z, abs=0.1)
        assert row["first_seen_after"].startswith("2026-03-01T06:00")
        assert row["first_seen_by"].startswith("2026-04-01T06:00")
    later = {row["id"]: row for row in rows if row["epoch"] == "2"}
    assert len(later) == 3
    assert {row["id"] for row in first} < set(later)


def test_the_promised_files_are_there_and_readable(result: Path, scans: Path) -> None:
    document = json.loads((result / "monitor.json").read_text())
    assert document["schema"] == 1
    assert [each["time"] for each in document["inputs"]] == [
        "2026-03-01T06:00:00Z", "2026-04-01T06:00:00Z", "2026-05-01T06:00:00Z"
    ]  # fmt: skip
    assert all(each["time_source"] == "from its name" and "UTM zone 32N" in each["crs"] for each in document["inputs"])
    difference, grid = read_geotiff(result / "difference_001.tif")
    level, same = read_geotiff(result / "lod_001.tif")
    assert same == grid
    assert np.nanmax(difference) == pytest.approx(0.2, abs=0.02)
    noise = 1.96 * NOISE_M * np.sqrt(2 / 9)  # of two planes through nine points; relief between the points adds to it
    assert noise / 2 < np.nanmedian(level) < 2 * noise
    cloud = read_laz(result / "epoch_001.laz")
    assert set(cloud.extra) == {"distance_m", "lod_m", "event"}
    assert len(cloud.points) == COUNT
    struck = cloud.extra["event"] > 0
    assert 0.002 < struck.mean() < 0.03
    assert np.nanmedian(cloud.extra["distance_m"][struck]) > 0.05
    with laspy.open(result / "epoch_001.laz") as reader:
        assert reader.header.parse_crs().to_epsg() == 32632
    annotations = COCO(str(result / "annotations.json"))
    assert len(annotations.getAnnIds(imgIds=[1])) == 2
    assert "What fell from the wall" in (result / "report.html").read_text()


def test_registered_points_lie_on_the_reference(result: Path) -> None:
    """The second epoch was shifted by (20, -30, 10) mm: it comes back to within 2 mm."""
    moved = read_laz(result / "epoch_001.laz").points - points(COUNT, 2, BLOCKS)
    np.testing.assert_allclose(np.median(moved, axis=0), 0.0, atol=2e-3)


def test_outlines_open_in_gis(result: Path) -> None:
    geopandas = pytest.importorskip("geopandas")
    table = geopandas.read_file(result / "events.gpkg", layer="events")
    assert len(table) == 5
    assert table.crs is not None
    assert "UTM zone 32N" in table.crs.name
    centre = table.geometry.iloc[0].centroid
    assert abs(centre.x - table["world_x_m"].iloc[0]) < 0.2
    assert table.geometry.has_z.all()


def test_processes_and_resumption_give_the_same(result: Path, scans: Path, tmp_path: Path) -> None:
    files = sorted(scans.glob("*.las"))
    words = ["monitor", *map(str, files), "--position", ",".join(STATION.split()), "--out", str(tmp_path / "out"), "--quiet"]
    assert cli.main([*words, "--workers", "2"]) == 0
    for name in ("events.csv", "difference_002.tif", "lod_001.tif", "epoch_002.laz", "annotations.json", "events.gpkg"):
        assert (tmp_path / "out" / name).read_bytes() == (result / name).read_bytes(), name
    (tmp_path / "out" / "events.csv").unlink()
    kept = [tmp_path / "out" / name for name in ("difference_001.tif", "epoch_001.laz", "map_001.png")]
    before = [file.stat().st_mtime_ns for file in kept]
    (tmp_path / "out" / "epoch_002.laz").unlink()
    assert cli.main([*words, "--resume"]) == 0
    for name in ("events.csv", "epoch_002.laz"):
        assert (tmp_path / "out" / name).read_bytes() == (result / name).read_bytes(), name
    assert [file.stat().st_mtime_ns for file in kept] == before


def test_an_error_in_a_worker_is_one_line(scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second, third = map(str, sorted(scans.glob("*.las")))
    las(tmp_path / "site_2026-04-15.las", points(2000, 4) + np.array([5000.0, 0, 0]))
    words = ["monitor", first, second, str(tmp_path / "site_2026-04-15.las"), third, "--position", ",".join(STATION.split())]
    assert cli.main([*words, "--workers", "2", "--out", str(tmp_path / "out"), "--quiet"]) == 2
    told = capsys.readouterr().err
    assert "lies elsewhere" in told
    assert told.count("\n") == 1


def test_an_error_of_map_on_workers_is_one_line(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker sends its error to the main process as pickled bytes. Here this process plays the worker."""

    def here(function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], count: int, started: None) -> Iterator[Any]:
        assert (count, started) == (2, None)
        for task in tasks:
            try:
                yield function(*pickle.loads(pickle.dumps(task)))
            except InputError as error:
                raise pickle.loads(pickle.dumps(error)) from None

    monkeypatch.setattr(run, "map_on_workers", here)
    monkeypatch.setattr(run, "workers_in_background", lambda count, modules: nullcontext())
    first, second, _ = map(str, sorted(scans.glob("*.las")))
    las(tmp_path / "site_2026-03-15.las", points(2000, 4) + np.array([5000.0, 0, 0]))
    words = ["monitor", first, str(tmp_path / "site_2026-03-15.las"), second, "--position", ",".join(STATION.split())]
    assert cli.main([*words, "--workers", "2", "--out", str(tmp_path / "out"), "--quiet"]) == 2
    told = capsys.readouterr().err
    assert "lies elsewhere" in told
    assert told.count("\n") == 1


def test_a_killed_monitoring_goes_on(result: Path, scans: Path, tmp_path: Path) -> None:
    """Killed (SIGKILL) once the first epoch is done: with --resume the same files come out, and the epoch is not made again."""
    words = ["monitor", *map(str, sorted(scans.glob("*.las"))), "--position", ",".join(STATION.split())]
    words += ["--out", str(tmp_path / "out"), "--quiet"]
    process = subprocess.Popen(command("main", *words), env=ENVIRONMENT)
    first = tmp_path / "out" / ".monitor" / "epoch_001.json"
    until = time.monotonic() + 120
    while not first.is_file() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert first.is_file()
    assert not (tmp_path / "out" / "monitor.json").exists()
    before = first.stat().st_mtime_ns
    assert cli.main([*words, "--resume"]) == 0
    assert first.stat().st_mtime_ns == before
    for name in ("events.csv", "difference_002.tif", "epoch_001.laz", "epoch_002.laz", "annotations.json"):
        assert (tmp_path / "out" / name).read_bytes() == (result / name).read_bytes(), name
    assert not list((tmp_path / "out").rglob(".*.part*"))


def test_from_python(scans: Path, tmp_path: Path) -> None:
    pytest.importorskip("xarray")
    first, second, _ = sorted(scans.glob("*.las"))
    station = [float(each) for each in STATION.split()]
    found = monitor([second], tmp_path / "out", reference=first, position=station)
    assert found.differences.dims == ("epoch", "y", "x")
    assert len(found.events) == 2
    assert found.events["volume_m3"].sum() == pytest.approx(VOLUME, rel=0.1)
    assert found.registration[1]["stable_pixels"] > 1000
    assert "2 places" in found.summary()
    with pytest.raises(InputError, match="unknown option"):
        monitor([], tmp_path / "other", colour="red")


def test_a_folder_is_followed_until_the_end(scans: Path, tmp_path: Path) -> None:
    first, second, third = sorted(scans.glob("*.las"))
    incoming = tmp_path / "incoming"
    incoming.mkdir()
    said: list[str] = []
    looks = iter(range(100))

    def ended() -> bool:
        look = next(looks)
        if look == 0:
            (incoming / second.name).write_bytes(second.read_bytes())
        if look == 3:
            (incoming / "broken.las").write_bytes(b"LASF")
            (incoming / third.name).write_bytes(third.read_bytes())
        return look >= 7

    options = MonitorOptions(position=np.array([float(each) for each in STATION.split()]))
    found = follow([first], incoming, tmp_path / "out", options, every_s=0.0, ended=ended, told=said.append)
    assert [len(epoch.regions) for epoch in found.epochs] == [2, 3]
    assert any("left out" in line and "broken.las" in line for line in said)


def test_nothing_is_followed_into_a_folder_with_other_files(scans: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    (tmp_path / "incoming").mkdir()
    with pytest.raises(InputError, match="--out"):
        follow([min(scans.glob("*.las"))], tmp_path / "incoming", tmp_path / "out", MonitorOptions(), ended=lambda: False)


def test_meshes_are_epochs_too(tmp_path: Path) -> None:
    grid = Grid(0.0, 10.0, 0.05, 320, 200)
    x, y = np.meshgrid(0.05 * np.arange(320), 0.05 * np.arange(200)[::-1])
    heights = 0.4 * np.sin(x) * np.cos(y)
    write_ply(tmp_path / "before.ply", mesh_of_raster(heights, grid))
    fallen = np.where((np.abs(x - 8) < 0.5) & (np.abs(y - 5) < 0.5), heights - 0.3, heights)
    write_ply(tmp_path / "after.ply", mesh_of_raster(fallen, grid))
    words = ["monitor", str(tmp_path / "before.ply"), str(tmp_path / "after.ply"), "--out", str(tmp_path / "out"), "--quiet"]
    assert cli.main(words) == 0
    (row,) = csv.DictReader((tmp_path / "out" / "events.csv").open())
    assert float(row["volume_m3"]) == pytest.approx(0.3, rel=0.1)


def test_too_little_stable_rock_is_said_and_the_result_goes_on(scans: Path, tmp_path: Path) -> None:
    (tmp_path / "stable.yaml").write_text("stable_areas:\n- [1, 1, 3, 3]\n")
    first, second, _ = sorted(scans.glob("*.las"))
    words = [str(first), str(second), "--position", ",".join(STATION.split()), "--stable", str(tmp_path / "stable.yaml")]
    assert cli.main(["monitor", *words, "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert "stable rock lies in" in (tmp_path / "out" / "report.html").read_text()


def test_an_epoch_with_few_points_says_how_much_of_the_wall_was_compared(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The reference is given again among the epochs, and the epoch is a folder with a file that states the time of its scan."""
    first, _, _ = sorted(scans.glob("*.las"))
    (tmp_path / "april").mkdir()
    sparse = las(tmp_path / "april" / "scan.las", points(COUNT // 12, 4, BLOCKS))
    (sparse.parent / (sparse.name + SIDECAR)).write_text("2026-04-01\n")
    words = [str(first), str(sparse.parent), "--reference", str(first), "--position", ",".join(STATION.split())]
    assert cli.main(["monitor", *words, "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert "could be compared" in capsys.readouterr().out
    assert "could be compared" in (tmp_path / "out" / "report.html").read_text()


def test_a_wall_that_moved_everywhere_is_said_to_have_no_stable_rock(scans: Path, tmp_path: Path) -> None:
    first, _, _ = sorted(scans.glob("*.las"))
    waves = points(COUNT, 2)
    waves[:, 1] += 0.05 * np.sin(waves[:, 0]) * np.cos(waves[:, 2])
    words = [str(first), str(las(tmp_path / "site_2026-04-01.las", waves)), "--position", ",".join(STATION.split())]
    assert cli.main(["monitor", *words, "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert "hardly any rock is stable" in (tmp_path / "out" / "report.html").read_text()


def test_feet_are_converted_with_their_coordinate_system(tmp_path: Path) -> None:
    """US survey feet, EPSG:2264: outlines are in metres, and their coordinate system places them where the scan was."""
    pyproj, geopandas = pytest.importorskip("pyproj"), pytest.importorskip("geopandas")
    foot, place = 1200 / 3937, np.array([457_200.0, 182_880.0, 100.0]) - UTM
    files = [
        las(tmp_path / f"{month}.las", (points(60_000, seed, blocks) + place) / foot, crs=2264)
        for month, seed, blocks in (("march", 1, ()), ("april", 2, BLOCKS))
    ]
    station = np.array([float(each) for each in STATION.split()]) + place
    monitor_paths(files, tmp_path / "out", MonitorOptions(position=station))
    assert "us-ft" in json.loads((tmp_path / "out" / "monitor.json").read_text())["inputs"][1]["unit"]
    events = geopandas.read_file(tmp_path / "out" / "events.gpkg")
    found = events.to_crs(4269).geometry.iloc[0].centroid
    middle = events.geometry.iloc[0].centroid
    expected = pyproj.Transformer.from_crs(2264, 4269, always_xy=True).transform(middle.x / foot, middle.y / foot)
    assert (found.x, found.y) == pytest.approx(expected, abs=1e-8)


def test_an_elevation_model_keeps_its_coordinate_system() -> None:
    assert "UTM zone 32N" in reading._crs_of_epsg(georeference({GEO_KEYS: _UTM_KEYS}, (2, 2), Path("dem.tif")).epsg)


def mistakes(scans: Path, folder: Path) -> dict[str, tuple[list[str], str]]:
    """Words after `monitor` that are wrong, and what the answer names."""
    first, second, _ = map(str, sorted(scans.glob("*.las")))
    station = ["--position", ",".join(STATION.split())]
    las(folder / "elsewhere.las", points(2000, 4) + np.array([5000.0, 0, 0]))
    las(folder / "feet.las", points(2000, 4) * np.array([3.28, 3.28, 3.28]), crs=None)
    las(folder / "zone33.las", points(2000, 4), crs=32633)
    las(folder / "millimetres.las", 1000 * (points(2000, 4) - UTM), crs=None)
    las(folder / "no_overlap.las", points(COUNT // 4, 4) + np.array([18.0, 0, 0]))
    shutil.copy(first, folder / "copy.las")
    (folder / "areas.yaml").write_text("- [1, 2]\n")
    (folder / "empty").mkdir()
    return {
        "one epoch": ([first, *station], "only 1 epoch is given"),
        "twice": ([first, first, *station], "is given twice"),
        "a copy": ([first, str(folder / "copy.las"), *station], "is a copy of"),
        "millimetres": ([str(folder / "millimetres.las"), second, *station], "--unit"),
        "no overlap": ([first, str(folder / "no_overlap.las"), *station], "registered on"),
        "not there": ([first, "nowhere.laz", *station], "no such file"),
        "times backwards": ([second, first, *station], "is earlier than"),
        "wrong number of times": ([first, second, *station, "--times", "2026-01-01"], "1 times are given for 2 epochs"),
        "no time": ([first, second, *station, "--times", "soon,later"], "ISO 8601"),
        "elsewhere": ([first, str(folder / "elsewhere.las"), *station], "lies elsewhere"),
        "other unit": ([first, str(folder / "feet.las"), *station], "lies elsewhere"),
        "other system": ([first, str(folder / "zone33.las"), *station], "another coordinate system"),
        "no areas": ([first, second, *station, "--stable", str(folder / "areas.yaml")], "is not a list of areas"),
        "empty folder": ([first, str(folder / "empty"), *station], "contains no scan"),
        "two models": ([first, second, *station, "--scanner", "riegl_vz400i", "--model", "m.yaml"], "--scanner"),
        "photographs": ([first, second, *station, "--photographs", "--scanner", "riegl_vz400i"], "--photographs"),
        "pixel too large": ([first, second, *station, "--gsd", "50"], "--gsd"),
        "no detector": ([first, second, *station, "--detector", "nothing_here"], "nothing_here"),
    }


@pytest.mark.parametrize("name", [
    "one epoch", "twice", "a copy", "millimetres", "no overlap",
    "not there", "times backwards", "wrong number of times", "no time", "elsewhere", "other unit",
    "other system", "no areas", "empty folder", "two models", "photographs", "pixel too large", "no detector",
])  # fmt: skip
def test_mistakes(name: str, scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words, problem = mistakes(scans, tmp_path)[name]
    assert cli.main(["monitor", *words, "--out", str(tmp_path / "out"), "--quiet"]) == 2
    told = capsys.readouterr().err
    assert problem in told
    assert told.count("\n") == 1
    assert "Traceback" not in told


def test_large_files_are_read_in_chunks_with_the_same_result(
    scans: Path, result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files above the limit, kept in memory or not: what is found agrees with the files read at once, to the sample of ICP."""
    first, second, _ = sorted(scans.glob("*.las"))
    options = MonitorOptions(position=np.array([float(each) for each in STATION.split()]))
    monkeypatch.setattr(reading, "WHOLE_POINTS", 10_000)
    monkeypatch.setattr(laz_chunks, "CHUNK", 7_000)
    found = {}
    for kept in (0, 10**9):
        monkeypatch.setattr(reading, "_KEPT_POINTS", kept)
        found[kept] = monitor_paths([first, second], tmp_path / str(kept), options)
        (epoch,) = found[kept].epochs
        assert sum(region.volume_m3 for region in epoch.regions) == pytest.approx(VOLUME, rel=0.1)
        assert any("in chunks" in note for note in epoch.record.notes)
        whole = read_geotiff(result / "difference_001.tif")[0]
        chunked = read_geotiff(tmp_path / str(kept) / "difference_001.tif")[0]
        assert chunked.shape == whole.shape
        assert np.nanquantile(np.abs(chunked - whole), 0.99) < 5e-4
        points = read_laz(tmp_path / str(kept) / "epoch_001.laz")
        assert len(points.points) == COUNT
        np.testing.assert_allclose(points.points, read_laz(result / "epoch_001.laz").points, atol=2e-3)


def test_a_large_file_that_is_cut_off_is_refused(scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "WHOLE_POINTS", 10_000)
    first, second, _ = sorted(scans.glob("*.las"))
    (tmp_path / "cut.las").write_bytes(second.read_bytes()[:-100_000])
    with pytest.raises(InputError, match=r"cut\.las"):
        monitor_paths([first, tmp_path / "cut.las"], tmp_path / "out", MonitorOptions(position=np.zeros(3)))
