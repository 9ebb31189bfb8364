"""Predict what a scanner station achieves at places on the wall: range, incidence, spacing, footprint, precision, power."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.precision.detectability import Sampling, lattice
from pipeline.precision.surface import BoolArray, Places, rotate_vectors, surface_shift
from scene.geometry.mesh import FloatArray
from sensors.effects.angle_noise import AngleNoise
from sensors.effects.base import Effect, Stage
from sensors.effects.beam_divergence import BeamDivergence
from sensors.laser.tls import LaserScanner
from sensors.signal_chain.polar import polar, polar_axes
from sensors.signal_chain.pulses import REFERENCE_RANGE_M, PulseGeometry

_OFTEN = 0.5
"""Probability of an echo above which a place counts as reached."""


@dataclass(frozen=True)
class TlsGeometry:
    """Store resolution and precision of a laser scanner at n places of a wall, as if nothing obstructed the view.

    All attributes are (n,) arrays unless noted.

    Attributes
    ----------
    range_m, incidence_rad
        Range, m, and angle of incidence, rad.
    spacing_line_m, spacing_pulse_m
        Point spacing on the surface, from scan line to scan line (azimuth) and from pulse to pulse (zenith), m.
    footprint_m, footprint_long_m
        Diameter of the beam across its direction, and longest extent of its footprint on the surface, m; 0 if the sensor model
        gives no divergence.
    range_sigma_m, azimuth_sigma_m, zenith_sigma_m
        Standard deviations of a point along the beam, and across it in the directions of increasing azimuth and zenith angle,
        m.
    covariance : (n, 3, 3)
        Covariance of a point, wall frame, m2.
    normal_sigma_m
        Standard deviation of a point along the surface's normal, m.
    power
        Received power, relative to that of albedo 1 at 100 m and normal incidence in clear air.
    reached
        Whether the place is within the scan window and the range limits, and its echo is strong enough to be recorded.
    sampling : Sampling
        How densely and precisely the scanner samples the surface: what `detection_probability` of a fallen block needs.
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
    """Compute resolution and precision of a laser scanner at n places of a wall, by error propagation instead of simulation.

    It predicts what a planned scan can measure. The covariance of a point is

        s_R^2 u u' + (R sin z s_az)^2 e_az e_az' + (R s_ze)^2 e_ze e_ze'

    u is the beam's direction, R the range and z the zenith angle. e_az and e_ze are the unit vectors
    towards increasing azimuth and zenith angle. s_R, s_az and s_ze are the standard deviations of range and angles, which are
    independent; ' means transposed. If two faces are averaged, the covariance is halved.

    Parameters
    ----------
    scanner : LaserScanner
        The scanner in front of the wall, with its sensor model.
    places : Places
        Positions, normals and albedo of the places, wall frame.
    """
    effects = scanner.model.chain()
    local = rotate_vectors(scanner.rotation.T, places.points - scanner.position)
    range_m, azimuth, zenith = polar(local)
    sight, rising_azimuth, rising_zenith = (rotate_vectors(scanner.rotation, axis) for axis in polar_axes(azimuth, zenith))
    cosine = -np.einsum("ni,ni->n", sight, places.normals)
    power = _power(scanner, places.albedo, cosine, range_m)
    echo = PulseGeometry(azimuth, zenith, range_m=range_m, cos_incidence=cosine, power=power)
    axes = np.stack([sight, rising_azimuth, rising_zenith], axis=1)
    single = np.stack([_range_sigma(effects, echo), *_across_sigma(effects, range_m, zenith)], axis=1)
    sigma = single / np.sqrt(scanner.config.faces)  # two faces have independent noise
    covariance = np.einsum("nk,nki,nkj->nij", sigma**2, axes, axes)
    normal_sigma = np.sqrt(np.einsum("ni,nij,nj->n", places.normals, covariance, places.normals))
    ray, step = sight * range_m[:, None], scanner.pattern
    line = surface_shift(ray, rising_azimuth * (range_m * np.sin(zenith) * step.azimuth_step)[:, None], places.normals)
    pulse = surface_shift(ray, rising_zenith * (range_m * step.zenith_step)[:, None], places.normals)
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
        power=power,
        reached=_reached(scanner, effects, echo),
        sampling=Sampling(
            **steps,
            white=normal_sigma,
            blur_a=steps["step_a"] * single[:, 1] / (range_m * np.sin(zenith) * step.azimuth_step),
            blur_b=steps["step_b"] * single[:, 2] / (range_m * step.zenith_step),
        ),
    )


def _power(scanner: LaserScanner, albedo: FloatArray, cosine: FloatArray, range_m: FloatArray) -> FloatArray:
    """Evaluate the lidar range equation, rho cos i / R^2 exp(-2 sigma R).

    The power is relative to albedo 1 at 100 m, normal incidence and clear air.
    """
    power = albedo * np.maximum(cosine, 0.0) * np.square(REFERENCE_RANGE_M / range_m)
    return power * np.exp(-2 * scanner.config.extinction_per_m * range_m)


def _range_sigma(effects: tuple[Effect, ...], echo: PulseGeometry) -> FloatArray:
    """Return the standard deviation (n,) of the range, m, from all sources in quadrature; infinite where nothing returns."""
    sources = (effect.variance(echo) for effect in effects if effect.stage == Stage.RANGE and not effect.is_null)
    with np.errstate(divide="ignore"):
        variance = sum(sources, np.zeros_like(echo.range_m))
    return np.where(echo.cos_incidence > 0, np.sqrt(variance), np.inf)


def _across_sigma(effects: tuple[Effect, ...], range_m: FloatArray, zenith: FloatArray) -> list[FloatArray]:
    """Return the standard deviations (n,) of a point's position across the beam, m, towards increasing azimuth and zenith."""
    noise = [effect for effect in effects if isinstance(effect, AngleNoise)]
    azimuth, polar = np.linalg.norm([(0.0, 0.0), *((each.azimuth_sigma_rad, each.zenith_sigma_rad) for each in noise)], axis=0)
    return [range_m * np.sin(zenith) * azimuth, range_m * polar]


def _divergence(effects: tuple[Effect, ...]) -> float:
    """Return the beam's full divergence (1/e^2), rad; 0 if no effect gives it."""
    return max((effect.divergence_rad for effect in effects if isinstance(effect, BeamDivergence)), default=0.0)


def _reached(scanner: LaserScanner, effects: tuple[Effect, ...], echo: PulseGeometry) -> BoolArray:
    """Return whether each place (n,) lies in the scanned window and the instrument probably records its echo."""
    pattern, config = scanner.pattern, scanner.config
    turned = np.mod(echo.azimuth - pattern.azimuth_start + pattern.azimuth_step / 2, 2 * np.pi)
    lowered = echo.zenith - pattern.zenith_start + pattern.zenith_step / 2
    in_window = (
        (turned < pattern.lines * pattern.azimuth_step) & (lowered >= 0) & (lowered < pattern.pulses * pattern.zenith_step)
    )
    in_reach = (echo.range_m >= config.minimum_range_m) & (echo.range_m <= config.maximum_range_m)
    kept = np.prod([effect.kept(echo) for effect in effects], axis=0)
    return in_window & in_reach & (echo.power >= 0) & (kept > _OFTEN)
