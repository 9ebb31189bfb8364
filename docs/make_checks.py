"""Try a bad input of each kind with each reader and write docs/reference/formats/checks.md: `python docs/make_checks.py`.

A reader is a command, an option or a function that reads files of some kind. tests/test_checks.py compares the page with the
results.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile

from pipeline import open_wall, register
from pipeline.cli import main as cli
from pipeline.formats.cameras.metashape import write_metashape
from pipeline.formats.meshes.ply import write_ply, write_ply_points
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.points import read_points
from pipeline.formats.rasters.geotiff import write_geotiff
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh
from sensors.cameras.camera import Camera

PAGE = Path(__file__).parent / "reference" / "formats" / "checks.md"
EYE = ("3", "-20", "2")
SCAN = ("--position", ",".join(EYE), "--scanner", "riegl_vz400i")
"""Where the scanner stands, and which it is."""
REFERENCE = ("measurement", "scan.ply", "--reference", "FILE", *SCAN, "--out", "out")
UTM = np.array([345_200.0, 6_389_450.0, 120.0])
REFUSED, TAKEN = "refused", "taken"
NO_FAULT = "none of these"
Make = Callable[[Path], None]
_HEAD = """# Checks of input files

This page lists faults of input files and says which command, option or function finds them. It is for users who wonder
whether a fault of their data could go unnoticed. In each table the rows are faults and the columns commands, options or
functions that read the file. Each cell was tried. *Refused* means that the program writes nothing and gives one message,
which says what is wrong, where, what is allowed and what to do. A command then ends with exit status 2, and a function raises
`InputError`.
"""


@dataclass(frozen=True)
class Kind:
    """Files of one kind, and how commands and functions are tried with faults in them.

    suffix: suffix of the files' names; readers: what reads such files, by name: the words of a command (FILE for the file), or a
    function; faults: functions that make a file with each fault; good: function that makes a file without a fault; refusing:
    readers that also refuse good files; long: readers that take long with a good file.
    """

    title: str
    suffix: str
    readers: dict[str, tuple[str, ...] | Callable[[Path], object]]
    faults: dict[str, Make]
    good: Make | None = None
    refusing: tuple[str, ...] = ()
    long: tuple[str, ...] = ()


def _grid_points(step: float = 0.1) -> np.ndarray:
    x, z = (each.ravel() for each in np.meshgrid(np.arange(0.0, 6.0, step), np.arange(0.0, 4.0, step)))
    return np.column_stack([x, 0.2 * np.sin(1.7 * x) * np.cos(1.3 * z), z])


def _sheet() -> TriangleMesh:
    points = _grid_points(0.2)
    columns, rows = 30, 20
    corner = np.arange(columns * rows).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel(), corner[1:, 1:].ravel(), corner[1:, :-1].ravel()
    return TriangleMesh(points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32))


def _cloud(points: np.ndarray) -> Make:
    return lambda path: write_ply_points(path, PointCloud(np.asarray(points, dtype=np.float64)))


def _mesh(change: Callable[[np.ndarray], np.ndarray]) -> Make:
    mesh = _sheet()
    return lambda path: write_ply(path, mesh.with_vertices(change(mesh.vertices.copy())))


def _cut(make: Make) -> Make:
    def cut(path: Path) -> None:
        make(path)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])

    return cut


def _with(row: int, value: float, points: np.ndarray) -> np.ndarray:
    points[row] = value
    return points


def _raster(path: Path) -> None:
    heights = 10.0 + np.sin(np.arange(40)[:, None] / 5.0) + np.zeros((40, 50))
    write_geotiff(path, heights, Grid(0.0, 20.0, 0.5, 50, 40))


def _changed_tiff(**options: object) -> Make:
    return lambda path: tifffile.imwrite(path, np.ones((40, 50), np.float32), **options)


GEO_DEGREES = (34735, 3, 8, (1, 1, 0, 1, 1024, 0, 1, 2), False)
PLACE = [(33550, 12, 3, (0.5, 0.5, 0.0), False), (33922, 12, 6, (0.0, 0.0, 0.0, 0.0, 20.0, 0.0), False)]
TURNED = [(34264, 12, 16, (0.5, 0.1, 0, 0, 0.1, -0.5, 0, 20, 0, 0, 0, 0, 0, 0, 0, 1), False)]
BOX = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [1, 1, 4, 4], "score": 0.9, "segmentation": [[1, 1, 5, 1, 5, 5]]}
COCO = {"images": [{"id": 1, "file_name": "a.tif", "width": 20, "height": 20}], "categories": [{"id": 1, "name": "block"}]}


def _annotated(**changes: object) -> Make:
    return lambda path: path.write_text(json.dumps({**COCO, "annotations": [{**BOX, **changes}]}))


def _other_records(path: Path) -> None:
    path.mkdir()
    for name in ("run.json", "measurement.yaml", "detector.yaml", "annotations.json"):
        (path / name).write_bytes(bytes(range(256)))


def _camera(x: float) -> Camera:
    """One of a pair that looks at the sheet from 20 m away."""
    lens = {"f_px": 1000.0, **dict.fromkeys(("cx_px", "cy_px", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2"), 0.0)}
    towards = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # camera x right, y down, z to the wall
    return Camera(640, 480, **lens, position=np.array([3.0 + x, -20.0, 2.0]), rotation=towards)


SITE = """wall: {mesh: wall.ply}
station: {position_m: [3, -20, 2]}
rockfall: {count: 1, size_m: 0.4, safe_zone_offset_m: 0.2}
scanner: {azimuth_step_rad: 0.004, zenith_step_rad: 0.004}
cameras: {distance_m: 20, base_m: 5, width: 640, height: 480}
depth_map: high
difference: {gsd_m: 0.1}
"""
ANY: dict[str, Make] = {
    "The file does not exist": lambda path: None,
    "It is a folder": lambda path: path.mkdir(),
    "It is a named pipe": lambda path: os.mkfifo(path),
    "It is empty": lambda path: path.write_bytes(b""),
    "It contains random bytes": lambda path: path.write_bytes(bytes(range(256)) * 40),
}
GOOD_POINTS = _cloud(_grid_points())
FEW_POINTS = _cloud(_grid_points(0.4))
"""Points whose scan pattern is sought in a moment, for readers of another file that is faulty."""
KINDS = (
    Kind(
        "Points",
        ".ply",
        {
            "`measurement SCAN`": ("measurement", "FILE", "--reference", "wall.ply", *SCAN, "--out", "out"),
            "`measurement --reference`": REFERENCE,
            "`gap SCAN`": ("gap", "FILE", "--reference", "wall.ply", *SCAN, "--out", "out"),
            "`surface`": ("surface", "FILE", "--seen-from", *EYE, "--out", "out.ply"),
            "`register`": lambda path: register(read_points(path).points, _grid_points()),
        },
        {
            **ANY,
            "It is truncated": _cut(GOOD_POINTS),
            "All coordinates are NaN": _cloud(_grid_points() * np.nan),
            "All points lie at one place": _cloud(np.ones((500, 3))),
            "All points lie on one line": _cloud(np.outer(np.arange(500.0), [1.0, 1.0, 0.5])),
            "Coordinates of UTM size were rounded to single precision": _cloud((_grid_points() + UTM).astype(np.float32)),
            "Points lie 1e9 m from the origin": _cloud(_grid_points() + 1e9),
            "Points and sensor are in different coordinate systems": _cloud(_grid_points() + UTM),
        },
        GOOD_POINTS,
        long=("`gap SCAN`",),
    ),
    Kind(
        "Meshes",
        ".ply",
        {
            "`simulate`": ("simulate", "--sensor", "tls", "--config", "site.yaml", "--set", "wall={mesh: FILE}", "--out", "out"),
            "`inspect`": ("inspect", "site.yaml", "--sensor", "tls", "--set", "wall={mesh: FILE}", "--out", "out"),
            "`measurement --reference`": REFERENCE,
            "`open_wall`": open_wall,
        },
        {
            **ANY,
            "It is truncated": _cut(_mesh(lambda points: points)),
            "A vertex is NaN": _mesh(lambda points: _with(5, np.nan, points)),
            "A vertex lies 1e300 m from the origin": _mesh(lambda points: _with(5, 1e300, points)),
            "Coordinates of UTM size were rounded to single precision": _mesh(
                lambda points: (points + UTM).astype(np.float32).astype(np.float64)
            ),
            "The mesh is smaller than a micrometre": _mesh(lambda points: points * 1e-9),
        },
        _mesh(lambda points: points),
        long=("`inspect`",),
    ),
    Kind(
        "Rasters",
        ".tif",
        {
            "`measurement --reference`": REFERENCE,
            "`detect`": ("detect", "baseline", "FILE", "--out", "out"),
        },
        {
            **ANY,
            "It is truncated": _cut(_raster),
            "It states no coordinates (georeference)": _changed_tiff(),
            "Its coordinates are degrees": _changed_tiff(extratags=[*PLACE, GEO_DEGREES]),
            "Its rows and columns are rotated against the axes": _changed_tiff(extratags=TURNED),
            "It has three bands": lambda path: tifffile.imwrite(path, np.ones((40, 50, 3), np.float32), extratags=PLACE),
            "It has infinite values": lambda path: tifffile.imwrite(path, np.full((40, 50), np.inf, np.float32), extratags=PLACE),
        },
        _raster,
        ("`measurement --reference`",),  # another surface than the scan's
    ),
    Kind(
        "Cameras",
        ".xml",
        {"`simulate`": ("simulate", "--sensor", "stereo", "--config", "site.yaml", "--set", "cameras=FILE", "--out", "out")},
        {**ANY, "It contains no cameras": lambda path: path.write_text("<document><chunk/></document>")},
        lambda path: write_metashape(path, {"left": _camera(-2.5), "right": _camera(2.5)}),
    ),
    Kind(
        "Annotations",
        ".json",
        {
            "`evaluate` truth": ("evaluate", "FILE", "found.json"),
            "`evaluate` detections": ("evaluate", "truth.json", "FILE"),
        },
        {
            **ANY,
            "A box lies outside its image": _annotated(bbox=[15, 15, 40, 4], segmentation=None),
            "A polygon has two corners": _annotated(segmentation=[[1, 1, 2, 2]]),
            "A box contains a word instead of a number": _annotated(bbox=["a", 1, 1, 1]),
            "An annotation names an image that is not listed": _annotated(image_id=9),
            "An annotation names a category that is not listed": _annotated(category_id=9),
        },
        _annotated(iscrowd=0),
    ),
    Kind(
        "Configs",
        ".yaml",
        {
            "`simulate`, its config": ("simulate", "--sensor", "tls", "--config", "FILE", "--out", "out"),
            "`inspect`": ("inspect", "FILE", "--sensor", "tls", "--out", "out"),
            "`dataset`": ("dataset", "FILE", "--out", "out"),
        },
        {
            **ANY,
            "It has an unknown key": lambda path: path.write_text("sede: 1\n"),
            "It has a key twice": lambda path: path.write_text("seed: 1\nseed: 2\n"),
            "It is a list instead of keys with values": lambda path: path.write_text("- 1\n"),
        },
        lambda path: path.write_text(SITE),
        ("`dataset`",),
        ("`inspect`",),
    ),
    Kind(
        "Folders of runs and measurements",
        "",
        {
            "`export`": ("export", "FILE", "picture", "--out", "out.png"),
            "`icp-study`": ("icp-study", "FILE", "--out", "out"),
            "`calibrate`": ("calibrate", "FILE", "--out", "out"),
            "`gap`": ("gap", "FILE", "--out", "out"),
            "`view`": ("view", "FILE", "--no-browser"),
            "`train`": ("train", "FILE", "--out", "out"),
            "`detect MODEL`": ("detect", "FILE", "map.tif", "--out", "out"),
            "`detect` a folder": ("detect", "baseline", "FILE", "--out", "out"),
            "`compare --measured`": ("compare", "site.yaml", "--measured", "FILE", "--out", "out"),
        },
        {
            "The file does not exist": lambda path: None,
            "It is empty": lambda path: path.mkdir(),
            "It is a file": lambda path: path.write_bytes(bytes(range(256))),
            "Its records contain random bytes": _other_records,
        },
    ),
)


def prepare(folder: Path) -> None:
    """Write the good files that the readers need beside the bad one."""
    write_ply(folder / "wall.ply", _sheet())
    FEW_POINTS(folder / "scan.ply")
    _raster(folder / "map.tif")
    (folder / "site.yaml").write_text(SITE)
    (folder / "truth.json").write_text(json.dumps({**COCO, "annotations": [{**BOX, "iscrowd": 0}]}))
    (folder / "found.json").write_text(json.dumps([BOX]))


def outcome(kind: Kind, reader: str, fault: str) -> str:
    """Return what a reader does with a faulty file in a prepared working folder: "refused", or what it does instead."""
    file = Path(f"bad{kind.suffix}")
    make = kind.good if fault == NO_FAULT else kind.faults[fault]
    if make is not None:
        make(file)
    through = kind.readers[reader]
    if callable(through):
        try:
            through(file)
        except InputError:
            return REFUSED
        return TAKEN
    words = [word.replace("FILE", str(file)) for word in through]
    told = io.StringIO()
    with contextlib.redirect_stderr(told), contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings(action="ignore"):
        code = cli.main(words)
    if code == 0:
        return TAKEN
    lines = [line for line in told.getvalue().splitlines() if line.startswith("error: ")]
    clean = code == 2 and len(lines) == 1 and "Traceback" not in told.getvalue()
    return REFUSED if clean and not Path("out").exists() else f"exit {code}"


def table(kind: Kind, found: dict[tuple[str, str], str]) -> str:
    """Return the table of one kind of files: a row for each fault, a column for each reader."""
    lines = [f"| fault | {' | '.join(kind.readers)} |", "|---" * (len(kind.readers) + 1) + "|"]
    lines += [f"| {fault} | {' | '.join(found[reader, fault] for reader in kind.readers)} |" for fault in kind.faults]
    return "\n".join(lines)


def tried(kind: Kind) -> dict[tuple[str, str], str]:
    """Return what each reader does with each fault, each time in a new folder."""
    found, here = {}, Path.cwd()
    for reader in kind.readers:
        for fault in kind.faults:
            with tempfile.TemporaryDirectory() as folder:
                os.chdir(folder)
                try:
                    prepare(Path())
                    found[reader, fault] = outcome(kind, reader, fault)
                finally:
                    os.chdir(here)
    return found


def main() -> None:
    parts = [_HEAD, *(f"## {kind.title}\n\n{table(kind, tried(kind))}\n" for kind in KINDS)]
    PAGE.write_text(
        "\n".join(parts) + "\n`python docs/make_checks.py` writes this page, and a test compares it with what the commands do.\n"
    )


if __name__ == "__main__":
    main()
