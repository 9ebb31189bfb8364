"""Simulate the disparities of a stereo pair pixel by pixel: the sensor simulation is evaluated at the pixels of a measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import StereoMeasurement
from pipeline.gap.residuals.disparity_raster import DisparityRaster, raster_cell_px
from pipeline.gap.residuals.nominal_pair import NominalPair, PixelGeometry, project, real_pair
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import ShowsIn, Stage
from sensors.effects.raster_effect import RasterEffect
from sensors.models.sensor_model import StereoModel
from sensors.stereo.stereo_pair import REDUCTION, StereoPair
from sensors.subset import effects_needing_neighbours, restrict_to

_SAME_STEP = 0.5
"""Difference of two raster spacings, px, that still counts as equal: registrations shift pixels a little."""


def simulate_disparities(
    measurement: StereoMeasurement, model: StereoModel, residuals: StereoResiduals, randoms: Sequence[KeyedRandom]
) -> FloatArray:
    """Simulate the disparities that a sensor model gives at the measured pixels of a stereo pair, with its random errors.

    The simulated depth maps have cells of 2, 4 or 8 px. The size is chosen whose cell centres lie nearest to the pixels. The
    simulated disparities are corrected for the distance of each pixel from the centre of its cell, by the disparities that the
    simulated cameras see on the reference at both places. If the measurement's own raster has another spacing, effects that
    depend on neighbouring cells are applied on that raster.

    Parameters
    ----------
    measurement : The pair, with the cameras at their aligned pose.
    model : The sensor model to simulate.
    residuals : Residuals with the n pixels; they may have been computed at another pose of the cameras.
    randoms : d sources of random numbers, one for each simulation.

    Returns
    -------
    (d, n) disparities, px.
    """
    nominal, g = NominalPair.of(measurement), residuals.geometry
    quality = min(REDUCTION, key=lambda name: float(np.mean(np.abs(np.mod(g.u, REDUCTION[name]) - REDUCTION[name] / 2))))
    step, pair = REDUCTION[quality], StereoPair(measurement.cameras, measurement.frame, model, quality)
    height, width = pair.shape
    rows = np.clip((g.v / step).astype(int), 0, height - 1)
    columns = np.clip((g.u / step).astype(int), 0, width - 1)
    real = real_pair(model.effects, measurement)  # a shifted image sees other rock, so that the relief beside it differs too
    middle = nominal.surface_disparity(measurement.scene, (columns + 0.5) * step, (rows + 0.5) * step, real)
    beside = g.disparity + (middle - nominal.surface_disparity(measurement.scene, g.u, g.v, real))
    pair, shaped = _on_own_raster(pair, measurement, g, step)
    points = _points(pair, measurement, rows * width + columns, randoms)
    drawn = [nominal.disparity(project(nominal.pair.left, each), project(nominal.pair.right, each)) for each in points]
    return np.stack(drawn) - beside + shaped


def _on_own_raster(
    pair: StereoPair, measurement: StereoMeasurement, geometry: PixelGeometry, step: int
) -> tuple[StereoPair, FloatArray]:
    """Remove the effects that are applied on the measurement's own raster from the pair.

    Returns the other pair and what these effects add to the disparities, (n,), px. Edge fattening grows by whole cells, so that
    it depends on their size.
    """
    matching = (effect for effect in pair.model.effects if effect.stage == Stage.MATCH and effect.looks_at == "neighbours")
    own = [effect for effect in matching if effect.shows_in != ShowsIn.SPREAD]
    step_px = raster_cell_px(geometry.u, geometry.v)
    if not own or step_px is None or abs(step_px - step) < _SAME_STEP:
        return pair, np.zeros(len(geometry))
    shapes = [effect for effect in own if isinstance(effect, RasterEffect)]
    raster = DisparityRaster.of(measurement.changed(model=pair.model), geometry) if shapes else None
    if shapes and raster is None:
        return pair, np.zeros(len(geometry))
    others = tuple(effect for effect in pair.model.effects if effect not in own)
    without = replace(pair, model=pair.model.model_copy(update={"effects": others}))
    added = np.asarray(sum((effect.mean(geometry) for effect in own if effect not in shapes), np.zeros(len(geometry))))
    return without, added if raster is None else added + raster.added_by(shapes, geometry.disparity)


def _points(
    pair: StereoPair, measurement: StereoMeasurement, cells: NDArray[np.int64], randoms: Sequence[KeyedRandom]
) -> list[FloatArray]:
    """For each source of random numbers the (n, 3) points recorded in depth map cells (n,).

    Only those cells are traced, unless an effect uses neighbouring ones.
    """
    if not effects_needing_neighbours(pair.model):
        chosen, cells = np.unique(cells, return_inverse=True)
        pair = restrict_to(pair, chosen.astype(np.uint32))
    return [pair.observe(measurement.scene, random).points.reshape(-1, 3)[cells] for random in randoms]
