"""Further bad inputs for all commands, of kinds that the other modules and the commands' own tests lack."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import yaml

from benchmarks.bad_inputs.case import PORT_IN_USE, Case
from benchmarks.bad_inputs.spoil import (
    GONE,
    NAN,
    Change,
    both,
    cut,
    instead,
    link,
    map_of,
    put,
    text,
)

SITE, CONFIG, TRUTH, FOUND = "site.yaml", "set.yaml", "truth.json", "found.json"
MAP = "run/difference_001.tif"


def _append(path: Path, more: str | bytes) -> None:
    path.write_bytes(path.read_bytes() + (more.encode() if isinstance(more, str) else more))


def _many(folder: Path) -> None:
    """truth.json with 20,000 images and annotations of none."""
    content = json.loads((folder / TRUTH).read_text())
    content["images"] += [{**content["images"][0], "id": 10 + k, "file_name": f"x{k}.tif"} for k in range(20_000)]
    (folder / TRUTH).write_text(json.dumps(content))


_EVALUATE: dict[str, Change] = {
    "20000 images": _many,
    "found is a run": lambda folder: shutil.copy(folder / TRUTH, folder / FOUND),
    "scores all 0": both(*[put(FOUND, **{f"annotations__{k}__score": 0.0}) for k in range(4)]),
    "scores all 1": both(*[put(FOUND, **{f"annotations__{k}__score": 1}) for k in range(4)]),
    "score 1e300": put(FOUND, annotations__0__score=1e300),
    "score a list": put(FOUND, annotations__0__score=[0.9]),
    "score null": put(FOUND, annotations__0__score=None),
    "categories twice": put(TRUTH, categories=[{"id": 1, "name": "a"}, {"id": 1, "name": "b"}]),
    "categories of markup": put(TRUTH, categories=[{"id": 1, "name": "<b>$x_{"}]),
    "category id text": put(TRUTH, categories=[{"id": "1", "name": "a"}]),
    "category id NaN": put(TRUTH, categories=[{"id": NAN, "name": "a"}]),
    "id 1e30": put(TRUTH, images__0__id=10**30, annotations__0__image_id=10**30, annotations__1__image_id=10**30),
    "id true": put(TRUTH, images__0__id=True),
    "annotation id 0": put(TRUTH, annotations__0__id=0),
    "annotation id 1e30": put(TRUTH, annotations__0__id=10**30),
    "width 1e5": put(TRUTH, images__0__width=100_000, images__0__height=100_000),
    "width -1": put(TRUTH, images__0__width=-1),
    "width NaN": put(TRUTH, images__0__width=NAN),
    "width 48.0": put(TRUTH, images__0__width=48.0),
    "file_name of markup": put(TRUTH, images__0__file_name="<script>$x_{.tif"),
    "file_name empty": put(TRUTH, images__0__file_name=""),
    "file_name null": put(TRUTH, images__0__file_name=None),
    "RLE of a million runs": put(TRUTH, annotations__0__segmentation=lambda: {"size": [32, 48], "counts": [1] * 1_000_000}),
    "RLE of no runs": put(TRUTH, annotations__0__segmentation={"size": [32, 48], "counts": []}),
    "RLE counts true": put(TRUTH, annotations__0__segmentation={"size": [32, 48], "counts": True}),
    "RLE counts 2^63": put(TRUTH, annotations__0__segmentation={"size": [32, 48], "counts": [2**63]}),
    "RLE size of 3": put(TRUTH, annotations__0__segmentation={"size": [32, 48, 1], "counts": [1536]}),
    "RLE size floats": put(TRUTH, annotations__0__segmentation={"size": [32.0, 48.0], "counts": [1536]}),
    "RLE with more keys": put(TRUTH, annotations__0__segmentation={"size": [32, 48], "counts": [1536], "x": 1}),
    "polygon of a million points": put(TRUTH, annotations__0__segmentation=lambda: [[float(k % 30) for k in range(1_000_000)]]),
    "polygon crossed": put(TRUTH, annotations__0__segmentation=[[4, 6, 14, 14, 14, 6, 4, 14]]),
    "polygon -5": put(TRUTH, annotations__0__segmentation=[[-5, -5, 14, 6, 14, 14]]),
    "polygon 1e9": put(TRUTH, annotations__0__segmentation=[[1e9, 6, 14, 6, 14, 14]]),
    "polygon true": put(TRUTH, annotations__0__segmentation=[[True, 6, 14, 6, 14, 14]]),
    "polygon null in it": put(TRUTH, annotations__0__segmentation=[[None, 6, 14, 6, 14, 14]]),
    "bbox of a list": put(TRUTH, annotations__0__bbox=[[1, 2, 3, 4]]),
    "bbox null": put(TRUTH, annotations__0__bbox=None),
    "bbox missing": put(TRUTH, annotations__0__bbox=GONE),
    "area 1e300": put(TRUTH, annotations__0__area=1e300),
    "area missing": put(TRUTH, annotations__0__area=GONE),
    "area -1": put(TRUTH, annotations__0__area=-1),
    "image_id null": put(TRUTH, annotations__0__image_id=None),
    "image_id 1.0": put(TRUTH, annotations__0__image_id=1.0),
    "image_id text": put(TRUTH, annotations__0__image_id="1"),
    "found image_id another": put(FOUND, annotations__0__image_id=2),
    "found id twice": put(FOUND, annotations__0__id=2),
    "found images empty": put(FOUND, images=[]),
    "found sizes differ": put(FOUND, images__0__width=10),
    "found annotations gone": put(FOUND, annotations=GONE),
    "found cut": cut(FOUND),
    "found in Latin 1": text(FOUND, b'{"images": [{"id": 1, "file_name": "\xf6"}]}'),
    "found of NaN": text(FOUND, "NaN"),
    "found of 20 MB of blanks": text(FOUND, " " * 20_000_000),
    "found is a folder": instead(FOUND, lambda path: path.mkdir()),
    "truth of repeated keys": text(TRUTH, '{"images": [], "images": 3, "annotations": [], "categories": []}'),
}  # fmt: skip


def _tiff(values: Any, **options: Any) -> Callable[[Path], object]:
    return lambda path: tifffile.imwrite(path, np.asarray(values), **options)


_GRID = np.random.default_rng(1).normal(0, 0.003, (100, 160))
_MAPS: dict[str, Callable[[Path], object]] = {
    "of bytes": _tiff((_GRID * 1000).astype(np.uint8)),
    "of whole numbers": _tiff((_GRID * 1000).astype(np.int16)),
    "of complex numbers": _tiff(_GRID.astype(np.complex64)),
    "in colour": _tiff(np.zeros((100, 160, 3), np.uint8), photometric="rgb"),
    "of three pages": _tiff(np.zeros((3, 100, 160), np.float32), photometric="minisblack"),
    "of 1000 pages": _tiff(np.zeros((1000, 8, 8), np.float32), photometric="minisblack"),
    "without georeference": _tiff(_GRID.astype(np.float32)),
    "of doubles": map_of(_GRID.astype(np.float64)),
    "in millimetres": map_of(_GRID * 1000),
    "of -9999": map_of(np.where(np.eye(100, 160) > 0, -9999.0, _GRID)),
    "of -9999 alone": map_of(np.full((100, 160), -9999.0)),
    "of a word for no data": _tiff(_GRID.astype(np.float32), extratags=[(42113, 2, 0, "none", False)]),
    "of -1e400 for no data": _tiff(_GRID.astype(np.float32), extratags=[(42113, 2, 0, "-1e400", False)]),
    "of doubles of 1e300": _tiff(_GRID * 1e300),
    "of half precision": _tiff(_GRID.astype(np.float16)),
    "of truth values": _tiff(_GRID > 0),
    "of no size": _tiff(np.zeros((0, 0), np.float32)),
    "of one column": map_of(np.zeros((100, 1))),
    "of 4 pixels": map_of([[0.001, 0.002], [0.003, NAN]]),
    "of 1e-30": map_of(_GRID * 1e-30),
    "of 1e30": map_of(_GRID * 1e30),
    "one block of 1 km": map_of(np.where(np.eye(100, 160) > 0, 1000.0, _GRID)),
}  # fmt: skip


def _site(**values: Any) -> Change:
    return put(SITE, **values)


_SITES: dict[str, Change] = {
    "seed text": _site(seed="a"),
    "seed -1": _site(seed=-1),
    "seed 1.5": _site(seed=1.5),
    "epochs 0": _site(epochs=0),
    "epochs true": _site(epochs=True),
    "wall null": _site(wall=None),
    "wall a list": _site(wall=[1]),
    "wall style unknown": _site(wall__style="<b>"),
    "wall 0 m": _site(wall__width_m=0),
    "wall 1 mm": _site(wall__width_m=0.001),
    "wall NaN": _site(wall__height_m=NAN),
    "blocks of NaN": _site(rockfall={"count": 4, "size_m": NAN}),
    "blocks of a list": _site(rockfall={"count": 4, "size_m": [0.1, 0.2]}),
    "blocks -1": _site(rockfall={"count": -1, "size_m": 0.5}),
    "blocks 5000 in a small wall": _site(rockfall={"count": 5000, "size_m": 0.5}),
    "blocks 0": _site(rockfall={"count": 0, "size_m": 0.5}),
    "scanner of no step": _site(scanner={}),
    "scanner range 0": _site(scanner={"azimuth_step_rad": 0.003, "zenith_step_rad": 0.003, "max_range_m": 0.0}),
    "station behind the wall": _site(station={"position_m": [0.0, 100.0, 0.0]}),
    "station in the wall": _site(station={"position_m": [0.0, 0.0, 2.5]}),
    "station height 1e300": _site(station={"distance_m": 20.0, "height_m": 1e300}),
    "station height NaN": _site(station={"distance_m": 20.0, "height_m": NAN}),
    "station both": _site(station={"distance_m": 20.0, "position_m": [0.0, -20.0, 2.0]}),
    "base 0": _site(cameras={"distance_m": 20.0, "base_m": 0.0}),
    "base 1e9": _site(cameras={"distance_m": 20.0, "base_m": 1e9}),
    "cameras distance 1e300": _site(cameras={"distance_m": 1e300, "base_m": 5.0}),
    "cameras 1 px": _site(cameras={"distance_m": 20.0, "base_m": 5.0, "width": 1, "height": 1}),
    "focal length 1e-9": _site(cameras={"distance_m": 20.0, "base_m": 5.0, "focal_length_m": 1e-9}),
    "gsd 10 m": _site(difference={"gsd_m": 10.0}),
    "gsd 0": _site(difference={"gsd_m": 0}),
    "icp 0": _site(icp={"max_iteration": 0}),
    "icp ratio 1e-9": _site(icp={"subsample_ratio": 1e-9}),
    "noise 1e300": _site(sensor=[{"sensor": "tls", "noise": {"range_sigma_m": 1e300}}]),
    "noise 1e3": _site(sensor=[{"sensor": "tls", "noise": {"range_sigma_m": 1e3}}]),
    "noise 1 rad": _site(sensor=[{"sensor": "tls", "noise": {"angle_sigma_rad": 1.0}}]),
    "effect twice": _site(sensor=[{"sensor": "tls", "effects": [{"name": "tls.range_offset", "offset_m": 0.1}] * 2}]),
    "effect null": _site(sensor=[{"sensor": "tls", "effects": [None]}]),
    "sensor null": _site(sensor=None),
    "sensor empty": _site(sensor=[]),
    "tiles 0": _site(tiles={"size_px": 0}),
    "name of markup": _site(wall__name="<script>$x_{"),
    "key of 1e5 letters": lambda folder: _append(folder / SITE, "\n" + "k" * 100_000 + ": 1\n"),
    "keys twice": lambda folder: _append(folder / SITE, "\nseed: 7\n"),
    "key a list": lambda folder: _append(folder / SITE, "\n? [1, 2]\n: 3\n"),
    "a date": _site(seed="2020-01-01"),
    "two documents": lambda folder: _append(folder / SITE, "\n---\nseed: 1\n"),
}  # fmt: skip
_SETS: dict[str, Change] = {
    "noise empty": put(CONFIG, noise={}),
    "noise null": put(CONFIG, noise__low=None),
    "noise of another sensor alone": put(CONFIG, noise__low__tls=GONE),
    "sizes empty": put(CONFIG, sizes={}),
    "sizes a list": put(CONFIG, sizes=[1]),
    "sizes backwards": put(CONFIG, sizes__large__rockfall__size_m={"kind": "uniform", "low": 0.6, "high": 0.4}),
    "sizes kind unknown": put(CONFIG, sizes__large__rockfall__size_m={"kind": "none", "low": 0.6, "high": 0.4}),
    "parts a mapping": put(CONFIG, parts={"a": 1}),
    "parts of an unknown size": put(CONFIG, parts__0__sizes=["none"]),
    "parts of an unknown noise": put(CONFIG, parts__0__noise=["none"]),
    "train -1": put(CONFIG, parts__0__train=-1),
    "train 1.5": put(CONFIG, parts__0__train=1.5),
    "train text": put(CONFIG, parts__0__train="one"),
    "only val": put(CONFIG, parts__0__train=0, parts__0__test=0),
    "wall name with a slash": lambda folder: _renamed(folder, "a/b"),
    "wall name of dots": lambda folder: _renamed(folder, ".."),
    "wall name of markup": lambda folder: _renamed(folder, "<b>$x_{"),
    "wall name empty": lambda folder: _renamed(folder, ""),
    "wall name a number": lambda folder: _renamed(folder, 7),
    "name null": put(CONFIG, name=None),
    "name of markup": put(CONFIG, name="<script>"),
    "name of control characters": put(CONFIG, name="\u001b[31m"),
    "sensors a word": put(CONFIG, sensors="tls"),
    "tiles negative": put(CONFIG, tiles__size_px=-1),
    "tiles share NaN": put(CONFIG, tiles__minimum_valid_share=NAN),
    "scale NaN": put(CONFIG, noise__low__tls__scale__ledge=NAN),
    "scale 1e6": put(CONFIG, noise__low__tls__scale__ledge=1e6),
    "model noise NaN": put(CONFIG, noise__low__tls__model={"sensor": "tls", "noise": {"range_sigma_m": NAN}}),
    "model of the other sensor": put(CONFIG, noise__low__tls__model={"sensor": "stereo"}),
    "density list": put(CONFIG, sizes__large__blocks_per_m2=[1, 2]),
    "density 1e4": put(CONFIG, sizes__large__blocks_per_m2=1e4),
    "station 1e300": put(CONFIG, walls__ledge__station={"distance_m": 1e300}),
}  # fmt: skip


def _renamed(folder: Path, name: object) -> None:
    values = yaml.safe_load((folder / CONFIG).read_text())
    values["walls"] = {name: values["walls"]["ledge"]}
    values["noise"]["low"]["tls"]["scale"] = {name: 2.0}
    values["parts"][0]["walls"] = [name]
    (folder / CONFIG).write_text(yaml.safe_dump(values))


_WORDS: dict[str, tuple[str, ...]] = {
    "ds: workers -1": ("dataset", CONFIG, "--workers", "-1"),
    "ds: workers 1.5": ("dataset", CONFIG, "--workers", "1.5"),
    "ds: workers 1e6 verify": ("dataset", "verify", "set", "--workers", "1000000"),
    "ds: out inside a set": ("dataset", CONFIG, "--out", "set/train"),
    "ds: out under a file": ("dataset", CONFIG, "--out", "site.yaml/out"),
    "ds: out a loop of links": ("dataset", CONFIG, "--out", "loop"),
    "ds: out closed": ("dataset", CONFIG, "--out", "/proc/out"),
    "ds: scheduler empty": ("dataset", CONFIG, "--scheduler", ""),
    "ds: scheduler of control characters": ("dataset", CONFIG, "--scheduler", "tcp://\u001b[31m:1"),
    "ds: split by of 1000": ("dataset", "split", "set", "--by", ",".join(["sensor"] * 1000), "--out", "parts"),
    "ds: merge with nothing": ("dataset", "merge", "set", "nowhere", "--out", "both"),
    "ds: verify a file": ("dataset", "verify", SITE),
    "ds: verify a loop": ("dataset", "verify", "loop"),
    "icp: epochs 0": ("icp-study", "run", "--epochs", "0"),
    "icp: epochs -1": ("icp-study", "run", "--epochs", "-1"),
    "icp: repeats 0": ("icp-study", "run", "--repeats", "0"),
    "icp: offset inf": ("icp-study", "run", "--offset-m", "inf"),
    "icp: offset text": ("icp-study", "run", "--offset-m", "far"),
    "icp: a set as run": ("icp-study", "set"),
    "icp: a loop": ("icp-study", "loop"),
    "icp: out in use": ("icp-study", "run", "--out", "set"),
    "icp: out under a file": ("icp-study", "run", "--out", "site.yaml/out"),
    "cmp: sizes text": ("compare", SITE, "--sizes-m", "a", "b"),
    "cmp: sizes alike": ("compare", SITE, "--sizes-m", "0.3", "0.3", "--epochs", "2"),
    "cmp: epochs 0": ("compare", SITE, "--epochs", "0"),
    "cmp: measured a loop": ("compare", SITE, "--measured", "loop", "--epochs", "2"),
    "cmp: measured a file": ("compare", SITE, "--measured", SITE, "--epochs", "2"),
    "cmp: a measurement": ("compare", "measurement"),
    "cmp: out in use": ("compare", SITE, "--epochs", "2", "--out", "set"),
    "cmp: out under a file": ("compare", SITE, "--epochs", "2", "--out", "site.yaml/out"),
    "cmp: a run twice": ("compare", "run", "run", "--epochs", "2"),
    "cmp: stations 3": ("compare", SITE, "--set", "station=[{distance_m: 20},{distance_m: 21}]", "--epochs", "2"),
    "cal: sensor unknown": ("calibrate", "run", "--sensor", "radar"),
    "cal: a loop": ("calibrate", "loop"),
    "cal: out in use": ("calibrate", "run", "--out", "set"),
    "cal: out under a file": ("calibrate", "run", "--out", "site.yaml/out"),
    "cal: config of a set": ("calibrate", MAP, "--sensor", "tls", "--config", CONFIG),
    "cal: 300 maps": ("calibrate", *[MAP] * 300, "--sensor", "tls", "--config", SITE),
    "view: port text": ("view", "run", "--port", "web", "--no-browser"),
    "view: port 1e9": ("view", "run", "--port", "1000000000", "--no-browser"),
    "view: port empty": ("view", "run", "--port", "", "--no-browser"),
    "view: a loop": ("view", "loop", "--port", str(PORT_IN_USE), "--no-browser"),
    "view: port of others": ("view", "run", "--port", "1", "--no-browser", "--detections", "nowhere"),
    "train: a run": ("train", "run"),
    "train: a loop": ("train", "loop"),
    "train: nothing": ("train", "nowhere"),
    "train: a file": ("train", SITE),
    "train: out in use": ("train", "set", "--out", "run"),
    "train: out is the set": ("train", "set", "--out", "set"),
    "train: out under a file": ("train", "set", "--out", "site.yaml/out"),
    "train: out a loop of links": ("train", "set", "--out", "loop"),
    "train: resume nothing": ("train", "set", "--resume"),
    "train: seed -1": ("train", "set", "--seed", "-1"),
    "train: --seed 1e30": ("train", "set", "--seed", "9" * 30),
    "train: set unknown": ("train", "set", "--set", "training.epoch=1"),
    "train: epochs 1e9": ("train", "set", "--set", "training.epochs=1000000000"),
    "train: epochs text": ("train", "set", "--set", "training.epochs=many"),
    "train: rate NaN": ("train", "set", "--set", "training.learning_rate=.nan"),
    "train: rate -1": ("train", "set", "--set", "training.learning_rate=-1"),
    "train: batch 0": ("train", "set", "--set", "training.batch=0"),
    "train: batch -1": ("train", "set", "--set", "training.batch=-1"),
    "train: image 0": ("train", "set", "--set", "detector.image_px=0"),
    "train: image 65": ("train", "set", "--set", "detector.image_px=65"),
    "train: config a loop": ("train", "set", "--config", "loop"),
    "det: nothing": ("detect", "baseline", "nowhere"),
    "det: a loop": ("detect", "baseline", "loop"),
    "det: a config": ("detect", "baseline", SITE),
    "det: a model unknown": ("detect", "nowhere", MAP),
    "det: a model is a file": ("detect", SITE, MAP),
    "det: a model is a loop": ("detect", "loop", MAP),
    "det: a model very long": ("detect", "a" * 5000, MAP),
    "det: a model is a run": ("detect", "run", MAP),
    "det: confidence 2": ("detect", "baseline", MAP, "--confidence", "2"),
    "det: confidence nan": ("detect", "baseline", MAP, "--confidence", "nan"),
    "det: confidence -1": ("detect", "baseline", MAP, "--confidence", "-1"),
    "det: confidence 1000 times": ("detect", "baseline", MAP, *["--confidence", "0.9"] * 1000),
    "det: a map twice": ("detect", "baseline", MAP, MAP),
    "det: a map 300 times": ("detect", "baseline", *[MAP] * 300),
    "det: out in use": ("detect", "baseline", MAP, "--out", "set"),
    "det: out under a file": ("detect", "baseline", MAP, "--out", "site.yaml/out"),
    "det: out is the run": ("detect", "baseline", MAP, "--out", "run"),
    "init: out there": ("init", "--out", SITE),
    "init: mesh gone": ("init", "--mesh", "none.ply", "--out", "new.yaml"),
    "init: mesh a loop": ("init", "--mesh", "loop", "--out", "new.yaml"),
    "init: mesh a config": ("init", "--mesh", SITE, "--out", "new.yaml"),
    "schema: unknown": ("schema", "nowhere"),
    "completion: unknown": ("completion", "nowhere"),
    "ev: a folder twice": ("evaluate", "set/test", "set/test"),
    "ev: a set": ("evaluate", "set", FOUND),
    "ev: out under a file": ("evaluate", TRUTH, FOUND, "--out", "site.yaml/out"),
    "ev: out a loop of links": ("evaluate", TRUTH, FOUND, "--out", "loop"),
    "ev: confidence 1000 times": ("evaluate", TRUTH, FOUND, *["--confidence", "0.9"] * 1000),
    "ev: by 100 times": ("evaluate", TRUTH, FOUND, *["--by", "noise"] * 100),
    "ev: by id": ("evaluate", TRUTH, FOUND, "--by", "id"),
    "ev: by markup": ("evaluate", TRUTH, FOUND, "--by", "<b>$x_{"),
}  # fmt: skip


def cases() -> list[Case]:
    out = ("--out", "out", "--quiet")
    by = ("--by", "noise", "--out", "out")
    found = [Case(f"ev: {name}", ("evaluate", TRUTH, FOUND, *by), (TRUTH, FOUND), spoil) for name, spoil in _EVALUATE.items()]
    for name, spoil in _SITES.items():
        found.append(Case(f"sim: {name}", ("simulate", "--sensor", "tls", "--config", SITE, *out), (SITE,), spoil))
        if name.startswith(("cameras", "base", "distance", "focal", "blocks", "noise", "station")):
            found.append(Case(f"inspect: {name}", ("inspect", SITE, *out), (SITE,), spoil))
        if name.startswith(("blocks", "noise", "wall", "seed", "name")):
            found.append(Case(f"cmp: {name}", ("compare", SITE, "--epochs", "2", *out), (SITE,), spoil))
        if name.startswith(("icp", "blocks", "noise")):
            found.append(Case(f"icp: {name}", ("icp-study", SITE, "--sensor", "tls", "--epochs", "2", *out), (SITE,), spoil))
    found += [Case(f"ds: {name}", ("dataset", CONFIG, *out), (CONFIG,), spoil) for name, spoil in _SETS.items()]
    for name, make in _MAPS.items():
        spoil = instead(MAP, make)
        words = ("calibrate", MAP, "run/difference_002.tif", "--sensor", "tls", "--config", SITE)
        found.append(Case(f"cal: map {name}", (*words, *out), ("run", SITE), spoil))
        found.append(Case(f"det: map {name}", ("detect", "baseline", MAP, *out), ("run",), spoil))
        found.append(Case(f"view: map {name}", ("view", "run", "--no-browser", "--port", str(PORT_IN_USE)), ("run",), spoil))
    needs = (SITE, CONFIG, "run", "set", "measurement", TRUTH, FOUND)
    loop = instead("loop", link("loop"))
    for name, words in _WORDS.items():
        no_out = "--out" in words or words[0] in ("view", "schema", "completion") or "verify" in words
        quiet = () if words[0] in ("view", "schema", "completion", "init", "evaluate") else ("--quiet",)
        found.append(Case(name, (*words, *(() if no_out else ("--out", "out")), *quiet), needs, loop))
    return found
