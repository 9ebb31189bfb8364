"""Matching noise that grows where the rock has little texture."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from scene.common.backend import mi
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage, parameter
from sensors.signal_chain.matches import Matches

WINDOW = 5
"""Side of the window over which gradients are summed, cells."""

WHITE = 255.0
"""Grey value of albedo 1."""

LARGEST_SIGMA_PX = 1.0
"""Upper limit of sigma_d: without texture, the matcher's smoothness constrains the disparity."""


class TextureNoise(Effect):
    """Matching noise grows where the rock has little texture, by the Cramer-Rao bound of matching a window.

    sigma_d^2 = k sigma_I^2 / sum gx^2, at most 1 px^2, is the variance of the disparity. The sum of the squared horizontal
    gradients gx runs over the 5 x 5 cells of the depth map about each cell. The noise sigma_I of the image is 1 grey value of
    255. For the simulated matcher the image is 255 x albedo (no shading, no texture finer than the wall's triangles). k = 2 is
    the bound for two equally noisy images. Real rock has finer texture, so its k is smaller.
    """

    name: Literal["texture_noise"] = "texture_noise"
    means = "Disparities scatter more where the rock has little texture."
    act = "Simulate and plan with the value found; side light, sharper focus and finer pixels bring texture out."
    told_by = "rock with another texture"
    sensor = "stereo"
    stage = Stage.MATCH
    shows_in = ShowsIn.SPREAD
    looks_at = "neighbours"
    needs = ("image",)
    order = 50
    coefficient: float = parameter("k", unit="1", source="Cramer-Rao bound", typical=2.0, ge=0, le=1e6)

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        """Return the matches with normal noise, px, added to each disparity, larger where the albedo has little texture.

        Raises InputError if the wall has no albedo.

        state: the matched cells of the depth map before this effect. random: source of random numbers.
        """
        albedo = state.albedo_raster()
        if albedo is None:
            raise InputError(
                "the wall has no albedo (share of light that it reflects), so its pictures have no texture",
                where=f"effect {self.name}",
                remedy="give the wall an albedo, or leave this effect out",
            )
        information = texture(WHITE * albedo, state.reduction)
        with np.errstate(divide="ignore"):
            sigma = np.minimum(np.sqrt(self.coefficient / information), LARGEST_SIGMA_PX)
        noise = mi.Float64(random.normals(state.index).x)
        return replace(state, disparity=state.disparity + state.sampled(sigma) * noise)


def texture(image: FloatArray, reduction: int) -> FloatArray:
    """Measure the texture of an image, on which the matching noise depends.

    Returns for each cell (rows, columns) the sum of the squared horizontal gradients in a window about it, in (grey values per
    px of the frame)^2. image: grey values of the cells, NaN where unknown; gradients that need an unknown value count as 0.
    reduction: px of the full-resolution frame per cell.
    """
    from scipy.ndimage import correlate1d

    gradient = np.zeros_like(image)
    gradient[:, 1:-1] = (image[:, 2:] - image[:, :-2]) / (2 * reduction)
    squared = np.square(np.nan_to_num(gradient))
    ones = np.ones(WINDOW)
    return correlate1d(correlate1d(squared, ones, axis=0, mode="constant"), ones, axis=1, mode="constant")
