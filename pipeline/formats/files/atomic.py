"""Write files completely or not at all: under a temporary name in the same folder, then renamed."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from scene.common.errors import InputError

_FULL = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "the file exceeds the size limit",
}
"""Messages for errors of a full disk."""
_FORBIDDEN = {errno.EACCES, errno.EPERM, errno.EROFS}
"""Errors of missing permissions."""
_NO_SUCH_PLACE = {errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.EEXIST, errno.ENOENT}
"""Errors of impossible paths."""
_ELSEWHERE = "choose another folder with --out"
_MOST_TRIES = 20
"""Attempts to make a folder whose parent another command removes."""


_noted: ContextVar[list[Path] | None] = ContextVar("noted", default=None)
"""Files written in the innermost `noting` block."""


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """Provide a temporary path to write to, so that a file is complete or absent.

    It becomes `path` if the `with` block succeeds and is removed if it fails. Missing folders are created. The temporary file
    is in the folder of `path` and keeps its suffix, as libraries may choose a format by it. Its name depends on the target
    only, so that the next run overwrites what a killed process left. The content is on the disk before the name, so that a
    power failure leaves no empty file.

    Raises InputError for a full disk, a folder without write permission, or a path that cannot be a file.
    """
    temporary = path.with_name(f".{path.stem}.part{path.suffix}")
    with _made_for(path.parent):
        try:
            with explained(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                yield temporary
                give_name(temporary, path)
            note(path)
        finally:
            _remove(temporary)


@contextmanager
def _made_for(folder: Path) -> Iterator[None]:
    """Allow the block to create `folder` and its parents.

    If it fails, those that it created are removed again if they are empty.
    """
    made = _missing(folder)
    try:
        yield
    except BaseException:
        _remove_empty(made)
        raise


def _missing(folder: Path) -> list[Path]:
    """Return `folder` and those of its parents that do not exist, the inner ones first."""
    return [each for each in (folder, *folder.parents) if not os.path.lexists(each)]


def _remove_empty(folders: list[Path]) -> None:
    """Remove folders that are empty."""
    for each in folders:
        with suppress(OSError, ValueError):  # does not exist, is not empty, or has an impossible name
            each.rmdir()


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Within the `with` block, turn an operating system's error about `path` that the user can solve into an InputError."""
    try:
        yield
    except OSError as error:
        raise _as_input_error(error, path) from None


@contextmanager
def noting() -> Iterator[list[Path]]:
    """Within the `with` block, collect the paths of all files that this thread writes, so that a failed command can remove them.

    A file counts when it has its final name (see `writing` and `note`). Blocks may be nested: when the inner one ends, its
    files are added to the outer list.
    """
    outer, found = _noted.get(), list[Path]()
    token = _noted.set(found)
    try:
        yield found
    finally:
        _noted.reset(token)
        if outer is not None:
            outer.extend(found)


def note(path: Path) -> None:
    """Add a file to the list that the enclosing `with noting()` block collects, to be removed after a failure."""
    found = _noted.get()
    if found is not None:
        found.append(path)


def remove_written(out: Path, written: list[Path]) -> None:
    """Remove the files that a failed command wrote, and folders in `out` that are then empty; files of others stay.

    written: the files, as `noting` collected them.
    """
    for path in written:
        with suppress(OSError):  # was renamed with its folder
            path.unlink()
    folders = {folder for path in written for folder in path.parents if out in folder.parents}
    for folder in sorted(folders, reverse=True):  # the inner ones first
        with suppress(OSError):  # does not exist, or contains files of others
            folder.rmdir()


def give_name(temporary: Path, path: Path) -> None:
    """Rename a complete temporary file or folder to `path`; its content is forced to the disk first and the name afterwards."""
    to_disk(temporary)
    temporary.replace(path)
    to_disk(path.parent)


def to_disk(path: Path) -> None:
    """Wait until a file's content, or a folder's entries, are on the disk, to survive a power failure."""
    try:
        file = os.open(path, os.O_RDONLY)
    except PermissionError:  # is writable but not readable
        return
    try:
        os.fsync(file)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(file)


def new_folder(parent: Path, name: str) -> Path:
    """Return a path for a new output folder under `parent`, named after `name` and the time, that does not exist yet."""
    stem = f"{name}_{datetime.now():%Y%m%d_%H%M%S}"
    names = (stem if number == 1 else f"{stem}_{number}" for number in range(1, 1000))
    return next(parent / free for free in names if not (parent / free).exists())


