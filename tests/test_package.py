"""The wheel contains everything that the program needs outside the checkout, and nothing else."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("scene", "sensors", "pipeline")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built by the backend that pyproject.toml names, from a copy of the checkout's files, without a network."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in (*PACKAGES, "configs"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    (built,) = out.glob("*.whl")
    return built


def test_everything_is_in_it(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
    files = (path for name in (*PACKAGES, "configs") for path in (ROOT / name).rglob("*") if path.is_file())
    wanted = {path.relative_to(ROOT).as_posix() for path in files if "__pycache__" not in path.parts}
    wanted = {f"pipeline/{name}" if name.startswith("configs/") else name for name in wanted}
    assert {name for name in held if ".dist-info/" not in name} == wanted
    assert {"pipeline/configs/demo.yaml", "pipeline/report/style.css", "pipeline/view/assets/view.css"} <= held
    (licence,) = (name for name in held if name.endswith("licenses/LICENSE"))
    assert licence


def test_its_metadata(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        lines = archive.read(metadata).decode().splitlines()
        (scripts,) = (name for name in archive.namelist() if name.endswith("entry_points.txt"))
        entry_points = archive.read(scripts).decode()
    assert "License-Expression: MIT" in lines
    assert any(line.startswith("Requires-Python:") and "3.11" in line for line in lines)
    assert "simulate = pipeline.cli.main:simulate" in entry_points
    assert "scarpsim = pipeline.cli.main:main" in entry_points


def test_it_runs_where_there_is_no_checkout(wheel: Path, tmp_path: Path) -> None:
    """It runs with its own code on the libraries of this environment: the bundled configs are in it, and load."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    program = (
        f"import sys; sys.path.insert(0, {str(tmp_path / 'site')!r})\n"
        "import pipeline.config.bundled\n"
        "from pipeline.cli.main import main\n"
        "print(pipeline.config.bundled.configs_folder())\n"
        "sys.exit(main(['init', '--site', 'bulga', '--scanner', 'leica_p50', '--out', 'site.yaml']))"
    )
    work = tmp_path / "work"
    work.mkdir()
    command = [sys.executable, "-P", "-c", program]
    shown = subprocess.run(command, cwd=work, check=True, capture_output=True, text=True).stdout
    assert shown.splitlines()[0] == str(tmp_path / "site/pipeline/configs")
    assert "style: bulga" in (work / "site.yaml").read_text()
