"""What `scarpsim monitor` finds on walls whose rockfalls are known, on a real cliff, and how long it takes.

    python benchmarks/monitor.py [--epochs 4] [--write]         with --write into docs/validation/monitor.md

Simulated epochs of both sensors are given without their truth, in projected coordinates and moved by a few centimetres. Blocks
count if at least half of their volume can be seen. The cliff is that of shared/data, scanned by a simulated scanner. The last
parts time two clouds of 20 million points, and 48 epochs of 2 million against reading their files.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from documents import printed, write_between
from numpy.typing import NDArray
from scipy import ndimage

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pipeline.api.building import observe, open_wall, stage  # noqa: E402
from pipeline.api.runs import simulate  # noqa: E402
from pipeline.change.difference import SurfaceRaster, cast_raster  # noqa: E402
from pipeline.change.m3c2 import M3c2Config, M3c2Map, m3c2  # noqa: E402
from pipeline.formats.point_cloud import PointCloud  # noqa: E402
from pipeline.formats.points.laz import read_laz, write_laz  # noqa: E402
from pipeline.monitoring.alignment import SAME, RasterPair, coarse, refine  # noqa: E402
from pipeline.monitoring.comparison import EpochChange, compare_epoch  # noqa: E402
from pipeline.monitoring.events import LEAST_PIXELS, SIGNIFICANT, Catalogue, Change, ChangedRegion, region_of_mask  # noqa: E402
from pipeline.monitoring.options import MonitorOptions  # noqa: E402
from pipeline.monitoring.point_writing import write_points_once  # noqa: E402
from pipeline.monitoring.products import Followed, Result  # noqa: E402
from pipeline.monitoring.reading import EpochSource, find_epochs, read_epoch  # noqa: E402
from pipeline.monitoring.report import epoch_pictures  # noqa: E402
from pipeline.monitoring.run import monitor_paths, processed  # noqa: E402
from pipeline.monitoring.site import ReferenceSite, WallView, prepared  # noqa: E402
from pipeline.registration.rigid import RigidTransform  # noqa: E402
from scene.geometry.frame import WallFrame  # noqa: E402
from scene.geometry.mesh import FloatArray, TriangleMesh  # noqa: E402
from scene.ray_casting.raycast import RayCaster  # noqa: E402

DOCUMENT = ROOT / "docs" / "validation" / "monitor.md"
MARKS = {
    name: (f"<!-- {name} -->", f"<!-- end of {name} -->")
    for name in ("simulated", "nothing", "cliff", "m3c2", "regions", "speed", "many", "steps")
}
CLIFF = ROOT.parent / "shared" / "data" / "trier_cliff"
PAIR, PAIR_FROM = CLIFF.parent / "tls_rock_blocks_pair", np.array([547_466.3, 149_575.8, 706.1])
PAIR_FILES = (PAIR / "before.txt", PAIR / "after.txt")
UTM = np.array([345_200.0, 5_389_450.0, 120.0])
CLASSES_L = ((0.3, 1.0), (1.0, 3.0), (3.0, 10.0), (10.0, np.inf))
SITES = {
    "laser scanner, 50 m": ("tls", None, {}),
    "stereo pair, 50 m": ("stereo", None, {}),
    "laser scanner, 50 m, another wall": ("tls", None, {"wall__style": "bulga", "wall__seed": 3}),
}
SPECK = {"rockfall__count": 1, "rockfall__size_m": {"kind": "gaussian", "mean": 0.002, "sigma": 0.0, "minimum": 0.001}}
"""A single rockfall of 2 mm, far below what any pixel shows: next to nothing."""
STEP_RAD = 2.618e-4
POINTS = 20_000_000
EPOCHS, EPOCH_POINTS = 48, 2_000_000
"""Of the series whose time is compared with that of reading it."""
NORMAL_95 = 1.96


@dataclass(frozen=True)
class Found:
    """A block that fell, m3: its volume, the share that can be seen, and what was found of it (NaN: nothing)."""

    volume: float
    visible: float
    measured: float
    sigma: float


def epochs_of(run: Path, out: Path, seed: int) -> list[Path]:
    """The run's epochs as a surveyor has them: LAZ files in projected coordinates, each registered to a few centimetres."""
    record = json.loads((run / "run.json").read_text(encoding="utf-8"))["wall_frame"]
    frame = WallFrame(np.array(record["rotation"]), np.array(record["origin_m"]))
    random, files = np.random.default_rng(seed), []
    for number, folder in enumerate(sorted(run.glob("epoch_*"))):
        points = frame.to_world(read_laz(folder / "points.laz").points) + UTM
        centre = points.mean(axis=0)
        motion = RigidTransform.about(centre, random.normal(0, 2e-4, 3), random.normal(0, 0.02, 3))
        files.append(out / f"epoch_{number:03d}.laz")
        write_laz(files[-1], PointCloud(motion.apply(points) if number else points))
    return files


