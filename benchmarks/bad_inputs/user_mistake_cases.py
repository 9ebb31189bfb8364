"""Bad inputs that are mistakes people make.

They are another program's notation, one place for input and output, stray files in a folder, and records that do not fit the
other files.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.bad_inputs.case import PORT_IN_USE, Case
from benchmarks.bad_inputs.spoil import GONE, NAN, Change, both, instead, link, pipe, put, text, whole
from pipeline.formats.meshes.ply import read_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz

SITE, YAML, RUN, MAP = "site.yaml", "measurement/measurement.yaml", "run/run.json", "run/difference_001.tif"
_OUT = ("--out", "out", "--quiet")
_RAW = ("measurement", "raw/scan.ply", "--reference", "raw/wall.ply", "--scanner", "riegl_vz400i", "--quiet")
_VIEW = ("--no-browser", "--port", str(PORT_IN_USE))

_NUMBERS: dict[str, str] = {
    "with a unit": "wall: {width_m: 5 m}",
    "with a decimal comma": "wall: {width_m: '5,5'}",
    "with thousands": "wall: {width_m: '1,000'}",
    "in words": "wall: {width_m: five}",
    "an exponent without a point": "difference: {gsd_m: 5e-2}",
    "a double exponent": "difference: {gsd_m: 5d-2}",
    "in octal": "seed: 0o17",
    "in old octal": "seed: 0777",
    "in binary": "seed: 0b101",
    "in sixties": "seed: 1:30:00",
    "with underscores": "seed: 1_000",
    "yes": "epochs: yes",
    "on": "epochs: on",
    "a quoted one": "epochs: '2'",
    "minus zero": "wall: {width_m: -0.0}",
    "a fraction": "wall: {width_m: 1/2}",
    "a percentage": "rockfall: {count: 50%}",
    "a range": "epochs: 1-2",
    "of full width": "epochs: \uff12",
    "with a minus of typography": "seed: \u22125",
    "with a space that does not break": "epochs:\u00a02",
    "a tilde": "epochs: ~",
    "a sum": "epochs: 1+1",
    "the smallest": "wall: {width_m: 5e-324}",
    "the largest": "wall: {width_m: 1.7976931348623157e308}",
}
"""Lines of a config."""
_KEYS: dict[str, str] = {
    "a number": "1: 2",
    "null": "~: 2",
    "true": "on: 2",
    "in capitals": "SEED: 3",
    "with a hyphen": "depth-map: low",
    "with a point": "wall.width_m: 5",
    "with a space behind": "'seed ': 3",
    "a letter that looks alike": "s\u0435ed: 3",
    "merged from a word": "<<: seed",
    "merged from a list of words": "<<: [seed, epochs]",
    "empty": "'': 3",
    "without a space": "seed:3",
    "with an equals sign": "seed = 3",
    "of JSON without an end": '{"seed": 3',
    "beneath a list": "- seed: 3",
    "of Windows": "[wall]\nwidth_m=5",
    "of XML": "<seed>3</seed>",
}
_PATHS: dict[str, str] = {
    "a pattern": "*.ply",
    "an address": "https://example.org/scan.ply",
    "a file's address": "file:///etc/passwd",
    "of home": "~/scan.ply",
    "with a variable": "$HOME/scan.ply",
    "of Windows": "C:\\data\\scan.ply",
    "of another slash": "sub\\scan.ply",
    "with a space behind": "scan.ply ",
    "with a slash behind": "scan.ply/",
    "with quotes": "'scan.ply'",
    "a folder up": "../../../../../../etc/passwd",
    "through a file": "scan.ply/../scan.ply",
    "a point": ".",
    "in capitals": "SCAN.PLY",
    "of a tape": "/dev/tty",
    "of memory": "/proc/self/mem",
    "of a descriptor": "/dev/fd/0",
    "of 300 folders": "a/" * 300 + "scan.ply",
}
"""In the place of a measurement's points, its wall and its model."""
_PLACES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "surface: out is the cloud": (("surface", "raw/scan.ply", "--out", "raw/scan.ply", "--seen-from", "0", "0", "0"), ("raw",)),
    "raw: out is the scan's folder": (
        (*_RAW, "--out", "raw"), ("raw",)
    ),
    "raw: out is above": (
        (*_RAW, "--out", ".."), ("raw",)
    ),
    "gap: out in the points": (("gap", "measurement", "--out", "measurement/scan.ply/out", "--quiet"), ("measurement",)),
    "gap: out is /proc": (("gap", "measurement", "--out", "/proc/1/out", "--quiet"), ("measurement",)),
    "cal: out is the run": (("calibrate", "run", "--out", "run", "--quiet"), ("run",)),
    "icp: out is the run": (("icp-study", "run", "--repeats", "1", "--out", "run", "--quiet"), ("run",)),
    "cmp: out is a run that is measured": (
        ("compare", SITE, "--measured", "run", "--epochs", "1", "--out", "run", "--quiet"), (SITE, "run")
    ),
    "det: out in the set": (("detect", "baseline", "set/train", "--out", "set/train", "--quiet"), ("set",)),
    "ev: out is the truth": (("evaluate", "truth.json", "found.json", "--out", "truth.json"), ("truth.json", "found.json")),
    "sim: out is here": (("simulate", "--sensor", "tls", "--config", SITE, "--out", ".", "--quiet"), (SITE,)),
    "sim: out is above": (("simulate", "--sensor", "tls", "--config", SITE, "--out", "..", "--quiet"), (SITE,)),
    "ds: out is here": (("dataset", "set.yaml", "--out", ".", "--quiet"), ("set.yaml",)),
    "train: out in the set": (("train", "set", "--out", "set/train", "--quiet"), ("set",)),
    "init: out is a config": (("init", "--out", SITE), (SITE,)),
    "inspect: out is the config": (("inspect", SITE, "--out", SITE, "--quiet"), (SITE,)),
    "export: out is the run's record": (("export", "run", "package", "--out", RUN, "--quiet"), ("run",)),
    "view: a run beside itself": (("view", "run", "run", *_VIEW), ("run",)),
    "view: a run beside a set": (("view", "run", "set/train", *_VIEW), ("run", "set")),
    "view: a run beside a diagnosis": (("view", "run", "diagnosis", *_VIEW), ("run", "diagnosis")),
    "view: a diagnosis beside itself": (("view", "diagnosis", "diagnosis", *_VIEW), ("diagnosis",)),
    "view: a run beside nothing": (("view", "run", "", *_VIEW), ("run",)),
    "view: a run beside a file": (("view", "run", SITE, *_VIEW), ("run", SITE)),
}  # fmt: skip


