"""Compare one epoch with the reference: register it, and compute differences, levels of detection and changed regions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.monitoring.alignment import SAME, Alignment, RasterPair, applied, coarse, reference_surface, refine
from pipeline.monitoring.events import Change, ChangedRegion, find_regions
from pipeline.monitoring.gridding import HeightRaster, PointSums, WallPoints
from pipeline.monitoring.significance import significance
from pipeline.monitoring.stable_areas import StableRock
from pipeline.monitoring.views import Partition
from pipeline.registration.closest_points import ReferenceSurface
from pipeline.registration.rigid import RigidTransform
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray


@dataclass(frozen=True)
class ReferenceHeights:
    """The reference epoch, with which all others are compared: rasters of its heights, and a surface for ICP.

    A wall that turns a corner has several views: parts that are mapped along directions of their own.

    Attributes
    ----------
    rasters : tuple of HeightRaster
        Heights of each view.
    from_wall : tuple of RigidTransform
        Transforms from the wall frame to the frame of each view.
    partition : Partition or None
        Says which points belong to which view, wall frame; None for a single view.
    surface : ReferenceSurface
        Points and normals of all views, wall frame, m, to which ICP registers.
    """

    rasters: tuple[HeightRaster, ...]
    from_wall: tuple[RigidTransform, ...]
    partition: Partition | None
    surface: ReferenceSurface

    @classmethod
    def of(
        cls,
        points: WallPoints,
        grids: Sequence[Grid],
        from_wall: Sequence[RigidTransform] = (SAME,),
        partition: Partition | None = None,
    ) -> ReferenceHeights:
        """Prepare the reference epoch from its points.

        Parameters
        ----------
        points : WallPoints
            Points of the reference, wall frame, m.
        grids : sequence of Grid
            Raster of each view (separately mapped part) of the wall.
        from_wall : sequence of RigidTransform
            Transforms from the wall frame to the frame of each view.
        partition : Partition or None
            Says which points belong to which view, wall frame; None for a single view.
        """
        rasters = _gridded(points.moved(SAME), grids, from_wall, partition)
        return cls(tuple(rasters), tuple(from_wall), partition, reference_surface(rasters, from_wall))

    def gridded(self, chunks: Iterable[FloatArray]) -> list[HeightRaster]:
        """Return the heights of another epoch on the reference's rasters, one for each view (separately mapped part) of the wall.

        chunks: points of the epoch in arrays (n, 3), wall frame, m.
        """
        return _gridded(chunks, [raster.grid for raster in self.rasters], self.from_wall, self.partition)


@dataclass(frozen=True)
class EpochChange:
    """Result of comparing one epoch with the reference.

    Attributes
    ----------
    transform : RigidTransform
        Moves the epoch's points, as they were read, to the reference, wall frame.
    first : RigidTransform
        The part of it that ICP found, or the targets.
    alignment : Alignment
        The final registration, with its uncertainty.
    changes : list of Change
        Difference map and level of detection of each view (separately mapped part) of the wall.
    regions : list of ChangedRegion
        Regions that changed, the largest volume first.
    """

    transform: RigidTransform
    first: RigidTransform
    alignment: Alignment
    changes: list[Change]
    regions: list[ChangedRegion]


def compare_epoch(
    reference: ReferenceHeights, points: WallPoints, stable: StableRock | None, seed: int, start: RigidTransform | None = None
) -> EpochChange:
    """Register an epoch on the reference, and find where the wall changed between the two.

    Parameters
    ----------
    reference : ReferenceHeights
        The reference epoch.
    points : WallPoints
        Points of the epoch, wall frame, m.
    stable : StableRock or None
        Areas of stable rock given by the user; None or no areas: unchanged rock is found from the differences.
    seed : int
        Seed of the random subsets of points for ICP.
    start : RigidTransform, optional
        Transform that brings the points near the reference, wall frame; None: ICP finds one.

    Returns
    -------
    EpochChange
        Registration, difference maps, levels of detection and changed regions.

    Raises
    ------
    InputError
        If the epoch does not overlap the reference, or too few pixels can be compared.
    """
    gsd = reference.rasters[0].grid.gsd
    first = coarse(reference.surface, points.sample, gsd, seed) if start is None else start
    epochs = reference.gridded(points.moved(first))
    pairs = [RasterPair(*each) for each in zip(reference.rasters, epochs, reference.from_wall, strict=True)]
    alignment = refine(pairs, stable)
    changes = [_change(pair, alignment, view) for view, pair in enumerate(pairs)]
    regions = [replace(region, view=view) for view, change in enumerate(changes, start=1) for region in find_regions(change)]
    return EpochChange(
        alignment.transform.after(first), first, alignment, changes, sorted(regions, key=lambda region: -region.volume_m3)
    )


def _change(pair: RasterPair, alignment: Alignment, view: int) -> Change:
    design = pair.design(alignment.centre)
    difference = pair.reference.height - applied(alignment, pair, design)
    registration = alignment.sigma(design)
    predicted = np.sqrt(pair.reference.sigma**2 + pair.epoch.sigma**2 + registration**2).astype(np.float32)
    noise = significance(difference, predicted, alignment.stable[view])
    return Change(difference, noise, registration, pair.reference, pair.epoch)


def _gridded(
    chunks: Iterable[FloatArray], grids: Sequence[Grid], from_wall: Sequence[RigidTransform], partition: Partition | None
) -> list[HeightRaster]:
    """Return the heights of each view from chunks of points (n, 3), wall frame, m."""
    sums = [PointSums.over(grid) for grid in grids]
    for chunk in chunks:
        if partition is None:
            sums[0].add(chunk)
            continue
        view = partition.of(chunk)
        for number, (each, transform) in enumerate(zip(sums, from_wall, strict=True)):
            each.add(transform.apply(chunk[view == number]))
    return [each.heights() for each in sums]
