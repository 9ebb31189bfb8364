"""Files that are either whole or absent: written under a temporary name in the same folder, then renamed."""

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
_FORBIDDEN = {errno.EACCES, errno.EPERM, errno.EROFS}
_NO_SUCH_PLACE = {errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.EEXIST, errno.ENOENT}
_ELSEWHERE = "choose another folder with --out"


_noted: ContextVar[list[Path] | None] = ContextVar("noted", default=None)


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """Give a temporary path to write to; it becomes `path` when the block ends well and vanishes when it does not.

    Missing folders are made. The temporary lies in the folder of `path` and keeps its suffix, so that libraries that choose a
    format by the suffix do so; it has one name per target, so that what a killed process left is overwritten by the next. The
    bytes are on the disk before the name is, so that a power failure leaves no empty file with it.
    Raises InputError for a full disk, a folder without permission to write and a path that cannot be a file.
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
    """A block that may make `folder` and those above it: where it fails, those that it made go again, if they are empty."""
    made = _missing(folder)
    try:
        yield
    except BaseException:
        _remove_empty(made)
        raise


def _missing(folder: Path) -> list[Path]:
    """`folder` and those above it that are not there, the inner ones first."""
    return [each for each in (folder, *folder.parents) if not os.path.lexists(each)]


def _remove_empty(folders: list[Path]) -> None:
    for each in folders:
        with suppress(OSError, ValueError):  # is not there, holds something, or cannot be a name
            each.rmdir()


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turn an operating system's error about `path` that a person can mend into an InputError."""
    try:
        yield
    except OSError as error:
        raise _as_input_error(error, path) from None


@contextmanager
def noting() -> Iterator[list[Path]]:
    """A list of the files that get their names by `writing` in the block, in this thread; blocks may be nested."""
    outer, found = _noted.get(), list[Path]()
    token = _noted.set(found)
    try:
        yield found
    finally:
        _noted.reset(token)
        if outer is not None:
            outer.extend(found)


def note(path: Path) -> None:
    """Add a file to the list of the `noting` around."""
    found = _noted.get()
    if found is not None:
        found.append(path)


def remove_written(out: Path, written: list[Path]) -> None:
    """Remove files (of a `noting`), and the folders in `out` that hold nothing else; what others put beside them stays."""
    for path in written:
        with suppress(OSError):  # is gone: it was renamed with its folder
            path.unlink()
    folders = {folder for path in written for folder in path.parents if out in folder.parents}
    for folder in sorted(folders, reverse=True):  # the inner ones first
        with suppress(OSError):  # is gone, or holds another's file
            folder.rmdir()


def give_name(temporary: Path, path: Path) -> None:
    """Rename a file or folder to `path`, both on the disk: the bytes before, the name after."""
    to_disk(temporary)
    temporary.replace(path)
    to_disk(path.parent)


def to_disk(path: Path) -> None:
    """Wait until a file's bytes, or a folder's names, are on the disk, as far as the file system can tell."""
    try:
        file = os.open(path, os.O_RDONLY)
    except PermissionError:  # may be written and not read
        return
    try:
        os.fsync(file)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(file)


def new_folder(parent: Path, name: str) -> Path:
    """A path under `parent` that is not there yet, called after `name` and the time."""
    stem = f"{name}_{datetime.now():%Y%m%d_%H%M%S}"
    names = (stem if number == 1 else f"{stem}_{number}" for number in range(1, 1000))
    return next(parent / free for free in names if not (parent / free).exists())


def empty_folder(out: Path, remedy: str = "choose another --out") -> Path:
    """`out` itself, if it is new or empty; InputError, naming --out, where it is in use or cannot be made."""
    check_place(out)
    if out.exists() and any(out.iterdir()):
        raise InputError("exists and is not an empty folder", where=f"--out {out}", remedy=remedy)
    return out


def check_place(out: Path) -> None:
    """Raise InputError, naming --out, where `out` cannot be a folder that is written into; it is tried, and nothing stays."""
    made = _missing(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        if not os.access(out, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except (OSError, ValueError) as error:  # ValueError: a null character
        reason = getattr(error, "strerror", None) or "a null character in its name"
        raise InputError(f"cannot be a folder to write into ({reason})", where=f"--out {out}", remedy=_ELSEWHERE) from None
    finally:
        _remove_empty(made)


@contextmanager
def filling(out: Path) -> Iterator[Path]:
    """Give a temporary folder to fill; what is in it appears in `out` when the block ends well, and vanishes when it does not.

    Raises InputError where `out` is in use, and as `writing` does.
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
    """Write `data`, whole or not at all."""
    with writing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8 with the line ends it has, whole or not at all; what is no character, such as the bytes of a file's
    name in another encoding, is written as \\udcf6."""
    write_bytes(path, text.encode(errors="backslashreplace"))


def write_json(path: Path, value: Any) -> None:
    """Write JSON in the order of the keys; NumPy scalars and arrays become numbers and lists, paths become strings.

    Raises ValueError for NaN and infinity, which JSON does not know: give None for a value that is not there.
    """
    write_text(path, json.dumps(value, indent=2, allow_nan=False, default=_plain) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")


def _as_input_error(error: OSError, path: Path) -> Exception:
    """What a person can mend, as an InputError; any other error as it is."""
    where, code = str(path), error.errno or _numpy_errno(error)
    if code in _FULL:
        free = shutil.disk_usage(_existing(path)).free / 1e6
        return InputError(f"{_FULL[code]}, {free:,.0f} MB are free", where=where, remedy=f"make room or {_ELSEWHERE}")
    if code in _FORBIDDEN:
        return InputError(f"may not be written ({error.strerror})", where=where, remedy=f"change the permissions or {_ELSEWHERE}")
    if code in _NO_SUCH_PLACE:
        return InputError(f"cannot be a file ({error.strerror})", where=where, remedy=_ELSEWHERE)
    return error


def _numpy_errno(error: OSError) -> int:
    """ndarray.tofile, which tifffile uses, tells a full disk by its words alone: "1000 requested and 10 written"."""
    return errno.ENOSPC if "requested and" in str(error) else 0


def _existing(path: Path) -> Path:
    """The nearest folder above `path` that exists."""
    return next(folder for folder in path.absolute().parents if folder.exists())


def _remove_folder(temporary: Path) -> None:
    shutil.rmtree(temporary, ignore_errors=True)


def _remove(temporary: Path) -> None:
    try:
        temporary.unlink(missing_ok=True)
    except OSError:  # the folder cannot be written, so there is nothing of ours in it
        return
