"""Check whether a niche's floor has the same fine noise as the wall around it, or gives the niche away by its texture.

    python benchmarks/niche_texture.py --set sets/detector_test_mean --set sets/direct [--write]

A pixel's fine deviation is that from the mean of its 3 x 3 neighbourhood. Inside is the median of its magnitude over those pixels
of a niche at least EROSION_PX from the outline, so that the rim does not count; around is that over a ring equally far from every
outline. Niches with fewer than FEWEST remaining pixels do not count. From maps on which the two differ, a detector learns a
texture that measured clouds do not have. --write puts the table into docs/validation/detector.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from detector_table import DOCS, SENSORS
from documents import printed, write_between
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.detection.network.data import CocoFolder, LabelledMap

MARKS = "<!-- texture -->", "<!-- end of texture -->"
EROSION_PX, RING_PX, FEWEST = 4, 14, 30
SMOOTHER = 0.7
"""Chance gives 6 % of the smallest niches that count a lower ratio: FEWEST independent pixels against ten times as many."""


def deviations(shown: LabelledMap) -> Iterator[tuple[float, float]]:
    """Inside and around each niche of a map, m."""
    known = np.isfinite(shown.difference)
    share = ndimage.uniform_filter(known.astype(np.float32), 3)
    mean = ndimage.uniform_filter(np.where(known, shown.difference, 0), 3) / np.where(share > 0.1, share, np.nan)
    fine = np.abs(shown.difference - mean)
    near = ndimage.binary_dilation(shown.labels > 0, iterations=EROSION_PX)
    for number in range(1, len(shown.boxes) + 1):
        niche = shown.labels == number
        inside = fine[ndimage.binary_erosion(niche, iterations=EROSION_PX)]
        around = fine[ndimage.binary_dilation(niche, iterations=RING_PX) & ~near]
        inside, around = inside[np.isfinite(inside)], around[np.isfinite(around)]
        if min(len(inside), len(around)) >= FEWEST:
            yield float(np.median(inside)), float(np.median(around))


def cells(folder: CocoFolder) -> dict[str, list[int]]:
    """Return indices of a folder's images by sensor, size and noise."""
    found: dict[str, list[int]] = {}
    for index, image in enumerate(folder.images):
        found.setdefault(f"{SENSORS[image['sensor']]} | {image['size_class']} | {image['noise']}", []).append(index)
    return found


def rows(sets: Sequence[Path]) -> Iterator[str]:
    """Yield the rows of the table, in Markdown."""
    yield f"| set | sensor | size | noise | niches | inside | around | median ratio | below {SMOOTHER:g} |"
    yield "|---" * 9 + "|"
    for path in sets:
        folder = CocoFolder(path / "test")
        for cell, images in cells(folder).items():
            pairs: NDArray[np.float64] = np.array([pair for index in images for pair in deviations(folder.labelled(index))])
            if len(pairs) < FEWEST:
                continue
            ratio, middle = pairs[:, 0] / pairs[:, 1], 1e3 * np.median(pairs, axis=0)
            yield (
                f"| {path.name} | {cell} | {len(pairs)} | {middle[0]:.1f} mm | {middle[1]:.1f} mm | {np.median(ratio):.2f} "
                f"| {100 * np.mean(ratio < SMOOTHER):.0f} % |"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", type=Path, required=True, action="append", dest="folders", help="a data set with a test part")
    parser.add_argument("--write", action="store_true", help="put the table into docs/validation/detector.md")
    arguments = parser.parse_args()
    table = printed(rows(arguments.folders))
    if arguments.write:
        write_between(DOCS / "detector.md", MARKS, table)


if __name__ == "__main__":
    main()