def _beside(**values: Any) -> Change:
    """second/, a copy of run/ with values in its record."""

    def change(folder: Path) -> None:
        shutil.copytree(folder / "run", folder / "second")
        put("second/run.json", **values)(folder)

    return change


_SECONDS: dict[str, Change] = {
    "of another wall's frame": _beside(wall_frame__origin_m=[500.0, 0.0, 0.0]),
    "without a frame": _beside(wall_frame=GONE),
    "with a frame null": _beside(wall_frame=None),
    "with a matrix of 3": _beside(wall_frame__matrix_world_to_wall=[[1, 0, 0]] * 3),
    "with a matrix of zeros": _beside(wall_frame__matrix_world_to_wall=[[0, 0, 0, 0]] * 4),
    "with a matrix of words": _beside(wall_frame__matrix_world_to_wall=[["a"] * 4] * 4),
    "of another sensor": _beside(sensor="stereo"),
    "of one epoch": lambda folder: _beside(epochs=json.loads((folder / RUN).read_text())["epochs"][:1])(folder),
    "without blocks": _beside(epochs__1__blocks=GONE),
    "with statistics null": _beside(epochs__1__statistics=None),
    "without its maps": both(_beside(), lambda folder: [path.unlink() for path in (folder / "second").glob("*.tif")]),
}
_FRAMES: dict[str, Change] = {
    "null": put(RUN, wall_frame=None),
    "gone": put(RUN, wall_frame=GONE),
    "a list": put(RUN, wall_frame=[]),
    "rotation of words": put(RUN, wall_frame__rotation=[["a", "b", "c"]] * 3),
    "rotation of zeros": put(RUN, wall_frame__rotation=[[0.0, 0.0, 0.0]] * 3),
    "rotation of 2": put(RUN, wall_frame__rotation=[[1.0, 0.0], [0.0, 1.0]]),
    "rotation gone": put(RUN, wall_frame__rotation=GONE),
    "origin 1e300": put(RUN, wall_frame__origin_m=[1e300, 0.0, 0.0]),
    "origin of 2": put(RUN, wall_frame__origin_m=[0.0, 0.0]),
    "origin gone": put(RUN, wall_frame__origin_m=GONE),
    "and no reference": lambda folder: (folder / "run/epoch_000/surface.ply").unlink(),
    "and a reference cut": lambda folder: (folder / "run/epoch_000/surface.ply").write_bytes(b"ply\nformat ascii 1.0\n"),
    "and a reference a pipe": instead("run/epoch_000/surface.ply", pipe),
    "run.json a pipe": instead(RUN, pipe),
    "run.json a loop": instead(RUN, link("run.json")),
    "run.json a list": whole(RUN, []),
}
"""Beside a map that `detect` is given: the places of its events are taken from there."""


