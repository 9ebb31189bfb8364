"""Convert to a scanner's polar coordinates on the host: azimuth = atan2(y, x), zenith angle from +z.

`pulses.py` does the same on the device.
"""

from __future__ import annotations

import numpy as np

from scene.geometry.mesh import FloatArray


def polar(local: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Convert points (n, 3) in the scanner's frame to range (m), azimuth and zenith angle (rad), each (n,)."""
    level = np.hypot(local[:, 0], local[:, 1])
    return np.hypot(level, local[:, 2]), np.arctan2(local[:, 1], local[:, 0]), np.arctan2(level, local[:, 2])


def polar_axes(azimuth: FloatArray, zenith: FloatArray) -> list[FloatArray]:
    """Return the unit vectors of polar coordinates in the scanner's frame, three arrays (n, 3).

    They point along the beam, towards increasing azimuth and towards increasing zenith angle. azimuth, zenith: (n,) directions
    of the beams, rad.
    """
    sin_az, cos_az, sin_ze, cos_ze = np.sin(azimuth), np.cos(azimuth), np.sin(zenith), np.cos(zenith)
    beam = [sin_ze * cos_az, sin_ze * sin_az, cos_ze]
    columns = [beam, [-sin_az, cos_az, np.zeros_like(azimuth)], [cos_ze * cos_az, cos_ze * sin_az, -sin_ze]]
    return [np.stack(column, axis=1) for column in columns]
