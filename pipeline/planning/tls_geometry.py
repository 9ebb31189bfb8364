"""What a laser scanner's station promises at places on the wall: range, incidence, spacing, footprint, precision, power."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.planning.detectability import Sampling, lattice
from pipeline.planning.surface import BoolArray, Places, slide, turned
from scene.mesh import FloatArray
from sensors.effects.base import Effect
from sensors.pulses import REFERENCE_RANGE_M
from sensors.tls import LaserScanner

Parameters = Mapping[str, Any]
RangeSigma = Callable[[Parameters, "Echoes"], FloatArray]


@dataclass(frozen=True)
class Echoes:
    """What returns from n places, (n,) each. range_m; cos_incidence; power: relative to albedo 1, hit squarely, at 100 m."""

    range_m: FloatArray
    cos_incidence: FloatArray
    power: FloatArray


RANGE_NOISE: dict[str, RangeSigma] = {
    "range_noise": lambda noise, echo: np.full_like(echo.range_m, noise["sigma_m"]),
    "range_noise_proportional": lambda noise, echo: noise["ppm"] * 1e-6 * echo.range_m,
    "range_noise_incidence": lambda noise, echo: noise["sigma_m"] * (1 / echo.cos_incidence - 1),
    "range_noise_intensity": lambda noise, echo: noise["a_m"] * echo.power ** noise["exponent"],
}
"""Standard deviation of the range, m, by each effect of the catalogue that is white noise on it."""

COUNTED = {*RANGE_NOISE, "angle_noise", "beam_divergence", "detection_limit"}
"""The effects that a plan takes into account."""


@dataclass(frozen=True)
class TlsGeometry:
    """A station's figures at n places; (n,) each, as if nothing stood in between.

    range_m; incidence_rad; spacing_line_m, spacing_pulse_m: on the surface, from scan line to scan line (azimuth) and from pulse
    to pulse (zenith); footprint_m: diameter of the beam across itself, at the range; footprint_long_m: its longest extent on the
    surface; both 0 where no divergence is given. range_sigma_m, azimuth_sigma_m, zenith_sigma_m: semi-axes of the error
    ellipsoid, along the beam and across it; covariance: (n, 3, 3) of a point, wall frame, m2; normal_sigma_m: along the surface's
    normal; power: relative to albedo 1, hit squarely, at 100 m; reached: within window, reach and detection limit.
    """

    range_m: FloatArray
    incidence_rad: FloatArray
    spacing_line_m: FloatArray
    spacing_pulse_m: FloatArray
    footprint_m: FloatArray
    footprint_long_m: FloatArray
    range_sigma_m: FloatArray
    azimuth_sigma_m: FloatArray
    zenith_sigma_m: FloatArray
    covariance: FloatArray
    normal_sigma_m: FloatArray
    power: FloatArray
    reached: BoolArray
    sampling: Sampling


def tls_geometry(scanner: LaserScanner, places: Places) -> TlsGeometry:
    """The figures of `scanner` at `places` (wall frame).

    With u the beam's direction, e_az and e_ze the unit vectors towards rising azimuth and zenith, and white noise of range (R)
    and angles, the covariance is  s_R^2 u u' + (R sin z s_az)^2 e_az e_az' + (R s_ze)^2 e_ze e_ze'. On a plane, a beam that
    leaves in another direction than recorded makes the same error along the normal as a point moved across. The mean of two
    faces has half of these variances; each of its beams misses a niche's floor as often as a single one.
    """
    effects = scanner.model.chain()
    local = turned(scanner.rotation.T, places.points - scanner.position)
    range_m = np.linalg.norm(local, axis=1)
    azimuth, zenith = np.arctan2(local[:, 1], local[:, 0]), np.arccos(local[:, 2] / range_m)
    sight, rising_azimuth, rising_zenith = (turned(scanner.rotation, axis) for axis in _axes(azimuth, zenith))
    cosine = -np.einsum("ni,ni->n", sight, places.normals)
    echo = Echoes(range_m, cosine, _power(scanner, places.albedo, cosine, range_m))
    axes = np.stack([sight, rising_azimuth, rising_zenith], axis=1)
    single = np.stack([_range_sigma(effects, echo), *_across_sigma(effects, range_m, zenith)], axis=1)
    sigma = single / np.sqrt(scanner.config.faces)  # of the mean of two faces with noise of their own
    covariance = np.einsum("nk,nki,nkj->nij", sigma**2, axes, axes)
    normal_sigma = np.sqrt(np.einsum("ni,nij,nj->n", places.normals, covariance, places.normals))
    ray, step = sight * range_m[:, None], scanner.pattern
    line = slide(ray, rising_azimuth * (range_m * np.sin(zenith) * step.azimuth_step)[:, None], places.normals)
    pulse = slide(ray, rising_zenith * (range_m * step.zenith_step)[:, None], places.normals)
    steps = lattice(line, pulse, places.normals, [sight])
    footprint = _divergence(effects) * range_m
    return TlsGeometry(
        range_m=range_m,
        incidence_rad=np.arccos(np.clip(cosine, -1, 1)),
        spacing_line_m=np.linalg.norm(line, axis=1),
        spacing_pulse_m=np.linalg.norm(pulse, axis=1),
        footprint_m=footprint,
        footprint_long_m=footprint / np.abs(cosine),
        range_sigma_m=sigma[:, 0],
        azimuth_sigma_m=sigma[:, 1],
        zenith_sigma_m=sigma[:, 2],
        covariance=covariance,
        normal_sigma_m=normal_sigma,
        power=echo.power,
        reached=_reached(scanner, effects, azimuth, zenith, echo),
        sampling=Sampling(
            **steps,
            white=normal_sigma,
            blur_a=steps["step_a"] * single[:, 1] / (range_m * np.sin(zenith) * step.azimuth_step),
            blur_b=steps["step_b"] * single[:, 2] / (range_m * step.zenith_step),
        ),
    )


def _axes(azimuth: FloatArray, zenith: FloatArray) -> list[FloatArray]:
    """(n, 3) unit vectors along the beam, towards rising azimuth and towards rising zenith, scanner frame."""
    sin_az, cos_az, sin_ze, cos_ze = np.sin(azimuth), np.cos(azimuth), np.sin(zenith), np.cos(zenith)
    beam = [sin_ze * cos_az, sin_ze * sin_az, cos_ze]
    columns = [beam, [-sin_az, cos_az, np.zeros_like(azimuth)], [cos_ze * cos_az, cos_ze * sin_az, -sin_ze]]
    return [np.stack(column, axis=1) for column in columns]


def _power(scanner: LaserScanner, albedo: FloatArray, cosine: FloatArray, range_m: FloatArray) -> FloatArray:
    """The lidar range equation, rho cos i / R^2 exp(-2 sigma R), relative to albedo 1, hit squarely, at 100 m, in clear air."""
    power = albedo * np.maximum(cosine, 0.0) * np.square(REFERENCE_RANGE_M / range_m)
    return power * np.exp(-2 * scanner.config.extinction_per_m * range_m)


def _range_sigma(effects: tuple[Effect, ...], echo: Echoes) -> FloatArray:
    """(n,) standard deviation of the range, m: the sources in quadrature; infinite where nothing returns."""
    variance = np.zeros_like(echo.range_m)
    for effect in effects:
        if effect.name in RANGE_NOISE and not effect.is_null:
            with np.errstate(divide="ignore"):
                variance += np.square(RANGE_NOISE[effect.name](effect.model_dump(), echo))
    return np.where(echo.cos_incidence > 0, np.sqrt(variance), np.inf)


def _across_sigma(effects: tuple[Effect, ...], range_m: FloatArray, zenith: FloatArray) -> list[FloatArray]:
    """(n,) standard deviations of a point's place across the beam, m, along rising azimuth and rising zenith."""
    noise = [effect.model_dump() for effect in effects if effect.name == "angle_noise"]
    azimuth, polar = (np.sqrt(sum(each[f"{name}_sigma_rad"] ** 2 for each in noise)) for name in ("azimuth", "zenith"))
    return [range_m * np.sin(zenith) * azimuth, range_m * polar]


def _divergence(effects: tuple[Effect, ...]) -> float:
    """The beam's divergence, full angle, 1/e^2, rad; 0 where no effect gives it."""
    return max((effect.model_dump()["divergence_rad"] for effect in effects if effect.name == "beam_divergence"), default=0.0)


def _reached(
    scanner: LaserScanner, effects: tuple[Effect, ...], azimuth: FloatArray, zenith: FloatArray, echo: Echoes
) -> BoolArray:
    """(n,) whether a place lies in the scanned window and its echo is one that the instrument records."""
    pattern, config = scanner.pattern, scanner.config
    turned = np.mod(azimuth - pattern.azimuth_start + pattern.azimuth_step / 2, 2 * np.pi)
    lowered = zenith - pattern.zenith_start + pattern.zenith_step / 2
    in_window = (
        (turned < pattern.lines * pattern.azimuth_step) & (lowered >= 0) & (lowered < pattern.pulses * pattern.zenith_step)
    )
    in_reach = (echo.range_m >= config.minimum_range_m) & (echo.range_m <= config.maximum_range_m)
    limits = [effect.model_dump()["minimum_power"] for effect in effects if effect.name == "detection_limit"]
    return in_window & in_reach & (echo.power >= max(limits, default=0.0))
