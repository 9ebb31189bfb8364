"""Bad inputs drawn at random: for each command good arguments and files, some of which are damaged.

`drawn` gives a case of a command to hypothesis. tests/test_fuzz_commands.py tries 25 of each command up to where its work begins,
`python benchmarks/fuzz.py` 500, and `python benchmarks/fuzz.py --through` runs some to their end.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from hypothesis import strategies as st

from benchmarks.bad_inputs.case import PORT_IN_USE, Case
from benchmarks.bad_inputs.spoil import Change, both, instead, link, pipe, text, write_mesh
from pipeline.dataset.records import _digest, _text
from pipeline.formats.meshes.ply import read_ply
from pipeline.formats.points.points import read_points
from scene.common.errors import InputError

Draw = Callable[[st.SearchStrategy[Any]], Any]
SITE, SET, RUN = "site.yaml", "set.yaml", "run/run.json"
TRUTH, FOUND, MAP = "truth.json", "found.json", "run/difference_001.tif"
_OUT = ("--out", "out", "--quiet")


@dataclass(frozen=True)
class SetUp:
    """A good call. words: after the command's name; needs: materials; files: those of them that it reads."""

    words: tuple[str, ...]
    needs: tuple[str, ...] = ()
    files: tuple[str, ...] = ()


def _site(*words: str) -> SetUp:
    return SetUp((*words, *_OUT), (SITE,), (SITE,))


