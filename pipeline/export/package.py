"""List a result folder's files with checksums as a Data Package (datapackage.org), which archives and catalogues read."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from pipeline.formats.files.atomic import write_json
from pipeline.formats.files.checksum import sha256
from scene.common.errors import InputError

PACKAGE_FILE = "datapackage.json"
_PROFILE = "https://datapackage.org/profiles/2.0/datapackage.json"
_MEDIA = {
    ".tif": "image/tiff; application=geotiff", ".png": "image/png", ".json": "application/json", ".html": "text/html",
    ".laz": "application/vnd.laszip", ".csv": "text/csv", ".yaml": "application/yaml", ".md": "text/markdown",
    ".ply": "model/ply", ".txt": "text/plain", ".qml": "application/xml",
}  # fmt: skip
"""Media types by suffix."""


def package(folder: Path) -> dict[str, Any]:
    """Describe the files in a results folder as a Data Package: each with path, size and SHA-256 checksum, as JSON types.

    Hidden files and the description itself are left out. Raises InputError if there is nothing to list, or for a link to a file
    outside the folder, which would be missing in a copy.
    """
    if not folder.is_dir():
        raise InputError("there is no such folder", where=str(folder), remedy="give a folder with results of a scarpsim command")
    found = [path for path in sorted(folder.rglob("*")) if _is_listed(path.relative_to(folder))]
    for path in found:
        if path.is_symlink() and not path.resolve().is_relative_to(folder.resolve()):
            raise InputError(
                f"the path is a link out of the folder, to {path.resolve()}",
                where=str(path),
                remedy="replace the link by the file that it points to, or remove it",
            )
    files = [path for path in found if path.is_file()]
    if not files:
        raise InputError(
            "the folder contains no file", where=str(folder), remedy="give a folder with results of a scarpsim command"
        )
    return {"$schema": _PROFILE, "name": _slug(folder.resolve().name), "resources": [_resource(folder, path) for path in files]}


def save_package(folder: Path, path: Path) -> int:
    """Write the description of a results folder as a Data Package (JSON): each file with its size and SHA-256 checksum.

    folder: the results. path: the JSON file. Returns the number of files that the description lists.
    """
    made = package(folder)
    write_json(path, made)
    return len(made["resources"])


def _is_listed(path: Path) -> bool:
    """Return whether a file belongs into the package."""
    return path.name != PACKAGE_FILE and not any(part.startswith(".") for part in path.parts)


def _resource(folder: Path, path: Path) -> dict[str, Any]:
    """Describe one file."""
    name = path.relative_to(folder).as_posix()
    known = {"mediatype": _MEDIA[path.suffix]} if path.suffix in _MEDIA else {}
    return {"name": _slug(name), "path": name, **known, "bytes": path.stat().st_size, "hash": f"sha256:{sha256(path)}"}


def _slug(name: str) -> str:
    """Convert a name to lower-case letters, digits, dots, hyphens and underscores."""
    return re.sub(r"[^a-z0-9._-]+", "-", name.lower()).strip("-") or "result"
