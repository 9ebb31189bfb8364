"""`scarpsim doctor`: say what is installed, what is missing and how to get it.

The command must not crash, whatever is missing.
"""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.cli import system_libraries
from pipeline.cli.command_output import CommandOutput
from pipeline.cli.parser import add_output_options
from scene.common.errors import InputError
from scene.common.extras import how_to_install

if TYPE_CHECKING:
    from packaging.requirements import Requirement

SUMMARY = "list what is installed, what is missing and how to get it"
EXAMPLE = """  scarpsim doctor
  scarpsim doctor --json"""
_INSTALL_AGAIN = "run `make setup` in the checkout, or install scarpsim again"
_MEMORY_GIB, _DISK_GIB = 2.0, 1.0
"""Free memory and disk space that the demo needs, with a margin."""
EXTRAS = {
    "colmap": ("surfaces by COLMAP from depth maps", "0.1 GB"),
    "dataset": ("data sets by several workers", "30 MB"),
    "detect": ("the detector, by TensorFlow", "2.0 GB"),
    "huggingface": ("data sets for Hugging Face's datasets", "0.2 GB"),
    "m3c2": ("M3C2 distances", "0.1 GB"),
    "notebook": ("xarray, GeoPandas, PyVista: the types of the Python interface", "0.9 GB"),
    "poisson": ("Poisson surfaces, by Open3D", "1.0 GB"),
}
"""Purpose of each extra, and the disk space of its packages beyond those of the program (November 2026)."""
_NEEDS_LIBRARIES = {"poisson": "open3d"}
"""Package of an extra; if it is installed, the extra's system libraries are examined too."""
_IMPORTS = {
    "laspy": "laspy",
    "manifold3d": "manifold3d",
    "mitsuba": "mitsuba",
    "opencv-contrib-python-headless": "cv2",
    "pycocotools": "pycocotools.mask",
    "pyyaml": "yaml",
}
"""Module to import for a package whose module has another name or whose compiled part is a submodule."""


