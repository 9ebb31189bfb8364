"""Bad inputs for `simulate`, `inspect`, `compare`, `icp-study`, `calibrate` and `view`: configs, runs and maps."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from benchmarks.bad_inputs.case import PORT_IN_USE, Case
from benchmarks.bad_inputs.spoil import (
    GONE,
    INFINITE,
    NAN,
    Change,
    bomb,
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

SITE, RUN = "site.yaml", "run/run.json"
_HUGE = "9" * 30
_NO_MESH = (
    "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nelement face 0\n"
    "property list uchar int vertex_indices\nend_header\n"
)
_OFFSET = {"name": "tls.range_offset", "offset_m": 0.001}
_CONFIGS: dict[str, Change] = {
    "epochs 1e9": put(SITE, epochs=10**9),
    "count 1e6 tiny": put(SITE, rockfall={"count": 1_000_000, "size_m": 0.01}),
    "count 1e30": put(SITE, rockfall={"count": 10**30, "size_m": 0.01}),
    "254 stations same place": put(SITE, station=[{"distance_m": 20.0}] * 254),
    "254 stations": put(SITE, station=[{"distance_m": 20.0 + k} for k in range(254)]),
    "stations empty": put(SITE, station=[]),
    "config is a FIFO": instead(SITE, pipe),
    "config /dev/zero": instead(SITE, link("/dev/zero")),
    "config is a folder": instead(SITE, lambda path: path.mkdir()),
    "config is a loop of links": instead(SITE, link(SITE)),
    "config of 50 MB": text(SITE, "# comment\n" * 5_000_000),
    "config one 50 MB line": text(SITE, "seed: " + "1" * 50_000_000),
    "config of 2 MB of keys": text(SITE, lambda: "".join(f"k{number}: 1\n" for number in range(200_000))),
    "config bomb": text(SITE, bomb()),
    "config merge bomb": text(SITE, merge_bomb()),
    "config nested": text(SITE, "a: " + "[" * 50_000),
    "config in UTF-16": text(SITE, "seed: 1\n".encode("utf-16")),
    "config with a tag": text(SITE, "seed: !!python/object/apply:os.system ['touch harm']\n"),
    "wall 1e6 m": put(SITE, wall__width_m=1e6),
    "wall 1e300 m": put(SITE, wall__width_m=1e300),
    "resolution 1e-9": put(SITE, wall__resolution_m=1e-9),
    "resolution 0": put(SITE, wall__resolution_m=0),
    "resolution larger than the wall": put(SITE, wall__resolution_m=50.0),
    "gsd 1e-9": put(SITE, difference__gsd_m=1e-9),
    "gsd 1e9": put(SITE, difference__gsd_m=1e9),
    "azimuth step 1e-12": put(SITE, scanner__azimuth_step_rad=1e-12),
    "azimuth step 1e300": put(SITE, scanner__azimuth_step_rad=1e300),
    "distance 1e300": put(SITE, station={"distance_m": 1e300}),
    "distance 0": put(SITE, station={"distance_m": 0.0}),
    "distance 1e-6": put(SITE, station={"distance_m": 1e-6}),
    "distance NaN": put(SITE, station={"distance_m": NAN}),
    "block 1e-9 m": put(SITE, rockfall={"count": 4, "size_m": 1e-9}),
    "block 1e300 m": put(SITE, rockfall={"count": 4, "size_m": 1e300}),
    "icp iterations 1e9": put(SITE, icp={"max_iteration": 10**9}),
    "icp ratio NaN": put(SITE, icp={"subsample_ratio": NAN}),
    "icp threshold 1e-300": put(SITE, icp={"outlier_distance_threshold": 1e-300}),
    "tiles 1 px": put(SITE, tiles={"size_px": 1}),
    "tiles 1e9 px": put(SITE, tiles={"size_px": 10**9}),
    "m3c2 scale 1e9": put(SITE, m3c2={"normal_scale_m": 1e9}),
    "seed 1e40": put(SITE, seed=10**40),
    "mesh symlink loop": both(instead("loop.ply", link("loop.ply")), put(SITE, wall={"mesh": "loop.ply"})),
    "mesh is a pipe": both(instead("pipe.ply", pipe), put(SITE, wall={"mesh": "pipe.ply"})),
    "mesh is /dev/zero": both(instead("zero.ply", link("/dev/zero")), put(SITE, wall={"mesh": "zero.ply"})),
    "mesh name very long": put(SITE, wall={"mesh": "a" * 5000 + ".ply"}),
    "mesh stl claims 4e9": both(text("a.stl", b"\0" * 80 + b"\xff\xff\xff\xff"), put(SITE, wall={"mesh": "a.stl"})),
    "mesh obj of 1e9 index": both(
        text("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 1000000000\n"), put(SITE, wall={"mesh": "a.obj"})
    ),
    "sensor 10000 effects": put(SITE, sensor=[{"sensor": "tls", "effects": [_OFFSET] * 10_000}]),
    "effect 1e300": put(SITE, sensor=[{"sensor": "tls", "effects": [{"name": "tls.range_offset", "offset_m": 1e300}]}]),
    "preset is a loop of links": both(instead("loop.yaml", link("loop.yaml")), put(SITE, scanner={"preset": "./loop.yaml"})),
    "preset is itself": put(SITE, scanner={"preset": "./site.yaml"}),
    "preset name very long": put(SITE, scanner={"preset": "a" * 5000}),
    "preset with markup": put(SITE, scanner={"preset": "<script>$x_"}),
}  # fmt: skip
_SIMULATE: dict[str, tuple[str, ...]] = {
    "--set huge int": ("--set", "seed=" + "1" * 5000),
    "--set huge float": ("--set", "wall.width_m=1e5000"),
    "--set of 1 MB": ("--set", "wall.style=" + "a" * 100_000),
    "--set deep": ("--set", ".".join(["a"] * 3000) + "=1"),
    "--set index huge": ("--set", "sensor." + "9" * 30 + "=1"),
    "--set unicode digit": ("--set", "sensor.\u00b2=1"),
    "--set not YAML": ("--set", "wall={"),
    "--seed huge": ("--seed", "1" * 5000),
    "--threads 1e9": ("--threads", "1000000000"),
    "--threads 0": ("--threads", "0"),
    "--resume nothing": ("--resume",),
    "--out is a file": ("--out", SITE),
    "--out very long": ("--out", "a" * 3000),
    "--out too deep": ("--out", "/".join(["a" * 200] * 30)),
    "--out a loop of links": ("--out", "loop"),
    "--config very long": ("--config", "a" * 5000),
    "--config with control characters": ("--config", "\u001b[31mred\n\u0007"),
}
_RUNS: dict[str, Change] = {
    "run.json odd": put(RUN, epochs=7),
    "run.json {}": whole(RUN, {}),
    "run.json []": whole(RUN, []),
    "run.json null": whole(RUN, None),
    "run.json empty": text(RUN, ""),
    "run.json cut": cut(RUN),
    "run.json binary": text(RUN, bytes(range(256))),
    "run.json nested": text(RUN, "[" * 100_000),
    "run.json is a pipe": instead(RUN, pipe),
    "run.json is a folder": instead(RUN, lambda path: path.mkdir()),
    "run.json is /dev/zero": instead(RUN, link("/dev/zero")),
    "run.json is a loop of links": instead(RUN, link("run.json")),
    "run.json sensor radar": put(RUN, sensor="radar"),
    "run.json sensor a list": put(RUN, sensor=["tls"]),
    "run.json sensor gone": put(RUN, sensor=GONE),
    "run.json config gone": put(RUN, config=GONE),
    "run.json config []": put(RUN, config=[]),
    "run.json config wrong": put(RUN, config__wall=7),
    "run.json wall a number": put(RUN, wall=3),
    "run.json epoch gone": put(RUN, epochs__1__epoch=GONE),
    "run.json epoch text": put(RUN, epochs__1__epoch="../../x"),
    "run.json epoch 1e9": put(RUN, epochs__1__epoch=10**9),
    "run.json epoch twice": put(RUN, epochs__1__epoch=2),
    "run.json rotation of words": put(RUN, epochs__1__registration__rotation="none"),
    "run.json rotation NaN": put(RUN, epochs__1__registration__rotation=[[NAN] * 3] * 3),
    "run.json rotation of 2": put(RUN, epochs__1__registration__rotation=[[1, 0]] * 2),
    "run.json sigma NaN": put(RUN, epochs__1__statistics__sigma_m=NAN),
    "run.json sigma 0": put(RUN, epochs__1__statistics__sigma_m=0),
    "run.json blocks of words": put(RUN, epochs__1__blocks=["a"]),
    "run.json block without a box": put(RUN, epochs__1__blocks__0__bbox_m=GONE),
    "run.json products outside": put(RUN, products={"epoch_000": {"../../etc/passwd": "0"}}),
    "map gone": gone("run/difference_001.tif"),
    "map cut": cut("run/difference_001.tif"),
    "map a bomb": instead("run/difference_001.tif", claiming_tiff),
    "map a pipe": instead("run/difference_001.tif", pipe),
    "map a loop of links": instead("run/difference_001.tif", link("difference_001.tif")),
    "surface gone": gone("run/epoch_001/surface.ply"),
    "surface cut": cut("run/epoch_001/surface.ply"),
    "surface a pipe": instead("run/epoch_001/surface.ply", pipe),
    "surface empty": text("run/epoch_001/surface.ply", _NO_MESH),
    "truth gone": gone("run/epoch_001/truth.ply"),
    "epoch gone": lambda folder: shutil.rmtree(folder / "run/epoch_001"),
}  # fmt: skip
_ICP: dict[str, tuple[str, ...]] = {
    "offset 1e300": ("run", "--offset-m", "1e300"),
    "offset nan": ("run", "--offset-m", "nan"),
    "offset -1": ("run", "--offset-m", "-1"),
    "offset 90": ("run", "--offset-m", "90"),
    "epochs 99 of 3": ("run", "--epochs", "99"),
    "epochs 1e9": (SITE, "--epochs", "1000000000"),
    "epochs 9999 of a config": (SITE, "--epochs", "9999", "--sensor", "tls"),
    "repeats 1e9": ("run", "--repeats", "1000000000"),
    "repeats 9999": ("run", "--repeats", "9999"),
    "no such run": ("nowhere",),
    "a set": ("set.yaml",),
}
_COMPARE: dict[str, tuple[str, ...]] = {
    "epochs 1e9": (SITE, "--epochs", "1000000000"),
    "epochs 1": (SITE, "--epochs", "1"),
    "same config 3x": (SITE, SITE, SITE),
    "config name with $ (mathtext)": ("cost$x_{$.yaml", "--epochs", "2"),
    "config name with markup": ("<b>&amp;.yaml", "--epochs", "2"),
    "config name very long": ("a" * 240 + ".yaml", "--epochs", "2"),
    "sizes nan": (SITE, "--sizes-m", "nan", "0.5"),
    "sizes negative": (SITE, "--sizes-m", "-1", "0.5"),
    "sizes backwards": (SITE, "--sizes-m", "0.5", "0.05"),
    "sizes 1e300": (SITE, "--sizes-m", "0.5", "1e300"),
    "sizes 1e-300": (SITE, "--sizes-m", "1e-300", "0.5"),
    "sizes larger than the wall": (SITE, "--sizes-m", "50", "60"),
    "measured nowhere": (SITE, "--measured", "nowhere", "--epochs", "2"),
    "measured a run without maps": (SITE, "--measured", "set", "--epochs", "2"),
    "no config": ("nowhere.yaml",),
    "an unknown preset": ("riegl_9000",),
    "100 configs": tuple(["riegl_vz400i", "faro_s350"] * 50),
}
_CALIBRATE: dict[str, Change] = {
    "all 0": lambda folder: _maps(folder, 0.0),
    "all NaN": lambda folder: _maps(folder, NAN),
    "all infinite": lambda folder: _maps(folder, INFINITE),
    "all 1e38": lambda folder: _maps(folder, 1e38),
    "one pixel": lambda folder: map_of([[0.1]])(folder / "run/difference_001.tif"),
    "one infinite": lambda folder: map_of(np.where(np.eye(100, 160), INFINITE, 0.01))(folder / "run/difference_001.tif"),
    "scale 0": lambda folder: _georeference(folder, 0.0),
    "scale NaN": lambda folder: _georeference(folder, NAN),
    "scale 1e-300": lambda folder: _georeference(folder, 1e-300),
    "scale 1e300": lambda folder: _georeference(folder, 1e300),
    "scale negative": lambda folder: _georeference(folder, -0.05),
    "a map a bomb": instead("run/difference_001.tif", claiming_tiff),
    "a map a pipe": instead("run/difference_001.tif", pipe),
}  # fmt: skip
_MAP = "run/difference_001.tif"
_CALIBRATION: dict[str, tuple[str, ...]] = {
    "same map twice": (_MAP, _MAP, "--sensor", "tls", "--config", SITE),
    "one map": (_MAP,),
    "no such map": ("none.tif",),
    "a picture": ("run/reference.png",),
    "a folder of nothing": ("set",),
    "no greedy": ("run", "--no-greedy", "--set", "calibration.windows=1000000000"),
    "simulations 1e9": ("run", "--set", "calibration.simulations=1000000000"),
    "window 1 px": ("run", "--set", "calibration.window_px=1"),
    "window 1e9 px": ("run", "--set", "calibration.window_px=1000000000"),
    "stable areas outside": ("run", "--set", "calibration.stable_areas=[[1000,1000,1001,1001]]"),
    "stable areas NaN": ("run", "--set", "calibration.stable_areas=[[.nan,0,1,1]]"),
    "stereo of a TLS run": ("run", "--sensor", "stereo"),
}
_VIEW: dict[str, tuple[str, ...]] = {
    "port 99999": ("run", "--port", "99999"),
    "port -1": ("run", "--port", "-1"),
    "port 1e30": ("run", "--port", _HUGE),
    "nothing to look at": ("set",),
    "no such folder": ("nowhere",),
    "a file": (SITE,),
    "very long": ("a" * 5000,),
    "detections of nothing": ("run", "--detections", "set"),
    "detections nowhere": ("run", "--detections", "nowhere"),
    "detections of a diagnosis": ("diagnosis", "--detections", "run"),
}
_GAP = "diagnosis/gap.json"
_DIAGNOSES: dict[str, Change] = {
    "gap.json {}": whole(_GAP, {}),
    "gap.json []": whole(_GAP, []),
    "gap.json cut": cut(_GAP),
    "gap.json is a pipe": instead(_GAP, pipe),
    "gap.json sensor radar": put(_GAP, sensor="radar"),
    "gap.json changes of words": put(_GAP, scene_changes=["a"]),
    "gap.json changes NaN": put(_GAP, scene_changes=[{"bbox_m": [NAN] * 6, "volume_m3": 1}]),
    "gap.json verdict a list": put(_GAP, verdict=[1]),
    "before.laz cut": cut("diagnosis/before.laz"),
    "before.laz gone": gone("diagnosis/before.laz"),
    "before.laz is a pipe": instead("diagnosis/before.laz", pipe),
    "before.laz is after.laz cut": cut("diagnosis/after.laz"),
}  # fmt: skip


def _maps(folder: Path, value: float) -> None:
    for number in (1, 2):
        map_of(np.full((100, 160), value))(folder / f"run/difference_{number:03d}.tif")


def _georeference(folder: Path, scale: float) -> None:
    import tifffile

    with tifffile.TiffFile(folder / _MAP, mode="r+b") as file:
        file.pages.first.tags[33550].overwrite((scale, scale, 0.0))


def _named(folder: Path) -> None:
    """site.yaml under every name that COMPARE uses, and a loop of links."""
    for words in _COMPARE.values():
        name = words[0]
        if name.endswith(".yaml") and name not in (SITE, "nowhere.yaml"):
            shutil.copy(folder / SITE, folder / name)
    (folder / "loop").symlink_to("loop")


def cases() -> list[Case]:
    out = ("--out", "out", "--quiet")
    found = []
    for name, spoil in _CONFIGS.items():
        words = ("simulate", "--sensor", "tls", "--config", SITE)
        found.append(Case(f"sim: {name}", (*words, *out), (SITE,), spoil))
        if name.startswith(("config", "mesh", "wall", "count")):
            found.append(Case(f"inspect: {name}", ("inspect", SITE, *out), (SITE,), spoil))
            found.append(Case(f"cmp: {name}", ("compare", SITE, "--epochs", "2", *out), (SITE,), spoil))
    for block in ("1e300", "1e-300", "nan", "-1"):
        words = ("inspect", SITE, "--set", f"planning.block_size_m=[{block}]")
        found.append(Case(f"inspect: block_size {block}", (*words, *out), (SITE,)))
    found.append(
        Case(
            "inspect: block_size of 1000",
            ("inspect", SITE, "--set", f"planning.block_size_m={[k / 1000 for k in range(1, 1001)]}", *out),
            (SITE,),
        )
    )
    needs = (SITE, "set.yaml", "run", "set", "diagnosis")
    for name, given in _SIMULATE.items():
        words = ("simulate", "--sensor", "tls", "--quiet", *(() if "--config" in given else ("--config", SITE)))
        found.append(Case(f"sim: {name}", (*words, *given, *(() if "--out" in given else ("--out", "out"))), (SITE,), _named))
    for command, words_by_name, short in (
        ("icp-study", _ICP, "icp"),
        ("compare", _COMPARE, "cmp"),
        ("calibrate", _CALIBRATION, "cal"),
    ):
        for name, given in words_by_name.items():
            found.append(Case(f"{short}: {name}", (command, *given, *out), needs, _named))
    for name, spoil in _CALIBRATE.items():
        maps = ("calibrate", "run/difference_001.tif", "run/difference_002.tif", "--sensor", "tls", "--config", SITE)
        found.append(Case(f"cal: {name}", (*maps, *out), needs, spoil))
    for name, spoil in _RUNS.items():
        if name != "run.json products outside":
            found.append(Case(f"icp: {name}", ("icp-study", "run", *out), ("run",), spoil))
            found.append(Case(f"view: {name}", ("view", "run", "--no-browser", "--port", str(PORT_IN_USE)), ("run",), spoil))
        found.append(Case(f"cal: {name}", ("calibrate", "run", *out), ("run",), spoil))
        found.append(Case(f"cmp: {name}", ("compare", "run", "--epochs", "2", *out), ("run",), spoil))
        resumed = ("simulate", "--sensor", "tls", "--config", SITE, "--resume", "--out", "run", "--quiet")
        found.append(Case(f"sim: {name}", resumed, (SITE, "run"), spoil))
    for name, given in _VIEW.items():
        port = () if "--port" in given else ("--port", str(PORT_IN_USE))
        found.append(Case(f"view: {name}", ("view", *given, *port, "--no-browser"), needs))
    for name, spoil in _DIAGNOSES.items():
        found.append(
            Case(f"view: {name}", ("view", "diagnosis", "--no-browser", "--port", str(PORT_IN_USE)), ("diagnosis",), spoil)
        )
    return found
