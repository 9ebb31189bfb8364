"""Checksums of files."""

from __future__ import annotations

import hashlib
from pathlib import Path

from scene.errors import InputError
from scene.regular_file import check_file


def sha256(path: Path) -> str:
    """The checksum of a file, in hexadecimal; raises InputError where it cannot be read."""
    check_file(path)
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path)) from None
