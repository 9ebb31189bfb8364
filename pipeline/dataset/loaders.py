"""Read a finished data set as NumPy arrays or as tf.data, for training without any part of the simulation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from pipeline.formats.files.inside import inside
from pipeline.formats.rasters.geotiff import read_tiff
from pipeline.formats.records.coco import read_coco
from scene.common.errors import InputError, nearest

if TYPE_CHECKING:
    import tensorflow as tf

FILTERS = ("sensor", "wall", "noise", "size_class")
"""Keys by which tiles can be selected."""


@dataclass(frozen=True)
class Sample:
    """A tile of h x w pixels with k blocks.

    Attributes
    ----------
    image : (h, w) float32 difference, reference minus epoch, m; 0 without data.
    valid : (h, w) bool, true where there is data.
    boxes : (k, 4) float32 x, y, width and height, pixels from the top-left corner.
    masks : (k, h, w) bool masks of the blocks.
    truth : (h, w) float32 true difference, m, NaN where there is no wall; None in a set without it.
    record : The image's entry in annotations.json.
    annotations : The blocks' entries in annotations.json.
    """

    image: NDArray[np.float32]
    valid: NDArray[np.bool_]
    boxes: NDArray[np.float32]
    masks: NDArray[np.bool_]
    truth: NDArray[np.float32] | None
    record: dict[str, Any]
    annotations: list[dict[str, Any]]


class Tiles(Sequence[Sample]):
    """One split of a data set as a sequence of tiles, for loops that train or test a detector.

        tiles = Tiles("sets/rockfall_9/train", sensor="stereo", noise="low")

    `tiles[k]` reads tile k from disk and returns its difference map with the blocks in it: boxes, masks and further keys.

    Parameters
    ----------
    folder : Folder of a split: train, val or test.
    filters : Values of sensor, wall, noise or size_class that a tile must have.

    Raises
    ------
    InputError
        If a filter is unknown or no tile matches.
    """

    def __init__(self, folder: Path | str, **filters: str) -> None:
        """Read the list of tiles and keep those that match all filters; see the class."""
        self.folder = Path(folder)
        for key in filters:
            if key not in FILTERS:
                raise InputError(
                    f"unknown filter '{key}'",
                    where="Tiles",
                    allowed=", ".join(FILTERS),
                    remedy=nearest(key, FILTERS) or "choose one of these filters",
                )
        content = read_coco(self.folder / "annotations.json")
        self.categories = content.categories
        self.records = [image for image in content.images if all(image.get(key) == value for key, value in filters.items())]
        if not self.records:
            present = {key: sorted({str(image[key]) for image in content.images if key in image}) for key in filters}
            raise InputError(
                f"no tile has the properties {filters}",
                where=str(self.folder),
                allowed=str(present),
                remedy="choose among the properties that the set has",
            )
        self._annotations: dict[int, list[dict[str, Any]]] = {image["id"]: [] for image in self.records}
        for annotation in content.annotations:
            if annotation["image_id"] in self._annotations:
                self._annotations[annotation["image_id"]].append(annotation)

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, index: Any) -> Any:
        """Read a sample from disk; a slice gives a list of samples."""
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        record = self.records[index]
        values = read_tiff(self.path_of(record))
        valid = ~np.isnan(values)
        annotations = self._annotations[record["id"]]
        truth = read_tiff(self._path(record["truth_file_name"])) if "truth_file_name" in record else None
        return Sample(
            image=np.where(valid, values, np.float32(0)),
            valid=valid,
            boxes=np.array([each["bbox"] for each in annotations], dtype=np.float32).reshape(-1, 4),
            masks=masks_of(annotations, values.shape),
            truth=truth,
            record=record,
            annotations=annotations,
        )

    def path_of(self, record: dict[str, Any]) -> Path:
        """Return the path of a tile's TIFF file. record: the image's entry in annotations.json."""
        return self._path(record["file_name"])

    def _path(self, name: Any) -> Path:
        """Return the path of a file that annotations.json names; raise InputError if it is outside the folder."""
        return inside(self.folder, name, self.folder / "annotations.json")

    def __iter__(self) -> Iterator[Sample]:
        return (self[index] for index in range(len(self)))

    def shuffled(self, seed: int) -> Iterator[Sample]:
        """Yield all tiles once in random order, for one pass of a training.

        seed: decides the order; use another one for each pass.
        """
        return (self[int(index)] for index in np.random.default_rng(seed).permutation(len(self)))

    def tf_dataset(self) -> tf.data.Dataset:
        """Return the tiles with their annotations as a tf.data.Dataset of dictionaries, to train with TensorFlow.

        The keys are image (h, w, 1) float32, valid (h, w, 1) bool, boxes (k, 4) float32, masks (k, h, w) bool and image_id
        int64.
        """
        import tensorflow as tf

        height, width = self.records[0]["height"], self.records[0]["width"]
        signature = {
            "image": tf.TensorSpec((height, width, 1), tf.float32),
            "valid": tf.TensorSpec((height, width, 1), tf.bool),
            "boxes": tf.TensorSpec((None, 4), tf.float32),
            "masks": tf.TensorSpec((None, height, width), tf.bool),
            "image_id": tf.TensorSpec((), tf.int64),
        }
        dataset = tf.data.Dataset.from_generator(lambda: map(_for_tensorflow, self), output_signature=signature)
        return dataset.apply(tf.data.experimental.assert_cardinality(len(self)))


def masks_of(annotations: Sequence[dict[str, Any]], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Decode the masks of k COCO annotations of one image, (k, h, w). shape: (h, w) of the image, px."""
    if not annotations:
        return np.zeros((0, *shape), dtype=bool)
    decoded = coco_mask.decode([each["segmentation"] for each in annotations])
    return np.ascontiguousarray(decoded.transpose(2, 0, 1).astype(bool))


def _for_tensorflow(sample: Sample) -> dict[str, Any]:
    """Return a sample as the dictionary that `tf_dataset` yields."""
    return {
        "image": sample.image[..., None],
        "valid": sample.valid[..., None],
        "boxes": sample.boxes,
        "masks": sample.masks,
        "image_id": np.int64(sample.record["id"]),
    }
