"""What `scarpsim monitor` finds on walls whose rockfalls are known, on a real cliff, and how long it takes.

    python benchmarks/monitor.py [--epochs 4] [--write]         with --write into docs/validation/monitor.md

Simulated epochs of both sensors are given without their truth, in projected coordinates and moved by a few centimetres. Blocks
count if at least half of their volume can be seen. The cliff is that of shared/data, scanned by a simulated scanner. The last
part times two clouds of 20 million points.
"""

from __future__ import annotations

import argparse
import json
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

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pipeline.api.building import observe, open_wall, stage  # noqa: E402
from pipeline.api.runs import simulate  # noqa: E402
from pipeline.change.difference import SurfaceRaster  # noqa: E402
from pipeline.change.m3c2 import M3c2Config, m3c2  # noqa: E402
from pipeline.formats.point_cloud import PointCloud  # noqa: E402
from pipeline.formats.points.laz import read_laz, write_laz  # noqa: E402
from pipeline.formats.rasters.geotiff import read_geotiff  # noqa: E402
from pipeline.monitoring.options import MonitorOptions  # noqa: E402
from pipeline.monitoring.products import Result  # noqa: E402
from pipeline.monitoring.reading import read_epoch  # noqa: E402
from pipeline.monitoring.run import monitor_paths  # noqa: E402
from pipeline.registration.rigid import RigidTransform  # noqa: E402
from scene.geometry.frame import WallFrame  # noqa: E402
from scene.geometry.mesh import FloatArray  # noqa: E402

DOCUMENT = ROOT / "docs" / "validation" / "monitor.md"
MARKS = {name: (f"<!-- {name} -->", f"<!-- end of {name} -->") for name in ("simulated", "cliff", "m3c2", "speed")}
CLIFF = ROOT.parent / "shared" / "data" / "trier_cliff"
PAIR, PAIR_FROM = CLIFF.parent / "tls_rock_blocks_pair", np.array([547_466.3, 149_575.8, 706.1])
UTM = np.array([345_200.0, 5_389_450.0, 120.0])
CLASSES_L = ((0.3, 1.0), (1.0, 3.0), (3.0, 10.0), (10.0, np.inf))
SITES = {
    "laser scanner, 50 m": ("tls", None, {}),
    "stereo pair, 50 m": ("stereo", None, {}),
    "laser scanner, 50 m, another wall": ("tls", None, {"wall__style": "bulga", "wall__seed": 3}),
}
STEP_RAD = 2.618e-4
POINTS = 20_000_000
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
            centre = result.site.frame.to_world(np.array([region.x_m, region.y_m, region.z_m])) - UTM
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


def _overlap(low: FloatArray, high: FloatArray, other_low: FloatArray, other_high: FloatArray) -> float:
    """Area that two rectangles share, over that of the smaller one."""
    sides = np.clip(np.minimum(high, other_high) - np.maximum(low, other_low), 0, None)
    return float(sides.prod() / max(min(np.prod(high - low), np.prod(other_high - other_low)), 1e-12))


def simulated(count: int) -> Iterator[str]:
    """Rows of the table of simulated epochs."""
    heads = [f"{low:g} to {high:g} l" if np.isfinite(high) else f"above {low:g} l" for low, high in CLASSES_L]
    yield f"| site | found of {' | '.join(heads)} | false in 1,000 m²: all, unmarked | volume, bias | 95 % intervals that hold |"
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
    yield "| state | events above 0.1 m³ | missing, m³ | added, m³ |"
    yield "|---|---|---|---|"
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
            yield f"| {state} | {len(large)} | {volumes[0]:.1f} | {volumes[1]:.1f} |"


