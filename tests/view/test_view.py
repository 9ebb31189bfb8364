"""`scarpsim view`: the numbers on the page are those of the files, and the page needs no network."""

from __future__ import annotations

import hashlib
import html
import json
import re
import shutil
import threading
import urllib.error
import urllib.request
from base64 import b64encode
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.change.annotate import BLOCK_CATEGORY
from pipeline.change.difference import surface_raster
from pipeline.config.simulation import SimulationConfig
from pipeline.formats.files.atomic import write_json, write_text
from pipeline.formats.meshes.ply import read_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import read_laz, write_laz
from pipeline.formats.rasters.geotiff import read_geotiff, write_geotiff
from pipeline.run.simulation import simulate
from pipeline.view.page import following, pictures
from pipeline.view.results import Item, Patch, ViewWindow, cut
from pipeline.view.server import cookie_name, make_app, make_page_server, open_results, open_second
from pipeline.view.split_view import Pair, border, split_patch
from scene.common.config import parse
from scene.common.errors import InputError
from scene.geometry.grid import Grid

SMALL: dict[str, Any] = {
    "seed": 3,
    "epochs": 2,
    "icp": None,
    "wall": {"style": "glendale", "width_m": 8.0, "height_m": 5.0, "resolution_m": 0.05, "seed": 1},
    "rockfall": {"count": 5, "size_m": {"kind": "gaussian", "mean": 0.5, "sigma": 0.05, "minimum": 0.3}},
    "station": {"distance_m": 20.0},
    "scanner": {"azimuth_step_rad": 0.0015, "zenith_step_rad": 0.0015},
    "difference": {"gsd_m": 0.03},
}
MANY = 10**9
TOKEN = "a-token_of-24-bytes"
OUTSIDE = re.compile(r"""(?:src|href)=["'](?:https?:)?//""")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("view") / "run"
    simulate(parse(SimulationConfig, SMALL, "test"), "tls", out)
    return out


