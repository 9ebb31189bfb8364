"""Where a scan was taken from, by the geometry of its own lines.

About the true origin the angles of recorded points lie on the scanner's grid (recorded directions are nominal, whatever the beam
did). About an origin that is off by dp they depart from it: for a point at range R with unit vectors e_a, e_z towards rising
azimuth and zenith angle

    R sin z da = -e_a . dp        R dz = -e_z . dp

Least squares over all points, with what the pattern leaves open as further unknowns (its start and step, of a tilted scan the
axis and the shape and start of its lines), give dp and its covariance. A first guess without any pattern comes from points in the
order in which they were taken: those of one line lie in a plane through the scanner, and the planes of many lines meet there.
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
_TURNS = 6
_OFF_GRID = 0.2
"""Share of a step: a pattern whose angles scatter more about it is none."""
_SHORTEST_LINE, _LONGEST_STEP = 25, 8.0
"""Points of a piece of a line, and the step between its points, in median ones."""
_RELIEF = 4.0
"""A piece of a line shows its plane where it is so many times wider across the line than out of the plane."""
_HEIGHTS = 41
_GROUPS = 24


@dataclass(frozen=True)
class Origin:
    """position: (3,) m, in the points' frame; sigma_m: (3,) its standard deviation; geometry: the pattern seen from there."""

    position: FloatArray
    sigma_m: FloatArray
    geometry: ScanGeometry


def pattern_from(points: FloatArray, position: FloatArray, rotation: FloatArray) -> ScanGeometry | None:
    """The pattern of points (n, 3) seen from a place, None where they lie on none from there."""
    try:
        found = recover_pattern(points, position, rotation)
    except InputError:
        return None
    good = found.azimuth_rms < _OFF_GRID * found.lines.step and found.zenith_rms < _OFF_GRID * found.pulses.step
    return found if good else None


def refined(points: FloatArray, position: FloatArray, rotation: FloatArray, geometry: ScanGeometry) -> Origin:
    """The origin near `position` about which the points' angles lie best on their pattern."""
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
    return float(np.hypot(geometry.azimuth_rms, geometry.zenith_rms))


