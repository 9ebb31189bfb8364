"""Metashape's camera in closed form, and the rectified geometry of a nominal pair.

x = X / Z, y = Y / Z (x right, y down, z forward), r2 = x^2 + y^2;
x' = x (1 + k1 r2 + k2 r4 + k3 r6 + k4 r8) + p1 (r2 + 2 x^2) + 2 p2 x y;  y' = y (same) + p2 (r2 + 2 y^2) + 2 p1 x y;
u = width / 2 + cx + x' f + x' b1 + y' b2;  v = height / 2 + cy + y' f. The centre of the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .frames import Frame
from .surface import Array

LENS = ("f_px", "cx_px", "cy_px", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")


@dataclass(frozen=True)
class Camera:
    """Width, height in px, the numbers of LENS, and the frame (camera to world)."""

    width: int
    height: int
    lens: dict[str, float]
    frame: Frame

    def with_lens(self, **added: float) -> Camera:
        """Return the same camera with something added to parameters of the lens."""
        return replace(self, lens={**self.lens, **{name: self.lens[name] + value for name, value in added.items()}})

    def with_frame(self, frame: Frame) -> Camera:
        """Return the same camera in another frame."""
        return replace(self, frame=frame)

    def distorted(self, x: Array, y: Array) -> tuple[Array, Array]:
        """x', y' of x, y."""
        k, r2 = self.lens, x * x + y * y
        radial = 1 + r2 * (k["k1"] + r2 * (k["k2"] + r2 * (k["k3"] + r2 * k["k4"])))
        return (
            x * radial + k["p1"] * (r2 + 2 * x * x) + 2 * k["p2"] * x * y,
            y * radial + k["p2"] * (r2 + 2 * y * y) + 2 * k["p1"] * x * y,
        )

    def project(self, points: Array) -> Array:
        """(n, 2) pixels u, v of world points (n, 3)."""
        local = self.frame.inward(points)
        x, y = self.distorted(local[:, 0] / local[:, 2], local[:, 1] / local[:, 2])
        u = self.width / 2 + self.lens["cx_px"] + x * (self.lens["f_px"] + self.lens["b1"]) + y * self.lens["b2"]
        return np.stack([u, self.height / 2 + self.lens["cy_px"] + y * self.lens["f_px"]], axis=1)

    def rays(self, pixels: Array) -> Array:
        """(n, 3) directions x, y, 1 in the camera's frame of pixels (n, 2), by fixed-point iteration to 1e-13."""
        wanted_y = (pixels[:, 1] - self.height / 2 - self.lens["cy_px"]) / self.lens["f_px"]
        u = pixels[:, 0] - self.width / 2 - self.lens["cx_px"]
        wanted_x = (u - wanted_y * self.lens["b2"]) / (self.lens["f_px"] + self.lens["b1"])
        x, y = wanted_x, wanted_y
        for _ in range(100):
            got = self.distorted(x, y)
            x, y = x + wanted_x - got[0], y + wanted_y - got[1]
            if max(np.abs(wanted_x - got[0]).max(), np.abs(wanted_y - got[1]).max()) < 1e-13:
                break
        return np.stack([x, y, np.ones_like(x)], axis=1)

    def to_dict(self) -> dict[str, Any]:
        """As cameras.yaml holds it."""
        lens = {name: float(value) for name, value in self.lens.items()}
        pose = {"position_m": self.frame.position.tolist(), "rotation": self.frame.rotation.tolist()}
        return {"width": self.width, "height": self.height, **lens, **pose}


@dataclass(frozen=True)
class Pair:
    """A left and a right camera, and the rectified frame between them: x along the base, z as near to both axes as can be."""

    left: Camera
    right: Camera

    @property
    def base(self) -> float:
        """Distance of the perspective centres, m."""
        return float(np.linalg.norm(self.right.frame.position - self.left.frame.position))

    @property
    def focal(self) -> float:
        """Principal distance of the rectified images, px."""
        return 0.5 * (self.left.lens["f_px"] + self.right.lens["f_px"])

    def rectified(self) -> Array:
        """(3, 3) rotation, rectified to world."""
        x = (self.right.frame.position - self.left.frame.position) / self.base
        z = self.left.frame.rotation[:, 2] + self.right.frame.rotation[:, 2]
        z = z - (z @ x) * x
        z = z / np.linalg.norm(z)
        return np.stack([x, np.cross(z, x), z], axis=1)

    def flat(self, camera: Camera, pixels: Array) -> Array:
        """(n, 2) rectified coordinates x, y (in principal distances) of pixels (n, 2) of one camera."""
        rays = camera.rays(pixels) @ camera.frame.rotation.T @ self.rectified()
        return rays[:, :2] / rays[:, 2:]

    def disparity(self, left_pixels: Array, right_pixels: Array) -> Array:
        """(n,) px: rectified x of the left minus that of the right image."""
        return self.focal * (self.flat(self.left, left_pixels)[:, 0] - self.flat(self.right, right_pixels)[:, 0])

    def points(self, left_pixels: Array, disparity: Array) -> Array:
        """(n, 3) world points on the left rays at the depth f B / d."""
        flat = self.flat(self.left, left_pixels)
        local = np.concatenate([flat, np.ones((len(flat), 1))], axis=1) * (self.focal * self.base / disparity)[:, None]
        return self.left.frame.position + local @ self.rectified().T