def compared(run: Path, result: Result) -> tuple[list[Found], list[bool], float]:
    """Each block of a run beside what was found, whether each false event has a mark, and the area, m2, that was searched."""
    record = json.loads((run / "run.json").read_text(encoding="utf-8"))["wall_frame"]
    frame = WallFrame(np.array(record["rotation"]), np.array(record["origin_m"]))
    found, false, area = [], list[bool](), 0.0
    for epoch in result.epochs:
        blocks = json.loads((run / f"epoch_{epoch.number:03d}" / "blocks.json").read_text(encoding="utf-8"))
        blocks = blocks["blocks"] if isinstance(blocks, dict) else blocks
        corners = [np.array(block["bbox_m"]).reshape(2, 3)[:, :2] for block in blocks]
        measured: dict[int, tuple[float, float]] = {}
        for region in epoch.regions:
            centre = result.site.views[region.view - 1].frame.to_world(np.array([region.x_m, region.y_m, region.z_m])) - UTM
            at = frame.to_wall(centre)[:2]
            half = np.array([region.width_m, region.height_m]) / 2
            shared = [_overlap(at - half, at + half, *each) for each in corners]
            best = int(np.argmax(shared)) if shared else -1
            if best < 0 or shared[best] < 0.3:
                false.append(bool(region.marks))
                continue
            volume, variance = measured.get(best, (0.0, 0.0))
            measured[best] = volume + region.volume_m3, variance + region.volume_std_m3**2
        for number, block in enumerate(blocks):
            volume, variance = measured.get(number, (np.nan, np.nan))
            seen = float(block["measured_volume_m3"] or 0.0) / block["volume_m3"]
            found.append(Found(block["volume_m3"], seen, volume, float(np.sqrt(variance))))
        area += epoch.record.area_m2
    return found, false, area


def nothing(count: int) -> Iterator[str]:
    """Rows of the table of epochs in which nothing fell."""
    yield "| site | compared area of all epochs, m² | false events: all, of which unmarked | the same in 1,000 m² |"
    yield "|---|---|---|---|"
    for name, (sensor, config, keys) in SITES.items():
        with tempfile.TemporaryDirectory() as folder:
            run, scans = Path(folder) / "run", Path(folder) / "scans"
            simulate(config, sensor, out=run, seed=78, epochs=count, progress=False, **keys, **SPECK)
            scans.mkdir()
            files = epochs_of(run, scans, 6)
            position = np.array([12.0, -50.0, 5.0]) + UTM
            result = monitor_paths(files, Path(folder) / "out", MonitorOptions(position=position))
        marked = [bool(region.marks) for epoch in result.epochs for region in epoch.regions]
        area = sum(epoch.record.area_m2 for epoch in result.epochs)
        yield f"| {name} | {area:,.0f} | {len(marked)}, {len(marked) - sum(marked)} | {_rates(marked, area)} |"


def _overlap(low: FloatArray, high: FloatArray, other_low: FloatArray, other_high: FloatArray) -> float:
    """Area that two rectangles share, over that of the smaller one."""
    sides = np.clip(np.minimum(high, other_high) - np.maximum(low, other_low), 0, None)
    return float(sides.prod() / max(min(np.prod(high - low), np.prod(other_high - other_low)), 1e-12))


def simulated(count: int) -> Iterator[str]:
    """Rows of the table of simulated epochs."""
    heads = [f"{low:g} to {high:g} l" if np.isfinite(high) else f"above {low:g} l" for low, high in CLASSES_L]
    last = "false events in 1,000 m²: all, of which unmarked | volume, bias | 95 % intervals that hold the true volume"
    yield f"| site | found of {' | '.join(heads)} | {last} |"
    yield "|---" * (5 + len(heads)) + "|"
    for name, (sensor, config, keys) in SITES.items():
        with tempfile.TemporaryDirectory() as folder:
            run, scans = Path(folder) / "run", Path(folder) / "scans"
            simulate(config, sensor, out=run, seed=77, epochs=count, progress=False, **keys)
            scans.mkdir()
            files = epochs_of(run, scans, 5)
            position = WallFrame(np.eye(3), np.zeros(3)).to_world(np.array([12.0, -50.0, 5.0])) + UTM
            result = monitor_paths(files, Path(folder) / "out", MonitorOptions(position=position))
            found, false, area = compared(run, result)
        yield f"| {name} | {' | '.join(_row(found))} | {_rates(false, area)} | {_volumes(found)} |"


