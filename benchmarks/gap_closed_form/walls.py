"""Walls as height fields: shape, fallen blocks, the reference's correlated error, and their place in the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.gap_closed_form.casting import Array, Surface

Random = np.random.Generator
_WAVES = 40
_SHORTEST, _LONGEST = 0.7, 2.0


@dataclass(frozen=True)
class Wall:
    """Depth y (m, into the slope) at the nodes of a grid over x (along the wall) and z (up), seen from -y; local frame."""

    spacing: float
    depth: Array

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, m."""
        rows, columns = self.depth.shape
        return (rows - 1) * self.spacing, (columns - 1) * self.spacing

    def nodes(self) -> tuple[Array, Array]:
        """Return x and z of the nodes, each of the grid's shape."""
        rows, columns = self.depth.shape
        x, z = np.meshgrid(self.spacing * np.arange(rows), self.spacing * np.arange(columns), indexing="ij")
        return x, z

    @property
    def vertices(self) -> Array:
        """(v, 3)."""
        x, z = self.nodes()
        return np.stack([x, self.depth, z], axis=-1).reshape(-1, 3)

    @property
    def faces(self) -> Any:
        """(f, 3), their normals to -y."""
        rows, columns = self.depth.shape
        number = np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
        return np.concatenate([np.stack(corner, axis=-1).reshape(-1, 3) for corner in ((a, b, c), (a, c, d))])

    def surface(self) -> Surface:
        """Return the wall for a ray caster."""
        return Surface(self.vertices, self.faces)

    def deeper(self, change: Array) -> Wall:
        """Return the wall with its nodes moved into the slope by `change`, m."""
        return Wall(self.spacing, self.depth + change)


@dataclass(frozen=True)
class Place:
    """Place of the local frame in the world: rotated about the vertical, then shifted."""

    yaw: float
    shift: Array

    @property
    def rotation(self) -> Array:
        """(3, 3) local to world."""
        return turn(2, self.yaw)

    def to_world(self, points: Array) -> Array:
        """Points (n, 3) or (3,)."""
        return points @ self.rotation.T + self.shift


@dataclass(frozen=True)
class Fall:
    """A region that moved. x, z: centre; half: half sides; angle: of the sides; depth: m, positive into the slope."""

    x: float
    z: float
    half: tuple[float, float]
    angle: float
    depth: float
    wedge: float

    def change(self, wall: Wall) -> Array:
        """Change of the depth at the nodes, m."""
        x, z = wall.nodes()
        a = (np.cos(self.angle) * (x - self.x) + np.sin(self.angle) * (z - self.z)) / self.half[0]
        b = (np.cos(self.angle) * (z - self.z) - np.sin(self.angle) * (x - self.x)) / self.half[1]
        return self.depth * (1 + self.wedge * a) * ((np.abs(a) < 1) & (np.abs(b) < 1))

    def world_box(self, wall: Wall, place: Place) -> list[float]:
        """x0, y0, z0, x1, y1, z1 that hold the region, world frame."""
        inside = np.flatnonzero(self.change(wall).ravel())
        points = place.to_world(wall.vertices[inside]) if len(inside) else place.to_world(np.array([[self.x, 0.0, self.z]]))
        return [*points.min(axis=0), *points.max(axis=0)]


def turn(axis: int, angle: float) -> Array:
    """(3, 3) right-handed rotation about an axis."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i], matrix[j, j], matrix[i, j], matrix[j, i] = c, c, -s, s
    return matrix


def small_turn(angles: Array) -> Array:
    """(3, 3) rotation by three small angles."""
    return turn(0, angles[0]) @ turn(1, angles[1]) @ turn(2, angles[2])


def wave_numbers(length: float, count: int, random: Random) -> Array:
    """(count, 2) wave vectors of waves of about one length, in every direction."""
    angle, k = random.uniform(0, 2 * np.pi, count), 2 * np.pi / (length * random.uniform(_SHORTEST, _LONGEST, count))
    return np.stack([k * np.cos(angle), k * np.sin(angle)], axis=1)


def waves(x: Array, z: Array, length: float, random: Random) -> Array:
    """Return a field of standard deviation 1 that is correlated over `length`, m."""
    phase = random.uniform(0, 2 * np.pi, _WAVES)
    total = np.zeros(x.shape)
    for (kx, kz), shift in zip(wave_numbers(length, _WAVES, random), phase, strict=True):
        total += np.sin(kx * x + kz * z + shift)
    return total / np.sqrt(_WAVES / 2)


def draw_wall(random: Random, nodes: int, steps: bool) -> Wall:
    """Draw a wall's size, lean, bend, undulation and, if `steps`, ledges of a few decimetres to more than a metre."""
    width, height = random.uniform(22, 65), random.uniform(12, 38)
    spacing = float(np.sqrt(width * height / nodes))
    wall = Wall(spacing, np.zeros((int(width / spacing) + 1, int(height / spacing) + 1)))
    x, z = wall.nodes()
    depth = random.uniform(0.0, 0.35) * z + random.uniform(-0.06, 0.06) * x + random.uniform(-3, 3) * ((x / width - 0.5) * 2) ** 2
    if random.uniform() < 0.3:  # a corner
        depth = depth + random.uniform(0.2, 0.5) * np.abs(x - random.uniform(0.25, 0.75) * width)
    for length, low, high in ((12.0, 0.2, 0.9), (4.0, 0.05, 0.3), (1.5, 0.0, 0.06)):
        depth = depth + random.uniform(low, high) * waves(x, z, length, random)
    if steps:
        for _ in range(random.integers(1, 4)):
            depth = depth + random.uniform(0.3, 1.5) * (waves(x, z, random.uniform(5, 12), random) > random.uniform(0.3, 1.2))
    return wall.deeper(depth - depth.mean())


def draw_falls(wall: Wall, count: int, random: Random) -> list[Fall]:
    """Draw missing blocks (nine of ten) or deposited debris, away from the wall's border."""
    width, height = wall.size
    found = []
    for _ in range(count):
        half = (random.uniform(0.4, 1.5), random.uniform(0.4, 1.5))
        depth = random.uniform(0.15, 1.2) * (1 if random.uniform() < 0.9 else -1)
        x, z = random.uniform(0.1, 0.9) * width, random.uniform(0.12, 0.88) * height
        found.append(Fall(x, z, half, random.uniform(0, np.pi), depth, random.uniform(-0.6, 0.6)))
    return found


def draw_place(random: Random) -> Place:
    """Draw a place on a map."""
    return Place(random.uniform(-np.pi, np.pi), np.array([*random.uniform(100, 9000, 2), random.uniform(50, 400)]))
