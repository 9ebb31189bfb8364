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
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), remedy="check the path") from None
    return parsed(text, str(path))


def parsed(text: bytes, where: str) -> ElementTree.Element:
    """Return the root element of XML text; `where` names its file for errors. Raises InputError as `read_root` does."""
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise InputError("declares entities, which could fill the memory", where=where, remedy="export it again without them")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"is not valid XML ({error})", where=where, remedy="export it again") from None
