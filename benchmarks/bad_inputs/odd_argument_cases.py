"""Bad inputs on the command line.

Arguments are empty, repeated or in other scripts; some names are unusual but right.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from benchmarks.bad_inputs.case import PORT_IN_USE, Case
from benchmarks.bad_inputs.spoil import text

SITE, TRUTH, FOUND, MAP = "site.yaml", "truth.json", "found.json", "run/difference_001.tif"
_LATIN = os.fsdecode(b"h\xf6he")
"""A file's name in Latin 1: bytes that are no UTF-8, as Python holds them."""
_NAMES = {
    "Latin 1": _LATIN,
    "mathematics": "cost$x_{$",
    "markup": "<script>alert(1)<",
    "a line's end": "two\nlines",
    "a terminal's words": "\x1b[31mred",
    "a space": "my file",
    "a percent sign": "100%s%d",
    "a brace": "{0}{name}",
    "quotes": "a'b\"c",
    "a hash": "a#b: c",
    "right to left": "\u202egnp",
    "an emoji": "\U0001f9d7",
    "200 letters": "\u00e4" * 100,
}


def _named(name: str) -> object:
    """site, truth, map, run, measurement, raw scan and diagnosis under a name."""

    def change(folder: Path) -> None:
        for old, suffix in ((SITE, ".yaml"), (TRUTH, ".json"), (MAP, ".tif"), ("raw/scan.ply", ".ply")):
            if (folder / old).exists():
                shutil.copy(folder / old, folder / f"{name}{suffix}")
        for old in ("run", "measurement", "set", "diagnosis"):
            if (folder / old).exists():
                (folder / old).rename(folder / f"{name} {old}")

    return change


def _under_names() -> list[Case]:
    found = []
    for word, name in _NAMES.items():
        spoil = _named(name)
        out = ("--out", f"{name} out", "--quiet")
        view = ("--no-browser", "--port", str(PORT_IN_USE))
        commands: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
            "sim": (("simulate", "--sensor", "tls", "--config", f"{name}.yaml", *out), (SITE,)),
            "inspect": (("inspect", f"{name}.yaml", "--sensor", "tls", *out), (SITE,)),
            "cmp": (("compare", f"{name}.yaml", "--epochs", "1", *out), (SITE,)),
            "icp": (("icp-study", f"{name} run", "--repeats", "1", *out), ("run",)),
            "cal": (("calibrate", f"{name}.tif", "--sensor", "tls", "--config", "none.yaml", *out), ("run",)),
            "det": (("detect", "baseline", f"{name}.tif", *out), ("run",)),
            "ev": (("evaluate", f"{name}.json", FOUND, "--by", "noise", "--out", f"{name} out"), (TRUTH, FOUND)),
            "view": (("view", f"{name} run", *view), ("run",)),
            "view gap": (("view", f"{name} diagnosis", *view), ("diagnosis",)),
            "raw": (("measurement", f"{name}.ply", "--reference", "raw/wall.ply", "--scanner", "riegl_vz400i", *out), ("raw",)),
            "ds": (("dataset", "split", f"{name} set", "--by", "sensor", *out), ("set",)),
            "init": (("init", "--mesh", f"{name}.ply", "--out", f"{name} new.yaml"), ("raw",)),
        }  # fmt: skip
        found += [Case(f"{short}: named with {word}", given, needs, spoil) for short, (given, needs) in commands.items()]  # type: ignore[arg-type]
    return found


