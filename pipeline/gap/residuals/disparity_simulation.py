"""A stereo pair asked for the depth map's cells that hold given pixels, so that a measurement can be simulated pixel by pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import StereoMeasurement
from pipeline.gap.residuals.disparity_raster import DisparityRaster
from pipeline.gap.residuals.nominal_pair import NominalPair, PixelGeometry, project
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Stage
from sensors.effects.raster_effect import RasterEffect
from sensors.models.sensor_model import StereoModel
from sensors.stereo.stereo_pair import REDUCTION, StereoPair
from sensors.subset import effects_needing_neighbours, restrict_to

_SAME_STEP = 0.5
"""px by which two rasters' steps may differ: registrations move pixels a little."""


def simulate_disparities(
    measurement: StereoMeasurement, model: StereoModel, residuals: StereoResiduals, randoms: Sequence[KeyedRandom]
) -> FloatArray:
    """(d, n) of the depth map's cell that holds each pixel, for each source of random numbers; the finest depth map of whose grid
    the pixels are, or come nearest to.

    measurement: with its cameras where they stood, against which `residuals` may be those of another place. Cells are two pixels
    wide at least; by how much the reference's disparity differs between the middle of a cell and the pixel is taken off. What a
    matcher does to neighbours is done among the pixels of the measurement's own raster, if that is not the depth map's.
    """
    nominal, g = NominalPair.of(measurement), residuals.geometry
    quality = min(REDUCTION, key=lambda name: float(np.mean(np.abs(np.mod(g.u, REDUCTION[name]) - REDUCTION[name] / 2))))
    step, pair = REDUCTION[quality], StereoPair(measurement.cameras, measurement.frame, model, quality)
    height, width = pair.shape
    rows = np.clip((g.v / step).astype(int), 0, height - 1)
    columns = np.clip((g.u / step).astype(int), 0, width - 1)
    middle = nominal.surface_disparity(measurement.scene, (columns + 0.5) * step, (rows + 0.5) * step)
    beside = g.disparity + (middle - nominal.surface_disparity(measurement.scene, g.u, g.v))
    pair, shaped = _on_own_raster(pair, measurement, g, step)
    drawn = []
    for seen in _points(pair, measurement, rows * width + columns, randoms):
        disparity = nominal.disparity(project(nominal.pair.left, seen), project(nominal.pair.right, seen))
        drawn.append(disparity - beside + shaped)
    return np.stack(drawn)


def _on_own_raster(
    pair: StereoPair, measurement: StereoMeasurement, geometry: PixelGeometry, step: int
) -> tuple[StereoPair, FloatArray]:
    """The pair without the effects that are done among the measurement's pixels, and what those add (n,), px.

    Outlines grow by whole cells, from steps between cells: on finer ones they grow otherwise.
    """
    shapes = [effect for effect in pair.model.effects if isinstance(effect, RasterEffect) and effect.stage == Stage.MATCH]
    raster = DisparityRaster.of(measurement.changed(model=pair.model), geometry) if shapes else None
    if raster is None or abs(raster.step - step) < _SAME_STEP:
        return pair, np.zeros(len(geometry))
    others = tuple(effect for effect in pair.model.effects if effect not in shapes)
    without = replace(pair, model=pair.model.model_copy(update={"effects": others}))
    return without, raster.added_by(shapes, geometry.disparity)


def _points(
    pair: StereoPair, measurement: StereoMeasurement, cells: NDArray[np.int64], randoms: Sequence[KeyedRandom]
) -> list[FloatArray]:
    """(n, 3) of each source of random numbers: what is recorded in these cells (n,), of which those alone are traced where no
    effect looks at others."""
    if effects_needing_neighbours(pair.model):
        return [pair.observe(measurement.scene, random).points.reshape(-1, 3)[cells] for random in randoms]
    chosen, place = np.unique(cells, return_inverse=True)
    some = restrict_to(pair, chosen.astype(np.uint32))
    return [some.observe(measurement.scene, random).points.reshape(-1, 3)[place] for random in randoms]
