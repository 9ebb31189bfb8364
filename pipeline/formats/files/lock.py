"""Allow one writer at a time in a folder, by a lock file that the kernel releases with its process, however that ends."""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from pipeline.formats.files.atomic import check_place, explained
from scene.common.errors import InputError

LOCK = ".lock"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Within the `with` block, hold a lock on `folder`, so that no other process writes to it; create the folder if needed.

    Afterwards the lock file and created folders that are empty are removed. Raises InputError if another process holds the
    lock, or the folder cannot be created.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("the path is a file, but the results need a folder", where=f"--out {folder}", remedy="choose a folder")
    check_place(folder)
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    path = folder / LOCK
    with explained(path):
        file = _held(path)
    try:
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield
    finally:
        path.unlink(missing_ok=True)  # removed before release: a waiting process checks whether the file still exists
        file.close()
        for each in missing:
            with suppress(OSError):  # is not empty
                each.rmdir()


def is_free(folder: Path) -> bool:
    """Return whether a folder contains nothing but a lock file, so that it can be written to."""
    return folder.is_dir() and all(path.name == LOCK for path in folder.iterdir())


def _held(path: Path) -> TextIO:
    """Open and lock the lock file, and empty it."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not path.is_file():
            raise InputError(
                "the path is not a file, so it cannot mark the folder as in use",
                where=str(path),
                allowed="a lock file or none",
                remedy="move it away, or choose another folder",
            )
        try:
            file = path.open("a+", encoding="utf-8")
        except FileNotFoundError:  # the last holder has just removed the folder that it created
            continue
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            with file:
                file.seek(0)
                holder = file.read().strip() or "another process"
            raise InputError(
                f"the folder is in use by {holder}",
                where=str(path.parent),
                remedy="wait for that process to end, or choose another folder",
            ) from None
        with suppress(FileNotFoundError):
            if os.path.samestat(path.stat(), os.fstat(file.fileno())):
                file.truncate(0)
                return file
        file.close()  # its holder removed it after we opened and before we locked it
