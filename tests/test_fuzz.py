"""Configs and input files with random damage: they load, or raise one InputError that says what is wrong, and nothing else.

Hypothesis draws the damage, the same in each run (derandomised); docs/validation lists the faults that have tests of their own.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from config_loaders import LOADERS
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from pipeline.config.overrides import apply_overrides
from pipeline.formats.cameras.camera_files import read_lens, read_oriented
from pipeline.formats.cameras.cameras import read_cameras_yaml, write_cameras_yaml
from pipeline.formats.cameras.colmap import read_map, write_map
from pipeline.formats.cameras.metashape import write_calibration, write_metashape
from pipeline.formats.cameras.opencv import write_opencv
from pipeline.formats.meshes.ply import read_ply, read_ply_points, write_ply, write_ply_points
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.e57 import E57Scan, read_e57, write_e57
from pipeline.formats.points.laz import read_laz, write_laz
from pipeline.formats.points.xyz import read_xyz, write_xyz
from pipeline.formats.rasters.geotiff import read_geotiff, write_geotiff
from scene.common.config import load_yaml
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh
from scene.walls.imported import ImportedWall
from sensors.cameras.camera import Camera, CameraPair

CONFIGS = Path(__file__).parent / "configs_of_versions" / "0.1"
EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "25"))
"""Of each kind of file and damage; benchmarks/fuzz.py tries 500."""
QUICK = settings(
    derandomize=True,
    database=None,
    max_examples=EXAMPLES,
    phases=[Phase.generate],
    deadline=timedelta(seconds=60),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
"""The deadline is for hangs only; what fails is not made smaller, which would take long where it is slow."""

ODD = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.sampled_from([0, -1, 10**30, 1e308, -1e-308, float("nan"), float("inf"), "", "x", "../..", "\0", "1e3", [], {}, [[1]]]),
    st.floats(),
    st.text(max_size=8),
    st.lists(st.floats(), max_size=4),
    st.dictionaries(st.text(max_size=4), st.integers(), max_size=2),
)


def answered(load: Callable[[], Any]) -> None:
    """Assert that `load` ends with a result or with an InputError of one line."""
    try:
        load()
    except InputError as error:
        assert "\n" not in str(error)  # noqa: PT017  (the result may also be right)


def places(values: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path to every value in nested mappings and lists."""
    for key, value in values.items() if isinstance(values, dict) else enumerate(values):
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))


@pytest.mark.parametrize("kind", LOADERS)
@QUICK
@given(data=st.data())
def test_a_config_with_an_odd_value(kind: str, tmp_path: Path, data: st.DataObject) -> None:
    values = copy.deepcopy(load_yaml(CONFIGS / f"{kind}.yaml"))
    path = data.draw(st.sampled_from(list(places(values))))
    holder = values
    for key in path[:-1]:
        holder = holder[key]
    match data.draw(st.sampled_from(["other", "gone", "new"])):
        case "other":
            holder[path[-1]] = data.draw(ODD)
        case "gone":
            del holder[path[-1]]
        case "new":
            values[data.draw(st.text(max_size=5))] = data.draw(ODD)
    file = tmp_path / f"{kind}.yaml"
    file.write_text(yaml.safe_dump(values, allow_unicode=True), encoding="utf-8", errors="surrogatepass")
    answered(lambda: LOADERS[kind](file))


@pytest.mark.parametrize("kind", LOADERS)
@QUICK
@given(data=st.data())
def test_a_config_with_damaged_text(kind: str, tmp_path: Path, data: st.DataObject) -> None:
    file = tmp_path / f"{kind}.yaml"
    file.write_bytes(damaged((CONFIGS / f"{kind}.yaml").read_bytes(), data))
    answered(lambda: LOADERS[kind](file))


@QUICK
@given(override=st.one_of(st.text(max_size=20), st.tuples(st.sampled_from(["wall", "wall.style", "epochs", "a.0"]), ODD)))
def test_an_odd_override(override: str | tuple[str, Any]) -> None:
    text = override if isinstance(override, str) else f"{override[0]}={override[1]}"
    answered(lambda: apply_overrides({"wall": {"style": "glendale"}, "a": [1]}, [text]))


