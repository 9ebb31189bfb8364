"""Recover the scan pattern of a raw scan: ranges, angles, scan lines, pulses and angular steps, from the points and their origin.

Points may be in any order, with gaps and several echoes of a pulse. Steps are the periods of the angles' histograms, found by
Fourier transform (the fundamental is the lowest of the harmonics). They are refined by least squares over all points once each
point has its line and its place in the line.

Two patterns are tried. A *level* pattern has in the given frame azimuth = start + line step, zenith = start + pulse step. A
*tilted* pattern is what instruments really deliver: its axis differs from the frame's z. A line is not a meridian, because the
head turns while the beam runs down. Each line begins at its own zenith angle:

    azimuth(line, z) = start + line step + d (z - pi/2) + c / sin z + t cot z        d head's turn, c collimation, t trunnion tilt

with both angles about the true axis. Its seven unknowns are found by Gauss-Newton on the lines' phase. The sine of the phase is
the influence function, so that an initial value that is off by a line costs iterations but does not change the result.

Limits: one scan, a fixed position, 16 to 170,000 lines of 16 to 40,000 pulses. Errors of the directions (rounded coordinates, a
wrong origin) must be below a fifth of a step for at least half of the points. A scan of a flat wall keeps a bent pattern about an
origin that is a metre off; `azimuth_rms` and `zenith_rms` are then far above the points' noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, IntArray
from sensors.signal_chain.polar import polar

_FEWEST = 16
"""Smallest number of lines, and of pulses in a line."""
_BINS, _LINE_BINS = 1 << 19, 1 << 17
"""Bins of a histogram of azimuths, and of one line's zenith angles: at least three for each step."""
_PADDING = 2
"""Zero padding of the Fourier transform."""
_NARROWEST_RAD = 1e-6
"""Narrowest range of angles in which a step can be found, rad."""
_FEW, _SAMPLE = 10_000, 100_000
"""Number of points for finding the axis roughly, and for refining it."""
_TURNS = 60
"""Largest number of iterations."""
_LINES = 48
"""Number of lines whose spectra are averaged."""
_ON_GRID = 0.9
_FOUND = 0.5
"""Coherence (length of the mean phasor; 1: all points on the pattern) from which a pattern is exact, and from which there
is one.
"""


@dataclass(frozen=True)
class AngularGrid:
    """Equally spaced angles of a scan pattern: the first (`start`) and the `step`, rad, and their number, `count`."""

    start: float
    step: float
    count: int

    @property
    def stop(self) -> float:
        """Last of the equally spaced angles of a scan pattern, rad."""
        return self.start + self.step * (self.count - 1)

    def to_list(self) -> list[float]:
        """Return the angles as [start, stop, step], rad, as the `pattern` in measurement.yaml has them."""
        return [self.start, self.stop, self.step]


