"""The noise parameters that a calibration can fit: where each is in the sensor model, and its bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scene.common.errors import InputError, nearest
from scene.geometry.mesh import FloatArray
from sensors.models.sensor_model import DrawnParameter, OrientationNoise, StereoModel, TlsModel

Model = StereoModel | TlsModel
ORIENTATION = "orientation"
_BOUNDS: dict[str, tuple[float, float]] = {
    "parallax_sigma_px": (0.02, 4.0),
    "regularization_sigma_px": (0.01, 4.0),
    "regularization_step_px": (8.0, 128.0),
    ORIENTATION: (0.05, 12.0),
    "range_sigma_m": (2e-4, 0.1),
    "range_ppm": (1.0, 300.0),
    "angle_sigma_rad": (2e-6, 1e-3),
}
"""Bounds of each parameter, in the unit of its name; those of `orientation` are factors."""
_OF_SIGMA = (0.05, 12.0)
"""Bounds of a single orientation sigma, as multiples of its value in the config."""
_DEFAULT = {
    "stereo": ("parallax_sigma_px", "regularization_sigma_px", "regularization_step_px", ORIENTATION),
    "tls": ("range_sigma_m", "angle_sigma_rad"),
}
"""Parameters that are fitted if the user names none."""
_ALLOWED = {
    "stereo": (*_DEFAULT["stereo"], *(f"{ORIENTATION}.{name}" for name in OrientationNoise.model_fields)),
    "tls": (*_DEFAULT["tls"], "range_ppm"),
}
"""Parameters that the user may name."""


@dataclass(frozen=True)
class NoiseParameters:
    """The noise parameters of a sensor model that a calibration fits, and their bounds.

    Attributes
    ----------
    base : The sensor model before the calibration.
    names : (k,) names of the parameters, such as "range_sigma_m".
    low, high : (k,) bounds, in the unit at the end of each name; "orientation" is a factor of the model's standard deviations.
    """

    base: Model
    names: tuple[str, ...]
    low: FloatArray
    high: FloatArray

    def model(self, values: Sequence[float] | FloatArray) -> Model:
        """Return the sensor model with given values of the fitted noise parameters; its effects stay unchanged.

        values: (k,) in the order of `names`, each in the unit at the end of its name.
        """
        found = dict(zip(self.names, (float(value) for value in values), strict=True))
        noise = self.base.noise
        plain: dict[str, Any] = {name: value for name, value in found.items() if not name.startswith(ORIENTATION)}
        if isinstance(self.base, StereoModel):
            plain["orientation"] = _orientation(self.base.noise.orientation, found)
        return self.base.model_copy(update={"noise": noise.model_copy(update=plain)})

    def meaning(self, name: str) -> str:
        """Describe a noise parameter in words for a report, as the config's documentation does, without its unit.

        name: name of the parameter, such as "range_sigma_m".
        """
        if name == ORIENTATION:
            return "all sigmas of the orientation, as a multiple of the config's"
        section, _, key = name.rpartition(".")
        held = getattr(self.base.noise, section) if section else self.base.noise
        words = (type(held).model_fields[key].description or key).partition(" [")[0]
        return f"standard deviation: {words}" if section else words

    def values(self, logarithms: FloatArray) -> FloatArray:
        """Convert natural logarithms of the noise parameters, on which the search works, to parameter values within the bounds.

        logarithms: (..., k), any number of parameter sets. Returns an array of the same shape.
        """
        return np.clip(np.exp(logarithms), self.low, self.high)


def _orientation(base: OrientationNoise, found: dict[str, float]) -> OrientationNoise:
    """Multiply the config's orientation sigmas by the common factor, and replace those that are fitted singly."""
    factor = found.get(ORIENTATION, 1.0)
    changed: dict[str, Any] = {}
    for name in type(base).model_fields:
        spread: DrawnParameter = getattr(base, name)
        sigma = found.get(f"{ORIENTATION}.{name}", spread.sigma * factor)
        changed[name] = DrawnParameter(mean=spread.mean, sigma=sigma)
    return base.model_copy(update=changed)


def noise_parameters(base: Model, names: Sequence[str]) -> NoiseParameters:
    """Select the noise parameters of a sensor model that a calibration fits, and set the bounds of each.

    Parameters
    ----------
    base : The sensor model before the calibration.
    names : Names from the config key `calibration.fit`; empty: the default parameters of the sensor.

    Raises
    ------
    InputError
        If a name is unknown or repeated, or an orientation parameter's standard deviation (sigma) is 0 in the model, so that
        the bounds, which are multiples of it, would be 0 too.
    """
    chosen = tuple(names) or _default_names(base)
    for name in chosen:
        if name not in _ALLOWED[base.sensor]:
            hint = nearest(name, _ALLOWED[base.sensor]) or f"allowed: {', '.join(_ALLOWED[base.sensor])}"
            raise InputError(
                f"'{name}' is not a noise parameter of the {base.sensor} sensor", where="calibration.fit", remedy=hint
            )
    if twice := sorted({name for name in chosen if chosen.count(name) > 1}):
        raise InputError(
            f"the noise parameter {twice[0]} is listed twice", where="calibration.fit", remedy="list each parameter once"
        )
    bounds = np.array([_bounds(base, name) for name in chosen])
    return NoiseParameters(base, chosen, bounds[:, 0], bounds[:, 1])


def _default_names(base: Model) -> tuple[str, ...]:
    """Return the default parameters of the model's sensor.

    The orientation factor is left out if the model has no orientation noise.
    """
    names = _DEFAULT[base.sensor]
    return names if not isinstance(base, StereoModel) or _has_orientation_noise(base) else names[:-1]


def _has_orientation_noise(base: StereoModel) -> bool:
    """Whether the model has orientation noise; without it the common factor has no effect."""
    orientation = base.noise.orientation
    return any(getattr(orientation, name).sigma > 0 for name in OrientationNoise.model_fields)


def _bounds(base: Model, name: str) -> tuple[float, float]:
    """Return the lower and upper bound of one parameter, or raise InputError if the model gives it no scale."""
    if not isinstance(base, StereoModel):
        return _BOUNDS[name]
    if name in _BOUNDS:
        if name == ORIENTATION and not _has_orientation_noise(base):
            raise InputError(
                "the model has no orientation noise to scale: the standard deviations of all camera angles and positions are 0",
                where="calibration.fit",
                remedy="remove orientation from this list, or use a model with this noise, such as --set sensor=glendale_high",
            )
        return _BOUNDS[name]
    sigma = getattr(base.noise.orientation, name.removeprefix(f"{ORIENTATION}.")).sigma
    if not sigma > 0:
        raise InputError(
            f"the sigma of {name} is 0 in the model, so the bounds for fitting it are unknown",
            where="calibration.fit",
            remedy="give this parameter a sigma above 0 in the sensor model, or remove it from calibration.fit",
        )
    return _OF_SIGMA[0] * sigma, _OF_SIGMA[1] * sigma
