"""Try each way to install the program into empty environments, and write docs/validation/installation.md.

    python tools/try_install.py                 # all ways
    python tools/try_install.py --only clone    # those with this word in their name; the other rows are kept

It clones the repository and carries out the README's commands, on each Python from 3.11 to 3.13 that this machine has. It builds
sdist and wheel with uv, installs the wheel on each of these, simulates from an empty folder, and tries the sdist, each extra,
`uvx` and `pipx`. It needs uv and a package index, about 20 minutes and 10 GB of disk.
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
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property, partial
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

    @cached_property
    def packages(self) -> tuple[str, str]:
        """Paths of the wheel and of the source distribution, built when first asked for."""
        self.run(self.uv, "build", "--out-dir", str(self.folder / "dist"), str(ROOT))
        (wheel,), (sdist,) = (list((self.folder / "dist").glob(kind)) for kind in ("*.whl", "*.tar.gz"))
        return str(wheel), str(sdist)

    def run(self, *words: str, cwd: Path | None = None, first_in_path: Path | None = None) -> str:
        """Run a command; return its output, or raise subprocess.CalledProcessError."""
        path = os.pathsep.join(map(str, filter(None, (first_in_path, self.environment["PATH"]))))
        done = subprocess.run(
            words, cwd=cwd or self.folder, env=self.environment | {"PATH": path}, capture_output=True, text=True, check=True
        )
        return done.stdout

    def empty(self, name: str) -> Path:
        """Make an empty folder."""
        folder = self.folder / name
        folder.mkdir(parents=True)
        return folder

    def trial(self, what: str, how: str, *commands: tuple[str, ...], first_in_path: Path | None = None) -> Trial:
        """Run commands from an empty folder, one after the other."""
        start, folder = time.perf_counter(), self.empty(re.sub(r"\W+", "_", what))
        try:
            for command in commands:
                self.run(*command, cwd=folder, first_in_path=first_in_path)
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

    def in_clone(self, what: str, version: str, python: str) -> Trial:
        """Clone the repository and carry out the README's commands, with a Python first in the path."""
        asked = f"import sys; sys.exit('%d.%d' % sys.version_info[:2] != '{version}')"
        commands = (
            ("git", "clone", "-q", str(ROOT), "."),
            ("make", "setup"),
            (".venv/bin/python", "-c", asked),
            ("make", "demo"),
            ("sh", "-c", "test -s runs/*/stereo/report.html && test -s runs/*/tls/report.html"),
        )
        found = self.trial(what, "`git clone`, `make setup`, `make demo`", *commands, first_in_path=Path(python).parent.resolve())
        shutil.rmtree(self.folder / re.sub(r"\W+", "_", what), ignore_errors=True)
        return found


def interpreter(uv: str, version: str) -> str | None:
    """Return the path of a Python on this machine; None where there is none."""
    pyenv = sorted((Path.home() / ".pyenv" / "versions").glob(f"{version}.*/bin/python"))
    words = [uv, "python", "find", "--no-python-downloads", version]
    found = subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip()
    return str(pyenv[-1]) if pyenv else found or None


def ways(shop: Workshop) -> dict[str, Callable[[str], Trial]]:
    """Return each way to install by its name; called with its name, it is tried."""
    pythons = {version: interpreter(shop.uv, version) for version in PYTHONS}
    python = next(each for each in pythons.values() if each)
    simulation = ("simulate", "--sensor", "tls", "--out", "run", *SMALL)
    notebook = ("python", "-c", "import pipeline, sensors, scene; from pipeline import simulate, configure")
    found: dict[str, Callable[[str], Trial]] = {}

    def without(what: str) -> Trial:
        return Trial(what, "", "not tried: no such Python on the machine, and none could be downloaded")

    def clone(what: str, version: str) -> Trial:
        return shop.in_clone(what, version, path) if (path := pythons[version]) else without(what)

    def wheel(what: str, version: str) -> Trial:
        path = pythons[version]
        return shop.in_environment(what, shop.packages[0], path, simulation, notebook) if path else without(what)

    def extra(what: str, name: str, imports: str) -> Trial:
        return shop.in_environment(what, f"{shop.packages[0]}[{name}]", python, ("python", "-c", imports))

    def tool(what: str, how: str, *words: str) -> Trial:
        return shop.trial(what, how, (shop.uv, "tool", "run", *words, shop.packages[0], *simulation))

    for version in PYTHONS:
        found[f"fresh clone on Python {version}, `make setup` and `make demo`"] = partial(clone, version=version)
    for version in PYTHONS:
        found[f"wheel on Python {version}, `simulate` and the Python interface"] = partial(wheel, version=version)
    found["source distribution"] = lambda what: shop.in_environment(what, shop.packages[1], python, simulation)
    for name, imports in IMPORTS.items():
        found[f"extra `{name}`"] = partial(extra, name=name, imports=imports)
    found["`uvx`"] = lambda what: tool(what, "`uvx --from WHEEL simulate`", "--python", python, "--from")
    found["`pipx`"] = lambda what: tool(what, "`pipx run --spec WHEEL simulate`", "pipx", "run", "--python", python, "--spec")
    return found


