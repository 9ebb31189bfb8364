"""Units of length that files state, in their coordinate system or in column names, and those of the command line."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from scene.common.errors import InputError
from scene.common.lengths import METRES, US_FOOT_M
from scene.geometry.mesh import FloatArray

_ALIKE = 1e-8
"""Relative difference up to which two factors are the same unit: files state the US survey foot with 9 to 15 digits."""
_NAMES = {1.0: "m", 0.01: "cm", 0.001: "mm", 0.3048: "ft (international foot)", US_FOOT_M: "us-ft (US survey foot)"}
"""Name of each unit, by its length in metres."""
_PROJECT = "project the points to a coordinate system in metres, such as UTM, and export them again"


@dataclass(frozen=True)
class AxisUnits:
    """Unit of the coordinates in a file, as the file states it.

    Attributes
    ----------
    metres
        Length of one unit along x, y and z, m.
    source
        Where the file states it.
    """

    metres: tuple[float, float, float]
    source: str

    @property
    def name(self) -> str:
        """The unit in words, such as "us-ft (US survey foot)"; if the axes differ, one after the other."""
        names = [unit_name(each) for each in self.metres]
        if len(set(names)) == 1:
            return names[0]
        return ", ".join(f"{axis} in {name}" for axis, name in zip("xyz", names, strict=True))

    @property
    def in_metres(self) -> bool:
        """Whether x, y and z are all in metres, so that nothing has to be converted."""
        return all(same_unit(each, 1.0) for each in self.metres)

    def factors(self) -> FloatArray:
        """Return the factors (3,) that convert x, y and z to metres."""
        return np.array(self.metres)


def unit_name(metres: float) -> str:
    """Return the name of a unit of length, for messages. metres: its length, m."""
    return next((name for known, name in _NAMES.items() if same_unit(metres, known)), f"units of {metres:.12g} m")


def same_unit(metres: float, other: float) -> bool:
    """Whether two units of length are the same, although files may write them with different numbers of digits.

    metres, other: their lengths, m.
    """
    return math.isclose(metres, other, rel_tol=_ALIKE)


def agreed_units(stated: AxisUnits | None, given: str | None, where: str, option: str = "--unit") -> AxisUnits:
    """Decide the unit of a file's coordinates from what the file states and what the user gives; metres if neither says.

    Parameters
    ----------
    stated : The file's statement; None: it states nothing.
    given : Name of the unit that the user gives, such as "mm"; None: the user gives nothing.
    where : Name of the file, for errors.
    option : Command-line option that gives the unit, for errors.

    Raises
    ------
    InputError
        If the two contradict each other.
    """
    if stated is None:
        return AxisUnits((METRES[given or "m"],) * 3, option)
    if given is None or all(same_unit(each, METRES[given]) for each in stated.metres):
        return stated
    raise InputError(
        f"the file states its unit, {stated.name}, in {stated.source}, but {option} says {unit_name(METRES[given])}", where=where,
        remedy=f"leave out {option} if the file is right; otherwise export it again with the right unit",
    )  # fmt: skip


def understood_crs(text: str) -> Any:
    """Interpret the name of a coordinate system. text: WKT or a code such as EPSG:2260.

    Returns a pyproj.CRS, or None if PROJ does not understand the text.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        return CRS.from_user_input(text)
    except (CRSError, UnicodeError):
        return None


def not_understood(text: str, where: str) -> str:
    """Return a note for the user that a file's coordinate system is not understood, and that its coordinates are read as metres.

    text: the system as the file states it. where: name of the file, for errors. Raises InputError instead if the text names a
    foot or yard.
    """
    problem = f"the file states a coordinate system that is not understood: '{text:.60}'"
    if word := re.search(r"foot|feet|yard|\bft\b|us-ft", text, re.IGNORECASE):
        raise InputError(
            f"{problem}, which names the unit '{word[0]}'", where=where, remedy="export the file with its EPSG code or valid WKT"
        )
    return f"{problem}; its coordinates are read as metres"


