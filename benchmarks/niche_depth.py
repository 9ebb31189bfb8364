"""Measure how deep the niches of small blocks are, and how many stand out from the noise.

This depends on how blocks are placed, and on how coarse and smooth the wall is.

    python benchmarks/niche_depth.py [--width 24 --height 14] [--maps 2] [--write]

The thesis carves its blocks out of Metashape's mesh of a wall, made from depth maps at a quarter of the images' resolution: its
vertices are farther apart, and it is smoother than rock. Here the relief of a Glendale wall, sampled every centimetre, is
smoothed by a Gaussian filter and sampled again. Small blocks are as in configs/datasets/detector_test.yaml, with a stereo pair
and surfaces by vertices. --write puts the table into docs/validation/detector_bound.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from documents import printed, write_between
from scipy import ndimage
from upper_bound import DOCUMENT, WALL, Niches, observed

from pipeline.change.annotate import DETECTABLE_SNR
from pipeline.config.bundled import bundled_config
from pipeline.dataset.config import DatasetConfig, load_dataset_config
from pipeline.dataset.plan import planned_epochs, simulation_of
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh
from scene.walls.procedural import ProceduralWall
from scene.walls.wall import Wall

MARKS = "<!-- niches -->", "<!-- end of niches -->"
SIZE, FINE_M = "small", 0.01
CASES = (
    ("relief", 0.05, 0.0),
    ("relief", 0.05, 0.08),
    ("relief", 0.08, 0.08),
    ("highest_vertex", 0.05, 0.0),
    ("highest_vertex", 0.08, 0.0),
    ("highest_vertex", 0.08, 0.08),
    ("mean_surface", 0.05, 0.0),
)
"""Placement, spacing of the mesh's vertices, m, standard deviation of the filter, m."""


def smoothed(config: ProceduralWall, sigma_m: float) -> Wall:
    """Return the wall, its relief filtered before it is sampled every `config.resolution_m`."""
    fine = config.model_copy(update={"resolution_m": FINE_M}).mesh(KeyedRandom(0))
    coarse = config.mesh(KeyedRandom(0))
    step = round(config.resolution_m / FINE_M)
    columns, rows = (round(extent / FINE_M) + 1 for extent in config.size)
    vertices = fine.vertices.reshape(rows, columns, 3)
    normal = np.array([0.0, -np.sin(config.site.slope_rad), np.cos(config.site.slope_rad)])
    relief = vertices @ normal
    change = ndimage.gaussian_filter(relief, sigma_m / FINE_M) - relief
    moved = (vertices + change[..., None] * normal)[::step, ::step]
    return Wall(TriangleMesh(moved.reshape(-1, 3), coarse.faces), (), config.style)


def niches(config: DatasetConfig, case: tuple[str, float, float], extent: dict[str, float], maps: int) -> dict[str, list[Niches]]:
    """Of so many epochs at each level of noise."""
    placement, spacing, sigma = case
    found: dict[str, list[Niches]] = {}
    for epoch in planned_epochs(config):
        if (epoch.wall, epoch.sensor, epoch.size, epoch.number) != (WALL, "stereo", SIZE, 1):
            continue
        simulation = simulation_of(config, epoch)
        wall = simulation.wall.model_copy(update={**extent, "resolution_m": spacing})
        rockfall = simulation.rockfall.model_copy(update={"placement": placement})
        given = smoothed(wall, sigma)
        for seed in range(maps):
            changed = simulation.model_copy(update={"wall": wall, "rockfall": rockfall, "seed": seed})
            found.setdefault(epoch.noise, []).append(observed(changed, config.sizes[SIZE].blocks_per_m2, given))
    return found


def rows(extent: dict[str, float], maps: int) -> Iterator[str]:
    """Yield the rows of the table, in Markdown."""
    config = load_dataset_config(bundled_config("datasets", "detector_test"))
    heads = ("placement", "vertices every", "filter's deviation", *config.noise, "depth", "centre above surface")
    yield f"| {' | '.join(heads)} |"
    yield "|---" * len(heads) + "|"
    for case in CASES:
        found = niches(config, case, extent, maps)
        shares = [np.mean([ratio > DETECTABLE_SNR for each in found[noise] for ratio in each.ratios]) for noise in config.noise]
        every = [each for level in found.values() for each in level]
        depth, rise = (np.median([one for each in every for one in getattr(each, name)]) for name in ("depths", "rise"))
        placement, spacing, sigma = case
        cells = (placement, f"{100 * spacing:.0f} cm", f"{100 * sigma:.0f} cm", *(f"{100 * share:.0f} %" for share in shares))
        yield f"| {' | '.join(cells)} | {100 * depth:.1f} cm | {100 * rise:.1f} cm |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=float, default=24.0)
    parser.add_argument("--height", type=float, default=14.0)
    parser.add_argument("--maps", type=int, default=2, help="at each level of noise")
    parser.add_argument("--write", action="store_true", help="put the table into docs/validation/detector_bound.md")
    arguments = parser.parse_args()
    table = printed(rows({"width_m": arguments.width, "height_m": arguments.height}, arguments.maps))
    if arguments.write:
        write_between(DOCUMENT, MARKS, table)


if __name__ == "__main__":
    main()
