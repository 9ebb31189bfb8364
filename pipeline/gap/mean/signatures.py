"""Compute the signatures of the catalogue's systematic effects: how each would change the residuals, per unit of its parameters.

The equations are those of the effects (`Effect.mean`); effects of the cameras follow by projection through the changed pair.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement
from pipeline.gap.mean.candidates import (
    Candidate,
    SineGrid,
    Wave,
    amplitude_and_phase,
    disparity_frequencies,
    frequency_grid,
)
from pipeline.gap.residuals.disparity_raster import apply_smoothing, raster_spacing_px
from pipeline.gap.residuals.nominal_pair import NominalPair, PixelGeometry, predict_disparities, real_pair
from pipeline.gap.residuals.residuals import Geometry, Residuals
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, Search, ShowsIn
from sensors.effects.camera_effect import CameraEffect
from sensors.effects.pixel_locking import PixelLocking
from sensors.effects.tile_shift import TileShift

_SIDES = ("left", "right", "both")
"""Cameras that an effect may belong to."""
_STEP = 0.1
"""Step of the finite differences, in typical sizes of the parameter."""
_LEAST_SIZE = 1e-9
"""Smallest size of an error, in typical ones, with which its limit is reported: a limit must be above 0."""
_PHASE = "phase_rad"
"""Name of the parameter that holds a phase."""
_MOST_PERIODS = 2000
"""Most periods of one effect. A wobble over 8,000 scan lines then has a period at most half a cycle off over all lines."""
_REDUCTIONS = (1.0, 2.0, 4.0, 8.0)
"""Reductions of the images in which a matcher may have worked: pixel locking has their pixels as its period."""


def systematic_candidates(residuals: Residuals, measurement: Measurement) -> list[Candidate]:
    """List every systematic sensor error of the catalogue that this kind of measurement can have, as regression terms.

    It lists the errors of `systematic_families`, but each trial period is a candidate of its own.

    residuals: residuals of the points. measurement: the measurement, with the sensor model with which they were computed.
    """
    families = systematic_families(residuals, measurement)
    return [each for family in families for each in (family.candidates if isinstance(family, SineGrid) else [family])]


def systematic_families(residuals: Residuals, measurement: Measurement) -> list[Candidate | SineGrid]:
    """List every systematic sensor error of the catalogue that this kind of measurement can have, with its periods as one grid.

    An error's design columns are the change of the residuals per unit of its parameters. Each camera is a candidate of its
    own, and a sine of unknown period is one `SineGrid` of trial frequencies. Errors that depend on data which were not
    recorded, such as the intensity, are left out.

    residuals: residuals of the points. measurement: the measurement, with the sensor model with which they were computed.
    """
    geometry = residuals.geometry
    possible = [effect for effect in residuals.candidates if effect is not TileShift]  # its seams are found before, by themselves
    shown = [effect for effect in possible if effect.shows_in == ShowsIn.MEAN and effect.known(geometry)]
    cameras: list[type[CameraEffect]] = [effect for effect in shown if issubclass(effect, CameraEffect)]
    found: list[Candidate | SineGrid] = []
    if isinstance(residuals, StereoResiduals) and isinstance(measurement, StereoMeasurement) and cameras:
        found += _of_cameras(cameras, residuals.geometry, measurement)
    for effect in shown:
        if effect not in cameras:
            sides: list[dict[str, str]] = [{"camera": side} for side in _SIDES[:2]] if "camera" in effect.model_fields else [{}]
            found += [form for fixed in sides for form in _families(effect, geometry, fixed)]
    return [*found, *_locking(residuals.geometry)] if isinstance(residuals, StereoResiduals) else found


def _families(effect: type[Effect], geometry: Geometry, fixed: dict[str, Any]) -> Iterator[Candidate | SineGrid]:
    """Yield the candidates of one effect; their columns follow from its equation at typical parameter values."""
    if effect.searched is not None:
        yield from _searched(effect, effect.searched, geometry, fixed)
    elif _PHASE in effect.model_fields:
        (amplitude,) = effect.typical_sizes()
        named = partial(amplitude_and_phase, amplitude=amplitude)
        yield Candidate(effect.tag(), _sine_and_cosine(effect, geometry, fixed), named, (amplitude, _PHASE), fixed)
    else:
        sizes = effect.typical_sizes()
        limit, tried = effect.trials or ("", ())
        for keys in effect.sets or (tuple(sizes),):
            for limited in [{limit: value} for value in tried] or [{}]:
                held = {**fixed, **limited}
                columns = [effect(**held, **{key: sizes[key]}).mean(geometry) / sizes[key] for key in keys]
                named = partial(_with_limits, keys, limited, sizes) if limited else partial(_by_name, keys)
                yield Candidate(effect.tag(), np.stack(columns, axis=1), named, keys, held)


def _sine_and_cosine(effect: type[Effect], geometry: Geometry, fixed: dict[str, Any]) -> FloatArray:
    """(n, 2) columns at amplitude 1: a sin(x + phase) = (a cos phase) sin x + (a sin phase) cos x."""
    ((amplitude, size),) = effect.typical_sizes().items()
    values = (effect(**fixed, **{amplitude: size, _PHASE: phase}).mean(geometry) / size for phase in (0.0, np.pi / 2))
    return np.stack([*values], axis=1)


def _searched(effect: type[Effect], search: Search, geometry: Geometry, fixed: dict[str, Any]) -> Iterator[SineGrid]:
    """Yield the periods to try for a sine; the extent of its argument over the points sets their spacing."""
    (amplitude,) = effect.typical_sizes()
    x = np.asarray(effect(**fixed).argument(geometry), dtype=np.float64)
    reach = max(float(np.ptp(np.quantile(x, [0.01, 0.99]))), search.shortest)
    low, high = 1 / search.longest if search.longest else search.cycles / reach, 1 / _shortest(search, geometry)
    if low >= high:
        return
    angle = 2 * np.pi * x / search.shortest
    columns = _sine_and_cosine(effect, geometry, {**fixed, search.period: search.shortest})
    factor = columns[:, 0] * np.sin(angle) + columns[:, 1] * np.cos(angle)
    tried = frequency_grid(low, high, 0.3 / reach, _MOST_PERIODS)
    yield SineGrid(effect.tag(), amplitude, Wave(search.period, factor, x, float(np.mean(x)), low), tried, fixed)


def _shortest(search: Search, geometry: Geometry) -> float:
    """Shortest period to try: pixels farther apart than half a period would show it as a longer one (aliasing)."""
    if not isinstance(geometry, PixelGeometry):
        return search.shortest
    step = raster_spacing_px({"image_x": geometry.u, "image_y": geometry.v}[search.along])
    return search.shortest if step is None else max(search.shortest, 2 * step)


def _of_cameras(effects: list[type[CameraEffect]], geometry: PixelGeometry, measurement: StereoMeasurement) -> list[Candidate]:
    """Return the candidates of camera effects; their columns are finite differences of the pair's disparities."""
    nominal = NominalPair.of(measurement)
    sets = {effect: effect.sets or (tuple(effect.nulls()),) for effect in effects}
    varied = [
        (effect, side, key, _STEP * next(iter(effect.typical_sizes().values())))
        for effect in effects
        for side in _SIDES
        for key in sorted({key for keys in sets[effect] for key in keys})
    ]
    changed = (real_pair((effect(camera=side, **{key: step}),), measurement) for effect, side, key, step in varied)
    base, *seen = predict_disparities(nominal, [nominal.pair, *changed], geometry)
    changes = np.stack([(each - base) / step for (*_, step), each in zip(varied, seen, strict=True)], axis=1)
    passed = apply_smoothing(measurement.model.effects, geometry, changes)
    columns = {(effect, side, key): column for (effect, side, key, _), column in zip(varied, passed.T, strict=True)}
    found = []
    for effect, side in product(effects, _SIDES):
        for keys in sets[effect]:
            matrix = np.stack([columns[effect, side, key] for key in keys], axis=1)
            found.append(Candidate(effect.tag(), matrix, partial(_by_name, keys), keys, {"camera": side}))
    return found


