"""Targets bring epochs together that ICP would not."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from monitor_cases import STATION, UTM, las, points

from pipeline.cli import main as cli
from pipeline.formats.points.laz import read_laz
from pipeline.monitoring.targets import fit_targets, read_targets
from pipeline.registration.rigid import RigidTransform
from scene.common.errors import InputError
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray

PLACES = UTM + np.array([[1.0, -2.0, 1.0], [15.0, -1.0, 2.0], [8.0, -3.0, 9.0], [4.0, 0.5, 6.0]])
MOTION = RigidTransform.about(PLACES.mean(axis=0), np.array([0.02, -0.01, 0.03]), np.array([1.5, -0.7, 0.4]))
WALL = WallFrame(np.eye(3), UTM)


def table(path: Path, moved: FloatArray) -> Path:
    """A file of the targets in two epochs."""
    rows = [
        f"{name},T{number},{x:.4f},{y:.4f},{z:.4f}"
        for name, places in (("a.las", PLACES), ("b.las", moved))
        for number, (x, y, z) in enumerate(places)
    ]
    path.write_text("\n".join(["epoch,target,x,y,z", *rows]))
    return path


def test_the_motion_of_the_targets_comes_back(tmp_path: Path) -> None:
    found = fit_targets(read_targets(table(tmp_path / "t.csv", MOTION.apply(PLACES))), "a.las", "b.las", WALL)
    assert found.count == 4
    assert found.rms_m < 1e-4
    back = found.transform.apply(WALL.to_wall(MOTION.apply(PLACES)))
    np.testing.assert_allclose(back, WALL.to_wall(PLACES), atol=2e-4)


def test_an_epoch_moved_by_metres_is_registered(tmp_path: Path) -> None:
    """1.8 m and two degrees, with 5 mm of error in the targets: points return within 3 mm, and the block is found."""
    las(tmp_path / "a.las", points(60_000, 1))
    after = points(60_000, 2, ((8.0, 5.0, 0.9, 0.3),))
    las(tmp_path / "b.las", MOTION.apply(after))
    errors = 0.005 * np.random.default_rng(3).normal(size=PLACES.shape)
    targets = table(tmp_path / "t.csv", MOTION.apply(PLACES) + errors)
    words = ["monitor", str(tmp_path / "a.las"), str(tmp_path / "b.las"), "--position", ",".join(STATION.split())]
    assert cli.main([*words, "--targets", str(targets), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    moved = read_laz(tmp_path / "out" / "epoch_001.laz").points - after
    np.testing.assert_allclose(np.median(moved, axis=0), 0.0, atol=3e-3)
    document = json.loads((tmp_path / "out" / "monitor.json").read_text())
    assert len(document["events"]) == 1
    assert any("4 targets" in note for note in document["inputs"][1]["notes"])


def test_targets_that_cannot_be_used(tmp_path: Path) -> None:
    good = read_targets(table(tmp_path / "t.csv", PLACES))
    with pytest.raises(InputError, match="0 targets are measured in both"):
        fit_targets(good, "a.las", "c.las", WALL)
    line = {name: {key: UTM + number * np.ones(3) for number, key in enumerate("abc")} for name in ("a", "b")}
    with pytest.raises(InputError, match="on one line"):
        fit_targets(line, "a", "b", WALL)
    far = PLACES.copy()
    far[2, 0] += 1.0
    with pytest.raises(InputError, match=r"target T\d of b\.las is"):
        fit_targets(read_targets(table(tmp_path / "far.csv", far)), "a.las", "b.las", WALL)
    (tmp_path / "bad.csv").write_text("epoch,x,y\na,1,2\n")
    with pytest.raises(InputError, match="target"):
        read_targets(tmp_path / "bad.csv")
    (tmp_path / "text.csv").write_text("epoch,target,x,y,z\na,T1,1,2,high\n")
    with pytest.raises(InputError, match="line 2"):
        read_targets(tmp_path / "text.csv")
