"""Try each way to install the program into empty environments, and write docs/validation/installation.md.

    python tools/try_install.py

It builds sdist and wheel with uv, installs the wheel on each Python from 3.11 to 3.13 that this machine has, simulates from an
empty folder, and tries the sdist, each extra, `uvx` and `pipx`. It needs uv and a package index, about 15 minutes and 10 GB of
disk.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RECORD, PAGE = (ROOT / "docs" / "validation" / f"installation.{kind}" for kind in ("json", "md"))
PYTHONS = ("3.11", "3.12", "3.13")
SMALL = (
    *("--set", "wall.width_m=6", "--set", "wall.height_m=4", "--set", "wall.resolution_m=0.1"),
    *("--set", "rockfall.count=3", "--set", "scanner.azimuth_step_rad=0.003", "--set", "scanner.zenith_step_rad=0.003"),
)
IMPORTS = {
    "colmap": "import pycolmap",
    "dataset": "import distributed, cryptography",
    "detect": "import tensorflow, tensorboard",
    "huggingface": "import datasets",
    "m3c2": "import py4dgeo",
    "notebook": "import geopandas, IPython, pyvista, rioxarray, xarray",
    "poisson": "import open3d",
}
"""What has to be importable with each extra."""
_NEEDED = (
    "PATH",
    "HOME",
    "LANG",
    "UV_CACHE_DIR",
    "SSL_CERT_FILE",
    "UV_INDEX_URL",
    "UV_DEFAULT_INDEX",
    "PIP_INDEX_URL",
    "PIP_CERT",
)
"""Variables that are kept; no other reaches the commands, so that nothing of this shell helps them."""


@dataclass(frozen=True)
class Trial:
    """One way to install. said: `works`, `not tried` or the last line of the error; seconds: installation and use together."""

    what: str
    how: str
    said: str
    seconds: float = 0.0


class Workshop:
    """A temporary folder with the built packages, and the environment variables of the commands."""

    def __init__(self, folder: Path, uv: str) -> None:
        self.folder, self.uv = folder, uv
        self.environment = {key: os.environ[key] for key in _NEEDED if key in os.environ}
        self.environment |= {key: value for key, value in os.environ.items() if key.lower().endswith("_proxy")}
        self.run(uv, "build", "--out-dir", str(folder / "dist"), str(ROOT))
        (self.wheel,), (self.sdist,) = (list((folder / "dist").glob(kind)) for kind in ("*.whl", "*.tar.gz"))

    def run(self, *words: str, cwd: Path | None = None) -> str:
        """Run a command; return its output, or raise subprocess.CalledProcessError."""
        done = subprocess.run(words, cwd=cwd or self.folder, env=self.environment, capture_output=True, text=True, check=True)
        return done.stdout

    def empty(self, name: str) -> Path:
        """Make an empty folder."""
        folder = self.folder / name
        folder.mkdir(parents=True)
        return folder

    def trial(self, what: str, how: str, *commands: tuple[str, ...]) -> Trial:
        """Run commands from an empty folder, one after the other."""
        start, folder = time.perf_counter(), self.empty(re.sub(r"\W+", "_", what))
        try:
            for command in commands:
                self.run(*command, cwd=folder)
        except (subprocess.CalledProcessError, OSError) as error:
            text = getattr(error, "stderr", "") or str(error)
            return Trial(what, how, f"failed: {text.strip().splitlines()[-1]}", time.perf_counter() - start)
        return Trial(what, how, "works", time.perf_counter() - start)

    def in_environment(self, what: str, package: str, python: str, *commands: tuple[str, ...]) -> Trial:
        """Install a package into an empty environment of a Python, and run commands of that environment."""
        place = self.folder / "environments" / re.sub(r"\W+", "_", what)
        steps = [(self.uv, "venv", "-q", "--python", python, str(place))]
        steps += [(self.uv, "pip", "install", "-q", "--python", str(place / "bin" / "python"), package)]
        steps += [(str(place / "bin" / first), *rest) for first, *rest in commands]
        found = self.trial(what, f"`uv pip install {Path(package).name}`", *steps)
        shutil.rmtree(place, ignore_errors=True)
        return found


def interpreter(uv: str, version: str) -> str | None:
    """Return the path of a Python on this machine; None where there is none."""
    pyenv = sorted((Path.home() / ".pyenv" / "versions").glob(f"{version}.*/bin/python"))
    words = [uv, "python", "find", "--no-python-downloads", version]
    found = subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip()
    return str(pyenv[-1]) if pyenv else found or None


def trials(shop: Workshop) -> list[Trial]:
    """Try everything."""
    pythons = {version: interpreter(shop.uv, version) for version in PYTHONS}
    wheel, simulation = str(shop.wheel), ("simulate", "--sensor", "tls", "--out", "run", *SMALL)
    notebook = ("python", "-c", "import pipeline, sensors, scene; from pipeline import simulate, configure")
    found = []
    for version, python in pythons.items():
        what = f"wheel on Python {version}, `simulate` and the Python interface"
        found.append(
            shop.in_environment(what, wheel, python, simulation, notebook)
            if python
            else Trial(what, "", "not tried: no such Python on the machine, and none could be downloaded")
        )
    python = next(each for each in pythons.values() if each)
    found.append(shop.in_environment("source distribution", str(shop.sdist), python, simulation))
    for extra, imports in IMPORTS.items():
        found.append(shop.in_environment(f"extra `{extra}`", f"{wheel}[{extra}]", python, ("python", "-c", imports)))
    uvx = (shop.uv, "tool", "run", "--python", python, "--from", wheel, *simulation)
    found.append(shop.trial("`uvx`", "`uvx --from WHEEL simulate`", uvx))
    pipx = (shop.uv, "tool", "run", "pipx", "run", "--python", python, "--spec", wheel, *simulation)
    found.append(shop.trial("`pipx`", "`pipx run --spec WHEEL simulate`", pipx))
    return found


def page(record: dict[str, Any]) -> str:
    """Return the page, made from the record."""
    rows = [
        f"| {each['what']} | {each['how'] or 'none'} | {each['said']} | {each['seconds']:.0f} s |" for each in record["trials"]
    ]
    failed = sum(each["said"] != "works" for each in record["trials"])
    works = f"{failed} of the ways in the table failed." if failed else "All ways in the table work."
    head = f"""# Ways to install

