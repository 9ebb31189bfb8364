"""Tell whether an epoch was registered at all, and how much of the wall could be compared with it."""

from __future__ import annotations

import numpy as np

from pipeline.monitoring.comparison import EpochChange
from pipeline.monitoring.records import CAUTION
from pipeline.monitoring.significance import NORMAL_95
from pipeline.monitoring.site import ReferenceSite
from pipeline.registration.rigid import RigidTransform
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

_MOST_TURNED_DEG = 20.0
"""Rotation that ICP can find; it returns a larger one where the epochs do not overlap."""
_MOST_MOVED = 0.5
"""Share of the map's longer side by which ICP may move the middle of an epoch."""
_BEYOND_NOISE = 4.0
"""Times the level of detection that the scatter of the points lets expect, from which the registration is doubted."""
_FEW_COMPARED = 0.75
"""Share of the reference's area below which the user is told how little was compared."""
_NO_OVERLAP = 0.25
"""The same share below which a doubtful registration is no result."""


def check_motion(motion: RigidTransform, points: FloatArray, site: ReferenceSite, name: str) -> None:
    """Raise InputError if ICP moved an epoch farther than it can: then it found a place where the rock only looks alike.

    motion: what ICP found, wall frame. points: (n, 3) points of the epoch before it, wall frame, m. name: the epoch's name.
    """
    turned = float(np.degrees(np.linalg.norm(motion.rotation_vector)))
    middle = np.median(points, axis=0)
    moved = float(np.linalg.norm(motion.apply(middle[None])[0] - middle))
    if turned <= _MOST_TURNED_DEG and moved <= _MOST_MOVED * site.grid.gsd * max(site.grid.width, site.grid.height):
        return
    raise InputError(
        f"the epoch could not be registered on {site.source.name}: the best fit of the rock turns it by {turned:.0f} degrees "
        f"and moves it by {moved:.2g} m",
        where=name,
        allowed="epochs that overlap, and are aligned to some metres and degrees",
        remedy="give epochs of the same part of the wall, align them before, or name targets with --targets",
    )


def remarks(found: EpochChange, site: ReferenceSite, name: str) -> list[str]:
    """Return remarks for the user on a registration that may have failed, and on an epoch that covers little of the wall.

    found: the comparison of the epoch with the reference. site: the reference. name: the epoch's name. Raises InputError where
    both are the case: then the epochs hardly overlap.
    """
    told = []
    compared, seen = compared_area(found, site), known_area(site)
    level, expected = (float(np.median(np.concatenate(each))) for each in _levels(found))
    if level > _BEYOND_NOISE * expected and compared < _NO_OVERLAP * seen:
        raise InputError(
            f"the epoch could not be registered on {site.source.name}: only {compared:.0f} m² of its {seen:.0f} m² lie in both, "
            "and do not fit there",
            where=name,
            allowed="epochs that overlap, and are aligned to some metres and degrees",
            remedy="give epochs of the same part of the wall, align them before, or name targets with --targets",
        )
    if level > _BEYOND_NOISE * expected:
        told.append(
            f"{CAUTION}after the registration, the level of detection is {1e3 * level:.1f} mm, where the scatter of the points "
            f"suggests {1e3 * expected:.1f} mm: either the registration failed, or hardly any rock is stable. Check the map for "
            "waves, and help the registration with --stable or --targets"
        )
    if compared < _FEW_COMPARED * seen:
        told.append(
            f"{CAUTION}only {compared:.0f} m² of the reference's {seen:.0f} m² could be compared, as the epoch has no points, or "
            "too few, elsewhere: changes there do not show. A larger --gsd helps where points are few"
        )
    return told


def compared_area(found: EpochChange, site: ReferenceSite) -> float:
    """Return the area of the maps that has data in both epochs, m2."""
    return sum(int(np.isfinite(change.difference).sum()) for change in found.changes) * float(site.grid.gsd**2)


def known_area(site: ReferenceSite) -> float:
    """Return the area of the maps that has data in the reference, m2."""
    return sum(int(view.raster.known.sum()) for view in site.views) * float(site.grid.gsd**2)


def _levels(found: EpochChange) -> tuple[list[FloatArray], list[FloatArray]]:
    """Levels of detection of all pixels with data, by view: as measured, and as the scatter of the points lets expect, m."""
    levels, expected = list[FloatArray](), list[FloatArray]()
    for change in found.changes:
        known = np.isfinite(change.significance.level)
        variance = change.reference.sigma[known] ** 2 + change.epoch.sigma[known] ** 2 + change.registration[known] ** 2
        levels.append(change.significance.level[known].astype(np.float64))
        expected.append(NORMAL_95 * np.sqrt(variance.astype(np.float64)))
    return levels, expected
