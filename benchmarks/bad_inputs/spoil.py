"""Functions that return a small change of a file in a case's folder."""

from __future__ import annotations

import copy
import json
import math
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import yaml

from pipeline.formats.meshes.ply import read_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from pipeline.formats.points.points import read_points

Change = Callable[[Path], object]
Array = np.ndarray[Any, np.dtype[np.float64]]
NAN, INFINITE = math.nan, math.inf
GONE = object()
"""Value that removes a key."""


def both(*changes: Change) -> Change:
    """Apply changes one after the other."""

    def change(folder: Path) -> None:
        for each in changes:
            each(folder)

    return change


def text(name: str, content: str | bytes | Callable[[], str | bytes]) -> Change:
    """Replace the content of a file. content: the new content, or a function that makes it if it is large."""

    def change(folder: Path) -> None:
        made = content() if callable(content) else content
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(made.encode() if isinstance(made, str) else made)

    return change


def put(name: str, /, **values: Any) -> Change:
    """Set values of a YAML or JSON file: `a__b__0` is item 0 of list b in mapping a.

    The value GONE removes a key. A large value is given as a function that makes it.
    """

    def change(folder: Path) -> None:
        path = folder / name
        content = yaml.safe_load(path.read_text()) if path.suffix == ".yaml" else json.loads(path.read_text())
        for place, value in values.items():
            _place(content, place.split("__"), value)
        dumped = yaml.safe_dump(content) if path.suffix == ".yaml" else json.dumps(content)
        path.write_text(dumped)

    return change


def _place(content: Any, keys: list[str], value: Any) -> None:
    for key in keys[:-1]:
        content = content[int(key)] if isinstance(content, list) else content[key]
    last = int(keys[-1]) if isinstance(content, list) else keys[-1]
    if value is GONE:
        del content[last]
    else:
        content[last] = value() if callable(value) else copy.deepcopy(value)


def whole(name: str, value: Any) -> Change:
    """Write a JSON or YAML file that contains only `value`."""
    return text(name, json.dumps(value))


def gone(name: str) -> Change:
    return lambda folder: (folder / name).unlink()


def cut(name: str, share: float = 0.5) -> Change:
    """Keep only the first part of a file."""

    def change(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(len(data) * share)])

    return change


def at(name: str, place: int, form: str, value: float) -> Change:
    """Replace bytes of a file at an offset; form: as in `struct`."""

    def change(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        struct.pack_into(form, data, place, value)
        (folder / name).write_bytes(data)

    return change


def instead(name: str, make: Callable[[Path], object]) -> Change:
    """Put something else in the place of a file, or at a new name: a folder, a pipe, a link."""

    def change(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        make(folder / name)

    return change


def link(target: str) -> Callable[[Path], object]:
    return lambda path: path.symlink_to(target)


def pipe(path: Path) -> None:
    os.mkfifo(path)


def points(move: Callable[[Array], Array], /, **keys: Any) -> Change:
    """Write measurement/ with other points (n, 3), scanner frame, mapped to (m, 3), as XYZ; keys: of measurement.yaml."""

    def change(folder: Path) -> None:
        found = read_points(folder / "measurement/scan.ply").points
        np.savetxt(folder / "measurement/scan.xyz", move(found), fmt="%.17g")
        put("measurement/measurement.yaml", points="scan.xyz", **keys)(folder)

    return change


def as_laz(*changes: Change) -> Change:
    """Write the points of measurement/ as scan.laz, then change it."""

    def change(folder: Path) -> None:
        cloud = read_points(folder / "measurement/scan.ply")
        write_laz(folder / "measurement/scan.laz", PointCloud(cloud.points, cloud.intensity, cloud.gps_time))
        put("measurement/measurement.yaml", points="scan.laz")(folder)
        both(*changes)(folder)

    return change


def mesh(name: str, move: Callable[[Array], Array], faces: Callable[[Any], Any] = lambda faces: faces) -> Change:
    """Move the vertices (n, 3) of a PLY mesh, and write it as text."""

    def change(folder: Path) -> None:
        found = read_ply(folder / name)
        write_mesh(folder / name, move(found.vertices), faces(found.faces))

    return change


def write_mesh(path: Path, vertices: Array, faces: Any) -> None:
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in vertices)
    path.write_text(head + rows + "".join(f"3 {a} {b} {c}\n" for a, b, c in faces))


def claiming_tiff(path: Path, height: int = 30000, width: int = 30000) -> None:
    """Write a TIFF of a few hundred bytes that claims an image of this size."""
    tifffile.imwrite(path, np.zeros((64, 64), np.float32), compression="zlib", tile=(64, 64))
    with tifffile.TiffFile(path, mode="r+b") as file:
        tags = file.pages.first.tags
        for name, value in (("ImageLength", height), ("ImageWidth", width)):
            tags[name].overwrite(value, dtype="I")


def map_of(values: Any) -> Callable[[Path], object]:
    """Return a function that writes a GeoTIFF with pixels of 0.05 m and these values (h, w)."""
    from pipeline.formats.rasters.geotiff import write_geotiff
    from scene.geometry.grid import Grid

    raster = np.asarray(values, np.float32)
    return lambda path: write_geotiff(path, raster, Grid(0.0, 2.0, 0.05, raster.shape[1], raster.shape[0]))


def bomb(levels: int = 10) -> str:
    """Return YAML lines that expand to 9 to the power of `levels` values."""
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 9)}]" for level in range(1, levels + 1)]
    return "\n".join([*lines, f"wall: *a{levels}", ""])


def merge_bomb(levels: int = 10) -> str:
    """Return YAML lines whose merge keys expand to 9 to the power of `levels` mappings."""
    lines = ["a0: &a0 {k0: 1}"]
    lines += [f"a{level}: &a{level} {{<<: [{', '.join([f'*a{level - 1}'] * 9)}], k{level}: 1}}" for level in range(1, levels + 1)]
    return "\n".join([*lines, f"wall: {{<<: *a{levels}}}", ""])
