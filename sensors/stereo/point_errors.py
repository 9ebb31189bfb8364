"""Apply errors that are given in metres to the points that a stereo pair records."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, TriangleMesh
from sensors.effects.base import Effect, Stage, apply_stage
from sensors.signal_chain.surface_places import RecordedPoints, ShapedSurface


def active_point_effects(effects: Sequence[Effect]) -> list[Effect]:
    """Return those effects (errors) that move recorded points and are not off."""
    return [effect for effect in effects if effect.stage == Stage.POINT and not effect.is_null]


def point_shifts(mesh: TriangleMesh, effects: Sequence[Effect], points: FloatArray, random: KeyedRandom) -> FloatArray:
    """Return how far errors in the recorded points themselves move them, (n, 3), wall frame, m; 0 where a point is NaN.

    It is computed with NumPy, because the effects depend on each point's neighbourhood on the surface.

    Parameters
    ----------
    mesh : TriangleMesh
        The true surface, wall frame.
    effects : sequence of Effect
        Errors in the recorded points, such as noise along the surface's normal.
    points : (n, 3) array
        True points on the surface, wall frame, m.
    random : KeyedRandom
        Source of random numbers.
    """
    places = ShapedSurface(mesh).near(points)
    moved = apply_stage(effects, Stage.POINT, RecordedPoints(places, np.zeros(len(places))), random)
    return np.nan_to_num(moved.above)[:, None] * places.normal
