"""Bad inputs that are results of other commands or programs: unusual content in complete files."""

from __future__ import annotations

import gzip
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.bad_inputs.case import PORT_IN_USE, Case
from benchmarks.bad_inputs.spoil import (
    INFINITE,
    NAN,
    Array,
    Change,
    both,
    instead,
    link,
    map_of,
    mesh,
    pipe,
    points,
    put,
    text,
    whole,
)
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import read_laz, write_laz

SITE, RUN, GAP, TRUTH, FOUND = "site.yaml", "run/run.json", "diagnosis/gap.json", "truth.json", "found.json"
_SURROGATE = "\ud800"
_EVENTS = "found/events_0.9.csv"
_HEAD = "image,number,score,x_m,y_m,width_m,height_m,volume_m3,depth_m\n"
_ROW = "difference_001.tif,1,0.97,1.0,2.0,0.5,0.5,0.01,0.1\n"


def _events(content: str | bytes, name: str = _EVENTS) -> Change:
    return text(name, content)


_DETECTIONS: dict[str, Change] = {
    "a name without a number": _events(_HEAD + _ROW, "found/events_all.csv"),
    "a name of nan": both(_events(_HEAD + _ROW, "found/events_nan.csv"), _events(_HEAD + _ROW)),
    "good": _events(_HEAD + _ROW),
    "empty": _events(""),
    "a head alone": _events(_HEAD),
    "other columns": _events("a,b,c\n1,2,3\n"),
    "a column gone": _events("image,number,score\ndifference_001.tif,1,0.9\n"),
    "words for numbers": _events(_HEAD + _ROW.replace("0.97", "high")),
    "x a word": _events(_HEAD + _ROW.replace("1.0", "left")),
    "x nan": _events(_HEAD + _ROW.replace("1.0", "nan")),
    "a short row": _events(_HEAD + "difference_001.tif,1\n"),
    "a long row": _events(_HEAD + _ROW.strip() + ",5,6,7\n"),
    "Latin 1": _events((_HEAD + _ROW).encode() + b"h\xf6he,1,1,1,1,1,1,1,1\n"),
    "UTF-16": _events((_HEAD + _ROW).encode("utf-16")),
    "null characters": _events("\0" * 1000),
    "one 200 kB field": _events(_HEAD + "a" * 200_000 + ",1,1,1,1,1,1,1,1\n"),
    "number of 5000 digits": _events(_HEAD + _ROW.replace("001", "1" * 5000)),
    "quotes without end": _events(_HEAD + '"difference_001.tif,1\n' * 5),
    "markup": _events(_HEAD + _ROW.replace(",1,", ",<script>alert(1)</script>,")),
    "a pipe": both(_events(""), instead(_EVENTS, pipe)),
    "a folder": both(_events(""), instead(_EVENTS, lambda path: path.mkdir())),
    "/dev/zero": both(_events(""), instead(_EVENTS, link("/dev/zero"))),
    "a loop of links": both(_events(""), instead(_EVENTS, link("events_0.9.csv"))),
}  # fmt: skip


def _cloud(name: str, move: Callable[[PointCloud], PointCloud]) -> Change:
    def change(folder: Path) -> None:
        path = folder / f"diagnosis/{name}.laz"
        cloud = move(read_laz(path))
        path.unlink()
        write_laz(path, cloud)

    return change


def _without(*names: str) -> Callable[[PointCloud], PointCloud]:
    return lambda cloud: PointCloud(cloud.points, extra={key: value for key, value in cloud.extra.items() if key not in names})


def _valued(name: str, value: float) -> Callable[[PointCloud], PointCloud]:
    return lambda cloud: PointCloud(cloud.points, extra={**cloud.extra, name: np.full(len(cloud.points), value)})


def _moved(move: Callable[[Array], Array]) -> Callable[[PointCloud], PointCloud]:
    def change(cloud: PointCloud) -> PointCloud:
        found = move(cloud.points)
        return PointCloud(found, extra={key: np.resize(value, len(found)) for key, value in cloud.extra.items()})

    return change


