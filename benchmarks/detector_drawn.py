"""Measure how well a detector draws the blocks that it finds, and what limits it: boxes, outlines, the mask's grid, or noise.

    python benchmarks/detector_drawn.py --set sets/mixed [--split val] [--model default] [--mirrored] [--write]

Of the detected blocks (masks overlap by 0.25, score 0.95), it gives the share whose mask overlaps by 0.75: with masks as they
are, drawn in other boxes, with another margin or probability threshold, and with the true masks cut or sampled like the predicted
ones. Every variant counts the blocks that the unchanged network finds. Tiles have the detector's own size. --write puts the table
into docs/validation/detector.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from documents import write_between
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from pipeline.detection.evaluation.evaluate import match_detections
from pipeline.detection.inference import weights
from pipeline.detection.inference.inference import paste
from pipeline.detection.network.boxes import widened
from pipeline.detection.network.data import CocoFolder
from pipeline.detection.network.normalisation import normalised
from pipeline.detection.products.run import detector_folder

DOCUMENT = Path(__file__).parents[1] / "docs" / "validation" / "detector.md"
MARKS = "<!-- drawn -->", "<!-- end of drawn -->"
CONFIDENCE, FOUND, DRAWN = 0.95, 0.25, 0.75
SIZES = ("small", "medium", "large")
ENOUGH = 20
"""Smallest number of blocks for which a share is given."""
MARGINS = (0.0, 0.5, 2.0)
RATIOS = ((4, 8), (8, 16), (16, 32), (32, np.inf))
Boxes = NDArray[np.float32]
Masks = NDArray[np.bool_]
Drawing = Callable[["Tile"], Masks]


@dataclass(frozen=True)
class Tile:
    """A tile with the blocks found in it, one row each.

    Attributes
    ----------
    boxes : (n, 4) boxes found.
    masks, mask_boxes : (n, m, m) probabilities, in boxes (n, 4) with a margin, px.
    true_masks, true_boxes : (n, size, size) and (n, 4) of the blocks found.
    draw : Predicts masks in other boxes of the tile.
    """

    size: int
    boxes: Boxes
    margin: float
    mask_boxes: Boxes
    masks: NDArray[np.float32]
    true_masks: Masks
    true_boxes: Boxes
    draw: Callable[[Boxes], NDArray[np.float32]]


@dataclass(frozen=True)
class Block:
    """A detected block. good: whether each variant overlaps by DRAWN; edges: (4,) found minus true box, px."""

    size: str
    ratio: float
    good: dict[str, bool]
    edges: NDArray[np.float32]


def pasted(masks: NDArray[np.float32], boxes: Boxes, size: int) -> Masks:
    """(n, size, size) from probabilities in boxes."""
    result = np.zeros((len(masks), size, size), bool)
    for whole, mask, box in zip(result, masks, boxes, strict=True):
        row, column, pixels = paste(mask, box, size)
        whole[row : row + pixels.shape[0], column : column + pixels.shape[1]] = pixels
    return result


def scaled(boxes: Boxes, factor: float) -> Boxes:
    """Return boxes with the same centres and sides `factor` times as long."""
    middle, half = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]) / 2
    return np.concatenate([middle - factor * half, middle + factor * half], axis=1)


def cut(masks: Masks, boxes: Boxes) -> Masks:
    """Masks without their pixels outside of the boxes."""
    at = np.arange(masks.shape[1]) + 0.5
    rows, columns = ((at >= boxes[:, axis, None]) & (at <= boxes[:, axis + 2, None]) for axis in (0, 1))
    return np.asarray(masks & rows[:, :, None] & columns[:, None, :])


def sampled(masks: Masks, boxes: Boxes, cells: int) -> NDArray[np.float32]:
    """(n, cells, cells) the masks at the centres of a grid in the boxes, 1 or 0."""
    parts = (np.arange(cells) + 0.5) / cells
    last = masks.shape[1] - 1
    rows, columns = (
        np.clip(np.floor(boxes[:, axis, None] + parts * (boxes[:, axis + 2] - boxes[:, axis])[:, None]), 0, last).astype(int)
        for axis in (0, 1)
    )
    return masks[np.arange(len(masks))[:, None, None], rows[:, :, None], columns[:, None, :]].astype(np.float32)


def redrawn(tile: Tile, boxes: Boxes) -> Masks:
    """Return what the mask head predicts in other boxes."""
    return pasted(tile.draw(boxes), boxes, tile.size)


def with_margin(tile: Tile, margin: float) -> Masks:
    """Return what the mask head predicts in the found boxes with another margin."""
    return redrawn(tile, widened(tile.boxes, margin))


AS_THEY_ARE, IN_TRUE_BOXES = "masks as they are", "masks drawn in the true boxes"
DRAWINGS: dict[str, Drawing] = {
    AS_THEY_ARE: lambda tile: pasted(tile.masks, tile.mask_boxes, tile.size),
    "masks from a probability of 0.45 on": lambda tile: pasted(tile.masks + 0.05, tile.mask_boxes, tile.size),
    "masks from 0.4 on": lambda tile: pasted(tile.masks + 0.1, tile.mask_boxes, tile.size),
    **{f"masks drawn with a margin of {margin:g} px": partial(with_margin, margin=margin) for margin in MARGINS},
    "masks drawn in boxes of 1.2 times the side": lambda tile: redrawn(tile, scaled(tile.boxes, 1.2)),
    IN_TRUE_BOXES: lambda tile: redrawn(tile, widened(tile.true_boxes, tile.margin)),
    "true masks, cut as the masks are": lambda tile: cut(tile.true_masks, tile.mask_boxes),
    "true masks, on the masks' grid": lambda tile: pasted(
        sampled(tile.true_masks, tile.mask_boxes, tile.masks.shape[1]), tile.mask_boxes, tile.size
    ),
}


def overlaps(one: Masks, other: Masks) -> NDArray[np.float64]:
    """(p, t) intersection over union of masks (p, ...) and (t, ...)."""
    a, b = one.reshape(len(one), -1).astype(np.float32), other.reshape(len(other), -1).astype(np.float32)
    both = a @ b.T
    return np.asarray(both / np.maximum(a.sum(1)[:, None] + b.sum(1)[None] - both, 1), dtype=np.float64)


def blocks(model: Any, folder: CocoFolder) -> Iterator[Block]:
    """All that the detector finds in the tiles of a folder."""
    from keras import ops

    for index, image in enumerate(folder.images):
        wanted = [each for each in folder.annotations if each["image_id"] == image["id"] and each["area"] > 0]
        pixels = normalised(folder.labelled(index).difference, model.config.normalisation)[None]
        answer = {name: np.asarray(value)[0] for name, value in model.predict_on_batch({"image": pixels}).items()}
        sure = answer["scores"] >= CONFIDENCE
        if not wanted or not sure.any():
            continue
        boxes, mask_boxes, masks = (answer[name][sure] for name in ("boxes", "mask_boxes", "masks"))
        true_masks = np.stack([coco_mask.decode(each["segmentation"]) > 0 for each in wanted])
        matched = match_detections(overlaps(pasted(masks, mask_boxes, model.size), true_masks), FOUND)
        hits, of = np.flatnonzero(matched >= 0), matched[matched >= 0]
        if not len(hits):
            continue
        true_boxes = np.array([box_of(wanted[number]) for number in of], np.float32)

        levels = model.first_stage(pixels, training=False).levels

        def draw(others: Boxes, levels: Any = levels) -> NDArray[np.float32]:
            return np.asarray(ops.sigmoid(model._masks(levels, ops.convert_to_tensor(others[None]), False)))[0]

        margin = model.config.head.mask_margin_px
        tile = Tile(model.size, boxes[hits], margin, mask_boxes[hits], masks[hits], true_masks[of], true_boxes, draw)
        drawn = {
            name: [overlaps(one[None], true[None])[0, 0] for one, true in zip(way(tile), tile.true_masks, strict=True)]
            for name, way in DRAWINGS.items()
        }
        for row, number in enumerate(of):
            good = {name: values[row] >= DRAWN for name, values in drawn.items()}
            ratio = float(wanted[number]["signal_to_noise"] or 0)
            yield Block(wanted[number]["size_class"], ratio, good, tile.boxes[row] - true_boxes[row])


def box_of(annotation: dict[str, Any]) -> tuple[float, float, float, float]:
    """y0, x0, y1, x1, px."""
    x, y, width, height = annotation["bbox"]
    return y, x, y + height, x + width


def rows(found: list[Block]) -> Iterator[str]:
    """Yield the rows of the table, in Markdown."""
    by_size = [[block for block in found if block.size == size] for size in SIZES]
    yield f"| | {' | '.join(SIZES)} |"
    yield "|---" * (1 + len(SIZES)) + "|"
    yield f"| blocks found | {' | '.join(f'{len(every):,}' for every in by_size)} |"
    for name in DRAWINGS:
        yield f"| {name} | {' | '.join(f'{share(every, name)} %' for every in by_size)} |"
    for low, high in RATIOS:
        name = f"signal-to-noise ratio {low} to {high}" if np.isfinite(high) else f"above {low}"
        cells = []
        for every in by_size:
            some = [block for block in every if low <= block.ratio < high]
            shares = f"{share(some, AS_THEY_ARE)}, {share(some, IN_TRUE_BOXES)} % of " if len(some) >= ENOUGH else ""
            cells.append(f"{shares}{len(some)} blocks")
        yield f"| {name}: as they are, in true boxes | {' | '.join(cells)} |"
    spreads = [np.median(np.abs([block.edges for block in every])) for every in by_size]
    yield f"| median error of a box's edge | {' | '.join(f'{spread:.1f} px' for spread in spreads)} |"


def share(every: list[Block], name: str) -> str:
    """Of the blocks with that drawing good, %."""
    return f"{100 * np.mean([block.good[name] for block in every]):.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", type=Path, required=True, dest="folder", help="a data set")
    parser.add_argument("--split", default="val", help="its folder with the tiles")
    parser.add_argument("--model", default="default", help="default, or a trained detector's folder")
    parser.add_argument("--mirrored", action="store_true", help="also look at the mirror images of the maps")
    parser.add_argument("--write", action="store_true", help="put the table into docs/validation/detector.md")
    arguments = parser.parse_args()
    model = weights.load(detector_folder(arguments.model), mirrored=arguments.mirrored)
    text = "\n".join(rows(list(blocks(model, CocoFolder(arguments.folder / arguments.split)))))
    print(text)
    if arguments.write:
        write_between(DOCUMENT, MARKS, text)


if __name__ == "__main__":
    main()