def _rates(false: Sequence[bool], area: float) -> str:
    return f"{1e3 * len(false) / area:.1f}, {1e3 * (len(false) - sum(false)) / area:.1f}"


def _row(found: Sequence[Found]) -> list[str]:
    cells = []
    for low, high in CLASSES_L:
        inside = [each for each in found if low <= 1e3 * each.volume < high and each.visible > 0.5]
        hits = sum(np.isfinite(each.measured) for each in inside)
        cells.append(f"{hits} of {len(inside)}")
    return cells


def _volumes(found: Sequence[Found]) -> str:
    """Median relative error of volumes above a litre, and the share of intervals that hold the truth."""
    known = [each for each in found if np.isfinite(each.measured) and each.visible > 0.5]
    large = [each.measured / each.volume - 1 for each in known if each.volume > 1e-3]
    held = [abs(each.measured - each.volume) < NORMAL_95 * each.sigma for each in known]
    return f"{100 * float(np.median(large)):+.1f} % | {sum(held)} of {len(held)}"


def cliff() -> Iterator[str]:
    """Rows of the table of the real cliff in three states."""
    yield "| state | events above 0.1 m³ | missing, m³ | added, m³ | missing and added between the meshes, m³ |"
    yield "|---|---|---|---|---|"
    if not CLIFF.is_dir():
        return
    station = np.array([26.5, -240.015, 135.411])
    keys = {
        "station": {"position_m": station.tolist(), "rotation": np.eye(3).tolist()},
        "scanner": {
            "azimuth_step_rad": STEP_RAD,
            "zenith_step_rad": STEP_RAD,
            "azimuth_rad": [1.45, 1.52],
            "zenith_rad": [1.44, 1.54],
        },
        "frame__normal": "sensor",
        "model": {"sensor": "tls", "noise": {"range_sigma_m": 0.005, "angle_sigma_rad": 2e-5}},
    }
    with tempfile.TemporaryDirectory() as folder:
        walls = {state: open_wall(CLIFF / f"{state}.ply") for state in ("before", "toppled", "fallen")}
        site = stage(walls["before"], "tls", **keys)
        for state, wall in walls.items():
            seen = observe(
                wall.with_vertices(site.frame.to_wall(wall.vertices)), site.sensor, seed=100 + list(walls).index(state)
            )
            write_laz(Path(folder) / f"{state}.laz", PointCloud(site.frame.to_world(seen.points[seen.valid])))
        middle = (walls["before"].vertices.min(axis=0) + walls["before"].vertices.max(axis=0)) / 2
        options = MonitorOptions(position=station, direction=station - middle)
        files = [Path(folder) / f"{state}.laz" for state in walls]
        result = monitor_paths(files, Path(folder) / "out", options)
        for state, epoch in zip(list(walls)[1:], result.epochs, strict=True):
            large = [region for region in epoch.regions if region.volume_m3 > 0.1]
            volumes = [sum(each.volume_m3 for each in large if each.kind == kind) for kind in ("missing", "added")]
            true = _between(walls["before"], walls[state], result.site.views[0])
            yield f"| {state} | {len(large)} | {volumes[0]:.1f} | {volumes[1]:.1f} | {true[0]:.1f}, {true[1]:.1f} |"


def _between(before: TriangleMesh, after: TriangleMesh, view: WallView) -> tuple[float, float]:
    """Return the volumes, m3, that are missing and added between two meshes along the direction of a map, without noise."""
    grid = view.raster.grid
    earlier, later = (
        cast_raster(RayCaster(mesh.with_vertices(view.frame.to_wall(mesh.vertices))), grid).heights for mesh in (before, after)
    )
    change = np.nan_to_num(earlier - later) * grid.gsd**2
    return float(change[change > 0].sum()), float(-change[change < 0].sum())