def empty_folder(out: Path, remedy: str = "choose another --out") -> Path:
    """Check that an output folder is new or empty and can be written to; return its path.

    remedy: what the user can do otherwise, the end of an error. Raises InputError, naming --out, if the folder has content or
    cannot be created.
    """
    check_place(out)
    if out.exists() and any(out.iterdir()):
        raise InputError("the path exists and is not an empty folder", where=f"--out {out}", remedy=remedy)
    return out


def check_place(out: Path) -> None:
    """Raise InputError, naming --out, if `out` cannot be a writable folder; it is created as a test and removed again."""
    made = _missing(out)
    try:
        _make_folder(out)
        if not os.access(out, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except (OSError, ValueError) as error:  # ValueError: a null character
        reason = getattr(error, "strerror", None) or "a null character in its name"
        problem = "the path cannot be used as a folder"
        if made and "\0" not in str(out):
            problem += f": no folder can be created in {_existing(out)}"
        raise InputError(f"{problem} ({reason})", where=f"--out {out}", remedy=_ELSEWHERE) from None
    finally:
        _remove_empty(made)


def _make_folder(out: Path) -> None:
    """Make a folder and its parents, again if another command that tests its own place removes an empty parent meanwhile."""
    for _ in range(_MOST_TRIES):
        with suppress(FileNotFoundError):
            out.mkdir(parents=True, exist_ok=True)
            return
    out.mkdir(parents=True, exist_ok=True)


@contextmanager
def filling(out: Path) -> Iterator[Path]:
    """Provide a temporary folder to write to, so that the output folder `out` is complete or absent.

    Its content moves to `out` if the `with` block succeeds, and is removed if it fails. Raises InputError if `out` exists and
    is not empty or cannot be created, if the disk is full, or if a path cannot be written.
    """
    empty_folder(out)
    temporary = out / ".part" if out.exists() else out.absolute().with_name(f".{out.absolute().name}.part")
    with _made_for(out.absolute()):
        try:
            _remove_folder(temporary)
            temporary.mkdir(parents=True)
            yield temporary
            out.mkdir(exist_ok=True)
            for made in sorted(temporary.iterdir()):
                made.rename(out / made.name)
        except OSError as error:
            raise _as_input_error(error, out) from None
        finally:
            _remove_folder(temporary)


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to the file `path`, completely or not at all."""
    with writing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, with the line ends that it has, completely or not at all.

    Bytes that are no characters, as in a file name of another encoding, are written as escape sequences.
    """
    write_bytes(path, text.encode(errors="backslashreplace"))


def write_json(path: Path, value: Any) -> None:
    """Write a value as a JSON file that is complete or absent. Keys stay in the order that they have in `value`.

    NumPy values become numbers and lists, paths become strings. Raises ValueError for NaN and infinity, which JSON does not
    have; use None for a missing value.
    """
    write_text(path, json.dumps(value, indent=2, allow_nan=False, default=_plain) + "\n")


def _plain(value: Any) -> Any:
    """Convert NumPy values and paths for JSON."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")


def _as_input_error(error: OSError, path: Path) -> Exception:
    """Return an error that the user can solve as an InputError, and any other error unchanged."""
    where, code = str(path), error.errno or _numpy_errno(error)
    if code in _FULL:
        free = shutil.disk_usage(_existing(path)).free / 1e6
        return InputError(
            f"the results cannot be written: {_FULL[code]}, and {free:,.0f} MB are free",
            where=where,
            remedy=f"make room or {_ELSEWHERE}",
        )
    if code in _FORBIDDEN:
        return InputError(
            f"the file cannot be written ({error.strerror})", where=where, remedy=f"change the permissions or {_ELSEWHERE}"
        )
    if code in _NO_SUCH_PLACE:
        return InputError(f"the path cannot be a file ({error.strerror})", where=where, remedy=_ELSEWHERE)
    return error


def _numpy_errno(error: OSError) -> int:
    """Return ENOSPC for the error of ndarray.tofile (used by tifffile), which describes a full disk only in words."""
    return errno.ENOSPC if "requested and" in str(error) else 0


def _existing(path: Path) -> Path:
    """Return the nearest existing folder above `path`."""
    return next(folder for folder in path.absolute().parents if folder.exists())


def _remove_folder(temporary: Path) -> None:
    """Remove a folder with its content."""
    shutil.rmtree(temporary, ignore_errors=True)


def _remove(temporary: Path) -> None:
    """Remove a file."""
    try:
        temporary.unlink(missing_ok=True)
    except OSError:  # the folder is not writable, so it contains no temporary file
        return
