"""Training targets of anchors and proposals, sampled at random with fixed shapes.

Fixed numbers of positive and negative samples are drawn for each image; places that cannot be filled have weight 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from keras import ops, random

from pipeline.detection.network.boxes import Tensor, encode, intersection_over_union, share_inside
from pipeline.detection.network.config import HeadConfig, ProposalConfig

_IGNORED = 0.5
"""Share of a box inside an ignored block from which the box is not background."""


@dataclass(frozen=True)
class AnchorTargets:
    """Anchors (boxes of fixed size) of b images, drawn at random for the loss of the region proposal network.

    The arrays have room for p positive and n negative anchors of each image, of which not all may be used.

    Attributes
    ----------
    positive, negative : (b, p) and (b, n) indices of anchors that hold a block, and of background.
    positive_weight, negative_weight : (b, p) and (b, n) 1 for a drawn anchor, 0 for an unused entry.
    code : (b, p, 4) shift and scaling from each positive anchor to its block's box, which the network learns (see
        `boxes.encode`).
    """

    positive: Tensor
    positive_weight: Tensor
    negative: Tensor
    negative_weight: Tensor
    code: Tensor


@dataclass(frozen=True)
class BoxTargets:
    """Proposed boxes of b images, drawn at random for the losses of the network's heads.

    The arrays have room for p positives (boxes that hold a block), which come first, and n negatives of each image, of which not
    all may be used.

    Attributes
    ----------
    boxes : (b, p + n, 4) boxes, top, left, bottom, right, px.
    weight : (b, p + n) 1 for a drawn box, 0 for an unused entry.
    code : (b, p, 4) shift and scaling from each positive to its block's box (see `boxes.encode`), which the network learns.
    block : (b, p) index of each positive's block.
    """

    boxes: Tensor
    weight: Tensor
    code: Tensor
    block: Tensor

    @property
    def positives(self) -> int:
        """Number of entries for positive proposals (boxes that hold a block) in each image; not all may be used."""
        return int(self.code.shape[1])


def anchor_targets(
    anchors: np.ndarray, blocks: Tensor, valid: Tensor, config: ProposalConfig, seed: random.SeedGenerator
) -> AnchorTargets:
    """Draw positive and negative anchors (boxes of fixed size), on which the region proposal network is trained.

    Positive are those with a large overlap with a block, and the nearest one to each block.

    Parameters
    ----------
    anchors : (a, 4) boxes, top, left, bottom, right, px.
    blocks : (b, g, 4) boxes of the annotated blocks in b images, px.
    valid : (b, g) 1 for a block, 0 for an unused box, -1 for a block to ignore, in which no anchor is negative.
    config : Thresholds and numbers of samples.
    seed : Source of random numbers.
    """
    counted, free = _counted(anchors[None], blocks, valid)
    overlap = intersection_over_union(anchors[None], blocks) * counted
    best = ops.max(overlap, axis=2)
    nearest = ops.any((overlap >= ops.max(overlap, axis=1, keepdims=True) - 1e-6) & (overlap > 0.05), axis=2)
    positive = ops.cast((best >= config.positive_iou) | nearest, "float32")
    negative = ops.cast(best < config.negative_iou, "float32") * (1 - positive) * free
    half = config.sampled_anchors // 2
    chosen, weight = _draw(positive, half, seed)
    others, other_weight = _draw(negative, config.sampled_anchors, seed)
    room = config.sampled_anchors - ops.sum(weight, axis=1, keepdims=True)
    other_weight = other_weight * ops.cast(np.arange(config.sampled_anchors)[None] < room, "float32")
    block = ops.take_along_axis(ops.argmax(overlap, axis=2), chosen, axis=1)
    wanted = ops.take_along_axis(blocks, block[..., None], axis=1)
    code = encode(wanted, ops.take(anchors, chosen, axis=0))
    return AnchorTargets(chosen, weight, others, other_weight, ops.where(weight[..., None] > 0, code, 0.0))


def box_targets(proposals: Tensor, blocks: Tensor, valid: Tensor, config: HeadConfig, seed: random.SeedGenerator) -> BoxTargets:
    """Draw positive and negative proposed boxes, on which the network's heads are trained.

    The blocks themselves are added to the proposals, so that there is always a positive.

    Parameters
    ----------
    proposals : (b, n, 4) boxes, top, left, bottom, right, px; those without area are unused.
    blocks : (b, g, 4) boxes of the annotated blocks in b images, px.
    valid : (b, g) 1 for a block, 0 for an unused box, -1 for a block to ignore, in which no proposal is negative.
    config : Threshold and number of samples.
    seed : Source of random numbers.
    """
    everything = ops.concatenate([proposals, blocks * ops.cast(valid > 0, "float32")[..., None]], axis=1)
    sound = ops.cast((everything[..., 2] > everything[..., 0]) & (everything[..., 3] > everything[..., 1]), "float32")
    counted, free = _counted(everything, blocks, valid)
    overlap = intersection_over_union(everything, blocks) * counted
    best = ops.max(overlap, axis=2)
    positive = ops.cast(best >= config.positive_iou, "float32") * sound
    count = config.sampled_proposals // 3
    chosen, weight = _draw(positive, count, seed)
    others, other_weight = _draw((1 - positive) * sound * free, config.sampled_proposals - count, seed)
    block = ops.take_along_axis(ops.argmax(overlap, axis=2), chosen, axis=1)
    boxes = ops.take_along_axis(everything, ops.concatenate([chosen, others], axis=1)[..., None], axis=1)
    wanted = ops.take_along_axis(blocks, block[..., None], axis=1)
    code = ops.where(weight[..., None] > 0, encode(wanted, boxes[:, :count]), 0.0)
    return BoxTargets(boxes, ops.concatenate([weight, other_weight], axis=1), code, block)


def _counted(boxes: Tensor, blocks: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Tell which blocks and boxes count, given that some blocks are to be ignored.

    Returns (b, 1, g) 1 for blocks that count, and (b, n) 0 for boxes whose share in an ignored block reaches _IGNORED, else 1.
    """
    ignored = ops.cast(valid < 0, "float32")[:, None]
    free = ops.max(share_inside(boxes, blocks) * ignored, axis=2) < _IGNORED
    return ops.cast(valid > 0, "float32")[:, None], ops.cast(free, "float32")


def mask_targets(labels: Tensor, boxes: Tensor, block: Tensor, size: int) -> Tensor:
    """Sample the annotated masks of blocks on the grid of their boxes, as targets for the mask head.

    Parameters
    ----------
    labels : (b, h, w) int32, 1 + the index of the block at a pixel, 0 for none.
    boxes : (b, p, 4) boxes, top, left, bottom, right, px.
    block : (b, p) index of each box's block.
    size : Cells along a side of the mask.

    Returns
    -------
    (b, p, size, size) 1 where the pixel at a cell's centre belongs to the box's block, else 0.
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
    """Return the pixels at the centres of mask cells along one axis."""
    return ops.cast(ops.clip(ops.floor(low + parts * (high - low)), 0, length - 1), "int32")


def _draw(wanted: Tensor, count: int, seed: random.SeedGenerator) -> tuple[Tensor, Tensor]:
    """Draw (b, count) indices at random where wanted (b, n) is 1, with weight 1, or 0 for places that cannot be filled."""
    rank = wanted * (1 + random.uniform(ops.shape(wanted), seed=seed))
    found, index = ops.top_k(rank, min(count, wanted.shape[1]))
    return ops.cast(index, "int32"), ops.cast(found > 0.5, "float32")
