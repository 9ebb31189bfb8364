"""Read a Metashape project (.psx): a small XML that names an archive, which names the archives of its chunks.

    wall.psx                      <document path="{projectname}.files/project.zip"/>
    wall.files/project.zip        doc.xml: <chunks active_id="0"><chunk id="0" path="0/chunk.zip"/>
    wall.files/0/chunk.zip        doc.xml: <chunk> with sensors, components, cameras and transform, as in an exported camera XML

The tags are those of projects of Metashape 1.2 to 2.3, as other programs read and write them.
"""

from __future__ import annotations

import lzma
import xml.etree.ElementTree as ElementTree
import zipfile
import zlib
from pathlib import Path

from pipeline.formats.files.inside import inside
from pipeline.formats.files.xml_file import parsed, read_root
from scene.common.errors import InputError
from scene.common.regular_file import MOST_TEXT_BYTES, check_file

_DOCUMENT = "doc.xml"
_DAMAGED = (OSError, zipfile.BadZipFile, KeyError, EOFError, zlib.error, lzma.LZMAError, RuntimeError, UnicodeDecodeError)
"""Exceptions of `zipfile` for a project that cannot be read: no permission, not an archive, no doc.xml, a truncated file, a
damaged stream, encryption or an unknown compression (both RuntimeError), names in an unknown encoding.
"""
_EXPORT = "save the project in Metashape again, or export the cameras with File > Export > Export Cameras"


def is_project(path: Path) -> bool:
    """Return whether a file is a Metashape project, by its name."""
    return path.suffix.lower() == ".psx"


def active_chunk(path: Path) -> ElementTree.Element:
    """Return the chunk (set of photographs with their cameras) of a Metashape project that was active when it was saved.

    A project without an active chunk must have only one. Raises InputError if it has several, or if files of the project are
    missing or damaged.
    """
    return _document(project_files(path)[-1], "chunk")


def project_files(path: Path) -> list[Path]:
    """Return the files from which the cameras of a Metashape project are read.

    They are the project file, its archive, and the archive of its active chunk.
    """
    root = read_root(path)
    if root.tag != "document" or root.get("path") is None:
        raise InputError("the file is not a Metashape project", where=str(path), remedy=_EXPORT)
    project = inside(path.parent, str(root.get("path")).replace("{projectname}", path.stem), path)
    document = _document(project, "document")
    chunks, listed = document.findall("chunks/chunk"), document.find("chunks")
    number = None if listed is None else listed.get("active_id")
    chosen = [chunk for chunk in chunks if chunk.get("id") == number] or chunks
    if len(chosen) != 1:
        raise InputError(
            f"the project has {len(chunks)} chunks, of which none is active",
            where=str(project),
            remedy="open the chunk in Metashape and save the project",
        )
    return [path, project, inside(project.parent, chosen[0].get("path"), project)]


def _document(archive: Path, tag: str) -> ElementTree.Element:
    """Return the root of an archive's doc.xml."""
    where = f"{archive}: {_DOCUMENT}"
    root = parsed(_unpacked(archive), where)
    if root.tag != tag:
        raise InputError(f"the XML has <{root.tag}> as its outermost element", where=where, allowed=f"<{tag}>", remedy=_EXPORT)
    return root


def _unpacked(archive: Path) -> bytes:
    """Return the content of an archive's doc.xml."""
    check_file(archive)
    try:
        with zipfile.ZipFile(archive) as file:
            size = file.getinfo(_DOCUMENT).file_size
            text = file.read(_DOCUMENT) if size <= MOST_TEXT_BYTES else b""
    except _DAMAGED as error:
        raise InputError(
            f"the file is not an archive of a Metashape project ({' '.join(str(error).split())[:200]})",
            where=str(archive),
            remedy=_EXPORT,
        ) from None
    if size > MOST_TEXT_BYTES:
        raise InputError(
            f"its {_DOCUMENT} has {size / 1e6:,.0f} MB",
            where=str(archive),
            allowed=f"{MOST_TEXT_BYTES / 1e6:,.0f} MB",
            remedy=_EXPORT,
        )
    return text
