"""Read COCO folders of difference maps as batches for the network."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from pipeline.change.annotate import KIND_CATEGORIES
from pipeline.detection.network.config import DetectorConfig, TrainingConfig
from pipeline.detection.network.normalisation import normalised
from pipeline.formats.files.inside import inside
from pipeline.formats.rasters.geotiff import read_tiff
from pipeline.formats.records.coco import Coco, Entry, read_coco
from scene.common.errors import InputError

Batch = dict[str, NDArray[Any]]
MIRRORED: dict[bool | str, tuple[int, ...]] = {True: (1, 0), "left_right": (1,), False: ()}
"""Axes along which images are mirrored, by `training.flips`."""


@dataclass(frozen=True)
class LabelledMap:
    """A difference map and its annotated blocks, to train or validate the network with.

    Attributes
    ----------
    difference : (h, w) differences, m; NaN without data.
    labels : (h, w) int32, 1 + the index of the block at a pixel (the later one where two overlap); 0 for none.
    boxes : (g, 4) float32 y0, x0, y1, x1, px.
    ignored : (g,) blocks left out of the loss, by COCO's `ignore` or `iscrowd`.
    """

    difference: NDArray[np.float32]
    labels: NDArray[np.int32]
    boxes: NDArray[np.float32]
    ignored: NDArray[np.bool_]


class CocoFolder:
    """A folder of annotated difference maps for training: `annotations.json` (COCO) and the TIFF images that it names.

    Parameters
    ----------
    folder : The folder.
    masks : Whether every annotation must have a mask.

    Raises
    ------
    InputError
        If annotations.json is missing or wrong.
    """

    def __init__(self, folder: Path, *, masks: bool = True) -> None:
        """Read annotations.json; see the class."""
        content = read_coco(folder / "annotations.json", masks=masks)
        self.folder = folder
        self.images = sorted(content.images, key=lambda image: image["id"])
        self.annotations = _of_missing_rock(content)
        self._of: dict[int, list[dict[str, Any]]] = {image["id"]: [] for image in self.images}
        for annotation in self.annotations:
            self._of[annotation["image_id"]].append(annotation)

    def check_images(self) -> None:
        """Read every image of the folder once; raise InputError for the first that is damaged or not of the annotated size."""
        for index in range(len(self)):
            self._difference(index)

    def __len__(self) -> int:
        return len(self.images)

    def path(self, image: dict[str, Any]) -> Path:
        """Return the path of an image. image: its entry in annotations.json. Raises InputError if it is outside the folder."""
        return inside(self.folder, image.get("file_name"), self.folder / "annotations.json")

    def labelled(self, index: int) -> LabelledMap:
        """Read one image with those of its blocks that cover at least one pixel.

        index: of the image in annotations.json, from 0. Raises InputError if the file is damaged or not of the annotated size.
        """
        difference = self._difference(index)
        labels = np.zeros(difference.shape, np.int32)
        boxes: list[tuple[float, float, float, float]] = []
        ignored: list[bool] = []
        for annotation in self._of[self.images[index]["id"]]:
            if annotation["area"] == 0:
                continue
            x, y, width, height = annotation["bbox"]
            boxes.append((y, x, y + height, x + width))
            ignored.append(bool(annotation.get("ignore") or annotation.get("iscrowd")))
            labels[coco_mask.decode(annotation["segmentation"]) > 0] = len(boxes)
        return LabelledMap(difference, labels, np.array(boxes, np.float32).reshape(-1, 4), np.array(ignored, dtype=bool))

    def _difference(self, index: int) -> NDArray[np.float32]:
        """Read the difference map at `index` and check its size."""
        image = self.images[index]
        path = self.path(image)
        difference = read_tiff(path)
        if difference.shape != (image["height"], image["width"]):
            raise InputError(
                f"the image has {difference.shape[0]} x {difference.shape[1]} px",
                where=str(path),
                allowed=f"{image['height']} x {image['width']} px as annotated",
                remedy="use the image that was annotated",
            )
        return difference


def _of_missing_rock(content: Coco) -> list[Entry]:
    """Return the annotations of missing rock: all, unless the categories tell missing rock from other changes of a series."""
    missing, *others = ((each["id"], each["name"]) for each in KIND_CATEGORIES)
    known = {(each["id"], each.get("name")) for each in content.categories}
    if missing not in known or known.isdisjoint(others):
        return content.annotations
    return [each for each in content.annotations if each["category_id"] == missing[0]]


def batches(
    folder: CocoFolder, detector: DetectorConfig, training: TrainingConfig, epoch: int, *, learning: bool
) -> Iterator[Batch]:
    """Yield all images of a folder once, as batches of network inputs for one epoch of training or validation.

    Each batch is a dictionary of the arrays that `network_input` makes of an image, stacked along a first axis. Random choices
    depend on seed, epoch and image only. An incomplete last batch is filled with its own first images.

    Parameters
    ----------
    folder : The images.
    detector : Settings of the network's input.
    training : Batch size, window size, flips and seed.
    epoch : Number of the training epoch.
    learning : True: random order, mirroring and windows; False: in order, and the middle of each image.
    """
    order = np.arange(len(folder))
    if learning:
        order = np.random.default_rng((training.seed, epoch)).permutation(order)
    size = training.crop_px or detector.image_px
    count = training.batch
    groups = [np.resize(order[first : first + count], count) for first in range(0, len(order), count)]

    def load(group: NDArray[np.int64]) -> Batch:
        examples = []
        for index in group:
            random = np.random.default_rng((training.seed, epoch, 1 + int(index))) if learning else None
            labelled = cut_window(folder.labelled(int(index)), size, random)
            if random is not None:
                for axis in MIRRORED[training.flips]:
                    labelled = mirrored(labelled, axis) if random.random() < 0.5 else labelled
            examples.append(network_input(labelled, detector))
        return {name: np.stack([example[name] for example in examples]) for name in examples[0]}

    with ThreadPoolExecutor(1) as pool:  # reads the next batch while the network trains on this one
        coming = None
        for group in groups:
            ready, coming = coming, pool.submit(load, group)
            if ready is not None:
                yield ready.result()
        if coming is not None:
            yield coming.result()


def network_input(labelled: LabelledMap, config: DetectorConfig) -> Batch:
    """Convert one image and its annotated blocks to the network's input, without the batch axis.

    Parameters
    ----------
    labelled : The map and its blocks.
    config : Says how values are scaled, and the largest number of blocks, `most_blocks`.

    Returns
    -------
    A dictionary of `image` (h, w, c), scaled; `boxes` (most_blocks, 4) y0, x0, y1, x1, px; `valid` (most_blocks,) 1 for a block,
    -1 for one to ignore, 0 for an unused box; and `labels` (h, w), 1 + the index of the block at a pixel.

    Raises
    ------
    InputError
        If there are more blocks than `most_blocks`.
    """
    count = len(labelled.boxes)
    if count > config.most_blocks:
        raise InputError(
            f"an image shows {count} blocks",
            where="detector.most_blocks",
            allowed=f"at least {count}",
            remedy="raise detector.most_blocks to this number, or cut smaller tiles",
        )
    boxes, valid = np.zeros((config.most_blocks, 4), np.float32), np.zeros(config.most_blocks, np.float32)
    boxes[:count], valid[:count] = labelled.boxes, np.where(labelled.ignored, -1, 1)
    image = normalised(labelled.difference, config.normalisation)
    return {"image": image, "boxes": boxes, "valid": valid, "labels": labelled.labels}


def mirrored(labelled: LabelledMap, axis: int) -> LabelledMap:
    """Mirror a map and its blocks, to vary training images. axis: 0 for up-down, 1 for left-right."""
    boxes = labelled.boxes.copy()
    boxes[:, [axis, axis + 2]] = labelled.difference.shape[axis] - labelled.boxes[:, [axis + 2, axis]]
    return replace(labelled, difference=np.flip(labelled.difference, axis), labels=np.flip(labelled.labels, axis), boxes=boxes)


def cut_window(labelled: LabelledMap, size: int, random: np.random.Generator | None) -> LabelledMap:
    """Cut a square window out of a map and its blocks, to train on; pixels beyond the map have no data.

    A block that the window cuts is kept if at least half of it is inside, and is background otherwise.

    Parameters
    ----------
    labelled : The map.
    size : Side of the window, px.
    random : Source of a random place; None: the middle.
    """
    if labelled.difference.shape == (size, size):
        return labelled
    room = [max(length - size, 0) for length in labelled.difference.shape]
    row, column = (int(random.integers(0, each + 1)) if random is not None else each // 2 for each in room)
    cut = np.s_[row : row + size, column : column + size]
    missing = [(0, size - length) for length in labelled.difference[cut].shape]
    labels = np.pad(labelled.labels[cut], missing)
    before = np.bincount(labelled.labels.ravel(), minlength=len(labelled.boxes) + 1)
    inside = np.bincount(labels.ravel(), minlength=len(labelled.boxes) + 1)
    kept = np.flatnonzero(2 * inside[1:] >= np.maximum(before[1:], 1))
    numbers = np.zeros(len(labelled.boxes) + 1, np.int32)
    numbers[kept + 1] = np.arange(1, len(kept) + 1)
    shifted = labelled.boxes[kept] - np.array([row, column, row, column], np.float32)
    return LabelledMap(
        np.pad(labelled.difference[cut], missing, constant_values=np.nan),
        numbers[labels],
        np.clip(shifted, 0, size, dtype=np.float32),
        labelled.ignored[kept],
    )