@dataclass(frozen=True)
class Finding:
    """Result of checking one part of the installation, for `scarpsim doctor`.

    Attributes
    ----------
    name : str
        What was examined.
    ok : bool or None
        Whether it is as it should be; None if it is only information.
    found : str
        What was found.
    remedy : str
        How to get what is missing, or empty.
    """

    name: str
    ok: bool | None
    found: str
    remedy: str = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim doctor` on its parser."""
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Examine the installation and list what was found."""
    findings = examine()
    ready = all(finding.ok is not False for finding in findings)
    end = "\nready: `simulate` can run here" if ready else "\nnot ready: fix what is marked PROBLEM"
    document = {"ready": ready, "findings": [asdict(finding) for finding in findings]}
    return CommandOutput("\n".join([*map(_format_finding, findings), end]), lambda: document, 0 if ready else 1)


def examine() -> list[Finding]:
    """Examine the installation for `scarpsim doctor` and return all findings; a check that fails is reported as a finding."""
    probes: tuple[Callable[[], Iterator[Finding]], ...] = (_python, _packages, _extras, _libraries, _backend, _machine, _caches)
    return [finding for probe in probes for finding in _run_probe(probe)]


def _run_probe(probe: Callable[[], Iterator[Finding]]) -> list[Finding]:
    """Return the findings of a probe, with an exception as a further finding."""
    found: list[Finding] = []
    try:
        found.extend(probe())
    except InputError as error:
        found.append(Finding(probe.__name__.strip("_"), False, str(error)))
    except Exception as error:  # the command reports every failure
        found.append(Finding(probe.__name__.strip("_"), False, _first_line(error), _INSTALL_AGAIN))
    return found


def _format_finding(finding: Finding) -> str:
    """Return a finding as one line of the table."""
    mark = {True: "ok", False: "PROBLEM", None: "-"}[finding.ok]
    return f"{mark:<8}{finding.name:<32}{finding.found}" + (f"; {finding.remedy}" if finding.remedy else "")


def _first_line(error: BaseException) -> str:
    """Return the type and the first line of an error."""
    return f"{type(error).__name__}: {error}".partition("\n")[0]


def _python() -> Iterator[Finding]:
    """Examine the versions of Python and scarpsim."""
    right = (3, 11) <= sys.version_info < (3, 14)
    yield Finding("Python", right, platform.python_version(), "" if right else "install Python 3.11 to 3.13")
    yield Finding("scarpsim", True, f"{metadata.version('scarpsim')} in {Path(__file__).parents[2]}")


def _packages() -> Iterator[Finding]:
    """Examine the packages that the program requires."""
    from packaging.requirements import Requirement

    for requirement in map(Requirement, metadata.requires("scarpsim") or []):
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            yield _package(requirement)
    yield Finding("all packages", None, f"{sum(map(_megabytes, metadata.distributions())):,.0f} MB")


def _extras() -> Iterator[Finding]:
    """Examine which extras are installed. A missing extra is not a problem."""
    from packaging.requirements import Requirement

    wanted = [Requirement(text) for text in metadata.requires("scarpsim") or []]
    for extra, (purpose, size) in EXTRAS.items():
        marked = [each for each in wanted if each.marker and "extra" in str(each.marker)]
        names = [each.name for each in marked if each.marker and each.marker.evaluate({"extra": extra})]
        absent = [name for name in names if not _is_installed(name)]
        found = f"{purpose}; " + (f"not installed: {', '.join(absent)}, {size} with dependencies" if absent else "installed")
        yield Finding(f"extra {extra}", None, found, how_to_install(extra) if absent else "")


def _is_installed(name: str) -> bool:
    """Return whether a package is installed."""
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return True


def _megabytes(distribution: metadata.Distribution) -> float:
    """Return the disk space of a package, MB, from its list of files."""
    return sum(file.size or 0 for file in distribution.files or ()) / 1e6


def _package(requirement: Requirement) -> Finding:
    """Examine whether a package is installed, can be imported, and has a suitable version."""
    name, wanted = requirement.name, requirement.specifier
    try:
        version = metadata.version(name)
        importlib.import_module(_IMPORTS.get(name, name))
    except metadata.PackageNotFoundError:
        return Finding(name, False, f"not installed, needs {wanted}", _INSTALL_AGAIN)
    except Exception as error:  # compiled packages fail in many ways
        return Finding(name, False, f"{version} does not load: {_first_line(error)}", "see the system libraries below")
    fits = version in wanted
    found = f"{version}, {_megabytes(metadata.distribution(name)):.0f} MB"
    return Finding(name, fits, found, "" if fits else f"needs {wanted}; {_INSTALL_AGAIN}")


def _libraries() -> Iterator[Finding]:
    """Examine the system libraries of the program and of the installed extras, except LLVM."""
    extras = [extra for extra, package in _NEEDS_LIBRARIES.items() if _is_installed(package)]
    missing = system_libraries.missing(extras)
    for library in system_libraries.LIBRARIES:
        if library.extra in ("", *extras) and library.soname != system_libraries.LLVM:  # `_backend` asks Dr.Jit for it
            absent = library in missing
            yield Finding(library.soname, not absent, f"for {library.needed_by}", _apt_line(missing) if absent else "")


def _apt_line(libraries: list[system_libraries.SystemLibrary]) -> str:
    """Return the command that installs system libraries."""
    return f"apt-get install -y --no-install-recommends {' '.join(system_libraries.packages(libraries))}"


def _backend() -> Iterator[Finding]:
    """Examine the GPU and LLVM, one of which the ray tracer needs."""
    import drjit as dr

    cuda, llvm = dr.has_backend(dr.JitBackend.CUDA), dr.has_backend(dr.JitBackend.LLVM)
    yield Finding("CUDA device", None, _gpu_name() if cuda else "none; the CPU is used")
    if llvm:
        yield Finding("LLVM backend", True, "usable")
    else:  # only information if there is a GPU
        remedy = _apt_line([library for library in system_libraries.LIBRARIES if library.soname == system_libraries.LLVM])
        yield Finding("LLVM backend", None if cuda else False, "no usable libLLVM", remedy)
    from scene.common.backend import VARIANT

    yield Finding("Mitsuba variant", True, f"{VARIANT} with {dr.thread_count()} threads")


def _gpu_name() -> str:
    """Return the name and memory of the GPU as nvidia-smi reports them."""
    try:
        query = ["nvidia-smi", "--query-gpu=name,memory.total", "--format=csv,noheader"]
        return subprocess.run(query, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "found"


def _machine() -> Iterator[Finding]:
    """Examine the processors, free memory and disk space."""
    import psutil

    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield Finding("CPU threads", None, f"{threads} usable of {os.cpu_count()}")
    memory = psutil.virtual_memory()
    free, disk = memory.available / 2**30, shutil.disk_usage(".").free / 2**30
    enough, room = free >= _MEMORY_GIB, disk >= _DISK_GIB
    short = f"the demo needs {_MEMORY_GIB:.0f} GiB: close other programs"
    yield Finding("memory", enough, f"{free:.1f} GiB free of {memory.total / 2**30:.1f}", "" if enough else short)
    full = f"results need at least {_DISK_GIB:.0f} GiB: make room, or use --out on another disk"
    yield Finding("disk space here", room, f"{disk:.1f} GiB free", "" if room else full)


def _caches() -> Iterator[Finding]:
    """Examine the cache of compiled kernels."""
    folder = Path(os.environ.get("DRJIT_CACHE_DIR") or Path.home() / ".drjit")
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) if folder.is_dir() else 0
    yield Finding("compiled kernels", None, f"{size / 2**20:.0f} MiB in {folder}; may be deleted at any time")
