"""Rotations and rigid frames. A rotation (3, 3) maps the inner frame to the outer: outer = R @ inner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .surface import Array


def turn(axis: int, angle_rad: float) -> Array:
    """(3, 3) right-handed rotation about axis 0 (x), 1 (y) or 2 (z)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[a, a], matrix[b, b], matrix[a, b], matrix[b, a] = c, c, -s, s
    return matrix


def small_turn(vector_rad: Array) -> Array:
    """(3, 3) rotation by a rotation vector (3,), rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector_rad))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector_rad / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@dataclass(frozen=True)
class Frame:
    """A frame in another: `rotation` (3, 3) and the place of its origin `position` (3,), m."""

    rotation: Array
    position: Array

    def outward(self, points: Array) -> Array:
        """(n, 3) points of this frame in the outer one, m."""
        return points @ self.rotation.T + self.position

    def inward(self, points: Array) -> Array:
        """(n, 3) points of the outer frame in this one, m."""
        return (points - self.position) @ self.rotation

    def of(self, outer: Frame) -> Frame:
        """Return this frame, given in the frame `outer`, as seen from where `outer` is given."""
        return Frame(outer.rotation @ self.rotation, outer.outward(self.position))

    def within(self, outer: Frame) -> Frame:
        """Return this frame as seen from inside `outer`, both being given in the same frame."""
        return Frame(outer.rotation.T @ self.rotation, outer.inward(self.position))
