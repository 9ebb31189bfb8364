"""Maps larger than a tile: every block is found once, whole and at its place, in whichever form `detect` gets the map."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pycocotools import mask as coco_mask
from scipy import ndimage

from pipeline.cli.main import main
from pipeline.detection.evaluation.detections import Detection
from pipeline.detection.inference import inference
from pipeline.detection.inference.inference import tile_places
from pipeline.detection.network.config import DetectorConfig, NormalisationConfig
from pipeline.detection.products import run
from pipeline.formats.rasters.geotiff import write_geotiff
from scene.geometry.grid import Grid

TILE, CELLS, DEPTH, NOISE = 64, 128, 1.0, 0.004
GSD = 0.02


class MarkFinder:
    """A fake network that finds, to the pixel, what a tile shows of each mark.

    smaller_better: small parts have the better scores, otherwise large ones; blind: numbers of the tiles in which it finds
    nothing; short_px: masks end this far before the tile's borders, as a network's do.
    """

    size = TILE
    config = DetectorConfig(image_px=TILE, normalisation=NormalisationConfig(method="fixed", scale_m=0.05))

    def __init__(self, *, smaller_better: bool = False, blind: tuple[int, ...] = (), short_px: int = 0) -> None:
        self.smaller_better, self.blind, self.short_px, self.calls = smaller_better, blind, short_px, 0

    def predict_on_batch(self, inputs):
        answers = [self._of(image) for image in inputs["image"]]
        most = max(1, *(len(each) for each in answers))
        boxes, scores = np.zeros((len(answers), most, 4), np.float32), np.full((len(answers), most), -1, np.float32)
        masks = np.zeros((len(answers), most, CELLS, CELLS), np.float32)
        for number, answer in enumerate(answers):
            for place, (score, box, mask) in enumerate(sorted(answer, key=lambda each: -each[0])):
                boxes[number, place], scores[number, place], masks[number, place] = box, score, mask
        return {"mask_boxes": boxes, "scores": scores, "masks": masks}

    def _of(self, image):
        self.calls += 1
        if self.calls - 1 in self.blind:
            return []
        marks = image[..., 0] > 1
        inner = np.zeros_like(marks)
        inner[self.short_px : TILE - self.short_px, self.short_px : TILE - self.short_px] = True
        labels, _ = ndimage.label(marks & inner)
        found = []
        for label, (rows, columns) in enumerate(ndimage.find_objects(labels), start=1):
            crop = labels[rows, columns] == label
            cells = [np.arange(CELLS) * length // (CELLS) for length in crop.shape]
            share = np.count_nonzero(crop) / TILE**2
            score = 0.99 - 0.05 * share if self.smaller_better else 0.94 + 0.05 * share
            box = (rows.start, columns.start, rows.stop, columns.stop)
            found.append((score, box, crop[np.ix_(*cells)].astype(np.float32)))
        return found


def map_of(shape: tuple[int, int], marks: list[np.ndarray]) -> np.ndarray:
    """Return a difference map, m: noise and the marks (masks of the whole map)."""
    difference = np.random.default_rng(5).normal(0, NOISE, shape).astype(np.float32)
    for mark in marks:
        difference[mark] += DEPTH
    return difference


def rectangle(shape: tuple[int, int], row: int, column: int, height: int, width: int) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[row : row + height, column : column + width] = True
    return mask


def scattered(shape: tuple[int, int]) -> list[np.ndarray]:
    """Return marks of 9 x 7 px, one at a random place in each cell of 17 x 15 px; some lie across borders of tiles."""
    random = np.random.default_rng(8)
    cells = [(row, column) for row in range(0, shape[0] - 16, 17) for column in range(0, shape[1] - 14, 15)]
    return [rectangle(shape, row + random.integers(1, 7), column + random.integers(1, 7), 9, 7) for row, column in cells]


def whole(item: Detection, shape: tuple[int, int]) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[item.row : item.row + item.mask.shape[0], item.column : item.column + item.mask.shape[1]] = item.mask
    return mask


def as_set(masks: list[np.ndarray]) -> set[bytes]:
    assert len({mask.tobytes() for mask in masks}) == len(masks), "doubles"
    return {mask.tobytes() for mask in masks}


@pytest.mark.parametrize("shape", [(64, 64), (50, 300), (65, 64), (150, 233)])
@pytest.mark.parametrize("smaller_better", [False, True])
def test_every_mark_is_found_once_and_whole(shape, smaller_better):
    """Each mark is found once, even if a part of it has a better score than the whole mark.

    Places and masks agree to the pixel.
    """
    marks = scattered(shape)
    for axis in (0, 1):
        spans = [np.flatnonzero(mark.any(axis=1 - axis))[[0, -1]] for mark in marks]
        borders = {place[axis] + end for place in tile_places(shape, TILE) for end in (0, TILE)}
        inner = [border for border in borders if 0 < border < shape[axis] - 8]
        crossed = [border for border in inner if any(first < border <= last for first, last in spans)]
        assert len(crossed) >= len(inner) // 4  # the test sees what it is for
    found = inference.detect(MarkFinder(smaller_better=smaller_better), map_of(shape, marks))
    assert as_set([whole(item, shape) for item in found]) == as_set(marks)
    assert [item.score for item in found] == sorted((item.score for item in found), reverse=True)


def test_margins_without_data_are_not_searched():
    """Margins occur around a wall that does not fill its raster: the answers are the same, shifted, from as many tiles."""
    shape, margin = (150, 100), ((70, 300), (40, 130))
    marks = scattered(shape)
    alone, framed = MarkFinder(), MarkFinder()
    expected = inference.detect(alone, map_of(shape, marks))
    found = inference.detect(framed, np.pad(map_of(shape, marks), margin, constant_values=np.nan))
    assert [(item.row - 70, item.column - 40, item.score) for item in found] == [
        (item.row, item.column, item.score) for item in expected
    ]
    for one, other in zip(found, expected, strict=True):
        assert_array_equal(one.mask, other.mask)
    assert framed.calls == alone.calls
    assert inference.detect(framed, np.full(shape, np.nan, np.float32)) == []


def test_tiles_without_data_are_not_searched():
    """Data in two opposite corners: of 5 x 5 tiles only the two that see them are searched, one at a time."""
    shape = (256, 256)
    marks = [rectangle(shape, 10, 12, 9, 7), rectangle(shape, 240, 230, 9, 7)]
    corners = rectangle(shape, 0, 0, 40, 40) | rectangle(shape, 216, 216, 40, 40)
    assert len(list(tile_places(shape, TILE))) == 25
    finder = MarkFinder()
    found = inference.detect(finder, np.where(corners, map_of(shape, marks), np.nan).astype(np.float32))
    assert as_set([whole(item, shape) for item in found]) == as_set(marks)
    assert finder.calls == 2


def _u_shape(shape: tuple[int, int]) -> np.ndarray:
    mask = rectangle(shape, 40, 30, 120, 110)
    mask[40:130, 50:120] = False
    return mask


SHAPE = (250, 330)
LARGE = {
    "half a tile": rectangle(SHAPE, 45, 70, 33, 32),
    "three quarters of a tile": rectangle(SHAPE, 45, 70, 48, 48),
    "a band of two tiles": rectangle(SHAPE, 60, 20, 10, 128),
    "a band of the whole width": rectangle(SHAPE, 60, 0, 40, 330),
    "nine tiles": rectangle(SHAPE, 30, 40, 170, 190),
    "a U": _u_shape(SHAPE),
}


@pytest.mark.parametrize("kind", LARGE)
@pytest.mark.parametrize("smaller_better", [False, True])
def test_a_block_that_no_tile_sees_whole_is_put_together(kind, smaller_better):
    marks = [LARGE[kind], rectangle(SHAPE, 5, 5, 8, 8), rectangle(SHAPE, 220, 300, 12, 20)]
    found = inference.detect(MarkFinder(smaller_better=smaller_better), map_of(SHAPE, marks))
    assert as_set([whole(item, SHAPE) for item in found]) == as_set(marks)


def test_a_part_that_the_tile_beside_denies_is_left_out():
    """Tiles begin at columns 0, 32 and 64. Only the middle one sees the whole mark, and here it finds nothing."""
    shape = (64, 128)
    marks = [rectangle(shape, 20, 58, 9, 12)]
    assert len(inference.detect(MarkFinder(), map_of(shape, marks))) == 1
    assert inference.detect(MarkFinder(blind=(1,)), map_of(shape, marks)) == []


@pytest.mark.parametrize("smaller_better", [False, True])
def test_masks_that_end_short_of_the_border_make_no_halves(smaller_better):
    """A network's mask of a block that the tile cuts ends up to some pixels before the border."""
    shape = (100, 200)
    marks = [mark for mark in scattered(shape) if not (mark[:2].any() or mark[-2:].any() or mark[:, :2].any())]
    marks = [mark for mark in marks if not mark[:, -2:].any()]
    found = inference.detect(MarkFinder(smaller_better=smaller_better, short_px=2), map_of(shape, marks))
    assert as_set([whole(item, shape) for item in found]) == as_set(marks)


