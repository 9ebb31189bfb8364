"""Bad inputs for `gap`: measurements, and its other arguments."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.bad_inputs.case import Case
from benchmarks.bad_inputs.spoil import (
    GONE,
    INFINITE,
    NAN,
    Array,
    Change,
    as_laz,
    at,
    bomb,
    both,
    cut,
    gone,
    instead,
    link,
    merge_bomb,
    mesh,
    pipe,
    points,
    put,
    text,
    whole,
)

YAML, MODEL, WALL, SCAN = "measurement/measurement.yaml", "measurement/model.yaml", "measurement/wall.ply", "measurement/scan.ply"
PAIR, CAMERAS, SURFACE = "pair/measurement.yaml", "pair/cameras.yaml", "pair/surface.xyz"
_GLTF = '{"asset": {"version": "2.0"}, "buffers": [{"uri": "/etc/passwd", "byteLength": 10}]}'
_ENTITIES = '<!DOCTYPE a [<!ENTITY b "cc"><!ENTITY d "&b;&b;">]><document>&d;</document>'
_AWAY = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
FACTOR, OFFSET = 131, 155
"""Offsets of the first scale factor and the first coordinate offset in the header of a LAS file."""


def _cloud(count: int) -> Change:
    return points(lambda found: found[:: max(len(found) // count, 1)][:count])


def _random(found: Array) -> Array:
    return np.random.default_rng(1).uniform(found.min(axis=0), found.max(axis=0), found.shape)


def _behind(meters: float) -> Change:
    return points(lambda found: found * (1 + meters / np.linalg.norm(found, axis=1, keepdims=True)))


def _one(value: float) -> Change:
    return points(lambda found: np.concatenate([found, [[value, 0.0, 0.0]]]))


def _xyz(content: str | bytes | Callable[[], bytes]) -> Change:
    return both(text("measurement/scan.xyz", content), put(YAML, points="scan.xyz"))


def _noise(**noise: object) -> Change:
    return put(MODEL, noise=noise)


def _effects(*effects: object) -> Change:
    return put(MODEL, effects=list(effects))


_TLS: dict[str, Change] = {
    "points empty list": put(YAML, points=[]),
    "points twice the same": put(YAML, points=["scan.ply", "scan.ply"]),
    "points is a folder": put(YAML, points="."),
    "points is no file": put(YAML, points="none.laz"),
    "points with another suffix": put(YAML, points="model.yaml"),
    "points is a number": put(YAML, points=3),
    "points with a null character": put(YAML, points="a\0b.laz"),
    "points with a very long name": put(YAML, points="a" * 5000 + ".laz"),
    "points is a pipe": instead(SCAN, pipe),
    "points is a loop of links": instead(SCAN, link("scan.ply")),
    "points is /dev/zero": instead(SCAN, link("/dev/zero")),
    "points xyz is /dev/zero": both(instead("measurement/scan.xyz", link("/dev/zero")), put(YAML, points="scan.xyz")),
    "points 1000 files": put(YAML, points=["scan.ply"] * 1000),
    "points cut": cut(SCAN),
    "points empty": text(SCAN, b""),
    "points garbage": text(SCAN, bytes(range(256)) * 40),
    "ply claims 4e9 vertices": text(SCAN, "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty double x\n"
                                          "property double y\nproperty double z\nend_header\n"),
    "ply claims -1 vertices": text(SCAN, "ply\nformat ascii 1.0\nelement vertex -1\nproperty double x\nproperty double y\n"
                                         "property double z\nend_header\n"),
    "ply without z": text(SCAN,
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty double x\nproperty double y\nend_header\n1 2\n"),
    "ply header without end": text(SCAN, b"ply\nformat ascii 1.0\n" + b"comment x\n" * 3_000_000),
    "xyz of one column": _xyz("1\n2\n3\n"),
    "xyz of words": _xyz("a b c\nd e f\n"),
    "xyz of changing columns": _xyz("1 2 3\n1 2\n1 2 3 4\n"),
    "xyz one 50 MB line": _xyz(lambda: b"1.0 2.0 3.0 " * 4_200_000),
    "xyz in UTF-16": _xyz("1 2 3\n4 5 6\n".encode("utf-16")),
    "xyz with null characters": _xyz(b"\0" * 1000),
    "pattern step 1e-12": put(YAML, pattern__azimuth_rad=[0.3, 1.5, 1e-12]),
    "pattern step 0": put(YAML, pattern__azimuth_rad=[0.3, 1.5, 0.0]),
    "pattern step negative": put(YAML, pattern__azimuth_rad=[0.3, 1.5, -0.01]),
    "pattern step NaN": put(YAML, pattern__azimuth_rad=[0.3, 1.5, NAN]),
    "pattern backwards": put(YAML, pattern__azimuth_rad=[1.5, 0.3, 0.01]),
    "pattern degrees": put(YAML, pattern__azimuth_rad=[22.0, 80.0, 0.68], pattern__zenith_rad=[58.0, 107.0, 1.04]),
    "pattern of two numbers": put(YAML, pattern__azimuth_rad=[0.3, 1.5]),
    "pattern elsewhere": put(YAML, pattern__azimuth_rad=[3.0, 4.0, 0.01]),
    "pattern of one pulse": put(YAML, pattern__azimuth_rad=[0.3, 1.5, 1.2], pattern__zenith_rad=[1.0, 1.9, 0.9]),
    "pattern much coarser than the points": put(YAML, pattern__azimuth_rad=[0.3, 1.5, 0.2]),
    "frame scanner but points are world": put(YAML, frame="world"),
    "frame unknown": put(YAML, frame="camera"),
    "scanner missing": put(YAML, scanner=GONE),
    "scanner position NaN": put(YAML, scanner__position_m__0=NAN),
    "scanner position infinite": put(YAML, scanner__position_m__0=INFINITE),
    "scanner position 1e300": put(YAML, scanner__position_m__0=1e300),
    "scanner position 0": put(YAML, scanner__position_m=[0.0, 0.0, 0.0]),
    "scanner rotation zero": put(YAML, scanner__rotation=[[0, 0, 0]] * 3),
    "scanner rotation mirrored": put(YAML, scanner__rotation=[[1, 0, 0], [0, 1, 0], [0, 0, -1]]),
    "scanner rotation NaN": put(YAML, scanner__rotation=[[NAN] * 3] * 3),
    "scanner rotation upside down": put(YAML, scanner__rotation=[[1, 0, 0], [0, -1, 0], [0, 0, -1]]),
    "stable_areas outside": put(YAML, stable_areas=[[1000, 1000, 1001, 1001]]),
    "stable_areas empty box": put(YAML, stable_areas=[[1, 1, 1, 1]]),
    "stable_areas NaN": put(YAML, stable_areas=[[NAN, 0, 1, 1]]),
    "stable_areas backwards": put(YAML, stable_areas=[[1, 1, 0, 0]]),
    "stable_areas two points": put(YAML, stable_areas=[[[0, 0], [1, 1]]]),
    "stable_areas words": put(YAML, stable_areas=["left"]),
    "stable_areas tiny": put(YAML, stable_areas=[[0.0, 0.0, 0.5, 0.5]]),
    "stable_areas 1e300": put(YAML, stable_areas=[[-1e300, -1e300, 1e300, 1e300]]),
    "model noise 0": _noise(range_sigma_m=0.0, angle_sigma_rad=0.0),
    "model noise 1e300": _noise(range_sigma_m=1e300),
    "model noise 1e-300": _noise(range_sigma_m=1e-300, angle_sigma_rad=0.0),
    "model noise 100 m": _noise(range_sigma_m=100.0),
    "model noise NaN": _noise(range_sigma_m=NAN),
    "model noise negative": _noise(range_sigma_m=-0.003),
    "model noise angle 1": _noise(range_sigma_m=0.003, angle_sigma_rad=1.0),
    "model is a list": whole(MODEL, []),
    "model empty": text(MODEL, ""),
    "model of stereo": put(MODEL, sensor="stereo", noise={"parallax_sigma_px": 0.3}),
    "model is the measurement": put(YAML, model="measurement.yaml"),
    "model effect unknown": _effects({"name": "none"}),
    "model effect 1e300": _effects({"name": "tls.range_offset", "offset_m": 1e300}),
    "model effect 1e6": _effects({"name": "tls.range_offset", "offset_m": 1e6}),
    "model effect scale -1": _effects({"name": "tls.range_scale", "scale_ppm": -1e6}),
    "model 10000 effects": _effects(*[{"name": "tls.range_offset", "offset_m": 1e-6}] * 10_000),
    "model effects a mapping": put(MODEL, effects={"name": "tls.range_offset"}),
    "model bomb": text(MODEL, bomb()),
    "model merge bomb": text(MODEL, merge_bomb()),
    "measurement.yaml bomb": text(YAML, bomb()),
    "measurement.yaml merge bomb": text(YAML, merge_bomb()),
    "measurement.yaml is a pipe": instead(YAML, pipe),
    "measurement.yaml is a folder": instead(YAML, lambda path: path.mkdir()),
    "measurement.yaml is a list": whole(YAML, [1, 2]),
    "measurement.yaml empty": text(YAML, ""),
    "measurement.yaml binary": text(YAML, bytes(range(256))),
    "measurement.yaml sensor radar": put(YAML, sensor="radar"),
    "measurement.yaml nested": text(YAML, "[" * 100_000),
    "laz scale nan": as_laz(at("measurement/scan.laz", FACTOR, "<d", NAN)),
    "laz scale 0": as_laz(at("measurement/scan.laz", FACTOR, "<d", 0.0)),
    "laz scale 1e300": as_laz(at("measurement/scan.laz", FACTOR, "<d", 1e300)),
    "laz scale 1000": as_laz(at("measurement/scan.laz", FACTOR, "<d", 1.0)),
    "laz scale negative": as_laz(at("measurement/scan.laz", FACTOR, "<d", -0.0001)),
    "laz offset 1e9": as_laz(at("measurement/scan.laz", OFFSET, "<d", 1e9)),
    "laz offset nan": as_laz(at("measurement/scan.laz", OFFSET, "<d", NAN)),
    "laz offset infinite": as_laz(at("measurement/scan.laz", OFFSET, "<d", INFINITE)),
    "laz cut": as_laz(cut("measurement/scan.laz")),
    "laz claims 4e9 points": as_laz(at("measurement/scan.laz", 107, "<I", 4_000_000_000), at("measurement/scan.laz", 247, "<Q",
        4_000_000_000)),
    "laz header length 65535": as_laz(at("measurement/scan.laz", 94, "<H", 65_535)),
    "laz 4e9 records": as_laz(at("measurement/scan.laz", 100, "<I", 4_000_000_000)),
    "0 points": points(lambda found: found[:0]),
    "1 point": _cloud(1),
    "2 points": _cloud(2),
    "3 points": _cloud(3),
    "7 points": _cloud(7),
    "50 points": _cloud(50),
    "300 points": _cloud(300),
    "3 points without a pattern": both(_cloud(3), put(YAML, pattern=GONE)),
    "5000 identical points": points(lambda found: np.repeat(found[:1], 5000, axis=0)),
    "two places 2500 times": points(lambda found: np.repeat(found[:2], 2500, axis=0)),
    "points on one line": points(lambda found: found[0] + np.linspace(0, 1, 3000)[:, None] * (found[1000] - found[0])),
    "random cloud": points(_random),
    "random cloud without a pattern": points(_random, pattern=GONE),
    "inf": points(lambda found: found + INFINITE),
    "one inf": _one(INFINITE),
    "nan": points(lambda found: found * NAN),
    "half nan": points(lambda found: np.where(np.arange(len(found))[:, None] % 2 == 0, found, NAN)),
    "1e300": points(lambda found: found * 1e300),
    "one 1e300": _one(1e300),
    "one 1e30": _one(1e30),
    "one 1e7": _one(1e7),
    "points 1e9 away": points(lambda found: found + 1e9),
    "points 1e5 away": points(lambda found: found + 1e5),
    "points mm": points(lambda found: 1000 * found),
    "points km": points(lambda found: found / 1000),
    "points behind wall 10 m": _behind(10),
    "points before wall 3 m": _behind(-3),
    "points behind wall 0.9 m": _behind(0.9),
    "points at the scanner": points(lambda found: found * 1e-9),
    "points mirrored": points(lambda found: found * [1, 1, -1]),
    "points behind the scanner": points(lambda found: -found),
    "points rotated": points(lambda found: found[:, [1, 2, 0]]),
    "points rounded to a metre": points(np.round),
    "points shuffled": points(np.random.default_rng(1).permutation),
    "points all twice": points(lambda found: np.concatenate([found, found])),
    "ref no vertices": mesh(WALL, lambda found: found[:0], lambda faces: faces[:0]),
    "ref no faces": mesh(WALL, lambda found: found, lambda faces: faces[:0]),
    "ref one face": mesh(WALL, lambda found: found, lambda faces: faces[:1]),
    "ref face out of range": mesh(WALL, lambda found: found, lambda faces: faces + 10**6),
    "ref negative face": mesh(WALL, lambda found: found, lambda faces: faces - 5),
    "ref 1e9 coords": mesh(WALL, lambda found: found * 1e9),
    "ref 1e300": mesh(WALL, lambda found: found * 1e300),
    "ref nan": mesh(WALL, lambda found: found * NAN),
    "ref one nan": mesh(WALL, lambda found: np.where(np.arange(len(found))[:, None] == 5, NAN, found)),
    "ref all one point": mesh(WALL, lambda found: found * 0 + found[:1]),
    "ref on a line": mesh(WALL, lambda found: found * [1, 0, 0]),
    "ref mm": mesh(WALL, lambda found: found * 1000),
    "ref 5 m away": mesh(WALL, lambda found: found + 5),
    "ref is the points": put(YAML, reference="scan.ply"),
    "ref is no file": put(YAML, reference="none.ply"),
    "ref is a folder": put(YAML, reference="."),
    "ref is a pipe": instead(WALL, pipe),
    "ref is /dev/zero": instead(WALL, link("/dev/zero")),
    "ref is a loop of links": instead(WALL, link("wall.ply")),
    "ref obj of words": both(text("measurement/wall.obj", "v a b c\nf 1 2 3\n"), put(YAML, reference="wall.obj")),
    "ref stl cut": both(text("measurement/wall.stl", b"\0" * 84), put(YAML, reference="wall.stl")),
    "ref gltf out of the folder": both(text("measurement/wall.gltf", _GLTF), put(YAML, reference="wall.gltf")),
    "ref cut": cut(WALL),
    "ref gone": gone(WALL),
    "intensity negative": points(lambda found: np.column_stack([found, -np.ones(len(found))])),
    "intensity NaN": points(lambda found: np.column_stack([found, np.full(len(found), NAN)])),
    "intensity 1e300": points(lambda found: np.column_stack([found, np.full(len(found), 1e300)])),
}  # fmt: skip
_STEREO: dict[str, Change] = {
    "stereo good": put(PAIR, frame="world"),
    "stereo base 0": put(CAMERAS, right__position_m=[4685.694448205591, 1434.9229406463091, 196.68835047684797]),
    "stereo base 1e-9": put(CAMERAS, right__position_m=[4685.694448206, 1434.9229406463091, 196.68835047684797]),
    "stereo f 0": put(CAMERAS, left__f_px=0),
    "stereo f 1e-300": put(CAMERAS, left__f_px=1e-300),
    "stereo f 1e300": put(CAMERAS, left__f_px=1e300),
    "stereo f nan": put(CAMERAS, left__f_px=NAN),
    "stereo width 1e9": put(CAMERAS, left__width=10**9),
    "stereo width 0": put(CAMERAS, left__width=0),
    "stereo distortion 1e6": put(CAMERAS, left__k1=1e6),
    "stereo looking away": put(CAMERAS, left__rotation=_AWAY, right__rotation=_AWAY),
    "stereo cameras exchanged": lambda folder: _exchange(folder),
    "stereo cameras missing": put(PAIR, cameras=GONE),
    "stereo cameras is the wall": put(PAIR, cameras="wall.ply"),
    "stereo cameras is a list": whole(CAMERAS, [1]),
    "stereo camera one": put(CAMERAS, right=GONE),
    "stereo camera behind the wall": put(CAMERAS, left__position_m=[4685.0, 1600.0, 196.0], right__position_m=[4691.0, 1600.0,
        196.0]),
    "stereo rotation zero": put(CAMERAS, left__rotation=[[0, 0, 0]] * 3),
    "stereo points 1": lambda folder: _lines(folder, 1),
    "stereo points 50": lambda folder: _lines(folder, 50),
    "stereo points elsewhere": text(SURFACE, "0 0 0\n1 0 0\n0 1 0\n" * 100),
    "stereo points NaN": text(SURFACE, "nan nan nan\n" * 100),
    "stereo noise 0": put("pair/model.yaml", noise={"parallax_sigma_px": 0.0, "regularization_sigma_px": 0.0}),
    "stereo noise 1e300": put("pair/model.yaml", noise={"parallax_sigma_px": 1e300}),
    "stereo step 0": put("pair/model.yaml", noise={"parallax_sigma_px": 0.1, "regularization_sigma_px": 0.1,
        "regularization_step_px": 0}),
    "stereo step 1e9": put("pair/model.yaml", noise={"parallax_sigma_px": 0.1, "regularization_sigma_px": 0.1,
        "regularization_step_px": 1e9}),
    "stereo frame scanner": put(PAIR, frame="scanner"),
    "stereo pattern": put(PAIR, pattern={"azimuth_rad": [0.3, 1.5, 0.01], "zenith_rad": [0.3, 1.5, 0.01]}),
    "stereo ref 1e9 coords": mesh("pair/wall.ply", lambda found: found * 1e9),
    "stereo metashape bomb": both(text("pair/cameras.xml", _ENTITIES), put(PAIR, cameras="cameras.xml")),
}  # fmt: skip


def _exchange(folder: object) -> None:
    import yaml

    path = folder / CAMERAS  # type: ignore[operator]
    found = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump({"left": found["right"], "right": found["left"]}))


def _lines(folder: object, count: int) -> None:
    path = folder / SURFACE  # type: ignore[operator]
    rows = path.read_text().splitlines()
    path.write_text("\n".join(rows[:: len(rows) // count][:count]) + "\n")


_ERRORS = ("nan", "1e300", "inf", "-1", "x")
_WORDS: dict[str, tuple[str, ...]] = {
    **{f"--reference-error {value}": ("site.yaml", "--identifiability", f"--reference-error={value}") for value in _ERRORS},
    "--seed -1": ("measurement", "--seed", "-1"),
    "--seed 1e30": ("measurement", "--seed", "1" + "0" * 30),
    "--seed 5000 digits": ("measurement", "--seed", "1" * 5000),
    "no such folder": ("nowhere",),
    "a file": ("site.yaml",),
    "a loop of links": ("loop",),
    "a run": ("run",),
    "--identifiability of a bad config": ("site.yaml", "--identifiability", "--set", "wall.width_m=nan"),
    "--identifiability of no file": ("none.yaml", "--identifiability"),
    "--identifiability, set.yaml": ("set.yaml", "--identifiability"),
    "--identifiability, a huge wall": ("site.yaml", "--identifiability", "--set", "wall.width_m=1e6"),
    "--identifiability, far": ("site.yaml", "--identifiability", "--sensor", "tls", "--set", "station.distance_m=1e6"),
    "--identifiability, coarse": ("site.yaml", "--identifiability", "--sensor", "tls", "--set", "scanner.azimuth_step_rad=1.0"),
    "--out is a file": ("measurement", "--out", "site.yaml"),
    "--out under a file": ("measurement", "--out", "site.yaml/out"),
    "--out with a null character": ("measurement", "--out", "a\u0000b".replace("\u0000", "")),
    "--out very long": ("measurement", "--out", "a" * 5000),
    "--out a loop of links": ("measurement", "--out", "loop"),
}


def cases() -> list[Case]:
    out = ("--out", "out", "--quiet")
    found = [Case(f"gap: {name}", ("gap", "measurement", *out), ("measurement",), spoil) for name, spoil in _TLS.items()]
    found += [Case(f"gap: {name}", ("gap", "pair", *out), ("pair",), spoil) for name, spoil in _STEREO.items()]
    loop = instead("loop", link("loop"))
    needs = ("measurement", "site.yaml", "set.yaml", "run")
    for name, words in _WORDS.items():
        asked = words if "--out" in words else (*words, "--out", "out")
        found.append(Case(f"gap: {name}", ("gap", *asked, "--quiet"), needs, loop))
    return found
