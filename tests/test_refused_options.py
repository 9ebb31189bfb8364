"""Options that contradict the input or name nothing are refused before any work, by the commands that take measured data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.cli.main import main
from pipeline.formats.files.atomic import check_place
from pipeline.monitoring.frame import wall_frame
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.reading import EpochSource
from pipeline.monitoring.run import monitor
from scene.common.errors import InputError


def said(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    """Run a command that must be refused, and return its message."""
    assert main([str(word) for word in words]) == 2
    return capsys.readouterr().err


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder of a measurement; the commands are refused before they read its files."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "measurement.yaml").write_text("sensor: tls\n")
    return tmp_path / "mine"


@pytest.mark.parametrize(
    "words",
    [
        ["--scanner", "riegl_vz400i"],
        ["--model", "model.yaml"],
        ["--reference", "wall.ply"],
        ["--unit", "ft"],
        ["--position", "1,2,3"],
        ["--columns", "x,y,z"],
        ["--photographs"],
        ["--pair", "A,B"],
        ["--scan", "2"],
    ],
)
def test_the_folder_of_a_measurement_knows_what_options_say_of_raw_scans(
    folder: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    message = said(capsys, "gap", folder, *words, "--out", folder.parent / "out")
    assert f"{words[0]}: the option cannot be combined with the folder of a measurement" in message
    assert not (folder.parent / "out").exists()


def test_results_are_not_written_among_the_files_of_a_measurement(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "the folder is a measurement" in said(capsys, "gap", folder, "--out", folder)
    assert [path.name for path in folder.iterdir()] == ["measurement.yaml"]


def test_the_sensor_is_asked_for_a_config_only(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--identifiability only" in said(capsys, "gap", folder, "--sensor", "tls", "--out", folder.parent / "out")


def test_one_measurement_is_diagnosed_at_a_time(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "a folder can only be given alone" in said(capsys, "gap", folder, folder, "--out", folder.parent / "out")


def test_a_folder_that_is_not_there_is_called_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "there is no such folder" in said(capsys, "gap", tmp_path / "nothing", "--out", tmp_path / "out")


def test_a_scanner_has_one_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--reference", "wall.ply", "--scanner", "riegl_vz400i", "--model", "model.yaml", "--out", tmp_path / "out")
    assert "--scanner: the option cannot be combined with --model" in said(capsys, "measurement", "scan.laz", *words)


def test_a_record_without_a_key_is_no_config(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record = tmp_path / "run.json"
    record.write_text("{}")
    assert "the config contains no key" in said(
        capsys, "simulate", "--sensor", "tls", "--config", record, "--out", tmp_path / "out"
    )


def test_a_direction_of_change_has_a_length() -> None:
    points = np.random.default_rng(1).uniform(size=(50, 3))
    with pytest.raises(InputError, match="--direction: the direction has no length"):
        wall_frame(points, np.array([0.0, 0.0, 9.0]), np.zeros(3))


def test_monitor_refuses_an_unknown_scanner_before_it_maps_anything(tmp_path: Path) -> None:
    unread: Any = None
    sources = [EpochSource(path, (path,), unread) for path in (tmp_path / "a.laz", tmp_path / "b.laz")]
    with pytest.raises(InputError, match="nosuch"):
        monitor(sources, tmp_path / "out", MonitorOptions(scanner="nosuch"))
    assert not list((tmp_path / "out").glob("*.tif"))


def test_a_parent_that_another_command_removes_meanwhile_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands that start together with outputs in one new folder each test the place and remove what they made."""
    make, calls = Path.mkdir, []

    def removed_once(path: Path, *mode: int, **how: bool) -> None:
        calls.append(path)
        if len(calls) == 1:
            raise FileNotFoundError(2, "No such file or directory")
        make(path, *mode, **how)

    monkeypatch.setattr(Path, "mkdir", removed_once)
    check_place(tmp_path / "new" / "mine")
    assert len(calls) > 1
    assert not (tmp_path / "new").exists()
