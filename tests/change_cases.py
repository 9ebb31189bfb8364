"""Range residuals of a flat wall from which blocks fell or to which rock was added, in closed form, with NumPy alone.

The scanner stands at the origin, the wall is the plane y = DISTANCE; a block is a box that reaches from the wall backwards (rock
is missing) or forwards (rock came), met by the slab method of a ray and a box (Kay and Kajiya 1986).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

Array = np.ndarray[Any, np.dtype[np.float64]]
DISTANCE, SIGMA = 30.0, 0.003
WIDE, HIGH = 0.57, 0.57


@dataclass(frozen=True)
class Box:
    """A block: its centre x, z and half widths on the wall, and by how much the wall is deeper there, m."""

    x: float
    z: float
    half: tuple[float, float]
    depth: float

    @property
    def volume(self) -> float:
        return 4 * self.half[0] * self.half[1] * abs(self.depth)

    @property
    def bounds(self) -> Array:
        """Lowest and highest corner (2, 3), m."""
        ys = sorted((DISTANCE, DISTANCE + self.depth))
        return np.array(
            [[self.x - self.half[0], ys[0], self.z - self.half[1]], [self.x + self.half[0], ys[1], self.z + self.half[1]]]
        )

    def meets(self, ray: Array, plane: Array) -> Array:
        """Return the range (n,) at which rays end, given the range `plane` to the wall."""
        low, high = (corner / ray for corner in self.bounds)
        enter, leave = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
        if self.depth < 0:
            return np.where(leave > enter, np.minimum(enter, plane), plane)
        inside = (np.abs(plane * ray[:, 0] - self.x) < self.half[0]) & (np.abs(plane * ray[:, 2] - self.z) < self.half[1])
        return np.where(inside, leave, plane)


@dataclass(frozen=True)
class Scan:
    """azimuth, zenith (n,), rad; ray: (n, 3); plane: (n,) range on the wall; clean: (n,) residual without noise, m."""

    azimuth: Array
    zenith: Array
    ray: Array
    plane: Array
    clean: Array
    hits: list[Any] = field(default_factory=list)


def scan(step_rad: float, boxes: list[Box], lost: float, rng: np.random.Generator, stretch: float = 1.0) -> Scan:
    """Return a scan with angular step `step_rad`, `stretch` times as wide in azimuth, of which the share `lost` is lost."""
    azimuth = np.arange(np.pi / 2 - WIDE / 2, np.pi / 2 + WIDE / 2, step_rad * stretch)
    zenith = np.arange(np.pi / 2 - HIGH / 2, np.pi / 2 + HIGH / 2, step_rad)
    az, ze = (grid.ravel() for grid in np.meshgrid(azimuth, zenith, indexing="ij"))
    kept = rng.uniform(size=len(az)) >= lost
    az, ze = az[kept], ze[kept]
    ray = np.stack([np.sin(ze) * np.cos(az), np.sin(ze) * np.sin(az), np.cos(ze)], axis=1)
    ray = np.where(np.abs(ray) < 1e-12, 1e-12, ray)
    plane = DISTANCE / ray[:, 1]
    ranges = [box.meets(ray, plane) - plane for box in boxes]
    clean = np.sum(ranges, axis=0) if boxes else np.zeros(len(az))
    return Scan(az, ze, ray, plane, clean, [np.flatnonzero(np.abs(each) > 1e-9) for each in ranges])


def waves(x: Array, z: Array, length_m: float, rng: np.random.Generator) -> Array:
    """Return an error that is correlated over metres, with standard deviation 1."""
    total = np.zeros_like(x)
    for _ in range(40):
        angle, phase, k = rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi), 2 * np.pi / (length_m * rng.uniform(0.7, 2.5))
        total += np.sin(k * (np.cos(angle) * x + np.sin(angle) * z) + phase)
    return total / np.sqrt(20)


def noise(of: Scan, outliers: float, reference_m: float, rng: np.random.Generator) -> Array:
    """Return errors (n,), m: white noise, an error of the reference correlated over 3 m, and a share of outliers of up
    to metres.
    """
    at = of.plane[:, None] * of.ray
    white = SIGMA * rng.standard_normal(len(at)) + reference_m * waves(at[:, 0], at[:, 2], 3.0, rng)
    wild = rng.uniform(size=len(at)) < outliers
    return np.where(wild, rng.choice([-1, 1], len(at)) * 10 ** rng.uniform(-2, 0.5, len(at)), white)


def draw_boxes(count: int, half_m: tuple[float, float], depth_m: tuple[float, float], rng: np.random.Generator) -> list[Box]:
    """Draw blocks clearly apart, some of missing and some of added rock."""
    found: list[Box] = []
    while len(found) < count:
        x, z = rng.uniform(-0.42, 0.42, 2) * DISTANCE * (WIDE, HIGH)
        if all(max(abs(x - other.x), abs(z - other.z)) > 2.2 * half_m[1] + 1.0 for other in found):
            half = (rng.uniform(*half_m), rng.uniform(*half_m))
            found.append(Box(x, z, half, rng.choice([-1, 1]) * rng.uniform(*depth_m)))
    return found
