"""Files that are either whole or absent: written under a temporary name in the same folder, then renamed."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from scene.errors import InputError

_FULL = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "the file exceeds the size limit",
}
_FORBIDDEN = {errno.EACCES, errno.EPERM, errno.EROFS}
_NO_SUCH_PLACE = {errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.EEXIST, errno.ENOENT}
_ELSEWHERE = "choose another folder with --out"


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """Give a temporary path to write to; it becomes `path` when the block ends well and vanishes when it does not.

    Missing folders are made. The temporary lies in the folder of `path` and keeps its suffix, so that libraries that choose a
    format by the suffix do so; it has one name per target, so that what a killed process left is overwritten by the next.
    Raises InputError for a full disk, a folder without permission to write and a path that cannot be a file.
    """
    temporary = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise _as_input_error(error, path) from None
    finally:
        _remove(temporary)


def empty_folder(out: Path) -> Path:
    """`out` itself, if it is new or empty; InputError, naming --out, where it is in use."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError("exists and is not an empty folder", where=f"--out {out}", remedy="choose another --out")
    return out


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data`, whole or not at all."""
    with writing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8 with the line ends it has, whole or not at all."""
    write_bytes(path, text.encode())


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


def _remove(temporary: Path) -> None:
    try:
        temporary.unlink(missing_ok=True)
    except OSError:  # the folder cannot be written, so there is nothing of ours in it
        return