_SETS: dict[str, tuple[str, str]] = {
    "empty": ("tls", ""),
    "a YAML bomb": ("tls", "a=[&a [1,1],[*a,*a]]"),
    "itself": ("tls", "wall=&a {a: *a}"),
    "a list of itself": ("tls", "wall=&a [*a]"),
    "a tag": ("tls", "seed=!!python/name:os.system"),
    "half a character": ("tls", 'wall.style="\\uD800"'),
    "crs": ("tls", "products.crs=EPSG:99999999"),
    "crs of half a character": ("tls", 'products.crs="\\uD800"'),
    "crs of degrees": ("tls", "products.crs=EPSG:4326"),
    "crs a file": ("tls", "products.crs=@/etc/passwd"),
    "crs of 1 MB": ("tls", "products.crs=" + "PROJCS[" * 15_000),
    "cameras a folder": ("stereo", "cameras=run"),
    "cameras a null character": ("stereo", 'cameras="a\\0"'),
    "sensor a folder": ("tls", "sensor=./run"),
    "sensor a scanner": ("tls", "sensor=riegl_vz400i"),
    "scanner a noise": ("tls", "scanner=glendale_high"),
    "scanner a folder": ("tls", "scanner=./run"),
}  # fmt: skip
_EMPTY: dict[str, tuple[str, ...]] = {
    "sim: config empty": ("simulate", "--sensor", "tls", "--config", "", "--out", "out"),
    "sim: out empty": ("simulate", "--sensor", "tls", "--config", SITE, "--out", ""),
    "sim: sensor named nothing": ("simulate", "--sensor", "", "--config", SITE),
    "sim: sensor twice": ("simulate", "--sensor", "tls", "--sensor", "radar", "--config", SITE, "--out", "out"),
    "sim: resume a set": ("simulate", "--sensor", "tls", "--config", SITE, "--resume", "--out", "set"),
    "sim: resume a file": ("simulate", "--sensor", "tls", "--config", SITE, "--resume", "--out", SITE),
    "sim: a stray word": ("simulate", "stray", "--sensor", "tls", "--config", SITE, "--out", "out"),
    "sim: two dashes": ("simulate", "--", "--sensor", "tls"),
    "sim: seed of another script": ("simulate", "--sensor", "tls", "--config", "none.yaml", "--seed", "\u0663", "--out", "out"),
    "sim: seed 1_000": ("simulate", "--sensor", "tls", "--config", "none.yaml", "--seed", "1_000", "--out", "out"),
    "sim: seed 1e3": ("simulate", "--sensor", "tls", "--config", SITE, "--seed", "1e3", "--out", "out"),
    "sim: seed of blanks": ("simulate", "--sensor", "tls", "--config", SITE, "--seed", "  ", "--out", "out"),
    "sim: config a picture": ("simulate", "--sensor", "tls", "--config", "run/reference.png", "--out", "out"),
    "sim: config a report": ("simulate", "--sensor", "tls", "--config", "run/report.html", "--out", "out"),
    "sim: config an annotation": ("simulate", "--sensor", "tls", "--config", TRUTH, "--out", "out"),
    "sim: config a set": ("simulate", "--sensor", "tls", "--config", "set/dataset.json", "--out", "out"),
    "sim: config a measurement": ("simulate", "--sensor", "tls", "--config", "measurement/measurement.yaml", "--out", "out"),
    "sim: set scanner twice": ("simulate", "--sensor", "tls", "--config", SITE, "--set", "scanner=riegl_vz400i", "--set",
        "scanner.preset=3", "--out", "out"),
    "inspect: config empty": ("inspect", ""),
    "inspect: a run": ("inspect", "run"),
    "inspect: out empty": ("inspect", SITE, "--out", ""),
    "cmp: config empty": ("compare", ""),
    "cmp: out empty": ("compare", SITE, "--out", ""),
    "cmp: measured empty": ("compare", SITE, "--measured", "", "--epochs", "1", "--out", "out"),
    "cmp: measured twice": ("compare", SITE, "--measured", "run", "run", "--epochs", "1", "--out", "out"),
    "cmp: measured by two names": ("compare", SITE, "--measured", "run", "./run", "--epochs", "1", "--out", "out"),
    "cmp: measured a set": ("compare", SITE, "--measured", "set", "--epochs", "1", "--out", "out"),
    "cmp: blocks unknown": ("compare", SITE, "--blocks", "none"),
    "cmp: seed of 5000 digits": ("compare", SITE, "--seed", "9" * 5000),
    "cmp: a set": ("compare", "set"),
    "cmp: a diagnosis": ("compare", "diagnosis"),
    "cmp: a detector": ("compare", "detector"),
    "cmp: only models": ("compare", "glendale_high", "glendale_low", "--epochs", "0"),
    "icp: source empty": ("icp-study", ""),
    "icp: out empty": ("icp-study", "run", "--out", ""),
    "icp: a diagnosis": ("icp-study", "diagnosis", "--out", "out"),
    "icp: a measurement": ("icp-study", "measurement", "--out", "out"),
    "icp: set of a run": ("icp-study", "run", "--set", "seed=nan", "--repeats", "1", "--out", "out"),
    "icp: sensor of a run": ("icp-study", "run", "--sensor", "stereo", "--repeats", "1", "--out", "out"),
    "icp: offset -0": ("icp-study", "run", "--offset-m", "-0.0", "--repeats", "1", "--out", "out"),
    "cal: empty": ("calibrate", ""),
    "cal: out empty": ("calibrate", "run", "--out", ""),
    "cal: config empty": ("calibrate", "run", "--config", "", "--out", "out"),
    "cal: a diagnosis": ("calibrate", "diagnosis", "--out", "out"),
    "cal: two folders": ("calibrate", "run", "measurement", "--out", "out"),
    "cal: a folder and a map": ("calibrate", "run", MAP, "--out", "out"),
    "cal: a folder twice": ("calibrate", "run", "run", "--out", "out"),
    "cal: tiles": ("calibrate", "set/test", "--sensor", "tls", "--config", SITE, "--out", "out"),
    "cal: a detector": ("calibrate", "detector/model.weights.h5", "--out", "out"),
    "ds: config named nothing": ("dataset", "", "--out", "out"),
    "ds: out empty": ("dataset", "set.yaml", "--out", ""),
    "ds: verify empty": ("dataset", "verify", ""),
    "ds: verify alone": ("dataset", "verify"),
    "ds: merge alone": ("dataset", "merge", "--out", "out"),
    "ds: split alone": ("dataset", "split", "--out", "out"),
    "ds: merge empty": ("dataset", "merge", "", "", "--out", "out"),
    "ds: merge of a set by two names": ("dataset", "merge", "set", "./set", "--out", "out"),
    "ds: split into its own folder": ("dataset", "split", "set", "--out", "set/parts", "--by", "sensor"),
    "ds: merge into its own folder": ("dataset", "merge", "set", "set", "--out", "set/parts"),
    "ds: split by blanks": ("dataset", "split", "set", "--by", " , ", "--out", "out"),
    "ds: split by a comma": ("dataset", "split", "set", "--by", "sensor,", "--out", "out"),
    "ds: split by all": ("dataset", "split", "set", "--by", "sensor,noise,size,wall,split", "--out", "out"),
    "ds: a run": ("dataset", "run", "--out", "out"),
    "ds: a site": ("dataset", SITE, "--out", "out"),
    "ds: a dataset.json": ("dataset", "set/dataset.json", "--out", "set", "--set", "seed=9"),
    "ds: a tile": ("dataset", MAP, "--out", "out"),
    "ds: scheduler of blanks": ("dataset", "set.yaml", "--out", "out", "--scheduler", " "),
    "ds: scheduler inproc": ("dataset", "set.yaml", "--out", "out", "--scheduler", "inproc://1/2/3"),
    "ds: scheduler ucx": ("dataset", "set.yaml", "--out", "out", "--scheduler", "ucx://127.0.0.1:1"),
    "ds: scheduler ws": ("dataset", "set.yaml", "--out", "out", "--scheduler", "ws://127.0.0.1:1"),
    "ds: scheduler a file": ("dataset", "set.yaml", "--out", "out", "--scheduler", "/etc/passwd"),
    "ds: scheduler half a character": ("dataset", "set.yaml", "--out", "out", "--scheduler", "tcp://\udcff:1"),
    "raw: scan empty": ("measurement", "", "--reference", "raw/wall.ply", "--scanner", "riegl_vz400i", "--out", "out"),
    "raw: reference named nothing": ("measurement", "raw/scan.ply", "--reference", "", "--scanner", "riegl_vz400i"),
    "raw: scanner empty": ("measurement", "raw/scan.ply", "--reference", "raw/wall.ply", "--scanner", "", "--out", "out"),
    "raw: model empty": ("measurement", "raw/scan.ply", "--reference", "raw/wall.ply", "--model", "", "--out", "out"),
    "raw: cameras empty": ("measurement", "raw/scan.ply", "--reference", "raw/wall.ply", "--cameras", "", "--out", "out"),
    "raw: out empty": ("measurement", "raw/scan.ply", "--reference", "raw/wall.ply", "--scanner", "riegl_vz400i", "--out", ""),
    "raw: scanner a folder": ("measurement", "raw/scan.ply", "--reference", "raw/wall.ply", "--scanner", "./run", "--out", "out"),
    "raw: reference a run": ("measurement", "raw/scan.ply", "--reference", "run", "--scanner", "riegl_vz400i", "--out", "out"),
    "raw: pair of blanks": ("measurement", "raw/scan.ply", "--reference", "raw/wall.ply", "--pair", " , ", "--out", "out"),
    "raw: unit empty": ("measurement", "raw/scan.ply", "--reference", "raw/wall.ply", "--unit", "", "--out", "out"),
    "gap: empty": ("gap", ""),
    "gap: out empty": ("gap", "measurement", "--out", ""),
    "gap: a run as a measurement": ("gap", "run", "--out", "out"),
    "gap: a config": ("gap", SITE, "--out", "out"),
    "gap: a model": ("gap", "measurement/model.yaml", "--out", "out"),
    "gap: two measurements": ("gap", "measurement", "measurement", "--out", "out"),
    "gap: out is the measurement": ("gap", "measurement", "--out", "measurement"),
    "gap: set unknown": ("gap", "measurement", "--set", "mean.none=1", "--out", "out"),
    "gap: set nan": ("gap", "measurement", "--set", "mean.class_margin=.nan", "--out", "out"),
    "gap: set a word": ("gap", "measurement", "--set", "mean.class_margin=much", "--out", "out"),
    "gap: set a section": ("gap", "measurement", "--set", "mean=3", "--out", "out"),
    "gap: set huge": ("gap", "measurement", "--set", "mean.class_margin=" + "9" * 5000, "--out", "out"),
    "gap: set without a value": ("gap", "measurement", "--set", "mean.class_margin", "--out", "out"),
    "gap: set a list": ("gap", "measurement", "--set", "mean.class_margin=[1]", "--out", "out"),
    "gap: seed 1e30": ("gap", "measurement", "--seed", "9" * 30, "--out", "out"),
    "gap: seed of 5000 digits": ("gap", "measurement", "--seed", "9" * 5000, "--out", "out"),
    "gap: identifiability of a set": ("gap", "set", "--identifiability", "--out", "out"),
    "gap: identifiability empty": ("gap", "", "--identifiability", "--out", "out"),
    "gap: reference error with a diagnosis": ("gap", "measurement/none", "--reference-error", "0.1", "--out", "out"),
    "train: empty": ("train", "", "--out", "out"),
    "train: out empty": ("train", "set", "--out", ""),
    "train: a split": ("train", "set/train", "--out", "out"),
    "train: config a site": ("train", "set", "--config", SITE, "--out", "out"),
    "train: config a detector": ("train", "set", "--config", "detector/detector.yaml", "--out", "out"),
    "train: config empty": ("train", "set", "--config", "", "--out", "out"),
    "train: weights 1e300": ("train", "set", "--set", "training.loss_weights={mask: 1e300}", "--out", "out"),
    "train: weights unknown": ("train", "set", "--set", "training.loss_weights={none: 1}", "--out", "out"),
    "train: backbone a path": ("train", "set", "--set", "detector.backbone=../x", "--out", "out"),
    "train: resume a set": ("train", "set", "--resume", "--out", "set"),
    "det: model empty": ("detect", "", MAP, "--out", "out"),
    "det: input empty": ("detect", "baseline", "", "--out", "out"),
    "det: out empty": ("detect", "baseline", MAP, "--out", ""),
    "det: two of one name": ("detect", "baseline", MAP, "run copy/difference_001.tif", "--out", "out"),
    "det: two runs": ("detect", "baseline", "run", "run copy", "--out", "out"),
    "det: two alike but for a space": ("detect", "baseline", "a b.tif", "a_b.tif", "--out", "out"),
    "det: confidence of a comma": ("detect", "baseline", MAP, "--confidence", "0,9", "--out", "out"),
    "det: a picture": ("detect", "baseline", "run/reference.png", "--out", "out"),
    "det: a set": ("detect", "baseline", "set", "--out", "out"),
    "ev: truth named nothing": ("evaluate", "", FOUND),
    "ev: found empty": ("evaluate", TRUTH, ""),
    "ev: out empty": ("evaluate", TRUTH, FOUND, "--out", ""),
    "ev: by empty": ("evaluate", TRUTH, FOUND, "--by", ""),
    "ev: by half a character": ("evaluate", TRUTH, FOUND, "--by", "\udcff"),
    "ev: a run": ("evaluate", "run", FOUND),
    "ev: found a folder": ("evaluate", TRUTH, "run"),
    "view: empty": ("view", "", "--no-browser", "--port", str(PORT_IN_USE)),
    "view: detections named nothing": ("view", "run", "--detections", "", "--no-browser", "--port", str(PORT_IN_USE)),
    "view: detections of a gap": ("view", "run", "--detections", "diagnosis", "--no-browser", "--port", str(PORT_IN_USE)),
    "view: a measurement": ("view", "measurement", "--no-browser", "--port", str(PORT_IN_USE)),
    "view: two folders": ("view", "run", "set", "--no-browser", "--port", str(PORT_IN_USE)),
    "surface: out empty": ("surface", "raw/scan.ply", "--seen-from", "0", "0", "0", "--out", ""),
    "surface: out a suffix alone": ("surface", "raw/scan.ply", "--seen-from", "0", "0", "0", "--out", ".ply"),
    "surface: cloud empty": ("surface", "", "--seen-from", "0", "0", "0", "--out", "out.ply"),
    "surface: cloud a folder": ("surface", "raw", "--seen-from", "0", "0", "0", "--out", "out.ply"),
    "surface: seen from two numbers": ("surface", "raw/scan.ply", "--seen-from", "0", "0", "--out", "out.ply"),
    "surface: out in no folder": ("surface", "none.ply", "--seen-from", "0", "0", "0", "--out", "new/deep/out.ply"),
    "init: out empty": ("init", "--out", ""),
    "init: out a folder": ("init", "--out", "run"),
    "init: out in no folder": ("init", "--out", "none/new.yaml"),
    "init: out a null device": ("init", "--out", "/dev/null"),
    "init: out full": ("init", "--out", "/dev/full"),
    "init: site a path": ("init", "--site", "../../etc/passwd", "--out", "new.yaml"),
    "init: site empty": ("init", "--site", "", "--out", "new.yaml"),
    "init: scanner a path": ("init", "--scanner", "./site.yaml", "--out", "new.yaml"),
    "init: scanner a noise": ("init", "--scanner", "glendale_high", "--out", "new.yaml"),
    "init: dataset a path": ("init", "--dataset", "../demo", "--out", "new.yaml"),
    "init: cameras a folder": ("init", "--cameras", "run", "--out", "new.yaml"),
    "init: mesh empty": ("init", "--mesh", "", "--out", "new.yaml"),
    "init: out of another suffix": ("init", "--out", "new.json"),
    "init: out very long": ("init", "--out", "a" * 3000),
    "init: out a null character": ("init", "--out", "/proc/new.yaml"),
    "schema: twice": ("schema", "model", "model"),
    "schema: empty": ("schema", ""),
    "completion: empty": ("completion", ""),
    "completion: script unknown": ("completion", "bash", "--script", "rm -rf /"),
    "doctor: a word": ("doctor", "all"),
}  # fmt: skip


