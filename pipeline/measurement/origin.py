"""Find where a scan was taken from, by the geometry of its scan lines.

Seen from the true origin, the angles of recorded points lie on the scanner's grid, because recorded directions are nominal. Seen
from an origin that is off by dp they deviate from it. For a point at range R with unit vectors e_a, e_z in the directions of
rising azimuth and zenith angle z,

    R sin z da = -e_a . dp        R dz = -e_z . dp

Least squares over all points gives dp and its covariance. Further unknowns are what the pattern leaves open: its start and step,
and for a tilted scan its axis and the shape and start of its lines. An initial value without a known pattern comes from points in
the order of measurement: the points of one line lie in a plane through the scanner, and the planes of many lines meet there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.scan_geometry import ScanGeometry, recover_pattern
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, IntArray
from sensors.signal_chain.polar import polar_axes

_SAMPLE = 60_000
"""Number of points used for the least squares."""
_TURNS = 6
"""Largest number of iterations."""
_OFF_GRID = 0.2
"""Scatter of the angles, as a share of the step, above which the points do not lie on a pattern."""
_SHORTEST_LINE, _LONGEST_STEP = 25, 8.0
"""Smallest number of points in a piece of a line, and largest step between them, in median steps."""
_RELIEF = 4.0
"""A piece of a line determines its plane if it is this much wider across the line than out of the plane."""
_HEIGHTS = 41
"""Number of heights tried in each pass."""
_GROUPS = 24
"""Number of groups of neighbouring lines for the covariance."""


@dataclass(frozen=True)
class Origin:
    """Position of a laser scanner, estimated from its points: seen from there, they lie on a regular grid of angles.

    Attributes
    ----------
    position : (3,) position of the scanner, m, in the points' frame.
    sigma_m : (3,) standard deviation of its coordinates, m.
    geometry : Scan lines and angular steps of the points, seen from there.
    """

    position: FloatArray
    sigma_m: FloatArray
    geometry: ScanGeometry


def pattern_from(points: FloatArray, position: FloatArray, rotation: FloatArray) -> ScanGeometry | None:
    """Find the scan lines and angular steps of a laser scan's points, seen from a position.

    Parameters
    ----------
    points : (n, 3) points, m.
    position : (3,) position of the scanner, same frame, m.
    rotation : (3, 3) rotation from the scanner's frame to the points' frame.

    Returns
    -------
    The scan lines and steps; None if, seen from there, the points do not lie on a regular grid of angles.
    """
    try:
        found = recover_pattern(points, position, rotation)
    except InputError:
        return None
    good = found.azimuth_rms < _OFF_GRID * found.lines.step and found.zenith_rms < _OFF_GRID * found.pulses.step
    return found if good else None


def refine_origin(points: FloatArray, position: FloatArray, rotation: FloatArray, geometry: ScanGeometry) -> Origin:
    """Improve the position of a laser scanner by least squares, so that its points lie on a regular grid of angles.

    Parameters
    ----------
    points : (n, 3) points, m.
    position : (3,) approximate position of the scanner, same frame, m.
    rotation : (3, 3) rotation from the scanner's frame to the points' frame.
    geometry : Scan lines and angular steps of the points, seen from the approximate position.

    Returns
    -------
    The improved position, its standard deviation, and the scan lines seen from there.
    """
    for _ in range(_TURNS):
        step, sigma = _step(geometry, rotation)
        if np.all(np.abs(step) <= 0.5 * sigma):
            break
        found = pattern_from(points, position + step, rotation)
        if found is None or _scatter(found) > _scatter(geometry):
            break
        position, geometry = position + step, found
    return Origin(position, _step(geometry, rotation)[1], geometry)


def _scatter(geometry: ScanGeometry) -> float:
    """Return the RMS deviation of the angles from the pattern, rad."""
    return float(np.hypot(geometry.azimuth_rms, geometry.zenith_rms))


def _step(geometry: ScanGeometry, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the (3,) correction of the origin and its (3,) standard deviation, points' frame, m."""
    rows = np.arange(0, len(geometry.range_m), max(len(geometry.range_m) // _SAMPLE, 1))
    rows = rows[geometry.range_m[rows] >= np.median(geometry.range_m) / 2]
    azimuth, zenith, distance = geometry.azimuth[rows], geometry.zenith[rows], geometry.range_m[rows]
    _, along_azimuth, along_zenith = polar_axes(azimuth, zenith)
    level = distance * np.sin(zenith)
    across, down = _pattern_unknowns(geometry, rows)
    design = [-along_azimuth / level[:, None], -along_zenith / distance[:, None]]
    residual = [azimuth - geometry.lines.start - geometry.lines.step * geometry.line[rows], _zenith_residual(geometry, rows)]
    if not geometry.synchronous:
        lean = np.stack([np.cos(azimuth) / np.tan(zenith), np.sin(azimuth) / np.tan(zenith)], axis=1)
        design[0] = np.concatenate([design[0], lean], axis=1)
        design[1] = np.concatenate([design[1], np.stack([-np.sin(azimuth), np.cos(azimuth)], axis=1)], axis=1)
    parts = [_project_out(open_, weight, *pair) for open_, weight, pair in zip(
        (across, down), (level, distance), zip(design, residual, strict=True), strict=True)]  # fmt: skip
    matrix = np.concatenate([part[0] for part in parts])
    value = np.concatenate([part[1] for part in parts])
    normal = np.einsum("ni,nj->ij", matrix, matrix)
    inverse = np.linalg.pinv(normal, rcond=1e-14)
    solution = np.einsum("ij,nj,n->i", inverse, matrix, value)
    covariance = _covariance(matrix, value - matrix @ solution, np.tile(geometry.line[rows], 2), inverse)
    turn = rotation @ geometry.rotation
    place = turn @ covariance[:3, :3] @ turn.T
    return -(turn @ solution[:3]), np.sqrt(np.maximum(np.diag(place), 0))


def _covariance(matrix: FloatArray, left: FloatArray, line: IntArray, inverse: FloatArray) -> FloatArray:
    """Return the covariance of a least-squares solution whose residuals are correlated within groups of neighbouring lines.

    It is the sandwich estimator.

    Parameters
    ----------
    matrix : (n, k) design matrix.
    left : (n,) residuals.
    line : (n,) line of each.
    inverse : (k, k) inverse of the normal matrix.
    """
    group = (line.astype(np.int64) - line.min()) * _GROUPS // (int(np.ptp(line)) + 1)
    score = np.stack([np.bincount(group, column * left, minlength=_GROUPS) for column in matrix.T], axis=1)
    return inverse @ (score.T @ score) @ inverse * (_GROUPS / (_GROUPS - 1))


def _zenith_residual(geometry: ScanGeometry, rows: NDArray[np.int64]) -> FloatArray:
    """Return the (k,) zenith angles minus the grid's; `_pattern_unknowns` has the starts of lines that begin anywhere."""
    return geometry.zenith[rows] - geometry.pulses.start - geometry.pulses.step * geometry.pulse[rows]


def _pattern_unknowns(geometry: ScanGeometry, rows: NDArray[np.int64]) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return the design columns (k,) of the pattern's unknowns in azimuth and in zenith angle.

    The first of the zenith angle's columns is the number of the line if each line has its own start.
    """
    line, pulse, zenith = (each[rows].astype(float) for each in (geometry.line, geometry.pulse, geometry.zenith))
    one = np.ones_like(line)
    if geometry.synchronous:
        return [one, line], [one, pulse]
    return [one, line, zenith - np.pi / 2, 1 / np.sin(zenith), 1 / np.tan(zenith)], [line, pulse]


def _project_out(
    columns: list[FloatArray], weight: FloatArray, design: FloatArray, value: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Project the unknowns of the pattern out of the weighted design and residuals.

    Parameters
    ----------
    columns : (k,) each, from `_pattern_unknowns`.
    weight : (k,) weights.
    design : (k, p) design matrix.
    value : (k,) residuals.
    """
    first, values = columns[0], np.concatenate([design, value[:, None]], axis=1)
    open_ = np.stack(columns[1:], axis=1)
    if np.ptp(first) > 0:  # each line has its own start: subtract the lines' weighted means
        number = np.unique(first, return_inverse=True)[1]
        total = np.bincount(number, weight**2)
        for block in (values, open_):
            for column in block.T:
                column -= (np.bincount(number, weight**2 * column) / total)[number]
    else:
        open_ = np.concatenate([first[:, None], open_], axis=1)
    open_, values = open_ * weight[:, None], values * weight[:, None]
    scale = np.sqrt(np.einsum("ni,ni->i", open_, open_)) + 1e-300
    basis = np.linalg.qr(open_ / scale)[0]
    values = values - basis @ np.einsum("ni,nj->ij", basis, values)
    return values[:, :-1], values[:, -1]


# --- initial value from the order of the points


def origin_from_point_order(points: FloatArray) -> Origin | None:
    """Find the position of a laser scanner from points (n, 3), m, that are in the order of measurement.

    The planes of vertical scan lines meet in the scanner's axis. The height on the axis is where the zenith angles of a line are
    equally spaced. The scanner is assumed to be upright in the points' frame to some degrees.

    Returns None if the lines do not determine the position.
    """
    centre = points.mean(axis=0)
    pieces = _pieces(points - centre)
    planes = _planes(points - centre, pieces)
    if planes is None:
        return None
    place, axis, free = _meeting(*planes)
    if free:
        place = place + _height(points - centre, pieces, place, axis) * axis
    return origin_near(points, centre + place, np.eye(3))


def origin_near(points: FloatArray, position: FloatArray, rotation: FloatArray) -> Origin | None:
    """Find the exact position of a laser scanner near an approximate one, from the regular grid of angles of its points.

    Parameters
    ----------
    points : (n, 3) points, m.
    position : (3,) approximate position of the scanner, same frame, m.
    rotation : (3, 3) rotation from the scanner's frame to the points' frame.

    Returns
    -------
    The position, its standard deviation and the scan lines; None if, seen from the approximate position, the points lie on no
    regular grid of angles.
    """
    some = points[:: max(len(points) // _SAMPLE, 1)] if len(points) > 3 * _SAMPLE else points
    seen = pattern_from(some, position, rotation)
    if seen is None:
        return None
    found = refine_origin(some, position, rotation, seen)
    whole = found.geometry if some is points else pattern_from(points, found.position, rotation)
    return None if whole is None else Origin(found.position, found.sigma_m, whole)


def _pieces(points: FloatArray) -> list[NDArray[np.int64]]:
    """Return the indices of the points in each piece of a line, which has no step back and no wide step."""
    step = np.diff(points, axis=0)
    length = np.linalg.norm(step, axis=1)
    typical = np.median(length[length > 0]) if (length > 0).any() else 1.0
    back = np.einsum("ni,ni->n", step[1:], step[:-1]) < -0.5 * length[1:] * length[:-1]
    cut = length > _LONGEST_STEP * typical
    cut[1:] |= back & (length[1:] > 3 * typical)
    pieces = np.split(np.arange(len(points)), np.flatnonzero(cut) + 1)
    return [piece for piece in pieces if len(piece) >= _SHORTEST_LINE]


def _planes(points: FloatArray, pieces: list[NDArray[np.int64]]) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return normals (k, 3), centres (k, 3) and angular errors (k,) of the planes of line pieces; None for fewer than 8."""
    found = []
    for rows in pieces:
        middle = points[rows].mean(axis=0)
        _, size, axes = np.linalg.svd(points[rows] - middle, full_matrices=False)
        if size[1] > _RELIEF * size[2]:
            found.append((axes[2], middle, size[1], size[2] / np.sqrt(len(rows))))
    if len(found) < 8:
        return None
    normals, middles, width, out = (np.array(each) for each in zip(*found, strict=True))
    out = np.maximum(out, np.median(out)) + 1e-12  # rounding can make a line exactly plane
    return normals, middles, out / width


def _height(points: FloatArray, pieces: list[NDArray[np.int64]], place: FloatArray, axis: FloatArray) -> float:
    """Return the distance along the axis from `place` at which the angular steps of the lines are most equal, m."""
    rows = np.concatenate(pieces)
    same = np.diff(np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])) == 0
    upright = axis if axis[2] >= 0 else -axis
    away = points[rows] - place
    level = np.linalg.norm(away - np.outer(away @ upright, upright), axis=1)
    rise = away @ upright

    def unequal(height: float) -> float:
        step = np.abs(np.diff(np.arctan2(level, rise - height)))[same]
        single = step[step < 1.5 * np.median(step)]
        return float(np.median(np.abs(single - np.median(single))) / np.median(single))

    reach = float(np.median(level))
    centre, width = 0.0, 0.8 * reach
    for _ in range(6):
        heights = np.linspace(centre - width, centre + width, _HEIGHTS)
        centre = float(heights[int(np.argmin([unequal(height) for height in heights]))])
        width *= 4 / _HEIGHTS
    return centre if axis[2] >= 0 else -centre


def _meeting(normals: FloatArray, middles: FloatArray, errors: FloatArray) -> tuple[FloatArray, FloatArray, bool]:
    """Intersect planes robustly.

    Returns
    -------
    The point of intersection, the direction in which it is least certain, and whether it is undetermined in that direction.
    """
    offset = np.einsum("ni,ni->n", normals, middles)
    place, weight = np.zeros(3), 1 / errors**2
    for _ in range(20):
        normal = np.einsum("n,ni,nj->ij", weight, normals, normals)
        values, vectors = np.linalg.eigh(normal)
        place = np.linalg.pinv(normal, rcond=1e-6) @ np.einsum("n,ni,n->i", weight, normals, offset)
        miss = (normals @ place - offset) / (errors * np.linalg.norm(middles - place, axis=1))
        spread = max(1.4826 * float(np.median(np.abs(miss))), 1e-12)
        weight = 1 / (errors * np.linalg.norm(middles - place, axis=1)) ** 2 / (1 + (miss / (2 * spread)) ** 2)
    return place, vectors[:, 0], bool(values[0] < 0.02 * values[1])
