"""Cameras read from the active chunk of a Metashape project; missing or damaged parts are named."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.formats.cameras.camera_files import oriented_files, read_oriented, stereo_pair
from pipeline.formats.cameras.metashape import read_metashape, write_metashape
from scene.common.errors import InputError
from sensors.cameras.camera import Camera

DESCRIPTOR = '<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.2.0" path="{projectname}.files/project.zip"/>\n'
"""As Metashape 1.2 to 2.3 write it, and the list below."""
CHUNKS = """<?xml version="1.0" encoding="UTF-8"?>
<document version="1.2.0">
  <chunks next_id="3" active_id="2"><chunk id="0" path="0/chunk.zip"/><chunk id="2" path="2/chunk.zip"/></chunks>
</document>"""


def _camera(x: float, f_px: float = 3000.0) -> Camera:
    lens = dict.fromkeys(("b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2"), 0.0)
    return Camera(1000, 800, f_px, 3.0, -4.0, **lens, position=np.array([x, -50.0, 2.0]), rotation=np.eye(3))


def _archive(path: Path, text: str, name: str = "doc.xml") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(name, text)


def _damage(path: Path, packing: int) -> None:
    """Write an archive with a compressed document and change some of its bytes."""
    with zipfile.ZipFile(path, "w", packing) as file:
        file.writestr("doc.xml", "<chunk/>" * 200)
    content = bytearray(path.read_bytes())
    content[45:60] = bytes(15 * [255])
    path.write_bytes(content)


def _unknown_packing(path: Path) -> None:
    """Write an archive that names a compression method that does not exist."""
    _archive(path, "<chunk/>")
    content = bytearray(path.read_bytes())
    content[8] = content[content.index(b"PK\x01\x02") + 10] = 97
    path.write_bytes(content)


def _chunk(folder: Path, cameras: dict[str, Camera]) -> str:
    """Write the chunk of an exported camera XML as a project's archive holds it."""
    write_metashape(folder / "export.xml", cameras)
    chunk = ElementTree.parse(folder / "export.xml").getroot().find("chunk")
    assert chunk is not None
    return ElementTree.tostring(chunk, encoding="unicode")


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Write `rock wall.psx` with two chunks, the second of which is active."""
    files = tmp_path / "rock wall.files"
    (tmp_path / "rock wall.psx").write_text(DESCRIPTOR)
    _archive(files / "project.zip", CHUNKS)
    _archive(files / "0" / "chunk.zip", _chunk(tmp_path, {"first": _camera(0.0)}))
    _archive(files / "2" / "chunk.zip", _chunk(tmp_path, {"L": _camera(-7.0), "R": _camera(7.0, 3100.0)}))
    (tmp_path / "export.xml").unlink()
    return tmp_path / "rock wall.psx"


def test_the_active_chunk_is_read(project: Path) -> None:
    found = read_oriented(project)
    assert found is not None
    pair = stereo_pair(found, "L", "R", str(project))
    assert (pair.left.position[0], pair.right.position[0], pair.right.f_px) == (-7.0, 7.0, 3100.0)
    assert [path.name for path in oriented_files(project)] == ["rock wall.psx", "project.zip", "chunk.zip"]


def test_an_only_chunk_needs_not_be_active(project: Path) -> None:
    _archive(
        project.with_suffix(".files") / "project.zip",
        CHUNKS.replace(' active_id="2"', "").replace('<chunk id="0" path="0/chunk.zip"/>', ""),
    )
    assert list(read_metashape(project).cameras) == ["L", "R"]


@pytest.mark.parametrize(
    ("spoil", "what"),
    [
        (lambda psx, files: psx.write_text("<document/>"), "not a Metashape project"),
        (lambda psx, files: psx.write_text(DESCRIPTOR.replace("{projectname}", "../{projectname}")), "outside of its folder"),
        (lambda psx, files: (files / "project.zip").unlink(), "No such file"),
        (
            lambda psx, files: (files / "2" / "chunk.zip").write_bytes(b"PK\x03\x04 and no more"),
            "not an archive of a Metashape project",
        ),
        (
            lambda psx, files: _archive(files / "2" / "chunk.zip", "<chunk/>", "other.xml"),
            "not an archive of a Metashape project",
        ),
        (lambda psx, files: _damage(files / "2" / "chunk.zip", zipfile.ZIP_DEFLATED), "not an archive of a Metashape project"),
        (lambda psx, files: _damage(files / "2" / "chunk.zip", zipfile.ZIP_LZMA), "not an archive of a Metashape project"),
        (
            lambda psx, files: _unknown_packing(files / "2" / "chunk.zip"),
            r"not an archive of a Metashape project \(.*not supported",
        ),
        (lambda psx, files: _archive(files / "2" / "chunk.zip", "<frame/>"), "has <frame> as its outermost element"),
        (lambda psx, files: _archive(files / "2" / "chunk.zip", "<chunk>"), "not valid XML"),
        (lambda psx, files: _archive(files / "2" / "chunk.zip", "<!DOCTYPE x><chunk/>"), "entities"),
        (
            lambda psx, files: _archive(files / "project.zip", CHUNKS.replace("2/chunk.zip", "/etc/chunk.zip")),
            "outside of its folder",
        ),
        (lambda psx, files: _archive(files / "project.zip", CHUNKS.replace(' active_id="2"', "")), "2 chunks, of which none"),
    ],
)
def test_what_is_missing_or_damaged_is_named(project: Path, spoil: Callable[[Path, Path], object], what: str) -> None:
    spoil(project, project.with_suffix(".files"))
    with pytest.raises(InputError, match=what):
        read_metashape(project)


def test_a_document_beyond_the_limit_is_not_unpacked(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.formats.cameras.metashape_project.MOST_TEXT_BYTES", 100)
    with pytest.raises(InputError, match=r"project\.zip: its doc\.xml has 0 MB") as found:
        read_metashape(project)
    assert "not an archive" not in str(found.value)
