"""Bad inputs for `measurement`, `gap SCAN --reference` and `surface`: raw files."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from benchmarks.bad_inputs.case import Case
from benchmarks.bad_inputs.spoil import (
    INFINITE,
    NAN,
    Array,
    Change,
    at,
    both,
    claiming_tiff,
    cut,
    gone,
    instead,
    link,
    map_of,
    merge_bomb,
    mesh,
    pipe,
    put,
    text,
    whole,
)
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.e57 import E57Scan, write_e57
from pipeline.formats.points.laz import write_laz
from pipeline.formats.points.points import read_points

SCAN, WALL = "raw/scan.ply", "raw/wall.ply"
FACTOR, OFFSET = 131, 155
"""Offsets of the first scale factor and the first coordinate offset in the header of a LAS file."""
_COUNT = 'recordCount="3606">\n        '
_TAIL = ("--reference", WALL, "--scanner", "riegl_vz400i", "--out", "out", "--quiet")


def _as(suffix: str, move: object = None, values: object = None) -> Change:
    """Write raw/scan with another suffix and other points (n, 3), scanner frame."""

    def change(folder: Path) -> None:
        found = read_points(folder / SCAN).points
        points = np.asarray(found if move is None else move(found), dtype=np.float64)  # type: ignore[operator]
        path = folder / f"raw/scan{suffix}"
        intensity = None if values is None else np.full(len(points), values, dtype=np.float64)
        cloud = PointCloud(points, intensity)
        if suffix in (".las", ".laz"):
            write_laz(path, cloud)
        elif suffix == ".e57":
            write_e57(path, [E57Scan("one", cloud, np.zeros(3), np.eye(3))])
        elif suffix == ".ptx":
            _write_ptx(path, points, np.eye(4))
        else:
            columns = points if intensity is None else np.column_stack([points, intensity])
            np.savetxt(path, columns, fmt="%.17g", delimiter="," if suffix == ".csv" else " ")

    return change


def _write_ptx(path: Path, points: Array, matrix: Array, columns: int | str = 1, rows: int | str | None = None) -> None:
    head = [str(columns), str(len(points) if rows is None else rows), *("0 0 0", "1 0 0", "0 1 0", "0 0 1")]
    head += [" ".join(f"{value:.17g}" for value in row) for row in matrix]
    path.write_text("\n".join([*head, *(f"{x:.9g} {y:.9g} {z:.9g} 0.5" for x, y, z in points)]) + "\n")


def _ptx(matrix: object = None, columns: int | str = 1, rows: int | str | None = None) -> Change:
    def change(folder: Path) -> None:
        points = read_points(folder / SCAN).points
        _write_ptx(folder / "raw/scan.ptx", points, np.eye(4) if matrix is None else np.asarray(matrix, float), columns, rows)

    return change


def _e57(position: object = (0, 0, 0), rotation: object = None, name: str = "one", times: int = 1) -> Change:
    def change(folder: Path) -> None:
        cloud = PointCloud(read_points(folder / SCAN).points)
        turn = np.eye(3) if rotation is None else np.asarray(rotation, float)
        scans = [E57Scan(f"{name}{k or ''}", cloud, np.asarray(position, float) * (1 + k), turn) for k in range(times)]
        write_e57(folder / "raw/scan.e57", scans)

    return change


def _in_e57(old: str, new: str) -> Change:
    return lambda folder: in_e57(folder / "raw/scan.e57", old, new)


def in_e57(path: Path, old: str, new: str) -> None:
    """Replace words by shorter ones in the XML of an E57 file, and correct the checksums of its pages."""
    data = path.read_bytes()
    body = b"".join(data[k : k + 1020] for k in range(0, len(data), 1024)).replace(old.encode(), new.ljust(len(old)).encode())
    pages = [body[k : k + 1020] for k in range(0, len(body), 1020)]
    path.write_bytes(b"".join(page + struct.pack(">I", _crc32c(page)) for page in pages))


def _crc32c(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def _random(found: Array) -> Array:
    return np.random.default_rng(1).uniform(found.min(axis=0), found.max(axis=0), found.shape)


_MOVES: dict[str, object] = {
    "0 points": lambda found: found[:0],
    "1 point": lambda found: found[:1],
    "3 points": lambda found: found[:3],
    "50 points": lambda found: found[::70][:50],
    "99 points": lambda found: found[::30][:99],
    "150 points": lambda found: found[::20][:150],
    "identical points": lambda found: np.repeat(found[:1], 5000, axis=0),
    "two places": lambda found: np.repeat(found[:2], 2500, axis=0),
    "points on one line": lambda found: found[0] + np.linspace(0, 1, 3000)[:, None] * (found[1000] - found[0]),
    "points on one line of sight": lambda found: found[0] * np.linspace(0.5, 1.5, 3000)[:, None],
    "points in a plane": lambda found: found * [1, 0, 1],
    "random cloud": _random,
    "mm": lambda found: 1000 * found,
    "km": lambda found: found / 1000,
    "feet": lambda found: found / 0.3048,
    "1e5 away": lambda found: found + 1e5,
    "1e7 away": lambda found: found + 1e7,
    "1e300": lambda found: found * 1e300,
    "one far": lambda found: np.concatenate([found, [[1e6, 0, 0]]]),
    "one at the scanner": lambda found: np.concatenate([found, [[0, 0, 0]]]),
    "half at the scanner": lambda found: np.concatenate([found, found * 0]),
    "nan": lambda found: found * NAN,
    "half nan": lambda found: np.where(np.arange(len(found))[:, None] % 2 == 0, found, NAN),
    "one inf": lambda found: np.concatenate([found, [[INFINITE, 0, 0]]]),
    "behind wall 10 m": lambda found: found * (1 + 10 / np.linalg.norm(found, axis=1, keepdims=True)),
    "behind the scanner": lambda found: -found,
    "mirrored": lambda found: found * [1, 1, -1],
    "y and z exchanged": lambda found: found[:, [0, 2, 1]],
    "rounded to a metre": np.round,
    "rounded to a centimetre": lambda found: np.round(found, 2),
    "shuffled": np.random.default_rng(1).permutation,
    "all twice": lambda found: np.concatenate([found, found]),
    "all zero": lambda found: found * 0,
}  # fmt: skip
_FILES: dict[str, tuple[str, Change]] = {
    "xyz negative intensity": ("xyz", _as(".xyz", values=-1.0)),
    "xyz nan intensity": ("xyz", _as(".xyz", values=NAN)),
    "xyz huge intensity": ("xyz", _as(".xyz", values=1e300)),
    "xyz empty": ("xyz", text("raw/scan.xyz", "")),
    "xyz of words": ("xyz", text("raw/scan.xyz", "a b c\nd e f\n")),
    "xyz of two columns": ("xyz", text("raw/scan.xyz", "1 2\n3 4\n" * 100)),
    "xyz one 50 MB line": ("xyz", text("raw/scan.xyz", lambda: b"1.0 2.0 3.0 " * 4_200_000)),
    "xyz header of 50 MB": ("xyz", text("raw/scan.xyz", b"# a\n" * 12_000_000)),
    "xyz in UTF-16": ("xyz", text("raw/scan.xyz", "1 2 3\n4 5 6\n".encode("utf-16"))),
    "xyz in Latin 1": ("xyz", text("raw/scan.xyz", "x y z h\u00f6he\n1 2 3 4\n".encode("latin-1"))),
    "xyz of 4000 columns": ("xyz", text("raw/scan.xyz", (" ".join(["1"] * 4000) + "\n") * 200)),
    "xyz of hexadecimal": ("xyz", text("raw/scan.xyz", "0x1 0x2 0x3\n" * 200)),
    "xyz decimal commas": ("xyz", text("raw/scan.xyz", "1,5 2,5 3,5\n" * 200)),
    "xyz a name twice": ("xyz", text("raw/scan.xyz", "x x z\n1 2 3\n" * 1 + "1 2 3\n" * 200)),
    "xyz is a pipe": ("xyz", instead("raw/scan.xyz", pipe)),
    "ptx is a pipe": ("ptx", instead("raw/scan.ptx", pipe)),
    "ptx is /dev/zero": ("ptx", instead("raw/scan.ptx", link("/dev/zero"))),
    "ptx is a folder": ("ptx", instead("raw/scan.ptx", lambda path: path.mkdir())),
    "ptx is a loop of links": ("ptx", instead("raw/scan.ptx", link("scan.ptx"))),
    "ptx empty": ("ptx", text("raw/scan.ptx", "")),
    "ptx binary": ("ptx", text("raw/scan.ptx", bytes(range(256)) * 10)),
    "ptx grid 1e9": ("ptx", _ptx(columns=10**9, rows=10**9)),
    "ptx grid negative": ("ptx", _ptx(columns=-1)),
    "ptx grid 0": ("ptx", _ptx(columns=0)),
    "ptx grid of 5000 digits": ("ptx", _ptx(columns="1" * 5000)),
    "ptx grid of words": ("ptx", _ptx(columns="a")),
    "ptx grid too small": ("ptx", _ptx(rows=100)),
    "ptx matrix zero": ("ptx", _ptx(np.zeros((4, 4)))),
    "ptx matrix nan": ("ptx", _ptx(np.full((4, 4), NAN))),
    "ptx matrix 1e300": ("ptx", _ptx(np.eye(4) * 1e300)),
    "ptx position 1e300": ("ptx", _ptx([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1e300, 0, 0, 1]])),
    "ptx position infinite": ("ptx", _ptx([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [INFINITE, 0, 0, 1]])),
    "ptx mirrored": ("ptx", _ptx(np.diag([1, 1, -1, 1]))),
    "ptx one 50 MB line": ("ptx", text("raw/scan.ptx", b"1 " * 25_000_000)),
    "e57 position 1e300": ("e57", _e57((1e300, 0, 0))),
    "e57 position 1e6": ("e57", _e57((1e6, 0, 0))),
    "e57 rotation zero": ("e57", both(_e57((1, 2, 3)), _in_e57('<w type="Float">1</w>', '<w type="Float">0</w>'))),
    "e57 name of markup": ("e57", _e57(name="<script>alert(1)</script>$x_{\u001b[31m")),
    "e57 name very long": ("e57", _e57(name="a" * 50_000)),
    "e57 5 scans of 5 places": ("e57", _e57((5, 0, 0), times=5)),
    "e57 cut": ("e57", both(_e57(), cut("raw/scan.e57"))),
    "e57 empty": ("e57", text("raw/scan.e57", b"")),
    "e57 garbage": ("e57", text("raw/scan.e57", bytes(range(256)) * 16)),
    "e57 is a pipe": ("e57", instead("raw/scan.e57", pipe)),
    "e57 claims 1e9 points": ("e57", both(_e57(), _in_e57(_COUNT, 'recordCount="999999999">'))),
    "e57 claims 1e11 points": ("e57", both(_e57(), _in_e57(_COUNT, 'recordCount="99999999999">'))),
    "las scale 0": ("las", both(_as(".las"), at("raw/scan.las", FACTOR, "<d", 0.0))),
    "las scale nan": ("las", both(_as(".las"), at("raw/scan.las", FACTOR, "<d", NAN))),
    "las scale 1": ("las", both(_as(".las"), at("raw/scan.las", FACTOR, "<d", 1.0))),
    "las scale negative": ("las", both(_as(".las"), at("raw/scan.las", FACTOR, "<d", -1e-6))),
    "las offset 1e300": ("las", both(_as(".las"), at("raw/scan.las", OFFSET, "<d", 1e300))),
    "las offset 1e7": ("las", both(_as(".las"), at("raw/scan.las", OFFSET, "<d", 1e7))),
    "las claims 4e9": ("las", both(_as(".las"), at("raw/scan.las", 247, "<Q", 4_000_000_000))),
    "las record length 0": ("las", both(_as(".las"), at("raw/scan.las", 105, "<H", 0))),
    "las format 255": ("las", both(_as(".las"), at("raw/scan.las", 104, "<B", 255))),
    "las offset to points 4e9": ("las", both(_as(".las"), at("raw/scan.las", 96, "<I", 4_000_000_000))),
    "las cut": ("las", both(_as(".las"), cut("raw/scan.las"))),
    "laz cut": ("laz", both(_as(".laz"), cut("raw/scan.laz"))),
    "las is laz": ("las", both(_as(".laz"), lambda folder: (folder / "raw/scan.laz").rename(folder / "raw/scan.las"))),
    "laz is las": ("laz", both(_as(".las"), lambda folder: (folder / "raw/scan.las").rename(folder / "raw/scan.laz"))),
    "ply as laz": ("laz", lambda folder: (folder / SCAN).rename(folder / "raw/scan.laz")),
    "ply as xyz": ("xyz", lambda folder: (folder / SCAN).rename(folder / "raw/scan.xyz")),
    "no suffix": ("", lambda folder: (folder / SCAN).rename(folder / "raw/scan")),
    "suffix alone": ("ply", lambda folder: (folder / SCAN).rename(folder / "raw/.ply")),
    "unknown suffix": ("abc", lambda folder: (folder / SCAN).rename(folder / "raw/scan.abc")),
}  # fmt: skip
_REFERENCES: dict[str, Change] = {
    "gone": gone(WALL),
    "cut": cut(WALL),
    "empty": text(WALL, b""),
    "a pipe": instead(WALL, pipe),
    "/dev/zero": instead(WALL, link("/dev/zero")),
    "a folder": instead(WALL, lambda path: path.mkdir()),
    "mm": mesh(WALL, lambda found: found * 1000),
    "km": mesh(WALL, lambda found: found / 1000),
    "1e5 away": mesh(WALL, lambda found: found + 1e5),
    "1e300": mesh(WALL, lambda found: found * 1e300),
    "nan": mesh(WALL, lambda found: found * NAN),
    "one point": mesh(WALL, lambda found: found * 0),
    "no vertices": mesh(WALL, lambda found: found[:0], lambda faces: faces[:0]),
    "one face": mesh(WALL, lambda found: found, lambda faces: faces[:1]),
    "face out of range": mesh(WALL, lambda found: found, lambda faces: faces + 10**6),
    "three points": mesh(WALL, lambda found: found[:3], lambda faces: faces[:0]),
    "cloud of 5 points": mesh(WALL, lambda found: found[::900][:5], lambda faces: faces[:0]),
    "cloud on a line": mesh(WALL, lambda found: found * [1, 0, 0], lambda faces: faces[:0]),
    "cloud of one place": mesh(WALL, lambda found: found * 0 + 5, lambda faces: faces[:0]),
    "cloud around the scanner": mesh(WALL, lambda found: found - found.mean(axis=0), lambda faces: faces[:0]),
    "behind the scanner": mesh(WALL, lambda found: -found),
    "turned": mesh(WALL, lambda found: found[:, [1, 2, 0]]),
    "the scan itself": lambda folder: (folder / WALL).write_bytes((folder / SCAN).read_bytes()),
}  # fmt: skip
_DEMS: dict[str, Change] = {
    "garbage": text("dem.tif", bytes(range(256))),
    "a bomb": instead("dem.tif", claiming_tiff),
    "all NaN": instead("dem.tif", map_of(np.full((40, 50), NAN))),
    "all infinite": instead("dem.tif", map_of(np.full((40, 50), INFINITE))),
    "1e38": instead("dem.tif", map_of(np.full((40, 50), 1e38))),
    "one row": instead("dem.tif", map_of(np.zeros((1, 50)))),
    "one pixel": instead("dem.tif", map_of([[1.0]])),
    "elsewhere": instead("dem.tif", map_of(np.zeros((40, 50)))),
    "a pipe": instead("dem.tif", pipe),
}  # fmt: skip
_WORDS: dict[str, tuple[str, ...]] = {
    "no reference": (SCAN, "--scanner", "riegl_vz400i"),
    "no scanner": (SCAN, "--reference", WALL),
    "scanner unknown": (SCAN, "--reference", WALL, "--scanner", "riegl_9000"),
    "scanner very long": (SCAN, "--reference", WALL, "--scanner", "a" * 5000),
    "scanner is a pipe": (SCAN, "--reference", WALL, "--scanner", "./pipe.yaml"),
    "scanner is a site": (SCAN, "--reference", WALL, "--scanner", "site.yaml"),
    "scanner of control characters": (SCAN, "--reference", WALL, "--scanner", "\u001b[31m\n"),
    "model of stereo": (SCAN, "--reference", WALL, "--model", "pair/model.yaml"),
    "model gone": (SCAN, "--reference", WALL, "--model", "none.yaml"),
    "model is a site": (SCAN, "--reference", WALL, "--model", "site.yaml"),
    "model is a pipe": (SCAN, "--reference", WALL, "--model", "pipe.yaml"),
    "model is a merge bomb": (SCAN, "--reference", WALL, "--model", "bomb.yaml"),
    "position nan": (SCAN, *_TAIL, "--position", "nan,0,0"),
    "position 1e300": (SCAN, *_TAIL, "--position", "1e300,0,0"),
    "position 1e9": (SCAN, *_TAIL, "--position", "1e9,0,0"),
    "position behind the wall": (SCAN, *_TAIL, "--position", "100,100,0"),
    "position in the wall": (SCAN, *_TAIL, "--position", "17,25,5"),
    "position of two": (SCAN, *_TAIL, "--position", "0,0"),
    "position text": (SCAN, *_TAIL, "--position", "a,b,c"),
    "position empty": (SCAN, *_TAIL, "--position", ""),
    "unit parsec": (SCAN, *_TAIL, "--unit", "pc"),
    "unit mm of m": (SCAN, *_TAIL, "--unit", "mm"),
    "reference unit mm of m": (SCAN, *_TAIL, "--reference-unit", "mm"),
    "scan 0": (SCAN, *_TAIL, "--scan", "0"),
    "scan 99": (SCAN, *_TAIL, "--scan", "99"),
    "scan 1e30": (SCAN, *_TAIL, "--scan", "9" * 30),
    "columns of one": ("raw/scan.xyz", *_TAIL, "--columns", "x"),
    "columns twice": ("raw/scan.xyz", *_TAIL, "--columns", "x,x,x"),
    "columns empty": ("raw/scan.xyz", *_TAIL, "--columns", ""),
    "columns of 1000": ("raw/scan.xyz", *_TAIL, "--columns", ",".join("abc" * 1000)),
    "columns of a ply": (SCAN, *_TAIL, "--columns", "x,y,z"),
    "cameras gone": (SCAN, *_TAIL, "--cameras", "none.xml"),
    "cameras of another project": (SCAN, "--reference", WALL, "--cameras", "pair/cameras.yaml"),
    "cameras a folder": (SCAN, "--reference", WALL, "--cameras", "pair"),
    "cameras a pipe": (SCAN, "--reference", WALL, "--cameras", "pipe.yaml"),
    "cameras and half": (SCAN, "--reference", "half", "--cameras", "pair/cameras.yaml"),
    "pair of one": (SCAN, *_TAIL, "--cameras", "pair/cameras.yaml", "--pair", "left"),
    "pair unknown": (SCAN, "--reference", WALL, "--cameras", "pair/cameras.yaml", "--pair", "a,b"),
    "half": (SCAN, "--reference", "half", "--scanner", "riegl_vz400i"),
    "half of a line": ("raw/line.xyz", "--reference", "half", "--scanner", "riegl_vz400i"),
    "half of a random cloud": ("raw/random.xyz", "--reference", "half", "--scanner", "riegl_vz400i", "--position", "0,0,0"),
    "scan twice": (SCAN, SCAN, *_TAIL),
    "scan and reference the same": (SCAN, "--reference", SCAN, "--scanner", "riegl_vz400i"),
    "100 scans": (*[SCAN] * 100, *_TAIL),
    "no such scan": ("none.laz", *_TAIL),
    "scan very long": ("a" * 5000 + ".laz", *_TAIL),
    "scan a folder": ("raw", *_TAIL),
    "scan a mesh": (WALL, *_TAIL),
    "scan a picture": ("run/reference.png", *_TAIL),
    "out a file": (SCAN, "--reference", WALL, "--scanner", "riegl_vz400i", "--out", "site.yaml"),
    "out under a file": (SCAN, "--reference", WALL, "--scanner", "riegl_vz400i", "--out", "site.yaml/out"),
    "out in use": (SCAN, "--reference", WALL, "--scanner", "riegl_vz400i", "--out", "raw"),
    "out very long": (SCAN, "--reference", WALL, "--scanner", "riegl_vz400i", "--out", "a" * 3000),
    "out of control characters": (SCAN, "--reference", WALL, "--scanner", "riegl_vz400i", "--out", "out\u001b[31m$x_{"),
    "out a loop of links": (SCAN, "--reference", WALL, "--scanner", "riegl_vz400i", "--out", "loop"),
    "out a pipe": (SCAN, "--reference", WALL, "--scanner", "riegl_vz400i", "--out", "pipe.yaml"),
    "out closed": (SCAN, "--reference", WALL, "--scanner", "riegl_vz400i", "--out", "/proc/out"),
}  # fmt: skip
_SURFACE: dict[str, tuple[str, ...]] = {
    "seen from nan": (SCAN, "--seen-from", "nan", "0", "0"),
    "seen from inf": (SCAN, "--seen-from", "inf", "0", "0"),
    "seen from 1e300": (SCAN, "--seen-from", "1e300", "0", "0"),
    "seen from 1e6": (SCAN, "--seen-from", "1e6", "0", "0"),
    "seen from text": (SCAN, "--seen-from", "a", "b", "c"),
    "trim nan": (SCAN, "--seen-from", "0", "0", "0", "--trim", "nan"),
    "trim 0.1": (SCAN, "--seen-from", "0", "0", "0", "--trim", "0.1"),
    "trim 1000": (SCAN, "--seen-from", "0", "0", "0", "--trim", "1000"),
    "depth 99": (SCAN, "--seen-from", "0", "0", "0", "--depth", "99"),
    "depth 16": (SCAN, "--seen-from", "0", "0", "0", "--depth", "16"),
    "depth 4": (SCAN, "--seen-from", "0", "0", "0", "--depth", "4"),
    "no such file": ("none.laz", "--seen-from", "0", "0", "0"),
    "out of another suffix": (SCAN, "--seen-from", "0", "0", "0", "--out", "out.obj"),
    "out there already": (SCAN, "--seen-from", "0", "0", "0", "--out", WALL),
    "out under a file": (SCAN, "--seen-from", "0", "0", "0", "--out", "site.yaml/out.ply"),
    "out very long": (SCAN, "--seen-from", "0", "0", "0", "--out", "a" * 3000 + ".ply"),
}  # fmt: skip
_CLOUDS = (
    *("0 points", "1 point", "3 points", "50 points", "identical points", "two places", "points on one line", "random cloud"),
    *("points in a plane", "mm", "km", "1e7 away", "1e300", "one far", "nan", "half nan", "one inf", "all twice", "all zero"),
)


def _beside(folder: Path) -> None:
    """Create what the arguments name: a pipe, a bomb, a loop of links, scans as text."""
    pipe(folder / "pipe.yaml")
    (folder / "bomb.yaml").write_text(merge_bomb())
    (folder / "loop").symlink_to("loop")
    _as(".xyz")(folder)
    points = read_points(folder / SCAN).points
    np.savetxt(folder / "raw/random.xyz", _random(points))
    np.savetxt(folder / "raw/line.xyz", points[0] + np.linspace(0, 1, 3000)[:, None] * (points[1000] - points[0]))


def cases() -> list[Case]:
    needs = ("raw",)
    found = []
    for name, move in _MOVES.items():
        words = ("measurement", "raw/scan.xyz", *_TAIL)
        found.append(Case(f"raw: {name}", words, needs, _as(".xyz", move)))
        found.append(Case(f"raw: {name}, placed", (*words, "--position", "0,0,0"), needs, _as(".xyz", move)))
    for name in ("3 points", "150 points", "identical points", "random cloud", "mm", "behind wall 10 m", "mirrored", "one far"):
        words = ("gap", "raw/scan.xyz", *_TAIL, "--position", "0,0,0")
        found.append(Case(f"gap raw: {name}", words, needs, _as(".xyz", _MOVES[name])))
    for name in _CLOUDS:
        words = ("surface", "raw/scan.xyz", "--seen-from", "0", "0", "0", "--out", "out.ply", "--quiet")
        found.append(Case(f"surface: {name}", words, needs, _as(".xyz", _MOVES[name])))
    for name, (suffix, change) in _FILES.items():
        file = f"raw/scan.{suffix}" if suffix else "raw/scan"
        file = "raw/.ply" if name == "suffix alone" else file
        found.append(Case(f"raw: {name}", ("measurement", file, *_TAIL), needs, change))
        found.append(Case(f"surface: {name}", ("surface", file, "--seen-from", "0", "0", "0", "--out", "out.ply"), needs, change))
    for name, change in _REFERENCES.items():
        found.append(Case(f"raw: reference {name}", ("measurement", SCAN, *_TAIL), needs, change))
        found.append(Case(f"gap raw: reference {name}", ("gap", SCAN, *_TAIL), needs, change))
    for name, change in _DEMS.items():
        words = ("measurement", SCAN, "--reference", "dem.tif", "--scanner", "riegl_vz400i", "--out", "out", "--quiet")
        found.append(Case(f"raw: dem {name}", words, needs, change))
    needs = ("raw", "pair", "run", "site.yaml")
    for name, given in _WORDS.items():
        out = () if "--out" in given else ("--out", "out")
        quiet = () if "--quiet" in given else ("--quiet",)
        found.append(Case(f"raw: {name}", ("measurement", *given, *out, *quiet), needs, _beside))
        if name.startswith(("out", "no", "model", "half", "scan", "cameras", "pair", "position")):
            found.append(Case(f"gap raw: {name}", ("gap", *given, *out, *quiet), needs, _beside))
    for name, given in _SURFACE.items():
        out = () if "--out" in given else ("--out", "out.ply")
        found.append(Case(f"surface: {name}", ("surface", *given, *out), needs))
    found.append(Case("raw: model a list", ("measurement", SCAN, "--reference", WALL, "--model", "model.yaml", "--out", "out"),
                      ("raw",), whole("model.yaml", [])))  # fmt: skip
    stereo = ("measurement", "pair/surface.xyz", "--reference", "pair/wall.ply", "--cameras", "pair/cameras.yaml", "--out", "out")
    for name, change in {
        "f 0": put("pair/cameras.yaml", left__f_px=0),
        "f nan": put("pair/cameras.yaml", left__f_px=NAN),
        "position 1e300": put("pair/cameras.yaml", left__position_m=[1e300, 0, 0]),
        "base 0": lambda folder: _one_place(folder),
        "looking away": put("pair/cameras.yaml", left__rotation=[[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
        "points behind": text("pair/surface.xyz", "0 0 0\n1 0 0\n0 1 0\n" * 100),
        "points nan": text("pair/surface.xyz", "nan nan nan\n" * 200),
        "a list": whole("pair/cameras.yaml", [1]),
        "distortion 1e6": put("pair/cameras.yaml", left__k1=1e6),
        "width 1e9": put("pair/cameras.yaml", left__width=10**9),
    }.items():
        found.append(Case(f"raw: stereo {name}", stereo, ("pair",), change))
    return found


def _one_place(folder: Path) -> None:
    import yaml

    found = yaml.safe_load((folder / "pair/cameras.yaml").read_text())
    put("pair/cameras.yaml", right__position_m=found["left"]["position_m"])(folder)
