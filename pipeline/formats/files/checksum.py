"""Checksums of files."""

from __future__ import annotations

import hashlib
from pathlib import Path

from scene.common.errors import InputError
from scene.common.regular_file import check_file

_MOST_BYTES = 16_000_000_000
"""Largest size of a file; larger ones would take minutes."""


def sha256(path: Path) -> str:
    """Return the SHA-256 checksum of a file in hexadecimal, which tells whether it was changed.

    Raises InputError if it cannot be read or is too large.
    """
    check_file(path, most_bytes=_MOST_BYTES, if_too_large="cut it to the scene")
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(
            f"the file cannot be read ({error.strerror})",
            where=str(path),
            remedy="give the path of an existing file that you may read",
        ) from None
