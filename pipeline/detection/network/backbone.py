"""The backbone: a ResNet and its feature pyramid.

It uses group normalisation (Wu & He 2018) because batch normalisation fails with the one or two images that fit into a step.
"""

from __future__ import annotations

from typing import Any

import keras
from keras import layers

_GROUPS = 8
"""Groups of the normalisation."""
_STAGES = {"fine": (1, 1, 2, 2), "light": (1, 1, 2, 2), "resnet50": (3, 4, 6, 3), "resnet101": (3, 4, 23, 3)}
"""Residual blocks in each stage."""
_BOTTLENECK_WIDTHS = (64, 128, 256, 512)
_PLAIN_WIDTHS = {"fine": (16, 32, 64, 128), "light": (32, 64, 128, 192)}


def feature_pyramid(name: str, image_px: int, channels_in: int, channels: int) -> keras.Model:
    """Build the part of the network that computes features of an image at several resolutions, the pyramid levels P2 to P6.

    Parameters
    ----------
    name : "resnet50" or "resnet101" of He et al. (2016), with bottleneck blocks; "light" with six plain blocks of two
    convolutions and
        a quarter of the width; "fine", narrower still and without pooling at its start, so that all its levels have half the
        stride, as blocks of five pixels need.
    image_px : Side of the images, px.
    channels_in : Channels of the images.
    channels : Channels of the levels.

    Returns
    -------
    Model from (b, h, w, channels_in) to five tensors (b, h / stride, w / stride, channels).
    """
    image = keras.Input((image_px, image_px, channels_in), name="image")
    stages = _resnet(image, name)
    top = None
    levels: list[Any] = []
    for number, stage in reversed(list(enumerate(stages, start=2))):
        side = layers.Conv2D(channels, 1, name=f"lateral_{number}")(stage)
        top = side if top is None else layers.Add()([side, layers.UpSampling2D(2)(top)])
        levels.insert(0, layers.Conv2D(channels, 3, padding="same", name=f"pyramid_{number}")(top))
    levels.append(layers.MaxPooling2D(1, strides=2, name="pyramid_6")(levels[-1]))
    return keras.Model(image, levels, name=f"{name}_pyramid")


def _resnet(image: Any, name: str) -> list[Any]:
    """Return the outputs of the four stages, at 1/4, 1/8, 1/16 and 1/32 of the image, or 1/2 to 1/16 for `fine`."""
    plain = name in _PLAIN_WIDTHS
    widths = _PLAIN_WIDTHS.get(name, _BOTTLENECK_WIDTHS)
    block = _plain if plain else _bottleneck
    x = _convolution(image, widths[0], 3 if plain else 7, 2, "stem")
    if name != "fine":
        x = layers.MaxPooling2D(3, strides=2, padding="same")(x)
    stages = []
    for stage, (count, width) in enumerate(zip(_STAGES[name], widths, strict=True), start=2):
        for number in range(count):
            x = block(x, width, 2 if stage > 2 and number == 0 else 1, f"stage_{stage}_{number}")
        stages.append(x)
    return stages


def _plain(x: Any, width: int, stride: int, name: str) -> Any:
    """Add a residual block of two 3 x 3 convolutions."""
    y = _convolution(x, width, 3, stride, f"{name}_a")
    y = _convolution(y, width, 3, 1, f"{name}_b", activation=None)
    return _joined(x, y, stride, name)


def _bottleneck(x: Any, width: int, stride: int, name: str) -> Any:
    """Add a residual block of 1 x 1, 3 x 3 and 1 x 1 convolutions."""
    y = _convolution(x, width, 1, 1, f"{name}_a")
    y = _convolution(y, width, 3, stride, f"{name}_b")
    y = _convolution(y, 4 * width, 1, 1, f"{name}_c", activation=None)
    return _joined(x, y, stride, name)


def _joined(x: Any, y: Any, stride: int, name: str) -> Any:
    """Add the shortcut, with a 1 x 1 convolution where shapes differ."""
    if x.shape[-1] != y.shape[-1] or stride > 1:
        x = _convolution(x, y.shape[-1], 1, stride, f"{name}_shortcut", activation=None)
    return layers.ReLU()(layers.Add()([x, y]))


def _convolution(x: Any, width: int, size: int, stride: int, name: str, activation: str | None = "relu") -> Any:
    """Add a convolution without bias, group normalisation and activation."""
    x = layers.Conv2D(width, size, strides=stride, padding="same", use_bias=False, kernel_initializer="he_normal", name=name)(x)
    x = layers.GroupNormalization(_GROUPS, name=f"{name}_norm")(x)
    return x if activation is None else layers.Activation(activation)(x)
