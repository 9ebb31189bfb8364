"""A triangulated height field y = h(x, z) over a vertical plane, and exact ray casting against it, with NumPy only.

Local frame: x along the wall, y out of it (towards the sensors), z up. A step of h over one cell is a ledge, a roof or a joint's
flank, so that a part in front of the part below is an overhang. Each cell is split along its diagonal from (low x, low z).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

Array = np.ndarray[Any, np.dtype[np.float64]]
Mask = np.ndarray[Any, np.dtype[np.bool_]]


@dataclass(frozen=True)
class Hits:
    """What rays met: `distance` (n,) m, inf without a hit; `normal` (n, 3) unit, out of the wall, zero without a hit."""

    distance: Array
    normal: Array

    @property
    def found(self) -> Mask:
        """(n,) whether the ray met the surface."""
        return np.isfinite(self.distance)


@dataclass(frozen=True)
class Surface:
    """Grid lines `x` (a,) and `z` (b,) m, rising; `height` (a, b) m."""

    x: Array
    z: Array
    height: Array

    def with_height(self, height: Array) -> Surface:
        """Return the same grid with other heights (a, b), m."""
        return replace(self, height=height)

    def vertices(self) -> Array:
        """Return the vertices (a b, 3), local frame, m."""
        x, z = np.meshgrid(self.x, self.z, indexing="ij")
        return np.stack([x.ravel(), self.height.ravel(), z.ravel()], axis=1)

    def faces(self) -> np.ndarray[Any, np.dtype[np.int32]]:
        """(2 (a - 1) (b - 1), 3) vertex numbers, counter-clockwise seen from outside (from +y)."""
        index = np.arange(self.height.size, dtype=np.int32).reshape(self.height.shape)
        low, right, up, far = (each.ravel() for each in (index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]))
        return np.concatenate([np.stack([low, far, right], axis=1), np.stack([low, up, far], axis=1)])

    def at(self, i: Any, j: Any, x: Array, z: Array) -> Array:
        """(n,) height of the points x, z in the cells i, j, m."""
        u, w = (x - self.x[i]) / (self.x[i + 1] - self.x[i]), (z - self.z[j]) / (self.z[j + 1] - self.z[j])
        low, right, up, far = self._corners(i, j)
        under = low + u * (right - low) + w * (far - right)
        return np.where(u >= w, under, low + w * (up - low) + u * (far - up))

    def _corners(self, i: Any, j: Any) -> tuple[Array, Array, Array, Array]:
        h = self.height
        return h[i, j], h[i + 1, j], h[i, j + 1], h[i + 1, j + 1]

    def normal(self, i: Any, j: Any, x: Array, z: Array) -> Array:
        """(n, 3) unit normals out of the wall at the points x, z of the cells i, j."""
        wide, tall = self.x[i + 1] - self.x[i], self.z[j + 1] - self.z[j]
        under = (x - self.x[i]) / wide >= (z - self.z[j]) / tall
        low, right, up, far = self._corners(i, j)
        slope_x, slope_z = np.where(under, right - low, far - up) / wide, np.where(under, far - right, up - low) / tall
        normal = np.stack([-slope_x, np.ones_like(slope_x), -slope_z], axis=1)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def cast(self, origin: Array, direction: Array) -> Hits:
        """Return the first hits of rays from `origin` (3,) or (n, 3) along unit `direction` (n, 3), local frame.

        It walks from grid line to grid line. Between two of them, on each side of the diagonal, h is linear along the ray, so
        that a change of sign of y - h is a hit with an exact place.
        """
        origin = np.broadcast_to(origin, direction.shape)
        start, end = self._slab(origin, direction)
        distance, normal = np.full(len(direction), np.inf), np.zeros(direction.shape)
        rays = np.flatnonzero(start < end)
        walk = _Walk(self, origin[rays], direction[rays], start[rays], end[rays])
        while len(rays):
            hit, gone = walk.step()
            distance[rays[hit]], normal[rays[hit]] = walk.found(hit)
            rays = rays[~(hit | gone)]
            walk.keep(~(hit | gone))
        return Hits(distance, normal)

    def _slab(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Return where each ray enters and leaves the surface's bounding box, m along it."""
        low = np.array([self.x[0], self.height.min() - 1e-6, self.z[0]])
        high = np.array([self.x[-1], self.height.max() + 1e-6, self.z[-1]])
        safe = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
        ends = np.stack([(low - origin) / safe, (high - origin) / safe])
        return np.maximum(ends.min(axis=0).max(axis=1), 0.0), ends.max(axis=0).min(axis=1)


