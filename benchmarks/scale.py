"""Measure how the cost of each command grows with its work: 1, 4 and 16 times the pulses, triangles, blocks, map pixels, epochs.

    python benchmarks/scale.py [--only simulate:pulses detect ...] [--write]

Each command runs as a process of its own, after one run of the smallest size that fills the kernel cache. Processor time of all
threads is counted, because other work on the machine changes it little. The exponent is that of the part that grows: with times
a, b and c at 1, 4 and 16 times the work it is log4((c - b) / (b - a)), 1 for linear growth, so that the fixed cost of starting
does not count. --write puts table and figure into docs/validation/performance.md.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from documents import printed, write_between

from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from pipeline.formats.rasters.geotiff import write_geotiff
from scene.geometry.grid import Grid

DOCUMENT = Path(__file__).parents[1] / "docs" / "validation" / "performance.md"
FIGURE = DOCUMENT.parent / "images" / "scale.png"
MARKS = "<!-- scale -->", "<!-- end of scale -->"
TIMES = (1, 4, 16)
LEAST_GROWTH_S, LEAST_GROWTH_GB = 1.0, 0.1
"""Growth from 1 to 16 times the work below which no exponent is stated: it would be that of the noise."""
PROGRAM = "import sys; from pipeline.cli.main import main; sys.exit(main(sys.argv[1:]))"
SITE = {
    "wall": "{style: glendale, width_m: 16, height_m: 10, resolution_m: %.5g}",
    "rockfall": "{count: %d, size_m: 0.3, minimum_distance_m: 0.02, maximum_attempts: 100000}",
    "station": "{distance_m: 50}",
    "cameras": "{distance_m: 50, base_m: 13}",
    "scanner": "{azimuth_step_rad: %.5g, zenith_step_rad: %.5g}",
    "difference": "{gsd_m: %.5g}",
}
RESOLUTION_M, STEP_RAD, GSD_M, BLOCKS = 0.08, 0.0008, 0.04, 10
"""Of the smallest site: 50,000 triangles, 100,000 pulses, 100,000 map pixels."""
POINTS, MAP_PX = 45_000, 512
"""Points of the smallest cloud, and side of the smallest difference map."""


@dataclass(frozen=True)
class Cost:
    """What one process took: processor time of all its threads, s, and its largest memory, GB."""

    seconds: float
    memory_gb: float


@dataclass(frozen=True)
class Work:
    """One command with a work that grows.

    Attributes
    ----------
    command : Words of the command before its inputs.
    grows : What grows, with its number at the smallest size.
    inputs : Writes inputs into a folder for a multiple of the work, and returns the further words of the command.
    """

    command: str
    grows: str
    inputs: Callable[[Path, int], Sequence[str]]

    @property
    def name(self) -> str:
        """Name of the work for --only."""
        return f"{self.command.split()[0]}:{self.grows.split()[0]}"

    def cost(self, times: int) -> Cost:
        """Run the command with a multiple of the smallest work."""
        with tempfile.TemporaryDirectory() as folder:
            words = [*self.command.split(), *self.inputs(Path(folder), times)]
            return run([sys.executable, "-c", PROGRAM, *words, "--out", str(Path(folder) / OUT.get(self.name, "out"))])


OUT = {"surface:points": "out.ply"}
"""Names of results that are no folders."""


def run(command: Sequence[str]) -> Cost:
    """Run a process to its end; raise CalledProcessError if it fails."""
    with tempfile.TemporaryFile() as told:
        process = subprocess.Popen(command, stdout=told, stderr=told)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            told.seek(0)
            raise subprocess.CalledProcessError(process.returncode, command, told.read().decode(errors="replace"))
    return Cost(used.ru_utime + used.ru_stime, used.ru_maxrss / 1e6)


def simulation(
    sensor: str, *, pulses: int = 1, triangles: int = 1, blocks: int = 1, pixels: int = 1, epochs: int = 1
) -> list[str]:
    """Return the words of a simulation of the small site with multiples of its parts."""
    step = STEP_RAD / math.sqrt(pulses)
    filled = {
        "wall": (RESOLUTION_M / math.sqrt(triangles),),
        "rockfall": (BLOCKS * blocks,),
        "scanner": (step, step),
        "difference": (GSD_M / math.sqrt(pixels),),
    }
    settings = {key: value % filled.get(key, ()) for key, value in SITE.items()} | {"epochs": str(epochs)}
    return ["--sensor", sensor, *(word for key, value in settings.items() for word in ("--set", f"{key}={value}"))]


def rough_wall(count: int, seed: int, niche: float = 0.0) -> PointCloud:
    """Return points of a rough wall of 16 x 10 m that looks along +z, 5 mm of noise; niche: depth of a niche of 1 m, m."""
    random = np.random.default_rng(seed)
    columns = math.isqrt(count * 16 // 10)
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 16, columns), np.linspace(0, 10, count // columns)))
    z = 0.3 * np.sin(1.3 * x) * np.cos(0.9 * y) + random.normal(0, 0.005, x.size)
    z -= niche * ((np.abs(x - 8) < 0.5) & (np.abs(y - 5) < 0.5))
    return PointCloud(np.stack([x, y, z], axis=1))


def cloud_words(folder: Path, times: int) -> list[str]:
    """Write a cloud to mesh."""
    write_laz(folder / "cloud.laz", rough_wall(POINTS * times, 1))
    return [str(folder / "cloud.laz"), "--seen-from", "8", "5", "50"]


def epochs_words(folder: Path, points: int, epochs: int) -> list[str]:
    """Write clouds of several epochs to monitor; the rock falls before the second one."""
    files = [folder / f"2026-03-{number + 1:02d}.laz" for number in range(epochs + 1)]
    for number, file in enumerate(files):
        write_laz(file, rough_wall(points, number, 0.3 if number else 0.0))
    return [*map(str, files), "--position", "8,5,50"]


def map_words(folder: Path, times: int) -> list[str]:
    """Write a square difference map."""
    side = MAP_PX * math.isqrt(times)
    write_map(folder / "map.tif", (side, side))
    return [str(folder / "map.tif")]


def write_map(path: Path, shape: tuple[int, int]) -> None:
    """Write a difference map, m, of (rows, columns), with a dozen niches in each 256 px square."""
    random, (rows_px, columns_px) = np.random.default_rng(1), shape
    values = random.normal(0, 0.005, shape).astype(np.float32)
    for _ in range(12 * (rows_px * columns_px // 256**2)):
        (height, width), row, column = random.integers(5, 25, 2), random.integers(rows_px - 25), random.integers(columns_px - 25)
        values[row : row + height, column : column + width] += 0.05
    write_geotiff(path, values, Grid(0.0, rows_px * 0.02, 0.02, columns_px, rows_px))


WORKS = (
    Work("simulate", "pulses (100,000), laser scanner", lambda _, n: simulation("tls", pulses=n)),
    Work("simulate", "triangles (50,000), laser scanner", lambda _, n: simulation("tls", triangles=n)),
    Work("simulate", "blocks (10), laser scanner", lambda _, n: simulation("tls", blocks=n)),
    Work("simulate", "pixels of the map (100,000), stereo pair", lambda _, n: simulation("stereo", pixels=n)),
    Work("simulate", "epochs (1), laser scanner", lambda _, n: simulation("tls", epochs=n)),
    Work("surface", "points (45,000)", cloud_words),
    Work("detect default", "pixels of the map (260,000)", map_words),
    Work("monitor", "points of each epoch (45,000)", lambda folder, n: epochs_words(folder, POINTS * n, 1)),
    Work("monitor", "epochs (1)", lambda folder, n: epochs_words(folder, POINTS, n)),
)


def exponent(values: Sequence[float], least: float) -> float:
    """Return the exponent of the growing part of costs at 1, 4 and 16 times the work; NaN if they hardly grow."""
    first, second, third = values
    if third - first < least or second <= first or third <= second:
        return math.nan
    return math.log((third - second) / (second - first), TIMES[1] / TIMES[0])


def measured(works: Sequence[Work]) -> dict[Work, list[Cost]]:
    """Run each work at each size, after a first run that fills the kernel cache."""
    found = {}
    for work in works:
        work.cost(TIMES[0])
        found[work] = [work.cost(times) for times in TIMES]
        print(f"{work.name}: {', '.join(f'{each.seconds:.1f} s {each.memory_gb:.2f} GB' for each in found[work])}", flush=True)
    return found


def rows(found: dict[Work, list[Cost]]) -> Iterator[str]:
    """Yield the rows of the table, in Markdown."""
    yield "| command | what grows | processor s at 1, 4, 16 times | exponent | GB | exponent |"
    yield "|---|---|---|---|---|---|"
    for work, costs in found.items():
        seconds, memory = [each.seconds for each in costs], [each.memory_gb for each in costs]
        powers = (exponent(seconds, LEAST_GROWTH_S), exponent(memory, LEAST_GROWTH_GB))
        told = ["-" if math.isnan(power) else f"{power:.1f}" for power in powers]
        cells = ", ".join(f"{each:.1f}" for each in seconds), ", ".join(f"{each:.2f}" for each in memory)
        yield f"| `{work.command}` | {work.grows} | {cells[0]} | {told[0]} | {cells[1]} | {told[1]} |"


def draw(found: dict[Work, list[Cost]], path: Path) -> None:
    """Draw processor time and memory over the work, both relative to the smallest size."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, what, label in zip(
        figure.subplots(1, 2), ("seconds", "memory_gb"), ("processor time, s", "memory, GB"), strict=True
    ):
        for work, costs in found.items():
            axes.loglog(
                TIMES, [getattr(each, what) for each in costs], "o-", label=f"{work.command}: {work.grows.split(' (')[0]}"
            )
        start = min(getattr(costs[0], what) for costs in found.values())
        axes.loglog(TIMES, [start * times for times in TIMES], "k:", label="linear")
        axes.set(xlabel="times the smallest work", ylabel=label, xticks=TIMES, xticklabels=map(str, TIMES))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", nargs="+", default=[work.name for work in WORKS], help="names of works, such as simulate:pulses"
    )
    parser.add_argument("--write", action="store_true", help="put table and figure into docs/validation/performance.md")
    arguments = parser.parse_args()
    found = measured([work for work in WORKS if work.name in arguments.only])
    table = printed(rows(found))
    if arguments.write:
        write_between(DOCUMENT, MARKS, table)
        draw(found, FIGURE)


if __name__ == "__main__":
    main()
