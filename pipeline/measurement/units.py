"""Coordinates that are likely in millimetres or feet are noticed and asked about, never converted unasked."""

from __future__ import annotations

import numpy as np

from scene.common.errors import InputError
from scene.common.lengths import METRES
from scene.geometry.mesh import FloatArray

_WIDEST_M, _SPARSEST_M = 20_000.0, 5.0
"""No scanner's window is wider, and none leaves so much between points of a wall."""
_ALIKE = 1.3
"""Two surfaces whose sizes, once converted, agree to this factor are taken for the same wall."""


def check_extent(points: FloatArray, where: str, unit: str | None) -> None:
    """Raise InputError where a cloud (n, 3), m if it is in `unit` (None: in metres), is wider or sparser than any scan."""
    wide, high = np.sort(np.ptp(points, axis=0))[:0:-1]
    apart = float(np.sqrt(wide * high / len(points)))
    if wide > _WIDEST_M or apart > _SPARSEST_M:
        raise InputError(
            f"taken as {unit or 'm'}, the points would be {wide:,.0f} m wide and {apart:.3g} m apart", where=where,
            allowed=f"up to {_WIDEST_M:,.0f} m and {_SPARSEST_M:g} m",
            remedy=f"say --unit mm (or cm, ft, us-ft) if that is the file's unit{_merged(wide, apart)}",
        )  # fmt: skip


def _merged(wide: float, apart: float) -> str:
    return "; a cloud of single points far away is to be cut first" if wide > 1e5 and apart < _SPARSEST_M else ""


def check_same_unit(points: FloatArray, surface: FloatArray, where: str, unit: str | None, reference_unit: str | None) -> None:
    """Raise InputError where a scan (n, 3) and its reference (m, 3), both m by what was said, are as large as each other in
    another unit, or lie in two coordinate systems."""
    ends = [np.stack([np.min(each, axis=0), np.max(each, axis=0)]) for each in (points, surface)]
    sizes = [float(np.linalg.norm(each[1] - each[0])) for each in ends]
    if min(sizes) == 0:
        which = "points" if sizes[0] == 0 else "vertices of the reference"
        raise InputError(f"all {which} are the same place", where=where, remedy="export it again")
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
                    where=where, remedy=f"say {flag} {_choices(name)} if so",
                )  # fmt: skip
    away = float(np.linalg.norm(ends[0].mean(axis=0) - ends[1].mean(axis=0)))
    if apart and away > 3 * sum(sizes):
        raise InputError(
            f"the points lie {away:,.0f} m from the reference", where=where, remedy="export both in one coordinate system (m)"
        )


def _choices(unit: str) -> str:
    """The units that are as good as one as long, to be chosen by who knows the survey."""
    return "ft (international foot) or us-ft (US survey foot)" if unit in ("ft", "us-ft") else unit
