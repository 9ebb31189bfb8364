"""`scarpsim surface`: points become a wall that is where they are."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from surfaces import heightfield

from pipeline.cli import main as cli
from pipeline.formats.meshes.ply import read_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from scene.walls.imported import ImportedWall

STATION = np.array([345203.0, 6389435.0, 122.0])
ORIGIN = np.array([345200.0, 6389450.0, 120.0])
TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""The heightfield's x, y, z as east, up and towards the south."""


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Points every 8 cm on a rough wall of 6 x 4 m in survey coordinates, in no order."""
    points = heightfield(6.0, 4.0, 0.08, roughness=0.05).vertices
    path = tmp_path_factory.mktemp("cloud") / "scan.laz"
    write_laz(path, PointCloud(np.random.default_rng(1).permutation(points) @ TURN.T + ORIGIN))
    return path


def test_points_become_a_wall_where_they_are(cloud: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = cloud.with_name("wall.ply")
    seen_from = [str(value) for value in STATION]
    assert cli.main(["surface", str(cloud), "--seen-from", *seen_from, "--out", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["points"] == 76 * 51
    mesh = read_ply(out)
    local = (mesh.vertices - ORIGIN) @ TURN
    inside = (local[:, :2] > 0.3).all(axis=1) & (local[:, 0] < 5.7) & (local[:, 1] < 3.7)
    truth = heightfield(6.0, 4.0, 0.08, roughness=0.05).vertices
    nearest = np.linalg.norm(local[inside][:, None, :2] - truth[None, ::1, :2], axis=2).argmin(axis=1)
    assert np.median(np.abs(local[inside, 2] - truth[nearest, 2])) < 0.01
    assert np.mean(mesh.face_normals()[:, 1] < 0) > 0.99
    wall, _ = ImportedWall(mesh=out).load()
    assert np.ptp(wall.vertices, axis=0)[0] == pytest.approx(6.0, abs=0.5)


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--seen-from", "0", "0", "0", "--out", "wall2.ply"], "--seen-from: lies 6,398,"),
        (["--seen-from", "0", "0", "0", "--out", "wall.obj"], "--out: got '.obj'; allowed: .ply"),
        (["--out", "wall2.ply"], "required: --seen-from"),
    ],
)
def test_mistakes(words: list[str], problem: str, cloud: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["surface", str(cloud), *words]) == 2
    assert problem in capsys.readouterr().err


def test_without_open3d_the_extra_is_named(
    cloud: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    words = ["--seen-from", *map(str, STATION), "--out", str(tmp_path / "wall.ply")]
    assert cli.main(["surface", str(cloud), *words]) == 2
    assert "make setup EXTRAS=poisson" in capsys.readouterr().err