@dataclass(frozen=True)
class ScanGeometry:
    """Scan lines, pulses and angular steps of a raw laser scan, recovered from its n points.

    Attributes
    ----------
    range_m, azimuth, zenith : (n,) range, m, and angles, rad, about the scan's own axis; azimuth has no jump within the scan.
    line, pulse : (n,) int32 number of each point's scan line, and of its pulse in the line, from 0; echoes of one pulse share
        them.
    lines, pulses : Azimuths of the lines and zenith angles of the pulses.
    rotation : (3, 3) frame of the scan's axis to the scanner's frame (identity for a level scan).
    line_shape : (3,) d, c and t, rad, by which the azimuth along a line varies with the zenith angle z, as
        d (z - pi/2) + c / sin z + t cot z: turn of the scanner's head, collimation error and trunnion tilt.
    synchronous : Whether the pulses of all lines have the same zenith angles; otherwise each line begins at its own.
    azimuth_rms, zenith_rms : RMS deviation of the measured angles from the pattern, rad, over the half of the points with the
        longest ranges, whose angles are the most exact.
    """

    range_m: FloatArray
    azimuth: FloatArray
    zenith: FloatArray
    line: IntArray
    pulse: IntArray
    lines: AngularGrid
    pulses: AngularGrid
    rotation: FloatArray
    line_shape: FloatArray
    synchronous: bool
    azimuth_rms: float
    zenith_rms: float

    @property
    def tilt(self) -> float:
        """Angle between the axis about which the scan was made and the scanner's z axis, rad."""
        return float(np.arctan2(np.hypot(*self.rotation[:2, 2]), self.rotation[2, 2]))

    @property
    def pattern(self) -> dict[str, list[float]]:
        """The scan's nominal directions, to be written under the key `pattern` of measurement.yaml.

        The keys azimuth_rad and zenith_rad each have [start, stop, step], rad.
        """
        return {"azimuth_rad": self.lines.to_list(), "zenith_rad": self.pulses.to_list()}

    @cached_property
    def returned(self) -> NDArray[np.bool_]:
        """(lines, pulses) whether each direction of the scan pattern has a return, that is, at least one of the points."""
        cells = np.zeros((self.lines.count, self.pulses.count), dtype=bool)
        cells[self.line, self.pulse] = True
        return cells


def recover_pattern(points: FloatArray, position: FloatArray | None = None, rotation: FloatArray | None = None) -> ScanGeometry:
    """Recover scan lines, pulses and angular steps of a raw laser scan from its points.

    points: (n, 3), m; position: (3,) scanner's centre in the points' frame, m; rotation: (3, 3), scanner to the points' frame.
    Without these two, the points are in the scanner's frame. Raises InputError if the points lie on no pattern.
    """
    origin = np.zeros(3) if position is None else position
    local = points - origin if rotation is None else np.einsum("ij,ni->nj", rotation, points - origin)
    _check(local)
    level = _level(local)
    return level if level is not None else _tilted(local)


def _check(local: FloatArray) -> None:
    """Raise InputError for too few points, or coordinates that are not numbers."""
    if len(local) < _FEWEST**2:
        raise InputError(
            f"{len(local)} points are too few to find the pattern of the scan",
            where="scan",
            allowed=f"at least {_FEWEST**2}",
            remedy="use all points of the scan",
        )
    if not np.isfinite(local).all():
        raise InputError(
            "some points of the scan have coordinates that are not numbers",
            where="scan",
            remedy="remove these points, which are missing returns",
        )


def _no_pattern(angle: str) -> InputError:
    """Return the error for points without a pattern."""
    return InputError(
        f"the points lie on no regular pattern in {angle}",
        where="scan",
        remedy="give all raw points of one scan; if you did, correct the scanner's position and rotation",
    )


# --- the two patterns


def _level(local: FloatArray) -> ScanGeometry | None:
    """Return the level pattern; None if the points lie on none."""
    distance, azimuth, zenith = polar(local)
    far = distance >= np.median(distance)
    azimuth = _unrolled(azimuth)
    try:
        step = _period([azimuth[far]])
        if abs(_phasor(azimuth[far], step)) < _ON_GRID:
            return None
        lines, line = _grid(azimuth, step, far)
        geometry = _with_pulses(distance, azimuth, azimuth, zenith, lines, line, far, np.eye(3), np.zeros(3))
    except InputError:
        return None
    return geometry if geometry is not None and geometry.synchronous else None


