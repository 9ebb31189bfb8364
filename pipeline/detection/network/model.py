"""Mask R-CNN (He et al. 2017) in Keras 3, written from scratch for difference maps.

It uses only `keras.ops`, so that the model trains on any Keras backend and its weights load in any other. All shapes are fixed;
empty places are marked by weights or scores.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

import keras
import numpy as np
from keras import ops

from pipeline.detection.network.backbone import feature_pyramid
from pipeline.detection.network.boxes import Tensor, anchors, clip, decode, doublings, non_maximum_suppression, widened
from pipeline.detection.network.config import DetectorConfig, Loss
from pipeline.detection.network.heads import MASK_POOLED_PX, POOLED_PX, box_head, mask_head, proposal_head
from pipeline.detection.network.losses import binary_cross_entropy, cross_entropy, smooth_l1
from pipeline.detection.network.roi_align import roi_align
from pipeline.detection.network.targets import anchor_targets, box_targets, mask_targets

LOSSES: tuple[Loss, ...] = get_args(Loss)
"""Names of the five losses."""


def total_loss(losses: Mapping[str, Any], weights: Mapping[Loss, float]) -> Any:
    """Return the weighted sum of the losses that training minimises.

    losses: by name, numbers or tensors. weights: by name, 1 for those not listed.
    """
    return sum(weights.get(name, 1.0) * losses[name] for name in LOSSES)


@dataclass(frozen=True)
class FirstStage:
    """Output of the network's first stage for b images: their features, and which anchors may hold a block.

    Anchors are boxes of fixed size and place. The second stage looks at the best of them.

    Attributes
    ----------
    levels : Features (b, h, w, c) at four resolutions: strides 4, 8, 16 and 32 px (levels P2 to P5 of the feature pyramid), or
        half of these.
    logits : (b, a) log odds that each of a anchors holds a block.
    codes : (b, a, 4) shift and scaling from each anchor to a box that fits the block better, as `boxes.encode` defines them.
    """

    levels: list[Tensor]
    logits: Tensor
    codes: Tensor


class MaskRCNN(keras.Model):
    """The network that detects fallen blocks in difference maps, a Mask R-CNN (He et al. 2017).

    Called with images only, it detects; called with blocks too, it returns the losses. The input is a dictionary. image: (b, h,
    w, c) float32 as `normalisation.normalised` makes it, with h = w = image_px. For the losses also boxes: (b, g, 4) float32 y0,
    x0, y1, x1, px; valid: (b, g) 1 for a block, 0 for an unused box, -1 for a block to ignore; labels: (b, h, w) int32, 1 + the
    index of the block at a pixel, 0 for none.

    Parameters
    ----------
    config : Settings of the network.
    image_px : Side of the images, px; None: as in the config. It differs in training on windows.
    seed : Seed of the initial weights, and of the random choice of anchors and proposals for the losses.
    loss_weights : Factors of the losses in their sum, by name; 1 for those not listed.
    """

    def __init__(
        self, config: DetectorConfig, image_px: int | None = None, seed: int = 1, loss_weights: Mapping[Loss, float] | None = None
    ) -> None:
        """Build all layers; see the class."""
        super().__init__(name="mask_rcnn")
        keras.utils.set_random_seed(seed)
        self.config = config
        size = image_px or config.image_px
        channels = config.pyramid_channels
        self.pyramid = feature_pyramid(config.backbone, size, config.normalisation.channels, channels)
        self.proposal_head = proposal_head(channels, len(config.proposal.anchor_ratios), config.proposal.convolution_px)
        self.box_head = box_head(channels, config.head.hidden_units)
        self.mask_head = mask_head(channels, config.head.mask_size_px)
        self.anchors = anchors(size, size, config.strides, config.proposal.anchor_sizes_px, config.proposal.anchor_ratios)
        self.samples = keras.random.SeedGenerator(seed)
        self.means = {name: keras.metrics.Mean(name=name) for name in LOSSES}
        self.size = size
        self.term_weights = loss_weights or {}
        self.built = True  # all layers are functional models with known shapes

    def call(self, inputs: dict[str, Tensor], training: bool = False) -> dict[str, Tensor]:
        """Run the network on b images: return the losses if the inputs have annotated blocks, else the detections.

        Parameters
        ----------
        inputs : `image` (b, h, w, c); for training also `boxes`, `labels` and `valid`, as `network_input` makes them, batched.
        training : Whether the layers, such as batch normalisation, are in training mode; the heads only for the losses.

        Returns
        -------
        The losses by name, or n detections an image, best first: `boxes` (b, n, 4) y0, x0, y1, x1, px; `scores` (b, n), -1 where
        there are fewer; `masks` (b, n, m, m), probabilities; and `mask_boxes` (b, n, 4), px, the areas that the masks cover.
        """
        first = self.first_stage(inputs["image"], training=training)
        proposals = self._proposals(first.logits, first.codes)
        if "boxes" in inputs:
            return self._loss_terms(inputs, first, proposals, training)
        return self._detections(first.levels, proposals)

    def first_stage(self, image: Tensor, *, training: bool) -> FirstStage:
        """Compute features of images, and which anchors (boxes of fixed size) may hold a block.

        image: (b, h, w, c) images, normalised. training: whether layers, such as batch normalisation, are in training mode.
        """
        levels = self.pyramid(image, training=training)
        found = [self.proposal_head(level, training=training) for level in levels]
        logits = ops.concatenate([logit for logit, _ in found], axis=1)[..., 0]
        return FirstStage(levels[:4], logits, ops.concatenate([code for _, code in found], axis=1))

    def compute_loss(
        self, x: Any = None, y: Any = None, y_pred: Any = None, sample_weight: Any = None, training: bool = True
    ) -> Tensor:
        """Return the weighted sum of the losses, as Keras requires in training, and keep the mean of each one as a metric.

        y_pred: the losses by name, which the network returned. The other arguments are Keras's and not used.
        """
        for name in LOSSES:
            self.means[name].update_state(y_pred[name])
        return total_loss(y_pred, self.term_weights)

    def _proposals(self, logits: Tensor, codes: Tensor) -> Tensor:
        """Return the proposals (b, proposals, 4), px, without gradients; empty places have no area."""
        config = self.config.proposal
        best, index = ops.top_k(ops.stop_gradient(logits), min(config.candidates, logits.shape[1]))
        chosen = ops.take_along_axis(ops.stop_gradient(codes), index[..., None], axis=1)
        boxes = clip(decode(chosen, ops.take(self.anchors, index, axis=0)), self.size, self.size)
        boxes, scores = non_maximum_suppression(boxes, ops.sigmoid(best), config.suppression_iou, config.proposals)
        return ops.where(scores[..., None] >= 0, boxes, 0.0)

    def _loss_terms(self, inputs: dict[str, Tensor], first: FirstStage, proposals: Tensor, training: bool) -> dict[str, Tensor]:
        """Compute the five losses against sampled targets."""
        blocks, valid = inputs["boxes"], inputs["valid"]
        anchor = anchor_targets(self.anchors, blocks, valid, self.config.proposal, self.samples)
        sampled = ops.take_along_axis(first.logits, ops.concatenate([anchor.positive, anchor.negative], axis=1), axis=1)
        wanted = ops.concatenate([ops.ones_like(anchor.positive_weight), ops.zeros_like(anchor.negative_weight)], axis=1)
        weights = ops.concatenate([anchor.positive_weight, anchor.negative_weight], axis=1)
        anchor_codes = ops.take_along_axis(first.codes, anchor.positive[..., None], axis=1)
        target = box_targets(proposals, blocks, valid, self.config.head, self.samples)
        positives = target.positives
        classes, box_codes = self._on_boxes(first.levels, target.boxes, training)
        positive_weight = target.weight[:, :positives]
        is_block = np.arange(target.boxes.shape[1]) < positives
        block_class = ops.cast(ops.zeros_like(target.weight), "int32") + is_block.astype(np.int32)
        boxes = target.boxes[:, :positives]
        masks = self._masks(first.levels, boxes, training)
        mask = mask_targets(inputs["labels"], boxes, target.block, self.config.head.mask_size_px)
        return {
            "proposal_class": binary_cross_entropy(sampled, wanted, weights),
            "proposal_box": smooth_l1(anchor_codes, anchor.code, anchor.positive_weight),
            "class": cross_entropy(classes, block_class, target.weight),
            "box": smooth_l1(box_codes[:, :positives], target.code, positive_weight),
            "mask": binary_cross_entropy(masks, mask, positive_weight[..., None, None]),
        }

    def _detections(self, levels: list[Tensor], proposals: Tensor) -> dict[str, Tensor]:
        """Compute the detections, best first.

        Returns
        -------
        boxes (b, n, 4), px; scores (b, n), -1 where there are fewer; masks (b, n, m, m) of probabilities; mask_boxes (b, n, 4),
        the area of the masks: the boxes with `mask_margin_px` around them, which may reach beyond the image.
        """
        config = self.config.head
        classes, codes = self._on_boxes(levels, proposals, False)
        real = proposals[..., 2] > proposals[..., 0]
        boxes = clip(decode(codes, proposals), self.size, self.size)
        shift, per_doubling = config.shifts
        odds = classes[..., 1] - classes[..., 0] + shift + per_doubling * doublings(boxes)
        scores, order = ops.top_k(ops.where(real, ops.sigmoid(odds), -1.0), proposals.shape[1])
        boxes = ops.take_along_axis(ops.where(real[..., None], boxes, 0.0), order[..., None], axis=1)
        boxes, scores = non_maximum_suppression(boxes, scores, config.suppression_iou, config.detections)
        around = widened(boxes, config.mask_margin_px)
        masks = ops.sigmoid(self._masks(levels, around, False))
        return {"boxes": boxes, "scores": scores, "mask_boxes": around, "masks": masks}

    def _on_boxes(self, levels: list[Tensor], boxes: Tensor, training: bool) -> tuple[Tensor, Tensor]:
        """Return class logits (b, n, classes) and codes (b, n, 4) of boxes."""
        count = boxes.shape[1]
        logits, codes = self.box_head(_flat(roi_align(levels, boxes, self.config.strides, POOLED_PX)), training=training)
        return ops.reshape(logits, (-1, count, logits.shape[-1])), ops.reshape(codes, (-1, count, 4))

    def _masks(self, levels: list[Tensor], boxes: Tensor, training: bool) -> Tensor:
        """Return the mask logits (b, n, m, m) of boxes."""
        size = self.config.head.mask_size_px
        logits = self.mask_head(
            _flat(roi_align(levels, boxes, self.config.strides, MASK_POOLED_PX, samples=1)), training=training
        )
        return ops.reshape(logits, (-1, boxes.shape[1], size, size))


def _flat(features: Tensor) -> Tensor:
    """Reshape (b, n, s, s, c) to (b n, s, s, c)."""
    return ops.reshape(features, (-1, *features.shape[2:]))