def _by_name(names: tuple[str, ...], values: FloatArray) -> dict[str, float]:
    """Return the coefficients by the names of their parameters."""
    return dict(zip(names, map(float, values), strict=True))


def _with_limits(
    names: tuple[str, ...], limits: dict[str, float], sizes: dict[str, float], values: FloatArray
) -> dict[str, float]:
    """Return the coefficients by name, and limits of the error, given for its typical size, that grow with its size."""
    found = _by_name(names, values)
    factor = max(abs(value) / sizes[name] for name, value in found.items())
    return {**found, **{name: max(factor, _LEAST_SIZE) * value for name, value in limits.items()}}


def _locking(geometry: PixelGeometry) -> list[SineGrid]:
    """Pixel locking: a sine of the disparity with the pixels of the matched image, full or reduced, at any phase.

    The rectification in which the disparities were computed is not known: its principal distance (the period) is uncertain by
    some percent, its offset (the phase) entirely. If the matcher's noise is locked too, little of the mean error is left.
    """
    x = geometry.disparity
    reach, middle = float(np.ptp(np.quantile(x, [0.01, 0.99]))), float(np.mean(x))
    frequencies = (disparity_frequencies(1 / reduction, reach) for reduction in _REDUCTIONS)
    waves = ((Wave("period_px", np.ones_like(x), x, middle, float(tried[0])), tried) for tried in frequencies)
    return [SineGrid(PixelLocking.tag(), "amplitude_px", wave, tried) for wave, tried in waves]
