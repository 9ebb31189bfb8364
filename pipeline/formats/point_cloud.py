"""The point cloud that all readers return and all writers take."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.units import AxisUnits
from scene.geometry.mesh import FloatArray

SCAN = "scan"
"""Channel with the number of the scan that a point belongs to."""
_COUNTERS = ("epoch", SCAN)
"""Channels that number the files of a joined cloud."""


@dataclass(frozen=True)
class PointCloud:
    """Points with the values recorded for each.

    Attributes
    ----------
    points : (n, 3) float64, m, in the file's own frame.
    intensity : (n,) relative received power.
    gps_time : (n,) float64, s.
    extra : (n,) channels by name, such as `true_range_m` or `pixel_x`, in the file's order.
    notes : What the reader left out, converted or guessed.
    stated_units : Unit of the points that the file states, if they are not yet in metres.
    """

    points: FloatArray
    intensity: NDArray[Any] | None = None
    gps_time: FloatArray | None = None
    extra: dict[str, NDArray[Any]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    stated_units: AxisUnits | None = None

    def part(self, rows: NDArray[Any]) -> PointCloud:
        """Return a cloud of some of the points. rows: a mask or indices."""
        return replace(
            self,
            points=self.points[rows],
            intensity=None if self.intensity is None else self.intensity[rows],
            gps_time=None if self.gps_time is None else self.gps_time[rows],
            extra={name: values[rows] for name, values in self.extra.items()},
        )

    def noted(self, *notes: str) -> PointCloud:
        """Return the cloud with further notes on what a reader left out, converted or guessed."""
        return replace(self, notes=(*self.notes, *notes))


def joined(clouds: list[PointCloud], counted: str) -> PointCloud:
    """Join the point clouds of several files into one, with the channels that all have.

    counted: name of a new channel with the number of the file, from 0; a channel of that name in the files is replaced.
    """
    if len(clouds) == 1:
        return replace(clouds[0], extra={name: values for name, values in clouds[0].extra.items() if name not in _COUNTERS})
    shared = set.intersection(*(set(cloud.extra) for cloud in clouds))
    columns: dict[str, Any] = {}
    for name in ("intensity", "gps_time"):
        parts = [getattr(cloud, name) for cloud in clouds]
        columns[name] = None if any(part is None for part in parts) else np.concatenate(parts)
    extra = {name: np.concatenate([cloud.extra[name] for cloud in clouds]) for name in sorted(shared - set(_COUNTERS))}
    extra[counted] = np.repeat(np.arange(len(clouds)), [len(cloud.points) for cloud in clouds])
    return PointCloud(np.concatenate([cloud.points for cloud in clouds]), extra=extra, **columns)
