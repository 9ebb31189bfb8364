"""How each effect of the laser scanner on the mean would show in the range residuals: columns that are linear in amplitudes.

An error d of a recorded angle makes the beam leave by -d, so the recorded range is that of the direction: dR = -d dR/dangle.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.gap.candidates import Candidate, Grid, Wave, amplitude_and_phase, frequencies, variants
from pipeline.gap.residuals import Residuals
from pipeline.gap.tls_spread import slant
from scene.mesh import FloatArray

_FEWEST_LINES = 4.0
_LONGEST_M, _SHORTEST_M = 15.0, 0.3
"""Periods that are searched: the catalogue's typical ones and half as much again."""


def log_over_median(power: FloatArray) -> FloatArray:
    """(n,) ln of the received power over its median."""
    positive = np.maximum(power, 1e-12)
    return np.asarray(np.log(positive / np.median(positive)), dtype=np.float64)


def mean_candidates(residuals: Residuals) -> list[Candidate]:
    """Every effect of the catalogue on the mean that the recorded fields allow, searched parameters as variants."""
    return variants(mean_families(residuals))


def mean_families(residuals: Residuals) -> list[Candidate | Grid]:
    """The same with each searched sine as one grid."""
    geometry = residuals.geometry
    found: list[Candidate | Grid] = [*_plain(geometry), *_eccentric(geometry), _cyclic(geometry)]
    if geometry.power is not None:
        column = log_over_median(geometry.power)
        found.append(_single("range_intensity_bias", "coefficient_m", column))
    if geometry.line is not None:
        found += _wobble(geometry)
    if geometry.share is not None:
        found.append(_drift(geometry))
    return found


def _single(name: str, parameter: str, column: FloatArray, scale: float = 1.0) -> Candidate:
    """One amplitude; `scale` units of the parameter per unit of the column."""
    return Candidate(name, column[:, None], lambda values: {parameter: float(values[0]) * scale}, (parameter,))


def _plain(geometry: Any) -> list[Candidate]:
    cot = 1 / np.tan(geometry.zenith)
    return [
        _single("range_offset", "offset_m", np.ones_like(geometry.range_m)),
        _single("range_scale", "scale_ppm", geometry.range_m, 1e6),
        _single("range_incidence_bias", "coefficient_m", slant(geometry)),
        _single("vertical_index", "offset_rad", -geometry.by_zenith),
        _single("collimation", "angle_rad", -geometry.by_azimuth / np.sin(geometry.zenith)),
        _single("trunnion_tilt", "angle_rad", -geometry.by_azimuth * cot),
    ]


def _eccentric(geometry: Any) -> list[Candidate]:
    """a sin(x + phase) = (a cos phase) sin x + (a sin phase) cos x."""
    found = []
    for name, slope, angle in (
        ("horizontal_eccentricity", geometry.by_azimuth, geometry.azimuth),
        ("vertical_eccentricity", geometry.by_zenith, geometry.zenith),
    ):
        found.append(_wave(name, -slope, angle, "amplitude_rad", {}))
    return found


def _wave(name: str, factor: FloatArray, angle: FloatArray, amplitude: str, fixed: dict[str, float]) -> Candidate:
    columns = np.stack([factor * np.sin(angle), factor * np.cos(angle)], axis=1)
    return Candidate(
        name, columns, lambda values: amplitude_and_phase(values, amplitude) | fixed, (amplitude, "phase_rad"), fixed
    )


def _cyclic(geometry: Any) -> Grid:
    """Periods on a grid as fine as the spread of the ranges can tell apart."""
    reach = max(float(np.ptp(np.quantile(geometry.range_m, [0.01, 0.99]))), 1.0)
    wave = Wave("period_m", np.ones_like(geometry.range_m), geometry.range_m)
    return Grid("range_cyclic", "amplitude_m", wave, frequencies(1 / _LONGEST_M, 1 / _SHORTEST_M, 0.3 / reach))


def _wobble(geometry: Any) -> list[Grid]:
    lines = float(np.ptp(geometry.line))
    if lines < 4 * _FEWEST_LINES:
        return []
    wave = Wave("lines_per_cycle", -geometry.by_zenith, geometry.line)
    return [Grid("wobble", "amplitude_rad", wave, frequencies(2 / lines, 1 / _FEWEST_LINES, 0.3 / lines))]


def _drift(geometry: Any) -> Candidate:
    sin_a, cos_a, cot = np.sin(geometry.azimuth), np.cos(geometry.azimuth), 1 / np.tan(geometry.zenith)
    by_x = -geometry.share * (-cot * cos_a * geometry.by_azimuth - sin_a * geometry.by_zenith)
    by_y = -geometry.share * (-cot * sin_a * geometry.by_azimuth + cos_a * geometry.by_zenith)
    names = ("rate_x_rad", "rate_y_rad")
    return Candidate(
        "tilt_drift", np.stack([by_x, by_y], axis=1), lambda values: dict(zip(names, map(float, values), strict=True)), names
    )
