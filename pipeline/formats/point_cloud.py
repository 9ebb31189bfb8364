"""A point cloud as files hold it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from scene.mesh import FloatArray


@dataclass(frozen=True)
class PointCloud:
    """Points with what was recorded or is known of each.

    points: (n, 3) float64, m, in the file's own frame; intensity: (n,) relative received power; gps_time: (n,) float64, s;
    extra: named (n,) channels, such as `true_range_m` or `pixel_x`, in the file's order.
    """

    points: FloatArray
    intensity: NDArray[Any] | None = None
    gps_time: FloatArray | None = None
    extra: dict[str, NDArray[Any]] = field(default_factory=dict)

    def part(self, rows: NDArray[Any]) -> PointCloud:
        """Some of the points, by a mask or indices."""
        return PointCloud(
            points=self.points[rows],
            intensity=None if self.intensity is None else self.intensity[rows],
            gps_time=None if self.gps_time is None else self.gps_time[rows],
            extra={name: values[rows] for name, values in self.extra.items()},
        )