def _stray(where: str) -> Change:
    """Leave files in a folder as a file manager, an editor and a cloud do."""

    def change(folder: Path) -> None:
        base = folder / where
        (base / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
        (base / "._scan.ply").write_bytes(b"\0\5\26\7")
        (base / "Thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0")
        (base / "~$notes.docx").write_bytes(b"")
        (base / "again").symlink_to(".")
        (base / "gone").symlink_to("nowhere")
        pipe(base / "pipe")
        (base / "copy of map.tif").write_bytes(b"II*\0")
        (base / "difference_001 (1).tif").write_bytes(b"")
        (base / "empty folder").mkdir()

    return change


_STRAYS: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "gap: strays in the measurement": ("measurement", ("gap", "measurement", *_OUT), ("measurement",)),
    "det: strays in the run": ("run", ("detect", "baseline", "run", *_OUT), ("run",)),
    "det: strays in the tiles": ("set/train", ("detect", "baseline", "set/train", *_OUT), ("set",)),
    "cal: strays in the run": ("run", ("calibrate", "run", "--no-greedy", *_OUT), ("run",)),
    "icp: strays in the run": ("run", ("icp-study", "run", "--repeats", "1", *_OUT), ("run",)),
    "cmp: strays in the run": ("run", ("compare", SITE, "--measured", "run", "--epochs", "1", *_OUT), ("run", SITE)),
    "view: strays in the run": ("run", ("view", "run", *_VIEW), ("run",)),
    "view: strays in the diagnosis": ("diagnosis", ("view", "diagnosis", *_VIEW), ("diagnosis",)),
    "ds: verify with strays": ("set", ("dataset", "verify", "set", "--quiet"), ("set",)),
    "ds: verify with strays in a split": ("set/train", ("dataset", "verify", "set", "--quiet"), ("set",)),
    "ds: split with strays": ("set/train", ("dataset", "split", "set", "--by", "noise", *_OUT), ("set",)),
    "train: strays in the set": ("set/train", ("train", "set", "--set", "training.epochs=0", *_OUT), ("set",)),
    "ev: strays in the set": ("set/train", ("evaluate", "set/train", "found.json"), ("set", "found.json")),
    "sim: strays in a run resumed": (
        "run", ("simulate", "--sensor", "tls", "--config", SITE, "--resume", "--out", "run", "--quiet"), ("run", SITE)
    ),
    "export: yolo with strays": ("set/train", ("export", "set", "yolo", *_OUT), ("set",)),
    "export: package with strays": ("run", ("export", "run", "package", "--quiet"), ("run",)),
}  # fmt: skip
_LEFT: dict[str, Change] = {
    "staging a file": text("set/.staging", "x"),
    "staging a link out": lambda folder: (folder / "set/.staging").symlink_to("/etc"),
    "staging a pipe": lambda folder: pipe(folder / "set/.staging"),
    "lock a folder": lambda folder: (folder / "set/.lock").mkdir(),
    "lock a link out": lambda folder: (folder / "set/.lock").symlink_to("/etc/passwd"),
    "lock a pipe": lambda folder: pipe(folder / "set/.lock"),
    "shards a file": both(lambda folder: shutil.rmtree(folder / "set/shards", ignore_errors=True), text("set/shards", "x")),
    "card a file": both(lambda folder: shutil.rmtree(folder / "set/card"), text("set/card", "x")),
    "README a folder": instead("set/README.md", lambda path: path.mkdir()),
    "README a pipe": instead("set/README.md", pipe),
    "checksums of Windows": lambda folder: _replaced(folder / "set/checksums.sha256", b"\n", b"\r\n"),
    "checksums twice": lambda folder: _replaced(folder / "set/checksums.sha256", b"\n", b"\n", times=2),
    "test a link": lambda folder: [(folder / "set/test").rename(folder / "kept"), (folder / "set/test").symlink_to("../kept")],
    "train a link of itself": lambda folder: [shutil.rmtree(folder / "set/train"), (folder / "set/train").symlink_to("train")],
}