class _Walk:
    """Rays on their way over the grid: `near` is the distance reached, m; `above` is y - h there."""

    def __init__(self, surface: Surface, origin: Array, direction: Array, near: Array, end: Array) -> None:
        self.surface, self.origin, self.direction, self.near, self.end = surface, origin, direction, near, end
        point = origin + direction * near[:, None]
        self.i = np.clip(np.searchsorted(surface.x, point[:, 0], side="right") - 1, 0, len(surface.x) - 2)
        self.j = np.clip(np.searchsorted(surface.z, point[:, 2], side="right") - 1, 0, len(surface.z) - 2)
        self.above = self._above(near)
        self.hit_at = near.copy()

    def _above(self, along: Array) -> Array:
        point = self.origin + self.direction * along[:, None]
        return point[:, 1] - self.surface.at(self.i, self.j, point[:, 0], point[:, 2])

    def step(self) -> tuple[Mask, Mask]:
        """Cross one cell; return which rays hit in it, and which left the grid."""
        x, z = self.surface.x, self.surface.z
        to_x = _crossing(self.origin[:, 0], self.direction[:, 0], x[self.i], x[self.i + 1])
        to_z = _crossing(self.origin[:, 2], self.direction[:, 2], z[self.j], z[self.j + 1])
        far = np.maximum(np.minimum(np.minimum(to_x, to_z), self.end), self.near)
        middle = self._diagonal(far)
        at_middle, at_far = self._above(middle), self._above(far)
        early = (self.above > 0) & (at_middle <= 0)
        late = ~early & (at_middle > 0) & (at_far <= 0)
        self.hit_at = np.where(early, _zero(self.near, middle, self.above, at_middle), _zero(middle, far, at_middle, at_far))
        self.cell = self.i.copy(), self.j.copy()
        self.i = self.i + np.where(to_x <= far, np.sign(self.direction[:, 0]), 0).astype(np.int64)
        self.j = self.j + np.where(to_z <= far, np.sign(self.direction[:, 2]), 0).astype(np.int64)
        gone = (far >= self.end) | (self.i < 0) | (self.j < 0) | (self.i > len(x) - 2) | (self.j > len(z) - 2)
        self.near, self.above = far, at_far
        return early | late, gone & ~(early | late)

    def _diagonal(self, far: Array) -> Array:
        """Where between `near` and `far` the ray crosses the cell's diagonal; `far` where it does not."""
        sides = []
        for along in (self.near, far):
            point = self.origin + self.direction * along[:, None]
            u = (point[:, 0] - self.surface.x[self.i]) / (self.surface.x[self.i + 1] - self.surface.x[self.i])
            sides.append(u - (point[:, 2] - self.surface.z[self.j]) / (self.surface.z[self.j + 1] - self.surface.z[self.j]))
        return np.where(sides[0] * sides[1] < 0, _zero(self.near, far, *sides), far)

    def found(self, hit: Mask) -> tuple[Array, Array]:
        """Distance (m,) and normal (m, 3) of the rays that hit in the cell just crossed."""
        point = self.origin[hit] + self.direction[hit] * self.hit_at[hit, None]
        return self.hit_at[hit], self.surface.normal(self.cell[0][hit], self.cell[1][hit], point[:, 0], point[:, 2])

    def keep(self, mask: Mask) -> None:
        """Goes on with some of the rays."""
        for name in ("origin", "direction", "near", "end", "i", "j", "above", "hit_at"):
            setattr(self, name, getattr(self, name)[mask])


def _crossing(origin: Array, direction: Array, low: Array, high: Array) -> Array:
    """Distance at which the ray leaves the interval (low, high) of one coordinate, m."""
    safe = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    return (np.where(safe > 0, high, low) - origin) / safe


def _zero(near: Array, far: Array, at_near: Array, at_far: Array) -> Array:
    """Where a linear function with these two values is zero."""
    change = at_near - at_far
    return near + (far - near) * np.where(change != 0, at_near / np.where(change != 0, change, 1.0), 1.0)
