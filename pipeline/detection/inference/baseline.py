"""A detector without a network, for comparison: threshold at the level of detection, morphology, connected components."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.detection.evaluation.detections import Detection
from pipeline.detection.network.normalisation import LEVEL_OF_DETECTION, nmad
from scene.common.config import Config


class BaselineConfig(Config):
    """Settings of the baseline detector, which needs no network.

    It thresholds the filtered difference map and takes connected components as blocks.
    """

    median_px: Literal[1, 3, 5] = Field(3, description="side of the median filter before the threshold; 1: none")
    levels: float = Field(
        1.0, gt=0, description="threshold, as a multiple of the level of detection (1.96 NMAD of the filtered map)"
    )
    opening_px: int = Field(3, ge=1, description="diameter of the opening's disc, which removes specks; 1: none")
    closing_px: int = Field(3, ge=1, description="diameter of the closing's disc, which fills gaps; 1: none")
    minimum_area_px: int = Field(12, ge=1, description="smaller components are left out")


def detect(difference: NDArray[np.float32], config: BaselineConfig | None = None) -> list[Detection]:
    """Detect missing rock in a difference map without a network, by a threshold; the best detections come first.

    difference: (h, w), m, NaN without data. config: settings; None: the defaults. Each connected region above the threshold is
    a detection. Its score is 1 - 2^-r^2, where r is its mean difference over the threshold: 0.5 for r = 1, 0.94 for r = 2.
    """
    config = config or BaselineConfig()
    valid = np.isfinite(difference)
    filled = np.where(valid, difference, np.float32(0))
    smooth = cv2.medianBlur(filled, config.median_px) if config.median_px > 1 else filled
    threshold = config.levels * LEVEL_OF_DETECTION * nmad(np.where(valid, smooth, np.float32(np.nan)))
    above = ((smooth > max(threshold, 1e-6)) & valid).astype(np.uint8)
    above = cv2.morphologyEx(above, cv2.MORPH_OPEN, _disc(config.opening_px))
    above = cv2.morphologyEx(above, cv2.MORPH_CLOSE, _disc(config.closing_px))
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(above, connectivity=8)
    pixels = np.maximum(np.bincount(labels.ravel(), minlength=count), 1)
    mean = np.bincount(labels.ravel(), weights=smooth.ravel(), minlength=count) / pixels
    found = []
    for number in range(1, count):
        column, row, width, height, area = (int(value) for value in boxes[number])
        if area >= config.minimum_area_px:
            mask = labels[row : row + height, column : column + width] == number
            found.append(Detection(row, column, mask, _score(float(mean[number]) / max(threshold, 1e-6))))
    return sorted(found, key=lambda item: (-item.score, item.row, item.column))


def _score(ratio: float) -> float:
    """Return the score for a ratio of mean difference to threshold."""
    return 1.0 - 2.0 ** -(ratio**2)


def _disc(size: int) -> NDArray[np.uint8]:
    """Return a disc as a structuring element."""
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
