"""Make COCO annotations of the blocks in difference maps or their tiles.

The masks come from the epoch's raster of labels, displaced like the map itself: they lie where the *reconstructed* niche lies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from scene.common.config import Config
from scene.geometry.grid import Grid
from scene.geometry.mesh import IntArray

DETECTABLE_SNR, INVISIBLE_SNR = 4.0, 2.0
"""Signal-to-noise ratios (matched_filter.py) from which a block can be found in the noise of a tile, and below which it cannot be
seen at all."""
BLOCK_CATEGORY = {"id": 1, "name": "block", "supercategory": "rockfall"}
"""The only category, in COCO's format."""
KIND_CATEGORIES = [
    {"id": number, "name": name, "supercategory": "rockfall"} for number, name in enumerate(("missing", "moved", "deposit"), 1)
]
"""The categories of a series that distinguishes kinds."""


class AnnotationConfig(Config):
    """Which fallen blocks get an annotation in images of a difference map, and which of them training ignores."""

    minimum_area_px: int = Field(4, ge=1, description="blocks that cover fewer pixels of an image are left out")
    ignore_below: float = Field(
        INVISIBLE_SNR,
        ge=0,
        description="data sets: blocks with a smaller matched-filter signal-to-noise ratio get `ignore: 1`; training leaves "
        "them out of the loss, but evaluations count them",
    )


@dataclass(frozen=True)
class LabelledImage:
    """A difference map or a tile of it, with the block at each pixel, to be annotated in COCO's format.

    Attributes
    ----------
    file_name : str
        Path relative to the annotations' folder.
    block : (h, w) int32 array
        Label of each pixel: the block's label in blocks.json, or 0 where there is none.
    grid : Grid
        Position of the image on the wall.
    epoch : int
        Number of the epoch.
    row, column : int
        Top-left pixel of the image in the difference map; 0, 0 for a whole map.
    """

    file_name: str
    block: IntArray
    grid: Grid
    epoch: int
    row: int = 0
    column: int = 0


def coco(images: Iterable[LabelledImage], config: AnnotationConfig, info: dict[str, Any] | None = None) -> dict[str, Any]:
    """Make the content of annotations.json in COCO's format, to train and score detectors with.

    Beyond COCO's own keys, an image has `epoch`, `row`, `column` and its grid (`x_min_m`, `y_max_m`, `gsd_m`, wall frame), and
    an annotation has the `block` that it shows.

    Parameters
    ----------
    images : iterable of LabelledImage
        The images.
    config : AnnotationConfig
        Which blocks are annotated.
    info : dict, optional
        Further entries of COCO's `info`.

    Returns
    -------
    dict
        JSON types only. Ids of images and annotations count from 1.
    """
    described: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for image_id, image in enumerate(images, start=1):
        described.append(_describe(image, image_id))
        for annotation in block_annotations(image.block, config):
            annotations.append({"id": len(annotations) + 1, "image_id": image_id, **annotation})
    return {
        "info": {"description": "Rockfall blocks in difference maps", **(info or {})},
        "licenses": [],
        "categories": [BLOCK_CATEGORY],
        "images": described,
        "annotations": annotations,
    }


def by_kind(data_set: dict[str, Any], rockfalls: int) -> dict[str, Any]:
    """Give the annotations of a time series a category for each kind of change: missing, moved and deposited rock.

    data_set: COCO annotations of `coco`, whose `block` says kind and rockfall in one label. Of n rockfalls, number e
    (from 1) has the label e where its rock is missing, n + e where it has moved, and 2 n + e where it lies as a deposit.
    rockfalls: n.

    Returns a copy with `category_id` 1, 2 or 3 for the kind, and with the number e alone as `block`.
    """
    annotations = [
        {**each, "category_id": (each["block"] - 1) // rockfalls + 1, "block": (each["block"] - 1) % rockfalls + 1}
        for each in data_set["annotations"]
    ]
    return {**data_set, "categories": KIND_CATEGORIES, "annotations": annotations}


def merge(data_sets: Iterable[dict[str, Any]], info: dict[str, Any] | None = None) -> dict[str, Any]:
    """Merge the annotations of several sets of images into one, with ids that count from 1 throughout.

    data_sets: results of `coco`; the last one's categories are kept. info: further entries of COCO's `info`.
    """
    result = coco([], AnnotationConfig(), info)
    for data_set in data_sets:
        result["categories"] = data_set["categories"]
        before = len(result["images"])
        result["images"] += [{**image, "id": image["id"] + before} for image in data_set["images"]]
        for annotation in data_set["annotations"]:
            number = len(result["annotations"]) + 1
            result["annotations"].append({**annotation, "id": number, "image_id": annotation["image_id"] + before})
    return result


def block_annotations(block: IntArray, config: AnnotationConfig) -> Iterator[dict[str, Any]]:
    """Yield a COCO annotation, without ids, for each block that covers enough pixels of an image, by ascending label.

    block: (h, w) label of the block at each pixel, 0 for none. config: says how many pixels are enough.
    """
    from scipy import ndimage

    for label, box in enumerate(ndimage.find_objects(block), start=1):
        if box is None:
            continue
        crop = block[box] == label
        area = int(np.count_nonzero(crop))
        if area < config.minimum_area_px:
            continue
        row, column = box[0].start, box[1].start
        yield {
            "category_id": BLOCK_CATEGORY["id"],
            "bbox": [column, row, crop.shape[1], crop.shape[0]],
            "area": area,
            "iscrowd": 0,
            "segmentation": run_length_encoding(crop, row, column, block.shape),
            "block": label,
        }


def run_length_encoding(crop: NDArray[np.bool_], row: int, column: int, shape: tuple[int, ...]) -> dict[str, Any]:
    """Encode the mask of a block in an image as COCO's compressed run lengths, for an annotation.

    Only the part of the mask around the block is needed, which saves time; the result is that of the whole image.

    Parameters
    ----------
    crop : (n, m) bool array
        The mask within the block's bounding box, true on the block.
    row, column : int
        Pixel of the image at the crop's top-left corner.
    shape : (int, int)
        Height and width of the image, px.
    """
    from pycocotools import mask as coco_mask

    height, width = shape
    columns = np.pad(crop.T, ((0, 0), (1, 1)))  # zeros at both ends of each column, so that every run ends within it
    place, step = np.nonzero(columns[:, 1:] != columns[:, :-1])
    changes = (place + column) * height + step + row
    joined = np.flatnonzero(changes[1:] == changes[:-1])  # runs that continue at the top of the next column
    changes = np.delete(changes, np.concatenate([joined, joined + 1]))
    counts = np.diff(changes, prepend=0, append=height * width)
    counts = counts[:-1] if counts[-1] == 0 else counts
    encoded = coco_mask.frPyObjects({"size": [height, width], "counts": counts.tolist()}, height, width)
    return {"size": [height, width], "counts": encoded["counts"].decode("ascii")}


def _describe(image: LabelledImage, image_id: int) -> dict[str, Any]:
    """Describe an image in COCO's format."""
    height, width = image.block.shape
    return {
        "id": image_id,
        "file_name": image.file_name,
        "width": width,
        "height": height,
        "epoch": image.epoch,
        "row": image.row,
        "column": image.column,
        "x_min_m": image.grid.x_min,
        "y_max_m": image.grid.y_max,
        "gsd_m": image.grid.gsd,
    }
