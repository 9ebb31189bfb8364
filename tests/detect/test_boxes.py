"""Anchors, the box codec, non-maximum suppression, ROIAlign."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

STRIDES = (4, 8, 16, 32, 64)


@pytest.fixture(autouse=True, scope="module")
def _network() -> None:
    """Import what needs Keras only where a test runs, as TensorFlow takes seconds to import."""
    global anchors, clip, decode, doublings, encode, intersection_over_union, non_maximum_suppression, roi_align, widened
    from pipeline.detection.network.boxes import (
        anchors,
        clip,
        decode,
        doublings,
        encode,
        intersection_over_union,
        non_maximum_suppression,
        widened,
    )
    from pipeline.detection.network.roi_align import roi_align


def _random_boxes(count: int, seed: int, side: float = 200.0) -> np.ndarray:
    random = np.random.default_rng(seed)
    corner = random.uniform(0, side, (count, 2))
    return np.concatenate([corner, corner + random.uniform(3, 60, (count, 2))], axis=1).astype(np.float32)


def _greedy(boxes: np.ndarray, threshold: float) -> list[int]:
    """The textbook loop of greedy non-maximum suppression."""
    overlap = np.asarray(intersection_over_union(boxes, boxes))
    kept: list[int] = []
    for index in range(len(boxes)):
        if all(overlap[index, better] <= threshold for better in kept):
            kept.append(index)
    return kept


def test_anchors_are_centred_on_their_cells_with_the_size_and_ratio_asked_for():
    made = anchors(64, 128, STRIDES, (8, 16, 32, 64, 128), (0.5, 1.0, 2.0))
    assert len(made) == 3 * sum((64 // s) * (128 // s) for s in STRIDES)
    height, width = (made[:, 2:] - made[:, :2]).T
    assert_allclose(np.sqrt(height * width)[:3], 8, rtol=1e-6)
    assert_allclose((height / width)[:3], (0.5, 1.0, 2.0), rtol=1e-6)
    second_of_row = made[3]  # one cell to the right, first ratio
    assert_allclose(0.5 * (second_of_row[:2] + second_of_row[2:]), (2, 6), atol=1e-6)


def test_overlap_of_known_boxes():
    left = np.array([[0, 0, 2, 2], [0, 0, 0, 0]], np.float32)
    right = np.array([[1, 1, 3, 3], [0, 0, 2, 2], [5, 5, 6, 6]], np.float32)
    assert_allclose(intersection_over_union(left, right), [[1 / 7, 1, 0], [0, 0, 0]], rtol=1e-6)


def test_the_codec_gives_a_box_back():
    wanted, reference = _random_boxes(500, 1), _random_boxes(500, 2)
    assert_allclose(decode(encode(wanted, reference), reference), wanted, atol=2e-3)
    assert_allclose(encode(reference, reference), 0, atol=1e-5)


def test_boxes_are_cut_at_the_image():
    assert_allclose(clip(np.array([[-3, 5, 70, 90]], np.float32), 64, 80), [[0, 5, 64, 80]])


def test_doublings_of_a_side_of_sixteen_pixels():
    boxes = np.array([[0, 0, 16, 16], [0, 0, 64, 16], [2, 2, 6, 6], [5, 5, 5, 5]], np.float32)
    assert_allclose(doublings(boxes), [0, 1, -2, -4], atol=1e-6)


def test_a_widened_box_reaches_further_by_the_margin_on_every_side():
    assert_allclose(widened(np.array([[3, 5, 7, 90]], np.float32), 1.5), [[1.5, 3.5, 8.5, 91.5]])


@pytest.mark.parametrize("seed", range(5))
def test_suppression_is_the_greedy_one(seed):
    boxes = _random_boxes(300, 10 + seed, 250)
    scores = np.sort(np.random.default_rng(seed).random(300).astype(np.float32))[::-1]
    wanted = _greedy(boxes, 0.3)
    found, best = non_maximum_suppression(boxes[None], scores[None].copy(), 0.3, 300)
    assert_allclose(np.asarray(found)[0, : len(wanted)], boxes[wanted])
    assert_allclose(np.asarray(best)[0, : len(wanted)], scores[wanted])
    assert (np.asarray(best)[0, len(wanted) :] == -1).all()


def test_a_long_chain_of_overlaps_is_settled():
    start = np.arange(200, dtype=np.float32) * 4
    boxes = np.stack(
        [start, 0 * start, start + 10, 0 * start + 10], axis=1
    )  # each overlaps its neighbours alone by more than 0.4
    _, scores = non_maximum_suppression(boxes[None], np.linspace(1, 0.5, 200, dtype=np.float32)[None], 0.4, 200)
    assert int((np.asarray(scores) > 0).sum()) == 100


@pytest.mark.parametrize("samples", [1, 2])
def test_roi_align_is_exact_on_a_ramp(samples):
    """Bilinear interpolation of a linear function is the function: the bin's mean is its value at the bin's centre."""
    levels = []
    for stride in STRIDES[:4]:
        centre = (np.arange(512 // stride) + 0.5) * stride
        y, x = np.meshgrid(centre, centre, indexing="ij")
        levels.append(np.stack([y, x, 3 - 0.5 * y + 2 * x], axis=-1)[None].astype(np.float32))
    boxes = np.array([[[100.3, 60.7, 131.9, 170.2], [33, 40, 250.5, 300.25], [200, 200, 208, 212]]], np.float32)
    found = np.asarray(roi_align(levels, boxes, STRIDES[:4], 7, samples))
    parts = (np.arange(7) + 0.5) / 7
    for box, features in zip(boxes[0], found[0], strict=True):
        y = box[0] + parts * (box[2] - box[0])
        x = box[1] + parts * (box[3] - box[1])
        assert_allclose(features[..., 0], np.broadcast_to(y[:, None], (7, 7)), atol=2e-4)
        assert_allclose(features[..., 1], np.broadcast_to(x[None], (7, 7)), atol=2e-4)
        assert_allclose(features[..., 2], 3 - 0.5 * y[:, None] + 2 * x[None], atol=2e-3)


def test_roi_align_takes_small_boxes_from_the_finest_level_and_keeps_images_apart():
    levels = [np.stack([np.full((128 // 2**k, 128 // 2**k, 1), 10 * b + k, np.float32) for b in range(2)]) for k in range(4)]
    boxes = np.tile(np.array([[0, 0, 8, 8], [0, 0, 60, 60], [0, 0, 120, 120], [0, 0, 500, 500]], np.float32), (2, 1, 1))
    found = np.asarray(roi_align(levels, boxes, STRIDES, 2))[:, :, 0, 0, 0]
    assert_array_equal(found, [[0, 0, 1, 3], [10, 10, 11, 13]])