def page(record: dict[str, Any]) -> str:
    """Return the page, made from the record."""
    rows = [
        f"| {each['what']} | {each['how'] or 'none'} | {each['said']} | {each['seconds']:.0f} s | {each['commit']} |"
        for each in record["trials"]
    ]
    failed = sum(each["said"] != "works" for each in record["trials"])
    works = f"{failed} of the ways in the table failed." if failed else "All ways in the table work."
    machines = ", and at commit ".join(dict.fromkeys(f"{each['commit']} on {each['machine']}" for each in record["trials"]))
    head = f"""# Ways to install

This page is for users who install scarpsim, from its repository or without it. It lists each way that was tried and what came of
it.

Each trial started with an empty environment and an empty folder, and with no variable of the shell but the path, the home and the
package index. The system libraries were already on the machine. There are three kinds of trials:

- *Fresh clone*: the repository is cloned, and the commands of the README (`make setup`, `make demo`) are carried out. The Python
  that the row names stands first in the path, so that they use it. The demonstration must write both its reports.
- *Extra*: the wheel (the built package) is installed with an extra, a named group of optional packages. These must be importable.
- All others: after the installation, the command `simulate` must simulate a small wall with the laser scanner.

`simulate` is a command of its own; `uvx` and `pipx` run it straight from the wheel (`WHEEL` is its path), without an installation
that stays. Times include the installation, mostly
from a local cache of packages. Other programs ran on the machine meanwhile, so that times are upper limits. {works}
"Glibc" in the name of a machine is the version of its C library.

| extra | what it is for |
|---|---|
| `colmap` | surfaces by COLMAP from depth maps |
| `dataset` | data sets and epochs by several workers |
| `detect` | the detector |
| `huggingface` | data sets for Hugging Face's library `datasets` |
| `m3c2` | M3C2 distances of point clouds |
| `notebook` | tables, maps and 3D views in notebooks |
| `poisson` | Poisson surfaces from points |

Tried at commit {machines}.

| what | how | result | time | at commit |
|---|---|---|---|---|
"""
    return head + "\n".join(rows) + "\n\nThe Containerfile was not built.\n\nWritten by `python tools/try_install.py`.\n"


def kept() -> dict[str, dict[str, Any]]:
    """Return the rows of the record by their names."""
    return {each["what"]: each for each in json.loads(RECORD.read_text(encoding="utf-8"))["trials"]}


def main() -> None:
    """Try the ways, keep the record and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", action="store_true", help="write the page from the record that is kept")
    parser.add_argument("--only", metavar="WORD", help="try the ways with this word in their name, and keep the other rows")
    options = parser.parse_args()
    if not options.page:
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        if set(extras) != set(IMPORTS):
            sys.exit(f"IMPORTS has to name the extras {sorted(extras)}")
        beside = Path(sys.executable).with_name("uv")
        uv = shutil.which("uv") or str(beside if beside.exists() else ROOT / ".uv" / "bin" / "uv")
        commit = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout
        origin = {"commit": commit.strip(), "machine": f"{platform.platform()}, {os.cpu_count()} cores"}
        with tempfile.TemporaryDirectory() as folder:
            known = ways(Workshop(Path(folder), uv))
            wanted = [what for what in known if not options.only or options.only in what]
            if not wanted:
                sys.exit(f"no way has {options.only!r} in its name; the names are: {'; '.join(known)}")
            tried = {what: asdict(known[what](what)) | origin for what in wanted}
        rows = (kept() if options.only else {}) | tried
        record = {"trials": [rows[what] for what in known if what in rows]}
        RECORD.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page(json.loads(RECORD.read_text(encoding="utf-8"))), encoding="utf-8")


if __name__ == "__main__":
    main()
