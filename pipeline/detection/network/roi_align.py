"""ROIAlign (He et al. 2017): sample the features of boxes by bilinear interpolation, without rounding positions."""

from __future__ import annotations

import numpy as np
from keras import ops

from pipeline.detection.network.boxes import Tensor

_CANONICAL_CELLS = 14.0
"""Side in cells of P2 from which a box of twice that size takes its features from P3, and of four times from P4. With 14, the
mask head's input samples P2 at its own spacing.
"""


def roi_align(features: list[Tensor], boxes: Tensor, strides: tuple[int, ...], size: int, samples: int = 2) -> Tensor:
    """Interpolate the features of boxes from the feature pyramid on a grid of size x size bins per box (He et al. 2017).

    Each bin is the mean of samples x samples interpolated values at the centres of its parts. A cell's value is at the cell's
    centre, so that the feature of a linear ramp is the ramp at the bin's centre; beyond the outermost centres, the nearest
    value is used.

    Parameters
    ----------
    features : Pyramid levels P2, P3, ..., (b, h, w, c) each.
    boxes : (b, n, 4) boxes, top, left, bottom, right, px of the image.
    strides : Pixels of the image per cell of each level.
    size : Bins along a side.
    samples : Samples along a side of a bin.

    Returns
    -------
    (b, n, size, size, c) features.
    """
    shapes = np.array([feature.shape[1:3] for feature in features], np.int32)
    starts = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))]).astype(np.int32)
    channels = features[0].shape[-1]
    cells = ops.concatenate(
        [ops.reshape(feature, (-1, starts[i + 1] - starts[i], channels)) for i, feature in enumerate(features)], axis=1
    )
    flat = ops.reshape(cells, (-1, channels))  # flattened once, so that the gradients of all gathers are added in one tensor
    image = ops.arange(ops.shape(cells)[0], dtype="int32")[:, None] * int(starts[-1])
    level = _levels(boxes, len(features), _CANONICAL_CELLS * strides[0])
    stride = ops.take(np.array(strides[: len(features)], np.float32), level, axis=0)
    height, width = ops.take(shapes[:, 0], level, axis=0), ops.take(shapes[:, 1], level, axis=0)
    start = ops.take(starts[:-1], level, axis=0) + image
    parts = (np.arange(size * samples, dtype=np.float32) + 0.5) / (size * samples)
    total = 0.0
    for i in range(samples):
        y0, y1, wy = _neighbours(boxes[..., 0:1], boxes[..., 2:3], parts[i::samples], stride, height)
        for j in range(samples):
            x0, x1, wx = _neighbours(boxes[..., 1:2], boxes[..., 3:4], parts[j::samples], stride, width)
            for rows, row_weight in ((y0, 1 - wy), (y1, wy)):
                for columns, column_weight in ((x0, 1 - wx), (x1, wx)):
                    index = start[..., None, None] + rows[..., :, None] * width[..., None, None] + columns[..., None, :]
                    weight = row_weight[..., :, None] * column_weight[..., None, :]
                    total = total + ops.take(flat, index, axis=0) * weight[..., None]
    return total / samples**2


def _levels(boxes: Tensor, count: int, canonical_px: float) -> Tensor:
    """Return the level of each box by its area."""
    area = ops.maximum((boxes[..., 2] - boxes[..., 0]) * (boxes[..., 3] - boxes[..., 1]), 1e-6)
    level = ops.floor(0.5 * ops.log(area / canonical_px**2) / float(np.log(2.0)))
    return ops.cast(ops.clip(level, 0, count - 1), "int32")


def _neighbours(low: Tensor, high: Tensor, parts: np.ndarray, stride: Tensor, length: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the (b, n, size) cells on both sides of each sample along one axis, and the weight of the second."""
    at = (low + parts * (high - low)) / stride[..., None] - 0.5
    last = ops.cast(length, "float32")[..., None] - 1
    at = ops.minimum(ops.maximum(at, 0.0), last)
    first = ops.minimum(ops.floor(at), ops.maximum(last - 1, 0.0))
    second = ops.minimum(first + 1, last)
    return ops.cast(first, "int32"), ops.cast(second, "int32"), at - first
