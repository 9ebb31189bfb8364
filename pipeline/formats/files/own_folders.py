"""Folders that a command makes within its own: what else may stand in their places when it goes on."""

from __future__ import annotations

import os
from pathlib import Path

from scene.common.errors import InputError


def require_own_folder(path: Path) -> None:
    """Raise InputError unless `path` is a folder or nothing: a file, a pipe (which `rmtree` waits at for ever), a link out."""
    if os.path.lexists(path) and (path.is_symlink() or not path.is_dir()):
        raise InputError("is no folder", where=str(path), remedy="move it away, a folder of the command's own belongs there")
