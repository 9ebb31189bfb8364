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
    """Return the versions of Python, of this package and of those it computes with.

    Packages that are not installed are left out.
    """
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found
