"""Export a data set in the form on which YOLO programs train: 8-bit pictures, a text file of outlines for each, data.yaml."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from pipeline.dataset.loaders import Sample, Tiles
from pipeline.export.exported_set import splits_of
from pipeline.formats.files.atomic import filling, write_bytes, write_text
from pipeline.report.progress import Progress
from scene.common.errors import InputError

_ZERO, _STEPS = 128, 127
"""Grey value of no change, and grey values from there to the limit."""
_FINER = 4
"""Subdivisions of a pixel on which outlines are traced; they lie an eighth of a pixel inside the mask."""
_SIGMAS = 6.0
"""Default limit of the grey values, in standard deviations of the noise."""


@dataclass(frozen=True)
class YoloSet:
    """Result of exporting a data set for YOLO, a family of object detectors.

    Attributes
    ----------
    folder : Path
        The folder.
    limit_m : float
        Difference at the ends of the grey scale, m.
    images, blocks : dict
        Number of images and of blocks by split.
    """

    folder: Path
    limit_m: float
    images: dict[str, int]
    blocks: dict[str, int]


def save_yolo(folder: Path, out: Path, limit_m: float | None, progress: Progress) -> YoloSet:
    """Write the splits of a data set as Ultralytics' YOLO reads them: images/SPLIT/*.png, labels/SPLIT/*.txt, data.yaml.

    Grey values are 128 + 127 * difference / limit_m, clipped to 1 and 255, and 0 without data. A line of a label file is class
    0 and the outline of a block, as shares of width and height; detectors derive its box.

    Parameters
    ----------
    folder, out : Path
        The data set, and where to write.
    limit_m : float or None
        Difference at the ends of the grey scale, m; None: six times the median noise of the images.
    progress : Progress
        Receives the progress.

    Raises
    ------
    InputError
        If the folder contains no split, or no noise from which to take the limit.
    """
    sets = splits_of(folder)
    limit = limit_m or _default_limit(sets, folder)
    blocks: dict[str, int] = {}
    with filling(out) as into:
        for split, tiles in sets.items():
            with progress.stage(split):
                blocks[split] = sum(_write(into, split, sample, limit) for sample in tiles)
        described: dict[str, Any] = {**{split: f"images/{split}" for split in sets}, "names": {0: "block"}}
        head = f"# Difference maps in grey values: 128 + 127 * difference / {limit:.6g} m, 0 without data. Made by scarpsim.\n"
        write_text(into / "data.yaml", head + yaml.safe_dump(described, sort_keys=False))
    return YoloSet(out, limit, {split: len(tiles) for split, tiles in sets.items()}, blocks)


def _default_limit(sets: dict[str, Tiles], folder: Path) -> float:
    """Return the default limit of the grey scale. Raises InputError if no image states its noise."""
    said: list[Any] = [record.get("noise_sigma_m") for tiles in sets.values() for record in tiles.records]
    noise = [value for value in said if type(value) in (int, float) and 0 < value < math.inf]
    if not noise:
        raise InputError(
            "none of its images states its noise, which sets the limit of the grey scale",
            where=str(folder),
            remedy="set that limit with --limit-m",
        )
    return _SIGMAS * float(np.median(noise))


def _write(out: Path, split: str, sample: Sample, limit: float) -> int:
    """Write a tile's picture and labels; return the number of blocks in it."""
    name = Path(sample.record["file_name"]).with_suffix("").as_posix().replace("/", "_")
    _, encoded = cv2.imencode(".png", grey_values(sample.image, sample.valid, limit))
    write_bytes(out / "images" / split / f"{name}.png", encoded.tobytes())
    outlines = [outline(mask) for mask in sample.masks]
    write_text(out / "labels" / split / f"{name}.txt", "".join(_line(each, sample.valid.shape) for each in outlines if len(each)))
    return sum(len(each) > 0 for each in outlines)


def grey_values(image: NDArray[np.float32], valid: NDArray[np.bool_], limit_m: float) -> NDArray[np.uint8]:
    """Convert a difference map to 8 bits, as images for YOLO: 128 is no change, 1 and 255 are the ends, 0 no data.

    image: (h, w) differences, m. valid: (h, w) true where there is data. limit_m: difference at the ends of the scale, m.
    """
    grey = np.clip(np.round(_ZERO + _STEPS * image / limit_m), 1, 255)
    return np.where(valid, grey, 0).astype(np.uint8)


def outline(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the outline of a block's mask (h, w) as a polygon, as YOLO's labels need it.

    The outline is (k, 2) x, y, px from the top-left corner. Separate parts are joined by lines there and back.
    """
    fine = np.kron(mask.astype(np.uint8), np.ones((_FINER, _FINER), np.uint8))
    found, _ = cv2.findContours(fine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    parts = [(part.reshape(-1, 2) + 0.5) / _FINER for part in found]
    if not parts:
        return np.empty((0, 2))
    joined = parts[0]
    for part in parts[1:]:
        joined = _joined(joined, part)
    return np.asarray(joined)


def _joined(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Join two outlines at their nearest points."""
    apart = np.linalg.norm(first[:, None] - second[None], axis=2)
    here, there = (int(place) for place in np.unravel_index(np.argmin(apart), apart.shape))
    around = np.roll(second, -there, axis=0)
    return np.concatenate([first[: here + 1], around, around[:1], first[here:]])


def _line(points: NDArray[np.float64], shape: tuple[int, ...]) -> str:
    """Return the line of a label file."""
    shares = points / np.array([shape[1], shape[0]])
    return f"0 {' '.join(f'{value:.6f}' for value in shares.ravel())}\n"


def summary(made: YoloSet) -> str:
    """Describe a data set exported for YOLO as lines of text: folder, grey scale, numbers of images and blocks."""
    return "\n".join(_sentences(made))


def _sentences(made: YoloSet) -> Iterator[str]:
    """Yield the lines of the summary."""
    for split, images in made.images.items():
        yield f"{split}: {images:,} images, {made.blocks[split]:,} blocks"
    yield f"grey values end at {1e3 * made.limit_m:.3g} mm; train with {made.folder / 'data.yaml'}"


def to_dict(made: YoloSet) -> dict[str, Any]:
    """Return the result of an export for YOLO (folder, grey scale, numbers of images and blocks) as JSON types, for --json."""
    return {"folder": str(made.folder), "limit_m": made.limit_m, "images": made.images, "blocks": made.blocks}