_MEASUREMENT = ("measurement.yaml", "model.yaml", "scan.ply", "wall.ply")
_PAIR = ("measurement.yaml", "model.yaml", "cameras.yaml", "surface.xyz", "wall.ply")
_SURFACES = tuple(f"run/epoch_{number:03d}/{name}.ply" for number in (0, 1) for name in ("surface", "truth"))
_RAW = ("raw/scan.ply", "raw/wall.ply")
_RAW_WORDS = ("raw/scan.ply", "--reference", "raw/wall.ply", "--scanner", "riegl_vz400i", "--position", "0,0,0")
_OUT_PNG = ("--out", "out.png", "--quiet")
_VIEW = ("--no-browser", "--port", str(PORT_IN_USE))
_ANNOTATIONS = ("set/train/annotations.json", "set/val/annotations.json")
_WHOLE_SET = ("set/dataset.json", "set/checksums.sha256", *_ANNOTATIONS)
SET_UPS: dict[str, tuple[SetUp, ...]] = {
    "simulate": (
        _site("--sensor", "tls", "--config", SITE),
        _site("--sensor", "stereo", "--config", SITE),
        SetUp(("--sensor", "tls", "--config", SITE, "--resume", "--out", "run", "--quiet"), (SITE, "run"), (RUN, SITE, MAP)),
    ),
    "inspect": (_site(SITE),),
    "compare": (
        _site(SITE, "--epochs", "1"),
        SetUp((SITE, "--epochs", "1", "--measured", "run", *_OUT), (SITE, "run"), (SITE, RUN, MAP)),
        SetUp(("run", "riegl_vz400i", "--epochs", "1", *_OUT), ("run",), (RUN,)),
    ),
    "icp-study": (SetUp(("run", "--repeats", "1", *_OUT), ("run",), (RUN, *_SURFACES)), _site(SITE, "--sensor", "tls")),
    "calibrate": (
        SetUp(("run", "--no-greedy", *_OUT), ("run",), (RUN, MAP)),
        SetUp((MAP, "--no-greedy", "--sensor", "tls", "--config", SITE, *_OUT), (SITE, "run"), (SITE, MAP)),
        SetUp(("measurement", "--no-greedy", *_OUT), ("measurement",), tuple(f"measurement/{name}" for name in _MEASUREMENT)),
    ),
    "dataset": (
        SetUp((SET, *_OUT), (SET,), (SET,)),
        SetUp(("verify", "set", "--quiet"), ("set",), _WHOLE_SET),
        SetUp(("verify", "set", "--report-only", "--quiet"), ("set",), _WHOLE_SET),
        SetUp(("split", "set", "--by", "sensor", *_OUT), ("set",), _WHOLE_SET),
        SetUp(("merge", "set", "set", *_OUT), ("set",), _WHOLE_SET),
    ),
    "measurement": (
        SetUp((*_RAW_WORDS, *_OUT), ("raw",), _RAW),
        SetUp(
            ("pair/surface.xyz", "--reference", "pair/wall.ply", "--cameras", "pair/cameras.yaml", *_OUT),
            ("pair",),
            ("pair/surface.xyz", "pair/wall.ply", "pair/cameras.yaml"),
        ),
    ),
    "monitor": (
        SetUp(("run", *_OUT), ("run",), (RUN,)),
        SetUp(("raw/scan.ply", "measurement/scan.ply", "--position", "0,0,0", *_OUT), ("raw", "measurement"), _RAW[:1]),
    ),
    "gap": (
        SetUp(("measurement", *_OUT), ("measurement",), tuple(f"measurement/{name}" for name in _MEASUREMENT)),
        SetUp(("pair", *_OUT), ("pair",), tuple(f"pair/{name}" for name in _PAIR)),
        _site(SITE, "--identifiability", "--sensor", "tls"),
    ),
    "train": (SetUp(("set", *_OUT), ("set",), _ANNOTATIONS),),
    "detect": (
        SetUp(("baseline", MAP, *_OUT), ("run",), (MAP,)),
        SetUp(("baseline", "set/train", *_OUT), ("set",), _ANNOTATIONS[:1]),
        SetUp(("detector", MAP, *_OUT), ("detector", "run"), ("detector/detector.yaml", "detector/model.weights.h5", MAP)),
    ),
    "evaluate": (SetUp((TRUTH, FOUND, "--by", "noise", "--out", "out"), (TRUTH, FOUND), (TRUTH, FOUND)),),
    "view": (
        SetUp(("run", *_VIEW), ("run",), (RUN, MAP)),
        SetUp(("run", "--detections", "events", *_VIEW), ("run", "events"), (RUN, "events/events_0.9.csv")),
        SetUp(("diagnosis", *_VIEW), ("diagnosis",), ("diagnosis/gap.json", "diagnosis/before.laz", "diagnosis/after.laz")),
        SetUp(("set/train", *_VIEW), ("set",), _ANNOTATIONS[:1]),
    ),
    "export": (
        SetUp(("run", "picture", *_OUT_PNG), ("run",), (RUN, MAP)),
        SetUp(("run", "gltf", "--out", "out.glb", "--quiet"), ("run",), (RUN, MAP, *_SURFACES)),
        SetUp(("set", "yolo", *_OUT), ("set",), _WHOLE_SET),
        SetUp(("run", "package", "--out", "out.json", "--quiet"), ("run",), (RUN, MAP)),
    ),
    "surface": (SetUp(("raw/scan.ply", "--seen-from", "0", "0", "0", "--out", "out.ply", "--quiet"), ("raw",), _RAW[:1]),),
    "init": (SetUp(("--mesh", "raw/wall.ply", "--out", "new.yaml"), ("raw",), _RAW[1:]),),
    "schema": (SetUp(("model",)),),
    "completion": (SetUp(("bash",)),),
    "doctor": (SetUp(("stray",)),),
}  # fmt: skip
_ODD_WORDS = (
    *("", " ", "nan", "-1", "inf", "1e300", "9" * 30, "9" * 5000, "0x10", "1,5", "1_0", "x", "a" * 5000, "-", "--", "None"),
    *("null", "true", "[1]", "a=b", "a=", "=b", ".", "run", "set", SITE, SET, TRUTH, MAP, "loop", "pipe", "nowhere", "/dev/zero"),
    *("<b>$x_{", "\u0663", "\udcf6", "\x1b[31m", "two\nlines", "site.yaml/x", "../../nowhere/x", "wall.width_m=nan", "seed=.inf"),
    *("seed=" + "9" * 30, "seed=&a [*a]", "wall=!!set {}", "epochs=1e9", "rockfall.count=1e12"),
)
_QUIET_OPTIONS = ("--help", "--debug", "--port", "--workers", "--scheduler", "--threads")
"""Options that are not drawn: help texts and tracebacks are correct responses; the others start processes, which have their own
tests.
"""
_FACTORS = (0.0, -1.0, 1e-300, 1e-9, 1e3, 1e9, 1e30, 1e300, math.nan, math.inf)
ODD_VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.sampled_from(
        [0, -1, 1e-300, 1e308, math.nan, math.inf, 10**30, 10**400, "", "x", "../..", "\0", "\ud800", "<b>$x_{", [], {}]
    ),
    st.floats(),
    st.text(max_size=8),
    st.lists(st.floats(), max_size=7),
    st.lists(st.lists(st.floats(), max_size=4), max_size=4),
    st.dictionaries(st.text(max_size=4), st.integers(), max_size=2),
)


