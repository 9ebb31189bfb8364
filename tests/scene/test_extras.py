"""The command that installs an extra."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from scene.common import extras


def test_a_checkout_is_told_its_own_set_up_and_a_package_pip(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert extras.how_to_install("detect") == f"make setup EXTRAS=detect, in {Path(__file__).parents[2]}"
    monkeypatch.setattr(extras, "_ROOT", tmp_path)
    assert extras.how_to_install("detect") == "pip install 'scarpsim[detect]'"


def test_the_set_up_knows_the_extras_and_refuses_other_words() -> None:
    told = subprocess.run(
        ["sh", "tools/setup.sh", "detect", "detekt"], cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False
    )
    assert told.returncode == 1
    assert "got 'detekt'; allowed: nothing, all, or some of colmap dataset detect" in told.stderr
