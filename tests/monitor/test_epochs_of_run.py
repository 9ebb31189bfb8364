"""Single epochs of a run of `simulate`, named by their folders, whose points are in the wall frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from monitor_cases import las

from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.reading import find_epochs, read_epoch
from scene.common.errors import InputError

TURNED = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
ORIGIN_M = [1000.0, 2000.0, 30.0]


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """A run with two finished epochs, each with a mesh beside its points, and one that was interrupted."""
    folder = tmp_path / "run"
    for number in range(3):
        (folder / f"epoch_{number:03d}").mkdir(parents=True)
    for number in range(2):
        epoch = folder / f"epoch_{number:03d}"
        las(epoch / "points.laz", np.random.default_rng(number).uniform(0, 5, (500, 3)))
        (epoch / "surface.ply").write_bytes(b"not read")
    frame = {"rotation": TURNED, "origin_m": ORIGIN_M, "matrix_world_to_wall": np.eye(4).tolist()}  # the matrix is not used
    (folder / "run.json").write_text(json.dumps({"sensor": "tls", "config": {}, "wall_frame": frame, "epochs": []}))
    return folder


def test_folders_of_epochs_are_those_of_their_run(run_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = find_epochs([run_folder])
    assert find_epochs([run_folder / "epoch_000", run_folder / "epoch_001"]) == whole
    monkeypatch.chdir(run_folder)
    assert [each.name for each in find_epochs([Path("epoch_001"), Path("epoch_000")])] == ["run/epoch_001", "run/epoch_000"]


def test_points_of_an_epoch_are_put_into_survey_coordinates(run_folder: Path) -> None:
    source = find_epochs([run_folder / "epoch_001", run_folder / "epoch_000"])[0]
    in_wall_frame = np.random.default_rng(1).uniform(0, 5, (500, 3))
    expected = in_wall_frame @ np.array(TURNED) + ORIGIN_M
    np.testing.assert_allclose(read_epoch(source, MonitorOptions()).points, expected, atol=2e-3)


def test_an_unfinished_epoch_is_refused(run_folder: Path) -> None:
    with pytest.raises(InputError, match="finished epoch"):
        find_epochs([run_folder / "epoch_000", run_folder / "epoch_002"])
