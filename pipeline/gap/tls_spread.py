"""The variance of a laser range that a model predicts, and the forms that effects on the spread add to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from scene.mesh import FloatArray
from sensors.effects.base import Effect
from sensors.model import TlsModel

_STEEPEST = 10.0
"""1 / cos i is taken as no larger than this: a grazing ray meets a neighbouring facet first."""


def slant(geometry: Any) -> FloatArray:
    """(n,) 1 / cos i - 1."""
    return np.minimum(1 / np.maximum(geometry.cos_incidence, 1e-6), _STEEPEST) - 1


def _angle(effect: Any, geometry: Any) -> FloatArray:
    return np.asarray((effect.azimuth_sigma_rad * geometry.by_azimuth) ** 2 + (effect.zenith_sigma_rad * geometry.by_zenith) ** 2)


def _intensity(effect: Any, geometry: Any) -> FloatArray:
    """Without recorded powers every pulse counts as one of power 1."""
    if geometry.power is None:
        return np.full(len(geometry.range_m), effect.a_m**2)
    return np.asarray((effect.a_m * geometry.power**effect.exponent) ** 2)


def _footprint(effect: Any, geometry: Any) -> FloatArray:
    """Standard deviation D / 4 of the direction within the beam; the mean over the beam is far more precise, a tenth is kept."""
    tangent = np.hypot(geometry.by_azimuth, geometry.by_zenith)
    return np.asarray((0.1 * effect.divergence_rad / 4 * tangent) ** 2)


_VARIANCES: dict[str, Callable[[Any, Any], FloatArray]] = {
    "range_noise": lambda effect, geometry: np.full(len(geometry.range_m), effect.sigma_m**2),
    "range_noise_proportional": lambda effect, geometry: (effect.ppm * 1e-6 * geometry.range_m) ** 2,
    "range_noise_incidence": lambda effect, geometry: (effect.sigma_m * slant(geometry)) ** 2,
    "range_noise_intensity": _intensity,
    "angle_noise": _angle,
    "range_quantization": lambda effect, geometry: np.full(len(geometry.range_m), effect.step_m**2 / 12),
    "beam_divergence": _footprint,
}


def effect_variance(effect: Effect, geometry: Any) -> FloatArray:
    """(n,) variance that an effect adds to a range, m^2; 0 for an effect on the mean."""
    form = _VARIANCES.get(effect.name)
    return np.zeros(len(geometry.range_m)) if form is None else form(effect, geometry)


def model_variance(model: TlsModel, geometry: Any) -> FloatArray:
    """(n,) variance of a range that a model predicts, m^2."""
    return np.asarray(sum((effect_variance(effect, geometry) for effect in model.chain()), np.zeros(len(geometry.range_m))))