def units_of_crs(crs: Any, where: str) -> AxisUnits | None:
    """Return the unit of projected coordinates in a coordinate system.

    Parameters
    ----------
    crs : A pyproj.CRS.
    where : Name of the file, for errors.

    Returns
    -------
    Units of easting, northing and height; None if the system states none. Without a vertical system, heights have the unit of the
    plane.

    Raises
    ------
    InputError
        If coordinates are in degrees or geocentric, or a unit is not a length.
    """
    plane, *further = [_plain(each) for each in (crs.sub_crs_list if crs.is_compound else [_plain(crs)])]
    if plane.is_geographic:
        problem = f"the file has coordinates in degrees, of the coordinate system '{crs.name}'"
        raise InputError(problem, where=where, allowed="projected coordinates", remedy=_PROJECT)
    if plane.is_geocentric:
        problem = f"the file has coordinates from the Earth's centre, of the coordinate system '{crs.name}', in which z is not up"
        raise InputError(problem, where=where, allowed="projected coordinates", remedy=_PROJECT)
    level = [axis for axis in plane.axis_info if axis.direction not in ("up", "down")]
    upright = [axis for part in (plane, *further) for axis in part.axis_info if axis.direction in ("up", "down")]
    if not level:
        return None
    across, along = (_metres(axis, crs.name, where) for axis in (level[0], level[-1]))
    up = _metres(upright[0], crs.name, where) if upright else across
    return AxisUnits((across, along, up), f"the coordinate system '{crs.name}'")


def metres_of_epsg_unit(code: int) -> float | None:
    """Return the length, m, of a unit by its EPSG code, such as 9003 of the US survey foot.

    None if the code is not a unit of length.
    """
    from pyproj.database import get_units_map

    units = get_units_map(auth_name="EPSG", category="linear", allow_deprecated=True).values()
    factor = next((unit.conv_factor for unit in units if unit.code == str(code)), None)
    return None if factor is None else _exact(factor)


def _plain(crs: Any) -> Any:
    """Return a coordinate system without a transformation to another datum that may be bound to it."""
    return crs.source_crs if crs.is_bound else crs


def _metres(axis: Any, name: str, where: str) -> float:
    """Return the length, m, of one unit of an axis; PROJ gives only the unit's name for local systems."""
    factor = axis.unit_conversion_factor
    if not factor:
        factor = metres_of_word(axis.unit_name)
    if not factor or "degree" in axis.unit_name:
        raise InputError(
            f"the file states the unit '{axis.unit_name}' in the coordinate system '{name}'",
            where=where,
            allowed="a unit of length",
            remedy=_PROJECT,
        )
    return _exact(float(factor))


def _exact(metres: float) -> float:
    """Replace a factor with few digits by the exact one of its unit."""
    return next((known for known in _NAMES if same_unit(metres, known)), metres)


_WORDS = {
    "m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0, "mtr": 1.0, "dm": 0.1, "cm": 0.01, "centimetre": 0.01,
    "centimeter": 0.01, "mm": 0.001, "millimetre": 0.001, "millimeter": 0.001, "km": 1000.0, "kilometre": 1000.0,
    "kilometer": 1000.0, "ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "ift": 0.3048, "internationalfoot": 0.3048,
    "internationalfeet": 0.3048, "usft": US_FOOT_M, "ftus": US_FOOT_M, "ussurveyfoot": US_FOOT_M, "ussurveyfeet": US_FOOT_M,
    "usfoot": US_FOOT_M, "usfeet": US_FOOT_M, "surveyfoot": US_FOOT_M, "surveyfeet": US_FOOT_M, "footus": US_FOOT_M,
    "in": 0.0254, "inch": 0.0254, "yd": 0.9144, "yard": 0.9144,
}  # fmt: skip
"""Length of each unit, m, by the words for it, in lower case without spaces and punctuation."""


def metres_of_word(word: str) -> float | None:
    """Return the length of a unit, m, by a word for it in a file, such as "ft"; None for an unknown word."""
    return _WORDS.get(re.sub(r"[\s._-]+", "", word.lower()))