def _replaced(path: Path, old: bytes, new: bytes, times: int = 1) -> None:
    path.write_bytes(path.read_bytes().replace(old, new) * times)


_CHECKPOINT: dict[str, Change] = {
    "state empty": text("detector/checkpoint/state.json", ""),
    "state a list": text("detector/checkpoint/state.json", "[]"),
    "state of another config": whole(
        "detector/checkpoint/state.json",
        {"weights": "w.weights.h5", "optimizer": "o.npz", "config": {}, "training": [], "validation": []},
    ),
    "state out of the folder": whole(
        "detector/checkpoint/state.json",
        {"weights": "../../x", "optimizer": "/etc/passwd", "config": {}, "training": [{"loss": 1e300}], "validation": []},
    ),
    "state a pipe": both(text("detector/checkpoint/state.json", ""), instead("detector/checkpoint/state.json", pipe)),
    "checkpoint a file": text("detector/checkpoint", "x"),
}


def _clouds(*moves: Any) -> Change:
    """Epochs, LAZ, each the scan with what its function gives as further channels."""

    def change(folder: Path) -> None:
        points = _scan(folder)
        names = []
        for number, extra in enumerate(moves):
            names.append(f"epoch {number}.laz")
            write_laz(folder / "measurement" / names[-1], PointCloud(points, **extra(len(points))))
        put(YAML, points=names)(folder)

    return change


def _scan(folder: Path) -> Any:
    from pipeline.formats.points.points import read_points

    return read_points(folder / "measurement/scan.ply").points


