"""Errors of a cloud's points that are given in metres, put on the points that a stereo pair records."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, TriangleMesh
from sensors.effects.base import Effect, Stage, apply_stage
from sensors.signal_chain.surface_places import RecordedPoints, ShapedSurface


def in_metres(effects: Sequence[Effect]) -> list[Effect]:
    """Those that move recorded points, if they do anything."""
    return [effect for effect in effects if effect.stage == Stage.POINT and not effect.is_null]


def shifts(mesh: TriangleMesh, effects: Sequence[Effect], points: FloatArray, random: KeyedRandom) -> FloatArray:
    """(n, 3) by how much effects move what is recorded of true points (n, 3) of a mesh, wall frame, m; 0 where a point is NaN.

    On the host, since they look at each point's neighbourhood on the surface.
    """
    places = ShapedSurface(mesh).near(points)
    moved = apply_stage(effects, Stage.POINT, RecordedPoints(places, np.zeros(len(places))), random)
    return np.nan_to_num(moved.above)[:, None] * places.normal
