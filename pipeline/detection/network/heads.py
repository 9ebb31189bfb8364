"""The three heads of the network: proposals, class and box, mask."""

from __future__ import annotations

from typing import Any

import keras
from keras import initializers, layers

POOLED_PX, MASK_POOLED_PX = 7, 14
"""Side of a box's features for its class and coordinates, and for its mask, cells."""
CLASSES = 2
"""Number of classes: background and block."""
_RARE = initializers.Constant(-4.0)
"""Initial logit of an anchor. Most anchors are background, so this saves the first training steps (Lin et al. 2017b)."""


def proposal_head(channels: int, ratios: int, size_px: int) -> keras.Model:
    """Build the part of the network that judges the anchors of one feature pyramid level: block or not, and a better box.

    Anchors are boxes of fixed size around each cell of the level.

    Parameters
    ----------
    channels : Channels of the level.
    ratios : Anchors per cell.
    size_px : Side of the hidden convolution, cells.

    Returns
    -------
    Model from (b, h, w, channels) to logits (b, h w ratios, 1) and box codes (b, h w ratios, 4) relative to the anchors.
    """
    level = keras.Input((None, None, channels))
    x = layers.Conv2D(channels, size_px, padding="same", activation="relu", kernel_initializer="he_normal", name="shared")(level)
    logits = layers.Conv2D(ratios, 1, bias_initializer=_RARE, kernel_initializer=_small(), name="logit")(x)
    codes = layers.Conv2D(4 * ratios, 1, kernel_initializer=_small(), name="code")(x)
    return keras.Model(level, [layers.Reshape((-1, 1))(logits), layers.Reshape((-1, 4))(codes)], name="proposal_head")


def box_head(channels: int, hidden: int) -> keras.Model:
    """Build the part of the network that decides whether a proposed box holds a block, and refines the box.

    The model's input is the features of n boxes (n, 7, 7, channels); its outputs are class logits (n, 2), for background and
    block, and box codes (n, 4) relative to the proposed boxes. hidden: units of each of the two dense layers.
    """
    features = keras.Input((POOLED_PX, POOLED_PX, channels))
    x: Any = layers.Flatten()(features)
    for number in range(2):
        x = layers.Dense(hidden, activation="relu", kernel_initializer="he_normal", name=f"hidden_{number}")(x)
    logits = layers.Dense(CLASSES, kernel_initializer=_small(), name="class")(x)
    code = layers.Dense(4, kernel_initializer=_small(), name="code")(x)
    return keras.Model(features, [logits, code], name="box_head")


def mask_head(channels: int, size_px: int) -> keras.Model:
    """Build the part of the network that draws the mask of a block inside its box.

    The model takes the features of n boxes (n, 14, 14, channels) to mask logits (n, size_px, size_px). Each doubling of 14 px
    is a transposed convolution: one for a `size_px` of 28, two for 56, three for 112.
    """
    features = keras.Input((MASK_POOLED_PX, MASK_POOLED_PX, channels))
    x: Any = features
    for number in range(4):
        x = layers.Conv2D(channels, 3, padding="same", kernel_initializer="he_normal", name=f"convolution_{number}")(x)
        x = layers.ReLU()(layers.GroupNormalization(8, name=f"norm_{number}")(x))
    doublings = (size_px // MASK_POOLED_PX).bit_length() - 1
    for number in range(doublings):
        x = layers.Conv2DTranspose(
            channels, 2, strides=2, activation="relu", kernel_initializer="he_normal", name=f"doubling_{number}"
        )(x)
    x = layers.Conv2D(1, 1, name="logit")(x)
    return keras.Model(features, layers.Reshape((size_px, size_px))(x), name="mask_head")


def _small() -> initializers.Initializer:
    """Return the initializer of output layers."""
    return initializers.RandomNormal(stddev=0.01)
