"""Measure what mirrored views improve in a detector, and their cost.

    python benchmarks/detector_mirrored.py --set sets/mixed [--split val] [--every 3] [--model default] [--write]

The views are those of pipeline/detection/inference/mirrored.py. F1 of masks is given by size at a score of 0.95, with the scores
of each variant set on the same tiles (`operating_point.best_shifts`), so that the gain is rather over- than underestimated. Tiles
have the detector's own size. --write puts the table into docs/validation/detector.md.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from documents import printed, write_between

from pipeline.detection.evaluation.evaluate import evaluate
from pipeline.detection.inference import inference, weights
from pipeline.detection.inference.mirrored import build_network
from pipeline.detection.inference.operating_point import best_shifts
from pipeline.detection.network.config import Mirroring
from pipeline.detection.network.data import CocoFolder
from pipeline.detection.network.model import MaskRCNN
from pipeline.detection.products.run import detector_folder

DOCUMENT = Path(__file__).parents[1] / "docs" / "validation" / "detector.md"
MARKS = "<!-- mirrored -->", "<!-- end of mirrored -->"
CONFIDENCE, LOWEST, OVERLAPS = 0.95, 0.02, (0.25, 0.75)
SIZES = ("small", "medium", "large")
WAYS: dict[Mirroring, str] = {
    "none": "as it is",
    "left_right": "left-right too",
    "both": "left-right, up-down and both too",
}
"""The table's rows, by `head.mirrored`."""


def figures(model: MaskRCNN, folder: CocoFolder) -> tuple[list[float], float]:
    """F1 by size and overlap, %, and processor seconds a tile."""
    truth = {"images": folder.images, "annotations": folder.annotations}
    inference.detect(model, folder.labelled(0).difference, LOWEST)  # compiles
    found: list[dict[str, Any]] = []
    started = time.process_time()
    for index, image in enumerate(folder.images):
        difference = folder.labelled(index).difference
        for each in inference.detect(model, difference, LOWEST):
            found.append(each.annotation(len(found) + 1, image["id"], difference.shape))
    seconds = (time.process_time() - started) / len(folder)
    shift, slope = best_shifts(truth, found) or (0.0, 0.0)
    shifted = [{**each, "score": moved(each, shift, slope)} for each in found]
    groups = {size: [image["id"] for image in folder.images if image["size_class"] == size] for size in SIZES}
    return [100 * score.f1 for score in evaluate(truth, shifted, groups, (CONFIDENCE,), OVERLAPS)], seconds


def moved(annotation: dict[str, Any], shift: float, slope: float) -> float:
    """Its score with the log odds shifted, as the head does it."""
    height, width = annotation["bbox"][2:]
    score = min(annotation["score"], 1 - 1e-6)
    odds = math.log(score / (1 - score)) + shift + slope * (0.5 * math.log2(height * width) - 4)
    return 1 / (1 + math.exp(-odds))


def rows(folder: CocoFolder, detector: Path) -> Iterator[str]:
    """Yield the rows of the table, in Markdown, as they are made."""
    yield f"| map | {' | '.join(f'{size}: 0.25, 0.75' for size in SIZES)} | mean | time |"
    yield "|---" * (3 + len(SIZES)) + "|"
    plain = 0.0
    for mirrored, name in WAYS.items():
        model = build_network(weights.with_head(weights.load_config(detector), mirrored=mirrored))
        weights.take_weights(model, detector)
        found, seconds = figures(model, folder)
        plain = plain or seconds
        pairs = np.reshape(found, (len(SIZES), len(OVERLAPS)))
        cells = [", ".join(f"{value:.1f}" for value in pair) for pair in [*pairs, pairs.mean(axis=0)]]
        yield f"| {name} | {' | '.join(cells)} | {seconds / plain:.1f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", type=Path, required=True, dest="folder", help="a data set")
    parser.add_argument("--split", default="val", help="its folder with the tiles")
    parser.add_argument("--every", type=int, default=1, help="take every so many of them alone")
    parser.add_argument("--model", default="default", help="default, or a trained detector's folder")
    parser.add_argument("--write", action="store_true", help="put the table into docs/validation/detector.md")
    arguments = parser.parse_args()
    tiles = CocoFolder(arguments.folder / arguments.split)
    tiles.images = tiles.images[:: arguments.every]
    tiles.annotations = [each for each in tiles.annotations if each["image_id"] in {image["id"] for image in tiles.images}]
    table = printed(rows(tiles, detector_folder(arguments.model)))
    if arguments.write:
        write_between(DOCUMENT, MARKS, table)


if __name__ == "__main__":
    main()