def _beside(folder: Path) -> None:
    """Make a copy of run/ and two maps whose names differ by a space."""
    if (folder / "run").exists():
        shutil.copytree(folder / "run", folder / "run copy")
        for name in ("a b.tif", "a_b.tif"):
            shutil.copy(folder / MAP, folder / name)


_YAML = {
    "a list of itself": "a: &a [*a]\n",
    "a mapping of itself": "wall: &a {b: *a}\n",
    "a hexadecimal number of 300 digits": "seed: 0x" + "f" * 300 + "\n",
    "a set": "wall: !!set {a, b}\n",
    "binary data": "seed: !!binary aGVsbG8=\n",
    "a mapping as key": "? {a: 1}\n: 2\n",
    "a time": "seed: 2026-01-01T00:00:00Z\n",
    "a text alone": "--- |\n text\n",
    "a tag of its own": "%TAG ! tag:a,2000:\n---\nseed: !b 1\n",
    "infinity": "seed: .inf\n",
    "old Mac lines": "seed: 1\r\rseed: 2\r",
}
"""Text in the place of a config."""
_DOCUMENTS = (
    "det: two runs",
    "ev: truth named nothing",
    "cal: a diagnosis",
    "gap: set nan",
    "icp: a measurement",
    "ds: verify empty",
)


def cases() -> list[Case]:
    needs = (SITE, "set.yaml", "run", "set", "measurement", "diagnosis", "detector", "raw", TRUTH, FOUND)
    plain = ("view", "surface", "schema", "completion", "doctor", "init", "evaluate")
    found = _under_names()
    for name, words in _EMPTY.items():
        quiet = () if words[0] in plain else ("--quiet",)
        found.append(Case(name, (*words, *quiet), needs, _beside))
        if name in _DOCUMENTS:
            found.append(Case(f"{name}, as JSON", (*words, *quiet, "--json"), needs, _beside))
    for name, (sensor, override) in _SETS.items():
        words = ("simulate", "--sensor", sensor, "--config", SITE, "--set", override, "--out", "out")
        found.append(Case(f"sim: set {name}", words, needs, _beside))
    for name, content in _YAML.items():
        words = ("simulate", "--sensor", "tls", "--config", SITE, "--out", "out")
        found.append(Case(f"sim: YAML {name}", words, (), text(SITE, content)))
    return found
