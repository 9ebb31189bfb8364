"""What the network should have said: targets of anchors and of proposals, drawn at random with fixed shapes.

Fixed numbers of positive and negative samples are drawn per image; where there are fewer, the rest of the places have weight 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from keras import ops, random

from pipeline.detection.network.boxes import Tensor, encode, intersection_over_union, share_inside
from pipeline.detection.network.config import HeadConfig, ProposalConfig

_IGNORED = 0.5
"""Share of a box in a block to ignore from which it is no background."""


@dataclass(frozen=True)
class AnchorTargets:
    """Sampled anchors of each image.

    positive, negative: (b, p), (b, n) their indices; positive_weight, negative_weight: 1 or 0; code: (b, p, 4) of the positives.
    """

    positive: Tensor
    positive_weight: Tensor
    negative: Tensor
    negative_weight: Tensor
    code: Tensor


@dataclass(frozen=True)
class BoxTargets:
    """Sampled proposals of each image, positives first.

    boxes: (b, p + n, 4); weight: (b, p + n) 1 or 0; code: (b, p, 4) of the positives; block: (b, p) index of each one's block.
    """

    boxes: Tensor
    weight: Tensor
    code: Tensor
    block: Tensor

    @property
    def positives(self) -> int:
        """Places for positives."""
        return int(self.code.shape[1])


def anchor_targets(
    anchors: np.ndarray, blocks: Tensor, valid: Tensor, config: ProposalConfig, seed: random.SeedGenerator
) -> AnchorTargets:
    """Which anchors are blocks: those near one, and the nearest to each block.

    anchors: (a, 4); blocks: (b, g, 4) with valid (b, g): 1, 0 for none, -1 for one to ignore, in which no anchor is negative.
    """
    counted, free = _counted(anchors[None], blocks, valid)
    overlap = intersection_over_union(anchors[None], blocks) * counted
    best = ops.max(overlap, axis=2)
    nearest = ops.any((overlap >= ops.max(overlap, axis=1, keepdims=True) - 1e-6) & (overlap > 0.05), axis=2)
    positive = ops.cast((best >= config.positive_iou) | nearest, "float32")
    negative = ops.cast(best < config.negative_iou, "float32") * (1 - positive) * free
    half = config.sampled_anchors // 2
    chosen, weight = _drawn(positive, half, seed)
    others, other_weight = _drawn(negative, config.sampled_anchors, seed)
    room = config.sampled_anchors - ops.sum(weight, axis=1, keepdims=True)
    other_weight = other_weight * ops.cast(np.arange(config.sampled_anchors)[None] < room, "float32")
    block = ops.take_along_axis(ops.argmax(overlap, axis=2), chosen, axis=1)
    wanted = ops.take_along_axis(blocks, block[..., None], axis=1)
    code = encode(wanted, ops.take(anchors, chosen, axis=0))
    return AnchorTargets(chosen, weight, others, other_weight, ops.where(weight[..., None] > 0, code, 0.0))


def box_targets(proposals: Tensor, blocks: Tensor, valid: Tensor, config: HeadConfig, seed: random.SeedGenerator) -> BoxTargets:
    """Which proposals are blocks; the blocks themselves are among the proposals, so that there is always something to learn from.

    proposals: (b, n, 4), empty ones have no area; blocks: (b, g, 4) with valid (b, g), as in `anchor_targets`.
    """
    everything = ops.concatenate([proposals, blocks * ops.cast(valid > 0, "float32")[..., None]], axis=1)
    sound = ops.cast((everything[..., 2] > everything[..., 0]) & (everything[..., 3] > everything[..., 1]), "float32")
    counted, free = _counted(everything, blocks, valid)
    overlap = intersection_over_union(everything, blocks) * counted
    best = ops.max(overlap, axis=2)
    positive = ops.cast(best >= config.positive_iou, "float32") * sound
    count = config.sampled_proposals // 3
    chosen, weight = _drawn(positive, count, seed)
    others, other_weight = _drawn((1 - positive) * sound * free, config.sampled_proposals - count, seed)
    block = ops.take_along_axis(ops.argmax(overlap, axis=2), chosen, axis=1)
    boxes = ops.take_along_axis(everything, ops.concatenate([chosen, others], axis=1)[..., None], axis=1)
    wanted = ops.take_along_axis(blocks, block[..., None], axis=1)
    code = ops.where(weight[..., None] > 0, encode(wanted, boxes[:, :count]), 0.0)
    return BoxTargets(boxes, ops.concatenate([weight, other_weight], axis=1), code, block)


def _counted(boxes: Tensor, blocks: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """(b, 1, g) 1 for the blocks that count, and (b, n) 0 for boxes that lie in one to ignore by _IGNORED or more, else 1."""
    ignored = ops.cast(valid < 0, "float32")[:, None]
    free = ops.max(share_inside(boxes, blocks) * ignored, axis=2) < _IGNORED
    return ops.cast(valid > 0, "float32")[:, None], ops.cast(free, "float32")


def mask_targets(labels: Tensor, boxes: Tensor, block: Tensor, size: int) -> Tensor:
    """(b, p, size, size) 1 where the pixel at a mask cell's centre belongs to the box's block, else 0.

    labels: (b, h, w) int32, 1 + the index of the block that a pixel belongs to, 0 for none; boxes: (b, p, 4); block: (b, p).
    """
    height, width = labels.shape[1:]
    parts = (np.arange(size, dtype=np.float32) + 0.5) / size
    row = _pixel(boxes[..., 0:1], boxes[..., 2:3], parts, height)
    column = _pixel(boxes[..., 1:2], boxes[..., 3:4], parts, width)
    image = ops.arange(ops.shape(labels)[0], dtype="int32")[:, None, None, None] * (height * width)
    index = image + row[..., :, None] * width + column[..., None, :]
    found = ops.take(ops.reshape(labels, (-1,)), index, axis=0)
    return ops.cast(found == ops.cast(block, "int32")[..., None, None] + 1, "float32")


def _pixel(low: Tensor, high: Tensor, parts: np.ndarray, length: int) -> Tensor:
    return ops.cast(ops.clip(ops.floor(low + parts * (high - low)), 0, length - 1), "int32")


def _drawn(wanted: Tensor, count: int, seed: random.SeedGenerator) -> tuple[Tensor, Tensor]:
    """(b, count) indices of random elements of those where wanted (b, n) is 1, and weights 1, or 0 where there are no more."""
    rank = wanted * (1 + random.uniform(ops.shape(wanted), seed=seed))
    found, index = ops.top_k(rank, min(count, wanted.shape[1]))
    return ops.cast(index, "int32"), ops.cast(found > 0.5, "float32")