def given_as(kind: str, folder: Path, maps: list[np.ndarray]) -> list[Path]:
    """Write the maps as files, a run folder or a COCO folder, and return what to pass to `detect`."""
    paths = [folder / f"difference_{number:03d}.tif" for number in range(1, len(maps) + 1)]
    for path, values in zip(paths, maps, strict=True):
        write_geotiff(path, values, Grid(100.0, 50.0, GSD, values.shape[1], values.shape[0]))
    if kind == "files":
        return paths
    if kind == "coco":
        images = [
            {"id": 10 + number, "file_name": path.name, "height": values.shape[0], "width": values.shape[1]}
            for number, (path, values) in enumerate(zip(paths, maps, strict=True))
        ]
        content = {"images": images, "annotations": [], "categories": [{"id": 1, "name": "block"}]}
        (folder / "annotations.json").write_text(json.dumps(content))
    return [folder]


@pytest.mark.parametrize("kind", ["files", "run", "coco"])
def test_every_kind_of_input_is_searched_to_its_last_corner(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "detector", lambda *_, **__: lambda difference: inference.detect(MarkFinder(), difference, 0.05))
    shapes = [(150, 210), (70, 300)]
    marks = [scattered(shape) for shape in shapes]
    inputs = given_as(kind, tmp_path / "maps", [map_of(*each) for each in zip(shapes, marks, strict=True)])
    out = tmp_path / "out"
    assert main(["detect", "baseline", *map(str, inputs), "--out", str(out), "--no-pictures"]) == 0
    content = json.loads((out / "detections.json").read_text())
    for image, shape, true in zip(content["images"], shapes, marks, strict=True):
        assert (image["height"], image["width"]) == shape
        found = [each for each in content["annotations"] if each["image_id"] == image["id"]]
        masks = [np.ascontiguousarray(coco_mask.decode(each["segmentation"]).astype(bool)) for each in found]
        assert as_set(masks) == as_set(true)
        for each, mask in zip(found, masks, strict=True):
            assert_array_equal(each["bbox"], coco_mask.toBbox(each["segmentation"]))
            assert each["area"] == mask.sum()
        events = [row for row in csv.DictReader((out / "events_0.9.csv").open()) if row["image"] == image["file_name"]]
        told = sorted((float(row["x_m"]), float(row["y_m"])) for row in events)
        centres = [np.argwhere(mask).mean(axis=0) + 0.5 for mask in true]
        assert_allclose(told, sorted((100 + x * GSD, 50 - y * GSD) for y, x in centres), atol=1e-4)


