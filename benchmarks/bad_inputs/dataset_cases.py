"""Bad inputs for `dataset`: configs, and finished data sets that were damaged."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.bad_inputs.case import Case
from benchmarks.bad_inputs.spoil import GONE, NAN, Change, bomb, cut, gone, instead, link, merge_bomb, pipe, put, text, whole

CONFIG, SET = "set.yaml", "set/dataset.json"
_HUGE = "9" * 30
_CONFIGS: dict[str, Change] = {
    "density 1e9": put(CONFIG, sizes__large__blocks_per_m2=1e9),
    "density 1e300": put(CONFIG, sizes__large__blocks_per_m2=1e300),
    "density 0": put(CONFIG, sizes__large__blocks_per_m2=0),
    "density 1e-9": put(CONFIG, sizes__large__blocks_per_m2=1e-9),
    "density NaN": put(CONFIG, sizes__large__blocks_per_m2=NAN),
    "scale negative": put(CONFIG, noise__low__tls__scale__ledge=-0.02),
    "scale 1e300": put(CONFIG, noise__low__tls__scale__ledge=1e300),
    "scale of another wall": put(CONFIG, noise__low__tls__scale={"other": 1.0}),
    "scale text": put(CONFIG, noise__low__tls__scale="large"),
    "sensor twice": put(CONFIG, sensors=["tls", "tls"]),
    "sensor unknown": put(CONFIG, sensors=["radar"]),
    "sensors empty": put(CONFIG, sensors=[]),
    "tiles larger than wall": put(CONFIG, tiles__size_px=4096),
    "tiles of 1 px": put(CONFIG, tiles__size_px=1),
    "tiles 1e9": put(CONFIG, tiles__size_px=10**9),
    "tiles all invalid": put(CONFIG, tiles__minimum_valid_share=1.0),
    "epochs 0": put(CONFIG, parts__0__train=0, parts__0__val=0, parts__0__test=0),
    "epochs huge": put(CONFIG, parts__0__train=10**12),
    "references huge": put(CONFIG, references=10**12),
    "validation_region 1": put(CONFIG, validation_region=1.0),
    "validation_region 0.999": put(CONFIG, validation_region=0.999),
    "validation_region NaN": put(CONFIG, validation_region=NAN),
    "parts empty": put(CONFIG, parts=[]),
    "parts of an unknown wall": put(CONFIG, parts__0__walls=["none"]),
    "parts twice": lambda folder: _twice(folder),
    "parts 5000": put(CONFIG, parts=[{"walls": ["ledge"], "noise": ["low"], "sizes": ["large"], "train": 1}] * 5000),
    "walls empty": put(CONFIG, walls={}),
    "wall of no site": put(CONFIG, walls__ledge={"site": "none"}),
    "wall of itself": put(CONFIG, walls__ledge={"site": "./set.yaml"}),
    "wall with a bad override": put(CONFIG, walls__ledge={"site": "glendale", "set": ["wall.width_m=nan"]}),
    "wall huge": put(CONFIG, walls__ledge__wall__width_m=1e6),
    "wall fine": put(CONFIG, walls__ledge__wall__resolution_m=1e-6),
    "wall mesh gone": put(CONFIG, walls__ledge__wall={"mesh": "none.ply"}),
    "name with a slash": put(CONFIG, name="../x"),
    "name very long": put(CONFIG, name="a" * 5000),
    "name of a wall very long": put(CONFIG, walls={"a" * 5000: {}}),
    "seed huge": put(CONFIG, seed=10**40),
    "blocks larger than the wall": put(CONFIG, sizes__large__rockfall__size_m=50.0),
    "config empty": text(CONFIG, ""),
    "config a list": whole(CONFIG, []),
    "config bomb": text(CONFIG, bomb()),
    "config merge bomb": text(CONFIG, merge_bomb()),
    "config is a pipe": instead(CONFIG, pipe),
    "config is /dev/zero": instead(CONFIG, link("/dev/zero")),
    "config is a loop of links": instead(CONFIG, link(CONFIG)),
    "config binary": text(CONFIG, bytes(range(256))),
}  # fmt: skip
_WORDS: dict[str, tuple[str, ...]] = {
    "workers 100000": (CONFIG, "--workers", "100000"),
    "workers 0": (CONFIG, "--workers", "0"),
    "workers 1e30": (CONFIG, "--workers", _HUGE),
    "scheduler dead": (CONFIG, "--scheduler", "tcp://127.0.0.1:1"),
    "scheduler no address": (CONFIG, "--scheduler", "nowhere"),
    "scheduler port 99999": (CONFIG, "--scheduler", "tcp://127.0.0.1:99999"),
    "scheduler of http": (CONFIG, "--scheduler", "http://127.0.0.1:1"),
    "scheduler tls without certificates": (CONFIG, "--scheduler", "tls://127.0.0.1:1"),
    "scheduler and workers": (CONFIG, "--scheduler", "tcp://127.0.0.1:1", "--workers", "2"),
    "--set without =": (CONFIG, "--set", "seed"),
    "--set huge int": (CONFIG, "--set", "seed=" + "1" * 5000),
    "--set into a number": (CONFIG, "--set", "seed.a=1"),
    "by w/o split": (CONFIG, "--by", "sensor"),
    "seed -1": (CONFIG, "--seed", "-1"),
    "no such config": ("none.yaml",),
    "out is a file": (CONFIG, "--out", CONFIG),
    "out very long": (CONFIG, "--out", "a" * 3000),
    "out in use": (CONFIG, "--out", "run"),
    "verify of a run": ("verify", "run"),
    "verify of nothing": ("verify", "nowhere"),
    "verify of two": ("verify", "set", "set"),
    "merge of one": ("merge", "set", "--out", "both"),
    "merge of the same": ("merge", "set", "set", "--out", "both"),
    "merge with a run": ("merge", "set", "run", "--out", "both"),
    "merge into itself": ("merge", "set", "set", "--out", "set"),
    "split by nothing": ("split", "set", "--by", "", "--out", "parts"),
    "split by colour": ("split", "set", "--by", "colour", "--out", "parts"),
    "split twice by one": ("split", "set", "--by", "sensor,sensor", "--out", "parts"),
    "split into a set": ("split", "set", "--out", "set"),
}


def _twice(folder: Path) -> None:
    import yaml

    values = yaml.safe_load((folder / CONFIG).read_text())
    values["parts"] *= 2
    (folder / CONFIG).write_text(yaml.safe_dump(values))


def _epochs(value: Any) -> Change:
    """Change the epochs in dataset.json and correct its checksum."""

    def change(folder: Path) -> None:
        from pipeline.dataset.records import _digest, _text

        path = folder / SET
        values = json.loads(path.read_text())
        values.pop("sha256")
        values["epochs"] = dict.fromkeys(values["epochs"], value)
        path.write_text(json.dumps({**values, "sha256": _digest(_text(values))}))

    return change


def _shard(move: Callable[[Path], object]) -> Change:
    return lambda folder: move(min((folder / "set/shards").glob("*.json")))


def _tile(move: Callable[[Path], object]) -> Change:
    return lambda folder: move(min((folder / "set/train").glob("*.tif")))


_SETS: dict[str, Change] = {
    "dataset.json {}": whole(SET, {}),
    "dataset.json []": whole(SET, []),
    "dataset.json null": whole(SET, None),
    "dataset.json empty": text(SET, ""),
    "dataset.json cut": cut(SET),
    "dataset.json binary": text(SET, bytes(range(256))),
    "dataset.json nested": text(SET, "[" * 100_000),
    "dataset.json is a pipe": instead(SET, pipe),
    "dataset.json is a folder": instead(SET, lambda path: path.mkdir()),
    "dataset.json is /dev/zero": instead(SET, link("/dev/zero")),
    "dataset.json gone": gone(SET),
    "dataset.json one digit": put(SET, fingerprint="0"),
    "dataset.json epochs a list": put(SET, epochs=[]),
    "dataset.json epochs huge": _epochs([10**9]),
    "dataset.json epochs 1e6": _epochs(list(range(1_000_000))),
    "dataset.json epochs negative": _epochs([-1]),
    "dataset.json epochs none": _epochs([]),
    "dataset.json epochs twice": _epochs([0, 0, 0, 1, 2]),
    "dataset.json schema 99": put(SET, schema=99),
    "dataset.json name a list": put(SET, name=["a"]),
    "dataset.json sources empty": put(SET, sources={}),
    "dataset.json complete gone": put(SET, complete=GONE),
    "checksums empty": text("set/checksums.sha256", ""),
    "checksums binary": text("set/checksums.sha256", bytes(range(256))),
    "checksums gone": gone("set/checksums.sha256"),
    "checksums outside": text("set/checksums.sha256", "0" * 64 + "  ../../etc/passwd\n"),
    "annotations [] ": whole("set/train/annotations.json", []),
    "shard cut": _shard(lambda path: path.write_bytes(path.read_bytes()[:50])),
    "shard a pipe": _shard(lambda path: (path.unlink(), pipe(path))),
    "shard a folder": _shard(lambda path: (path.unlink(), path.mkdir())),
    "shard /dev/zero": _shard(lambda path: (path.unlink(), path.symlink_to("/dev/zero"))),
    "tile a folder": _tile(lambda path: (path.unlink(), path.mkdir())),
    "tile a pipe": _tile(lambda path: (path.unlink(), pipe(path))),
    "tile a link out": _tile(lambda path: (path.unlink(), path.symlink_to("/etc/passwd"))),
    "shards gone": lambda folder: shutil.rmtree(folder / "set/shards"),
    "train gone": lambda folder: shutil.rmtree(folder / "set/train"),
}  # fmt: skip


def cases() -> list[Case]:
    made = (CONFIG, "--out", "out", "--quiet")
    found = [Case(f"ds: {name}", ("dataset", *made), (CONFIG,), spoil) for name, spoil in _CONFIGS.items()]
    for name, words in _WORDS.items():
        out = () if "--out" in words or words[0] == "verify" else ("--out", "out")
        found.append(Case(f"ds: {name}", ("dataset", *words, *out, "--quiet"), (CONFIG, "run", "set")))
    for name, spoil in _SETS.items():
        report = ("dataset", "verify", "set", "--report-only", "--quiet")
        found.append(Case(f"ds: verify {name}", report, ("set",), spoil, codes=(0, 1, 2)))
        found.append(Case(f"ds: repair {name}", ("dataset", "verify", "set", "--quiet"), ("set",), spoil))
        split = ("dataset", "split", "set", "--out", "parts", "--by", "sensor", "--quiet")
        found.append(Case(f"ds: split {name}", split, ("set",), spoil))
    return found
