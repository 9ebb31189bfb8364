"""Describe a laser scanner as its data sheet does, each figure with its source and whether it is accuracy or precision.

Precision is the scatter of repeated measurements and becomes noise. Accuracy bounds the deviation from the true value, most of
which is systematic, so it never becomes noise. Figures have the units of data sheets; the properties convert them to SI and
radians.
"""

from __future__ import annotations

from math import log, sqrt
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from scene.common.config import Config
from sensors.effects.beam_divergence import BeamDivergence
from sensors.laser.tls import ScannerConfig
from sensors.models.sensor_model import TlsModel, TlsNoise

_FULL_BEAM = {"1/e2": 1.0, "1/e": sqrt(2.0), "fwhm": sqrt(2.0 / log(2.0))}
"""Full width of a Gaussian beam exp(-2 r^2 / w^2) at 1/e^2 (2 w), relative to those at 1/e (sqrt(2) w) and at half maximum
(sqrt(2 ln 2) w).
"""


class Figure(Config):
    """A figure of a scanner's data sheet that is no error, such as the pulse rate, with its source."""

    value: float = Field(gt=0, description="value, in the unit that the key names")
    source: str = Field(min_length=1, description="where the figure is from")


class Window(Config):
    """The range of directions that a scanner covers, from its data sheet, with the source."""

    value: tuple[Annotated[float, Field(ge=0, le=180)], Annotated[float, Field(ge=0, le=180)]] = Field(
        description="smallest and largest direction, in the unit that the key names"
    )
    source: str = Field(min_length=1, description="where the figure is from")


class Accuracy(Config):
    """Accuracy figure of a data sheet: a bound on the deviation from the true value, mostly systematic.

    It is never used as noise.
    """

    value: float = Field(ge=0, description="value, in the unit that the key names")
    ppm: float = Field(0.0, ge=0, description="further part in proportion to the range")
    kind: Literal["accuracy"]
    source: str = Field(min_length=1, description="where the figure is from")


class Precision(Config):
    """Precision figure of a data sheet: the standard deviation of repeated measurements, which is used as noise."""

    value: float = Field(ge=0, description="value, in the unit that the key names")
    at_m: float | None = Field(None, gt=0, description="range at which the value holds; none: at any range")
    kind: Literal["precision"]
    source: str = Field(min_length=1, description="where the figure is from")


class Divergence(Config):
    """Divergence of a laser beam, from a data sheet, with the convention in which it is stated."""

    value: float = Field(gt=0, description="value, in the unit that the key names")
    level: Literal["1/e2", "1/e", "fwhm"] = Field(description="share of the intensity on the axis at which the width is measured")
    angle: Literal["full", "half"] = Field(description="full or half angle of the cone")
    source: str = Field(min_length=1, description="where the figure is from")

    @property
    def full_angle(self) -> float:
        """Full divergence of the beam at 1/e^2 of the intensity on its axis, whatever the convention of the data sheet.

        The beam is taken for Gaussian. The unit is that of the figure.
        """
        return self.value * _FULL_BEAM[self.level] * (2.0 if self.angle == "half" else 1.0)