def drawn(draw: Draw, command: str, good: Path) -> Case:
    """Draw a case of the command; good: folder of the materials."""
    set_up: SetUp = draw(st.sampled_from(SET_UPS[command]))
    what = draw(st.sampled_from(["words", "file", "file", "both"])) if set_up.files else "words"
    words, spoils = set_up.words, [_beside]
    if what != "file":
        words = _spoilt_words(draw, command, words)
    if what != "words":
        spoils.append(_spoilt_file(draw, draw(st.sampled_from(set_up.files)), good))
    codes = (0, 1, 2) if "--report-only" in words else (0, 2)
    return Case(f"drawn: {command}", (command, *words), set_up.needs, both(*spoils), codes)


def _beside(folder: Path) -> None:
    """Create what odd arguments may name: a loop of links and a pipe."""
    instead("loop", link("loop"))(folder)
    instead("pipe", pipe)(folder)


def _spoilt_words(draw: Draw, command: str, words: tuple[str, ...]) -> tuple[str, ...]:
    match draw(st.sampled_from(["other", "other", "gone", "twice", "unknown", "option", "option", "option"])):
        case "other":
            at = draw(st.integers(0, len(words) - 1))
            kept = words[at] in (str(PORT_IN_USE), "--port")  # a page at another port would stay
            return words if kept else (*words[:at], draw(st.sampled_from(_ODD_WORDS)), *words[at + 1 :])
        case "gone":
            at = draw(st.integers(0, len(words) - 1))
            return words if words[at] in (str(PORT_IN_USE), "--port") else words[:at] + words[at + 1 :]
        case "twice":
            at = draw(st.integers(0, len(words) - 1))
            return (*words[:at], words[at], *words[at:])
        case "unknown":
            return (draw(st.sampled_from(["--nothing", "--seeed", "-x", "--out-put", "--Set", "--\u00e9"])), *words)
    option, count = draw(st.sampled_from(_options(command)))
    values = [draw(st.sampled_from(_ODD_WORDS)) for _ in range(count if draw(st.booleans()) else draw(st.integers(0, 3)))]
    joined = draw(st.booleans()) and len(values) == 1
    given = (f"{option}={values[0]}",) if joined else (option, *values)
    return (*words, *given) if draw(st.booleans()) and command != "view" else (*given, *words)


def _options(command: str) -> list[tuple[str, int]]:
    """Return the options of a command's parser, with their numbers of values."""
    from pipeline.cli.main import COMMANDS, command_parser

    actions: list[argparse.Action] = command_parser(command, COMMANDS[command])._actions
    found = []
    for action in actions:
        for option in action.option_strings:
            count = action.nargs if isinstance(action.nargs, int) else 1
            found += [] if option in (*_QUIET_OPTIONS, "-h") else [(option, count)]
    return found or [("--json", 1)]


def _spoilt_file(draw: Draw, name: str, good: Path) -> Change:
    kind = draw(st.sampled_from(["odd", "odd", "odd", "bytes", "bytes", "replaced"]))
    if kind == "replaced":
        return _replaced(draw, name)
    suffix = Path(name).suffix
    if kind == "odd" and suffix in (".json", ".yaml"):
        return _odd_value(draw, name, good)
    if kind == "odd" and suffix in (".ply", ".xyz"):
        return _odd_coordinates(draw, name)
    if kind == "odd" and suffix == ".tif":
        return _odd_map(draw, name)
    return _odd_bytes(draw, name, (good / name).stat().st_size)


def _replaced(draw: Draw, name: str) -> Change:
    others = {
        "gone": lambda path: None,
        "pipe": pipe,
        "folder": lambda path: path.mkdir(),
        "loop": link(Path(name).name),
        "zero": link("/dev/zero"),
        "empty": lambda path: path.write_bytes(b""),
        "binary": lambda path: path.write_bytes(bytes(range(256)) * 20),
        "page": lambda path: path.write_text("<!DOCTYPE html><html><body>404</body></html>\n" * 9),
        "sparse": lambda path: (path.touch(), os.truncate(path, 60_000_000_000)),
        "nested": lambda path: path.write_text("[" * 100_000),
        "blanks": lambda path: path.write_text(" " * 1_000_000),
    }
    return instead(name, others[draw(st.sampled_from(sorted(others)))])


