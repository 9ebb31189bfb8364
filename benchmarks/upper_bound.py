"""Measure what any detector could find, by surface and placement.

This is the share of blocks with a matched-filter signal-to-noise ratio above 4.

    python benchmarks/upper_bound.py [--width 24 --height 14] [--write]

The wall is Glendale, blocks are as in configs/datasets/detector_test.yaml, the sensor is the stereo pair; noise is 2.5, 5 and 7.5
cm. Also given are the median depth of a niche (removed rock over its outline) and the share of its bounding box that it fills.
--write puts the table into docs/validation/detector_bound.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from documents import printed, write_between

from pipeline.change.annotate import DETECTABLE_SNR, AnnotationConfig, block_annotations
from pipeline.config.bundled import bundled_config
from pipeline.config.simulation import SimulationConfig
from pipeline.dataset.config import load_dataset_config
from pipeline.dataset.epoch import with_count
from pipeline.dataset.plan import planned_epochs, simulation_of
from pipeline.report.progress import Progress
from pipeline.run.epoch import observe_epoch, observe_reference
from pipeline.run.site import prepare_site
from scene.common.keyed_random import KeyedRandom
from scene.walls.contour import median_under
from scene.walls.wall import Wall

DOCUMENT = Path(__file__).parents[1] / "docs" / "validation" / "detector_bound.md"
MARKS = "<!-- bound -->", "<!-- end of bound -->"
WALL = "glendale-b"
WAYS = (("direct", "medium", "relief"), ("vertices", "medium", "relief"), ("vertices", "medium", "mean_surface"))
"""Reconstruction, depth map, placement."""


def rows(width_m: float, height_m: float) -> Iterator[str]:
    yield "| reconstruction | placement | size | 2.5 cm | 5 cm | 7.5 cm | median depth | niche / box |"
    yield "|---|---|---|---|---|---|---|---|"
    config = load_dataset_config(bundled_config("datasets", "detector_test"))
    epochs = [each for each in planned_epochs(config) if (each.wall, each.sensor, each.number) == (WALL, "stereo", 1)]
    for reconstruction, depth_map, placement in WAYS:
        for size in config.sizes:
            shares, depths, filled = [], [], []
            for epoch in (each for each in epochs if each.size == size):
                simulation = simulation_of(config, epoch)
                wall = simulation.wall.model_copy(update={"width_m": width_m, "height_m": height_m})
                rockfall = simulation.rockfall.model_copy(update={"placement": placement})
                way = {"wall": wall, "rockfall": rockfall, "reconstruction": reconstruction, "depth_map": depth_map}
                found = observed(simulation.model_copy(update=way), config.sizes[size].blocks_per_m2)
                shares.append(f"{100 * np.mean(np.array(found.ratios) > DETECTABLE_SNR):.0f} %")
                depths += found.depths
                filled += found.filled
            name = f"{reconstruction}, {depth_map}" if reconstruction == "direct" else reconstruction
            figures = f"{100 * np.median(depths):.1f} cm | {100 * np.mean(filled):.0f} %"
            yield f"| {name} | {placement} | {size} | {' | '.join(shares)} | {figures} |"


@dataclass(frozen=True)
class Niches:
    """Niches of the blocks of one epoch.

    Attributes
    ----------
    ratios : Signal-to-noise ratio of each block.
    depths : Depths of the visible niches, m.
    filled : Shares of their boxes that the visible niches fill.
    rise : Heights of the blocks' centres above the median surface within their contours, m.
    """

    ratios: list[float]
    depths: list[float]
    filled: list[float]
    rise: list[float]


def observed(config: SimulationConfig, blocks_per_m2: float, given: Wall | None = None) -> Niches:
    """Simulate one epoch and return the niches of its blocks.

    given: a wall that replaces the config's.
    """
    random, progress = KeyedRandom(config.seed), Progress()
    site = prepare_site(config, "stereo", random, given)
    reference = observe_reference(config, site, random, progress)
    grid = reference.raster.grid
    count = max(1, round(blocks_per_m2 * grid.width * grid.height * grid.gsd**2))
    epoch = observe_epoch(with_count(config, count), site, reference, 1, random, progress)
    ratios = [block["signal_to_noise"] or 0.0 for block in epoch.blocks]
    shown = list(block_annotations(epoch.raster.block, AnnotationConfig(minimum_area_px=1)))
    depths = [epoch.blocks[each["block"] - 1]["volume_m3"] / (each["area"] * grid.gsd**2) for each in shown]
    filled = [each["area"] / (each["bbox"][2] * each["bbox"][3]) for each in shown]
    solids = epoch.solids
    outlines = np.split(solids.vertices[:, :2], solids.vertex_start[1:-1])
    rise = solids.position_m[:, 2] - median_under(reference.caster, outlines)
    return Niches(ratios, depths, filled, rise.tolist())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=float, default=24.0)
    parser.add_argument("--height", type=float, default=14.0)
    parser.add_argument("--write", action="store_true", help="put the table into docs/validation/detector_bound.md")
    arguments = parser.parse_args()
    table = printed(rows(arguments.width, arguments.height))
    if arguments.write:
        write_between(DOCUMENT, MARKS, table)


if __name__ == "__main__":
    main()
