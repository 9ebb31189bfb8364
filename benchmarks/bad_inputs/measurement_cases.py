"""Bad inputs for `gap`: measurements with wrong epochs, channels, pixels or surfaces."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bad_inputs.case import Case
from benchmarks.bad_inputs.spoil import (
    INFINITE,
    NAN,
    Array,
    Change,
    both,
    instead,
    map_of,
    mesh,
    pipe,
    points,
    put,
    text,
    whole,
    write_mesh,
)
from pipeline.formats.meshes.ply import read_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from pipeline.formats.points.points import read_points

YAML, MODEL, WALL, SCAN = "measurement/measurement.yaml", "measurement/model.yaml", "measurement/wall.ply", "measurement/scan.ply"
PAIR, SURFACE = "pair/measurement.yaml", "pair/surface.xyz"


def _channels(**channels: Callable[[int], Any]) -> Change:
    """measurement/ with its points as LAZ with other intensity, gps_time or extra channels, each made for n points."""

    def change(folder: Path) -> None:
        cloud = read_points(folder / SCAN)
        count = len(cloud.points)
        given: dict[str, Any] = {name: np.asarray(make(count)) for name, make in channels.items()}
        own = {name: given.pop(name) for name in ("intensity", "gps_time") if name in given}
        write_laz(folder / "measurement/scan.laz", PointCloud(cloud.points, extra=given, **own))
        put(YAML, points="scan.laz")(folder)

    return change


def _epochs(*moves: Callable[[Array], Array]) -> Change:
    """measurement/ with an epoch for each move of its points."""

    def change(folder: Path) -> None:
        found = read_points(folder / SCAN).points
        for number, move in enumerate(moves):
            np.savetxt(folder / f"measurement/{number}.xyz", move(found), fmt="%.17g")
        put(YAML, points=[f"{number}.xyz" for number in range(len(moves))])(folder)

    return change


def _pixels(make: Callable[[int], Array]) -> Change:
    """pair/ with pixels of its points, (n, 2)."""

    def change(folder: Path) -> None:
        found = np.loadtxt(folder / SURFACE, comments="//", ndmin=2)[:, :3]
        header = "//x y z pixel_x pixel_y"
        np.savetxt(folder / SURFACE, np.column_stack([found, make(len(found))]), fmt="%.17g", header=header, comments="")

    return change


def _same(found: Array) -> Array:
    return found


def _on_the_wall(found: Array) -> Array:
    """Points drawn towards a sphere about the scanner: smooth, without noise."""
    return found / np.linalg.norm(found, axis=1, keepdims=True) * 28.0


def _pieces(folder: Path) -> None:
    """Write the wall as triangles of which no two share a vertex."""
    found = read_ply(folder / WALL)
    write_mesh(folder / WALL, found.vertices[found.faces].reshape(-1, 3), np.arange(3 * len(found.faces)).reshape(-1, 3))


_RING = np.linspace(0, 6.28, 20_000)
"""Angles at which the corners of a round stable area lie about its centre, rad."""
_GAP: dict[str, Change] = {
    "epochs: one in mm": _epochs(_same, lambda found: 1000 * found),
    "epochs: one NaN": _epochs(_same, lambda found: found * NAN),
    "epochs: one of 3 points": _epochs(_same, lambda found: found[:3]),
    "epochs: one behind the scanner": _epochs(_same, lambda found: -found),
    "epochs: one of another place": _epochs(_same, lambda found: found + 7),
    "epochs: three alike": _epochs(_same, _same, _same),
    "10 points": points(lambda found: found[::400][:10]),
    "20 points": points(lambda found: found[::180][:20]),
    "100 points": points(lambda found: found[::36][:100]),
    "500 points": points(lambda found: found[::7][:500]),
    "30 points 100 times": points(lambda found: np.tile(found[::120][:30], (100, 1))),
    "points without noise": points(_on_the_wall),
    "points of half a metre more": points(lambda found: found * (1 + 0.5 / np.linalg.norm(found, axis=1, keepdims=True))),
    "points of an arc": points(lambda found: found[np.abs(found[:, 2]) < 0.2]),
    "points of one line of the scan": points(lambda found: found[:46]),
    "points as float 1e-320": points(lambda found: found * 1e-320),
    "points half behind": points(lambda found: np.where(np.arange(len(found))[:, None] % 2 == 0, found, -found)),
    "points of two walls": points(lambda found: np.concatenate([found, found * 1.5])),
    "points with noise of 5 m": points(lambda found: found + np.random.default_rng(1).normal(0, 5, found.shape)),
    "points of degrees": points(lambda found: np.degrees(found / np.linalg.norm(found, axis=1, keepdims=True))),
    "points sorted by x": points(lambda found: found[np.argsort(found[:, 0])]),
    "points on a cube": points(lambda found: np.round(found / 5) * 5),
    "intensity 0": _channels(intensity=np.zeros),
    "intensity 1": _channels(intensity=np.ones),
    "intensity one bright": _channels(intensity=lambda n: np.where(np.arange(n) == 5, 1e9, 1.0)),
    "gps_time 0": _channels(gps_time=np.zeros),
    "gps_time NaN": _channels(gps_time=lambda n: np.full(n, NAN)),
    "gps_time infinite": _channels(gps_time=lambda n: np.full(n, INFINITE)),
    "gps_time 1e300": _channels(gps_time=lambda n: np.full(n, 1e300) * np.linspace(0, 1, n)),
    "gps_time backwards": _channels(gps_time=lambda n: -np.arange(n, dtype=float)),
    "gps_time half NaN": _channels(gps_time=lambda n: np.where(np.arange(n) % 2, NAN, 1.0)),
    "channel epoch": _channels(epoch=lambda n: np.full(n, -5)),
    "channel epoch huge": _channels(epoch=lambda n: np.full(n, 2**31 - 1)),
    "channel line": _channels(line=lambda n: np.full(n, -1)),
    "channel NaN": _channels(strange=lambda n: np.full(n, NAN)),
    "pattern infinite": put(YAML, pattern__azimuth_rad=[0.3, INFINITE, 0.01]),
    "pattern 1e300": put(YAML, pattern__azimuth_rad=[0.3, 1e300, 1e298]),
    "pattern text": put(YAML, pattern__azimuth_rad="0.3 1.5 0.01"),
    "pattern null": put(YAML, pattern={"azimuth_rad": None, "zenith_rad": None}),
    "pattern both units": put(YAML, pattern__azimuth_deg=[20, 80, 1]),
    "pattern fine": put(YAML, pattern__azimuth_rad=[0.3857, 1.4053, 0.0005]),
    "pattern of a full turn": put(YAML, pattern__azimuth_rad=[-6.28, 6.28, 0.0118]),
    "pattern shifted": put(YAML, pattern__azimuth_rad=[0.3916, 1.4112, 0.011855749929083337]),
    "scanner null": put(YAML, scanner=None),
    "scanner list": put(YAML, scanner=[1, 2, 3]),
    "scanner key unknown": put(YAML, scanner__position=[1, 2, 3]),
    "scanner position text": put(YAML, scanner__position_m="here"),
    "scanner position of 2": put(YAML, scanner__position_m=[1.0, 2.0]),
    "scanner position 10 m off": put(YAML, scanner__position_m=[2397.9, 8336.4, 380.9]),
    "scanner position 5000 m up": put(YAML, scanner__position_m=[2387.9, 8336.4, 5380.9]),
    "scanner rotation turned": put(YAML, scanner__rotation=[[0.94686, -0.3216, 0], [0.3216, 0.94686, 0], [0, 0, 1]]),
    "scanner rotation of words": put(YAML, scanner__rotation=[["a", "b", "c"]] * 3),
    "scanner rotation 1e300": put(YAML, scanner__rotation=[[1e300] * 3] * 3),
    "stable_areas a ring": put(YAML, stable_areas=lambda: [np.column_stack([np.cos(_RING), np.sin(_RING)]).tolist()]),
    "stable_areas crossed": put(YAML, stable_areas=[[[0, 0], [9, 9], [9, 0], [0, 9]]]),
    "stable_areas 20000": put(YAML, stable_areas=[[0, 0, 50, 50]] * 20_000),
    "stable_areas one number": put(YAML, stable_areas=[[1]]),
    "stable_areas a number": put(YAML, stable_areas=3),
    "stable_areas nested": put(YAML, stable_areas=[[[[1, 2], [3, 4], [5, 6]]]]),
    "notes of markup": put(YAML, notes=["<script>alert(1)</script>", "$x_{", "\u001b[31m"]),
    "notes a number": put(YAML, notes=3),
    "notes of 1 MB": put(YAML, notes=["a" * 1_000_000]),
    "notes 10000": put(YAML, notes=["a"] * 10_000),
    "key unknown": put(YAML, refrence="wall.ply"),
    "keys twice": lambda folder: _append(folder / YAML, "\nsensor: tls\nreference: none.ply\n"),
    "tabs": lambda folder: _append(folder / YAML, "\n\tpoints: scan.ply\n"),
    "a byte order mark": lambda folder: _prepend(folder / YAML, "\ufeff".encode()),
    "Latin 1": lambda folder: _append(folder / YAML, b"\nnotes: [H\xf6he]\n"),
    "reference a cloud": put(YAML, reference="scan.ply"),
    "reference a text": put(YAML, reference="measurement.yaml"),
    "reference a DEM": both(instead("measurement/dem.tif", map_of(np.zeros((40, 50)))), put(YAML, reference="dem.tif")),
    "reference null": put(YAML, reference=None),
    "reference a list": put(YAML, reference=["wall.ply", "wall.ply"]),
    "reference outside": put(YAML, reference="../../../../../../etc/passwd"),
    "reference turned inside out": mesh(WALL, _same, lambda faces: faces[:, ::-1]),
    "reference of pieces": _pieces,
    "reference every face twice": mesh(WALL, _same, lambda faces: np.concatenate([faces, faces])),
    "reference both sides": mesh(WALL, _same, lambda faces: np.concatenate([faces, faces[:, ::-1]])),
    "reference of slivers": mesh(WALL, _same, lambda faces: faces[:, [0, 0, 1]]),
    "reference in degrees": mesh(WALL, lambda found: found * 1e-5),
    "reference flat": mesh(WALL, lambda found: found * [1, 1, 0]),
    "reference a tenth": mesh(WALL, _same, lambda faces: faces[::10]),
    "reference one vertex far": mesh(WALL, lambda found: np.where(np.arange(len(found))[:, None] == 7, 1e7, found)),
    "reference shuffled": mesh(WALL, np.random.default_rng(1).permutation),
    "model effect NaN": put(MODEL, effects=[{"name": "tls.range_offset", "offset_m": NAN}]),
    "model effect text": put(MODEL, effects=[{"name": "tls.range_offset", "offset_m": "much"}]),
    "model effect a list": put(MODEL, effects=[[1]]),
    "model effect without a name": put(MODEL, effects=[{"offset_m": 1.0}]),
    "model effect of stereo": put(MODEL, effects=[{"name": "stereo.base_error", "error_m": 1.0}]),
    "model effect offset -1000": put(MODEL, effects=[{"name": "tls.range_offset", "offset_m": -1000.0}]),
    "model limit high": put(MODEL, effects=[{"name": "tls.detection_limit", "minimum_power": 1e9}]),
    "model rain": put(MODEL, effects=[{"name": "tls.precipitation", "rate_per_m": 10.0}]),
    "model noise text": put(MODEL, noise={"range_sigma_m": "3 mm"}),
    "model noise a list": put(MODEL, noise=[0.003]),
    "model noise 1 um": put(MODEL, noise={"range_sigma_m": 1e-6, "angle_sigma_rad": 0.0}),
    "model noise angle 1e300": put(MODEL, noise={"range_sigma_m": 0.003, "angle_sigma_rad": 1e300}),
    "model gone": put(YAML, model="none.yaml"),
    "model is a folder": put(YAML, model="."),
    "points null": put(YAML, points=None),
    "points a mapping": put(YAML, points={"a": "scan.ply"}),
    "points a list of null": put(YAML, points=[None]),
    "points of markup": put(YAML, points="<script>$x_{.laz"),
    "sensor a list": put(YAML, sensor=["tls"]),
    "sensor stereo": put(YAML, sensor="stereo"),
}  # fmt: skip
_STEREO: dict[str, Change] = {
    "pixels NaN": _pixels(lambda n: np.full((n, 2), NAN)),
    "pixels 1e300": _pixels(lambda n: np.full((n, 2), 1e300)),
    "pixels -5": _pixels(lambda n: np.full((n, 2), -5.0)),
    "pixels all one": _pixels(lambda n: np.full((n, 2), 600.0)),
    "pixels random": _pixels(lambda n: np.random.default_rng(1).uniform(0, 1200, (n, 2))),
    "points on one line": text(SURFACE, "".join(f"{4685 + k / 100:.3f} 1500 200\n" for k in range(1000))),
    "points random": text(SURFACE, "".join("{:.3f} {:.3f} {:.3f}\n".format(*row) for row in
        np.random.default_rng(1).uniform([4670, 1480, 180], [4700, 1520, 210], (3000, 3)))),
    "points identical": text(SURFACE, "4685 1500 200\n" * 1000),
    "scanner too": put(PAIR, scanner={"position_m": [0, 0, 0], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}),
    "model of tls": put("pair/model.yaml", sensor="tls", noise={"range_sigma_m": 0.003}),
    "model noise negative": put("pair/model.yaml", noise={"parallax_sigma_px": -1.0}),
    "model noise 1e4 px": put("pair/model.yaml", noise={"parallax_sigma_px": 1e4}),
    "cameras b1 1e300": put("pair/cameras.yaml", left__b1=1e300),
    "cameras cx 1e300": put("pair/cameras.yaml", left__cx_px=1e300),
    "cameras cx 90000": put("pair/cameras.yaml", left__cx_px=90000),
    "cameras k1 -10": put("pair/cameras.yaml", left__k1=-10),
    "cameras p1 1e300": put("pair/cameras.yaml", left__p1=1e300),
    "cameras f 1": put("pair/cameras.yaml", left__f_px=1),
    "cameras f 1e6": put("pair/cameras.yaml", left__f_px=1e6, right__f_px=1e6),
    "cameras width 1": put("pair/cameras.yaml", left__width=1, right__width=1),
    "cameras 50 km apart": put("pair/cameras.yaml", right__position_m=[54691.0, 1434.0, 196.0]),
    "cameras one behind the other": put("pair/cameras.yaml", right__position_m=[4685.694448205591, 1440.0, 196.68835]),
    "cameras position text": put("pair/cameras.yaml", left__position_m="here"),
    "cameras third": put("pair/cameras.yaml", middle={"f_px": 1}),
    "cameras a pipe": instead("pair/cameras.yaml", pipe),
    "cameras calibration gone": put("pair/cameras.yaml", left__calibration="none.xml"),
    "cameras calibration a pipe": both(instead("pair/a.xml", pipe), put("pair/cameras.yaml", left__calibration="a.xml")),
    "cameras calibration a list": put("pair/cameras.yaml", left__calibration=["a"]),
}  # fmt: skip


def _append(path: Path, more: str | bytes) -> None:
    path.write_bytes(path.read_bytes() + (more.encode() if isinstance(more, str) else more))


def _prepend(path: Path, more: bytes) -> None:
    path.write_bytes(more + path.read_bytes())


def cases() -> list[Case]:
    out = ("--out", "out", "--quiet")
    found = [Case(f"gap: {name}", ("gap", "measurement", *out), ("measurement",), spoil) for name, spoil in _GAP.items()]
    found += [Case(f"gap: stereo {name}", ("gap", "pair", *out), ("pair",), spoil) for name, spoil in _STEREO.items()]
    found.append(Case("gap: measurement.yaml of nulls", ("gap", "measurement", *out), ("measurement",), whole(YAML, None)))
    return found
