"""Record the versions of the software that made a result."""

from __future__ import annotations

import platform
from importlib import metadata

PACKAGES = (
    "scarpsim",
    "mitsuba",
    "drjit",
    "manifold3d",
    "open3d",
    "opencv-contrib-python-headless",
    "trimesh",
    "numpy",
    "scipy",
    "laspy",
    "lazrs",
    "tifffile",
    "pycocotools",
)
"""Packages whose versions are recorded."""


def versions() -> dict[str, str]:
    """Return the versions of Python, scarpsim and the packages that it computes with, by name, to record how a result was made.

    The key `platform` describes the operating system. Packages that are not installed are left out.
    """
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found
