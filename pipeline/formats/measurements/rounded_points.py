"""Points whose coordinates a file has rounded, against the noise that the model predicts."""

from __future__ import annotations

import numpy as np

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from scene.meshes.rounding import rounded_axes

_TOLD = 0.1
"""Share of the model's noise from which the error of rounding is told: it adds a hundredth to the variance."""


def check_rounded_points(points: FloatArray, viewpoint: FloatArray, noise_m: float, where: str) -> tuple[str, ...]:
    """What to say of the rounding of `points` (n, 3), finite, seen from `viewpoint` (3,), both m and in the file's frame.

    noise_m: standard deviation along the line of sight that the model predicts. Rounding to steps s errs by s / sqrt(12) along
    each axis; what of it lies along the lines of sight looks like noise of the sensor. Raises InputError where it is larger than
    the noise.
    """
    rounded = rounded_axes(points)
    if not rounded:
        return ()
    sight = points - viewpoint
    sight /= np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-9)
    steps = [next((each.step_m for each in rounded if each.axis == axis), 0.0) for axis in "xyz"]
    error = float(np.sqrt(np.mean(np.sum((sight * steps) ** 2, axis=1)) / 12))
    told = f"the coordinates are rounded, {', '.join(map(str, rounded))}: {1e3 * error:.2g} mm along the lines of sight"
    if error > noise_m:
        raise InputError(
            f"{told}, more than the noise of the sensor that the model has",
            where=where,
            allowed=f"up to {1e3 * noise_m:.2g} mm, less than {1e2 * _TOLD:.0f} % of it is best",
            remedy="export the points in double precision or with more decimals",
        )
    if error < _TOLD * noise_m:
        return ()
    return (f"{told}, where the model has a noise of {1e3 * noise_m:.2g} mm; what is named a noise may be the rounding",)