def places(values: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path to every value in nested mappings and lists."""
    for key, value in values.items() if isinstance(values, dict) else enumerate(values):
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))


def _odd_value(draw: Draw, name: str, good: Path) -> Change:
    """Draw a change of the file: a value of another type or size, or a key missing or added."""
    content = (good / name).read_text()
    values = yaml.safe_load(content) if name.endswith(".yaml") else json.loads(content)
    values = copy.deepcopy(values)
    path = draw(st.sampled_from(sorted(places(values), key=lambda each: (len(each), str(each)))))
    holder = values
    for key in path[:-1]:
        holder = holder[key]
    old = holder[path[-1]]
    match draw(st.sampled_from(["other", "other", "size", "gone", "more", "whole"])):
        case "size" if isinstance(old, int | float) and not isinstance(old, bool):
            holder[path[-1]] = old * draw(st.sampled_from(_FACTORS))
        case "gone":
            del holder[path[-1]]
        case "more" if isinstance(old, list):
            holder[path[-1]] = old * draw(st.sampled_from([2, 1000]))
        case "more" if isinstance(holder, dict):
            holder[draw(st.text(max_size=5))] = draw(ODD_VALUES)
        case "whole":
            values = draw(ODD_VALUES)
        case _:
            holder[path[-1]] = draw(ODD_VALUES)
    return text(name, _dumped(name, values))


def _dumped(name: str, values: Any) -> bytes:
    if name.endswith("dataset.json") and isinstance(values, dict):
        values.pop("sha256", None)
        with suppress(ValueError, TypeError):  # NaN and infinity have no place in the checksum's text
            values = {**values, "sha256": _digest(_text(values))}
    dumped = yaml.safe_dump(values, allow_unicode=True) if name.endswith(".yaml") else json.dumps(values)
    return dumped.encode(errors="surrogatepass")


def _odd_coordinates(draw: Draw, name: str) -> Change:
    """Draw a change of points or vertices: scaled, shifted, subsampled, partly odd, or reordered."""
    kind = draw(st.sampled_from(["scale", "axis", "shift", "few", "some", "one place", "shuffled"]))
    factor, axis = draw(st.sampled_from(_FACTORS)), draw(st.integers(0, 2))
    count = draw(st.integers(0, 60))

    def move(found: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        found = found.copy()
        with np.errstate(all="ignore"):
            match kind:
                case "scale":
                    found *= factor
                case "axis":
                    found[:, axis] *= factor
                case "shift":
                    found[:, axis] += factor
                case "some":
                    found[:: count + 1, axis] = factor
                case "one place":
                    found[:] = found[:1]
                case "shuffled":
                    found = np.random.default_rng(count).permutation(found)
                case "few":
                    found = found[:count]
        return found

    def change(folder: Path) -> None:
        if name.endswith(".xyz"):
            np.savetxt(folder / name, move(read_points(folder / name).points), fmt="%.17g")
            return
        try:
            found = read_ply(folder / name)
            vertices, faces = move(found.vertices), found.faces
        except InputError:  # a cloud
            vertices, faces = move(read_points(folder / name).points), np.empty((0, 3), int)
        write_mesh(folder / name, vertices, faces)

    return change


def _odd_map(draw: Draw, name: str) -> Change:
    from pipeline.formats.rasters.geotiff import read_geotiff, write_geotiff
    from scene.geometry.grid import Grid

    kind, factor = draw(st.sampled_from(["scale", "some", "all", "cut"])), draw(st.sampled_from(_FACTORS))
    step = draw(st.integers(1, 60))

    def change(folder: Path) -> None:
        values, grid = read_geotiff(folder / name)
        with np.errstate(all="ignore"):
            values = values * np.float32(factor) if kind == "scale" else values.copy()
            if kind == "some":
                values[::step] = factor
            if kind == "all":
                values[:] = factor
        values = values[:step, :step] if kind == "cut" else values
        write_geotiff(folder / name, values, Grid(grid.x_min, grid.y_max, grid.gsd, values.shape[1], values.shape[0]))

    return change


def _odd_bytes(draw: Draw, name: str, size: int) -> Change:
    """Draw a change of the file's bytes: cut, changed, inserted or zeroed, more often near its beginning."""
    at = draw(st.integers(0, max(size - 1, 0)) | st.integers(0, max(min(size, 400) - 1, 0)))
    kind, new = draw(st.sampled_from(["cut", "change", "insert", "zero", "twice"])), draw(st.binary(min_size=1, max_size=8))

    def change(folder: Path) -> None:
        whole = (folder / name).read_bytes()
        pieces = {
            "cut": whole[:at],
            "change": whole[:at] + new + whole[at + len(new) :],
            "insert": whole[:at] + new + whole[at:],
            "zero": whole[:at] + bytes(16) + whole[at + 16 :],
            "twice": whole + whole,
        }
        (folder / name).write_bytes(pieces[kind])

    return change
