"""Render a wall as a camera in front of it sees it, for slides and frames of animations."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.report.figures import COLOURS, NO_DATA
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster

_FROM = np.array([-0.42, -0.12, 1.0])
"""Direction towards the camera, wall frame: from the left, slightly from below."""
_LIGHT = np.array([-0.45, 0.55, 0.7])
"""Direction towards the light, wall frame."""
_HALF_VIEW = np.tan(np.radians(16.0))
"""Tangent of half the horizontal field of view; a long lens keeps the wall's lines straight."""
_MARGIN = 1.04
"""Width of the picture relative to what it shows."""
_TALLEST = 3.0
"""Largest ratio of height to width: a picture of a vertical line of points would take gigabytes."""
_LEAST_SHARE = 1e-3
"""Smallest extent across the line of sight, as a share of that along it, and smallest distance of the camera from any place."""
_OVERSAMPLED = 2
"""Rays per pixel along a row or a column."""
_PLACES = 200_000
"""If there are more places than this, the camera is fitted to a subsample of about this size."""
_ROCK = np.array([0.80, 0.77, 0.73])
_DARKEST = 0.25
"""Brightness of surfaces that face away from the light."""
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class PerspectiveView:
    """A perspective view of a wall for pictures: position, direction and size of an imagined camera.

    Attributes
    ----------
    position : (3,) array
        Perspective centre, wall frame, m.
    axes : (3, 3) array
        Rows are right, down and forward.
    width, height : int
        Size of the picture, px.
    focal_px : float
        Principal distance, px.
    """

    position: FloatArray
    axes: FloatArray
    width: int
    height: int
    focal_px: float

    @classmethod
    def on(cls, places: FloatArray, width: int = 1280) -> PerspectiveView:
        """Place the camera so that a wall is just in its picture.

        places: (n, 3) points that must be in it, wall frame, m. width: of the picture, px; it is at most three times as high as
        wide. Raises InputError if the places are one point or lie on one line of sight.
        """
        forward = -_FROM / np.linalg.norm(_FROM)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(forward, right), forward])
        own = places[:: max(1, len(places) // _PLACES)] @ axes.T
        middle = (own.min(axis=0) + own.max(axis=0)) / 2
        across, down = _MARGIN * np.abs(own - middle)[:, :2].T
        ahead = own[:, 2] - middle[2]
        needed = np.maximum(across, down / _TALLEST) / _HALF_VIEW
        if needed.max() <= _LEAST_SHARE * np.ptp(own[:, 2]):
            raise InputError(
                "all points of the surface lie on one line of sight, so no picture of the wall can be drawn",
                where="export",
                remedy="make the run again with scarpsim simulate, in another folder: the file of its surface is damaged",
            )
        distance = float((np.maximum(needed, _LEAST_SHARE * needed.max()) - ahead).max())
        focal_px = width / 2 / _HALF_VIEW
        height = 2 * int(np.ceil(float((down / (distance + ahead)).max()) * focal_px))
        return cls(middle @ axes - distance * forward, axes, width, max(height, 2), focal_px)

    def rays(self, times: int) -> FloatArray:
        """Return the directions in which the pixels of the picture look, wall frame, to render it by ray casting.

        times: each pixel is divided into times x times parts, for smooth edges. Returns an array
        (height * width * times^2, 3) with one direction for each part, row by row.
        """
        columns, rows = np.meshgrid(*((np.arange(size * times) + 0.5) / times for size in (self.width, self.height)))
        right, down = columns - self.width / 2, rows - self.height / 2
        own = np.stack([right, down, np.full_like(right, self.focal_px)], axis=-1).reshape(-1, 3) / self.focal_px
        return np.asarray(own @ self.axes)

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where points are in the picture: column and row (n, 2), px from the top-left corner, and their depth (n,), m.

        points: (n, 3), wall frame, m.
        """
        own = (points - self.position) @ self.axes.T
        ahead = own[:, 2]
        place = own[:, :2] / ahead[:, None] * self.focal_px + np.array([self.width, self.height]) / 2
        return place, ahead


def draw_wall(
    view: PerspectiveView, mesh: TriangleMesh, difference: NDArray[np.floating] | None, grid: Grid | None, limit_m: float
) -> Image:
    """Render a mesh in perspective, lit from the upper left, on white: an RGB picture (h, w, 3), 8 bits.

    Parameters
    ----------
    view : PerspectiveView
        The camera.
    mesh : TriangleMesh
        The wall, wall frame, m.
    difference : (h, w) array or None
        Difference map, m, that gives the colours (red where rock is missing, grey without data); None for bare rock.
    grid : Grid or None
        Grid of the map; None without a map.
    limit_m : float
        Difference at which the colour scale ends, m.
    """
    caster, rays = RayCaster(mesh), view.rays(_OVERSAMPLED)
    distance, face = caster.cast(view.position, rays)
    met = face >= 0
    normals = mesh.vertex_normals()[mesh.faces[face[met]]].sum(axis=1)
    lit = normals @ (_LIGHT / np.linalg.norm(_LIGHT)) / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    colour = np.broadcast_to(_ROCK, (int(met.sum()), 3))
    if difference is not None and grid is not None:
        colour = _colours(view.position + distance[met, None] * rays[met], difference, grid, limit_m)
    drawn = np.ones((len(rays), 3))
    drawn[met] = colour * np.clip(_DARKEST + (1 - _DARKEST) * lit, _DARKEST, 1.0)[:, None]
    fine = drawn.reshape(view.height * _OVERSAMPLED, view.width * _OVERSAMPLED, 3).astype(np.float32)
    small = cv2.resize(fine, (view.width, view.height), interpolation=cv2.INTER_AREA)
    return np.asarray(np.round(255 * small), dtype=np.uint8)


def difference_at(places: FloatArray, difference: NDArray[np.floating], grid: Grid) -> NDArray[np.floating]:
    """Look up a difference map at places on the wall; returns (n,) values, m, NaN outside the map.

    places: (n, 2 or 3) x, y (and z), wall frame, m. difference: (h, w) map, m. grid: its pixels.
    """
    columns, rows = np.floor(grid.columns(places[:, 0])).astype(int), np.floor(grid.rows(places[:, 1])).astype(int)
    inside = (columns >= 0) & (columns < grid.width) & (rows >= 0) & (rows < grid.height)
    values = np.full(len(places), np.nan)
    values[inside] = difference[rows[inside], columns[inside]]
    return values


def colours_of(values: NDArray[np.floating], limit_m: float) -> NDArray[np.uint8]:
    """Return the RGBA colours (n, 4) of differences, as in the reports' maps.

    values: (n,) differences, m. limit_m: difference at which the colour scale ends, m.
    """
    return np.asarray(COLOURS.with_extremes(bad=NO_DATA)((values / limit_m + 1) / 2, bytes=True))


def _colours(places: FloatArray, difference: NDArray[np.floating], grid: Grid, limit_m: float) -> FloatArray:
    """Return the colours (n, 3) of places."""
    return np.asarray(colours_of(difference_at(places, difference, grid), limit_m)[:, :3] / 255.0)
