"""Detect coordinates that are probably in millimetres or feet and ask for the unit; nothing is converted unasked."""

from __future__ import annotations

import numpy as np

from scene.common.errors import InputError
from scene.common.lengths import METRES
from scene.geometry.mesh import FloatArray

_WIDEST_M, _SPARSEST_M = 20_000.0, 5.0
"""Largest width of a scan, and largest spacing of points on a wall, m."""
_ALIKE = 1.3
"""Two surfaces are taken for the same wall if their sizes, after conversion, agree to this factor."""


def check_extent(points: FloatArray, where: str, unit: str | None) -> None:
    """Raise InputError if a cloud is so wide (above 20 km) or sparse (5 m between points) that its unit must be wrong.

    Parameters
    ----------
    points : (n, 3) points, m, converted from `unit`.
    where : Name of the file, for errors.
    unit : Unit that the user gave, such as "mm"; None: metres.
    """
    wide, high = np.sort(np.ptp(points, axis=0))[:0:-1]
    apart = float(np.sqrt(wide * high / len(points)))
    if wide > _WIDEST_M or apart > _SPARSEST_M:
        raise InputError(
            f"taken as {unit or 'm'}, the points would be {wide:,.0f} m wide and {apart:.3g} m apart", where=where,
            allowed=f"up to {_WIDEST_M:,.0f} m and {_SPARSEST_M:g} m",
            remedy=f"add --unit mm (or cm, ft, us-ft) if that is the file's unit{_merged(wide, apart)}",
        )  # fmt: skip


def _merged(wide: float, apart: float) -> str:
    """Return the hint that single far points may be the cause."""
    return "; remove single points far away first" if wide > 1e5 and apart < _SPARSEST_M else ""


def check_same_unit(points: FloatArray, surface: FloatArray, where: str, unit: str | None, reference_unit: str | None) -> None:
    """Check that scan and reference have one unit and one coordinate system.

    Parameters
    ----------
    points, surface : (n, 3) measured points and (m, 3) vertices of the reference, m.
    where : Name of the scan's file, for errors.
    unit, reference_unit : Units that the user gave of scan and reference, such as "mm"; None: metres.

    Raises
    ------
    InputError
        If the two would have the same size if one were in another unit, if they lie far apart, or if all points of one
        coincide.
    """
    ends = [np.stack([np.min(each, axis=0), np.max(each, axis=0)]) for each in (points, surface)]
    sizes = [float(np.linalg.norm(each[1] - each[0])) for each in ends]
    if min(sizes) == 0:
        which = "points" if sizes[0] == 0 else "vertices of the reference"
        raise InputError(
            f"all {which} are at the same place", where=where, remedy="export the coordinates again with all their decimals"
        )
    apart = bool((np.minimum(ends[0][1], ends[1][1]) < np.maximum(ends[0][0], ends[1][0])).any())
    for flag, other, ratio, named in (
        ("--unit", unit, sizes[1] / sizes[0], "points"),
        ("--reference-unit", reference_unit, sizes[0] / sizes[1], "reference"),
    ):
        for name, metres in METRES.items():
            factor = metres / METRES[other or "m"]
            if (factor < 0.1 or (apart and factor < 1)) and 1 / _ALIKE < ratio / factor < _ALIKE:
                raise InputError(
                    f"the points span {sizes[0]:.4g} m and the reference {sizes[1]:.4g} m, as if the {named} were in {name}",
                    where=where, remedy=f"if so, add {flag} {_choices(name)}",
                )  # fmt: skip
    away = float(np.linalg.norm(ends[0].mean(axis=0) - ends[1].mean(axis=0)))
    if apart and away > 3 * sum(sizes):
        raise InputError(
            f"the points lie {away:,.0f} m from the reference",
            where=where,
            remedy="export points and reference in one coordinate system in metres",
        )


def _choices(unit: str) -> str:
    """Return the units of about the same length, between which the user must choose."""
    return "ft (international foot) or us-ft (US survey foot)" if unit in ("ft", "us-ft") else unit