This page is for users who install scarpsim without its repository. It lists each way that was tried and what came of it.

Each trial started with an empty environment and an empty folder, and with no variable of the shell but the path, the home and the
package index. The program then simulated a small wall with the laser scanner, or imported what the extra adds. Times include the
installation, mostly from a local cache of packages. An *extra* is a named group of optional packages, such as `detect` for the
detector. {works} "Glibc" in the name of the machine is the version of its C library.

Tried at commit {record["commit"]} on {record["machine"]}.

| what | how | result | time |
|---|---|---|---|
"""
    return head + "\n".join(rows) + "\n\nThe Containerfile was not built.\n\nWritten by `python tools/try_install.py`.\n"


def main() -> None:
    """Try everything, keep the record and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", action="store_true", help="write the page from the record that is kept")
    if not parser.parse_args().page:
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        if set(extras) != set(IMPORTS):
            sys.exit(f"IMPORTS has to name the extras {sorted(extras)}")
        uv = shutil.which("uv") or str(ROOT / ".uv" / "bin" / "uv")
        commit = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout
        with tempfile.TemporaryDirectory() as folder:
            found = trials(Workshop(Path(folder), uv))
        record = {"commit": commit.strip(), "machine": f"{platform.platform()}, {os.cpu_count()} cores"}
        RECORD.write_text(json.dumps(record | {"trials": [asdict(each) for each in found]}, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page(json.loads(RECORD.read_text(encoding="utf-8"))), encoding="utf-8")


if __name__ == "__main__":
    main()
