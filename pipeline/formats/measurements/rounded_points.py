"""Compare the rounding of coordinates in a file with the noise that the model predicts."""

from __future__ import annotations

import numpy as np

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from scene.meshes.rounding import rounded_axes

_TOLD = 0.1
"""Rounding error, as a share of the model's noise, from which it is reported; it then adds 1 % to the variance."""


def check_rounded_points(points: FloatArray, viewpoint: FloatArray, noise_m: float, where: str) -> tuple[str, ...]:
    """Check whether the rounding of coordinates in a file disturbs the measured noise; return a note if it matters.

    Rounding to steps s has an error of s / sqrt(12) along each axis; its component along the line of sight looks like sensor
    noise.

    Parameters
    ----------
    points : (n, 3) finite points, m, in the file's frame.
    viewpoint : (3,) position of the sensor, m, in the same frame.
    noise_m : Standard deviation along the line of sight that the model predicts, m.
    where : Name of the file, for errors.

    Raises
    ------
    InputError
        If the rounding error is larger than the noise.
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
            f"{told}, more than the sensor noise in the model",
            where=where,
            allowed=f"up to {1e3 * noise_m:.2g} mm, best less than {1e2 * _TOLD:.0f} % of it",
            remedy="export the points in double precision or with more decimals",
        )
    if error < _TOLD * noise_m:
        return ()
    return (f"{told}, and the model has a noise of {1e3 * noise_m:.2g} mm; an effect named as noise may be the rounding",)