def _tilted(local: FloatArray) -> ScanGeometry:
    """Return the tilted pattern, from the best of several initial axes."""
    distance, _, _ = polar(local)
    far = distance >= np.median(distance)
    few, many = (local[far][:: max(1, int(far.sum()) // most)] for most in (_FEW, _SAMPLE))
    best: _AxisFit | None = None
    for axis in _first_axes(local):
        fit = _fit_axis(few, axis)
        best = fit if fit is not None and (best is None or fit.coherence > best.coherence) else best
        if best is not None and best.coherence > _ON_GRID:
            break
    fit = None if best is None else _turn(many, _turn(many, best))
    if fit is None or fit.coherence < _FOUND:
        raise _no_pattern("azimuth")
    distance, azimuth, zenith = polar(np.einsum("ij,nj->ni", fit.rotation, local))
    straight = np.mod(azimuth - _shape(zenith) @ fit.shape - fit.cut, 2 * np.pi) + fit.cut
    lines, line = _grid(straight, fit.step, far)
    azimuth += 2 * np.pi * np.rint((straight - azimuth) / (2 * np.pi))
    geometry = _with_pulses(distance, azimuth, straight, zenith, lines, line, far, fit.rotation.T, fit.shape)
    if geometry is None:
        raise _no_pattern("zenith")
    return geometry


def _with_pulses(
    distance: FloatArray,
    azimuth: FloatArray,
    straight: FloatArray,
    zenith: FloatArray,
    lines: AngularGrid,
    line: IntArray,
    far: NDArray[np.bool_],
    rotation: FloatArray,
    shape: FloatArray,
) -> ScanGeometry | None:
    """Find the grid of zenith angles and return the scan's geometry; None if they have no step.

    Parameters
    ----------
    distance : (n,) array
        Ranges, m.
    azimuth, straight, zenith : (n,) arrays
        Angles in the frame of the axis, rad; straight is the azimuth without the line's shape.
    lines : AngularGrid
        Azimuths of the scan lines.
    line : (n,) array
        Scan line of each point.
    far : (n,) bool array
        Points that are far enough for exact angles.
    rotation : (3, 3) array
        From the frame of the axis to the scanner's.
    shape : (3,) array
        Shape of the line.
    """
    try:
        step = _period(_longest_lines(zenith[far], line[far]))
    except InputError:
        return None
    for _ in range(3):  # the first pass corrects the step enough for right indices over a whole line
        phase = _line_phases(zenith, line, far, step, lines.count)
        step = _refined_step(zenith, line, far, step, phase)
    phase = _line_phases(zenith, line, far, step, lines.count)
    weight = np.bincount(line[far], minlength=lines.count)
    mean = (weight * np.exp(2j * np.pi * phase)).sum() / weight.sum()
    synchronous = bool(abs(mean) >= _ON_GRID)
    if synchronous:
        pulses, pulse = _grid(zenith, step, far)
        residual = zenith - pulses.start - pulses.step * pulse
    else:
        common = np.angle(mean) / (2 * np.pi)
        offset = (common + np.mod(phase - common + 0.5, 1.0) - 0.5)[line]
        index = np.rint(zenith / step - offset).astype(np.int64)
        residual = zenith - step * (index + offset)
        first = int(index.min())
        pulse = (index - first).astype(np.int32)
        pulses = AngularGrid(float(step * (first + common)), step, int(pulse.max()) + 1)
    if not synchronous and np.abs(np.mean(np.exp(2j * np.pi * residual[far] / step))) < _FOUND:
        return None
    azimuth_rms = float(np.sqrt(np.mean((straight - lines.start - lines.step * line)[far] ** 2)))
    zenith_rms = float(np.sqrt(np.mean(residual[far] ** 2)))
    return ScanGeometry(
        distance, azimuth, zenith, line, pulse, lines, pulses, rotation, shape, synchronous, azimuth_rms, zenith_rms
    )


# --- periods


def _period(groups: list[FloatArray]) -> float:
    """Return the step of the grid on which each group's angles lie, rad, accurate to a fraction of a step over the whole range.

    It is the lowest of the strong peaks of the groups' mean amplitude spectrum. Raises InputError if none is significant.
    """
    low, high = min(group.min() for group in groups), max(group.max() for group in groups)
    if high - low < _NARROWEST_RAD:
        raise _no_pattern("angle")
    width = (high - low) * (1 + 1e-9)
    bins = _BINS if len(groups) == 1 else _LINE_BINS
    spectrum = np.zeros(bins * _PADDING // 2 + 1)
    for group in groups:
        histogram = np.bincount(((group - low) / width * bins).astype(np.int64), minlength=bins)
        spectrum += np.abs(np.fft.rfft(histogram, bins * _PADDING)) / len(group)
    spectrum /= len(groups)
    lowest = (_FEWEST - 1) * _PADDING
    strongest = spectrum[lowest : len(spectrum) // 2].max()
    if strongest < 10 / np.sqrt(sum(len(group) for group in groups)):
        raise _no_pattern("angle")
    first = lowest + int(np.argmax(spectrum[lowest:] >= 0.6 * strongest))
    peak = first + int(np.argmax(spectrum[first : first + first // 3]))  # beyond its side lobes, before the next harmonic
    before, at, after = spectrum[peak - 1 : peak + 2]
    curvature = before - 2 * at + after
    shift = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    return float(width * _PADDING / (peak + shift))


def _phasor(values: FloatArray, step: float) -> complex:
    """Return the mean of exp(2 pi i value / step), whose length is 1 if all values lie on one grid."""
    return complex(np.mean(np.exp(2j * np.pi * values / step)))


def _grid(values: FloatArray, step: float, far: NDArray[np.bool_]) -> tuple[AngularGrid, IntArray]:
    """Return the grid of the values, by least squares over the far ones, and each value's index.

    Raises InputError for a single index.
    """
    start = float(np.angle(_phasor(values[far], step))) / (2 * np.pi) * step
    for _ in range(3):
        index = np.rint((values - start) / step)
        if np.ptp(index[far]) == 0:
            raise _no_pattern("angle")
        centred = index[far] - index[far].mean()
        residual = (values - start - step * index)[far]
        step += float(np.sum(centred * residual) / np.sum(centred**2))
        start = float(np.mean(values[far] - step * index[far]))
    first = int(index.min())
    place = (index - first).astype(np.int32)
    return AngularGrid(start + step * first, step, int(place.max()) + 1), place


# --- zenith, line by line


def _longest_lines(zenith: FloatArray, line: IntArray) -> list[FloatArray]:
    """Return the zenith angles of the lines with the most points, one group for each."""
    order = np.argsort(line, kind="stable")
    groups = np.split(zenith[order], np.flatnonzero(np.diff(line[order])) + 1)
    return sorted(groups, key=len, reverse=True)[:_LINES]


def _line_phases(zenith: FloatArray, line: IntArray, far: NDArray[np.bool_], step: float, count: int) -> FloatArray:
    """Return the (count,) start of each line's grid, in steps, modulo 1."""
    angle = 2 * np.pi * zenith[far] / step
    real, imaginary = (np.bincount(line[far], part(angle), minlength=count) for part in (np.cos, np.sin))
    return np.arctan2(imaginary, real) / (2 * np.pi)


def _refined_step(zenith: FloatArray, line: IntArray, far: NDArray[np.bool_], step: float, phase: FloatArray) -> float:
    """Return the step by least squares within lines, each with its own phase."""
    z, of = zenith[far], line[far]
    index = np.rint(z / step - phase[of])
    residual = z / step - phase[of] - index
    number = np.maximum(np.bincount(of, minlength=len(phase)), 1)
    centred = index - (np.bincount(of, index, minlength=len(phase)) / number)[of]
    return float(step * (1 + np.sum(centred * residual) / max(np.sum(centred**2), 1.0)))


# --- the axis


@dataclass(frozen=True)
class _AxisFit:
    """Fit of the scan's axis.

    Attributes
    ----------
    rotation : (3, 3) array
        From the scanner's frame to that of the axis.
    shape : (3,) array
        Shape d, c, t of the line.
    step : float
        Step of azimuth, rad.
    cut : float
        Azimuth at which the scan starts, rad.
    """

    rotation: FloatArray
    shape: FloatArray
    step: float
    cut: float
    coherence: float


def _first_axes(local: FloatArray) -> list[FloatArray]:
    """Return initial rotations to the axis: those that level the lower and the upper edge of the field of view, and none."""
    _, azimuth, zenith = polar(local)
    sector = np.floor((azimuth + np.pi) * (90 / np.pi)).astype(np.int64).clip(0, 179)
    present = np.unique(sector)
    middle = (present + 0.5) * (np.pi / 90) - np.pi
    order = np.lexsort((zenith, sector))
    last = np.append(np.flatnonzero(np.diff(sector[order])), len(order) - 1)
    edges = zenith[order][last], zenith[order][np.append(0, last[:-1] + 1)]
    return [*(_levelled(middle, edge) for edge in edges if len(present) > 3), np.eye(3)]


def _levelled(azimuth: FloatArray, edge: FloatArray) -> FloatArray:
    """Return the rotation that makes zenith angles `edge` constant over azimuth, from a cosine fitted in the L1 norm."""
    design = np.stack([np.ones_like(azimuth), np.cos(azimuth), np.sin(azimuth)], axis=1)
    weight = np.ones_like(azimuth)
    for _ in range(50):
        solution = _least_squares(design, edge, weight)
        weight = 1 / (np.abs(edge - np.einsum("ij,j->i", design, solution)) + 1e-4)
    return Rotation.from_rotvec([solution[2], -solution[1], 0.0]).as_matrix()


def _fit_axis(local: FloatArray, rotation: FloatArray) -> _AxisFit | None:
    """Fit axis, line shape and step to the azimuths of points in the scanner's frame; None if no step is found."""
    _, azimuth, _ = polar(np.einsum("ij,nj->ni", rotation, local))
    try:
        fit = _AxisFit(rotation, np.zeros(3), _period([_unrolled(azimuth)]), 0.0, 0.0)
    except InputError:
        return None
    for _ in range(_TURNS):
        before, fit = fit, _turn(local, fit)
        if fit.coherence < before.coherence + 1e-4:
            break
    return fit


def _turn(local: FloatArray, fit: _AxisFit) -> _AxisFit:
    """Improve a fit: find the start of the scan again, then make a few Gauss-Newton steps."""
    rotation, shape = fit.rotation, fit.shape
    cut, step = _cut(local, rotation, shape, fit.step)
    for _ in range(6):
        rotation, shape, step = _improved(local, rotation, shape, step, cut)
    straight = _straight(local, rotation, shape, cut)[0]
    return _AxisFit(rotation, shape, step, cut, abs(_phasor(straight, step)))


def _improved(
    local: FloatArray, rotation: FloatArray, shape: FloatArray, step: float, cut: float
) -> tuple[FloatArray, FloatArray, float]:
    """Make one Gauss-Newton step for phase, step, axis (2) and line shape (3)."""
    straight, azimuth, zenith = _straight(local, rotation, shape, cut)
    phase = np.angle(_phasor(straight, step)) / (2 * np.pi)
    index = np.rint(straight / step - phase)
    residual = np.sin(2 * np.pi * (straight / step - phase - index)) * (step / (2 * np.pi))
    lean = 1 / np.tan(zenith)
    design = np.stack([np.ones_like(lean), index, np.cos(azimuth) * lean, np.sin(azimuth) * lean], axis=1)
    change = _least_squares(np.concatenate([design, _shape(zenith)], axis=1), residual, None)
    turned = Rotation.from_rotvec([change[2], change[3], 0.0]).as_matrix() @ rotation
    return turned, shape + change[4:], step + float(change[1])


def _straight(
    local: FloatArray, rotation: FloatArray, shape: FloatArray, cut: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the azimuth without the line's shape, from `cut` upwards; azimuth; zenith angle."""
    _, azimuth, zenith = polar(np.einsum("ij,nj->ni", rotation, local))
    return np.mod(azimuth - _shape(zenith) @ shape - cut, 2 * np.pi) + cut, azimuth, zenith


def _shape(zenith: FloatArray) -> FloatArray:
    """Return the (n, 3) terms of a line's shape: z - pi/2, 1 / sin z, cot z."""
    return np.stack([zenith - np.pi / 2, 1 / np.sin(zenith), 1 / np.tan(zenith)], axis=1)


def _seam(straight: FloatArray, step: float) -> tuple[float, float]:
    """Find the azimuth at which the scan begins, and correct the step: the cut that puts most lines on one grid.

    straight: (n,) rad, from -pi to pi. A full circle is not a whole number of steps: the lines' phase jumps between the last and
    the first line, and a step found across that jump is off by a fraction of a line per circle. Cuts at whole degrees are tried
    with up to two lines per circle more or fewer; the cut is then moved to the best place for that step.
    """
    place = np.floor((straight + np.pi) * (180 / np.pi)).astype(np.int64).clip(0, 359)
    phasors = np.exp(2j * np.pi * straight / step)
    summed = np.bincount(place, phasors.real, minlength=360) + 1j * np.bincount(place, phasors.imag, minlength=360)
    more: FloatArray = np.arange(-2.0, 2.01, 0.05) / (2 * np.pi)  # lines per radian
    shifted = summed * np.exp(2j * np.pi * more[:, None] * ((np.arange(360) + 0.5) * (np.pi / 180) - np.pi))
    before = np.cumsum(shifted, axis=1) - shifted
    turn = np.exp(4j * np.pi**2 * (1 / step + more))[:, None]
    best = int(np.argmax(np.abs(before[:, -1:] + shifted[:, -1:] + (turn - 1) * before)))
    step = 1 / (1 / step + float(more[best // 360]))
    straight = np.sort(straight)
    summed = np.cumsum(np.exp(2j * np.pi * straight / step))
    exact = np.abs(summed[-1] + (np.exp(4j * np.pi**2 / step) - 1) * summed)
    near = np.abs(straight - ((best % 360) * (np.pi / 180) - np.pi)) < np.pi / 90
    last = int(np.argmax(np.where(near, exact, 0.0)))
    return float(straight[last] + straight[min(last + 1, len(straight) - 1)]) / 2, step


def _cut(local: FloatArray, rotation: FloatArray, shape: FloatArray, step: float) -> tuple[float, float]:
    """Return the azimuth at which the scan begins, in its widest gap or at its seam, and the step."""
    straight = _straight(local, rotation, shape, -np.pi)[0]
    ordered = np.sort(straight)
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    return (float(ordered[widest] + gaps[widest] / 2), step) if gaps[widest] > 3 * step else _seam(straight, step)


def _unrolled(azimuth: FloatArray) -> FloatArray:
    """Return azimuths without a jump within the scan: they begin behind the widest gap."""
    ordered = np.sort(azimuth)
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    begin = ordered[(widest + 1) % len(ordered)]
    result: FloatArray = np.where(azimuth < begin, azimuth + 2 * np.pi, azimuth) if widest < len(ordered) - 1 else azimuth
    return result


def _least_squares(design: FloatArray, values: FloatArray, weight: FloatArray | None) -> FloatArray:
    """Solve weighted least squares by scaled normal equations, summed in a fixed order whatever the number of threads."""
    scale = np.sqrt(np.einsum("ni,ni->i", design, design)) + 1e-300
    scaled = design / scale
    weighted = scaled if weight is None else scaled * weight[:, None]
    normal, right = np.einsum("ni,nj->ij", weighted, scaled), np.einsum("ni,n->i", weighted, values)
    solution: FloatArray = np.linalg.lstsq(normal, right, rcond=1e-12)[0] / scale
    return solution
