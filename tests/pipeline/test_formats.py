"""Files of every format: written completely or not at all, system errors in one line, equal bytes for equal arguments."""

from __future__ import annotations

import errno
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from format_cases import GRID, a_cloud, a_mesh, a_raster

from pipeline.formats.files.atomic import write_bytes, write_json, write_text, writing
from pipeline.formats.meshes.ply import write_ply, write_ply_points
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from pipeline.formats.rasters.geotiff import write_geotiff, write_tiff
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh


@pytest.fixture
def cloud() -> PointCloud:
    return a_cloud()


@pytest.fixture
def mesh() -> TriangleMesh:
    return a_mesh()


@pytest.fixture
def raster() -> np.ndarray:
    return a_raster()


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """Let no file grow beyond `size` bytes, so that writing fails as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_failure_leaves_the_old_file_and_no_temporary(tmp_path: Path) -> None:
    path = tmp_path / "sub" / "a.txt"
    write_text(path, "old")
    with pytest.raises(RuntimeError, match="stop"):
        _fail_half_way(path)
    assert path.read_text() == "old"
    assert list(path.parent.iterdir()) == [path]


def _fail_half_way(path: Path) -> None:
    with writing(path) as temporary:
        temporary.write_text("half")
        assert temporary.suffix == path.suffix
        raise RuntimeError("stop")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_killed_in_the_middle_leaves_no_file(tmp_path: Path, number: signal.Signals) -> None:
    code = (
        "import sys, time; from pathlib import Path; from pipeline.formats.files.atomic import writing\n"
        "with writing(Path(sys.argv[1])) as t:\n t.write_bytes(b'half'); print('ready', flush=True); time.sleep(60)"
    )
    path = tmp_path / "a.bin"
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # jobs in the background of a shell ignore it
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    process.send_signal(number)
    process.communicate()
    assert not path.exists()
    if number == signal.SIGINT:
        assert list(tmp_path.iterdir()) == []
    write_bytes(path, b"whole")  # what a kill left is overwritten
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOSPC, "the disk is full"),
        (errno.EDQUOT, "quota"),
        (errno.EACCES, "cannot be written"),
        (errno.EROFS, "Read-only"),
    ],
)
def test_system_errors_become_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, words: str) -> None:
    def fail(*_: object) -> int:
        raise OSError(code, os.strerror(code))

    path = tmp_path / "a.json"
    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(InputError, match=words) as caught:
        write_json(path, [1])
    assert str(path) in str(caught.value)
    assert "--out" in caught.value.remedy
    assert list(tmp_path.iterdir()) == []


def test_paths_that_cannot_be_files(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "file" / "a.txt", tmp_path / "folder"):
        with pytest.raises(InputError, match="cannot be a file"):
            write_text(path, "a")
    assert sorted(item.name for item in tmp_path.iterdir()) == ["file", "folder"]


@pytest.mark.parametrize("size", [10, 3000, 200_000])
def test_full_disk_in_every_format(tmp_path: Path, cloud: PointCloud, mesh: TriangleMesh, size: int) -> None:
    big = np.zeros((300, 300), dtype=np.float32)
    faces = np.tile(mesh.faces, (20, 1))
    writers: list[Callable[[], None]] = [
        lambda: write_laz(tmp_path / "a.laz", PointCloud(cloud.points)),
        lambda: write_laz(tmp_path / "a.las", PointCloud(cloud.points)),
        lambda: write_ply(tmp_path / "a.ply", TriangleMesh(mesh.vertices, faces)),
        lambda: write_ply_points(tmp_path / "b.ply", cloud),
        lambda: write_tiff(tmp_path / "a.tif", big),
        lambda: write_geotiff(tmp_path / "b.tif", big, Grid(0, 6, 0.02, 300, 300)),
    ]
    for write in writers:
        with file_size_limit(size), pytest.raises(InputError, match=r"are free; make room"):
            write()
        assert list(tmp_path.iterdir()) == []
        write()
        for path in tmp_path.iterdir():
            path.unlink()


def test_json_holds_numpy_values_and_refuses_nan(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"b": np.float64(0.5), "a": np.arange(3), "c": np.int32(7), "d": np.bool_(True), "e": Path("x/y")})
    assert json.loads(path.read_text()) == {"b": 0.5, "a": [0, 1, 2], "c": 7, "d": True, "e": "x/y"}
    assert path.read_text().index('"b"') < path.read_text().index('"a"')
    with pytest.raises(ValueError, match="Out of range"):
        write_json(path, {"a": float("nan")})
    with pytest.raises(TypeError, match="no JSON form"):
        write_json(path, {"a": object()})
    assert json.loads(path.read_text())["c"] == 7


def test_equal_arguments_give_equal_bytes(tmp_path: Path, cloud: PointCloud, mesh: TriangleMesh, raster: np.ndarray) -> None:
    writers: list[Callable[[Path], None]] = [
        lambda path: write_laz(path, cloud),
        lambda path: write_ply(path, mesh),
        lambda path: write_geotiff(path, raster, GRID, description="a"),
        lambda path: write_tiff(path, raster),
    ]
    for write in writers:
        write(tmp_path / "a.laz")
        write(tmp_path / "b.laz")
        assert (tmp_path / "a.laz").read_bytes() == (tmp_path / "b.laz").read_bytes()
