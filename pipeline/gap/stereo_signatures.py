"""How each effect of the stereo pair on the mean would show in the disparity residuals."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from pipeline.gap.candidates import Candidate, Grid, Wave, frequencies, variants
from pipeline.gap.measurement import Measurement
from pipeline.gap.nominal_pair import NominalPair, StereoGeometry, real_pair, seen_disparities
from pipeline.gap.residuals import Residuals
from scene.mesh import FloatArray
from sensors.effects import (
    AffinitySkew,
    CameraKappa,
    CameraOmega,
    CameraPhi,
    CameraShift,
    FocalLength,
    PrincipalPointX,
    PrincipalPointY,
    RadialDistortion,
    TangentialDistortion,
)
from sensors.effects.base import Effect

_SIDES = ("left", "right", "both")
_CAMERA: tuple[tuple[type[Effect], tuple[tuple[str, ...], ...], float], ...] = (
    (FocalLength, (("delta_px",),), 0.1),
    (PrincipalPointX, (("delta_px",),), 0.1),
    (PrincipalPointY, (("delta_px",),), 0.1),
    (RadialDistortion, (("k1",), ("k1", "k2"), ("k1", "k2", "k3")), 1e-4),
    (TangentialDistortion, (("p1",), ("p2",), ("p1", "p2")), 1e-5),
    (AffinitySkew, (("b1_px",), ("b2_px",), ("b1_px", "b2_px")), 0.1),
    (CameraOmega, (("angle_rad",),), 1e-5),
    (CameraPhi, (("angle_rad",),), 1e-5),
    (CameraKappa, (("angle_rad",),), 1e-5),
    (CameraShift, (("x_m", "y_m", "z_m"),), 1e-3),
)
"""Effect, the sets of its parameters that are tried, and the step of the finite differences."""
_FEWEST_ROWS = 20.0
_SCALE_UNKNOWN = 0.03


def mean_candidates(residuals: Residuals, measurement: Measurement) -> list[Candidate]:
    """Every effect of the catalogue on the mean disparity, cameras and searched parameters as variants."""
    return variants(mean_families(residuals, measurement))


def mean_families(residuals: Residuals, measurement: Measurement) -> list[Candidate | Grid]:
    """The same with each searched sine as one grid."""
    geometry, nominal = residuals.geometry, NominalPair.of(measurement)
    varied = [
        (effect, side, key, step)
        for effect, sets, step in _CAMERA
        for side in _SIDES
        for key in sorted({key for keys in sets for key in keys})
    ]
    changed = (real_pair(nominal, (effect(**{"camera": side, key: step}),), measurement) for effect, side, key, step in varied)
    base, *seen = seen_disparities(nominal, [nominal.pair, *changed], geometry)
    columns = {(effect, side, key): (each - base) / step for (effect, side, key, step), each in zip(varied, seen, strict=True)}
    found: list[Candidate | Grid] = [
        Candidate(
            effect.model_fields["name"].default,
            np.stack([columns[effect, side, key] for key in keys], axis=1),
            partial(_by_name, keys),
            keys,
            {"camera": side},
        )
        for effect, sets, _ in _CAMERA
        for side in _SIDES
        for keys in sets
    ]
    return [*found, *_row_jitter(geometry), *_locking(geometry)]


def _by_name(names: tuple[str, ...], values: FloatArray) -> dict[str, float]:
    return dict(zip(names, map(float, values), strict=True))


def _row_jitter(geometry: StereoGeometry) -> list[Grid]:
    """dx in the left image adds to the disparity, in the right image it is taken off, at the right image's row."""
    height = float(np.ptp(geometry.v))
    tried = frequencies(0.7 / height, 1 / _FEWEST_ROWS, 0.3 / height)
    return [
        Grid("row_jitter", "amplitude_px", Wave("rows_per_cycle", np.full(len(rows), sign), rows), tried, {"camera": side})
        for side, rows, sign in (("left", geometry.v, 1.0), ("right", geometry.v_right, -1.0))
    ]


def _locking(geometry: StereoGeometry) -> list[Grid]:
    """A sine of the disparity with the pixels of the matched image, full or reduced, at any phase.

    The rectification in which the disparities were found is not part of a measurement: its principal distance (the period) is
    known to some percent, its offset (the phase) not at all. Locking that acts on the noise too leaves little of its mean.
    """
    reach = max(float(np.ptp(np.quantile(geometry.disparity, [0.01, 0.99]))), 1.0)
    one = np.ones_like(geometry.disparity)
    return [
        Grid("pixel_locking", "amplitude_px", Wave("period_px", one, geometry.disparity), tried)
        for reduction in (1.0, 2.0, 4.0, 8.0)
        if (tried := frequencies((1 - _SCALE_UNKNOWN) / reduction, (1 + _SCALE_UNKNOWN) / reduction, 0.3 / reach, 80)).size
    ]


def exposure_and_locking(effects: tuple[Effect, ...], geometry: StereoGeometry) -> FloatArray:
    """(n,) what a model's row jitter and pixel locking add to the disparity, px."""
    total = np.zeros(len(geometry.u))
    for effect in effects:
        values: Any = effect
        if effect.name == "row_jitter":
            for side, rows, sign in (("left", geometry.v, 1.0), ("right", geometry.v_right, -1.0)):
                if values.camera in (side, "both"):
                    angle = 2 * np.pi * rows / values.rows_per_cycle + values.phase_rad
                    total += sign * values.amplitude_px * np.sin(angle)
        elif effect.name == "pixel_locking":
            total += values.amplitude_px * np.sin(2 * np.pi * geometry.found / (values.period_px or 1.0) + values.phase_rad)
    return total