@dataclass(frozen=True)
class BothWays:
    """One pair of epochs compared by monitor and by M3C2 with the same registration."""

    change: EpochChange
    other: M3c2Map

    @classmethod
    def of(cls, files: Sequence[Path], position: FloatArray) -> BothWays:
        """Compare two files with one view."""
        options = MonitorOptions(position=position, views=1)
        reference, epoch = find_epochs(files)
        site = prepared(reference, options)
        grid, raster = site.grid, site.views[0].raster
        points = [read_epoch(source, options).wall_points(site.frame, grid.gsd) for source in (reference, epoch)]
        change = compare_epoch(site.reference, points[1], None, options.seed)
        surface = SurfaceRaster(grid, raster.height, np.zeros(grid.shape, dtype=np.int32))
        config = M3c2Config(core_step_px=1, cylinder_radius_m=3 * grid.gsd, normal_radius_m=6 * grid.gsd, direction="wall")
        clouds = [np.concatenate(list(each.moved(SAME))) for each in points]
        other = m3c2(clouds[0], change.transform.apply(clouds[1]), surface, surface.block, config)
        return cls(change, other)

    def areas(self, name: str) -> str:
        """Row of the table of areas."""
        change, gsd = self.change.changes[0], self.change.changes[0].grid.gsd
        level = change.significance.level
        known = np.isfinite(change.difference) & np.isfinite(self.other.level)
        ours, theirs = (np.abs(change.difference) > level) & known, self.other.significant & known
        areas = [gsd**2 * int(each.sum()) for each in (ours & theirs, ours & ~theirs, theirs & ~ours)]
        levels = [1e3 * float(np.nanmedian(each)) for each in (level, self.other.level)]
        return f"| {name} | {levels[0]:.1f}, {levels[1]:.1f} mm | {areas[0]:.1f}, {areas[1]:.1f}, {areas[2]:.1f} |"

    def regions(self) -> Iterator[str]:
        """Rows of the table of regions, from the largest on."""
        change, grid = self.change.changes[0], self.change.changes[0].grid
        rows, matched = [], set[int]()
        for sign in (1, -1):
            significant = self.other.significant & (sign * self.other.distance > 0)
            labels, count = ndimage.label(significant, np.ones((3, 3)))
            for number in range(1, count + 1):
                mask = labels == number
                if mask.sum() < LEAST_PIXELS:
                    continue
                volume = sign * float(np.nansum(self.other.distance[mask])) * grid.gsd**2
                ours = [each for each in self.change.regions if mask[each.window][each.mask].any()]
                matched |= {id(each) for each in ours}
                found = sum(each.volume_m3 for each in ours)
                reason = _reason(mask, ours, change, self.other)
                row, column = np.argwhere(mask).mean(axis=0)
                at = f"{grid.x_min + column * grid.gsd:.1f}, {grid.y_max - row * grid.gsd:.1f}"
                rows.append((volume, f"| {at} | {volume:.3f} | {f'{found:.3f}' if ours else '-'} | {reason} |"))
        for each in self.change.regions:
            if id(each) not in matched:
                at = f"{each.x_m:.1f}, {each.y_m:.1f}"
                reason = f"M3C2 has no level there or a higher one; marked {' '.join(each.marks) or 'with nothing'}"
                rows.append((each.volume_m3, f"| {at} | - | {each.volume_m3:.3f} | {reason} |"))
        yield from (text for _, text in sorted(rows, reverse=True))


def _reason(mask: NDArray[np.bool_], ours: Sequence[ChangedRegion], change: Change, other: M3c2Map) -> str:
    """Why monitor and M3C2 differ on a region that M3C2 has."""
    if len(ours) == 1:
        return "both"
    if ours:
        return f"both; `monitor` has {len(ours)} events, because between them the change is below half of its level"
    known = mask & np.isfinite(change.difference)
    if not known.any():
        return "too few points for a plane through 3 x 3 pixels, which M3C2's larger cylinder has"
    levels = [1e3 * float(np.nanmedian(each[known])) for each in (change.significance.level, other.level)]
    measured = region_of_mask(known, 0, 0, 1.0, change)
    significance = 0.0 if measured is None else measured.significance
    if significance >= SIGNIFICANT:
        return "no square of 3, 5 or 9 pixels in it is significant by itself"
    return (
        f"mean change {significance:.1f} standard deviations, events need {SIGNIFICANT:.0f}; "
        f"level {levels[0]:.0f} mm, M3C2's {levels[1]:.0f} mm"
    )


