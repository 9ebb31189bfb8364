"""The system libraries that PyPI's packages do not bring along, and which of them this machine lacks.

Standard library only: `tools/setup.sh` runs this file before any package is there, with the extras that it installs as arguments;
`scarpsim doctor` imports it.
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
"""LLVM releases for Dr.Jit 1.5, the ones to prefer first; tried: 22, 19, 16, 15."""


@dataclass(frozen=True)
class SystemLibrary:
    """A shared library: what the loader looks for, Debian's and Ubuntu's package, and who needs it; extra: the extra of that,
    without which nobody does."""

    soname: str
    package: str
    needed_by: str
    extra: str = ""

    @property
    def present(self) -> bool:
        """Whether the loader finds it (for LLVM: whether Dr.Jit would)."""
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


def missing(extras: Sequence[str] = ()) -> list[SystemLibrary]:
    """The libraries that this machine lacks for the program and some of its extras."""
    return [library for library in LIBRARIES if library.extra in ("", *extras) and not library.present]


def packages(libraries: list[SystemLibrary]) -> list[str]:
    """The packages to install for `libraries`; LLVM's has its release in the name, so apt is asked which there are."""
    return [_llvm_package() if library.soname == LLVM else library.package for library in libraries]


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def _llvm_path() -> str | None:
    """Where Dr.Jit will find LLVM: its own variable, the loader's path, Debian's folders."""
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    found = sorted(map(str, Path("/usr/lib").glob("*-linux-gnu/libLLVM*.so.*")))
    return next((path for path in ([named] if named else ["libLLVM.so", *found]) if _loads(path)), None)


def _llvm_package() -> str:
    """The best LLVM package that apt knows; a usual name where there is no apt to ask."""
    known: set[str] = set()
    if shutil.which("apt-cache"):
        listing = subprocess.run(["apt-cache", "pkgnames", "libllvm"], capture_output=True, text=True, check=False).stdout
        known = set(re.findall(r"^libllvm\d+(?:t64)?$", listing, re.MULTILINE))
    names = (name for release in _LLVM_RELEASES for name in (f"libllvm{release}", f"libllvm{release}t64"))
    return next((name for name in names if name in known), "libllvm15")


if __name__ == "__main__":
    print(" ".join(packages(missing(sys.argv[1:]))))
