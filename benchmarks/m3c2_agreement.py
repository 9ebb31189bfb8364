"""Measure the agreement of M3C2 distances and difference maps on the same epochs.

    python benchmarks/m3c2_agreement.py [--config FILE]

Prints a table for docs/validation/m3c2.md: each sensor, along the wall's normal and along the surface's own.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from pycocotools import mask

from pipeline.change.difference import statistics
from pipeline.change.m3c2 import core_grid
from pipeline.config.bundled import bundled_config
from pipeline.config.simulation import load_config
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.run.simulation import simulate

COLUMNS = (
    "sensor, direction",
    "noise of the map on stable rock (NMAD)",
    "the same of M3C2",
    "map minus M3C2: median, NMAD",
    "stable points beyond the LoD (5 % expected)",
    "mean change of the blocks: M3C2 over map",
    "points in blocks beyond the LoD",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--config", type=Path, default=bundled_config("", "demo"))
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    arguments = parser.parse_args()
    print(f"| {' | '.join(COLUMNS)} |")
    print("|---" * len(COLUMNS) + "|")
    for sensor in ("stereo", "tls"):
        for direction in ("wall", "normal"):
            print(row(arguments, sensor, direction))


def row(arguments: argparse.Namespace, sensor: str, direction: str) -> str:
    """One line of the table."""
    overrides = [*arguments.overrides, f"m3c2.direction={direction}"]
    config = load_config(arguments.config, overrides, sensor, None)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        simulate(config, sensor, out)
        change, full = read_geotiff(out / "difference_001.tif")
        distance, _ = read_geotiff(out / "m3c2_001.tif")
        level, _ = read_geotiff(out / "m3c2_lod_001.tif")
        block = labels(out, distance.shape)
    assert config.m3c2 is not None
    grid, every = core_grid(full, config.m3c2.core_step_px)
    core = change[every, every][: grid.height, : grid.width]
    known = ~np.isnan(core) & ~np.isnan(distance)
    stable, inside = known & ~block, known & block & (core > 0.05)
    raster, cloud, apart = (statistics(values[stable]) for values in (core, distance, core - distance))
    beyond = np.mean(np.abs(distance[stable]) > level[stable])
    ratio, found = np.median(distance[inside] / core[inside]), np.mean(distance[inside] > level[inside])
    return (
        f"| {sensor}, {direction} | {raster.nmad * 1e3:.1f} mm | {cloud.nmad * 1e3:.1f} mm "
        f"| {apart.median * 1e3:+.2f}, {apart.nmad * 1e3:.1f} mm | {100 * beyond:.1f} % | {ratio:.3f} | {100 * found:.0f} % |"
    )


def labels(out: Path, shape: tuple[int, ...]) -> np.ndarray:
    """(h, w) where annotations_m3c2.json has blocks."""
    found = json.loads((out / "annotations_m3c2.json").read_text())["annotations"]
    masks = [mask.decode(item["segmentation"]).astype(bool) for item in found]
    return np.any(masks, axis=0) if masks else np.zeros(shape, dtype=bool)


if __name__ == "__main__":
    main()
