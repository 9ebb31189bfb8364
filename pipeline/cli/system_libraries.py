"""List the system libraries that the packages from PyPI do not contain, and which of them this machine lacks.

This file uses only the standard library. `tools/setup.sh` runs it before any package is installed, with the extras to install
as arguments; `scarpsim doctor` imports it.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

LLVM = "libLLVM"
_LLVM_RELEASES = range(22, 13, -1)
"""LLVM releases that Dr.Jit 1.5 works with, preferred ones first. Tested: 22, 19, 16, 15."""


@dataclass(frozen=True)
class SystemLibrary:
    """A shared library that must be installed with the system's package manager.

    Attributes
    ----------
    soname : str
        Name that the loader looks for.
    package : str
        Package of Debian and Ubuntu.
    needed_by : str
        Python packages that need it.
    extra : str
        Extra that installs those packages; empty if the program always needs them.
    """

    soname: str
    package: str
    needed_by: str
    extra: str = ""

    @property
    def present(self) -> bool:
        """Whether the loader finds the library; for LLVM, whether Dr.Jit would find it."""
        return _llvm_path() is not None if self.soname == LLVM else _loads(self.soname)


LIBRARIES = (
    SystemLibrary("libstdc++.so.6", "libstdc++6", "every compiled package"),
    SystemLibrary("libz.so.1", "zlib1g", "OpenCV, Mitsuba"),
    SystemLibrary("libatomic.so.1", "libatomic1", "Dr.Jit"),
    SystemLibrary("libusb-1.0.so.0", "libusb-1.0-0", "Open3D", "poisson"),
    SystemLibrary("libudev.so.1", "libudev1", "Open3D", "poisson"),
    SystemLibrary("libX11.so.6", "libx11-6", "Open3D", "poisson"),
    SystemLibrary("libGL.so.1", "libgl1", "Open3D", "poisson"),
    SystemLibrary("libEGL.so.1", "libegl1", "Open3D", "poisson"),
    SystemLibrary(LLVM, "libllvm", "Dr.Jit on the CPU"),
)
"""All system libraries of the program and its extras."""


def missing(extras: Sequence[str] = ()) -> list[SystemLibrary]:
    """Return the shared libraries that this machine lacks, for `scarpsim doctor`.

    extras: names of the installed extras (optional parts of the program) whose libraries are looked for too.
    """
    return [library for library in LIBRARIES if library.extra in ("", *extras) and not library.present]


def packages(libraries: list[SystemLibrary]) -> list[str]:
    """Return the names of the Debian packages that contain the libraries.

    LLVM's package name contains its release, so apt is asked which exist.
    """
    return [_llvm_package() if library.soname == LLVM else library.package for library in libraries]


def _loads(name: str) -> bool:
    """Return whether the loader can load a library."""
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def _llvm_path() -> str | None:
    """Return where Dr.Jit finds LLVM: in its own environment variable, on the loader's path, or in Debian's folders."""
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    found = sorted(map(str, Path("/usr/lib").glob("*-linux-gnu/libLLVM*.so.*")))
    return next((path for path in ([named] if named else ["libLLVM.so", *found]) if _loads(path)), None)


def _llvm_package() -> str:
    """Return the best LLVM package that apt knows, or a common name if apt is not available."""
    known: set[str] = set()
    if shutil.which("apt-cache"):
        listing = subprocess.run(["apt-cache", "pkgnames", "libllvm"], capture_output=True, text=True, check=False).stdout
        known = set(re.findall(r"^libllvm\d+(?:t64)?$", listing, re.MULTILINE))
    names = (name for release in _LLVM_RELEASES for name in (f"libllvm{release}", f"libllvm{release}t64"))
    return next((name for name in names if name in known), "libllvm15")


if __name__ == "__main__":
    print(" ".join(packages(missing(sys.argv[1:]))))