def _measured() -> dict[str, Change]:
    clock = {"gps_time": np.arange}
    return {
        "epochs of other channels": _clouds(lambda n: {}, lambda n: {"intensity": np.ones(n, np.uint16)}),
        "epochs of one clock": _clouds(*[lambda n: {name: make(n, dtype=float) for name, make in clock.items()}] * 2),
        "epochs the second without power": _clouds(
            lambda n: {"intensity": np.arange(n) % 9 + 1.0}, lambda n: {"intensity": np.zeros(n)}
        ),
        "epochs 30 alike": _clouds(*[lambda n: {}] * 30),
        "rows without columns": _clouds(lambda n: {"extra": {"row": np.arange(n, dtype=np.int32)}}),
        "rows all alike": _clouds(lambda n: {"extra": {"row": np.zeros(n, np.int32), "column": np.zeros(n, np.int32)}}),
        "rows of 2 billion": _clouds(lambda n: {"extra": {name: np.full(n, 2**31 - 1, np.int32) for name in ("row", "column")}}),
        "true range beside": _clouds(lambda n: {"extra": {"true_range_m": np.full(n, NAN), "incidence_rad": np.full(n, NAN)}}),
        "reference of 500 m": lambda folder: _scaled(folder, 500.0),
        "reference of 1 cm": lambda folder: _scaled(folder, 0.0005),
        "reference of a million triangles on one place": lambda folder: _heap(folder),
    }  # fmt: skip


def _scaled(folder: Path, factor: float) -> None:
    from pipeline.formats.meshes.ply import write_ply
    from scene.geometry.mesh import TriangleMesh

    wall = read_ply(folder / "measurement/wall.ply")
    middle = wall.vertices.mean(axis=0)
    write_ply(folder / "measurement/wall.ply", TriangleMesh((wall.vertices - middle) * factor + middle, wall.faces))


def _heap(folder: Path) -> None:
    from pipeline.formats.meshes.ply import write_ply
    from scene.geometry.mesh import TriangleMesh

    wall = read_ply(folder / "measurement/wall.ply")
    write_ply(folder / "measurement/wall.ply", TriangleMesh(wall.vertices, np.tile(wall.faces[:1], (1_000_000, 1))))


def cases() -> list[Case]:
    lines = {**_NUMBERS, **{f"key {name}": line for name, line in _KEYS.items()}}
    words: tuple[str, ...] = ("inspect", "own.yaml", "--sensor", "tls", *_OUT)
    found = [Case(f"inspect: written {name}", words, (SITE,), _written(line)) for name, line in lines.items()]
    gap = ("gap", "measurement", *_OUT)
    for name, path in _PATHS.items():
        keys = [key for key in ("points", "reference", "model") if (len(name) + len(key)) % 2]  # one or two of them
        found += [Case(f"gap: {key} {name}", gap, ("measurement",), put(YAML, **{key: path})) for key in keys]
    found += [Case(name, words, needs) for name, (words, needs) in _PLACES.items()]
    found += [
        Case(f"view: beside {name}", ("view", "run", "second", *_VIEW), ("run",), spoil) for name, spoil in _SECONDS.items()
    ]
    found += [Case(f"det: frame {name}", ("detect", "baseline", MAP, *_OUT), ("run",), spoil) for name, spoil in _FRAMES.items()]
    found += [Case(name, words, needs, _stray(where), (0, 2)) for name, (where, words, needs) in _STRAYS.items()]
    jobs = (("dataset", "verify", "set", "--quiet"), ("dataset", "split", "set", "--by", "noise", *_OUT))
    found += [Case(f"ds: {name}", jobs[number % 2], ("set",), spoil) for number, (name, spoil) in enumerate(_LEFT.items())]
    resumed = ("train", "set", "--resume", "--out", "detector", "--quiet")
    found += [Case(f"train: {name}", resumed, ("set", "detector"), spoil) for name, spoil in _CHECKPOINT.items()]
    found += [Case(f"gap: {name}", ("gap", "measurement", *_OUT), ("measurement",), spoil) for name, spoil in _measured().items()]
    return found


def _written(line: str) -> Change:
    """own.yaml: the site's with a line more before it, whose keys the site's do not repeat."""

    def change(folder: Path) -> None:
        site = yaml.safe_load((folder / SITE).read_text())
        site.pop(line.split(":")[0], None)
        (folder / "own.yaml").write_text(f"{line}\n{yaml.safe_dump(site)}", encoding="utf-8")

    return change