@pytest.mark.slow
def test_the_detector_that_comes_along_searches_the_whole_map(tmp_path, eager):
    """The bundled detector finds each of 40 clear niches in a map of 2 x 5 tiles, by a mask that covers most of it.

    The niches have 30 px, are twenty times as deep as the noise, and lie on a grid over 600 x 1400 px.
    """
    shape = (600, 1400)
    y, x = np.mgrid[: shape[0], : shape[1]]
    centres = [(60 + 160 * row, 60 + 142 * column) for row in range(4) for column in range(10)]
    marks = [np.hypot(y - row, x - column) < 15 for row, column in centres]
    difference = np.random.default_rng(3).normal(0, NOISE, shape).astype(np.float32)
    for mark in marks:
        difference[mark] += 20 * NOISE
    write_geotiff(tmp_path / "map.tif", difference, Grid(0.0, 12.0, GSD, shape[1], shape[0]))
    run.detect("default", [tmp_path / "map.tif"], tmp_path / "out", confidences=(0.9,), pictures=False)
    found = json.loads((tmp_path / "out" / "detections_0.9.json").read_text())["annotations"]
    masks = [coco_mask.decode(each["segmentation"]).astype(bool) for each in found]
    overlap = np.array([[np.sum(mask & mark) / np.sum(mask | mark) for mask in masks] for mark in marks])
    assert (overlap.max(axis=1) > 0.7).all()
    assert ((overlap > 0.1).sum(axis=1) == 1).all()
    assert len(found) <= len(marks) + 2
