"""Bad inputs that other programs leave in a file's place: failed downloads, pointers to files, archives, unwritten blocks."""

from __future__ import annotations

import gzip
import io
import zipfile
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from benchmarks.bad_inputs.case import PORT_IN_USE, Case
from benchmarks.bad_inputs.spoil import Change

_ZIPPED = io.BytesIO()
with zipfile.ZipFile(_ZIPPED, "w") as _archive:
    _archive.writestr(zipfile.ZipInfo("scan.las"), b"LASF" + bytes(300))
CONTENTS: dict[str, bytes] = {
    "a pointer of Git LFS": b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"4d7a" * 16 + b"\nsize 132735\n",
    "a page that says 404": b"<!DOCTYPE html>\n<html><head><title>404 Not Found</title></head><body>Not Found</body></html>\n",
    "an archive": _ZIPPED.getvalue(),
    "gzip": gzip.compress(b"x y z\n1 2 3\n" * 100, mtime=0),
    "10 MB of zeros": bytes(10_000_000),
    "a PDF": b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n1 0 obj\n<< /Type /Catalog >>\nendobj\n",
    "a line's end": b"\n",
    "a byte order mark": b"\xef\xbb\xbf",
    "an error of a server": b'{"error": {"code": 403, "message": "Forbidden"}}\n',
    "a Mac's other half": b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X        \x00\x02\x00\x00\x00\x09" + bytes(60),
    "a word": b"none",
    "a program": b"\x7fELF\x02\x01\x01" + bytes(57),
    "a pickle": b"\x80\x04\x95\x1c" + bytes(7) + b"\x8c\x05posix\x94\x8c\x06system\x94\x93\x94\x8c\x04true\x94\x85\x94R\x94.",
    "a certificate's text": b"-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n",
}
"""Content of each kind, as bytes."""
_OUT = ("--out", "out", "--quiet")
_RAW = ("--scanner", "riegl_vz400i", *_OUT)
_TO_WALL = ("--reference", "raw/wall.ply", *_RAW)
_TO_RAW = ("measurement", "raw/scan.ply", "--reference", "raw/wall.ply")
_TLS, _STEREO = (("simulate", "--sensor", sensor, "--config", "site.yaml") for sensor in ("tls", "stereo"))
_MAP = "run/difference_001.tif"
_VIEW = ("--no-browser", "--port", str(PORT_IN_USE))
_SUFFIXES = ("las", "laz", "ply", "e57", "ptx", "pts", "xyz", "csv", "pcd")
_MESHES = ("ply", "obj", "stl", "glb", "off", "tif")
_PLACES: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "gap: points": ("measurement/scan.ply", ("gap", "measurement", *_OUT), ("measurement",)),
    "gap: reference": ("measurement/wall.ply", ("gap", "measurement", *_OUT), ("measurement",)),
    "gap: model": ("measurement/model.yaml", ("gap", "measurement", *_OUT), ("measurement",)),
    "gap: measurement.yaml": ("measurement/measurement.yaml", ("gap", "measurement", *_OUT), ("measurement",)),
    "gap: stereo cameras": ("pair/cameras.yaml", ("gap", "pair", *_OUT), ("pair",)),
    "gap: stereo points": ("pair/surface.xyz", ("gap", "pair", *_OUT), ("pair",)),
    **{
        f"raw: scan.{suffix}": (f"scan.{suffix}", ("measurement", f"scan.{suffix}", *_TO_WALL), ("raw",))
        for suffix in _SUFFIXES
    },
    **{
        f"raw: reference.{suffix}": (
            f"wall.{suffix}", ("measurement", "raw/scan.ply", "--reference", f"wall.{suffix}", *_RAW), ("raw",)
        )
        for suffix in _MESHES
    },
    "raw: scanner": ("own.yaml", (*_TO_RAW, "--model", "own.yaml", *_OUT), ("raw",)),
    "raw: cameras": (
        "own.xml", (*_TO_RAW, "--cameras", "own.xml", *_OUT), ("raw",)
    ),
    "surface: cloud": ("cloud.xyz", ("surface", "cloud.xyz", "--out", "a.ply", "--seen-from", "0", "0", "0"), ()),
    "surface: cloud.laz": ("cloud.laz", ("surface", "cloud.laz", "--out", "a.ply", "--seen-from", "0", "0", "0"), ()),
    "ev: truth": ("truth.json", ("evaluate", "truth.json", "found.json"), ("found.json",)),
    "ev: found": ("found.json", ("evaluate", "truth.json", "found.json"), ("truth.json",)),
    "det: map": (_MAP, ("detect", "baseline", _MAP, *_OUT), ("run",)),
    "det: run.json": ("run/run.json", ("detect", "baseline", "run", *_OUT), ("run",)),
    "det: weights": ("detector/model.weights.h5", ("detect", "detector", _MAP, *_OUT), ("run", "detector")),
    "det: detector.yaml": ("detector/detector.yaml", ("detect", "detector", _MAP, *_OUT), ("run", "detector")),
    "train: annotations": ("set/train/annotations.json", ("train", "set", *_OUT), ("set",)),
    "train: config": ("own.yaml", ("train", "set", "--config", "own.yaml", *_OUT), ("set",)),
    "sim: config": ("own.yaml", ("simulate", "--sensor", "tls", "--config", "own.yaml", *_OUT), ()),
    "sim: mesh": ("own.obj", (*_TLS, "--set", "wall={mesh: own.obj}", *_OUT), ("site.yaml",)),
    "sim: cameras": (
        "own.xml", (*_STEREO, "--set", "cameras={file: own.xml}", *_OUT), ("site.yaml",)
    ),
    "inspect: config": ("own.yaml", ("inspect", "own.yaml", *_OUT), ()),
    "cmp: config": ("own.yaml", ("compare", "own.yaml", "--epochs", "1", *_OUT), ()),
    "cmp: measured": (_MAP, ("compare", "site.yaml", "--measured", "run", "--epochs", "1", *_OUT), ("run", "site.yaml")),
    "cal: map": (_MAP, ("calibrate", "run", *_OUT), ("run",)),
    "icp: surface": ("run/epoch_001/surface.ply", ("icp-study", "run", "--repeats", "1", *_OUT), ("run",)),
    "ds: config": ("own.yaml", ("dataset", "own.yaml", *_OUT), ()),
    "ds: dataset.json": ("set/dataset.json", ("dataset", "verify", "set", "--quiet"), ("set",)),
    "ds: checksums": ("set/checksums.sha256", ("dataset", "verify", "set", "--report-only", "--quiet"), ("set",)),
    "ds: split": ("set/train/annotations.json", ("dataset", "split", "set", "--by", "noise", *_OUT), ("set",)),
    "view: run.json": ("run/run.json", ("view", "run", *_VIEW), ("run",)),
    "view: gap.json": ("diagnosis/gap.json", ("view", "diagnosis", *_VIEW), ("diagnosis",)),
    "view: before.laz": ("diagnosis/before.laz", ("view", "diagnosis", *_VIEW), ("diagnosis",)),
    "view: second": ("second/run.json", ("view", "run", "second", *_VIEW), ("run",)),
    "export: surface": ("run/epoch_001/surface.ply", ("export", "run", "picture", "--out", "a.png", "--quiet"), ("run",)),
    "export: points": ("run/epoch_001/points.laz", ("export", "run", "scan", "--out", "a.gif", "--quiet"), ("run",)),
    "export: annotations": ("set/val/annotations.json", ("export", "set", "yolo", *_OUT), ("set",)),
}  # fmt: skip
"""For each place, the file's name, the command's words and the materials that it needs."""
_EACH = 4
"""Number of contents that each place gets, in turn."""


def _in_turn() -> Iterator[str]:
    while True:
        yield from CONTENTS


def _written(name: str, content: bytes) -> Change:
    def change(folder: Path) -> None:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.write_bytes(content)

    return change


def cases() -> list[Case]:
    found, turn = [], _in_turn()
    codes = (0, 1, 2)  # 1: `verify --report-only` of a damaged set
    for place, (file, words, needs) in _PLACES.items():
        for what in islice(turn, _EACH):
            allowed = codes if "--report-only" in words else (0, 2)
            found.append(Case(f"{place} is {what}", words, needs, _written(file, CONTENTS[what]), allowed))
    return found
