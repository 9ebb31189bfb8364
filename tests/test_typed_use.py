"""The types of the public functions: mypy accepts a user's correct script and finds errors in a wrong one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
RIGHT = """
from pathlib import Path

from pipeline import Detections, Monitoring, Run, detect, monitor, open_run, simulate

run: Run = simulate("glendale", "tls", out=Path("runs/one"), rockfall__count=20)
volumes: list[float] = [float(block["volume_m3"]) for block in open_run("runs/one")[1].blocks.to_dict("records")]
found: Detections = detect(run, "baseline", confidence=0.9)
fallen: Monitoring = monitor(["march.laz", Path("april.laz")], "april", position=[0.0, -50.0, 2.0])
total: float = found.volume_m3 + sum(volumes)
"""
WRONG = """
from pipeline import detect, simulate

run = simulate("glendale", "sonar")
number: int = detect(run, confidence="high")
"""


def _checked(folder: Path, text: str) -> subprocess.CompletedProcess[str]:
    (folder / "script.py").write_text(text)
    command = [sys.executable, "-m", "mypy", "--follow-imports=silent", "--config-file", str(ROOT / "pyproject.toml")]
    return subprocess.run([*command, str(folder / "script.py")], capture_output=True, text=True, check=False, cwd=ROOT)


def test_a_right_script_passes(tmp_path: Path) -> None:
    done = _checked(tmp_path, RIGHT)
    assert done.returncode == 0, done.stdout


def test_wrong_uses_are_found(tmp_path: Path) -> None:
    told = _checked(tmp_path, WRONG).stdout
    assert "arg-type" in told
    assert "script.py:4" in told
    assert "script.py:5" in told
