"""Bad inputs for `export`: runs and data sets that were damaged after they were written."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bad_inputs.case import Case
from benchmarks.bad_inputs.spoil import (
    GONE,
    INFINITE,
    NAN,
    Array,
    Change,
    both,
    claiming_tiff,
    cut,
    gone,
    instead,
    link,
    map_of,
    mesh,
    pipe,
    put,
    text,
    whole,
)
from pipeline.formats.meshes.ply import read_ply, write_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import read_laz, write_laz
from scene.geometry.mesh import TriangleMesh

RUN, MAP, TILES = "run/run.json", "run/difference_001.tif", "set/train/annotations.json"
BEFORE, AFTER, POINTS = "run/epoch_000/surface.ply", "run/epoch_001/surface.ply", "run/epoch_001/points.laz"
_BLOCK = "epochs__1__blocks__0__"


def _set_record(**values: Any) -> Change:
    """Of all images in train."""

    def change(folder: Path) -> None:
        content = json.loads((folder / TILES).read_text())
        for image in content["images"]:
            image.update(values)
        (folder / TILES).write_text(json.dumps(content))

    return change


def _cloud(move: Callable[[PointCloud], PointCloud]) -> Change:
    def change(folder: Path) -> None:
        cloud = move(read_laz(folder / POINTS))
        (folder / POINTS).unlink()
        write_laz(folder / POINTS, cloud)

    return change


def _places(move: Callable[[Array], Array]) -> Change:
    return _cloud(lambda cloud: PointCloud(move(cloud.points), gps_time=np.arange(len(move(cloud.points)), dtype=float)))


def _clock(move: Callable[[Array], Array]) -> Change:
    return _cloud(lambda cloud: PointCloud(cloud.points, gps_time=move(np.arange(len(cloud.points), dtype=float))))


def _surface(move: Callable[[TriangleMesh], TriangleMesh], name: str = AFTER) -> Change:
    def change(folder: Path) -> None:
        found = move(read_ply(folder / name))
        (folder / name).unlink()
        write_ply(folder / name, found)

    return change


def _tile(values: Any) -> Change:
    """Return a change that gives the first tile of train other values."""

    def change(folder: Path) -> None:
        first = json.loads((folder / TILES).read_text())["images"][0]["file_name"]
        instead(f"set/train/{first}", map_of(values))(folder)

    return change


def _first_tile(make: Callable[[Path], object]) -> Change:
    return lambda folder: instead(f"set/train/{json.loads((folder / TILES).read_text())['images'][0]['file_name']}", make)(folder)


def _many_files(folder: Path) -> None:
    for number in range(5000):
        (folder / f"run/{number}.txt").write_text("")


def _deep(folder: Path) -> None:
    inner = folder / "run"
    for _ in range(300):
        inner = inner / "a"
        inner.mkdir()
    (inner / "b.txt").write_text("deep")


def _sparse(folder: Path) -> None:
    with (folder / "run/huge.bin").open("wb") as file:
        file.truncate(60_000_000_000)


_SURFACES: dict[str, Change] = {
    "surface gone": gone(AFTER),
    "surface cut": cut(AFTER),
    "surface empty": text(AFTER, ""),
    "surface of text": text(AFTER, "ply\nformat ascii 1.0\nend_header\n"),
    "surface a folder": instead(AFTER, lambda path: path.mkdir()),
    "surface a pipe": instead(AFTER, pipe),
    "surface /dev/zero": instead(AFTER, link("/dev/zero")),
    "surface a loop of links": instead(AFTER, link("surface.ply")),
    "surface of NaN": mesh(AFTER, lambda found: found * NAN),
    "surface one NaN": mesh(AFTER, lambda found: np.where(np.arange(len(found))[:, None] == 7, NAN, found)),
    "surface 1e300": mesh(AFTER, lambda found: found * 1e300),
    "surface 1e9 away": mesh(AFTER, lambda found: found + 1e9),
    "surface of one place": mesh(AFTER, lambda found: found * 0),
    "surface of one line": mesh(AFTER, lambda found: found * [1, 0, 0]),
    "surface without faces": mesh(AFTER, lambda found: found, lambda faces: faces[:0]),
    "surface without vertices": mesh(AFTER, lambda found: found[:0], lambda faces: faces[:0]),
    "surface face out of range": mesh(AFTER, lambda found: found, lambda faces: faces + 100_000),
    "surface negative faces": mesh(AFTER, lambda found: found, lambda faces: faces - 5),
    "surface elsewhere": mesh(AFTER, lambda found: found + 500),
    "surface in mm": mesh(AFTER, lambda found: found * 1000),
    "surface turned": mesh(AFTER, lambda found: found[:, [2, 0, 1]]),
    "surface labels negative": _surface(
        lambda found: TriangleMesh(found.vertices, found.faces, np.full(len(found.faces), -7, np.int32))
    ),
    "surface labels 1e9": _surface(
        lambda found: TriangleMesh(found.vertices, found.faces, np.arange(len(found.faces), dtype=np.int32) + 1_000_000_000)
    ),
    "reference surface NaN": mesh(BEFORE, lambda found: found * NAN),
    "reference surface of one place": mesh(BEFORE, lambda found: found * 0 + 3),
    "reference surface of one line": mesh(BEFORE, lambda found: found * [0, 1, 0]),
    "reference surface 1e300": mesh(BEFORE, lambda found: found * 1e300),
    "reference surface without vertices": mesh(BEFORE, lambda found: found[:0], lambda faces: faces[:0]),
    "reference surface behind": mesh(BEFORE, lambda found: found * [1, 1, 0] - [0, 0, 1e4]),
    "reference surface very tall": mesh(BEFORE, lambda found: found * [1e-5, 1e4, 1]),
    "reference surface very wide": mesh(BEFORE, lambda found: found * [1e4, 1e-5, 1]),
    "map gone": gone(MAP),
    "map cut": cut(MAP),
    "map of gigabytes": instead(MAP, claiming_tiff),
    "map of NaN": instead(MAP, map_of(np.full((40, 60), NAN))),
    "map infinite": instead(MAP, map_of(np.full((40, 60), INFINITE))),
    "map 1e38": instead(MAP, map_of(np.full((40, 60), 1e38))),
    "map one pixel": instead(MAP, map_of(np.zeros((1, 1)))),
    "map a pipe": instead(MAP, pipe),
    "map a picture": lambda folder: shutil.copy(folder / "run/reference.png", folder / MAP),
    "sigma 1e-300": put(RUN, epochs__1__statistics__sigma_m=1e-300),
    "sigma 1e8": put(RUN, epochs__1__statistics__sigma_m=1e8),
    "sigma gone": put(RUN, epochs__1__statistics__sigma_m=GONE),
    "statistics gone": put(RUN, epochs__1__statistics=GONE),
    "statistics null": put(RUN, epochs__1__statistics=None),
    "blocks gone": put(RUN, epochs__1__blocks=GONE),
    "block position 1e8": put(RUN, **{f"{_BLOCK}position_m": [1e8] * 3}),
    "block position behind": put(RUN, **{f"{_BLOCK}position_m": [0.0, 0.0, 1e6]}),
    "block volume 1e300": put(RUN, **{f"{_BLOCK}volume_m3": 1e300}),
    "block volume -1": put(RUN, **{f"{_BLOCK}volume_m3": -1.0}),
    "block label of 300 digits": put(RUN, **{f"{_BLOCK}label": 10**300}),
    "block label twice": put(RUN, **{f"{_BLOCK}label": 2}),
    "wall gone": put(RUN, wall=GONE),
    "sensor of the other": put(RUN, sensor="stereo"),
    "one epoch": lambda folder: put(RUN, epochs=json.loads((folder / RUN).read_text())["epochs"][:1])(folder),
    "epochs backwards": lambda folder: put(RUN, epochs=json.loads((folder / RUN).read_text())["epochs"][::-1])(folder),
    "epochs 9999 times": lambda folder: put(RUN, epochs=json.loads((folder / RUN).read_text())["epochs"][1:2] * 9999)(folder),
    "run.json gone": gone(RUN),
    "run.json a list": whole(RUN, []),
    "run.json a pipe": instead(RUN, pipe),
    "folder a link of itself": lambda folder: (folder / "run/again").symlink_to("."),
}
_POINTS: dict[str, Change] = {
    "points gone": gone(POINTS),
    "points cut": cut(POINTS),
    "points none": _places(lambda found: found[:0]),
    "points 1": _places(lambda found: found[:1]),
    "points 3": _places(lambda found: found[:3]),
    "points of one place": _places(lambda found: found * 0 + 2),
    "points of one line": _places(lambda found: found * [1, 0, 0]),
    "points of one upright line": _places(lambda found: found * [0, 1, 0]),
    "points of one line of sight": _places(lambda found: found * 0 + np.linspace(0, 1, len(found))[:, None] * [-0.42, -0.12, 1]),
    "points one far": _places(lambda found: np.vstack([found, [1e6, 0, 0]])),
    "points in km": _places(lambda found: found * 1000),
    "points without a clock": _cloud(lambda cloud: PointCloud(cloud.points)),
    "clock NaN": _clock(lambda clock: clock * NAN),
    "clock infinite": _clock(lambda clock: clock + INFINITE),
    "clock 1e300": _clock(lambda clock: clock * 1e300),
    "clock backwards": _clock(lambda clock: clock[::-1]),
    "clock alike": _clock(lambda clock: clock * 0),
    "stereo": put(RUN, sensor="stereo"),
}
_SETS: dict[str, Change] = {
    "noise null": _set_record(noise_sigma_m=None),
    "noise 0": _set_record(noise_sigma_m=0),
    "noise 1e-300": _set_record(noise_sigma_m=1e-300),
    "noise -1": _set_record(noise_sigma_m=-1.0),
    "noise a word": _set_record(noise_sigma_m="low"),
    "noise a list": _set_record(noise_sigma_m=[1]),
    "noise true": _set_record(noise_sigma_m=True),
    "names alike": _set_record(file_name="a.tif"),
    "name outside": _set_record(file_name="../../run/difference_001.tif"),
    "name absolute": _set_record(file_name="/etc/passwd"),
    "name a null character": _set_record(file_name="a\0.tif"),
    "name of markup": _set_record(file_name="<b>.tif"),
    "truth_file_name outside": _set_record(truth_file_name="../../x.tif"),
    "truth_file_name a number": _set_record(truth_file_name=3),
    "truth_file_name gone": _set_record(truth_file_name="none.tif"),
    "width 1e9": _set_record(width=1_000_000_000),
    "sensor a list": _set_record(sensor=[1]),
    "tile gone": _first_tile(lambda path: None),
    "tile a pipe": _first_tile(pipe),
    "tile a folder": _first_tile(lambda path: path.mkdir()),
    "tile out of the set": _first_tile(link("/etc/passwd")),
    "tile of gigabytes": _first_tile(claiming_tiff),
    "tile empty": _first_tile(lambda path: path.write_bytes(b"")),
    "tile of another size": _tile(np.zeros((7, 9))),
    "tile infinite": _tile(np.full((48, 48), INFINITE)),
    "tile 1e38": _tile(np.full((48, 48), 1e38)),
    "tile of NaN": _tile(np.full((48, 48), NAN)),
    "annotations a list": whole(TILES, []),
    "annotations empty": put(TILES, annotations=[]),
    "images empty": put(TILES, images=[], annotations=[]),
    "masks of another size": put(TILES, annotations__0__segmentation={"size": [3, 3], "counts": [9]}),
    "masks empty": put(TILES, annotations__0__segmentation={"size": [48, 48], "counts": [2304]}),
    "masks a checkerboard": put(TILES, annotations__0__segmentation={"size": [48, 48], "counts": [1] * 2304}),
    "masks polygons": put(TILES, annotations__0__segmentation=[[1, 1, 20, 1, 20, 20]]),
    "category of another": put(TILES, annotations__0__category_id=9),
    "a split a file": both(lambda folder: shutil.rmtree(folder / "set/val"), text("set/val", "a file")),
    "no split": lambda folder: [shutil.rmtree(folder / "set" / name) for name in ("train", "val", "test")],
}
_FOLDERS: dict[str, Change] = {
    "of a pipe": lambda folder: pipe(folder / "run/pipe"),
    "of a device": lambda folder: (folder / "run/zero").symlink_to("/dev/zero"),
    "of a loop": lambda folder: (folder / "run/loop").symlink_to("loop"),
    "of itself": lambda folder: (folder / "run/again").symlink_to("."),
    "of a link out": lambda folder: (folder / "run/passwd").symlink_to("/etc/passwd"),
    "of a link to all": lambda folder: (folder / "run/all").symlink_to("/"),
    "of 5000 files": _many_files,
    "of 300 folders in one another": _deep,
    "of 60 GB": _sparse,
    "of names in Latin 1": lambda folder: Path(os.fsdecode(os.fsencode(folder / "run") + b"/h\xf6he.txt")).write_text(""),
    "of a line's end": lambda folder: (folder / "run/two\nlines").write_text(""),
    "of hidden files alone": lambda folder: [shutil.rmtree(folder / "run"), (folder / "run").mkdir(), pipe(folder / "run/.a")],
    "that is a file": both(lambda folder: shutil.rmtree(folder / "run"), text("run", "a file")),
    "that is none": lambda folder: shutil.rmtree(folder / "run"),
    "with a package that is a folder": lambda folder: (folder / "run/datapackage.json").mkdir(),
}
_WORDS: dict[str, tuple[str, ...]] = {
    "form unknown": ("run", "obj"),
    "form empty": ("run", ""),
    "form alone": ("run",),
    "folder empty": ("", "picture"),
    "folder a file": ("site.yaml", "picture"),
    "folder a set": ("set", "picture"),
    "folder a diagnosis": ("diagnosis", "gltf"),
    "yolo of a run": ("run", "yolo", "--out", "out"),
    "yolo of a split": ("set/train", "yolo", "--out", "out"),
    "yolo into the set": ("set", "yolo", "--out", "set"),
    "yolo into its split": ("set", "yolo", "--out", "set/train"),
    "yolo out a file": ("set", "yolo", "--out", "site.yaml"),
    "yolo limit 1e-300": ("set", "yolo", "--out", "out", "--limit-m", "1e-300"),
    "yolo limit nan": ("set", "yolo", "--out", "out", "--limit-m", "nan"),
    "epoch 3": ("run", "picture", "--epoch", "3", "--out", "a.png"),
    "epoch 9999": ("run", "gltf", "--epoch", "9999", "--out", "a.glb"),
    "epoch -1": ("run", "picture", "--epoch", "-1", "--out", "a.png"),
    "epoch 0 of gltf": ("run", "gltf", "--epoch", "0", "--out", "a.glb"),
    "epoch 1e300": ("run", "scan", "--epoch", "1e300", "--out", "a.gif"),
    "epoch of 5000 digits": ("run", "scan", "--epoch", "9" * 5000, "--out", "a.gif"),
    "width 1": ("run", "picture", "--width", "1", "--out", "a.png"),
    "width 1e9": ("run", "picture", "--width", "1000000000", "--out", "a.png"),
    "width of gltf": ("run", "gltf", "--width", "400", "--out", "a.glb"),
    "out of another ending": ("run", "picture", "--out", "a.jpg"),
    "out without an ending": ("run", "epochs", "--out", "a"),
    "out empty": ("run", "picture", "--out", ""),
    "out under a file": ("run", "gltf", "--out", "site.yaml/a.glb"),
    "out a folder": ("run", "picture", "--out", "a folder.png"),
    "out a loop": ("run", "picture", "--out", "loop.png"),
    "out a pipe": ("run", "scan", "--out", "pipe.gif"),
    "out very long": ("run", "picture", "--out", "a" * 3000 + ".png"),
    "out a device": ("run", "package", "--out", "/dev/full"),
    "out in no folder": ("run", "package", "--out", "none/deep/a.json"),
    "package out a folder": ("run", "package", "--out", "set"),
    "package of a file": ("site.yaml", "package"),
    "package out closed": ("run", "package", "--out", "/proc/a.json"),
}


def _beside(folder: Path) -> None:
    (folder / "a folder.png").mkdir()
    (folder / "loop.png").symlink_to("loop.png")
    pipe(folder / "pipe.gif")


def cases() -> list[Case]:
    found = []
    for number, (name, spoil) in enumerate(_SURFACES.items()):
        forms = ("picture", "gltf", "epochs")
        form = forms[number % 3]
        out = ("--out", f"out{'.png' if form == 'picture' else '.glb' if form == 'gltf' else '.gif'}", "--quiet")
        found.append(Case(f"export: {form}, {name}", ("export", "run", form, *out), ("run",), spoil))
    for name, spoil in _POINTS.items():
        found.append(Case(f"export: scan, {name}", ("export", "run", "scan", "--out", "out.gif", "--quiet"), ("run",), spoil))
    for name, spoil in _SETS.items():
        found.append(Case(f"export: yolo, {name}", ("export", "set", "yolo", "--out", "out", "--quiet"), ("set",), spoil))
    for name, spoil in _FOLDERS.items():
        found.append(Case(f"export: package {name}", ("export", "run", "package", "--quiet"), ("run",), spoil))
    needs = ("site.yaml", "run", "set", "diagnosis")
    for name, words in _WORDS.items():
        found.append(Case(f"export: {name}", ("export", *words, "--quiet"), needs, _beside))
    return found
