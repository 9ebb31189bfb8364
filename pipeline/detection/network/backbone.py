"""The part that sees: a ResNet and its feature pyramid.

Group normalisation (Wu & He 2018) in place of batch normalisation, which fails on the one or two images that fit a step.
"""

from __future__ import annotations

from typing import Any

import keras
from keras import layers

_GROUPS = 8
_STAGES = {"fine": (1, 1, 2, 2), "light": (1, 1, 2, 2), "resnet50": (3, 4, 6, 3), "resnet101": (3, 4, 23, 3)}
_BOTTLENECK_WIDTHS = (64, 128, 256, 512)
_PLAIN_WIDTHS = {"fine": (16, 32, 64, 128), "light": (32, 64, 128, 192)}


def feature_pyramid(name: str, image_px: int, channels_in: int, channels: int) -> keras.Model:
    """A model from images (b, h, w, channels_in) to the levels P2 to P6, (b, h / stride, w / stride, channels) each.

    name: resnet50 and resnet101 of He et al. (2016), bottleneck blocks; `light` has six plain blocks of two convolutions and a
    quarter of the width; `fine` is narrower still and has no pooling at its start, so that all its levels are twice as fine, as
    blocks of five pixels need.
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
    """The outputs of the four stages, at 1/4, 1/8, 1/16 and 1/32 of the image, or 1/2 to 1/16 for `fine`."""
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
    y = _convolution(x, width, 3, stride, f"{name}_a")
    y = _convolution(y, width, 3, 1, f"{name}_b", activation=None)
    return _joined(x, y, stride, name)


def _bottleneck(x: Any, width: int, stride: int, name: str) -> Any:
    y = _convolution(x, width, 1, 1, f"{name}_a")
    y = _convolution(y, width, 3, stride, f"{name}_b")
    y = _convolution(y, 4 * width, 1, 1, f"{name}_c", activation=None)
    return _joined(x, y, stride, name)


def _joined(x: Any, y: Any, stride: int, name: str) -> Any:
    if x.shape[-1] != y.shape[-1] or stride > 1:
        x = _convolution(x, y.shape[-1], 1, stride, f"{name}_shortcut", activation=None)
    return layers.ReLU()(layers.Add()([x, y]))


def _convolution(x: Any, width: int, size: int, stride: int, name: str, activation: str | None = "relu") -> Any:
    """Convolution without bias, group normalisation, activation."""
    x = layers.Conv2D(width, size, strides=stride, padding="same", use_bias=False, kernel_initializer="he_normal", name=name)(x)
    x = layers.GroupNormalization(_GROUPS, name=f"{name}_norm")(x)
    return x if activation is None else layers.Activation(activation)(x)
