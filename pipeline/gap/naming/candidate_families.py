"""List the candidate explanations of the mean (families) that a measurement allows.

They are the effects of the catalogue, non-parametric terms and spatial null candidates.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.mean.candidates import Candidate, SineGrid
from pipeline.gap.mean.nonparametric_terms import (
    MOST_CYCLES,
    MOST_CYCLES_OF_A_SENSOR,
    angle_error_terms,
    half_pixel_sine,
    line_pattern_terms,
    nonparametric_terms,
    polynomial_term,
    robust_extent,
    spatial_null_candidates,
)
from pipeline.gap.mean.signatures import systematic_families
from pipeline.gap.residuals.disparity_raster import raster_spacing_px
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from pipeline.gap.thresholds import thresholds
from scene.geometry.mesh import FloatArray
from sensors.effects import EFFECTS, effect_of

PERIODIC = {effect.tag(): effect.searched.along for effect in EFFECTS if effect.searched and effect.searched.along != "line"}
"""Sinusoidal effects and the covariate along which they repeat. A periodic error that is no sine belongs to none of them."""
_IMAGE = ("image_x", "image_y")
_NO_NONPARAMETRIC_TERM = ("edge_step", "line", "disparity_fraction")


def model_has(measurement: Measurement, name: str) -> bool:
    """Tell whether a measurement's sensor model already contains an effect, so that it is not searched again.

    name: the effect's name in a config, without the sensor's prefix, such as "range_offset".
    """
    return any(effect.name == name for effect in measurement.model.effects)


def catalogue_families(measurement: Measurement, part: Residuals) -> list[Candidate | SineGrid]:
    """List the systematic sensor errors of the catalogue to try as explanations of residuals, as regression terms.

    Each has n design columns (change of the observable per unit of a parameter), or is a sine with a grid of trial frequencies.
    Left out are errors that need data which were not recorded (intensity, time). Each error gets a Gaussian prior of its size
    with mean 0, so that two similar errors cannot grow large and cancel.

    measurement: the measured points with the sensor model that is tested. part: residuals of n of its points.
    """
    return [_with_prior(each) for each in systematic_families(part, measurement)]


def candidate_families(
    measurement: Measurement, part: Residuals, catalogue: list[Candidate | SineGrid] | None = None
) -> list[Candidate | SineGrid]:
    """List all regression terms that a forward selection tries as explanations of the systematic part of residuals.

    They are of three kinds: sensor errors of the catalogue; terms along each covariate that name no cause (line, spline, steps,
    waves), for errors that the catalogue lacks; and such terms along oblique directions on the wall. No sensor causes the last
    ones, so they show what an error of the reference surface can imitate.

    Parameters
    ----------
    measurement : the measured points with the sensor model that is tested.
    part : residuals of n of its points, measured minus predicted.
    catalogue : the effects of the catalogue at these points (`catalogue_families`), if they are known already.
    """
    named = catalogue_families(measurement, part) if catalogue is None else catalogue
    lowest = {PERIODIC[each.name]: each.frequencies[0] for each in named if isinstance(each, SineGrid) and each.name in PERIODIC}
    free = [
        form
        for name, values in part.covariates.items()
        if name not in _NO_NONPARAMETRIC_TERM and np.ptp(values) > 0
        for form in nonparametric_terms(name, values, lowest.get(name, np.inf), _most_cycles(name, values))
    ]
    if isinstance(part, TlsResiduals):
        free += _angle_terms(part)
    first, second = part.position_covariates
    both = polynomial_term(first, second, part.covariates[first], part.covariates[second])
    return [*named, *free, *_half_pixel_sines(part), both, *_repeating_terms(part), *spatial_null_candidates(part.wall_xy)]


def _most_cycles(name: str, values: FloatArray) -> float:
    """Highest number of cycles of a wave along a covariate; along an image's axes as many as the raster can show."""
    if name not in _IMAGE:
        return MOST_CYCLES
    step = raster_spacing_px(values)
    return MOST_CYCLES_OF_A_SENSOR if step is None else min(MOST_CYCLES_OF_A_SENSOR, robust_extent(values) / (2 * step))


def _angle_terms(part: TlsResiduals) -> list[Candidate | SineGrid]:
    """Non-parametric terms of errors of both angles. An error of an angle changes the range by the slope of the surface."""
    angles = {"azimuth": part.geometry.azimuth, "zenith": part.geometry.zenith}
    levers = {"azimuth": -part.geometry.by_azimuth, "zenith": -part.geometry.by_zenith}
    along = [(angle, name, values) for angle in levers for name, values in angles.items() if np.ptp(values) > 0]
    return [form for angle, name, values in along for form in angle_error_terms(angle, name, values, levers[angle])]


def _repeating_terms(part: Residuals) -> list[Candidate]:
    """Terms that repeat after a few scan lines, or after a few columns or rows of a pixel raster."""
    found = part.covariates
    if "line" in found and np.ptp(found["line"]) > 0:
        turn = float(np.polyfit(found["line"], found["azimuth"], 1)[0])
        return line_pattern_terms("azimuth", found["line"], turn)
    steps = {name: step for name in _IMAGE if name in found and (step := raster_spacing_px(found[name])) is not None}
    return [
        form for name, step in steps.items() for form in line_pattern_terms(name, (found[name] - found[name].min()) / step, step)
    ]


def _half_pixel_sines(part: Residuals) -> list[SineGrid]:
    """Sines of twice the pixel frequency, if the disparities span enough pixels for locking."""
    disparity = part.covariates.get("disparity")
    if disparity is None or robust_extent(disparity) < thresholds().locking.fewest_cycles:
        return []
    return half_pixel_sine("disparity", disparity)


def _with_prior(candidate: Candidate | SineGrid) -> Candidate | SineGrid:
    """Add the prior of an effect's size, so that two effects that nearly cancel cannot both become arbitrarily large."""
    if isinstance(candidate, SineGrid):
        return candidate
    typical = effect_of(candidate.name).typical_sizes()
    units = np.eye(len(candidate.names))
    first = next(iter(typical.values()))
    sizes = [
        typical.get(key, first) / max(abs(candidate.parameters(unit)[key]), 1e-300) if not key.startswith("phase") else first
        for key, unit in zip(candidate.names, units, strict=True)
    ]
    return replace(candidate, prior_precision=1 / (thresholds().mean.prior_size * np.array(sizes)) ** 2)
