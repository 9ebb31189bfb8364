"""Bad inputs for `evaluate`, `detect` and `train`: COCO files, maps, detectors and data sets."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bad_inputs.case import Case
from benchmarks.bad_inputs.spoil import (
    GONE,
    INFINITE,
    NAN,
    Change,
    both,
    claiming_tiff,
    cut,
    gone,
    instead,
    link,
    map_of,
    merge_bomb,
    pipe,
    put,
    text,
    whole,
)

TRUTH, FOUND = "truth.json", "found.json"
_SQUARE = [[4, 6, 14, 6, 14, 14, 4, 14]]
_RLE = {"size": [32, 48], "counts": [100, 8, 1428]}


def _shape(value: Any, file: str = TRUTH) -> Change:
    return put(file, annotations__0__segmentation=value)


_EVALUATE: dict[str, Change] = {
    "truth no annotations key": put(TRUTH, annotations=GONE),
    "truth no images key": put(TRUTH, images=GONE),
    "truth no categories key": put(TRUTH, categories=GONE),
    "truth categories empty": put(TRUTH, categories=[]),
    "truth images empty": put(TRUTH, images=[]),
    "truth annotations empty": put(TRUTH, annotations=[]),
    "truth annotations a mapping": put(TRUTH, annotations={"a": 1}),
    "truth a list": whole(TRUTH, []),
    "truth a number": whole(TRUTH, 3),
    "truth null": whole(TRUTH, None),
    "truth empty": text(TRUTH, ""),
    "truth cut": cut(TRUTH),
    "truth binary": text(TRUTH, bytes(range(256))),
    "truth nested": text(TRUTH, "[" * 1_000_000),
    "truth huge number": text(TRUTH, '{"images": [{"id": ' + "1" * 5000 + "}]}"),
    "truth is a pipe": instead(TRUTH, pipe),
    "truth is /dev/zero": instead(TRUTH, link("/dev/zero")),
    "truth is a loop of links": instead(TRUTH, link(TRUTH)),
    "truth is an empty folder": instead(TRUTH, lambda path: path.mkdir()),
    "truth in UTF-16": text(TRUTH, "{}".encode("utf-16")),
    "truth images w/o id": put(TRUTH, images__0__id=GONE),
    "truth images id text": put(TRUTH, images__0__id="1"),
    "truth images id float": put(TRUTH, images__0__id=1.5),
    "truth images id null": put(TRUTH, images__0__id=None),
    "truth images id negative": put(TRUTH, images__0__id=-1),
    "truth images id twice": put(TRUTH, images__0__id=2),
    "truth images width text": put(TRUTH, images__0__width="48"),
    "truth images width 0": put(TRUTH, images__0__width=0),
    "truth images width 1e9": put(TRUTH, images__0__width=10**9, images__0__height=10**9),
    "truth images width missing": put(TRUTH, images__0__width=GONE),
    "truth images w/o file_name": put(TRUTH, images__0__file_name=GONE),
    "truth images file_name a list": put(TRUTH, images__0__file_name=["a"]),
    "truth images file_name twice": put(TRUTH, images__0__file_name="1.tif"),
    "truth image a list": put(TRUTH, images__0=[1]),
    "truth annotation a list": put(TRUTH, annotations__0=[1]),
    "truth annotation id missing": put(TRUTH, annotations__0__id=GONE),
    "truth annotation id twice": put(TRUTH, annotations__0__id=2),
    "truth annotation id a list": put(TRUTH, annotations__0__id=[1]),
    "truth annotation image_id missing": put(TRUTH, annotations__0__image_id=GONE),
    "truth annotation image_id unknown": put(TRUTH, annotations__0__image_id=99),
    "truth annotation image_id a list": put(TRUTH, annotations__0__image_id=[1]),
    "truth category missing": put(TRUTH, annotations__0__category_id=GONE),
    "truth category unknown": put(TRUTH, annotations__0__category_id=7),
    "truth polygon odd": _shape([[4, 6, 14, 6, 14, 14, 4]]),
    "truth polygon 2 points": _shape([[4, 6, 14, 6]]),
    "truth polygon good": _shape(_SQUARE),
    "truth polygon of 100000 parts": _shape(lambda: [[4 + k / 100, 6, 14, 6, 14, 14] for k in range(100_000)]),
    "truth polygon outside": _shape([[400, 600, 1400, 600, 1400, 1400]]),
    "truth polygon 1e300": _shape([[1e300, 6, 14, 6, 14, 14]]),
    "truth polygon words": _shape([["a", "b", "c", "d", "e", "f"]]),
    "truth polygon nested": _shape([[[4, 6], [14, 6], [14, 14]]]),
    "polygon NaN": _shape([[NAN, 6, 14, 6, 14, 14]]),
    "polygon empty": _shape([]),
    "polygon empty part": _shape([[]]),
    "polygon of no area": _shape([[4, 6, 4, 6, 4, 6]]),
    "segmentation missing": put(TRUTH, annotations__0__segmentation=GONE),
    "segmentation null": _shape(None),
    "segmentation text": _shape("abc"),
    "segmentation number": _shape(7),
    "RLE good, uncompressed": _shape(_RLE),
    "RLE size 1e6x1e6": _shape({"size": [10**6, 10**6], "counts": [1]}),
    "RLE size text": _shape({"size": "32x48", "counts": [1536]}),
    "RLE size of another image": _shape({"size": [48, 32], "counts": [1536]}),
    "RLE size negative": _shape({"size": [-32, 48], "counts": [1536]}),
    "RLE counts missing": _shape({"size": [32, 48]}),
    "RLE counts null": _shape({"size": [32, 48], "counts": None}),
    "RLE counts garbage": _shape({"size": [32, 48], "counts": "garbage!~~~~~~~"}),
    "RLE counts negative": _shape({"size": [32, 48], "counts": [-5, 1541]}),
    "RLE counts too many": _shape({"size": [32, 48], "counts": [10**9]}),
    "RLE counts float": _shape({"size": [32, 48], "counts": [1.5, 1534.5]}),
    "RLE counts empty": _shape({"size": [32, 48], "counts": ""}),
    "RLE counts not ASCII": _shape({"size": [32, 48], "counts": "\u00e4\u4e00"}),
    "bbox 3 numbers": put(TRUTH, annotations__0__bbox=[1, 2, 3]),
    "bbox text": put(TRUTH, annotations__0__bbox="1 2 3 4"),
    "bbox NaN": put(TRUTH, annotations__0__bbox=[NAN, 2, 3, 4]),
    "bbox negative": put(TRUTH, annotations__0__bbox=[4, 6, -10, 8]),
    "bbox 1e300": put(TRUTH, annotations__0__bbox=[1e300, 6, 10, 8]),
    "area text": put(TRUTH, annotations__0__area="80"),
    "area a list": put(TRUTH, annotations__0__area=[80]),
    "area NaN": put(TRUTH, annotations__0__area=NAN),
    "iscrowd 7": put(TRUTH, annotations__0__iscrowd=7),
    "iscrowd 1": put(TRUTH, annotations__0__iscrowd=1),
    "pred score text": put(FOUND, annotations__0__score="0.9"),
    "pred score NaN": put(FOUND, annotations__0__score=NAN),
    "pred score infinite": put(FOUND, annotations__0__score=INFINITE),
    "pred score 7": put(FOUND, annotations__0__score=7),
    "pred score missing": put(FOUND, annotations__0__score=GONE),
    "pred score true": put(FOUND, annotations__0__score=True),
    "pred mixed unknown ids": put(FOUND, annotations__0__image_id=99, annotations__1__image_id="x"),
    "pred no segmentation": put(FOUND, annotations__0__segmentation=GONE),
    "pred annotations w/o file_name": put(FOUND, images__0__file_name=GONE),
    "pred other file names": put(FOUND, images__0__file_name="other.tif"),
    "pred images missing": put(FOUND, images=GONE),
    "pred category unknown": put(FOUND, annotations__0__category_id=9),
    "pred empty": put(FOUND, annotations=[]),
    "pred a plain list": lambda folder: _plain(folder),
    "pred a list of lists": whole(FOUND, [[1]]),
    "pred a list of numbers": whole(FOUND, [1, 2]),
    "pred a word": whole(FOUND, "none"),
    "pred the truth": lambda folder: shutil.copy(folder / TRUTH, folder / FOUND),
    "pred RLE of another size": _shape({"size": [48, 32], "counts": [1536]}, FOUND),
    "pred RLE garbage": _shape({"size": [32, 48], "counts": "zzzzzz"}, FOUND),
    "pred is a pipe": instead(FOUND, pipe),
    "--by unhashable": both(put(TRUTH, images__0__noise=["low"]), put(TRUTH, images__1__noise=["low"])),
    "--by NaN": put(TRUTH, images__0__noise=NAN),
    "--by a mapping": put(TRUTH, images__0__noise={"a": 1}),
    "--by missing in one": put(TRUTH, images__0__noise=GONE),
    "--by markup and control characters": put(TRUTH, images__0__noise="<b>\u001b[31m\n"),
}  # fmt: skip


def _plain(folder: Path) -> None:
    content = json.loads((folder / FOUND).read_text())["annotations"]
    (folder / FOUND).write_text(json.dumps(content))


_WORDS: dict[str, tuple[str, ...]] = {
    "--by unknown": (TRUTH, FOUND, "--by", "none"),
    "--confidence nan": (TRUTH, FOUND, "--confidence", "nan"),
    "--confidence 0": (TRUTH, FOUND, "--confidence", "0"),
    "--confidence inf": (TRUTH, FOUND, "--confidence", "inf"),
    "--confidence text": (TRUTH, FOUND, "--confidence", "high"),
    "--iou other": (TRUTH, FOUND, "--iou", "volume"),
    "--iou bbox": (TRUTH, FOUND, "--iou", "bbox"),
    "--out is a file": (TRUTH, FOUND, "--out", "truth.json"),
    "--out very long": (TRUTH, FOUND, "--out", "a" * 3000),
    "no such truth": ("none.json", FOUND),
    "no such pred": (TRUTH, "none.json"),
    "a very long name": ("a" * 5000, FOUND),
    "a folder without annotations": (".", FOUND),
}
_HOLES = np.where(np.random.default_rng(1).uniform(size=(40, 50)) > 0.5, 0.01, NAN)
_MAPS: dict[str, Change] = {
    "tiff bomb 3.6 GB in small file": instead("map.tif", claiming_tiff),
    "tiff bomb 300 MP": instead("map.tif", lambda path: claiming_tiff(path, 20_000, 15_000)),
    "tiff claims 4e9 x 4e9": instead("map.tif", lambda path: claiming_tiff(path, 2**32 - 1, 2**32 - 1)),
    "tiff empty": text("map.tif", b""),
    "tiff garbage": text("map.tif", bytes(range(256)) * 10),
    "tiff cut": both(instead("map.tif", map_of(_HOLES)), cut("map.tif")),
    "tiff is a pipe": instead("map.tif", pipe),
    "tiff is /dev/zero": instead("map.tif", link("/dev/zero")),
    "tiff is a loop of links": instead("map.tif", link("map.tif")),
    "tiff is a folder": instead("map.tif", lambda path: path.mkdir()),
    "tiff of text": text("map.tif", "not a map"),
    "map all NaN": instead("map.tif", map_of(np.full((40, 50), NAN))),
    "map one pixel": instead("map.tif", map_of([[0.1]])),
    "map one row": instead("map.tif", map_of(np.zeros((1, 2000)))),
    "map all 0": instead("map.tif", map_of(np.zeros((40, 50)))),
    "map infinite": instead("map.tif", map_of(np.full((40, 50), INFINITE))),
    "map one infinite": instead("map.tif", map_of(np.where(np.eye(40, 50), INFINITE, 0.01))),
    "map 1e38": instead("map.tif", map_of(np.full((40, 50), 1e38))),
    "map half NaN": instead("map.tif", map_of(_HOLES)),
}  # fmt: skip
_TRAIN = "set/train/annotations.json"
_FOLDERS: dict[str, Change] = {
    "coco unhashable id": put(_TRAIN, images__0__id=[1]),
    "coco annotation w/o image_id": put(_TRAIN, annotations__0__image_id=GONE),
    "coco file_name outside": put(_TRAIN, images__0__file_name="../../../etc/passwd"),
    "coco file_name absolute": put(_TRAIN, images__0__file_name="/etc/passwd"),
    "coco file_name a number": put(_TRAIN, images__0__file_name=7),
    "coco file_name with a null character": put(_TRAIN, images__0__file_name="a\0b.tif"),
    "coco file_name very long": put(_TRAIN, images__0__file_name="a" * 5000 + ".tif"),
    "coco file gone": put(_TRAIN, images__0__file_name="gone.tif"),
    "coco images a mapping": put(_TRAIN, images={"a": 1}),
    "coco width of another map": put(_TRAIN, images__0__width=7),
    "coco a list": whole(_TRAIN, []),
    "coco is a pipe": instead(_TRAIN, pipe),
}  # fmt: skip
_DETECTOR: dict[str, Change] = {
    "detector.yaml unknown backbone": put("detector/detector.yaml", backbone="vgg"),
    "detector.yaml another backbone": put("detector/detector.yaml", backbone="light"),
    "detector.yaml image 1e9": put("detector/detector.yaml", image_px=64 * 10**7),
    "detector.yaml channels 1e9": put("detector/detector.yaml", pyramid_channels=8 * 10**8),
    "detector.yaml hidden 1e9": put("detector/detector.yaml", head__hidden_units=10**9),
    "detector.yaml proposals 1e9": put("detector/detector.yaml", proposal__proposals=10**9, proposal__candidates=10**9),
    "detector.yaml 10000 ratios": put("detector/detector.yaml", proposal__anchor_ratios=[1.0] * 10_000),
    "detector.yaml anchors negative": put("detector/detector.yaml", proposal__anchor_sizes_px=[-1.0] * 5),
    "detector.yaml anchors 1e300": put("detector/detector.yaml", proposal__anchor_sizes_px=[1e300] * 5),
    "detector.yaml scale 1e-300": put("detector/detector.yaml", normalisation__scale_m=1e-300),
    "detector.yaml shift 1e300": put("detector/detector.yaml", head__score_shift=1e300),
    "detector.yaml gone": gone("detector/detector.yaml"),
    "detector.yaml a list": whole("detector/detector.yaml", []),
    "detector.yaml merge bomb": text("detector/detector.yaml", merge_bomb()),
    "weights gone": gone("detector/model.weights.h5"),
    "weights cut": cut("detector/model.weights.h5"),
    "weights garbage": text("detector/model.weights.h5", bytes(range(256)) * 100),
    "weights empty": text("detector/model.weights.h5", b""),
    "weights are a pipe": instead("detector/model.weights.h5", pipe),
    "weights are a folder": instead("detector/model.weights.h5", lambda path: path.mkdir()),
    "weights of nothing": instead("detector/model.weights.h5", lambda path: _empty_weights(path)),
}  # fmt: skip
_SETS: dict[str, Change] = {
    "tile cut": lambda folder: cut(str(_tile(folder, "train")))(folder),
    "tile gone": lambda folder: _tile(folder, "val").unlink(),
    "tile a bomb": lambda folder: claiming_tiff(_tile(folder, "train")),
    "tile a pipe": lambda folder: instead(str(_tile(folder, "train")), pipe)(folder),
    "train gone": lambda folder: shutil.rmtree(folder / "set/train"),
    "val empty": put("set/val/annotations.json", images=[]),
    "annotations cut": cut(_TRAIN),
    "annotations of another size": put(_TRAIN, images__0__width=7, images__0__height=7),
    "category unknown": put(_TRAIN, annotations__0__category_id=7),
    "file_name outside": put(_TRAIN, images__0__file_name="../../truth.json"),
}  # fmt: skip
_TRAINING: dict[str, tuple[str, ...]] = {
    "epochs 1e30": ("training.epochs=" + "9" * 30,),
    "epochs 0": ("training.epochs=0",),
    "batch 1e9": ("training.batch=1000000000",),
    "batch 1e30": ("training.batch=" + "9" * 30,),
    "image_px 1e9": ("detector.image_px=64000000000",),
    "crop_px 1e9": ("training.crop_px=64000000",),
    "channels 1e9": ("detector.pyramid_channels=800000000",),
    "hidden 1e9": ("detector.head.hidden_units=1000000000",),
    "most_blocks 1e9": ("detector.most_blocks=1000000000",),
    "learning_rate inf": ("training.learning_rate=.inf",),
    "learning_rate 1e300": ("training.learning_rate=1e300", "training.epochs=1"),
    "seed 1e30": ("training.seed=" + "9" * 30,),
    "warm_up 1e30": ("training.warm_up_steps=" + "9" * 30, "training.epochs=1"),
}


def _tile(folder: Path, split: str) -> Path:
    return min((folder / "set" / split).glob("*.tif"))


def _empty_weights(path: Path) -> None:
    import h5py

    h5py.File(path, "w").close()


def cases() -> list[Case]:
    words = ("evaluate", TRUTH, FOUND, "--out", "out")
    needs = (TRUTH, FOUND)
    found = [
        Case(f"ev: {name}", (*words, *(("--by", "noise") if name.startswith("--by") else ())), needs, spoil)
        for name, spoil in _EVALUATE.items()
    ]
    for name, given in _WORDS.items():
        found.append(Case(f"ev: {name}", ("evaluate", *given, *(() if "--out" in given else ("--out", "out"))), needs))
    out = ("--out", "out", "--quiet")
    found += [Case(f"det: {name}", ("detect", "baseline", "map.tif", *out), (), spoil) for name, spoil in _MAPS.items()]
    found += [
        Case(f"det: {name}", ("detect", "baseline", "set/train", *out), ("set",), spoil) for name, spoil in _FOLDERS.items()
    ]
    found += [
        Case(f"det: {name}", ("detect", "detector", "set/test", *out), ("set", "detector"), spoil)
        for name, spoil in _DETECTOR.items()
    ]
    found += [Case(f"train: {name}", ("train", "set", *out), ("set",), spoil) for name, spoil in _SETS.items()]
    for name, given in _TRAINING.items():
        overrides = tuple(word for each in given for word in ("--set", each))
        found.append(Case(f"train: {name}", ("train", "set", *out, *overrides), ("set",)))
    found.append(Case("train: config is a pipe", ("train", "set", *out, "--config", "pipe"), ("set",), instead("pipe", pipe)))
    found.append(Case("train: config is a site", ("train", "set", *out, "--config", "site.yaml"), ("set", "site.yaml")))
    return found
