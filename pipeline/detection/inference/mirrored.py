"""Test-time augmentation: detect in a map and its mirror images, and average the network's outputs over these views.

The averages are taken of log odds, box codes and mask log odds; a proposal is the same box in all views. With all four views (as
it is, mirrored left-right, up-down, and both), a mirrored map gives exactly mirrored detections, unlike with the network alone.
"""

from __future__ import annotations

import numpy as np
from keras import ops
from numpy.typing import NDArray

from pipeline.detection.network.boxes import Axes, Tensor, mirrored, mirrored_codes
from pipeline.detection.network.config import DetectorConfig, Mirroring
from pipeline.detection.network.model import FirstStage, MaskRCNN

VIEWS: dict[Mirroring, tuple[Axes, ...]] = {
    "none": ((),),
    "left_right": ((), (1,)),
    "both": ((), (1,), (0,), (0, 1)),
}
"""Axes along which each view is mirrored, by `head.mirrored`."""


def build_network(config: DetectorConfig, image_px: int | None = None) -> MaskRCNN:
    """Build the network for detection from a detector's config, without trained weights.

    image_px: side of the images, px; None: as in the config.
    """
    return MaskRCNN(config, image_px) if config.head.mirrored == "none" else MirroredMaskRCNN(config, image_px)


class MirroredMaskRCNN(MaskRCNN):
    """A MaskRCNN that also looks at mirror images of the map (views) and averages its outputs over them, for better detections.

    Its `first_stage` returns a FirstStage whose `levels` are a list for each view: the levels P2 to P5 of the view's own feature
    pyramid.
    """

    @property
    def views(self) -> tuple[Axes, ...]:
        """For each view of the map, the axes along which it is mirrored (0: up-down, 1: left-right), as the config says."""
        return VIEWS[self.config.head.mirrored]

    def first_stage(self, image: Tensor, *, training: bool) -> FirstStage:
        """Compute features of images and their mirror images (views), and which anchors (fixed boxes) may hold a block.

        image: (b, h, w, c) images, not mirrored. training: whether layers are in training mode. The result has the features of
        each view. Scores and box codes are mirrored back and averaged over the views.
        """
        levels, logits, codes = [], [], []
        for axes in self.views:
            own = super().first_stage(ops.flip(image, [axis + 1 for axis in axes]), training=training)
            order = self._anchor_order(axes)
            levels.append(own.levels)
            logits.append(ops.take(own.logits, order, axis=1))
            codes.append(mirrored_codes(ops.take(own.codes, order, axis=1), axes))
        return FirstStage(levels, _mean(logits), _mean(codes))

    def _anchor_order(self, axes: Axes) -> NDArray[np.int64]:
        """Return the (a,) indices in a view of the unmirrored map's anchors."""
        ratios, start, result = len(self.config.proposal.anchor_ratios), 0, []
        for stride in self.config.strides:
            cells = -(-self.size // stride)
            numbers = start + np.arange(cells**2 * ratios).reshape(cells, cells, ratios)
            result.append(np.flip(numbers, axes).ravel())
            start += numbers.size
        return np.concatenate(result)

    def _on_boxes(self, levels: list[Tensor], boxes: Tensor, training: bool) -> tuple[Tensor, Tensor]:
        """Average class logits and box codes over the views."""
        logits, codes = [], []
        for axes, own in zip(self.views, levels, strict=True):
            classes, turned = super()._on_boxes(own, mirrored(boxes, axes, self.size), training)
            logits.append(classes)
            codes.append(mirrored_codes(turned, axes))
        return _mean(logits), _mean(codes)

    def _masks(self, levels: list[Tensor], boxes: Tensor, training: bool) -> Tensor:
        """Average mask logits over the views."""
        views = []
        for axes, own in zip(self.views, levels, strict=True):
            logits = super()._masks(own, mirrored(boxes, axes, self.size), training)
            views.append(ops.flip(logits, [axis + 2 for axis in axes]))
        return _mean(views)


def _mean(values: list[Tensor]) -> Tensor:
    """Return the mean of tensors."""
    return sum(values[1:], values[0]) / len(values)