@pytest.fixture(scope="module")
def gap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A diagnosis as `scarpsim gap` writes it: a plane that leans back at 70 degrees, in survey coordinates, with residuals."""
    out = tmp_path_factory.mktemp("gap") / "gap"
    x, up = np.meshgrid(np.linspace(0, 20, 101), np.linspace(0, 10, 51))
    lean = np.deg2rad(70)
    points = np.stack([x.ravel() + 5e5, 4e6 + up.ravel() * np.cos(lean), 300 + up.ravel() * np.sin(lean)], axis=1)
    for name, factor in (("before", 1e-3), ("after", 1e-4)):
        extra = {"residual_m": factor * x.ravel(), "held_out": (x.ravel() > 10).astype(np.uint8)}
        write_laz(out / f"{name}.laz", PointCloud(points, extra=extra))
    change = {"bbox_m": [*points[0], *(points[0] + 1)], "volume_m3": 0.12}
    write_json(out / "gap.json", {"schema": 1, "sensor": "tls", "verdict": "named", "scene_changes": [change]})
    return out


@pytest.fixture(scope="module")
def tiles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("set") / "test"
    values = np.arange(12.0, dtype=np.float32).reshape(3, 4) / 1e3
    write_geotiff(out / "one.tif", values, Grid(1.0, 5.0, 0.5, 4, 3))
    image = {"id": 7, "file_name": "one.tif", "width": 4, "height": 3, "noise_sigma_m": 0.002}
    block = {"id": 1, "image_id": 7, "category_id": 1, "bbox": [1, 0, 2, 1], "block": 5, "volume_m3": 0.25, "shape": "cube"}
    write_json(out / "annotations.json", {"images": [image], "annotations": [block], "categories": [BLOCK_CATEGORY]})
    return out


def test_a_run_shows_the_values_of_its_files(run: Path) -> None:
    results = open_results(run)
    assert list(results.steps) == ["1", "2"]
    layer = results.layers("2")[0]
    patch = results.patch("2", "surface", layer, None, MANY)
    difference, grid = read_geotiff(run / "difference_002.tif")
    surface = surface_raster(read_ply(run / "epoch_002/surface.ply"), grid)
    np.testing.assert_allclose(patch.value, difference * 1e3, rtol=1e-6)
    np.testing.assert_array_equal(patch.height, surface.heights)
    np.testing.assert_array_equal(patch.label, surface.block)
    assert (patch.x[0], patch.y[0]) == (grid.x_min + grid.gsd / 2, grid.y_max - grid.gsd / 2)
    blocks = json.loads((run / "epoch_002/blocks.json").read_text())
    assert [item.name for item in results.items("2")] == [f"block {block['label']}" for block in blocks]


def test_other_surfaces_and_layers(run: Path) -> None:
    results = open_results(run)
    layers = {layer.key: layer for layer in results.layers("1")}
    assert list(layers) == ["difference", "rock", "height"]
    reference = results.patch("1", "reference", layers["height"], None, MANY)
    epoch = results.patch("1", "surface", layers["difference"], None, MANY)
    np.testing.assert_allclose((reference.height - epoch.height) * 1e3, epoch.value, atol=1e-3)  # mm, float32
    truth = results.patch("1", "truth", layers["height"], None, MANY)
    assert np.nanmedian(np.abs(truth.height - epoch.height)) < 0.01  # m; noise of 3 mm, registration


def test_a_window_is_thinned_to_the_budget_by_means(run: Path) -> None:
    results, window = open_results(run), ViewWindow(2.0, 4.0, 1.0, 3.0)
    layer = results.layers("1")[0]
    fine, coarse = (results.patch("1", "surface", layer, window, budget) for budget in (MANY, 300))
    assert fine.pooled == 1
    assert coarse.value.size <= 300 < fine.value.size
    assert (fine.x.min() >= 2.0 - 0.03, fine.x.max() <= 4.03, fine.y.min() >= 0.97, fine.y.max() <= 3.03) == (True,) * 4
    k = coarse.pooled
    cell = fine.value[:k, :k]
    assert coarse.value[0, 0] == pytest.approx(np.nanmean(cell), abs=1e-3)


def test_the_points_of_a_run(run: Path) -> None:
    results = open_results(run)
    cloud = read_laz(run / "epoch_001/points.laz")
    points = results.points("1", results.layers("1")[0], None, 1000)
    assert points is not None
    assert len(points.points) <= 1000
    assert points.share == pytest.approx(len(points.points) / len(cloud.points))
    assert {"intensity", "true_range_m", "block"} <= set(points.facts)
    inside = results.points("1", results.layers("1")[0], ViewWindow(2.0, 4.0, 1.0, 3.0), MANY)
    assert inside is not None
    assert inside.points[:, :2].min(axis=0) == pytest.approx([2, 1], abs=0.1)


def test_detections_lie_where_they_were_found(run: Path, tmp_path: Path) -> None:
    header = "image,number,x_m,y_m,width_m,height_m,area_m2,depth_m,mean_depth_m,volume_m3,score\n"
    write_text(tmp_path / "events_0.9.csv", header + "difference_002.tif,1,3.0,2.0,0.4,0.2,0.08,0.3,0.2,0.016,0.97\n")
    write_text(tmp_path / "events_0.95.csv", header)
    results = open_results(run, tmp_path)
    assert [item.kind for item in results.items("1")] == ["block"] * 5
    (found,) = [item for item in results.items("2") if item.kind == "detection"]
    assert found.box[:4] == pytest.approx((2.8, 3.2, 1.9, 2.1))
    assert found.facts["volume"] == "0.016 m³"
    write_text(tmp_path / "other/events_0.9.csv", header + "difference_009.tif,1,3,2,1,1,1,1,1,1,0.9\n")
    with pytest.raises(InputError, match="no detections of this run's maps"):
        open_results(run, tmp_path / "other")


ROW = {"image": "difference_001.tif", "number": "1", "x_m": "3", "y_m": "2", "width_m": "1", "height_m": "0.4", "area_m2": "0.3"}
ROW |= {"depth_m": "0.1", "mean_depth_m": "0.05", "volume_m3": "0.015", "score": "0.9"}


@pytest.mark.parametrize(
    ("name", "row", "said"),
    [
        ("events_all.csv", ROW, "is not that of a table"),
        ("events_nan.csv", ROW, "is not that of a table"),
        ("events_0.9.csv", {**ROW, "x_m": "left"}, "line 2: the column 'x_m' has the value 'left'"),
        ("events_0.9.csv", {**ROW, "x_m": "nan"}, "finite numbers"),
        ("events_0.9.csv", {"image": "a.tif"}, "not a table of events"),
        ("events_0.9.csv", {**ROW, "more": "1"}, "not a table of events"),
    ],
)
def test_tables_of_events_that_are_none_are_told(name: str, row: dict[str, str], said: str, run: Path, tmp_path: Path) -> None:
    (tmp_path / name).write_text(f"{','.join(row)}\n{','.join(row.values())}\n")
    with pytest.raises(InputError, match=re.escape(said)):
        open_results(run, tmp_path)
    (tmp_path / name).unlink()
    (tmp_path / "events_0.9.csv").write_text(f"{','.join(ROW)}\n{','.join(ROW.values())}\n")
    assert open_results(run, tmp_path).items("1")[-1].box[:4] == (2.5, 3.5, 1.8, 2.2)


def test_clouds_that_are_of_no_diagnosis_are_told(gap: Path, tmp_path: Path) -> None:
    cloud = read_laz(gap / "before.laz")
    for extra, points, said in (
        ({}, cloud.points, "no channel residual_m"),
        ({"residual_m": cloud.extra["residual_m"]}, cloud.points, "no channel held_out"),
        ({**cloud.extra, "residual_m": cloud.extra["residual_m"] * np.nan}, cloud.points, "not numbers"),
        ({key: value[:2] for key, value in cloud.extra.items()}, cloud.points[:2], "contains only 2 points"),
    ):
        shutil.copytree(gap, tmp_path / said)
        write_laz(tmp_path / said / "after.laz", PointCloud(points, extra=extra))
        with pytest.raises(InputError, match=said):
            open_results(tmp_path / said)


def test_keys_of_others_in_a_tile_are_shown_as_far_as_they_are_numbers(tiles: Path, tmp_path: Path) -> None:
    shutil.copytree(tiles, tmp_path / "test")
    path = tmp_path / "test/annotations.json"
    content = json.loads(path.read_text())
    content["images"][0]["noise_sigma_m"] = "low"
    content["annotations"][0] |= {"volume_m3": "much", "depth_m": 0.5, "shape": ["cube"]}
    path.write_text(json.dumps(content))
    results = open_results(tmp_path / "test")
    assert results.layers("7")[0].limit > 0
    assert results.items("7")[0].facts == {"depth": "0.5 m", "shape": "['cube']"}


def test_a_file_that_breaks_under_the_page_is_told_on_it(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    client = make_app(open_results(tmp_path / "run"), TOKEN).server.test_client()
    (tmp_path / "run/difference_001.tif").write_bytes(b"II*\0")
    client.get(f"/?token={TOKEN}", headers={"Host": "127.0.0.1"})
    values = {"step": "1", "layer": "difference", "surface": "surface", "shown": ["surface"], "item": None, "window": None}
    values |= {"beside": "", "border": 50}
    inputs = [{"id": name, "property": "data" if name == "window" else "value", "value": value} for name, value in values.items()]
    outputs = [{"id": "wall", "property": "figure"}, {"id": "map", "property": "figure"}, {"id": "note", "property": "children"}]
    asked = {"output": "..wall.figure...map.figure...note.children..", "outputs": outputs, "inputs": inputs}
    body = {**asked, "changedPropIds": ["step.value"], "parsedChangedPropsIds": ["step.value"]}
    answer = client.post("/_dash-update-component", json=body, headers={"Host": "127.0.0.1"})
    assert answer.status_code == 200
    assert "difference_001.tif" in answer.get_json()["sideUpdate"]["note"]["children"]


def test_a_diagnosis_in_the_wall_s_own_frame(gap: Path) -> None:
    """The wall is 20 x 10 m in its own plane, x runs along it, and the residual grows with x from 0 to 20 mm."""
    results = open_results(gap)
    layer = results.layers("before")[0]
    assert (layer.diverging, layer.unit) == (True, "mm")
    patch = results.patch("before", "surface", layer, None, 60_000)
    assert np.ptp(patch.x) == pytest.approx(20, abs=1)
    assert np.ptp(patch.y) == pytest.approx(10, abs=1)
    assert abs(np.nanmean(patch.value) - 10) < 0.1
    assert np.nanmax(np.abs(patch.height)) < 1e-3
    points = results.points("after", layer, None, MANY)
    assert points is not None
    assert points.value is not None
    np.testing.assert_allclose(points.value, 0.1 * points.points[:, 0], atol=1e-3)  # x from the wall's left edge: mm of 0.1 mm/m
    assert set(points.facts["held out"]) == {"yes", "no"}
    (change,) = results.items("before")
    assert change.facts == {"volume": "0.12 m³"}


def test_effects_of_a_diagnosis_are_switched_on_and_off(gap: Path, tmp_path: Path) -> None:
    """Without effects the residual is 1 mm per metre of x; the first effect removes half of it, the second 0.3 mm everywhere."""
    shutil.copytree(gap, tmp_path / "gap")
    before = read_laz(gap / "before.laz")
    x = 1e3 * before.extra["residual_m"]
    parts = {"effect_1_m": 5e-4 * x, "effect_2_m": np.full(len(x), 3e-4)}
    write_laz(tmp_path / "gap/before.laz", PointCloud(before.points, extra={**before.extra, **parts}))
    record = json.loads((gap / "gap.json").read_text())
    write_json(tmp_path / "gap/gap.json", {**record, "effects": [{"name": "tls.wobble"}, {"name": "tls.range_offset"}]})
    results = open_results(tmp_path / "gap")
    assert dict(results.steps) == {
        "before": "before: model as it was",
        "1": "with tls.wobble alone",
        "2": "with tls.range_offset alone",
        "after": "after: with what was named",
    }
    layer = results.layers("1")[0]
    for step, expected in (("1", 0.5 * x), ("2", x - 0.3)):
        points = results.points(step, layer, None, MANY)
        assert points is not None
        assert points.value is not None
        np.testing.assert_allclose(points.value, expected, atol=1e-6)
    assert list(open_results(gap).steps) == ["before", "after"]


def test_what_stands_beside_begins_at_the_border() -> None:
    """The right map has cells twice as large, ends sooner and has no data in its last column."""
    left = Patch(np.arange(10.0), np.arange(4.0)[::-1], np.zeros((4, 10)), np.zeros((4, 10)), np.zeros((4, 10), int), 1)
    value = np.array([[1.0, 2.0, 3.0, np.nan], [5.0, 6.0, 7.0, np.nan]])
    right = Patch(np.array([0.5, 2.5, 4.5, 6.5]), np.array([2.5, 0.5]), value, value, np.ones((2, 4), int), 1)
    assert border(left, 1 / 3) == 3
    both = split_patch(left, right, 1 / 3)
    np.testing.assert_array_equal(both.value[0], [0, 0, 0, 0, 3, 3, np.nan, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(both.value[3], [0, 0, 0, 0, 7, 7, np.nan, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(both.label[0], [0, 0, 0, 0, 1, 1, 1, 1, 0, 0])
    np.testing.assert_array_equal(split_patch(left, left, 0.0).value, left.value)


def test_two_runs_of_one_wall_stand_side_by_side(run: Path, gap: Path, tmp_path: Path) -> None:
    first = open_results(run)
    second = open_second(run, first)
    pair = Pair(first, second)
    assert list(pair.choices) == ["own 1", "own 2", "other 1", "other 2"]
    layer, window = first.layers("1")[0], ViewWindow(2.0, 4.0, 1.0, 3.0)
    other = pair.patch("other 2", "surface", layer, window, MANY)
    np.testing.assert_array_equal(other.value, first.patch("2", "surface", layer, window, MANY).value)
    _, flat, note = pictures(first, "1", "surface", layer, ["surface"], None, window, (pair, "other 2", 0.5))
    assert note.startswith("Left of the border: run: laser scanner, glendale, epoch 1; right of it: run: ")
    drawn, plain = np.asarray(flat.data[0].z), np.asarray(pictures(first, "1", "surface", layer, [], None, window)[1].data[0].z)
    half = drawn.shape[1] // 2
    np.testing.assert_array_equal(drawn[:, : half - 1], plain[:, : half - 1])
    assert not np.array_equal(drawn[:, half + 1 :], plain[:, half + 1 :], equal_nan=True)
    with pytest.raises(InputError, match="only two runs of one wall"):
        open_second(gap, first)
    shutil.copytree(run, tmp_path / "moved")
    record = json.loads((run / "run.json").read_text())
    record["wall_frame"]["matrix_world_to_wall"][0][3] += 1.0
    write_json(tmp_path / "moved/run.json", record)
    with pytest.raises(InputError, match="shows another wall or uses another wall frame"):
        open_second(tmp_path / "moved", first)


def test_playing_goes_round() -> None:
    assert [following(["1", "2", "3"], step) for step in "123"] == ["2", "3", "1"]


def test_a_tile_as_relief(tiles: Path) -> None:
    results = open_results(tiles)
    patch = results.patch("7", "relief", results.layers("7")[0], None, MANY)
    np.testing.assert_allclose(patch.value, np.arange(12.0).reshape(3, 4), rtol=1e-5)
    np.testing.assert_allclose(patch.height, -patch.value / 1e3, rtol=1e-5)
    assert results.layers("7")[0].limit == pytest.approx(12.0)
    (block,) = results.items("7")
    assert block.box[:4] == pytest.approx((1.5, 2.5, 4.5, 5.0))
    assert block.facts == {"volume": "0.25 m³", "shape": "cube"}


def test_windows_beyond_the_raster_keep_a_pixel() -> None:
    grid = Grid(0.0, 10.0, 1.0, 20, 10)
    for window in (ViewWindow(-50, -40, 0, 5), ViewWindow(30, 40, 20, 30), ViewWindow(5.2, 5.3, 5.2, 5.3)):
        rows, columns, factor = cut(grid, window, 100)
        assert (rows.stop > rows.start, columns.stop > columns.start, factor) == (True, True, 1)
    assert cut(grid, None, 2)[2] == 10


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda _: Path("/nowhere"), "there is no such folder"),
        (lambda folder: folder, "contains no results that can be shown"),
        (lambda folder: _written(folder, "run.json", "{"), "run.json: the file is not JSON"),
        (lambda folder: _written(folder, "run.json", '{"sensor": "tls", "config": {}}'), "contains no finished epoch"),
        (lambda folder: _written(folder, "gap.json", "[]"), "gap.json: the content must be a mapping"),
        (lambda folder: _written(folder, "annotations.json", "{}"), "is not a COCO annotation file"),
    ],
)
def test_other_folders_are_told(make: Any, expected: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=expected):
        open_results(make(tmp_path))


def _written(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder


@pytest.fixture
def address(run: Path) -> Iterator[str]:
    server = make_page_server(open_results(run), 0, TOKEN)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()


def asked(address: str, **headers: str) -> urllib.request.Request:
    host = address.removeprefix("http://").partition("/")[0]
    return urllib.request.Request(address, headers={"Cookie": f"{cookie_name(host)}={TOKEN}", **headers})


def get(address: str, **headers: str) -> str:
    with urllib.request.urlopen(asked(address, **headers), timeout=30) as answer:
        return str(answer.read().decode())


def test_the_page_comes_whole_from_this_machine(address: str) -> None:
    page = get(address)
    assert OUTSIDE.search(page) is None
    scripts = re.findall(r'<script src="([^"]+)"', page)
    assert scripts
    assert all(len(get(address + script)) > 0 for script in scripts)
    assert '"wall"' in get(f"{address}/_dash-layout")


EVIL = "</title><script>alert(1)</script><b>'\"&"


def test_a_name_out_of_a_file_stays_text(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    record = json.loads((run / "run.json").read_text())
    record["wall"]["name"] = EVIL
    write_json(tmp_path / "run" / "run.json", record)
    app = make_app(open_results(tmp_path / "run"), TOKEN)
    client = app.server.test_client()
    page = client.get(f"/?token={TOKEN}", headers={"Host": "127.0.0.1"}, follow_redirects=True).get_data(as_text=True)
    (title,) = re.findall(r"<title>(.*?)</title>", page)
    assert html.unescape(title) == f"scarpsim: run: laser scanner, {EVIL}"
    assert "<script>alert" not in page


def test_the_page_runs_its_own_scripts_only(address: str) -> None:
    """In every response, each script of the page is allowed by its hash, and no other script is."""
    with urllib.request.urlopen(asked(address), timeout=30) as answer:
        page, policy = answer.read().decode(), answer.headers["Content-Security-Policy"]
    allowed = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    without_comments = re.sub(r"<!--.*?-->", "", page, flags=re.DOTALL)
    inline = re.findall(r"<script(?![^>]*(?:src=|application/json))[^>]*>(.*?)</script>", without_comments, re.DOTALL)
    hashes = {f"'sha256-{b64encode(hashlib.sha256(script.encode()).digest()).decode()}'" for script in inline}
    assert hashes
    assert set(allowed["script-src"].split()) == {"'self'", *hashes}
    assert allowed["default-src"] == allowed["frame-ancestors"] == allowed["base-uri"] == allowed["form-action"] == "'none'"
    assert "http" not in policy
    with urllib.request.urlopen(asked(f"{address}/_dash-layout"), timeout=30) as answer:
        assert answer.headers["Content-Security-Policy"] == policy


def test_the_page_answers_to_this_machine_s_names_only(address: str) -> None:
    with pytest.raises(urllib.error.HTTPError, match="403"):
        get(address, Host="evil.example")
    assert address.startswith("http://127.0.0.1:")
    with pytest.raises(InputError, match="cannot be used"):
        make_page_server(open_results_of_nothing(), int(address.rpartition(":")[2]), TOKEN)


def test_the_page_answers_to_those_who_know_the_token_only(address: str) -> None:
    """Another user of the machine who finds the port is refused.

    The address that the command prints sets a cookie and shows no token.
    """
    name = cookie_name(address)
    for place in ("/", "/_dash-layout", "/_dash-update-component", "/?token=", "/?token=another", "/assets/page.css"):
        for cookie in ("", f"{name}=", f"{name}=another", f"{name}0={TOKEN}"):
            with pytest.raises(urllib.error.HTTPError, match="403"):
                get(f"{address}{place}", Cookie=cookie)
    jar = urllib.request.HTTPCookieProcessor()
    opener = urllib.request.build_opener(jar)
    with opener.open(f"{address}/?token={TOKEN}", timeout=30) as answer:
        assert answer.geturl() == f"{address}/"
    (cookie,) = jar.cookiejar
    assert cookie.has_nonstandard_attr("HttpOnly")
    assert cookie.get_nonstandard_attr("SameSite") == "Strict"
    with opener.open(f"{address}/_dash-layout", timeout=30) as answer:
        assert answer.status == 200


def open_results_of_nothing() -> Any:
    class Nothing:
        title, step_name, steps, surfaces = "nothing", "step", {"1": "one"}, {"surface": "surface"}

        def items(self, step: str) -> list[Item]:
            return []

    return Nothing()
