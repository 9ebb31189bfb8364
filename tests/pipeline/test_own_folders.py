"""A command that resumes in its own folders names unexpected files there at once: it does not wait, and follows no link."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.cli.main import main
from pipeline.formats.files.own_folders import require_own_folder
from pipeline.run.simulation import _remove_unfinished
from scene.common.errors import InputError

MAKES = [os.mkfifo, Path.touch, lambda path: path.symlink_to("nowhere"), lambda path: path.symlink_to("/etc")]


@pytest.mark.parametrize("make", MAKES)
def test_what_is_no_folder(make: Callable[[Path], object], tmp_path: Path) -> None:
    require_own_folder(tmp_path / ".epoch_001")
    make(tmp_path / ".epoch_001")
    for refuse in (lambda: require_own_folder(tmp_path / ".epoch_001"), lambda: _remove_unfinished(tmp_path)):
        with pytest.raises(InputError, match=r"\.epoch_001: the path is not a folder"):
            refuse()
    assert os.path.lexists(tmp_path / ".epoch_001")


@pytest.mark.parametrize("name", ["checkpoint", "best", "events"])
@pytest.mark.parametrize("make", MAKES)
def test_a_training_to_go_on_with(
    make: Callable[[Path], object], name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/losses.png").touch()
    make(tmp_path / "out" / name)
    assert main(["train", str(tmp_path / "set"), "--resume", "--out", str(tmp_path / "out")]) == 2
    assert f"{name}: the path is not a folder" in capsys.readouterr().err