def against_m3c2() -> Iterator[str]:
    """Rows of the table of significant pixels by both methods, of a simulated epoch and of the real pair of shared/data."""
    yield "| data | level of detection, median: monitor, M3C2 | area significant by both, by monitor alone, by M3C2 alone, m² |"
    yield "|---|---|---|"
    with tempfile.TemporaryDirectory() as folder:
        run, scans = Path(folder) / "run", Path(folder) / "scans"
        simulate(None, "tls", out=run, seed=77, epochs=1, progress=False)
        scans.mkdir()
        position = np.array([12.0, -50.0, 5.0]) + UTM
        yield BothWays.of(epochs_of(run, scans, 5), position).areas("simulated rockfalls, 50 m")
    if PAIR.is_dir():
        yield BothWays.of(PAIR_FILES, PAIR_FROM).areas("real pair, coordinates rounded to 6 cm")


def regions() -> Iterator[str]:
    """Rows of the table of regions of the real pair, as both methods have them."""
    yield "| place on the wall: x, y, m | M3C2, m³ | monitor, m³ | found by, and why |"
    yield "|---|---|---|---|"
    if PAIR.is_dir():
        yield from BothWays.of(PAIR_FILES, PAIR_FROM).regions()


def speed() -> Iterator[str]:
    """Rows of the table of times, with a process of its own for its memory."""
    yield "| points in each of two epochs | time | processor time | largest memory | load average of other programs |"
    yield "|---|---|---|---|---|"
    with tempfile.TemporaryDirectory() as folder:
        for number in (1, 2):
            write_laz(Path(folder) / f"{number}.laz", PointCloud(_large_wall(number, POINTS)))
        took, processor = _timed(MONITOR, f"{folder}/1.laz", f"{folder}/2.laz", *FROM, "--out", f"{folder}/out")
        others = max(os.getloadavg()[0] - processor / took, 0.0)
        memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6
        yield f"| {POINTS:,} | {took:.0f} s | {processor:.0f} s | {memory:.1f} GB | {others:.1f} |"


def many(epochs: int) -> Iterator[str]:
    """Rows of the table of many epochs: the time of `monitor`, of reading its files, and of reading and writing them."""
    heads = "time over reading | processor time over reading | load average of other programs"
    yield f"| epochs, points in each | what | time | processor time | {heads} |"
    yield "|---|---|---|---|---|---|---|"
    with tempfile.TemporaryDirectory() as folder:
        files = [f"{folder}/2026-03-01T{number // 2:02d}{30 * (number % 2):02d}.laz" for number in range(epochs)]
        for number, file in enumerate(files):
            write_laz(Path(file), PointCloud(_large_wall(number, EPOCH_POINTS)))
        calls = {"reading the files": [READ, *files]}
        for processes in ("1 process", "2 processes"):
            calls[f"only reading and writing them, in {processes}"] = [REWRITE, processes[0], folder, *files]
        for workers in ("1", "2"):
            words = [MONITOR, *files, *FROM, "--workers", workers, "--out", f"{folder}/out{workers}"]
            calls[f"`monitor --workers {workers}`"] = words
        reading: tuple[float, float] | None = None
        for what, (program, *words) in calls.items():
            took, processor = _timed(program, *words)
            reading = reading or (took, processor)
            others = max(os.getloadavg()[0] - processor / took, 0.0)
            ratios = f"{took / reading[0]:.1f} | {processor / reading[1]:.1f}"
            yield f"| {epochs}, {EPOCH_POINTS:,} | {what} | {took:.0f} s | {processor:.0f} s | {ratios} | {others:.1f} |"


def steps() -> Iterator[str]:
    """Rows of the table of the steps of one epoch: the least processor time of three epochs in one process."""
    yield "| step | processor time of an epoch | over reading |"
    yield "|---|---|---|"
    options = MonitorOptions(position=np.array([50.0, -80.0, 10.0]))
    least: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / f"{number}.laz" for number in range(4)]
        for number, file in enumerate(files):
            write_laz(file, PointCloud(_large_wall(number, EPOCH_POINTS)))
        reference, *sources = find_epochs(files)
        site, out = prepared(reference, options), Path(folder) / "out"
        for number, source in enumerate(sources, start=1):
            for step, used in _steps_of(number, source, site, out, options).items():
                least[step] = min(used, least.get(step, np.inf))
    for step, used in least.items():
        yield f"| {step} | {used:.2f} s | {used / least['reading']:.2f} |"


