"""Compare one epoch with the reference: register, difference, level of detection, regions that changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.change.areas import Area
from pipeline.monitoring.alignment import Alignment, applied, coarse, reference_surface, refine
from pipeline.monitoring.events import Change, ChangedRegion, find_regions
from pipeline.monitoring.gridding import HeightRaster, gridded
from pipeline.monitoring.significance import significance
from pipeline.registration.closest_points import ReferenceSurface
from pipeline.registration.rigid import RigidTransform
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

_SURE = 15.0
"""Significance from which a region is taken for a change when noise is measured on what is left."""
_AROUND_PX = 3


@dataclass(frozen=True)
class ReferenceHeights:
    """The reference epoch: its heights, and its pixels as a surface that ICP pairs points with."""

    raster: HeightRaster
    surface: ReferenceSurface

    @classmethod
    def of(cls, points: FloatArray, grid: Grid) -> ReferenceHeights:
        """Prepare the reference from its points (n, 3), wall frame, m."""
        raster = gridded(points, grid)
        return cls(raster, reference_surface(raster))


@dataclass(frozen=True)
class EpochChange:
    """What one epoch shows against the reference.

    Attributes
    ----------
    transform : RigidTransform
        From the epoch's points as they were read to the reference, wall frame.
    alignment : Alignment
        The last fit, with its uncertainty.
    change : Change
        Difference map and level of detection.
    regions : list of ChangedRegion
        What changed, the largest volume first.
    """

    transform: RigidTransform
    alignment: Alignment
    change: Change
    regions: list[ChangedRegion]


def compare_epoch(reference: ReferenceHeights, points: FloatArray, stable: Sequence[Area], seed: int) -> EpochChange:
    """Compare an epoch's points (n, 3), wall frame, m, with the reference.

    Parameters
    ----------
    reference : ReferenceHeights
    points : (n, 3) array
    stable : sequence of Area
        Stable rock as the user says, wall frame; empty: found here.
    seed : int
        Of the subsets that ICP begins with.

    Raises
    ------
    InputError
        Where the two do not meet, or too little is stable.
    """
    grid = reference.raster.grid
    first = coarse(reference.surface, points, grid.gsd, seed)
    epoch = gridded(first.apply(points), grid)
    alignment = refine(reference.raster, epoch, stable)
    difference = reference.raster.height - applied(alignment, epoch)
    registration = alignment.sigma(epoch)
    predicted = np.sqrt(reference.raster.sigma**2 + epoch.sigma**2 + registration**2).astype(np.float32)

    def changed(unchanged: NDArray[np.bool_]) -> tuple[Change, list[ChangedRegion]]:
        found = Change(difference, significance(difference, predicted, unchanged), registration, reference.raster, epoch)
        return found, find_regions(found)

    _, regions = changed(alignment.stable)
    change, regions = changed(alignment.stable & ~_surely_changed(regions, difference.shape))
    return EpochChange(alignment.transform.after(first), alignment, change, regions)


def _surely_changed(regions: Sequence[ChangedRegion], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """(h, w) where something surely changed, with a margin: noise is measured elsewhere."""
    sure = np.zeros(shape, dtype=bool)
    for region in regions:
        if region.significance >= _SURE and "thin" not in region.marks:
            sure[region.window] |= region.mask
    return np.asarray(ndimage.binary_dilation(sure, np.ones((3, 3)), iterations=_AROUND_PX))
