"""Apply errors that are given in metres to the points that a stereo pair records."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, TriangleMesh
from sensors.effects.base import Effect, Stage, apply_stage
from sensors.signal_chain.surface_places import RecordedPoints, ShapedSurface


def active_point_effects(effects: Sequence[Effect]) -> list[Effect]:
    """Return the effects that move recorded points and are not null."""
    return [effect for effect in effects if effect.stage == Stage.POINT and not effect.is_null]


def point_shifts(mesh: TriangleMesh, effects: Sequence[Effect], points: FloatArray, random: KeyedRandom) -> FloatArray:
    """Return how far effects move the recorded points, (n, 3), wall frame, m; 0 where a point is NaN.

    This runs on the host, because the effects depend on each point's neighbourhood on the surface.

    Parameters
    ----------
    mesh : TriangleMesh
        The true surface, wall frame.
    effects : sequence of Effect
        Effects on recorded points.
    points : (n, 3) array
        True points on the surface, wall frame, m.
    random : KeyedRandom
        Source of random numbers.
    """
    places = ShapedSurface(mesh).near(points)
    moved = apply_stage(effects, Stage.POINT, RecordedPoints(places, np.zeros(len(places))), random)
    return np.nan_to_num(moved.above)[:, None] * places.normal
