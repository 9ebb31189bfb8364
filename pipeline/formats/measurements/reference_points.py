"""Decide whether a measurement's reference is a known surface, or consists of points of a scan with their own noise."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.formats.measurements.config import MeasurementConfig
from scene.geometry.mesh import FloatArray
from scene.geometry.point_planes import PointPlanes, estimate_point_noise

_NOTICED = 0.3
"""Noise of the vertices, as a share of that of the ranges, from which it is taken into account."""


@dataclass(frozen=True)
class ReferencePoints:
    """Error of a laser scan's reference surface whose vertices may be measured points with noise.

    Attributes
    ----------
    planes : Planes through the vertices, to which incidence angles refer; None: they refer to the triangles.
    error_m : Standard deviation of each vertex along the rays, m.
    error_is_relief : Whether that error is mostly relief between the vertices, which is independent from ray to ray. Otherwise
        it is noise of the vertices, which rays to the same triangles share.
    words : Notes for the report, if the error was estimated; else empty.
    """

    planes: PointPlanes | None = None
    error_m: float = 0.0
    error_is_relief: bool = False
    words: tuple[str, ...] = ()

    @classmethod
    def of(cls, config: MeasurementConfig, vertices: FloatArray, viewpoint: FloatArray, range_sigma_m: float) -> ReferencePoints:
        """Take the error of the reference from measurement.yaml if it states one, or else estimate it from the vertices.

        Parameters
        ----------
        config : Content of measurement.yaml.
        vertices : (n, 3) vertices of the reference, m.
        viewpoint : (3,) position of the scanner, m, in the same frame.
        range_sigma_m : Range noise of the scanner, m; an estimated error that is small beside it is neglected.
        """
        if config.incidence is not None or config.reference_error_m is not None:
            planes = PointPlanes.of(vertices, viewpoint) if config.incidence == "planes" else None
            relief = planes is not None and not planes.noise_dominates
            if config.reference_error_kind is not None:
                relief = config.reference_error_kind == "relief"
            return cls(planes, config.reference_error_m or 0.0, relief)
        noise = estimate_point_noise(vertices, viewpoint)
        if noise is None or noise < _NOTICED * range_sigma_m:
            return cls()
        words = (
            f"the reference's vertices scatter by {1e3 * noise:.2g} mm, as points of a scan do: that is used as their error "
            "(reference_error_m), and incidence angles refer to planes through them (incidence: planes)"
        )
        return cls(PointPlanes.of(vertices, viewpoint), noise, words=(words,))
