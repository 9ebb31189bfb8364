"""Coordinate systems of the survey, as the config names them."""

from __future__ import annotations

from scene.common.errors import InputError


def wkt_of(name: str, where: str) -> str:
    """Return the WKT (version 1, as LAS files have it) of a projected coordinate system in metres.

    name: such as EPSG:28356. where: which key of the config has the name, for errors. Raises InputError if it is unknown or not
    in metres.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        crs = CRS.from_user_input(name)
    except (CRSError, UnicodeError) as error:
        problem = f"the coordinate system is not understood: {name!r:.60} ({' '.join(str(error).split())[:100]})"
        raise InputError(
            problem,
            where=where,
            allowed="an EPSG code such as EPSG:28356, or WKT",
            remedy="correct the code, or leave the key out",
        ) from None
    if any(axis.unit_conversion_factor != 1 or "degree" in axis.unit_name for axis in crs.axis_info):
        problem = f"the coordinate system '{crs.name}' has the unit {crs.axis_info[0].unit_name}"
        raise InputError(
            problem,
            where=where,
            allowed="a projected coordinate system in metres",
            remedy="name the system in which the coordinates are eastings and northings in metres",
        )
    return str(crs.to_wkt("WKT1_GDAL"))
