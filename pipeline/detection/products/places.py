"""Compute the survey coordinates of events, from the run's wall frame and the heights of its reference surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from pipeline.detection.products.events import Event
from pipeline.formats.records.result_files import read_surface
from pipeline.formats.records.result_records import RUN_FILE, read_run
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray

_NEAR_M, _FARTHEST_M = 0.05, 1.0
"""Radius, m, within which reference vertices give the height of the rock; it is doubled up to the second value if there
are none.
"""


@dataclass(frozen=True)
class EventPlaces:
    """Converts the position of a rockfall on a run's difference map to world coordinates.

    The map gives x and y in the wall frame. The height comes from the vertices of the reference surface around them.

    Attributes
    ----------
    frame : The wall frame of the run.
    vertices : (n, 3) vertices of the reference surface, wall frame, m, sorted by x; empty if the run wrote none.
    """

    frame: WallFrame
    vertices: FloatArray

    def world(self, x: float, y: float) -> FloatArray:
        """Return where the rock of an event was before it fell, (3,) in the world frame, m; NaN if unknown.

        x, y: position of the event in the wall frame, m.
        """
        return np.asarray(self.frame.to_world(np.array([x, y, self._height(x, y)])))

    def _height(self, x: float, y: float) -> float:
        """Return the median height of the reference around (x, y), m."""
        radius = _NEAR_M
        while radius <= _FARTHEST_M:
            low, high = np.searchsorted(self.vertices[:, 0], [x - radius, x + radius])
            part = self.vertices[low:high]
            near = part[np.abs(part[:, 1] - y) <= radius, 2]
            if near.size:
                return float(np.median(near))
            radius *= 2
        return float("nan")


def with_world_coordinates(event: Event, path: Path) -> Event:
    """Return a detected rockfall with its world coordinates, if its map belongs to a run with a known wall frame.

    event: the rockfall. path: file of the map in which it was detected.
    """
    run = next((folder for folder in (path.parent, path.parent.parent) if (folder / RUN_FILE).is_file()), None)
    places = _places(run.resolve()) if run is not None else None
    if places is None:
        return event
    x, y, z = places.world(event.x_m, event.y_m).tolist()
    return replace(event, world_x_m=x, world_y_m=y, world_z_m=z)


@lru_cache(2)
def _places(folder: Path) -> EventPlaces | None:
    """Read wall frame and reference surface of a run's folder."""
    frame = read_run(folder / RUN_FILE, "make the run again").get("wall_frame")
    if not frame:
        return None
    surface = folder / "epoch_000" / "surface.ply"
    vertices = read_surface(surface).vertices if surface.is_file() else np.empty((0, 3))
    ordered = vertices[np.argsort(vertices[:, 0])]
    return EventPlaces(WallFrame(np.array(frame["rotation"]), np.array(frame["origin_m"])), ordered)
