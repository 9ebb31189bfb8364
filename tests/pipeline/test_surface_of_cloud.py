"""`scarpsim surface`: points become a wall at the same place."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from surfaces import heightfield

from pipeline import mesh_points
from pipeline.cli import main as cli
from pipeline.formats.meshes.ply import read_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from scene.common.errors import InputError
from scene.walls.imported import ImportedWall

STATION = np.array([345203.0, 6389435.0, 122.0])
ORIGIN = np.array([345200.0, 6389450.0, 120.0])
TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""The heightfield's x, y, z as east, up and towards the south."""


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Points about every 8 cm on a rough wall of 6 x 4 m in survey coordinates, in random order."""
    points = heightfield(6.0, 4.0, 0.08, roughness=0.05).vertices
    path = tmp_path_factory.mktemp("cloud") / "scan.laz"
    write_laz(path, PointCloud(np.random.default_rng(1).permutation(points) @ TURN.T + ORIGIN))
    return path


@pytest.mark.parametrize("method", ["triangulation", "poisson"])
def test_points_become_a_wall_where_they_are(cloud: Path, method: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = cloud.with_name(f"{method}.ply")
    seen_from = [str(value) for value in STATION]
    words = ["surface", str(cloud), "--seen-from", *seen_from, "--method", method, "--out", str(out), "--json"]
    assert cli.main(words) == 0
    assert json.loads(capsys.readouterr().out)["points"] == 76 * 51
    mesh = read_ply(out)
    local = (mesh.vertices - ORIGIN) @ TURN
    inside = (local[:, :2] > 0.3).all(axis=1) & (local[:, 0] < 5.7) & (local[:, 1] < 3.7)
    truth = heightfield(6.0, 4.0, 0.08, roughness=0.05).vertices
    nearest = cKDTree(truth[:, :2]).query(local[inside][:, :2])[1]
    assert np.median(np.abs(local[inside, 2] - truth[nearest, 2])) < 0.01
    towards = STATION - mesh.vertices[mesh.faces].mean(axis=1)
    assert np.mean(np.einsum("fi,fi->f", mesh.face_normals(), towards) > 0) > 0.99
    wall, _ = ImportedWall(mesh=out).load()
    assert np.ptp(wall.vertices, axis=0)[0] == pytest.approx(6.0, abs=0.5)


def test_a_triangulation_passes_through_its_points() -> None:
    """A sphere of 10 m seen from 30 m: every vertex is a point, so chords lie at most edge^2 / (8 r) below it."""
    random = np.random.default_rng(4)
    aside = random.uniform(-5.0, 5.0, (4000, 2))
    points = np.column_stack([aside, np.sqrt(100.0 - np.sum(aside**2, axis=1))]) + ORIGIN
    mesh = mesh_points(points, ORIGIN + np.array([0.0, 0.0, 30.0]))
    assert {tuple(row) for row in mesh.vertices} <= {tuple(row) for row in points}
    assert len(mesh.vertices) > 0.9 * len(points)
    corners = mesh.vertices[mesh.faces] - ORIGIN
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    depth = 10.0 - np.linalg.norm(corners.mean(axis=1), axis=1)
    assert np.all(depth < edge**2 / 20 + 1e-9)  # circumradius at most edge / sqrt(3): edge^2 / (6 r) for a triangle
    assert np.all(np.einsum("fi,fi->f", mesh.face_normals(), corners.mean(axis=1)) > 0)


def test_a_step_is_not_bridged_and_a_hole_stays_open() -> None:
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(0.0, 8.0, 0.05), np.arange(0.0, 4.0, 0.05)))
    hole = (np.abs(x - 1.5) < 0.5) & (np.abs(y - 2.0) < 0.5)
    points = np.column_stack([x, y, np.where(x < 4.0, 0.0, -3.0)])[~hole]
    mesh = mesh_points(points, [4.0, 2.0, 40.0])
    corners = mesh.vertices[mesh.faces]
    assert np.ptp(corners[:, :, 2], axis=1).max() == 0.0
    middle = corners.mean(axis=1)
    assert not np.any((np.abs(middle[:, 0] - 1.5) < 0.3) & (np.abs(middle[:, 1] - 2.0) < 0.3))
    sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(*sides), axis=1).sum() / 2
    assert area == pytest.approx(7.9 * 3.95 - 1.0, rel=0.02)


def test_rounded_points_are_refused_as_those_of_a_wall() -> None:
    """Survey coordinates in single precision have steps of 3 cm and 0.5 m, which would be meshed as terraces."""
    points = (heightfield(6.0, 4.0, 0.08, roughness=0.05).vertices @ TURN.T + ORIGIN).astype(np.float32)
    with pytest.raises(InputError, match=r"x in steps of 0.0312 m \(single precision.* the points' spacing is 0.0"):
        mesh_points(points, STATION)


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--seen-from", "0", "0", "0", "--out", "wall2.ply"], "--seen-from: the sensor's place lies 6,398,"),
        (["--seen-from", "0", "0", "0", "--out", "wall.obj"], "--out: the file name ends in '.obj'; allowed: .ply"),
        (["--out", "wall2.ply"], "required: --seen-from"),
        (["--method", "poison", "--seen-from", "0", "0", "0", "--out", "wall2.ply"], "invalid choice: 'poison'"),
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
    assert cli.main(["surface", str(cloud), *words, "--method", "poisson"]) == 2
    assert "make setup EXTRAS=poisson" in capsys.readouterr().err


def test_points_in_another_unit_become_a_mesh_in_metres(tmp_path: Path) -> None:
    x, z = (each.ravel() for each in np.meshgrid(np.arange(0.0, 5.0, 0.1), np.arange(0.0, 4.0, 0.1)))
    points = np.column_stack([x, 0.1 * np.sin(x), z])
    (tmp_path / "scan.xyz").write_text("\n".join(" ".join(f"{value:.6f}" for value in row) for row in 1000.0 * points))
    words = ["surface", str(tmp_path / "scan.xyz"), "--unit", "mm", "--seen-from", "2.5", "-10", "2", "--out"]
    assert cli.main([*words, str(tmp_path / "wall.ply")]) == 0
    found = read_ply(tmp_path / "wall.ply")
    np.testing.assert_allclose(found.bounds, [points.min(axis=0), points.max(axis=0)], atol=1e-6)
