"""Simulate a laser scan of a workshop in closed form, with NumPy only.

It has floor, walls, a box, a ball and pipes, curved and with edges.
"""

from __future__ import annotations

from typing import Any

import numpy as np

Array = np.ndarray[Any, np.dtype[np.float64]]
BEAM_RAD = 2.5e-4
NOISE_M = 0.0023


def rays(azimuth: Array, zenith: Array) -> Array:
    """(n, 3) unit directions."""
    return np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=1)


def ranges(ray: Array) -> Array:
    """Return the (n,) distance of what each ray from the origin meets first, m."""
    with np.errstate(all="ignore"):
        planes = [-1.6 / ray[:, 2], 3.2 / ray[:, 2], 9.0 / ray[:, 1], -6.0 / ray[:, 0], 7.0 / ray[:, 0]]
        pipes = [_pipe(ray, (-2.8, 7.0), 0.45), _pipe(ray, (4.2, 7.5), 0.6), _pipe(ray, (1.6, 5.0), 0.12)]
        found = np.stack([*planes, _box(ray, (-2.0, 4.0, -1.6), (-0.8, 5.2, 0.4)), _ball(ray, (0.2, 6.0, -0.9), 0.7), *pipes])
    return np.asarray(np.where(found > 0.5, found, np.inf).min(axis=0))


def _box(ray: Array, low: tuple[float, ...], high: tuple[float, ...]) -> Array:
    ends = np.stack([np.array(low) / ray, np.array(high) / ray])
    near, far = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
    return np.where(near < far, near, np.inf)


def _ball(ray: Array, middle: tuple[float, ...], radius_m: float) -> Array:
    along = ray @ np.array(middle)
    return np.asarray(along - np.sqrt(along**2 - np.dot(middle, middle) + radius_m**2))


def _pipe(ray: Array, middle: tuple[float, float], radius_m: float) -> Array:
    """Return the distance to an upright pipe with its axis at x and y."""
    flat, along = np.sum(ray[:, :2] ** 2, axis=1), ray[:, :2] @ np.array(middle)
    return np.asarray((along - np.sqrt(along**2 - flat * (np.dot(middle, middle) - radius_m**2))) / flat)


def scan(step_deg: float, seed: int = 1, noise_m: float = NOISE_M) -> tuple[Array, Array]:
    """Return points (n, 3) in the scanner's frame, m, line after line, and the number (n,) of each point's line.

    At an edge, the range is the mean over seven rays, as for mixed points; one pulse in a hundred is lost.
    """
    rng = np.random.default_rng(seed)
    azimuth, zenith = np.radians(np.arange(35.0, 145.0, step_deg)), np.radians(np.arange(45.0, 125.0, step_deg))
    line, pulse = (each.ravel() for each in np.indices((len(azimuth), len(zenith))))
    angles = azimuth[line], zenith[pulse]
    turn = np.arange(6) * np.pi / 3
    beside = [(BEAM_RAD * np.cos(each) / np.sin(angles[1]), BEAM_RAD * np.sin(each)) for each in turn]
    seen = np.stack([ranges(rays(angles[0] + a, angles[1] + z)) for a, z in [(0.0, 0.0), *beside]])
    measured = np.where(np.ptp(seen, axis=0) > 0.02, seen.mean(axis=0), seen[0]) + noise_m * rng.standard_normal(len(line))
    kept = rng.random(len(line)) > 0.01
    return (measured[:, None] * rays(*angles))[kept], line[kept].astype(np.float64)
