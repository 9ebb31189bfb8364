"""Poses in geocentric coordinates, as Metashape keeps them, taken to the projected coordinates of the survey.

The geocentric axes are those of the projection's own datum, so that no datum is changed: a point goes to longitude, latitude and
ellipsoidal height (PROJ's `cart`), and these through the projection. An attitude is turned by the projection's Jacobian at the
camera, of which the rotation is kept. A projection stretches the plane (UTM: by -4e-4 to 1e-3) and not the heights: poses and
surfaces in projected coordinates agree with one another to that share of their distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

_EARTH_M = 6.3e6, 6.45e6
"""How far from the earth's centre cameras on and above its surface stand."""
_STEP_M = 10.0
"""Over which the Jacobian's differences are taken."""
_REMEDY = "in Metashape convert the chunk's reference to a projected or local coordinate system in metres and export anew"


def is_geocentric(position: FloatArray) -> bool:
    """Whether a position (3,), m, is that of a camera near the earth's surface, counted from the earth's centre."""
    return bool(_EARTH_M[0] < np.linalg.norm(position) < _EARTH_M[1])


@dataclass(frozen=True)
class Projection:
    """A projected coordinate system. text: in WKT, or as PROJ writes it; where: for errors."""

    text: str
    where: str

    def pose(self, matrix: FloatArray) -> FloatArray:
        """(4, 4) camera to easting, northing, ellipsoidal height, of one to geocentric; a scale stays."""
        position = matrix[:3, 3]
        shifted = position + _STEP_M * np.concatenate([np.eye(3), -np.eye(3)])
        projected = self.project(np.vstack([position, shifted]))
        left, _, right = np.linalg.svd((projected[1:4] - projected[4:]).T)
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = left @ right @ matrix[:3, :3], projected[0]
        return result

    def project(self, points: FloatArray) -> FloatArray:
        """(n, 3) easting, northing, ellipsoidal height of geocentric points (n, 3), m."""
        crs = self._crs
        from pyproj import Proj, Transformer

        ellipsoid = f"+a={crs.ellipsoid.semi_major_metre!r} +b={crs.ellipsoid.semi_minor_metre!r}"
        degrees = "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
        geodetic = Transformer.from_pipeline(f"+proj=pipeline +step +inv +proj=cart {ellipsoid} {degrees}")
        longitude, latitude, height = geodetic.transform(*points.T)
        return np.stack([*Proj(crs)(longitude, latitude), height], axis=1)

    @cached_property
    def _crs(self) -> Any:
        from pyproj import CRS
        from pyproj.exceptions import CRSError

        try:
            crs = CRS.from_user_input(self.text)
        except (CRSError, UnicodeError) as error:
            problem = f"names a coordinate system that is not understood ({' '.join(str(error).split())[:100]})"
            raise InputError(problem, where=self.where, remedy=_REMEDY) from None
        self._check(crs)
        return crs.sub_crs_list[0] if crs.is_compound else crs

    def _check(self, crs: Any) -> None:
        plane, *vertical = crs.sub_crs_list if crs.is_compound else [crs]
        problem = ""
        if not plane.is_projected:
            problem = f"holds poses in geocentric coordinates, and its coordinate system '{crs.name}' has no plane"
        elif any(axis.unit_conversion_factor != 1 for axis in plane.axis_info):
            problem = f"has the coordinate system '{crs.name}', whose unit is {plane.axis_info[0].unit_name}"
        elif any("ellipsoid" not in each.to_wkt().lower().split("cs[")[0] for each in vertical):
            problem = f"has the coordinate system '{crs.name}' with heights above a geoid, which poses in the file are not"
        if problem:
            raise InputError(problem, where=self.where, allowed="a projected coordinate system, m", remedy=_REMEDY)
