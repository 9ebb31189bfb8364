"""Compare one epoch with the reference: register, difference, level of detection, regions that changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.change.areas import Area
from pipeline.monitoring.alignment import Alignment, applied, coarse, reference_surface, refine
from pipeline.monitoring.events import Change, ChangedRegion, find_regions
from pipeline.monitoring.gridding import HeightRaster, WallPoints, gridded
from pipeline.monitoring.significance import significance
from pipeline.registration.closest_points import ReferenceSurface
from pipeline.registration.rigid import RigidTransform
from scene.geometry.grid import Grid


@dataclass(frozen=True)
class ReferenceHeights:
    """The reference epoch: its heights, and its pixels as a surface that ICP pairs points with."""

    raster: HeightRaster
    surface: ReferenceSurface

    @classmethod
    def of(cls, points: WallPoints, grid: Grid) -> ReferenceHeights:
        """Prepare the reference from its points."""
        raster = gridded(points.chunks(), grid)
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


def compare_epoch(reference: ReferenceHeights, points: WallPoints, stable: Sequence[Area], seed: int) -> EpochChange:
    """Compare an epoch's points with the reference.

    Parameters
    ----------
    reference : ReferenceHeights
    points : WallPoints
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
    first = coarse(reference.surface, points.sample, grid.gsd, seed)
    epoch = gridded(map(first.apply, points.chunks()), grid)
    alignment = refine(reference.raster, epoch, stable)
    difference = reference.raster.height - applied(alignment, epoch)
    registration = alignment.sigma(epoch)
    predicted = np.sqrt(reference.raster.sigma**2 + epoch.sigma**2 + registration**2).astype(np.float32)
    noise = significance(difference, predicted, alignment.stable)
    change = Change(difference, noise, registration, reference.raster, epoch)
    return EpochChange(alignment.transform.after(first), alignment, change, find_regions(change))