def _steps_of(number: int, source: EpochSource, site: ReferenceSite, out: Path, options: MonitorOptions) -> dict[str, float]:
    """Processor time, s, of each step of an epoch."""
    ends = [time.process_time()]

    def passed() -> float:
        ends.append(time.process_time())
        return ends[-1] - ends[-2]

    points = read_epoch(source, options).wall_points(site.frame, site.grid.gsd)
    read = passed()
    first = coarse(site.reference.surface, points.sample, site.grid.gsd, options.seed)
    near = passed()
    rasters = site.reference.gridded(points.moved(first))
    fitted = passed()
    refine([RasterPair(*each) for each in zip(site.reference.rasters, rasters, strict=True)], None)
    registered = passed()
    record, data = processed(number, source, site, out, options, "benchmark")
    rest = passed() - read - near - fitted - registered
    epoch = Followed(source, record, Catalogue().identified(record.regions))
    write_points_once(epoch, data, site, out, "benchmark", options)
    written = passed()
    epoch_pictures(epoch, site.views, out)
    return {
        "reading": read,
        "fitting planes to the points": fitted,
        "registration": near + registered,
        "differences, levels of detection, events, their files": rest,
        "writing the registered points": written,
        "map of the report": passed(),
    }


MONITOR = "import sys; from pipeline.cli.main import main; sys.exit(main(['monitor', '--quiet', *sys.argv[1:]]))"
REWRITE = """
import concurrent.futures, functools, pathlib, sys
import numpy as np
from pipeline.formats.points.laz import LazHeader, read_laz
from pipeline.formats.points.laz_chunks import chunk_writer

def rewrite(folder, name):
    path = pathlib.Path(name)
    points = read_laz(path, only_points=True).points
    noise = (np.rint(np.random.default_rng(0).normal(0, 200, len(points))) / 2**16).astype(np.float32)
    extra = {"distance_m": noise, "lod_m": np.abs(noise), "event": np.zeros(len(points), dtype=np.uint16)}
    bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    types = {key: values.dtype for key, values in extra.items()}
    with chunk_writer(pathlib.Path(folder, f"copy_{path.name}"), bounds, types, LazHeader(scale_m=1e-4)) as file:
        def fill(records, part):
            for axis, values, scale, offset in zip("XYZ", points[part].T, file.scales, file.offsets):
                records[axis] = np.rint((values - offset) / scale)
            for key, values in extra.items():
                records[key] = values[part]
        file.write(len(points), fill)

with concurrent.futures.ProcessPoolExecutor(int(sys.argv[1])) as pool:
    list(pool.map(functools.partial(rewrite, sys.argv[2]), sys.argv[3:]))
"""
"""Reads the files and writes their points again with three values for each, as the contract of `monitor` demands, and no more."""
READ = "import sys, pathlib; from pipeline.formats.points.laz import read_laz; [*map(read_laz, map(pathlib.Path, sys.argv[1:]))]"
FROM = ("--position", "50,-80,10")


def _timed(program: str, *words: str) -> tuple[float, float]:
    """Run a program with Python; return its wall time and the processor time of all its threads and processes, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began = time.monotonic()
    subprocess.run([sys.executable, "-c", program, *words], check=True, cwd=ROOT, capture_output=True)
    took, used = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return took, used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime


def _large_wall(seed: int, count: int) -> FloatArray:
    """(n, 3) points of a wall of 100 m x 40 m with 3 mm of noise, m."""
    random = np.random.default_rng(seed)
    x, z = random.uniform([0, 0], [100, 40], (count, 2)).T
    y = -0.5 * np.sin(0.9 * x) * np.cos(1.1 * z) + 0.003 * random.normal(size=count)
    return np.column_stack([x, y, z])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=4, help="simulated epochs of each site")
    parser.add_argument("--many", type=int, default=EPOCHS, help="epochs of the part `many`")
    parser.add_argument("--parts", nargs="+", default=list(MARKS), choices=list(MARKS))
    parser.add_argument("--write", action="store_true", help="put the tables into docs/validation/monitor.md")
    arguments = parser.parse_args()
    rows = {
        "simulated": lambda: simulated(arguments.epochs),
        "nothing": lambda: nothing(arguments.epochs),
        "cliff": cliff,
        "m3c2": against_m3c2,
        "regions": regions,
        "speed": speed,
        "many": lambda: many(arguments.many),
        "steps": steps,
    }
    for part in arguments.parts:
        table = printed(rows[part]())
        if arguments.write:
            write_between(DOCUMENT, MARKS[part], table)


if __name__ == "__main__":
    main()
