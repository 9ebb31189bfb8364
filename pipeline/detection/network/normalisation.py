"""Convert a difference map to the network's input."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.change import robust
from pipeline.detection.network.config import NormalisationConfig

Image = NDArray[np.float32]
LEVEL_OF_DETECTION = 1.96
"""95 % of normal errors are within this many standard deviations."""


def nmad(difference: Image) -> float:
    """Return the robust standard deviation (NMAD) of a difference map (h, w), m, over the pixels with data; 0 without data."""
    values = difference[np.isfinite(difference)]
    return robust.nmad(values) if values.size else 0.0


def normalised(difference: Image, config: NormalisationConfig, noise_m: float | None = None) -> Image:
    """Scale a difference map to the values that the detector's network takes, so that maps of any noise look alike.

    Parameters
    ----------
    difference : (h, w) differences, m; NaN without data. It may be a tile of a larger map.
    config : How to scale them.
    noise_m : Standard deviation of the noise of the whole map, m. It is used by the method `level_of_detection` alone, which
        divides by the level that noise of this size has. None: the NMAD of `difference`.

    Returns
    -------
    (h, w, channels) float32: the scaled differences and, if the config asks for it, 1 where there are data and 0 elsewhere.
    """
    valid = np.isfinite(difference)
    if config.method == "minmax":
        scaled = _minmax(difference, valid)
    else:
        noise = nmad(difference) if noise_m is None else noise_m
        scale = config.scale_m if config.method == "fixed" else max(LEVEL_OF_DETECTION * noise, 1e-6)
        scaled = np.arcsinh(np.where(valid, difference, 0.0) / scale)
    channels = [scaled, valid] if config.validity_channel else [scaled]
    return np.stack(channels, axis=-1).astype(np.float32)


def denormalised(image: Image, lowest_m: float, highest_m: float) -> Image:
    """Convert an image that was scaled to 0...1 (method `minmax`) back to differences, m.

    image: (h, w). lowest_m, highest_m: smallest and largest difference before the scaling, m.
    """
    return np.asarray(lowest_m + image * (highest_m - lowest_m), dtype=np.float32)


def _minmax(difference: Image, valid: NDArray[np.bool_]) -> Image:
    """Scale valid pixels to 0...1 and set the others to the median."""
    if not valid.any():
        return np.zeros_like(difference)
    values = difference[valid]
    low, high = float(values.min()), float(values.max())
    filled = np.where(valid, difference, np.median(values))
    return np.asarray((filled - low) / max(high - low, 1e-9), dtype=np.float32)