_DIAGNOSES: dict[str, Change] = {
    "before without residuals": _cloud("before", _without("residual_m")),
    "after without residuals": _cloud("after", _without("residual_m")),
    "before without held_out": _cloud("before", _without("held_out")),
    "residuals nan": _cloud("before", _valued("residual_m", NAN)),
    "residuals 1e300": _cloud("before", _valued("residual_m", 1e300)),
    "residuals 0": _cloud("before", _valued("residual_m", 0.0)),
    "held_out nan": _cloud("before", _valued("held_out", NAN)),
    "2 points": _cloud("before", _moved(lambda found: found[:2])),
    "2 points after": _cloud("after", _moved(lambda found: found[:2])),
    "no points after": _cloud("after", _moved(lambda found: found[:0])),
    "3 points": _cloud("before", _moved(lambda found: found[:3])),
    "one place": _cloud("before", _moved(lambda found: found * 0 + 5)),
    "one line": _cloud("before", _moved(lambda found: found * [1, 0, 0])),
    "a level plane": _cloud("before", _moved(lambda found: found * [1, 1, 0])),
    "another cloud": lambda folder: write_laz(folder / "diagnosis/before.laz", PointCloud(np.eye(3) * 5)),
    "verdict of markup": put(GAP, verdict="<script>alert(1)</script>"),
    "verdict of half a character": put(GAP, verdict=_SURROGATE),
    "verdict of 1 MB": put(GAP, verdict="a" * 1_000_000),
    "a million changes": put(GAP, scene_changes=lambda: [{"bbox_m": [0.0] * 6, "volume_m3": 1.0}] * 1_000_000),
    "a change backwards": put(GAP, scene_changes=[{"bbox_m": [1.0, 1.0, 1.0, 0.0, 0.0, 0.0], "volume_m3": 1.0}]),
    "a change 1e300": put(GAP, scene_changes=[{"bbox_m": [1e300] * 6, "volume_m3": 1e300}]),
    "sensor of the other": put(GAP, sensor="stereo"),
}  # fmt: skip
_TILE = "set/test/annotations.json"
_SPLITS: dict[str, Change] = {
    "noise_sigma_m a word": put(_TILE, images__0__noise_sigma_m="low"),
    "noise_sigma_m nan": put(_TILE, images__0__noise_sigma_m=NAN),
    "noise_sigma_m 0": put(_TILE, images__0__noise_sigma_m=0),
    "noise_sigma_m -1": put(_TILE, images__0__noise_sigma_m=-1.0),
    "noise_sigma_m null": put(_TILE, images__0__noise_sigma_m=None),
    "volume_m3 a word": put(_TILE, annotations__0__volume_m3="much"),
    "volume_m3 a list": put(_TILE, annotations__0__volume_m3=[1]),
    "shape a list": put(_TILE, annotations__0__shape=["cube"]),
    "block a mapping": put(_TILE, annotations__0__block={"a": 1}),
    "sensor a list": put(_TILE, images__0__sensor=["tls"]),
    "file_name of half a character": put(_TILE, images__0__file_name=_SURROGATE + ".tif"),
    "file_name of markup": put(_TILE, images__0__file_name="<script>.tif"),
    "category name of half a character": put(_TILE, categories__0__name=_SURROGATE),
    "info a list": put(_TILE, info=[1]),
    "licenses a number": put(_TILE, licenses=7),
}  # fmt: skip


def _crowd(count: int) -> Change:
    """truth.json with so many annotations in one image, found.json with as many detections."""

    def change(folder: Path) -> None:
        for name in (TRUTH, FOUND):
            content = json.loads((folder / name).read_text())
            one = content["annotations"][0]
            content["annotations"] = [{**one, "id": 1 + number} for number in range(count)]
            (folder / name).write_text(json.dumps(content))

    return change


def _wide(width: int, images: int) -> Change:
    """truth.json and found.json with large images and a box in each."""

    def change(folder: Path) -> None:
        listed = [{"id": 1 + k, "file_name": f"{k}.tif", "width": width, "height": width, "noise": "a"} for k in range(images)]
        polygon = [[0, 0, width, 0, width, width, 0, width]]
        entries = [{"id": 1 + k, "image_id": 1 + k, "category_id": 1, "segmentation": polygon} for k in range(images)]
        content = {"images": listed, "annotations": entries, "categories": [{"id": 1, "name": "block"}]}
        (folder / TRUTH).write_text(json.dumps(content))
        (folder / FOUND).write_text(json.dumps({**content, "annotations": [{**each, "score": 0.9} for each in entries]}))

    return change


def _in_both(**values: Any) -> Change:
    return both(put(TRUTH, **values), put(FOUND, **values))


