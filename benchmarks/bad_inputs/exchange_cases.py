"""Bad inputs that are valid but unusual files of other programs.

They have odd properties, links, compression bombs, unusual camera files or giant sparse arrays.
"""

from __future__ import annotations

import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bad_inputs.case import Case
from benchmarks.bad_inputs.raw_cases import _e57, in_e57
from benchmarks.bad_inputs.spoil import Array, Change, both, instead, pipe, put, text
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from pipeline.formats.points.points import read_points

YAML, SITE = "measurement/measurement.yaml", "site.yaml"
_TAIL = ("--reference", "raw/wall.ply", "--scanner", "riegl_vz400i", "--out", "out", "--quiet")


def sparse(name: str, gigabytes: float = 60) -> Change:
    """Create a file that claims this size but uses no space on the disk."""

    def change(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with (folder / name).open("ab") as file:
            file.truncate(int(gigabytes * 1e9))

    return change


def _ply_with(*names: str, value: float = 1.0) -> Change:
    """Write measurement/scan.ply as text with additional properties of these names."""

    def change(folder: Path) -> None:
        found = read_points(folder / "measurement/scan.ply").points
        head = "ply\nformat ascii 1.0\nelement vertex {}\n{}end_header\n".format(
            len(found), "".join(f"property double {name}\n" for name in ("x", "y", "z", *names))
        )
        table = np.column_stack([found, np.full((len(found), len(names)), value)])
        with (folder / "measurement/scan.ply").open("wb") as file:
            file.write(head.encode("utf-8", errors="surrogateescape"))
            np.savetxt(file, table, fmt="%.9g")

    return change


def _laz_with(**extra: Callable[[int], Any]) -> Change:
    def change(folder: Path) -> None:
        found = read_points(folder / "measurement/scan.ply").points
        channels = {name: np.asarray(make(len(found))) for name, make in extra.items()}
        write_laz(folder / "measurement/scan.laz", PointCloud(found, extra=channels))
        put(YAML, points="scan.laz")(folder)

    return change


_PLY: dict[str, Change] = {
    "property residual_m": _ply_with("residual_m"),
    "property held_out": _ply_with("held_out"),
    "property epoch 1e300": _ply_with("epoch", value=1e300),
    "property epoch nan": _ply_with("epoch", value=np.nan),
    "property epoch 0.5": _ply_with("epoch", value=0.5),
    "property scan nan": _ply_with("scan", value=np.nan),
    "property row 1e300": _ply_with("row", "column", value=1e300),
    "property column nan": _ply_with("row", "column", value=np.nan),
    "property return_number nan": _ply_with("return_number", "number_of_returns", value=np.nan),
    "property return_number 1e9": _ply_with("return_number", "number_of_returns", value=1e9),
    "property scan_angle_rad nan": _ply_with("scan_angle_rad", value=np.nan),
    "property of 100 letters": _ply_with("a" * 100),
    "property of markup": _ply_with("<script>$x_{"),
    "property in Latin 1": _ply_with("h\udcf6he"),
    "property count x": _ply_with("count"),
    "300 properties": _ply_with(*[f"p{k}" for k in range(300)]),
    "property pixel_x": _ply_with("pixel_x", "pixel_y", value=5.0),
    "property true_range_m": _ply_with("true_range_m", value=np.nan),
    "property true_range_m 1e300": _ply_with("true_range_m", value=1e300),
    "property incidence_rad": _ply_with("incidence_rad", value=7.0),
    "property intensity and gps_time 1e-320": _ply_with("intensity", "gps_time", value=1e-320),
    "laz channel of words": _laz_with(**{"a" * 31: np.ones}),
    "laz channel row": _laz_with(row=lambda n: np.full(n, -1, np.int32), column=lambda n: np.full(n, -1, np.int32)),
    "laz channel intensity_relative nan": _laz_with(intensity_relative=lambda n: np.full(n, np.nan)),
    "laz channel intensity_relative -1": _laz_with(intensity_relative=lambda n: np.full(n, -1.0)),
    "laz channel scan 255": _laz_with(scan=lambda n: np.full(n, 255, np.uint8)),
    "laz channel sequence": _laz_with(line=lambda n: np.arange(n, dtype=np.uint64) * 2**50),
}  # fmt: skip


def _stl(claims: int) -> bytes:
    return b"\0" * 80 + struct.pack("<I", claims) + b"\0" * 500


def _glb(content: bytes, length: int | None = None) -> bytes:
    padded = content.ljust(-(-len(content) // 4) * 4)
    total = 20 + len(padded) if length is None else length
    return struct.pack("<4sIIII", b"glTF", 2, total, len(padded), 0x4E4F534A) + padded


_TRIANGLE = "v 0 0 0\nv 9 0 0\nv 9 0 9\nv 0 0 9\nf 1 2 3\nf 1 3 4\n"
_ACCESSOR = (
    b'{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],"meshes":[{"primitives":'
    b'[{"attributes":{"POSITION":0}}]}],"accessors":[{"bufferView":0,"componentType":5126,"count":4000000000,"type":"VEC3"}],'
    b'"bufferViews":[{"buffer":0,"byteLength":48000000000}],"buffers":[{"byteLength":48000000000}]}'
)
_LOOP = b'{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"children":[0]}]}'
_MESHES: dict[str, tuple[str, Change]] = {
    "obj with materials of /dev/zero": ("obj", text("a.obj", f"mtllib /dev/zero\nusemtl a\n{_TRIANGLE}")),
    "obj with materials of a pipe": ("obj", both(instead("p", pipe), text("a.obj", f"mtllib p\n{_TRIANGLE}"))),
    "obj of quads": ("obj", text("a.obj", _TRIANGLE.split("f")[0] + "f 1 2 3 4\n")),
    "obj of a face of 100000": ("obj", text("a.obj", "v 0 0 0\n" * 9 + "f " + "1 " * 100_000 + "\n")),
    "obj negative indices": ("obj", text("a.obj", _TRIANGLE.split("f")[0] + "f -1 -2 -3\nf -1 -3 -4\n")),
    "obj index 0": ("obj", text("a.obj", _TRIANGLE.split("f")[0] + "f 0 1 2\n")),
    "obj of 2 coordinates": ("obj", text("a.obj", "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n")),
    "obj of lines": ("obj", text("a.obj", "v 0 0 0\nv 1 0 0\nl 1 2\n")),
    "obj of 1e400": ("obj", text("a.obj", "v 1e400 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")),
    "obj one 100 MB line": ("obj", text("a.obj", lambda: b"v " + b"1" * 100_000_000)),
    "obj of 60 GB": ("obj", sparse("a.obj")),
    "stl of 60 GB": ("stl", sparse("a.stl")),
    "stl of 3 GB": ("stl", sparse("a.stl", 3)),
    "glb of 60 GB": ("glb", sparse("a.glb")),
    "off of 60 GB": ("off", sparse("a.off")),
    "ply of 60 GB": ("ply", both(text("a.ply", "ply\nformat binary_little_endian 1.0\n"), sparse("a.ply"))),
    "ply ascii of 60 GB": (
        "ply",
        both(text("a.ply", "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
                           "element face 1\nproperty list uchar int vertex_indices\nend_header\n"), sparse("a.ply")),
    ),
    "stl claims 4e9 and has some": ("stl", text("a.stl", _stl(4_000_000_000))),
    "stl text without end": ("stl", text("a.stl", "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n")),
    "stl text of words": ("stl", text("a.stl", "solid a\nfacet normal a b c\nouter loop\nvertex a b c\nendloop\nendfacet\n")),
    "off claims 4e9": ("off", text("a.off", "OFF\n4000000000 4000000000 0\n0 0 0\n")),
    "off of words": ("off", text("a.off", "OFF\na b c\n")),
    "off cut": ("off", text("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n")),
    "glb of nothing": ("glb", text("a.glb", _glb(b"{}"))),
    "glb of a list": ("glb", text("a.glb", _glb(b"[]"))),
    "glb claims 48 GB": ("glb", text("a.glb", _glb(_ACCESSOR))),
    "glb is its own child": ("glb", text("a.glb", _glb(_LOOP))),
    "glb says 4 GB": ("glb", text("a.glb", _glb(b"{}", 2**32 - 1))),
    "gltf of /etc/passwd": ("gltf", text("a.gltf", '{"asset":{"version":"2.0"},"buffers":[{"uri":"/etc/passwd"}]}')),
    "gltf of a pipe": ("gltf", both(instead("p", pipe), text("a.gltf", '{"asset":{"version":"2.0"},"buffers":[{"uri":"p"}]}'))),
    "gltf of an address": ("gltf", text("a.gltf", '{"asset":{"version":"2.0"},"buffers":[{"uri":"http://127.0.0.1:9/"}]}')),
    "gltf of data": ("gltf", text("a.gltf", '{"asset":{"version":"2.0"},"buffers":[{"uri":"data:;base64,!!"}]}')),
    "dxf": ("dxf", text("a.dxf", "0\nSECTION\n2\nENTITIES\n0\nENDSEC\n0\nEOF\n")),
    "dxf garbage": ("dxf", text("a.dxf", bytes(range(256)))),
    "xyz": ("xyz", text("a.xyz", "0 0 0\n1 1 1\n")),
    "ply with a texture of /dev/zero": (
        "ply",
        text("a.ply", "ply\nformat ascii 1.0\ncomment TextureFile /dev/zero\nelement vertex 3\nproperty float x\n"
                      "property float y\nproperty float z\nproperty float s\nproperty float t\nelement face 1\n"
                      "property list uchar int vertex_indices\nend_header\n0 0 0 0 0\n1 0 0 0 0\n0 0 1 0 0\n3 0 1 2\n"),
    ),
    "ply of quads and triangles": (
        "ply",
        text("a.ply", "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
                      "element face 2\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n9 0 0\n9 0 9\n0 0 9\n"
                      "4 0 1 2 3\n3 0 1 2\n"),
    ),
    "ply of strips": (
        "ply",
        text("a.ply", "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
                      "element tristrips 1\nproperty list int int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 0 1\n3 0 1 2\n"),
    ),
    "suffix in capitals": ("PLY", lambda folder: shutil.copy(folder / "measurement/wall.ply", folder / "a.PLY")),
    "two suffixes": ("ply.gz", text("a.ply.gz", b"\x1f\x8b\x08")),
}  # fmt: skip


def zlib_bomb(path: Path, gigabytes: float = 3.0) -> None:
    """Write a TIFF of 64 x 64 px whose one compressed tile decompresses to gigabytes."""
    import tifffile

    tifffile.imwrite(path, np.zeros((64, 64), np.float32), compression="zlib", tile=(64, 64))
    packer, piece = zlib.compressobj(), bytes(2**24)
    start = packer.compress(piece) + packer.flush(zlib.Z_FULL_FLUSH)
    again = packer.compress(piece) + packer.flush(zlib.Z_FULL_FLUSH)  # stands alone, so that it can be repeated
    data = start + again * int(gigabytes * 2**30 / len(piece)) + packer.flush()
    whole = path.read_bytes()
    path.write_bytes(whole + data)
    with tifffile.TiffFile(path, mode="r+b") as file:
        tags = file.pages.first.tags
        tags["TileOffsets"].overwrite(len(whole))
        tags["TileByteCounts"].overwrite(len(data))


def _tags(**values: Any) -> Change:
    """Change values of tags of dem.tif."""

    def change(folder: Path) -> None:
        import tifffile

        shutil.copy(folder / "run/difference_001.tif", folder / "dem.tif")
        with tifffile.TiffFile(folder / "dem.tif", mode="r+b") as file:
            for name, value in values.items():
                file.pages.first.tags[name].overwrite(value)

    return change


def _looped(folder: Path) -> None:
    """Make the tag directory of dem.tif refer to itself."""
    shutil.copy(folder / "run/difference_001.tif", folder / "dem.tif")
    data = bytearray((folder / "dem.tif").read_bytes())
    (start,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, start)
    struct.pack_into("<I", data, start + 2 + 12 * count, start)
    (folder / "dem.tif").write_bytes(data)


_TIFFS: dict[str, Change] = {
    "a zlib bomb": lambda folder: zlib_bomb(folder / "dem.tif"),
    "directories in a ring": _looped,
    "compression unknown": _tags(Compression=34712),
    "compression 65000": _tags(Compression=65000),
    "compression jpeg": _tags(Compression=7),
    "bits 12": _tags(BitsPerSample=12),
    "bits 0": _tags(BitsPerSample=0),
    "bits 65535": _tags(BitsPerSample=65535),
    "samples 0": _tags(SamplesPerPixel=0),
    "samples 65535": _tags(SamplesPerPixel=65535),
    "width 0": _tags(ImageWidth=0),
    "width 3": _tags(ImageWidth=3),
    "rows per strip 0": _tags(RowsPerStrip=0),
    "rows per strip 4e9": _tags(RowsPerStrip=2**32 - 1),
    "strips beyond": _tags(StripOffsets=2**32 - 10),
    "strips of 4 GB": _tags(StripByteCounts=2**32 - 1),
    "tie nan": _tags(ModelTiepointTag=(0.0, 0.0, 0.0, float("nan"), 0.0, 0.0)),
    "tie 1e300": _tags(ModelTiepointTag=(0.0, 0.0, 0.0, 1e300, 1e300, 0.0)),
    "tie pixel 1e300": _tags(ModelTiepointTag=(1e300, 0.0, 0.0, 0.0, 0.0, 0.0)),
    "pixels 1e-300": _tags(ModelPixelScaleTag=(1e-300, 1e-300, 0.0)),
    "pixels 1e9": _tags(ModelPixelScaleTag=(1e9, 1e9, 0.0)),
    "big": sparse("dem.tif"),
}  # fmt: skip


def _in_xml(old: str, new: str) -> Change:
    """Replace words by shorter ones in the XML of raw/scan.e57, and correct its checksums."""

    def change(folder: Path) -> None:
        in_e57(folder / "raw/scan.e57", old, new)

    return both(_e57(), change)


_E57: dict[str, Change] = {
    "points of another type": _in_xml('<points type="CompressedVector"', '<points type="Integer"'),
    "points gone": _in_xml("<points ", "<pointz "),
    "points have no prototype": _in_xml("<prototype ", "<prototypo "),
    "name a number": _in_xml('<name type="String"', '<name type="Integer"'),
    "pose a word": _in_xml('<pose type="Structure"', '<pose type="String"'),
    "rotation a number": _in_xml('<rotation type="Structure"', '<rotation type="Integer"'),
    "translation gone": _in_xml("<translation ", "<translatiom "),
    "one axis gone": _in_xml("<x type=", "<q type="),
    "x of whole numbers": _in_xml('<cartesianX type="Float"', '<cartesianX type="Integer"'),
    "x gone": _in_xml("<cartesianX ", "<cartesianQ "),
    "x in single precision": _in_xml('precision="double"', 'precision="single"'),
    "scans a structure": _in_xml('<data3D type="Vector"', '<data3D type="Structure"'),
    "scans gone": _in_xml("<data3D ", "<data3X "),
    "count negative": _in_xml('recordCount="', 'recordCount="-'),
    "offset beyond": _in_xml('fileOffset="', 'fileOffset="9'),
    "encoding": _in_xml("UTF-8", "UTF-7"),
    "no end": _in_xml("</e57Root>", "</e57Roo>"),
    "a document type": _in_xml("<?xml version=", "<!DOCTYPE a [ "),
    "60 GB": both(_e57(), sparse("raw/scan.e57")),
}  # fmt: skip


def _text_file(suffix: str, content: str | bytes) -> Change:
    return text(f"raw/scan{suffix}", content)


def _columns(make: Callable[[Array], list[str]], suffix: str = ".csv") -> Change:
    def change(folder: Path) -> None:
        found = read_points(folder / "raw/scan.ply").points
        (folder / f"raw/scan{suffix}").write_text("\n".join(make(found)) + "\n", encoding="utf-8")

    return change


_TEXTS: dict[str, tuple[str, Change]] = {
    "csv quoted": ("csv", _columns(lambda found: ['"x","y","z"', *(f'"{x}","{y}","{z}"' for x, y, z in found)])),
    "csv with decimal commas": ("csv", _columns(lambda found: [f"{x};{y};{z}".replace(".", ",") for x, y, z in found])),
    "csv with thousands": ("csv", _columns(lambda found: [f"1,{x:.3f},{y:.3f}" for x, y, z in found])),
    "csv header alone": ("csv", _text_file(".csv", "x,y,z\n")),
    "csv of a last line": ("csv", _columns(lambda found: [*(f"{x},{y},{z}" for x, y, z in found), "total,3606,0"])),
    "csv a name twice": ("csv", _columns(lambda found: ["x,y,z,i,i", *(f"{x},{y},{z},1,1" for x, y, z in found)])),
    "csv names of markup": ("csv", _columns(lambda found: ["x,y,z,<b>$x_{", *(f"{x},{y},{z},1" for x, y, z in found)])),
    "csv name of 100 letters": ("csv", _columns(lambda found: [f"x,y,z,{'a' * 100}", *(f"{x},{y},{z},1" for x, y, z in found)])),
    "csv name not of ASCII": ("csv", _columns(lambda found: ["x,y,z,h\u00f6he", *(f"{x},{y},{z},1" for x, y, z in found)])),
    "csv name residual_m": ("csv", _columns(lambda found: ["x,y,z,residual_m", *(f"{x},{y},{z},1" for x, y, z in found)])),
    "csv name epoch": ("csv", _columns(lambda found: ["x,y,z,epoch", *(f"{x},{y},{z},nan" for x, y, z in found)])),
    "csv name scan": ("csv", _columns(lambda found: ["x,y,z,scan", *(f"{x},{y},{z},1e300" for x, y, z in found)])),
    "csv name row": ("csv", _columns(lambda found: ["x,y,z,row,column", *(f"{x},{y},{z},1e300,nan" for x, y, z in found)])),
    "csv name gps_time": ("csv", _columns(lambda found: ["x,y,z,gps_time", *(f"{x},{y},{z},nan" for x, y, z in found)])),
    "csv with a date": ("csv", _columns(lambda found: ["x,y,z,time", *(f"{x},{y},{z},2026-01-01" for x, y, z in found)])),
    "csv of degrees": ("csv", _columns(lambda found: ["lon,lat,h", *(f"{x / 1e3},{y / 1e3},{z}" for x, y, z in found)])),
    "xyz of 60 GB": ("xyz", sparse("raw/scan.xyz")),
    "laz of 60 GB": ("laz", sparse("raw/scan.laz")),
    "las of 60 GB": ("las", sparse("raw/scan.las")),
    "ptx of 60 GB": ("ptx", sparse("raw/scan.ptx")),
    "xyz compressed": ("xyz", _text_file(".xyz", b"\x1f\x8b\x08" + bytes(range(256)))),
    "pts with a wrong count": ("pts", _columns(lambda found: ["99999999999", *(f"{x} {y} {z}" for x, y, z in found)], ".pts")),
    "pts of two scans": ("pts", _columns(lambda found: ["3", *(f"{x} {y} {z}" for x, y, z in found[:3]), "4"] * 2, ".pts")),
    "html": ("xyz", _text_file(".xyz", "<!DOCTYPE html><html><body>404 not found</body></html>\n" * 5)),
    "xyz of whole turns": ("xyz", _columns(lambda found: ["1 2 3"] * 5000, ".xyz")),
    "xyz with tabs and words behind": ("xyz", _columns(lambda found: [f"{x}\t{y}\t{z}\trock" for x, y, z in found], ".xyz")),
    "xyz with comments between": ("xyz", _columns(lambda found: [f"{x} {y} {z}\n# a" for x, y, z in found], ".xyz")),
    "xyz of old Mac lines": ("xyz", lambda folder: (folder / "raw/scan.xyz").write_bytes(b"1 2 3\r4 5 6\r" * 200)),
    "xyz with a byte order mark": ("xyz", lambda folder: (folder / "raw/scan.xyz").write_bytes(b"\xef\xbb\xbf1 2 3\n" * 200)),
}  # fmt: skip


def cases() -> list[Case]:
    found = [Case(f"gap: {name}", ("gap", "measurement", "--out", "out", "--quiet"), ("measurement",), spoil)
             for name, spoil in _PLY.items()]  # fmt: skip
    for name, (suffix, change) in _MESHES.items():
        made = both(change, put(SITE, wall={"mesh": f"a.{suffix}"}))
        words_ = ("simulate", "--sensor", "tls", "--config", SITE, "--out", "out", "--quiet")
        found.append(Case(f"sim: mesh {name}", words_, (SITE, "measurement"), made))
        reference = (
            "measurement",
            "raw/scan.ply",
            "--reference",
            f"a.{suffix}",
            "--scanner",
            "riegl_vz400i",
            "--out",
            "out",
            "--quiet",
        )
        found.append(Case(f"raw: reference {name}", reference, ("raw", "measurement"), change))
    for name, change in _TIFFS.items():
        reference = (
            "measurement",
            "raw/scan.ply",
            "--reference",
            "dem.tif",
            "--scanner",
            "riegl_vz400i",
            "--out",
            "out",
            "--quiet",
        )
        found.append(Case(f"raw: dem {name}", reference, ("raw", "run"), change))
        found.append(Case(f"det: tiff {name}", ("detect", "baseline", "dem.tif", "--out", "out", "--quiet"), ("run",), change))
    for name, change in _E57.items():
        found.append(Case(f"raw: e57 {name}", ("measurement", "raw/scan.e57", *_TAIL), ("raw",), change))
    for name, (suffix, change) in _TEXTS.items():
        found.append(Case(f"raw: {name}", ("measurement", f"raw/scan.{suffix}", *_TAIL), ("raw",), change))
        surface = ("surface", f"raw/scan.{suffix}", "--seen-from", "0", "0", "0", "--out", "out.ply", "--quiet")
        found.append(Case(f"surface: {name}", surface, ("raw",), change))
    return found
