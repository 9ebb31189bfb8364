"""What a measurement's reference is made of: a surface that is known, or points of a scan with noise of their own."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.formats.measurements.config import MeasurementConfig
from scene.geometry.mesh import FloatArray
from scene.geometry.point_planes import PointPlanes, estimate_point_noise

_NOTICED = 0.3
"""Noise of the vertices over that of the ranges from which on it is carried along."""


@dataclass(frozen=True)
class ReferencePoints:
    """planes: through the vertices, where rays are inclined to them; error_m: standard deviation of each vertex along the rays;
    words: for the report, where these were not stated but found."""

    planes: PointPlanes | None = None
    error_m: float = 0.0
    words: tuple[str, ...] = ()

    @classmethod
    def of(cls, config: MeasurementConfig, vertices: FloatArray, viewpoint: FloatArray, range_sigma_m: float) -> ReferencePoints:
        """By what measurement.yaml states, else by the vertices (n, 3), m, as seen from the scanner's place (3,)."""
        if config.incidence is not None or config.reference_error_m is not None:
            planes = PointPlanes.of(vertices, viewpoint) if config.incidence == "planes" else None
            return cls(planes, config.reference_error_m or 0.0)
        noise = estimate_point_noise(vertices, viewpoint)
        if noise is None or noise < _NOTICED * range_sigma_m:
            return cls()
        words = (
            f"the reference's vertices scatter by {1e3 * noise:.2g} mm of their own, as a scan's points do: that is carried as "
            "their error (reference_error_m), and rays are inclined to planes through them (incidence: planes)"
        )
        return cls(PointPlanes.of(vertices, viewpoint), noise, (words,))
