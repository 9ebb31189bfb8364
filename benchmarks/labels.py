"""Measure how well labels show the true outlines of fallen blocks: share with an IoU of at least 0.75, by size and noise.

    python benchmarks/labels.py [--epochs 1] [--width 24 --height 14]

The true outline consists of the pixels where the untouched wall lies inside the block, from the block's mesh and the wall's
height, without carving, sensor or labels. `placed`: the same with the outline moved like the whole map (by errors of its
orientation).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.config.bundled import bundled_config
from pipeline.config.simulation import SimulationConfig, load_config
from pipeline.report.progress import Progress
from pipeline.run.displacement import displacement
from pipeline.run.epoch import observe_epoch, observe_reference
from pipeline.run.site import prepare_site
from scene.blocks.block import Blocks
from scene.common.backend import dr
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from scene.geometry.mesh import WALL, FloatArray, IntArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster

SIZES = {
    "small": ("{kind: uniform, low: 0.075, high: 0.15}", 0.191),
    "medium": ("{kind: uniform, low: 0.15, high: 0.5}", 0.191),
    "large": ("{kind: uniform, low: 0.5, high: 1.5}", 0.05),
}
MODELS = {"none": None, "glendale_high": "glendale_high"}
SILENT = "{sensor: stereo, noise: {parallax_sigma_px: 0, regularization_sigma_px: 0}}"


@dataclass(frozen=True)
class Outcome:
    """Intersection over union of each block's label with its true outline, and with the outline moved as the map is."""

    raw: NDArray[np.float64]
    placed: NDArray[np.float64]


def true_outlines(blocks: Blocks, wall: RayCaster, grid: Grid, shift_m: NDArray[np.float32]) -> IntArray:
    """(h, w) the block that takes the wall's surface along at each pixel, of the outlines moved by `shift_m` (h, w, 2)."""
    solids = RayCaster(TriangleMesh(blocks.vertices, blocks.faces, face_block=blocks.face_label))
    turned = RayCaster(TriangleMesh(blocks.vertices * [1.0, 1.0, -1.0], blocks.faces[:, ::-1].copy()))
    low, high, surface = (_height(caster, grid, shift_m) for caster in (turned, solids, wall))
    inside = (-low < surface) & (surface <= high)
    return np.where(inside, solids.labels_down(grid, shift_m), np.int32(WALL))


def _height(caster: RayCaster, grid: Grid, shift_m: NDArray[np.float32]) -> FloatArray:
    hits, point = caster.look_down(grid, shift_m)
    return np.array(dr.select(hits.valid, point.z, np.nan)).reshape(grid.shape)


def overlaps(label: IntArray, truth: IntArray, count: int) -> NDArray[np.float64]:
    """(count,) intersection over union of each block's pixels in both rasters; NaN of a block that shows on no pixel."""
    common = np.bincount(truth[label == truth], minlength=count + 1)
    union = np.bincount(label.ravel(), minlength=count + 1) + np.bincount(truth.ravel(), minlength=count + 1) - common
    with np.errstate(invalid="ignore"):
        return np.asarray((common / union)[1:])


def outcome(config: SimulationConfig, size: str, epochs: int) -> Outcome:
    random = KeyedRandom(config.seed)
    site = prepare_site(config, "stereo", random)
    progress = Progress()
    reference = observe_reference(config, site, random, progress)
    grid = reference.raster.grid
    count = max(1, round(SIZES[size][1] * grid.width * grid.height * grid.gsd**2))
    config = config.model_copy(update={"rockfall": config.rockfall.model_copy(update={"count": count})})
    raw: list[FloatArray] = []
    placed: list[FloatArray] = []
    for number in range(1, epochs + 1):
        epoch = observe_epoch(config, site, reference, number, random, progress)
        shift = displacement(epoch.seen.observations, epoch.registration, grid)
        for kept, moved in ((raw, 0 * shift), (placed, shift)):
            truth = true_outlines(epoch.solids, reference.caster, grid, moved)
            kept.append(overlaps(epoch.raster.block, truth, count))
    return Outcome(np.concatenate(raw), np.concatenate(placed))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=1)
    parser.add_argument("--width", type=float, default=24.0)
    parser.add_argument("--height", type=float, default=14.0)
    arguments = parser.parse_args()
    print("| reconstruction | noise | size | blocks | IoU >= 0.75 | placed | median IoU |\n|" + "---|" * 7)
    for reconstruction in ("direct", "vertices"):
        for noise, model in MODELS.items():
            for size, (distribution, _) in SIZES.items():
                settings = [
                    f"reconstruction={reconstruction}",
                    f"sensor={model or SILENT}",
                    f"rockfall.size_m={distribution}",
                    "rockfall.safe_zone_offset_m=0.3",
                    "noisy_reference=false",
                    f"wall.width_m={arguments.width}",
                    f"wall.height_m={arguments.height}",
                ]
                config = load_config(bundled_config("sites", "glendale"), settings, "stereo", None)
                found = outcome(config, size, arguments.epochs)
                good, placed = (np.mean(values[~np.isnan(values)] >= 0.75) for values in (found.raw, found.placed))
                figures = f"{len(found.raw)} | {100 * good:.1f} % | {100 * placed:.1f} % | {np.nanmedian(found.raw):.3f}"
                print(f"| {reconstruction} | {noise} | {size} | {figures} |", flush=True)


if __name__ == "__main__":
    main()
