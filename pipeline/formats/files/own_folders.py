"""Check folders that a command creates inside its own folder before it continues there."""

from __future__ import annotations

import os
from pathlib import Path

from scene.common.errors import InputError


def require_own_folder(path: Path) -> None:
    """Check that `path` can be used as a folder to write to: raise InputError unless it is a folder or does not exist.

    A file, a pipe (at which `rmtree` waits forever) and a link are refused.
    """
    if os.path.lexists(path) and (path.is_symlink() or not path.is_dir()):
        raise InputError(
            "the path is not a folder", where=str(path), remedy="move it away: the command needs its own folder there"
        )