def against_m3c2() -> Iterator[str]:
    """Rows of the table of significant pixels by both methods, of a simulated epoch and of the real pair of shared/data."""
    yield "| data | level of detection, median: monitor, M3C2 | area significant by both, by monitor alone, by M3C2 alone, m² |"
    yield "|---|---|---|"
    with tempfile.TemporaryDirectory() as folder:
        run, scans = Path(folder) / "run", Path(folder) / "scans"
        simulate(None, "tls", out=run, seed=77, epochs=1, progress=False)
        scans.mkdir()
        yield _m3c2_row(
            "simulated rockfalls, 50 m", epochs_of(run, scans, 5), np.array([12.0, -50.0, 5.0]) + UTM, Path(folder) / "out"
        )
        if PAIR.is_dir():
            files = [PAIR / "before.txt", PAIR / "after.txt"]
            yield _m3c2_row("real pair, coordinates rounded to 6 cm", files, PAIR_FROM, Path(folder) / "pair")


def _m3c2_row(name: str, files: Sequence[Path], position: FloatArray, out: Path) -> str:
    options = MonitorOptions(position=position)
    result = monitor_paths(files, out, options)
    site, record = result.site, result.epochs[0].record
    grid, heights = site.grid, site.reference.raster.height
    points = [site.frame.to_wall(read_epoch(source, options).points) for source in result.sources]
    raster = SurfaceRaster(grid, heights, np.zeros(grid.shape, dtype=np.int32))
    config = M3c2Config(core_step_px=1, cylinder_radius_m=3 * grid.gsd, normal_radius_m=6 * grid.gsd, direction="wall")
    other = m3c2(points[0], record.transform.apply(points[1]), raster, raster.block, config)
    difference, level = (read_geotiff(out / f"{kind}_001.tif")[0] for kind in ("difference", "lod"))
    known = np.isfinite(difference) & np.isfinite(other.level)
    ours, theirs = (np.abs(difference) > level) & known, other.significant & known
    areas = [grid.gsd**2 * int(each.sum()) for each in (ours & theirs, ours & ~theirs, theirs & ~ours)]
    levels = [1e3 * float(np.nanmedian(each)) for each in (level, other.level)]
    return f"| {name} | {levels[0]:.1f}, {levels[1]:.1f} mm | {areas[0]:.1f}, {areas[1]:.1f}, {areas[2]:.1f} |"


def speed() -> Iterator[str]:
    """Rows of the table of times, with a process of its own for its memory."""
    yield "| points in each of two epochs | time | largest memory |"
    yield "|---|---|---|"
    with tempfile.TemporaryDirectory() as folder:
        for number in (1, 2):
            write_laz(
                Path(folder) / f"{number}.laz",
                PointCloud(_large_wall(number)),
            )
        words = ["monitor", f"{folder}/1.laz", f"{folder}/2.laz", "--position", "50,-80,10", "--out", f"{folder}/out", "--quiet"]
        command = [sys.executable, "-c", "import sys; from pipeline.cli.main import main; sys.exit(main(sys.argv[1:]))", *words]
        began = time.monotonic()
        subprocess.run(command, check=True, cwd=ROOT, capture_output=True)
        took = time.monotonic() - began
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6
        yield f"| {POINTS:,} | {took:.0f} s | {peak:.1f} GB |"


def _large_wall(seed: int) -> FloatArray:
    """(n, 3) points of a wall of 100 m x 40 m with 3 mm of noise, m."""
    random = np.random.default_rng(seed)
    x, z = random.uniform([0, 0], [100, 40], (POINTS, 2)).T
    y = -0.5 * np.sin(0.9 * x) * np.cos(1.1 * z) + 0.003 * random.normal(size=POINTS)
    return np.column_stack([x, y, z])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=4, help="simulated epochs of each site")
    parser.add_argument("--parts", nargs="+", default=list(MARKS), choices=list(MARKS))
    parser.add_argument("--write", action="store_true", help="put the tables into docs/validation/monitor.md")
    arguments = parser.parse_args()
    rows = {"simulated": lambda: simulated(arguments.epochs), "cliff": cliff, "m3c2": against_m3c2, "speed": speed}
    for part in arguments.parts:
        table = printed(rows[part]())
        if arguments.write:
            write_between(DOCUMENT, MARKS[part], table)


if __name__ == "__main__":
    main()
