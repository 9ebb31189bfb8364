"""Operations on boxes (y0, x0, y1, x1), px, where pixel (0, 0) covers 0...1: overlap, coding against anchors, suppression.

They work on batches and on any Keras backend.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from keras import ops
from numpy.typing import NDArray

Tensor = Any
"""A tensor of the Keras backend in use."""
Axes = tuple[int, ...]
"""Axes along which an image is mirrored: 0 exchanges up and down, 1 left and right."""
_DEVIATIONS = np.array([0.1, 0.1, 0.2, 0.2], np.float32)
"""Typical standard deviations of the four numbers of a code, which are divided by them (He et al. 2017)."""
_LARGEST_LOG = float(np.log(1000 / 16))
"""Largest logarithm of a size ratio in a code."""


def anchors(
    height: int, width: int, strides: tuple[int, ...], sizes: tuple[float, ...], ratios: tuple[float, ...]
) -> NDArray[np.float32]:
    """Compute the anchors, the boxes of fixed size and place from which a region proposal network predicts boxes of blocks.

    They are ordered by pyramid level, row, column and ratio; each is centred on a cell of its level.

    Parameters
    ----------
    height, width : Size of the image, px.
    strides : Pixels per cell, one for each pyramid level.
    sizes : Square root of the anchors' area, px, one for each level.
    ratios : Height over width.

    Returns
    -------
    (a, 4) boxes, top, left, bottom, right, px.
    """
    root = np.sqrt(np.asarray(ratios))
    levels = []
    for stride, size in zip(strides, sizes, strict=True):
        y = (np.arange(-(-height // stride)) + 0.5) * stride
        x = (np.arange(-(-width // stride)) + 0.5) * stride
        centre = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1)[:, :, None]
        half = 0.5 * size * np.stack([root, 1 / root], axis=-1)
        levels.append(np.concatenate([centre - half, centre + half], axis=-1).reshape(-1, 4))
    return np.concatenate(levels).astype(np.float32)


def intersection_over_union(left: Tensor, right: Tensor) -> Tensor:
    """Compute the overlap of each of n boxes with each of m others: intersection over union (..., n, m), 0 if both are empty.

    left, right: the n boxes (..., n, 4) and the m others (..., m, 4) as top, left, bottom, right, px.
    """
    left, right = ops.expand_dims(left, -2), ops.expand_dims(right, -3)
    common = _common(left, right)
    return common / ops.maximum(_area(left) + _area(right) - common, 1e-6)


def share_inside(left: Tensor, right: Tensor) -> Tensor:
    """Return the share of the area of each of n boxes that lies in each of m others, (..., n, m); 0 for empty boxes.

    left, right: the n boxes (..., n, 4) and the m others (..., m, 4) as top, left, bottom, right, px. This is COCO's overlap
    with a crowd region.
    """
    left, right = ops.expand_dims(left, -2), ops.expand_dims(right, -3)
    return _common(left, right) / ops.maximum(_area(left), 1e-6)


def _common(left: Tensor, right: Tensor) -> Tensor:
    """Return the area of intersection."""
    height, width = (
        ops.maximum(ops.minimum(left[..., end], right[..., end]) - ops.maximum(left[..., start], right[..., start]), 0.0)
        for start, end in ((0, 2), (1, 3))
    )
    return height * width


def encode(boxes: Tensor, reference: Tensor) -> Tensor:
    """Code boxes relative to reference boxes (anchors or proposals), as the four numbers that the network predicts.

    boxes, reference: (..., 4) top, left, bottom, right, px. The code (..., 4) has the shift of the centre in y and x in units
    of the reference's height and width, then the logarithms of the ratios of heights and widths. All are divided by their usual
    standard deviations.
    """
    centre, size = _centre_size(boxes)
    at, scale = _centre_size(reference)
    code = ops.concatenate([(centre - at) / scale, ops.log(size / scale)], axis=-1)
    return code / _DEVIATIONS


def decode(code: Tensor, reference: Tensor) -> Tensor:
    """Return the boxes (..., 4) that the network's codes mean, the inverse of `encode`.

    code: (..., 4) relative to the boxes `reference` (..., 4), top, left, bottom, right, px. Sizes are limited to 62 times the
    reference's.
    """
    at, scale = _centre_size(reference)
    code = code * _DEVIATIONS
    centre = at + code[..., :2] * scale
    half = 0.5 * scale * ops.exp(ops.minimum(code[..., 2:], _LARGEST_LOG))
    return ops.concatenate([centre - half, centre + half], axis=-1)


def widened(boxes: Tensor, margin: float) -> Tensor:
    """Return boxes with all edges moved outwards by `margin`, px, to predict masks with a margin.

    boxes: (..., 4) top, left, bottom, right, px.
    """
    return boxes + margin * np.array([-1, -1, 1, 1], np.float32)


def mirrored(boxes: Tensor, axes: Axes, side: float) -> Tensor:
    """Return where boxes lie after their image is mirrored; applying it twice gives the boxes again.

    boxes: (..., 4) top, left, bottom, right, px. axes: mirrored axes, 0 for up-down, 1 for left-right. side: of the image, px.
    """
    edges = [boxes[..., number] for number in range(4)]
    for axis in axes:
        edges[axis], edges[axis + 2] = side - edges[axis + 2], side - edges[axis]
    return ops.stack(edges, axis=-1)


def mirrored_codes(codes: Tensor, axes: Axes) -> Tensor:
    """Return the codes (see `encode`) of boxes after their image is mirrored; applying it twice gives the codes again.

    codes: (..., 4), of which the shifts of the centre change sign and the sizes stay. axes: mirrored axes, 0 for up-down, 1 for
    left-right.
    """
    return codes * np.array([-1 if axis in axes else 1 for axis in range(2)] + [1, 1], np.float32)


def doublings(boxes: Tensor) -> Tensor:
    """Return the size of boxes as a number of doublings of 16 px, by which the detector corrects its scores.

    boxes: (..., 4) y0, x0, y1, x1, px. Returns log2(s / 16 px) (...), where s is the root of the box's area, at least 1 px.
    """
    return 0.5 * ops.log2(ops.maximum(_area(boxes), 1.0)) - 4.0


def clip(boxes: Tensor, height: int, width: int) -> Tensor:
    """Clip boxes (..., 4), top, left, bottom, right, px, to an image of the given height and width, px."""
    return ops.clip(boxes, 0.0, np.array([height, width, height, width], np.float32))


def non_maximum_suppression(boxes: Tensor, scores: Tensor, threshold: float, count: int) -> tuple[Tensor, Tensor]:
    """Drop boxes that overlap a better one (greedy non-maximum suppression), so that each block is found once.

    A box stays unless a better box that stays overlaps it by more than `threshold`. The rule has a unique solution. It is found
    by applying the rule to all boxes at once until nothing changes; each pass settles at least one more box, and in practice a
    few passes settle all.

    Parameters
    ----------
    boxes : (b, n, 4) boxes of b images, top, left, bottom, right, px.
    scores : (b, n) scores, 0...1, falling along n.
    threshold : Largest IoU of two boxes that both stay.
    count : Number of boxes to return for each image.

    Returns
    -------
    The best boxes (b, count, 4) and their scores (b, count), -1 where there are fewer.
    """
    size = boxes.shape[1]
    better = np.triu(np.ones((size, size), np.float32), 1)
    rival = ops.cast(intersection_over_union(boxes, boxes) > threshold, "float32") * better

    def step(kept: Tensor, _: Tensor) -> tuple[Tensor, Tensor]:
        return ops.cast(ops.matmul(kept[:, None], rival)[:, 0] < 0.5, "float32"), kept

    start = ops.ones_like(scores)
    kept, _ = ops.while_loop(lambda new, old: ops.any(new != old), step, (start, 0 * start), maximum_iterations=size)
    sound = (kept > 0.5) & (_area(boxes) > 0)
    best, index = ops.top_k(ops.where(sound, scores, -1.0), min(count, size))
    return ops.take_along_axis(boxes, index[..., None], axis=1), best


def _area(boxes: Tensor) -> Tensor:
    """Return the area of boxes."""
    return (boxes[..., 2] - boxes[..., 0]) * (boxes[..., 3] - boxes[..., 1])


def _centre_size(boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Return centre and size of boxes."""
    size = ops.maximum(boxes[..., 2:] - boxes[..., :2], 1e-3)
    return 0.5 * (boxes[..., 2:] + boxes[..., :2]), size