def _prepend(path: Path, data: bytes) -> None:
    path.write_bytes(data + path.read_bytes())


def _exchanged(folder: Path) -> None:
    for old, new in ((TRUTH, "x"), (FOUND, TRUTH), ("x", FOUND)):
        shutil.move(folder / old, folder / new)


_NOTHING = {"size": [32, 48], "counts": [1536]}
_EVALUATE: dict[str, Change] = {
    "noise of half a character": put(TRUTH, images__0__noise=_SURROGATE),
    "noise of 5000 digits": put(TRUTH, images__0__noise=10**4000),
    "noise 1, '1' and true": both(put(TRUTH, images__0__noise=1), put(TRUTH, images__1__noise=True)),
    "noise infinite": put(TRUTH, images__0__noise=INFINITE),
    "noise of 1 MB": put(TRUTH, images__0__noise="a" * 1_000_000),
    "noise of a line": put(TRUTH, images__0__noise="a\nb\rc\x1b[31m"),
    "file_name of half a character": _in_both(images__0__file_name=_SURROGATE),
    "file_name of 1 MB": _in_both(images__0__file_name="a" * 1_000_000),
    "area of 400 digits": put(TRUTH, annotations__0__area=10**400),
    "bbox of 400 digits": put(TRUTH, annotations__0__bbox=[10**400, 1, 1, 1]),
    "score of 400 digits": put(FOUND, annotations__0__score=10**400),
    "polygon of 400 digits": put(TRUTH, annotations__0__segmentation=[[10**400, 6, 14, 6, 14, 14]]),
    "counts of 400 digits": put(TRUTH, annotations__0__segmentation={"size": [32, 48], "counts": [10**400]}),
    "size of 400 digits": put(TRUTH, annotations__0__segmentation={"size": [10**400, 48], "counts": [1]}),
    "width of 400 digits": put(TRUTH, images__0__width=10**400),
    "2000 of one place": _crowd(2000),
    "20000 of one place": _crowd(20_000),
    "20 images of 10000 px": _wide(10_000, 20),
    "300 images of 15000 px": _wide(15_000, 300),
    "extra keys nested": put(TRUTH, annotations__0__attributes={"a": {"b": [1, {"c": None}]}}),
    "keypoints": put(TRUTH, annotations__0__keypoints=[1, 2, 2], annotations__0__num_keypoints=1),
    "ignore a word": put(TRUTH, annotations__0__ignore="yes"),
    "ignore a list": put(TRUTH, annotations__0__ignore=[1]),
    "stand_out a word": put(TRUTH, annotations__0__signal_to_noise="high"),
    "snr nan": put(TRUTH, annotations__0__snr=NAN),
    "snr a list": put(TRUTH, annotations__0__snr=[1]),
    "all crowd": both(*[put(TRUTH, **{f"annotations__{k}__iscrowd": 1}) for k in range(4)]),
    "crowd with plain counts": put(TRUTH, annotations__0__iscrowd=1, annotations__0__segmentation=_NOTHING),
    "all masks empty": both(*[put(TRUTH, **{f"annotations__{k}__segmentation": _NOTHING}) for k in range(4)]),
    "truth with a byte order mark": lambda folder: _prepend(folder / TRUTH, b"\xef\xbb\xbf"),
    "truth compressed": lambda folder: (folder / TRUTH).write_bytes(gzip.compress((folder / TRUTH).read_bytes())),
    "truth of lines": text(TRUTH, '{"images": []}\n{"annotations": []}\n'),
    "truth with comments": lambda folder: (folder / TRUTH).write_text("// mine\n" + (folder / TRUTH).read_text()),
    "truth with a comma too many": text(TRUTH, '{"images": [],}'),
    "truth and found exchanged": lambda folder: _exchanged(folder),
    "truth of 400 MB": text(TRUTH, lambda: b"[" + b"0," * 200_000_000 + b"0]"),
}  # fmt: skip
_EPOCH = "run/epoch_001/surface.ply"
_RUNS: dict[str, Change] = {
    "surface of one place": mesh(_EPOCH, lambda found: found * 0 + 1),
    "surface nan": mesh(_EPOCH, lambda found: found * NAN),
    "surface 1e300": mesh(_EPOCH, lambda found: found * 1e300),
    "surface 1e30": mesh(_EPOCH, lambda found: found * 1e30),
    "surface on a line": mesh(_EPOCH, lambda found: found * [1, 0, 0]),
    "surface of one triangle": mesh(_EPOCH, lambda found: found, lambda faces: faces[:1]),
    "surface without triangles": mesh(_EPOCH, lambda found: found, lambda faces: faces[:0]),
    "surface far away": mesh(_EPOCH, lambda found: found + 1e6),
    "surface of slivers": mesh(_EPOCH, lambda found: found, lambda faces: faces[:, [0, 0, 1]]),
    "reference of one place": mesh("run/epoch_000/surface.ply", lambda found: found * 0 + 1),
    "reference nan": mesh("run/epoch_000/surface.ply", lambda found: found * NAN),
    "reference of one triangle": mesh("run/epoch_000/surface.ply", lambda found: found, lambda faces: faces[:1]),
    "truth nan": mesh("run/epoch_001/truth.ply", lambda found: found * NAN),
    "truth of one triangle": mesh("run/epoch_001/truth.ply", lambda found: found, lambda faces: faces[:1]),
    "truth far away": mesh("run/epoch_001/truth.ply", lambda found: found + 1e6),
    "rotation 0": put(RUN, epochs__1__registration__rotation=[[0.0] * 3] * 3),
    "rotation doubled": put(RUN, epochs__1__registration__rotation=[[2.0, 0, 0], [0, 2.0, 0], [0, 0, 2.0]]),
    "rotation 1e300": put(RUN, epochs__1__registration__rotation=[[1e300, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]),
    "translation 1e300": put(RUN, epochs__1__registration__translation_m=[1e300, 0.0, 0.0]),
    "registration null": put(RUN, epochs__1__registration=None),
    "statistics null": put(RUN, epochs__1__statistics=None),
    "sigma 1e300": put(RUN, epochs__1__statistics__sigma_m=1e300),
    "sigma 1e-320": put(RUN, epochs__1__statistics__sigma_m=1e-320),
    "epochs backwards": lambda folder: _backwards(folder),
    "epochs empty": put(RUN, epochs=[]),
    "wall of half a character": put(RUN, wall__name=_SURROGATE),
    "wall of 1 MB": put(RUN, wall__name="a" * 1_000_000),
    "config of another schema": put(RUN, schema=99),
    "config icp 0": put(RUN, config__icp={"max_iteration": 1, "subsample_ratio": 0.999999}),
    "config icp null": put(RUN, config__icp=None),
    "config seed 1e40": put(RUN, config__seed=10**40),
    "config mesh gone": put(RUN, config__wall={"mesh": "/none.ply"}),
    "block size huge": put(RUN, epochs__1__blocks__0__size_m=[1e300, 1e300, 1e300]),
    "block box backwards": put(RUN, epochs__1__blocks__0__bbox_m=[9.0, 9.0, 9.0, 0.0, 0.0, 0.0]),
    "block depth null": put(RUN, epochs__1__blocks__0__measured_mean_depth_m=None),
    "difference of another grid": lambda folder: map_of(np.zeros((7, 9)))(folder / "run/difference_001.tif"),
    "difference a folder": instead("run/difference_001.tif", lambda path: path.mkdir()),
    "points another file": lambda folder: (folder / "run/epoch_001/points.laz").write_bytes(b"LASF"),
    "points gone": lambda folder: (folder / "run/epoch_001/points.laz").unlink(missing_ok=True),
    "lock a folder": lambda folder: (folder / "run/.lock").mkdir(),
    "lock a pipe": lambda folder: instead("run/.lock", pipe)(folder),
    "products null": put(RUN, products=None),
    "products of a million": put(RUN, products=lambda: {f"epoch_{k:03d}": {} for k in range(1_000_000)}),
}  # fmt: skip


def _backwards(folder: Path) -> None:
    values = json.loads((folder / RUN).read_text())
    values["epochs"].reverse()
    (folder / RUN).write_text(json.dumps(values))


def _epoch_files(*moves: Callable[[Array], Array]) -> Change:
    def change(folder: Path) -> None:
        from pipeline.formats.points.points import read_points

        found = read_points(folder / "measurement/scan.ply").points
        for number, move in enumerate(moves):
            np.savetxt(folder / f"measurement/{number}.xyz", move(found), fmt="%.17g")
        put("measurement/measurement.yaml", points=[f"{number}.xyz" for number in range(len(moves))])(folder)

    return change


_MEASUREMENTS: dict[str, Change] = {
    "good": points(lambda found: found),
    "1 point": points(lambda found: found[:1]),
    "3 points": points(lambda found: found[:3]),
    "20 points": points(lambda found: found[::180][:20]),
    "identical points": points(lambda found: np.repeat(found[:1], 500, axis=0)),
    "points of one line": points(lambda found: found[:46]),
    "epoch of 3 points": _epoch_files(lambda found: found, lambda found: found[:3]),
    "epochs alike": _epoch_files(lambda found: found, lambda found: found),
    "epoch elsewhere": _epoch_files(lambda found: found, lambda found: found + 7),
    "no pattern": lambda folder: _no_pattern(folder),
    "stable areas outside": put("measurement/measurement.yaml", stable_areas=[[1000, 1000, 1001, 1001]]),
    "stable areas tiny": put("measurement/measurement.yaml", stable_areas=[[0.0, 0.0, 0.1, 0.1]]),
    "reference far": mesh("measurement/wall.ply", lambda found: found + 50),
    "reference of one triangle": mesh("measurement/wall.ply", lambda found: found, lambda faces: faces[:1]),
    "noise 1e300": put("measurement/model.yaml", noise={"range_sigma_m": 1e300}),
    "sensor of the other": put("measurement/measurement.yaml", sensor="stereo"),
}  # fmt: skip


def _no_pattern(folder: Path) -> None:
    path = folder / "measurement/measurement.yaml"
    values = yaml.safe_load(path.read_text())
    values.pop("pattern", None)
    path.write_text(yaml.safe_dump(values))


def _notes(folder: Path) -> None:
    path = folder / "measurement/measurement.yaml"
    path.write_text(path.read_text() + '\nnotes: ["\\uD800"]\n')


def cases() -> list[Case]:
    view = ("--no-browser", "--port", str(PORT_IN_USE))
    out = ("--out", "out", "--quiet")
    found = [Case(f"view: detections {name}", ("view", "run", "--detections", "found", *view), ("run",), spoil)
             for name, spoil in _DETECTIONS.items()]  # fmt: skip
    found += [
        Case(f"view: diagnosis {name}", ("view", "diagnosis", *view), ("diagnosis",), spoil) for name, spoil in _DIAGNOSES.items()
    ]
    for name, spoil in _SPLITS.items():
        found.append(Case(f"view: tiles {name}", ("view", "set/test", *view), ("set",), spoil))
        found.append(Case(f"det: tiles {name}", ("detect", "baseline", "set/test", *out), ("set",), spoil))
    for name, spoil in _EVALUATE.items():
        found.append(Case(f"ev: {name}", ("evaluate", TRUTH, FOUND, "--by", "noise", "--out", "out"), (TRUTH, FOUND), spoil))
    for name, spoil in _RUNS.items():
        found.append(Case(f"icp: run {name}", ("icp-study", "run", "--repeats", "1", *out), ("run",), spoil))
        found.append(Case(f"view: run {name}", ("view", "run", *view), ("run",), spoil))
        if not name.startswith(("surface", "truth", "block", "points", "lock", "products")):
            found.append(
                Case(
                    f"cmp: measured run {name}",
                    ("compare", SITE, "--measured", "run", "--epochs", "1", *out),
                    (SITE, "run"),
                    spoil,
                )
            )
        if name.startswith(("config", "epochs", "lock", "products", "difference", "points", "wall")):
            resumed = ("simulate", "--sensor", "tls", "--config", SITE, "--resume", "--out", "run", "--quiet")
            found.append(Case(f"sim: resumed {name}", resumed, (SITE, "run"), spoil))
            found.append(Case(f"cal: run {name}", ("calibrate", "run", "--no-greedy", *out), ("run",), spoil))
    for name, spoil in _MEASUREMENTS.items():
        found.append(Case(f"cal: measurement {name}", ("calibrate", "measurement", "--no-greedy", *out), ("measurement",), spoil))
        measured = ("compare", SITE, "--measured", "measurement", "--epochs", "1", *out)
        found.append(Case(f"cmp: measured {name}", measured, (SITE, "measurement"), spoil))
    found.append(Case("gap: notes of half a character", ("gap", "measurement", *out), ("measurement",), _notes))
    found.append(Case("icp: a mapping", ("icp-study", "run", *out), ("run",), whole(RUN, {"epochs": {"a": 1}})))
    return found
