"""Draw how raw files were interpreted: the set-up from above, and the scan as seen from the scanner."""

from __future__ import annotations

import numpy as np
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from pipeline.report.figures import FAMILY, SEQUENTIAL, label_axes, png_bytes
from scene.geometry.mesh import FloatArray, TriangleMesh
from sensors.signal_chain.polar import polar

_DOTS = 15_000
"""Number of points drawn."""


def picture(
    points: FloatArray,
    mesh: TriangleMesh,
    position: FloatArray,
    rotation: FloatArray,
    title: str,
    *,
    sensor: bool = True,
) -> bytes:
    """Draw measured points and reference surface, from above and from the sensor, as PNG: the user checks the set-up with it.

    Parameters
    ----------
    points : (n, 3) measured points, m.
    mesh : Reference surface, in the frame of the points.
    position : (3,) position of the sensor, in the frame of the points, m.
    rotation : (3, 3) rotation from the sensor's frame (z up) to the frame of the points.
    title : Title of the picture.
    sensor : Whether a sensor is at that position; otherwise it is only a place to look from.
    """
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    above, seen = figure.subplots(1, 2)
    origin = np.floor(position / 1000) * 1000 if np.abs(position).max() > 1e4 else np.zeros(3)
    few, known = (each[:: max(len(each) // _DOTS, 1)] - origin for each in (points, mesh.vertices))
    here = position - origin
    above.scatter(*known[:, :2].T, s=0.5, color="#b5b5b5", linewidths=0, label="reference")
    above.scatter(*few[:, :2].T, s=0.5, color=FAMILY[0], linewidths=0, label="scan" if sensor else "cloud")
    if sensor:
        above.plot(here[0], here[1], marker="*", markersize=13, color=FAMILY[1], linestyle="none", label="sensor")
        _fan(above, few, here)
    above.set_aspect("equal", adjustable="datalim")
    shift = "" if not origin.any() else f" less {origin[0]:,.0f}", f" less {origin[1]:,.0f}" if origin.any() else ""
    label_axes(above, f"x{shift[0]}, m", f"y{shift[1]}, m")
    above.set_title("from above")
    for handle in above.legend(loc="best", fontsize=8).legend_handles:
        if isinstance(handle, PathCollection):
            handle.set_sizes([16])  # the dots are too small to show their colours
    distance, azimuth, zenith = polar(np.einsum("ij,ni->nj", rotation, few - here))
    middle = float(np.angle(np.mean(np.exp(1j * azimuth))))
    azimuth = middle + np.angle(np.exp(1j * (azimuth - middle)))
    dots = seen.scatter(np.degrees(azimuth), np.degrees(zenith), c=distance, s=0.8, cmap=SEQUENTIAL, linewidths=0)
    seen.invert_yaxis()
    label_axes(seen, "azimuth, degrees", "zenith angle, degrees")
    seen.set_title("as the sensor sees it" if sensor else "seen from in front of the wall")
    figure.colorbar(dots, ax=seen, label="range, m" if sensor else "distance from there, m")
    figure.suptitle(title)
    return png_bytes(figure)


def _fan(axes: object, points: FloatArray, here: FloatArray) -> None:
    """Draw the edges of the field of view from above, unless it is a full circle."""
    angle = np.sort(np.arctan2(points[:, 1] - here[1], points[:, 0] - here[0]))
    gaps = np.diff(angle, append=angle[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    if gaps[widest] < np.pi / 6:
        return
    reach = float(np.quantile(np.linalg.norm(points[:, :2] - here[:2], axis=1), 0.9))
    for edge in (angle[widest], angle[(widest + 1) % len(angle)]):
        end = here[:2] + reach * np.array([np.cos(edge), np.sin(edge)])
        axes.plot([here[0], end[0]], [here[1], end[1]], color=FAMILY[1], linewidth=0.8)  # type: ignore[attr-defined]
