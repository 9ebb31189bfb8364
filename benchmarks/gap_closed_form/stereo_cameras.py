"""Frame cameras in Metashape's model, brute-force projection, and triangulation by nominal cameras (EFFECTS.md, CONTRACT.md)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks.gap_closed_form.casting import Array, Surface
from benchmarks.gap_closed_form.walls import turn

INTERIOR = ("f_px", "cx_px", "cy_px", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
_UNDISTORTIONS = 25
_BLIND_M = 0.04
"""A point is visible if the ray towards it meets the surface at most this far in front of it, m."""


@dataclass(frozen=True)
class Frame:
    """A camera: interior orientation by Metashape's names, position (3,), rotation (3, 3) camera to the frame of `position`."""

    width: int
    height: int
    interior: dict[str, float]
    position: Array
    rotation: Array

    def changed(self, **more: float) -> Frame:
        """With values added to the interior orientation."""
        return replace(self, interior={key: value + more.get(key, 0.0) for key, value in self.interior.items()})

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels of points (n, 3)."""
        local = (points - self.position) @ self.rotation
        i = self.interior
        x, y = self._distorted(local[:, 0] / local[:, 2], local[:, 1] / local[:, 2])
        u = self.width / 2 + i["cx_px"] + x * (i["f_px"] + i["b1"]) + y * i["b2"]
        return u, self.height / 2 + i["cy_px"] + y * i["f_px"]

    def rays(self, u: Array, v: Array) -> Array:
        """(n, 3) directions of pixels, 1 along the camera's axis; the distortion inverted by fixed-point steps."""
        i = self.interior
        y_seen = (v - self.height / 2 - i["cy_px"]) / i["f_px"]
        x_seen = (u - self.width / 2 - i["cx_px"] - y_seen * i["b2"]) / (i["f_px"] + i["b1"])
        x, y = x_seen, y_seen
        for _ in range(_UNDISTORTIONS):
            found = self._distorted(x, y)
            x, y = x + x_seen - found[0], y + y_seen - found[1]
        return np.stack([x, y, np.ones_like(x)], axis=1) @ self.rotation.T

    def _distorted(self, x: Array, y: Array) -> tuple[Array, Array]:
        i, r2 = self.interior, x * x + y * y
        radial = 1 + r2 * (i["k1"] + r2 * (i["k2"] + r2 * (i["k3"] + r2 * i["k4"])))
        return (
            x * radial + i["p1"] * (r2 + 2 * x * x) + 2 * i["p2"] * x * y,
            y * radial + i["p2"] * (r2 + 2 * y * y) + 2 * i["p1"] * x * y,
        )


@dataclass(frozen=True)
class Jitter:
    """Row jitter dx = amplitude sin(2 pi row / rows + phase), recorded minus ideal column."""

    amplitude: float = 0.0
    rows: float = 1.0
    phase: float = 0.0

    def at(self, row: Array) -> Array:
        """(n,) dx, px."""
        return self.amplitude * np.sin(2 * np.pi * row / self.rows + self.phase)


@dataclass(frozen=True)
class Pair:
    """Two cameras, as they really are or as calibrated."""

    left: Frame
    right: Frame
    jitter: dict[str, Jitter] = field(default_factory=dict)

    def each(self, camera: str, change: Any) -> Pair:
        """Return the pair with `change` applied to left, right or both."""
        sides = ("left", "right") if camera == "both" else (camera,)
        return replace(self, **{side: change(getattr(self, side)) for side in sides})

    def moved(self, shift: Array, rotation: Array) -> Pair:
        """Return the pair moved as one body about the left camera."""
        centre = self.left.position
        return self.each(
            "both",
            lambda c: replace(c, position=centre + rotation @ (c.position - centre) + shift, rotation=rotation @ c.rotation),
        )

    def matches(self, surface: Surface, u: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return where the right camera records what the left one records at (u, v): columns, rows, and the points (n, 3)."""
        still = Jitter()
        ray = self.left.rays(u - self.jitter.get("left", still).at(v), v)
        distance, _ = surface.cast(self.left.position, ray)
        points = self.left.position + distance[:, None] * ray
        u_right, v_right = self.right.project(points)
        return u_right + self.jitter.get("right", still).at(v_right), v_right, points

    def seen_by_right(self, surface: Surface, points: Array) -> Array:
        """(n,) whether nothing stands between the right camera and points on the surface."""
        away = points - self.right.position
        length = np.linalg.norm(away, axis=1)
        distance, _ = surface.cast(self.right.position, away / length[:, None])
        return np.nan_to_num(distance, nan=np.inf) > length - _BLIND_M


@dataclass(frozen=True)
class Rectified:
    """The nominal pair rotated to the normal case: rows to camera axes; d = f (x_left - x_right) = f base / Z."""

    pair: Pair
    f: float

    @property
    def axes(self) -> Array:
        """(3, 3) rows: along the base, down, forward."""
        along = self.pair.right.position - self.pair.left.position
        along = along / np.linalg.norm(along)
        forward = self.pair.left.rotation[:, 2] + self.pair.right.rotation[:, 2]
        forward = forward - along * (along @ forward)
        forward /= np.linalg.norm(forward)
        return np.stack([along, np.cross(forward, along), forward])

    @property
    def base(self) -> float:
        """Length of the base, m."""
        return float(np.linalg.norm(self.pair.right.position - self.pair.left.position))

    def disparity(self, u: Array, v: Array, u_right: Array, v_right: Array) -> Array:
        """(n,) px."""
        columns = []
        for camera, x, y in ((self.pair.left, u, v), (self.pair.right, u_right, v_right)):
            ray = camera.rays(x, y) @ self.axes.T
            columns.append(ray[:, 0] / ray[:, 2])
        return self.f * (columns[0] - columns[1])

    def points(self, u: Array, v: Array, disparity: Array) -> Array:
        """(n, 3) on the rays of the left pixels."""
        ray = self.pair.left.rays(u, v)
        depth = self.f * self.base / disparity
        return self.pair.left.position + ray * (depth / (ray @ self.axes[2]))[:, None]


def looking_at(position: Array, target: Array, roll: float) -> Array:
    """(3, 3) camera to local: z towards the target, x level but for the roll."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1) @ turn(2, roll)
