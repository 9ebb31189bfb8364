"""Detection that looks at a map's mirror images too: all that the network says is a mean over the views, each turned back.

Log odds, codes of boxes and log odds of masks are means; a proposal is one box in all views. With all four views, the map as it
is, mirrored left-right, up-down and both ways, a mirrored map has mirrored answers, which those of the network alone are not.
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
"""The axes along which a map is mirrored, view by view."""


def network(config: DetectorConfig, image_px: int | None = None) -> MaskRCNN:
    """The network that a detector's config tells of, as detection uses it."""
    return MaskRCNN(config, image_px) if config.head.mirrored == "none" else Mirrored(config, image_px)


class Mirrored(MaskRCNN):
    """A MaskRCNN whose answers are means over views. `FirstStage.levels` holds P2 to P5 of each view."""

    @property
    def views(self) -> tuple[Axes, ...]:
        """Those of its config."""
        return VIEWS[self.config.head.mirrored]

    def first_stage(self, image: Tensor, *, training: bool) -> FirstStage:
        """As `MaskRCNN.first_stage`, anchors of the map as it is."""
        levels, logits, codes = [], [], []
        for axes in self.views:
            own = super().first_stage(ops.flip(image, [axis + 1 for axis in axes]), training=training)
            order = self._turned_back(axes)
            levels.append(own.levels)
            logits.append(ops.take(own.logits, order, axis=1))
            codes.append(mirrored_codes(ops.take(own.codes, order, axis=1), axes))
        return FirstStage(levels, _mean(logits), _mean(codes))

    def _turned_back(self, axes: Axes) -> NDArray[np.int64]:
        """(a,) where the anchors of the map stand in a view."""
        ratios, start, result = len(self.config.proposal.anchor_ratios), 0, []
        for stride in self.config.strides:
            cells = -(-self.size // stride)
            numbers = start + np.arange(cells**2 * ratios).reshape(cells, cells, ratios)
            result.append(np.flip(numbers, axes).ravel())
            start += numbers.size
        return np.concatenate(result)

    def _on_boxes(self, levels: list[Tensor], boxes: Tensor, training: bool) -> tuple[Tensor, Tensor]:
        logits, codes = [], []
        for axes, own in zip(self.views, levels, strict=True):
            classes, turned = super()._on_boxes(own, mirrored(boxes, axes, self.size), training)
            logits.append(classes)
            codes.append(mirrored_codes(turned, axes))
        return _mean(logits), _mean(codes)

    def _masks(self, levels: list[Tensor], boxes: Tensor, training: bool) -> Tensor:
        views = []
        for axes, own in zip(self.views, levels, strict=True):
            logits = super()._masks(own, mirrored(boxes, axes, self.size), training)
            views.append(ops.flip(logits, [axis + 2 for axis in axes]))
        return _mean(views)


def _mean(values: list[Tensor]) -> Tensor:
    return sum(values[1:], values[0]) / len(values)
