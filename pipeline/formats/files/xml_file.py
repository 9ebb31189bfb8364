"""Read XML of other programs, without entities, by which a small file could fill the memory."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from scene.common.errors import InputError
from scene.common.regular_file import MOST_TEXT_BYTES, check_file


def read_root(path: Path) -> ElementTree.Element:
    """Return the root element of an XML file.

    Raises InputError if it is not XML or declares entities, which could fill the memory.
    """
    check_file(path, most_bytes=MOST_TEXT_BYTES)
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"the file cannot be read ({error.strerror})",
            where=str(path),
            remedy="give the path of an existing XML file that you may read",
        ) from None
    return parsed(text, str(path))


def parsed(text: bytes, where: str) -> ElementTree.Element:
    """Return the root element of XML text; `where` names its file for errors. Raises InputError as `read_root` does."""
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise InputError(
            "the file declares XML entities (abbreviations), which could fill the memory when they are replaced",
            where=where,
            remedy="export the file again without entities in its DOCTYPE",
        )
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(
            f"the file is not valid XML ({error})",
            where=where,
            remedy="copy the complete file again, or export it again from the program that made it",
        ) from None
