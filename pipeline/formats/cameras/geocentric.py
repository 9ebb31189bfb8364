"""Convert poses in geocentric coordinates, as Metashape stores them, to the projected coordinates of the survey.

The geocentric axes are those of the projection's own datum, so that the datum does not change. A point is converted to longitude,
latitude and ellipsoidal height (PROJ's `cart`), then projected. An attitude is turned by the rotation in the projection's
Jacobian at the camera. A projection scales the plane (UTM: by -4e-4 to 1e-3) but not the heights; poses and surfaces in projected
coordinates agree with each other to that share of their distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

_EARTH_M = 6.3e6, 6.45e6
"""Range of distances from the Earth's centre of cameras on and above its surface, m."""
_STEP_M = 10.0
"""Step of the finite differences for the Jacobian, m."""
_REMEDY = "in Metashape convert the chunk's reference to a projected or local coordinate system in metres and export anew"


def is_geocentric(position: FloatArray) -> bool:
    """Return whether a camera's position is geocentric (relative to the Earth's centre), so that it has to be projected.

    position: (3,) coordinates, m. They are taken for geocentric if they would then be near the Earth's surface.
    """
    return bool(_EARTH_M[0] < np.linalg.norm(position) < _EARTH_M[1])


@dataclass(frozen=True)
class Projection:
    """A projected coordinate system, to which geocentric camera poses are converted.

    text: the system in WKT or as PROJ writes it; where: name of the file, for errors.
    """

    text: str
    where: str

    def pose(self, matrix: FloatArray) -> FloatArray:
        """Convert a camera's pose from geocentric coordinates to easting, northing and ellipsoidal height of the system.

        matrix: (4, 4) from the camera's frame to geocentric coordinates, m. Returns (4, 4) from the camera's frame to the
        projected coordinates, m. If the matrix has a scale, the result has it too.
        """
        position = matrix[:3, 3]
        shifted = position + _STEP_M * np.concatenate([np.eye(3), -np.eye(3)])
        projected = self.project(np.vstack([position, shifted]))
        left, _, right = np.linalg.svd((projected[1:4] - projected[4:]).T)
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = left @ right @ matrix[:3, :3], projected[0]
        return result

    def project(self, points: FloatArray) -> FloatArray:
        """Return the projected coordinates of geocentric points (n, 3), m.

        They are easting, northing and ellipsoidal height, (n, 3), m.
        """
        crs = self._crs
        from pyproj import Proj, Transformer

        ellipsoid = f"+a={crs.ellipsoid.semi_major_metre!r} +b={crs.ellipsoid.semi_minor_metre!r}"
        degrees = "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
        geodetic = Transformer.from_pipeline(f"+proj=pipeline +step +inv +proj=cart {ellipsoid} {degrees}")
        longitude, latitude, height = geodetic.transform(*points.T)
        return np.stack([*Proj(crs)(longitude, latitude), height], axis=1)

    @cached_property
    def _crs(self) -> Any:
        """The horizontal part of the coordinate system."""
        from pyproj import CRS
        from pyproj.exceptions import CRSError

        try:
            crs = CRS.from_user_input(self.text)
        except (CRSError, UnicodeError) as error:
            raise InputError(
                f"the file names an unknown coordinate system ({' '.join(str(error).split())[:100]})",
                where=self.where,
                remedy=_REMEDY,
            ) from None
        self._check(crs)
        return crs.sub_crs_list[0] if crs.is_compound else crs

    def _check(self, crs: Any) -> None:
        """Raise InputError unless the system is projected, in metres, with ellipsoidal heights."""
        plane, *vertical = crs.sub_crs_list if crs.is_compound else [crs]
        problem = ""
        if not plane.is_projected:
            problem = f"the file has poses in geocentric coordinates, but its coordinate system '{crs.name}' is not projected"
        elif any(axis.unit_conversion_factor != 1 for axis in plane.axis_info):
            problem = f"the file has the coordinate system '{crs.name}', whose unit is {plane.axis_info[0].unit_name}"
        elif any("ellipsoid" not in each.to_wkt().lower().split("cs[")[0] for each in vertical):
            problem = f"the coordinate system '{crs.name}' has heights above a geoid, but the poses have ellipsoidal heights"
        if problem:
            raise InputError(problem, where=self.where, allowed="a projected coordinate system in metres", remedy=_REMEDY)
