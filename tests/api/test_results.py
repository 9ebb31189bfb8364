"""What the functions of the Python interface return: values, coordinates, units, types."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import geopandas
import laspy
import numpy as np
import pytest
import rasterio
import rioxarray
import trimesh
import xarray

from pipeline import Mesh, Points, Run, SimulationConfig, configure, detect, open_run, plan, simulate
from pipeline.api import detecting, planning
from pipeline.api.maps import raster_of
from pipeline.formats.points.laz import read_laz
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.report.progress import Progress
from scene import InputError

TINY: dict[str, Any] = {
    "wall": {"style": "pilkington", "width_m": 6.0, "height_m": 4.0, "resolution_m": 0.1},
    "rockfall__count": 3,
    "station__distance_m": 20.0,
    "scanner__azimuth_step_rad": 0.002,
    "scanner__zenith_step_rad": 0.002,
    "difference__gsd_m": 0.05,
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return simulate(None, "tls", out=tmp_path_factory.mktemp("runs") / "tiny", seed=4, progress=False, **TINY)


def test_a_difference_map_lies_where_the_geotiff_does(run: Run) -> None:
    found, file = run[1].difference, run.folder / "difference_001.tif"
    with rioxarray.open_rasterio(file) as raster, rasterio.open(file) as plain:
        assert np.array_equal(found.values, raster.squeeze("band").values, equal_nan=True)
        assert np.allclose(found.rio.bounds(), plain.bounds)
        assert found.rio.crs == plain.crs
    assert found.dims == ("y", "x")
    assert found.attrs["units"] == found.x.attrs["units"] == "m"
    assert run.differences.sel(epoch=1).drop_vars("epoch").equals(found)
    matrix = np.reshape(found.attrs["matrix_world_to_wall"], (4, 4))
    assert np.allclose(matrix @ [1, 2, 3, 1], [*run.frame.to_wall(np.array([1.0, 2.0, 3.0])), 1])


def test_a_map_goes_to_a_raster_and_back(run: Run) -> None:
    values, grid = raster_of(run[1].difference.isel(y=slice(None, None, -1)), "map")
    expected, place = read_geotiff(run.folder / "difference_001.tif")
    assert np.array_equal(values, expected, equal_nan=True)
    assert (grid.width, grid.height) == (place.width, place.height)
    assert np.allclose((grid.x_min, grid.y_max, grid.gsd), (place.x_min, place.y_max, place.gsd))


@pytest.mark.parametrize(
    ("array", "problem"),
    [
        (xarray.DataArray(np.zeros((2, 2, 2)), dims=("epoch", "y", "x")), "dimensions"),
        (xarray.DataArray(np.zeros((2, 2)), coords={"y": [0.0, 1.0], "x": [0.0, 2.0]}, dims=("y", "x")), "1 to 2 m"),
        (xarray.DataArray(np.zeros((1, 2)), coords={"y": [0.0], "x": [0.0, 2.0]}, dims=("y", "x")), "1 x 2 pixels"),
    ],
)
def test_what_is_no_map(array: xarray.DataArray, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        raster_of(array, "map")


def test_blocks_are_what_the_files_say(run: Run) -> None:
    found, held = run.blocks, json.loads((run.folder / "epoch_001" / "blocks.json").read_text())
    assert isinstance(found, geopandas.GeoDataFrame)
    assert found.crs == run[1].difference.rio.crs
    assert found.block.tolist() == [each["label"] for each in held]
    assert found.volume_m3.tolist() == [each["volume_m3"] for each in held]
    x0, y0, _, x1, y1, _ = held[0]["bbox_m"]
    assert found.geometry[0].bounds == (x0, y0, x1, y1)
    assert [found.world_x_m[0], found.world_y_m[0], found.world_z_m[0]] == held[0]["world_position_m"]
    annotated = {each["block"] for each in run.annotations["annotations"]}
    assert set(found.block[found.annotated]) == annotated


def test_points_are_the_files_and_go_to_others(run: Run, tmp_path: Path) -> None:
    found, held = run[1].points, read_laz(run.folder / "epoch_001" / "points.laz")
    assert np.array_equal(found.xyz, held.points)
    assert np.array_equal(found["block"], held.extra["block"])
    assert type(found["x"]) is np.ndarray
    assert isinstance(found[found["block"] == 0], Points)
    assert np.array_equal(np.asarray(found.to_open3d().points), held.points)
    assert np.array_equal(found.to_pyvista().point_data["block"], held.extra["block"])
    again = read_laz(found.save(tmp_path / "again.laz"))
    assert np.abs(again.points - held.points).max() < 1e-6
    with laspy.CopcReader.open(found.save(tmp_path / "again.copc.laz")) as reader:
        assert len(reader.query()) == len(held.points)
    with pytest.raises(InputError, match=r"allowed: \.laz"):
        found.save(tmp_path / "points.dwg")


def test_meshes_go_to_others(run: Run, tmp_path: Path) -> None:
    truth = run[1].truth
    for other in (truth.to_trimesh().vertices, np.asarray(truth.to_open3d().vertices), truth.to_pyvista().points):
        assert np.allclose(other, truth.vertices, atol=1e-5)
    assert np.array_equal(truth.to_pyvista().cell_data["block"], truth.face_block)
    assert np.array_equal(Mesh.read(truth.save(tmp_path / "mesh.ply")).faces, truth.faces)
    with pytest.raises(InputError, match="are not indices of vertices"):
        Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 3]])


def test_everything_with_a_picture_shows_it(run: Run, tmp_path: Path) -> None:
    pictures = [run.plot(), run.plot("histogram"), run[0].plot(), run[1].points.plot("intensity"), run[1].surface.plot(0.1)]
    for number, each in enumerate(pictures):
        assert each._repr_png_().startswith(b"\x89PNG")
        assert each.save(tmp_path / f"{number}.png").stat().st_size > 1000
    for shown in (run, run[1], run[1].points, run[1].surface):
        assert "<table>" in shown._repr_html_()
        assert len(repr(shown)) < 2000
    assert repr(run) == f"<Run {run.folder}: tls, 1 epoch>"
    assert len(repr(pictures[0])) < 60
    with pytest.raises(InputError, match="allowed: difference"):
        run.plot("diference")


def test_a_surface_goes_to_slides_with_its_differences_as_colours(run: Run, tmp_path: Path) -> None:
    scene = trimesh.load(run[1].save_gltf(tmp_path / "wall.glb"))
    (mesh,) = scene.geometry.values()
    surface = run[1].surface
    assert np.allclose(mesh.vertices, surface.vertices, atol=1e-4)
    red, green, blue, _ = np.asarray(mesh.visual.vertex_colors, dtype=int).T
    x, y = (xarray.DataArray(surface.vertices[:, axis]) for axis in (0, 1))
    fallen = run[1].difference.interp(x=x, y=y, method="nearest")
    assert np.all((red > green + 80)[fallen.values > 0.1])
    assert np.median(np.abs(red - blue)[np.abs(fallen.values) < 0.002]) < 60
    with pytest.raises(InputError, match=r"allowed: \.glb"):
        run[1].save_gltf(tmp_path / "wall.obj")


def test_an_opened_run_is_the_same(run: Run, tmp_path: Path) -> None:
    found = open_run(str(run.folder))
    assert found.config == run.config
    assert found.sensor == "tls"
    assert len(found) == 2
    assert found.statistics.nmad_m[0] == run.record["epochs"][1]["statistics"]["outside_blocks"]["nmad_m"]
    with pytest.raises(InputError, match=r"contains no run\.json"):
        open_run(tmp_path)
    with pytest.raises(IndexError, match="0, the reference, to 1"):
        run[2]


@pytest.mark.parametrize(
    ("file", "keys", "value", "problem", "use"),
    [
        (
            "run.json",
            ["sensor"],
            "sonar",
            r"run\.json: keys or values are wrong: 'sensor': .* got 'sonar'",
            lambda run: run.sensor,
        ),
        ("run.json", ["wall_frame", "origin_m"], [0, 0], r"wall_frame\.origin_m", lambda run: run.frame),
        ("run.json", ["epochs", 1, "blocks", 0, "bbox_m"], "wide", r"bbox_m", lambda run: run.blocks),
        ("run.json", ["epochs", 1, "statistics", "outside_blocks"], {"count": 3}, "median_m", lambda run: run.statistics),
        ("run.json", ["epochs", 1, "statistics"], None, "no statistics", lambda run: run.statistics),
        ("annotations.json", ["images", 0, "epoch"], "first", "epoch", lambda run: run.blocks),
    ],
)
def test_a_record_is_checked_where_it_is_read(
    run: Run, tmp_path: Path, file: str, keys: list[str | int], value: Any, problem: str, use: Any
) -> None:
    for name in ("run.json", "annotations.json"):
        record = json.loads((run.folder / name).read_text())
        if name == file:
            part = record
            for key in keys[:-1]:
                part = part[key]
            part[keys[-1]] = value
        (tmp_path / name).write_text(json.dumps(record))
    with pytest.raises(InputError, match=problem):
        use(Run(tmp_path))


def test_blocks_of_a_run_that_does_not_hold_their_place_in_the_world(run: Run, tmp_path: Path) -> None:
    """Runs from before November 2026 lack the world coordinates of blocks, which then come from the wall frame."""
    record = json.loads((run.folder / "run.json").read_text())
    for block in record["epochs"][1]["blocks"]:
        del block["world_position_m"]
    (tmp_path / "run.json").write_text(json.dumps(record))
    (tmp_path / "annotations.json").write_bytes((run.folder / "annotations.json").read_bytes())
    place = ["world_x_m", "world_y_m", "world_z_m"]
    assert np.allclose(Run(tmp_path).blocks[place], run.blocks[place], rtol=0, atol=1e-9)


def test_detections_of_a_run_and_of_its_map_are_the_same(run: Run, tmp_path: Path) -> None:
    of_run = detect(run, "baseline", confidence=0.5, out=tmp_path / "found", progress=False)
    of_map = detect([run[1].difference], "baseline", confidence=0.5, progress=False)
    assert len(of_run) > 0
    place = ["world_x_m", "world_y_m", "world_z_m"]  # a map by itself does not say where its wall stands
    numbers = [events.drop(columns=["image", "geometry", *place]) for events in (of_run.events, of_map.events)]
    assert np.allclose(*numbers, rtol=0, atol=1e-9)
    assert np.isfinite(of_run.events[place]).all(axis=None)
    assert of_map.events[place].isna().all(axis=None)
    assert of_run.volume_m3 == pytest.approx(of_run.events.volume_m3.sum())
    assert of_map.plot().png.startswith(b"\x89PNG")
    with pytest.raises(InputError, match="allowed"):
        detect(run, "baseline", confidence=1.5)


def test_a_detector_says_what_it_waits_for(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = Progress()

    def stop(*_: Any, **__: Any) -> None:
        raise InputError(shown.current)

    monkeypatch.setattr(detecting, "python_progress", lambda show: shown)
    monkeypatch.setattr(detecting, "_in_another_process", stop)
    with pytest.raises(InputError, match="TensorFlow takes ten seconds"):
        detect(run)


def test_a_plan_says_where_which_block_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = Progress()
    monkeypatch.setattr(planning, "python_progress", lambda show: shown if show else Progress())
    found = plan(None, "tls", planning__gsd_m=0.2, progress=True, **TINY)[0]
    assert list(shown.timings) == ["tls: wall", "tls: maps"]
    maps = found.maps
    assert maps.smallest_block_m.attrs["units"] == "m"
    assert maps.incidence_rad.attrs["units"] == "rad"
    assert 0 < found.table.loc["smallest_block_m", "middle"] < 0.5
    assert found.table.loc["range_m", "median"] == pytest.approx(20, abs=2)
    assert "the fall of a block with sides of" in found._repr_html_()


def test_configs_by_object_mapping_file_and_keyword_are_one(run: Run, tmp_path: Path) -> None:
    config = configure(None, seed=4, **TINY)
    assert config == run.config
    assert configure(config) == config
    assert configure(config.model_dump(mode="json")) == config
    assert configure(run.folder) == config
    assert isinstance(config, SimulationConfig)
    assert configure(config, rockfall__count=9).rockfall.count == 9
    assert configure("glendale", scanner="riegl_vz400i").scanner.name
    model = configure(model="glendale_high").stereo_model()
    assert model != configure().stereo_model()
    assert configure(model=model).stereo_model() == model


@pytest.mark.parametrize(
    ("call", "problem"),
    [
        (lambda: configure(rockfall__cuont=5), "did you mean 'count'"),
        (lambda: configure("glendal"), "did you mean 'glendale'"),
        (lambda: simulate(), "and none was chosen; give sensor='tls'"),
        (lambda: simulate(sensor="radar"), "allowed: 'stereo', 'tls'"),
        (lambda: simulate(wall={"mesh": Path("nothing.ply")}, sensor="tls"), "nothing.ply"),
    ],
)
def test_mistakes_are_said_in_one_line(call: Any, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=problem) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_a_missing_library_names_its_extra(monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    monkeypatch.setitem(sys.modules, "rioxarray", None)
    with pytest.raises(InputError, match="make setup EXTRAS=notebook"):
        _ = run[1].difference


def test_importing_costs_nothing_and_rooms_do_not_hide_functions() -> None:
    program = (
        "import sys, pipeline, scene, sensors\n"
        "loaded = {'numpy', 'mitsuba', 'xarray', 'pydantic', 'matplotlib'} & set(sys.modules)\n"
        "from pipeline import compare, calibrate, detect, open_run\n"
        "import pipeline.comparison, pipeline.detection, pipeline.calibration\n"
        "from pipeline import compare, calibrate, detect\n"
        "heavy = {'xarray', 'geopandas', 'pyvista', 'open3d', 'tensorflow', 'IPython'} & set(sys.modules)\n"
        "print(loaded, heavy, callable(compare), callable(calibrate), callable(detect))"
    )
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert shown.strip() == "set() set() True True True"
