"""Join file names from a file to a folder without leaving that folder."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

from scene.common.errors import InputError


def inside(folder: Path, name: Any, where: Path | str) -> Path:
    """Return the path of a file in `folder` whose name was read from another file, so that it cannot lead elsewhere.

    name: relative to the folder. where: the file that contains the name, for errors. Raises InputError for a name that leads
    out of the folder: an absolute path, one with `..`, or a link to elsewhere.
    """
    if not isinstance(name, str) or not name.strip() or not name.isprintable():
        raise InputError(
            f"the file contains {name!r:.80} where the name of a file is expected",
            where=str(where),
            allowed="a file name",
            remedy="restore the file from a copy, or run the command that wrote it again",
        )
    pure, path = PurePosixPath(name), folder / name
    try:
        leads_out = pure.is_absolute() or ".." in pure.parts or not path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError) as error:  # too long, a loop of links
        raise InputError(
            f"this file names the file '{name:.80}', which is impossible ({error})",
            where=str(where),
            remedy="correct this name",
        ) from None
    if leads_out:
        raise InputError(
            f"this file names the file '{name:.80}', which lies outside of its folder",
            where=str(where),
            allowed=f"files in {folder}",
            remedy="correct the name, or move the named file into this folder",
        )
    return path
