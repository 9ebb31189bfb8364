"""Bad inputs for `gap`: camera files of other programs (COLMAP's text model, Metashape's XML, OpenCV's calibrations)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import yaml

from benchmarks.bad_inputs.case import Case
from benchmarks.bad_inputs.exchange_cases import sparse
from benchmarks.bad_inputs.spoil import Change, both, instead, link, pipe, put, text
from pipeline.formats.cameras.cameras import read_cameras_yaml
from pipeline.formats.cameras.colmap import write_colmap
from pipeline.formats.cameras.metashape import write_metashape
from pipeline.formats.cameras.opencv import write_opencv
from sensors.cameras.camera import Camera


def _camera_files(write: Callable[[Path], object], *changes: Change) -> Change:
    """Replace cameras.yaml of pair/ by a file or folder of another program."""

    def change(folder: Path) -> None:
        write(folder)
        both(*changes)(folder)

    return change


def _as_colmap(folder: Path) -> None:
    pair = read_cameras_yaml(folder / "pair/cameras.yaml")
    plain = {"left.jpg": _plain(pair.left), "right.jpg": _plain(pair.right)}
    write_colmap(folder / "pair/colmap", plain)
    put("pair/measurement.yaml", cameras="colmap")(folder)


def _plain(camera: Camera) -> Camera:
    """Return the camera without parameters that the other models lack."""
    return replace(camera, b2=0.0, k4=0.0)


def _as_metashape(folder: Path) -> None:
    pair = read_cameras_yaml(folder / "pair/cameras.yaml")
    write_metashape(folder / "pair/cameras.xml", {"left": pair.left, "right": pair.right})
    put("pair/measurement.yaml", cameras="cameras.xml")(folder)


def _as_opencv(folder: Path) -> None:
    path = folder / "pair/cameras.yaml"
    write_opencv(folder / "pair/lens.yaml", _plain(read_cameras_yaml(path).left))
    values = yaml.safe_load(path.read_text())
    pose = {key: values["left"][key] for key in ("position_m", "rotation")}
    path.write_text(yaml.safe_dump({**values, "left": {"calibration": "lens.yaml", **pose}}))


def words(name: str, old: str, new: str, count: int = 1) -> Change:
    """Replace words in a text file; raise ValueError if they are not there."""

    def change(folder: Path) -> None:
        content = (folder / name).read_text()
        if old not in content:
            raise ValueError(f"{name} has no {old!r}")
        (folder / name).write_text(content.replace(old, new, count))

    return change


def _line(name: str, number: int, content: str) -> Change:
    """Replace a line, counted from 0, in a text file."""

    def change(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        lines[number] = content
        (folder / name).write_text("\n".join(lines) + "\n")

    return change


_IMAGES, _CAMERAS = "pair/colmap/images.txt", "pair/colmap/cameras.txt"
_XML, _LENS = "pair/cameras.xml", "pair/lens.yaml"
_PROJECTED = '<reference>PROJCS["x",GEOGCS["y"]]</reference></chunk>'
_COLMAP: dict[str, tuple[Change, ...]] = {
    "good": (),
    "images empty": (text(_IMAGES, ""),),
    "cameras empty": (text(_CAMERAS, ""),),
    "cameras gone": (lambda folder: (folder / _CAMERAS).unlink(),),
    "images a pipe": (instead(_IMAGES, pipe),),
    "cameras a folder": (instead(_CAMERAS, lambda path: path.mkdir()),),
    "quaternion 0": (_line(_IMAGES, 0, "1 0 0 0 0 1 2 3 1 left.jpg"),),
    "quaternion 1e300": (_line(_IMAGES, 0, "1 1e300 1e300 0 0 1 2 3 1 left.jpg"),),
    "quaternion nan": (_line(_IMAGES, 0, "1 nan 0 0 0 1 2 3 1 left.jpg"),),
    "translation 1e300": (_line(_IMAGES, 0, "1 1 0 0 0 1e300 2 3 1 left.jpg"),),
    "one name twice": (_line(_IMAGES, 2, "2 1 0 0 0 1 2 3 1 left.jpg"),),
    "three images": (lambda folder: _append(folder / _IMAGES, "\n3 1 0 0 0 1 2 3 1 third.jpg\n\n"),),
    "camera unknown": (_line(_IMAGES, 0, "1 1 0 0 0 1 2 3 77 left.jpg"),),
    "words": (_line(_IMAGES, 0, "1 a b c d e f g 1 left.jpg"),),
    "width 1e300": (_line(_CAMERAS, 0, "1 PINHOLE 1e300 1e300 1000 1000 10 10"),),
    "width nan": (_line(_CAMERAS, 0, "1 PINHOLE nan nan 1000 1000 10 10"),),
    "width 0": (_line(_CAMERAS, 0, "1 PINHOLE 0 0 1000 1000 10 10"),),
    "focal length 0": (_line(_CAMERAS, 0, "1 PINHOLE 1200 900 1000 0 10 10"),),
    "focal length -1": (_line(_CAMERAS, 0, "1 PINHOLE 1200 900 1000 -1 10 10"),),
    "fisheye": (_line(_CAMERAS, 0, "1 OPENCV_FISHEYE 1200 900 1000 1000 600 450 0 0 0 0"),),
    "distortion 1e6": (_line(_CAMERAS, 0, "1 OPENCV 1200 900 1000 1000 600 450 1e6 0 0 0"),),
    "distortion 1e300": (_line(_CAMERAS, 0, "1 OPENCV 1200 900 1000 1000 600 450 1e300 0 0 0"),),
    "binary": (text(_CAMERAS, bytes(range(256)) * 4),),
}  # fmt: skip
_METASHAPE: dict[str, tuple[Change, ...]] = {
    "good": (),
    "rotation 0": (words(_XML, "<transform>", "<transform>0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 1</transform><x>", 1),),
    "scale 0": (words(_XML, "<scale>1.0</scale>", "<scale>0</scale>"),),
    "scale 1e300": (words(_XML, "<scale>1.0</scale>", "<scale>1e300</scale>"),),
    "scale 1e-300": (words(_XML, "<scale>1.0</scale>", "<scale>1e-300</scale>"),),
    "scale nan": (words(_XML, "<scale>1.0</scale>", "<scale>nan</scale>"),),
    "focal length nan": (words(_XML, "<f>", "<f>nan</f><g>", 1), words(_XML, "</f>", "</g>", 2), words(_XML, "</g>", "</f>", 1)),
    "label twice": (words(_XML, 'label="right" enabled', 'label="left" enabled'),),
    "label of markup": (words(_XML, 'label="right" enabled', 'label="&lt;script&gt;$x_{" enabled'),),
    "label gone": (words(_XML, 'label="right" enabled', "enabled"),),
    "sensor gone": (words(_XML, 'sensor_id="1"', 'sensor_id="7"'),),
    "width 1e300": (words(_XML, 'width="', 'width="1e300" w="'),),
    "width 1.5": (words(_XML, 'width="', 'width="1.5" w="'),),
    "width huge digits": (words(_XML, 'width="', f'width="{"9" * 5000}" w="'),),
    "fisheye": (words(_XML, 'type="frame"', 'type="fisheye"', 9),),
    "one unaligned": (words(_XML, "<transform>", "<unknown>", 2), words(_XML, "</transform>", "</unknown>", 2)),
    "nested 100000": (text(_XML, "<document>" + "<a>" * 100_000 + "</a>" * 100_000 + "</document>"),),
    "nested without end": (text(_XML, "<document>" + "<a>" * 1_000_000),),
    "encoding unknown": (text(_XML, "<?xml version='1.0' encoding='klingon'?><document/>"),),
    "a reference that is none": (words(_XML, "</chunk>", "<reference>PROJCS[</reference></chunk>"),),
    "a reference cut": (words(_XML, "</chunk>", _PROJECTED),),
    "60 GB": (text(_XML, "<document>"), sparse(_XML)),
}  # fmt: skip
_OPENCV: dict[str, tuple[Change, ...]] = {
    "good": (),
    "width inf": (words(_LENS, "image_width: ", "image_width: .Inf # "),),
    "width nan": (words(_LENS, "image_width: ", "image_width: .Nan # "),),
    "width a word": (words(_LENS, "image_width: ", "image_width: wide # "),),
    "width 1e30": (words(_LENS, "image_width: ", "image_width: 1e30 # "),),
    "width -5": (words(_LENS, "image_width: ", "image_width: -5 # "),),
    "width a list": (words(_LENS, "image_width: ", "image_width: [1, 2] # "),),
    "matrix of 2 rows": (words(_LENS, "rows: 3", "rows: 2"),),
    "matrix of 1e9 rows": (words(_LENS, "rows: 3", "rows: 1000000000"),),
    "matrix of words": (words(_LENS, "data: [", "data: [a, "),),
    "matrix of bytes": (words(_LENS, "dt: d", "dt: u"),),
    "matrix nan": (words(_LENS, "data: [", "data: [.Nan, "),),
    "matrix a number": (words(_LENS, "camera_matrix: !!opencv-matrix", "camera_matrix: 3\nother: !!opencv-matrix"),),
    "distortion gone": (words(_LENS, "distortion_coefficients:", "other:"),),
    "cut": (lambda folder: (folder / _LENS).write_bytes((folder / _LENS).read_bytes()[:200]),),
    "no tag": (words(_LENS, "%YAML 1.2", "%YAML 9.9"),),
    "a pipe": (instead(_LENS, pipe),),
    "/dev/zero": (instead(_LENS, link("/dev/zero")),),
    "a folder": (instead(_LENS, lambda path: path.mkdir()),),
    "xml cut": (text("pair/lens.xml", '<?xml version="1.0"?><opencv_storage><image_width>'), words("pair/cameras.yaml",
        "lens.yaml", "lens.xml")),
    "text of nan": (text("pair/lens.txt", "nan " * 15), words("pair/cameras.yaml", "lens.yaml", "lens.txt")),
    "text of inf": (text("pair/lens.txt", "inf " * 15), words("pair/cameras.yaml", "lens.yaml", "lens.txt")),
    "text of 1e300": (text("pair/lens.txt", "1e300 " * 15), words("pair/cameras.yaml", "lens.yaml", "lens.txt")),
    "text of 60 GB": (sparse("pair/lens.txt"), words("pair/cameras.yaml", "lens.yaml", "lens.txt")),
    "text in Latin 1": (text("pair/lens.txt", b"\xf6 " * 15), words("pair/cameras.yaml", "lens.yaml", "lens.txt")),
    "json": (text("pair/lens.json", '{"image_width": {"a": 1}}'), words("pair/cameras.yaml", "lens.yaml", "lens.json")),
    "itself": (words("pair/cameras.yaml", "lens.yaml", "cameras.yaml"),),
}  # fmt: skip


def _append(path: Path, more: str) -> None:
    path.write_text(path.read_text() + more)


def _pair(name: str, changes: dict[str, tuple[Change, ...]], write: Callable[[Path], object]) -> list[Case]:
    words_ = ("gap", "pair", "--out", "out", "--quiet")
    return [Case(f"gap: {name} {each}", words_, ("pair",), _camera_files(write, *made)) for each, made in changes.items()]


def cases() -> list[Case]:
    return [
        *_pair("colmap", _COLMAP, _as_colmap),
        *_pair("metashape", _METASHAPE, _as_metashape),
        *_pair("opencv", _OPENCV, _as_opencv),
    ]
