"""Prepare the reference epoch of `monitor`: its views, frames and rasters, with which all other epochs are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.change.areas import check_some_inside
from pipeline.monitoring.alignment import SAME
from pipeline.monitoring.comparison import ReferenceHeights
from pipeline.monitoring.frame import doubt_of_side, raster_of, towards_sensor, wall_frame
from pipeline.monitoring.gridding import HeightRaster
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.reading import EpochData, EpochSource, read_epoch
from pipeline.monitoring.stable_areas import StableArea, StableRock
from pipeline.monitoring.views import MOST_VIEWS, Partition, divided
from pipeline.registration.rigid import RigidTransform
from scene.common.errors import InputError
from scene.geometry.frame import WallFrame
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

_TENTH = 0.1
_WIDEST_M = 10_000.0
"""Extent of a wall beyond which its coordinates are hardly metres."""
_STEEP = float(np.tan(np.radians(65.0)))


@dataclass(frozen=True)
class WallView:
    """A part of the wall with maps of its own, which are made along a direction of its own.

    Attributes
    ----------
    number : int
        Number of the view, from 1 on; the first is the largest, and its frame is the wall frame.
    frame : WallFrame
        Frame of the view; z is the direction in which change is measured, towards the sensor.
    raster : HeightRaster
        Heights of the reference epoch, frame of the view.
    """

    number: int
    frame: WallFrame
    raster: HeightRaster

    @property
    def grid(self) -> Grid:
        """Raster of the maps of this part of the wall."""
        return self.raster.grid

    @property
    def suffix(self) -> str:
        """Ending of the names of the files of this part of the wall, such as "_view2"; empty for the first part."""
        return "" if self.number == 1 else f"_view{self.number}"


@dataclass(frozen=True)
class ReferenceSite:
    """The reference epoch, prepared so that other epochs can be compared with it.

    Attributes
    ----------
    source : EpochSource
        Its files and time.
    views : tuple of WallView
        The view of the whole wall, or several views (separately mapped parts) if the wall turns a corner or overhangs.
    station : (3,) array
        Position of the sensor, or a place in front of the wall, wall frame, m.
    reference : ReferenceHeights
        Heights of all views.
    points : int
        Number of points.
    crs : str
        WKT of the coordinate system; empty if the file states none.
    notes : tuple of str
        Remarks on the reference for the user.
    """

    source: EpochSource
    views: tuple[WallView, ...]
    station: FloatArray
    reference: ReferenceHeights
    points: int
    crs: str
    notes: tuple[str, ...]

    @property
    def frame(self) -> WallFrame:
        """The wall frame, which is the frame of the first and largest view (separately mapped part) of the wall."""
        return self.views[0].frame

    @property
    def grid(self) -> Grid:
        """Raster of the maps of the first and largest view (separately mapped part) of the wall."""
        return self.views[0].grid


def prepared(source: EpochSource, options: MonitorOptions) -> ReferenceSite:
    """Read the reference epoch, and prepare it for comparisons with other epochs.

    The wall is divided into views (parts that are mapped along directions of their own) where needed. Each gets a frame and a
    raster.

    source: files of the reference. options: options of `monitor`. Raises InputError if the files cannot be used.
    """
    data = read_epoch(source, options)
    _check_extent(data, options, source.name)
    towards, how = towards_sensor(data, options, source.name)
    frames, partition = _frames(data, towards, options)
    wall = frames[0]
    grids = _grids(data, frames, partition, options)
    points = data.wall_points(wall, grids[0].gsd, several=partition is not None)
    reference = ReferenceHeights.of(points, grids, [_between(wall, frame) for frame in frames], partition)
    _check_stable_areas(options.stable, frames, reference.rasters)
    parts = zip(frames, reference.rasters, strict=True)
    views = tuple(WallView(number, *each) for number, each in enumerate(parts, start=1))
    notes = [*data.notes, f"the wall was seen from its side of ({', '.join(f'{value:.2f}' for value in towards)}), {how}"]
    notes += [*doubt_of_side(data, options, wall, source.name), *_notes(views)]
    return ReferenceSite(source, views, wall.to_wall(towards), reference, data.count, data.crs, tuple(notes))


def _check_stable_areas(areas: Sequence[StableArea], frames: Sequence[WallFrame], rasters: Sequence[HeightRaster]) -> None:
    """Raise InputError if the user gave stable areas that all lie outside the wall. frames, rasters: of each view."""
    if not areas:
        return
    places = []
    for frame, raster in zip(frames, rasters, strict=True):
        row, column = np.nonzero(raster.known)
        x, y = raster.grid.x_min + (column + 0.5) * raster.grid.gsd, raster.grid.y_max - (row + 0.5) * raster.grid.gsd
        places.append(frames[0].to_wall(frame.to_world(np.stack([x, y, raster.height[row, column].astype(np.float64)], axis=1))))
    points = np.concatenate(places)
    check_some_inside(StableRock(tuple(areas), frames[0]).contains(points), points[:, 0], points[:, 1], "--stable")


def _check_extent(data: EpochData, options: MonitorOptions, name: str) -> None:
    """Raise InputError for a wall of many kilometres, unless the user stated the unit."""
    extent = float(np.ptp(data.bounds, axis=0).max())
    if options.unit is None and extent > _WIDEST_M:
        raise InputError(
            f"the wall is {extent / 1e3:,.0f} km long, if its coordinates are metres",
            where=name,
            allowed=f"up to {_WIDEST_M / 1e3:.0f} km without --unit",
            remedy="state the unit of the coordinates with --unit (mm, cm, m, ft), or remove stray points far from the wall",
        )


def _frames(data: EpochData, towards: FloatArray, options: MonitorOptions) -> tuple[list[WallFrame], Partition | None]:
    """Frame of each view, the largest first, and which point belongs to which, in the first frame."""
    single = wall_frame(data.points, towards, options.direction)
    count = options.views or (None if options.direction is None else 1)
    if count is not None and not 1 <= count <= MOST_VIEWS:
        raise InputError(
            f"the wall cannot be divided into {count} views",
            where="--views",
            allowed=f"1 to {MOST_VIEWS}",
            remedy="choose a number in this range",
        )
    found = divided(data.points - single.origin, towards - single.origin, single.rotation[2], count)
    if found is None:
        return [single], None
    view = found.of(data.points - single.origin)
    frames = [WallFrame.along(direction, data.points[view == number]) for number, direction in enumerate(found.directions)]
    wall = frames[0]
    return frames, found.for_points(RigidTransform(wall.rotation.T, wall.origin - single.origin))


def _grids(data: EpochData, frames: Sequence[WallFrame], partition: Partition | None, options: MonitorOptions) -> list[Grid]:
    """Raster of each view; all have the pixel of the first."""
    gsd = options.gsd_m or _gsd_of_mesh(data)
    if partition is None:
        return [raster_of(frames[0].to_wall(data.points), gsd, data.count)]
    view, grids = partition.of(frames[0].to_wall(data.points)), list[Grid]()
    for number, frame in enumerate(frames):
        part = frame.to_wall(data.points[view == number])
        grids.append(raster_of(part, gsd, round(data.count * len(part) / len(data.points))))
        gsd = grids[0].gsd
    return grids


def _between(wall: WallFrame, view: WallFrame) -> RigidTransform:
    """From the wall frame to that of a view."""
    if view is wall:
        return SAME
    return RigidTransform(view.rotation @ wall.rotation.T, view.rotation @ (wall.origin - view.origin))


def _notes(views: Sequence[WallView]) -> list[str]:
    notes = []
    if len(views) > 1:
        notes.append(
            f"the wall turns or overhangs: it has {len(views)} views with maps of their own (difference_001.tif, "
            "difference_001_view2.tif, ...), registered together"
        )
    known = sum(int(view.raster.known.sum()) for view in views)
    steep = sum(int((view.raster.steepness[view.raster.known] > _STEEP).sum()) for view in views)
    if (share := steep / max(known, 1)) > _TENTH:
        notes.append(
            f"{100 * share:.0f} % of the surface stands at more than 65 degrees to the maps' plane, where changes show badly: "
            "give another --direction, or a number of --views"
        )
    seen = known / sum(view.raster.known.size for view in views)
    if len(views) == 1 and seen < _TENTH:
        notes.append(
            f"only {100 * seen:.0f} % of the map has data: give a larger --gsd, or remove stray points far from the wall"
        )
    return notes


def _gsd_of_mesh(data: EpochData) -> float | None:
    """Of a mesh or an elevation model: the median edge; None for points."""
    if data.mesh is None:
        return None
    few = data.mesh.faces[:: max(len(data.mesh.faces) // 100_000, 1)]
    corners = data.mesh.vertices[few]
    return float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))
