"""The noise parameters that a calibration may fit: where each stands in a sensor model, and between which bounds it is sought."""

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
_OF_SIGMA = (0.05, 12.0)
"""Bounds of a single sigma of the orientation, times that of the config."""
_DEFAULT = {
    "stereo": ("parallax_sigma_px", "regularization_sigma_px", "regularization_step_px", ORIENTATION),
    "tls": ("range_sigma_m", "angle_sigma_rad"),
}
_ALLOWED = {
    "stereo": (*_DEFAULT["stereo"], *(f"{ORIENTATION}.{name}" for name in OrientationNoise.model_fields)),
    "tls": (*_DEFAULT["tls"], "range_ppm"),
}


@dataclass(frozen=True)
class Parameters:
    """Parameters of one model, sought as their natural logarithms. names: k; low, high: (k,) bounds, in the parameters' units."""

    base: Model
    names: tuple[str, ...]
    low: FloatArray
    high: FloatArray

    def model(self, values: Sequence[float] | FloatArray) -> Model:
        """The base model with these values; all else, effects included, stays as it is."""
        found = dict(zip(self.names, (float(value) for value in values), strict=True))
        noise = self.base.noise
        plain: dict[str, Any] = {name: value for name, value in found.items() if not name.startswith(ORIENTATION)}
        if isinstance(self.base, StereoModel):
            plain["orientation"] = _orientation(self.base.noise.orientation, found)
        return self.base.model_copy(update={"noise": noise.model_copy(update=plain)})

    def meaning(self, name: str) -> str:
        """What a parameter is, in the words of the config, without its unit."""
        if name == ORIENTATION:
            return "all sigmas of the orientation, as a multiple of the config's"
        section, _, key = name.rpartition(".")
        held = getattr(self.base.noise, section) if section else self.base.noise
        words = (type(held).model_fields[key].description or key).partition(" [")[0]
        return f"standard deviation: {words}" if section else words

    def values(self, logarithms: FloatArray) -> FloatArray:
        """(..., k) values of logarithms, within the bounds."""
        return np.clip(np.exp(logarithms), self.low, self.high)


def _orientation(base: OrientationNoise, found: dict[str, float]) -> OrientationNoise:
    """The config's spreads times the common factor; those that are fitted singly have a sigma of their own."""
    factor = found.get(ORIENTATION, 1.0)
    changed: dict[str, Any] = {}
    for name in type(base).model_fields:
        spread: DrawnParameter = getattr(base, name)
        sigma = found.get(f"{ORIENTATION}.{name}", spread.sigma * factor)
        changed[name] = DrawnParameter(mean=spread.mean, sigma=sigma)
    return base.model_copy(update=changed)


def parameters(base: Model, names: Sequence[str]) -> Parameters:
    """The parameters of these names, or the usual ones of the sensor. Raises InputError for one that the model has not."""
    chosen = tuple(names) or _usual(base)
    for name in chosen:
        if name not in _ALLOWED[base.sensor]:
            hint = nearest(name, _ALLOWED[base.sensor]) or f"allowed: {', '.join(_ALLOWED[base.sensor])}"
            raise InputError(f"'{name}' is no noise parameter of the {base.sensor} sensor", where="calibration.fit", remedy=hint)
    if len(set(chosen)) < len(chosen):
        raise InputError("names a parameter twice", where="calibration.fit")
    bounds = np.array([_bounds(base, name) for name in chosen])
    return Parameters(base, chosen, bounds[:, 0], bounds[:, 1])


def _usual(base: Model) -> tuple[str, ...]:
    names = _DEFAULT[base.sensor]
    return names if not isinstance(base, StereoModel) or _moves(base) else names[:-1]


def _moves(base: StereoModel) -> bool:
    """Whether the model has noise of the orientation, which alone gives the factor a meaning."""
    orientation = base.noise.orientation
    return any(getattr(orientation, name).sigma > 0 for name in OrientationNoise.model_fields)


def _bounds(base: Model, name: str) -> tuple[float, float]:
    if not isinstance(base, StereoModel):
        return _BOUNDS[name]
    if name in _BOUNDS:
        if name == ORIENTATION and not _moves(base):
            raise InputError(
                "the model has no noise of the orientation that a factor could change",
                where="calibration.fit",
                remedy="give its sigmas, such as --set sensor=glendale_high",
            )
        return _BOUNDS[name]
    sigma = getattr(base.noise.orientation, name.removeprefix(f"{ORIENTATION}.")).sigma
    if not sigma > 0:
        raise InputError("its sigma in the model is 0, so there is no scale to seek it at", where=f"calibration.fit: {name}")
    return _OF_SIGMA[0] * sigma, _OF_SIGMA[1] * sigma