def _step(geometry: ScanGeometry, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(3,) step of the origin towards the best one and (3,) its standard deviation, points' frame, m."""
    rows = np.arange(0, len(geometry.range_m), max(len(geometry.range_m) // _SAMPLE, 1))
    rows = rows[geometry.range_m[rows] >= np.median(geometry.range_m) / 2]
    azimuth, zenith, distance = geometry.azimuth[rows], geometry.zenith[rows], geometry.range_m[rows]
    _, along_azimuth, along_zenith = polar_axes(azimuth, zenith)
    level = distance * np.sin(zenith)
    across, down = _open(geometry, rows)
    design = [-along_azimuth / level[:, None], -along_zenith / distance[:, None]]
    residual = [azimuth - geometry.lines.start - geometry.lines.step * geometry.line[rows], _zenith_residual(geometry, rows)]
    if not geometry.synchronous:
        lean = np.stack([np.cos(azimuth) / np.tan(zenith), np.sin(azimuth) / np.tan(zenith)], axis=1)
        design[0] = np.concatenate([design[0], lean], axis=1)
        design[1] = np.concatenate([design[1], np.stack([-np.sin(azimuth), np.cos(azimuth)], axis=1)], axis=1)
    parts = [_without(open_, weight, *pair) for open_, weight, pair in zip(
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
    """Of a least-squares solution whose residuals (n,) go together within groups of neighbouring lines (the sandwich form)."""
    group = (line.astype(np.int64) - line.min()) * _GROUPS // (int(np.ptp(line)) + 1)
    score = np.stack([np.bincount(group, column * left, minlength=_GROUPS) for column in matrix.T], axis=1)
    return inverse @ (score.T @ score) @ inverse * (_GROUPS / (_GROUPS - 1))


def _zenith_residual(geometry: ScanGeometry, rows: NDArray[np.int64]) -> FloatArray:
    """(k,) zenith angle less the grid's; of lines that begin anywhere each with its own start (taken out in `_open`)."""
    return geometry.zenith[rows] - geometry.pulses.start - geometry.pulses.step * geometry.pulse[rows]


def _open(geometry: ScanGeometry, rows: NDArray[np.int64]) -> tuple[list[FloatArray], list[FloatArray]]:
    """What the pattern leaves open of azimuth and of zenith: columns (k,); a line's own start is given as its number."""
    line, pulse, zenith = (each[rows].astype(float) for each in (geometry.line, geometry.pulse, geometry.zenith))
    one = np.ones_like(line)
    if geometry.synchronous:
        return [one, line], [one, pulse]
    return [one, line, zenith - np.pi / 2, 1 / np.sin(zenith), 1 / np.tan(zenith)], [line, pulse]


def _without(
    columns: list[FloatArray], weight: FloatArray, design: FloatArray, value: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The weighted design and residual without what the open columns explain."""
    first, values = columns[0], np.concatenate([design, value[:, None]], axis=1)
    open_ = np.stack(columns[1:], axis=1)
    if np.ptp(first) > 0:  # a start for each line: take the lines' weighted means out of everything
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


# --- a first guess from the order of the points


def from_order(points: FloatArray) -> Origin | None:
    """The origin of points (n, 3), m, that stand in the order in which they were taken; None where their lines do not tell it.

    The planes of vertical lines meet in the scanner's axis; the height on it is where the zenith angles of a line are equally
    spaced. The scanner is taken to stand upright in the points' frame, to some degrees.
    """
    centre = points.mean(axis=0)
    pieces = _pieces(points - centre)
    planes = _planes(points - centre, pieces)
    if planes is None:
        return None
    place, axis, free = _meeting(*planes)
    if free:
        place = place + _height(points - centre, pieces, place, axis) * axis
    return near(points, centre + place, np.eye(3))


def near(points: FloatArray, position: FloatArray, rotation: FloatArray) -> Origin | None:
    """The origin of points (n, 3), m, near a place; None where they lie on no pattern seen from there."""
    some = points[:: max(len(points) // _SAMPLE, 1)] if len(points) > 3 * _SAMPLE else points
    seen = pattern_from(some, position, rotation)
    if seen is None:
        return None
    found = refined(some, position, rotation, seen)
    whole = found.geometry if some is points else pattern_from(points, found.position, rotation)
    return None if whole is None else Origin(found.position, found.sigma_m, whole)


def _pieces(points: FloatArray) -> list[NDArray[np.int64]]:
    """Indices of the points of each piece of a line: without a step back or a wide one."""
    step = np.diff(points, axis=0)
    length = np.linalg.norm(step, axis=1)
    typical = np.median(length[length > 0]) if (length > 0).any() else 1.0
    back = np.einsum("ni,ni->n", step[1:], step[:-1]) < -0.5 * length[1:] * length[:-1]
    cut = length > _LONGEST_STEP * typical
    cut[1:] |= back & (length[1:] > 3 * typical)
    pieces = np.split(np.arange(len(points)), np.flatnonzero(cut) + 1)
    return [piece for piece in pieces if len(piece) >= _SHORTEST_LINE]


def _planes(points: FloatArray, pieces: list[NDArray[np.int64]]) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Normals (k, 3), middles (k, 3) and angular errors (k,) of the planes of pieces of lines; None for fewer than 8."""
    found = []
    for rows in pieces:
        middle = points[rows].mean(axis=0)
        _, size, axes = np.linalg.svd(points[rows] - middle, full_matrices=False)
        if size[1] > _RELIEF * size[2]:
            found.append((axes[2], middle, size[1], size[2] / np.sqrt(len(rows))))
    if len(found) < 8:
        return None
    normals, middles, width, out = (np.array(each) for each in zip(*found, strict=True))
    out = np.maximum(out, np.median(out)) + 1e-12  # rounding can put a line into a plane of its own
    return normals, middles, out / width


def _height(points: FloatArray, pieces: list[NDArray[np.int64]], place: FloatArray, axis: FloatArray) -> float:
    """How far along the axis from `place` the steps of a line are most equal as angles, m."""
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
    """Where planes meet, robustly: a point, the direction in which it is known worst, and whether it is open in that one."""
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