class ScannerPreset(Config):
    """A model of laser scanner, described by its data sheet; unknown properties are left out.

    Users choose it by name instead of giving the scanner's properties.
    """

    name: str = Field(min_length=1, description="manufacturer and model")
    ranging: Literal["pulse", "phase"] = Field("pulse", description="how the range is measured")
    wavelength_nm: Figure | None = Field(None, description="wavelength of the laser")
    pulse_width_ns: Figure | None = Field(None, description="duration of a pulse; echoes closer together merge into one")
    zenith_limits_deg: Window | None = Field(None, description="field of view in zenith")
    azimuth_step_deg: Figure | None = Field(None, description="angular step between scan lines to scan with")
    zenith_step_deg: Figure | None = Field(None, description="angular step between the pulses of a line to scan with")
    angle_resolution_deg: Figure | None = Field(None, description="smallest step of the recorded angles")
    pulse_rate_hz: Figure | None = Field(None, description="pulses per second, at the fastest")
    minimum_range_m: Figure | None = Field(None, description="nearest range")
    maximum_range_m: Figure | None = Field(None, description="farthest range")
    range_accuracy_mm: Accuracy | None = Field(None, description="accuracy of the range")
    range_precision_mm: tuple[Precision, ...] = Field(
        (), max_length=2, description="noise of the range; two figures at two ranges give its growth with range"
    )
    angle_accuracy_arcsec: Accuracy | None = Field(None, description="accuracy of azimuth and of zenith")
    angle_precision_arcsec: Precision | None = Field(None, description="noise of azimuth and of zenith")
    divergence_mrad: Divergence | None = Field(None, description="divergence of the beam")

    @model_validator(mode="after")
    def _two_ranges(self) -> ScannerPreset:
        ranges = [figure.at_m for figure in self.range_precision_mm]
        if len(ranges) == 2 and (None in ranges or ranges[0] == ranges[1]):
            raise ValueError("range_precision_mm: two figures need two different at_m")
        return self

    def scanner_values(self) -> dict[str, Any]:
        """Return what the data sheet tells of the instrument, as keys and values of a `ScannerConfig`, in its units."""
        known: dict[str, Any] = {"name": self.name}
        if self.zenith_limits_deg is not None:
            known["zenith_limits_rad"] = tuple(float(np.radians(limit)) for limit in self.zenith_limits_deg.value)
        for key, figure in (("azimuth_step_rad", self.azimuth_step_deg), ("zenith_step_rad", self.zenith_step_deg)):
            known |= {} if figure is None else {key: float(np.radians(figure.value))}
        for key in ("pulse_rate_hz", "minimum_range_m", "maximum_range_m", "wavelength_nm"):
            figure = getattr(self, key)
            known |= {} if figure is None else {key: figure.value}
        return known

    def scanner(self) -> ScannerConfig:
        """Return the instrument's config from the data sheet; what is not known there has its default."""
        return ScannerConfig(**self.scanner_values())

    def model(self) -> TlsModel:
        """Return the scanner's errors from the data sheet: noise from the precision figures only, and the width of the beam.

        What is not known has its default.
        """
        known = self._range_noise()
        if self.angle_precision_arcsec is not None:
            known["angle_sigma_rad"] = float(np.radians(self.angle_precision_arcsec.value / 3600))
        return TlsModel(noise=TlsNoise(**known), effects=self._beam())

    def _beam(self) -> tuple[BeamDivergence, ...]:
        """Return the beam as an effect, if its divergence is known."""
        if self.divergence_mrad is None:
            return ()
        width = {} if self.pulse_width_ns is None else {"pulse_width_s": self.pulse_width_ns.value * 1e-9}
        return (BeamDivergence(divergence_rad=self.divergence_mrad.full_angle * 1e-3, ranging=self.ranging, **width),)

    def _range_noise(self) -> dict[str, float]:
        """Fit sigma^2 = sigma_0^2 + (p R)^2 to the figures of the data sheet.

        A single figure is sigma_0; so is the first of two if the second is smaller.
        """
        if not self.range_precision_mm:
            return {}
        sigma = [figure.value * 1e-3 for figure in self.range_precision_mm]
        if len(sigma) == 1:
            return {"range_sigma_m": sigma[0], "range_ppm": 0.0}
        near, far = (float(figure.at_m or 0.0) for figure in self.range_precision_mm)
        growth = max((sigma[1] ** 2 - sigma[0] ** 2) / (far**2 - near**2), 0.0)
        growth = min(growth, (sigma[0] / near) ** 2)  # keeps sigma_0^2 positive
        return {"range_sigma_m": sqrt(max(sigma[0] ** 2 - growth * near**2, 0.0)), "range_ppm": sqrt(growth) * 1e6}