@pytest.mark.parametrize("kind", LOADERS)
def test_a_bomb_of_aliases(kind: str, tmp_path: Path) -> None:
    """Eleven lines stand for 31 thousand million values."""
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 9)}]" for level in range(1, 11)]
    first = next(iter(load_yaml(CONFIGS / f"{kind}.yaml")))
    file = tmp_path / f"{kind}.yaml"
    file.write_text("\n".join([*lines, f"{first}: *a10", "seed: *a10"]))
    with pytest.raises(InputError) as caught:
        LOADERS[kind](file)
    assert len(str(caught.value)) < 3000


def test_an_archive_is_no_wall(tmp_path: Path) -> None:
    """Nothing is unpacked, so an archive cannot fill memory or disk."""
    for name in ("wall.zip", "wall.tar.gz", "wall.bz2"):
        (tmp_path / name).write_bytes(b"PK")
        with pytest.raises(InputError, match="is not a mesh format"):
            ImportedWall(mesh=tmp_path / name).load()


def damaged(whole: bytes, data: st.DataObject) -> bytes:
    """Return `whole` cut off, with bytes changed, or with bytes inserted."""
    at = data.draw(st.integers(0, len(whole) - 1) | st.integers(0, min(len(whole), 400) - 1), label="at")
    match data.draw(st.sampled_from(["cut", "change", "insert", "zero"])):
        case "cut":
            return whole[:at]
        case "change":
            new = data.draw(st.binary(min_size=1, max_size=8))
            return whole[:at] + new + whole[at + len(new) :]
        case "insert":
            return whole[:at] + data.draw(st.binary(min_size=1, max_size=8)) + whole[at:]
    return whole[:at] + bytes(16) + whole[at + 16 :]


CLOUD = PointCloud(
    points=np.random.default_rng(1).uniform(0, 9, (60, 3)),
    intensity=np.linspace(0, 1, 60, dtype=np.float32),
    gps_time=np.arange(60.0),
    extra={"true_range_m": np.linspace(90, 110, 60)},
)
MESH = TriangleMesh(
    vertices=np.array([[0.0, 0, 0], [9, 0, 0], [9, 0, 9], [0, 0, 9], [4, 1, 4]]),
    faces=np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]], dtype=np.int32),
)
LENS = {"b1": 0.0, "b2": 0.0, "k1": -0.08, "k2": 0.01, "k3": 0.0, "k4": 0.0, "p1": 1e-4, "p2": 0.0}
CAMERA = Camera(640, 480, 900.0, 1.0, -2.0, **LENS, position=np.zeros(3), rotation=np.eye(3))
PAIR = CameraPair(CAMERA, CAMERA)
MAP = np.random.default_rng(2).normal(0, 0.01, (20, 30)).astype(np.float32)

FILES: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any]]] = {
    "a.laz": (lambda path: write_laz(path, PointCloud(CLOUD.points, CLOUD.intensity, extra=CLOUD.extra)), read_laz),
    "a.las": (lambda path: write_laz(path, PointCloud(CLOUD.points, CLOUD.intensity, extra=CLOUD.extra)), read_laz),
    "a.e57": (lambda path: write_e57(path, [E57Scan("scan", CLOUD, np.zeros(3), np.eye(3))]), read_e57),
    "a.xyz": (lambda path: write_xyz(path, CLOUD), read_xyz),
    "points.ply": (lambda path: write_ply_points(path, CLOUD), read_ply_points),
    "mesh.ply": (lambda path: write_ply(path, MESH), read_ply),
    "wall.ply": (lambda path: write_ply(path, MESH), lambda path: ImportedWall(mesh=path).load()),
    "map.tif": (lambda path: write_geotiff(path, MAP, Grid(0.0, 2.0, 0.1, 30, 20)), read_geotiff),
    "map.bin": (lambda path: write_map(path, MAP), read_map),
    "cameras.xml": (lambda path: write_metashape(path, {"left": CAMERA, "right": CAMERA}), read_oriented),
    "lens.xml": (lambda path: write_calibration(path, CAMERA), read_lens),
    "lens.yaml": (lambda path: write_opencv(path, CAMERA), read_lens),
    "cameras.yaml": (lambda path: write_cameras_yaml(path, PAIR), read_cameras_yaml),
}


@pytest.mark.parametrize("name", FILES)
@QUICK
@given(data=st.data())
def test_a_damaged_file(name: str, tmp_path: Path, data: st.DataObject) -> None:
    write, read = FILES[name]
    file, whole = tmp_path / name, tmp_path / f"whole_{name}"
    if not whole.exists():
        write(whole)
        read(whole)
    file.write_bytes(damaged(whole.read_bytes(), data))
    answered(lambda: read(file))
