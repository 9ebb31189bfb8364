"""Every explanation of the mean that a measurement allows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.decisions import decided
from pipeline.gap.mean.candidates import (
    MOST_CYCLES,
    MOST_CYCLES_OF_A_SENSOR,
    Candidate,
    SineGrid,
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
from scene.geometry.mesh import FloatArray
from sensors.effects import EFFECTS, effect_of
from sensors.effects.angle_empirical import AngleEmpirical

PERIODIC = {effect.tag(): effect.searched.along for effect in EFFECTS if effect.searched and effect.searched.along != "line"}
"""Sines, and along what: an error that repeats but is no sine is not theirs."""
_IMAGE = ("image_x", "image_y")
_NOT_FREE = ("edge_step", "line", "disparity_fraction")
_MOST_POINTS = 5_000
"""By which one sees whether one form holds another."""


def believes(measurement: Measurement, name: str) -> bool:
    """Whether the model holds an effect already."""
    return any(effect.name == name for effect in measurement.model.effects)


def effects_of(measurement: Measurement, part: Residuals) -> list[Candidate | SineGrid]:
    """Every effect of the catalogue that the fields of `part` allow, with what is typical of it."""
    return [_with_precision(each) for each in systematic_families(part, measurement)]


def families_of(measurement: Measurement, part: Residuals) -> list[Candidate | SineGrid]:
    """Every explanation of the mean that the fields of `part` allow, the catalogue's and free forms."""
    named = effects_of(measurement, part)
    lowest = {PERIODIC[each.name]: each.frequencies[0] for each in named if isinstance(each, SineGrid) and each.name in PERIODIC}
    free = [
        form
        for name, values in part.covariates.items()
        if name not in _NOT_FREE and np.ptp(values) > 0
        for form in nonparametric_terms(name, values, lowest.get(name, np.inf), _most_cycles(name, values))
    ]
    if isinstance(part, TlsResiduals):
        angles = _of_angles(part)
        named, free = _not_held(named, angles, measurement, part), [*free, *angles]
    first, second = part.position_covariates
    both = polynomial_term(first, second, part.covariates[first], part.covariates[second])
    return [*named, *free, *_twice_a_pixel(part), both, *_repeated(part), *spatial_null_candidates(part.wall_xy)]


def _most_cycles(name: str, values: FloatArray) -> float:
    """Of a wave along a covariate; along an image's axes as many as a sensor may have and its raster can show."""
    if name not in _IMAGE:
        return MOST_CYCLES
    step = raster_spacing_px(values)
    return MOST_CYCLES_OF_A_SENSOR if step is None else min(MOST_CYCLES_OF_A_SENSOR, robust_extent(values) / (2 * step))


def _of_angles(part: TlsResiduals) -> list[Candidate | SineGrid]:
    """Free forms of the errors of both angles: an error of an angle changes the range by the slope of the surface."""
    angles = {"azimuth": part.geometry.azimuth, "zenith": part.geometry.zenith}
    levers = {"azimuth": -part.geometry.by_azimuth, "zenith": -part.geometry.by_zenith}
    along = [(angle, name, values) for angle in levers for name, values in angles.items() if np.ptp(values) > 0]
    return [form for angle, name, values in along for form in angle_error_terms(angle, name, values, levers[angle])]


def _not_held(
    named: list[Candidate | SineGrid], angles: list[Candidate | SineGrid], measurement: Measurement, part: TlsResiduals
) -> list[Candidate | SineGrid]:
    """Without the effects that a curve of an angle's error, where the model has one, holds too, but for its values."""
    curves = {(each.angle, each.covariate) for each in measurement.model.effects if isinstance(each, AngleEmpirical)}
    held = [each.columns for each in angles if isinstance(each, Candidate) and (each.angle, each.name) in curves]
    if not held:
        return named
    rows = slice(None, None, max(len(part) // _MOST_POINTS, 1))
    basis = np.linalg.qr(np.concatenate([part.pose_jacobian[rows], *(columns[rows] for columns in held)], axis=1))[0]

    def left(columns: FloatArray) -> float:
        return float(np.sum((columns - basis @ (basis.T @ columns)) ** 2) / np.sum(columns**2))

    least = decided().mean.undone_share
    return [each for each in named if isinstance(each, SineGrid) or left(each.columns[rows]) > least]


def _repeated(part: Residuals) -> list[Candidate]:
    """Forms that repeat after a few scan lines, or columns or rows of a raster of pixels."""
    found = part.covariates
    if "line" in found and np.ptp(found["line"]) > 0:
        turn = float(np.polyfit(found["line"], found["azimuth"], 1)[0])
        return line_pattern_terms("azimuth", found["line"], turn)
    steps = {name: step for name in _IMAGE if name in found and (step := raster_spacing_px(found[name])) is not None}
    return [
        form for name, step in steps.items() for form in line_pattern_terms(name, (found[name] - found[name].min()) / step, step)
    ]


def _twice_a_pixel(part: Residuals) -> list[SineGrid]:
    """Where disparities span as many pixels as locking to these has to."""
    disparity = part.covariates.get("disparity")
    if disparity is None or robust_extent(disparity) < decided().locking.fewest_cycles:
        return []
    return half_pixel_sine("disparity", disparity)


def _with_precision(candidate: Candidate | SineGrid) -> Candidate | SineGrid:
    """With what is typical of its effect: two effects that nearly cancel each other must not do so at any size."""
    if isinstance(candidate, SineGrid):
        return candidate
    typical = effect_of(candidate.name).typical_sizes()
    units = np.eye(len(candidate.names))
    first = next(iter(typical.values()))
    sizes = [
        typical.get(key, first) / max(abs(candidate.parameters(unit)[key]), 1e-300) if not key.startswith("phase") else first
        for key, unit in zip(candidate.names, units, strict=True)
    ]
    return replace(candidate, prior_precision=1 / (decided().mean.typical_sizes * np.array(sizes)) ** 2)
