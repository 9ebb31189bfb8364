"""Measure the commands that a user waits for as whole processes, from their start to their last product.

    python benchmarks/processes.py [--only demo surface detect]

Prints wall time, processor time of all threads and largest memory of the demo, of `surface` and of `detect default`. The maps of
`detect` have a dozen niches in each square of 256 px.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import scale

from pipeline.formats.points.laz import write_laz

POINTS = 45_000
MAPS_PX = {"detect smaller": (482, 2385), "detect larger": (1790, 1790)}
"""Rows and columns of the maps."""
DEMO = {"demo stereo": "stereo", "demo tls": "tls"}


def timed(name: str, words: Sequence[str]) -> None:
    """Run a command of scarpsim and print what it took."""
    start = time.perf_counter()
    cost = scale.run([sys.executable, "-c", scale.PROGRAM, *words])
    wall = time.perf_counter() - start
    print(f"{name:24} {wall:6.1f} s, processor {cost.seconds:6.1f} s, {cost.memory_gb:5.2f} GB", flush=True)


def demo(folder: Path) -> None:
    for name, sensor in DEMO.items():
        timed(name, ["simulate", "--sensor", sensor, "--out", str(folder / sensor)])


def surface(folder: Path) -> None:
    write_laz(folder / "cloud.laz", scale.rough_wall(POINTS, 1))
    timed("surface", ["surface", str(folder / "cloud.laz"), "--seen-from", "8", "5", "50", "--out", str(folder / "surface.ply")])


def detect(folder: Path) -> None:
    for name, shape in MAPS_PX.items():
        scale.write_map(folder / f"{name}.tif", shape)
        timed(name, ["detect", "default", str(folder / f"{name}.tif"), "--out", str(folder / name)])


COMMANDS = {"demo": demo, "surface": surface, "detect": detect}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(COMMANDS), default=list(COMMANDS))
    for name in parser.parse_args().only:
        with tempfile.TemporaryDirectory() as folder:
            COMMANDS[name](Path(folder))


if __name__ == "__main__":
    main()
