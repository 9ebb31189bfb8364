"""The site of a monitoring: its reference epoch, prepared for comparisons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.monitoring.comparison import ReferenceHeights
from pipeline.monitoring.frame import raster_of, towards_sensor, wall_frame
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.reading import EpochData, EpochSource, read_epoch
from scene.geometry.frame import WallFrame
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

_TENTH = 0.1
_STEEP = float(np.tan(np.radians(65.0)))


@dataclass(frozen=True)
class ReferenceSite:
    """The reference, prepared for comparisons.

    Attributes
    ----------
    source : EpochSource
    frame : WallFrame
        z along the direction of change, towards the sensor.
    station : (3,) array
        Where the sensor stood, or a place before the wall, wall frame, m.
    reference : ReferenceHeights
    points : int
    crs : str
        WKT, empty where the file states none.
    notes : tuple of str
    """

    source: EpochSource
    frame: WallFrame
    station: FloatArray
    reference: ReferenceHeights
    points: int
    crs: str
    notes: tuple[str, ...]

    @property
    def grid(self) -> Grid:
        """Of all maps."""
        return self.reference.raster.grid


def prepared(source: EpochSource, options: MonitorOptions) -> ReferenceSite:
    """Read the reference and choose frame and raster."""
    data = read_epoch(source, options)
    towards, how = towards_sensor(data, options, source.name)
    frame = wall_frame(data.points, towards, options.direction)
    grid = raster_of(frame.to_wall(data.points), options.gsd_m or _gsd_of_mesh(data), data.count)
    points = data.wall_points(frame, grid.gsd)
    reference = ReferenceHeights.of(points, grid)
    seen = float(reference.raster.known.mean())
    notes = [*data.notes, f"the wall was seen from its side of ({', '.join(f'{value:.2f}' for value in towards)}), {how}"]
    steep = reference.raster.steepness[reference.raster.known]
    if (share := float((steep > _STEEP).mean())) > _TENTH:
        notes.append(
            f"{100 * share:.0f} % of the surface stands at more than 65 degrees to the maps' plane, where changes show badly: "
            "give another --direction, or monitor the sides of a corner by themselves"
        )
    if seen < _TENTH:
        notes.append(f"only {100 * seen:.0f} % of the map has data: a larger --gsd has fewer gaps")
    return ReferenceSite(source, frame, frame.to_wall(towards), reference, data.count, data.crs, tuple(notes))


def _gsd_of_mesh(data: EpochData) -> float | None:
    """Of a mesh or an elevation model: the median edge; None for points."""
    if data.mesh is None:
        return None
    few = data.mesh.faces[:: max(len(data.mesh.faces) // 100_000, 1)]
    corners = data.mesh.vertices[few]
    return float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))
