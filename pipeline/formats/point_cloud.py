"""A point cloud as files hold it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.units import AxisUnits
from scene.geometry.mesh import FloatArray

SCAN = "scan"
"""Channel of points: the number of the scan, of several."""
_COUNTERS = ("epoch", SCAN)


@dataclass(frozen=True)
class PointCloud:
    """Points with what was recorded or is known of each.

    points: (n, 3) float64, m, in the file's own frame; intensity: (n,) relative received power; gps_time: (n,) float64, s;
    extra: named (n,) channels, such as `true_range_m` or `pixel_x`, in the file's order; notes: what the reader left out,
    converted or guessed; stated_units: of the points as yet, where the file states one and they are not in metres already.
    """

    points: FloatArray
    intensity: NDArray[Any] | None = None
    gps_time: FloatArray | None = None
    extra: dict[str, NDArray[Any]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    stated_units: AxisUnits | None = None

    def part(self, rows: NDArray[Any]) -> PointCloud:
        """Some of the points, by a mask or indices."""
        return replace(
            self,
            points=self.points[rows],
            intensity=None if self.intensity is None else self.intensity[rows],
            gps_time=None if self.gps_time is None else self.gps_time[rows],
            extra={name: values[rows] for name, values in self.extra.items()},
        )

    def noted(self, *notes: str) -> PointCloud:
        """The cloud with further notes."""
        return replace(self, notes=(*self.notes, *notes))


def joined(clouds: list[PointCloud], counted: str) -> PointCloud:
    """One cloud of all files, with the channels that all have; a channel `counted` counts the files, whatever a file calls so."""
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
