"""Register an epoch on the reference by the rock that did not move, and estimate the uncertainty of the registration.

ICP brings the points near the reference. A robust least-squares fit of the two rasters then removes what is left: a small shift t
and rotation w of the epoch change its height at a place (x, y), to first order, by

    dz = tz + wx y - wy x - a (tx + wy z - wz y) - b (ty + wz x - wx z),

a and b the slopes of the surface. Tukey's weights leave out what moved. The fit is repeated on the pixels that did not change
sign-consistently (`unchanged.py`), as a robust fit alone is drawn towards changes that all have one sign. The covariance of the
six parameters comes from leaving out one block of the wall at a time (delete-a-group jackknife), since neighbouring pixels share
their errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.monitoring.gridding import SAMPLE, HeightRaster
from pipeline.monitoring.stable_areas import StableRock
from pipeline.monitoring.unchanged import unchanged_pixels
from pipeline.registration.closest_points import ReferenceSurface
from pipeline.registration.register import IcpConfig, register_to
from pipeline.registration.rigid import RigidTransform
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

SAME = RigidTransform(np.eye(3), np.zeros(3))
"""No motion."""
_MOST_REFERENCE = 400_000
"""Points of the reference that ICP works with."""
_TUKEY = 4.685
"""Tuning constant of Tukey's biweight, in standard deviations: 95 % efficient for normal errors (Huber 1981)."""
_ROUNDS, _SETTLED_M = 30, 1e-6
"""Most rounds of the robust fit, and change of a height below which it has converged, m."""
_LOWERED, _MORE_THAN_EXPECTED, _ENOUGH_AGREE = 0.7, 1.5, 0.15
"""Factor by which the scale of the robust fit is lowered at a time; it stops at so many times the expected one, and where a
smaller share of the pixels would agree."""
_MOST_FITTED = 150_000
"""Pixels that the fit takes."""
_BLOCKS = 6
"""Blocks along the longer side of the wall, of which one at a time is left out."""
_MOST_BLOCKS = 10_000
"""Numbers of blocks of one view begin so far from those of the one before."""
_LEAST_PIXELS = 300
"""Stable pixels without which no fit is made."""
_FEWEST_BLOCKS = 5
_FEW_STABLE = 0.25
"""Share of the compared pixels below which the user is told that little of the wall is stable."""
_FARTHEST_NOISE = 3.0
"""Times the limit of the robust fit (14 standard deviations) beyond which a difference in the user's stable areas is no noise."""
_BAND = 16
"""Rows of a raster that are worked on at a time, so that they stay in the processor's cache."""
_REFITS = 3
"""Most fits on the pixels that did not change, each after a new search for them."""
_SAME_FIT = 0.02
"""Expected standard deviations of a difference by which another fit moves no height once the search has converged."""
_UNDETERMINED = 1e-7
"""Motions whose effect on the heights, relative to the largest, is smaller than this are left as they are."""


@dataclass(frozen=True)
class RasterPair:
    """Heights of the reference and of an epoch on one grid, for one view of the wall, from which the epoch is registered.

    A view is a part of the wall that is mapped along a direction of its own.

    Attributes
    ----------
    reference, epoch : HeightRaster
        Heights of the two epochs, frame of the view, m.
    from_wall : RigidTransform
        From the wall frame, in which the epoch is registered, to the frame of the view; the identity for one view.
    """

    reference: HeightRaster
    epoch: HeightRaster
    from_wall: RigidTransform = SAME

    @property
    def difference(self) -> NDArray[np.float32]:
        """Height of the reference minus that of the epoch before registration, (h, w), m; NaN without data."""
        return self.reference.height - self.epoch.height

    def design(self, centre: FloatArray) -> NDArray[np.float32]:
        """Return how each height of the epoch changes with a small motion: the design matrix of the least-squares registration.

        centre: (3,) centre of the rotation, wall frame, m.

        Returns (6, h, w): derivatives by the three shifts, m/m, and the three rotation angles, m/rad, wall frame. NaN without
        data.
        """
        found = _design(self.epoch, self.from_wall.apply(centre))
        if np.array_equal(self.from_wall.rotation, SAME.rotation):
            return found
        turned = self.from_wall.rotation.T.astype(np.float32)
        return np.concatenate([np.tensordot(turned, part, 1) for part in (found[:3], found[3:])])

    def points(self, where: NDArray[np.bool_]) -> FloatArray:
        """Return the epoch's surface points (n, 3), wall frame, m, at the n pixels that the mask `where` (h, w) selects."""
        x, y = _places(self.epoch.grid)
        found = np.stack([x[where], y[where], self.epoch.height[where].astype(np.float64)], axis=1)
        return self.from_wall.inverse().apply(found)

    def sum_of_points(self, where: NDArray[np.bool_]) -> FloatArray:
        """Return the sum (3,) of the points that `points` returns, m, in a tenth of the time."""
        (x, y), count = _places(self.epoch.grid), int(where.sum())
        sums = [where.sum(axis=0) @ x[0], where.sum(axis=1) @ y[:, 0], self.epoch.height[where].sum(dtype=np.float64)]
        return np.asarray(count * self.from_wall.inverse().apply(np.array(sums) / max(count, 1)))


@dataclass(frozen=True)
class Alignment:
    """Result of registering an epoch finely on the reference, by the rock that did not change.

    ICP or survey targets have brought the epoch near the reference before.

    Attributes
    ----------
    transform : RigidTransform
        Moves the epoch's points, which are near the reference already, onto it, wall frame.
    covariance : (6, 6) array
        Covariance of shift (m) and rotation (rad) about `centre`, wall frame.
    centre : (3,) array
        Centre of the rotation, wall frame, m.
    stable : tuple of (h, w) bool arrays
        For each view (separately mapped part) of the wall, the pixels that did not change: registration and noise come from them.
    rms_m : float
        Root mean square of the height differences on these pixels after the registration, m.
    notes : tuple of str
        Remarks on the registration for the user.
    """

    transform: RigidTransform
    covariance: FloatArray
    centre: FloatArray
    stable: tuple[NDArray[np.bool_], ...]
    rms_m: float
    notes: tuple[str, ...] = ()

    def sigma(self, design: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the standard deviation of each registered height, (h, w), m, that comes from the registration's uncertainty.

        design: (6, h, w) design matrix of one view of the wall about `centre` (`RasterPair.design`). Pixels without data are NaN.
        """
        covariance = self.covariance.astype(np.float32)
        sigma = np.empty(design.shape[1:], dtype=np.float32)
        for start in range(0, len(sigma), _BAND):
            part = design[:, start : start + _BAND]
            variance = (part * np.tensordot(covariance, part, 1)).sum(axis=0)
            sigma[start : start + _BAND] = np.sqrt(np.maximum(variance, 0.0))
        return sigma

    def to_dict(self) -> dict[str, Any]:
        """Return the fine registration of an epoch, with its standard deviations, by the names that monitor.json has for them."""
        sigma = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return {
            **self.transform.to_dict(),
            "stable_pixels": sum(int(each.sum()) for each in self.stable),
            "rms_m": self.rms_m,
            "sigma_translation_m": sigma[:3].tolist(),
            "sigma_rotation_rad": sigma[3:].tolist(),
            "notes": list(self.notes),
        }


def reference_surface(rasters: Sequence[HeightRaster], from_wall: Sequence[RigidTransform] = (SAME,)) -> ReferenceSurface:
    """Build the surface to which ICP registers epochs, from the pixels of the reference's height rasters and their normals.

    rasters: one for each view (separately mapped part) of the wall. from_wall: transform from the wall frame to the frame of each
    view. The surface is in the wall frame.
    """
    points, normals = [], []
    step = max(sum(int(raster.known.sum()) for raster in rasters) // _MOST_REFERENCE, 1)
    for raster, transform in zip(rasters, from_wall, strict=True):
        rows, columns = (each[::step] for each in np.nonzero(raster.known))
        x, y = _places(raster.grid)
        at = np.stack([x[rows, columns], y[rows, columns], raster.height[rows, columns]], axis=1).astype(np.float64)
        slopes = raster.slope_x[rows, columns], raster.slope_y[rows, columns]
        points.append(transform.inverse().apply(at))
        normals.append(np.stack([-slopes[0], -slopes[1], np.ones(len(rows))], axis=1) @ transform.rotation)
    return ReferenceSurface.build(np.concatenate(points), np.concatenate(normals))


def coarse(surface: ReferenceSurface, points: FloatArray, gsd_m: float, seed: int) -> RigidTransform:
    """Bring an epoch's points near the reference by ICP, before the finer registration on stable rock.

    Parameters
    ----------
    surface : ReferenceSurface
        Points and normals of the reference, wall frame, m.
    points : (n, 3) array
        Points of the epoch, wall frame, m.
    gsd_m : float
        Side of a pixel of the maps, m. Pairs farther apart than three pixels, but at least 0.1 m, are outliers for ICP.
    seed : int
        Seed of the random subsets of the points.

    Returns
    -------
    RigidTransform
        From the points to the reference, wall frame.

    Raises
    ------
    InputError
        If the points do not overlap the reference.
    """
    config = IcpConfig(outlier_distance_threshold=max(0.1, 3 * gsd_m))
    moving = points[:: max(len(points) // SAMPLE, 1)]
    try:
        return register_to(surface, moving, config, KeyedRandom(seed)).transform
    except InputError:
        away = float(np.median(surface.tree.query(moving - surface.origin, 1)[0]))
        raise InputError(
            f"the epoch cannot be registered on the reference: half of its points are more than {away:.3g} m from it",
            where="registration",
            allowed="epochs of the same wall, aligned to some metres",
            remedy="align the epochs before, name targets with --targets, or state the unit of their coordinates with --unit",
        ) from None


def refine(pairs: Sequence[RasterPair], areas: StableRock | None) -> Alignment:
    """Estimate the small shift and rotation of an epoch that remain after ICP, by a robust fit on rock that did not change.

    Parameters
    ----------
    pairs : sequence of RasterPair
        Heights of the reference and of the epoch, one pair for each view (separately mapped part) of the wall.
    areas : StableRock or None
        Areas of stable rock given by the user; None or no areas: unchanged pixels are found from the differences.

    Returns
    -------
    Alignment
        The remaining motion, its covariance, and the unchanged pixels.

    Raises
    ------
    InputError
        If fewer than 300 pixels can be compared.
    """
    compared = [_compared(pair, areas) for pair in pairs]
    count = sum(int(each.sum()) for each in compared)
    _check_enough(count, bool(areas))
    centre = np.sum([pair.sum_of_points(each) for pair, each in zip(pairs, compared, strict=True)], axis=0) / count
    designs = [pair.design(centre) for pair in pairs]
    columns = _Columns.of(pairs, designs, compared)
    expected = columns.expected
    fit = _robust_fit(columns, expected)
    stable = compared
    for _ in range(_REFITS):
        before = fit.parameters
        stable = [_stable(*each, fit, bool(areas)) for each in zip(pairs, designs, compared, strict=True)]
        if sum(int(each.sum()) for each in stable) < _LEAST_PIXELS:
            stable = [_near(*each, fit) for each in zip(pairs, designs, compared, strict=True)]
        columns = _Columns.of(pairs, designs, stable)
        fit = _robust_fit(columns, expected)
        if np.abs((fit.parameters - before) @ columns.design).max() < _SAME_FIT * expected:
            break
    covariance, groups = _jackknife(columns, fit.robust)
    rest = columns.target - fit.parameters @ columns.design
    notes = _notes(sum(int(each.sum()) for each in stable) / count, groups, bool(areas))
    transform = RigidTransform.about(centre, fit.parameters[3:], fit.parameters[:3])
    rms = float(np.sqrt(np.mean(rest[fit.robust > 0] ** 2)))
    return Alignment(transform, covariance, centre, tuple(stable), rms, notes)


def applied(alignment: Alignment, pair: RasterPair, design: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the epoch's heights (h, w), m, after the small motion that `refine` estimated, to first order in it.

    Parameters
    ----------
    alignment : Alignment
        The motion.
    pair : RasterPair
        Heights of the reference and of the epoch in one view of the wall.
    design : (6, h, w) array
        Design matrix of this view about the centre of the motion (`RasterPair.design`).
    """
    shift = alignment.transform.apply(alignment.centre) - alignment.centre
    parameters = np.concatenate([shift, alignment.transform.rotation_vector])
    return np.asarray(pair.epoch.height + np.tensordot(parameters.astype(np.float32), design, 1))


def _compared(pair: RasterPair, areas: StableRock | None) -> NDArray[np.bool_]:
    """(h, w) pixels with data in both epochs, in the user's stable areas where there are any."""
    found = np.isfinite(pair.difference)
    if areas:
        found[found] = areas.contains(pair.points(found))
    return found


def _check_enough(count: int, given: bool) -> None:
    if count >= _LEAST_PIXELS:
        return
    in_or_of = "in the stable areas" if given else "of the maps"
    remedy = "give larger stable areas" if given else "give epochs of the same wall, or a larger --gsd"
    raise InputError(
        f"only {count:,} pixels {in_or_of} have data in both epochs",
        where="registration",
        allowed=f"at least {_LEAST_PIXELS} pixels",
        remedy=remedy,
    )


def _stable(
    pair: RasterPair, design: NDArray[np.float32], compared: NDArray[np.bool_], fit: _RobustFit, given: bool
) -> NDArray[np.bool_]:
    """(h, w) pixels that did not change: in areas that the user gave, all but the farthest ones; else those found here."""
    if not compared.any():
        return compared
    rest = np.where(compared, fit.residuals(pair, design), np.nan)
    if not given:
        return unchanged_pixels(rest / np.hypot(pair.reference.sigma, pair.epoch.sigma), compared)
    stable = compared.copy()
    stable[compared] = np.abs(rest[compared]) * np.sqrt(_weights_by_sigma(pair, compared)) < _FARTHEST_NOISE * fit.limit
    return stable


def _near(pair: RasterPair, design: NDArray[np.float32], compared: NDArray[np.bool_], fit: _RobustFit) -> NDArray[np.bool_]:
    """(h, w) pixels on which the robust fit rests."""
    return compared & (np.abs(fit.residuals(pair, design)) < fit.limit)


def _places(grid: Grid) -> tuple[FloatArray, FloatArray]:
    """Return x and y of the pixels' centres, (h, w), wall frame, m."""
    x = grid.x_min + (np.arange(grid.width) + 0.5) * grid.gsd
    y = grid.y_max - (np.arange(grid.height) + 0.5) * grid.gsd
    return np.broadcast_to(x, grid.shape), np.broadcast_to(y[:, None], grid.shape)


def _design(raster: HeightRaster, centre: FloatArray) -> NDArray[np.float32]:
    """(6, h, w) change of height with shift and rotation about `centre`, frame of the grid; NaN without data."""
    every_x, every_y = _places(raster.grid)
    found = np.empty((6, *raster.grid.shape), dtype=np.float32)
    for start in range(0, raster.grid.height, _BAND):
        rows = slice(start, start + _BAND)
        x, y, z = every_x[rows] - centre[0], every_y[rows] - centre[1], raster.height[rows].astype(np.float64) - centre[2]
        a, b = raster.slope_x[rows].astype(np.float64), raster.slope_y[rows].astype(np.float64)
        for derivative, values in zip(found, (-a, -b, 0 * z + 1, y + b * z, -x - a * z, a * y - b * x), strict=True):
            derivative[rows] = values
    return found


def _weights_by_sigma(pair: RasterPair, where: NDArray[np.bool_]) -> FloatArray:
    """Weights of pixels by the variance of their difference, at most those of the best tenth: no pixel rules alone."""
    variance = pair.reference.sigma[where].astype(np.float64) ** 2 + pair.epoch.sigma[where].astype(np.float64) ** 2
    floor = max(float(np.quantile(variance, 0.1)), 1e-12)
    return np.asarray(floor / np.maximum(variance, floor))


@dataclass(frozen=True)
class _Columns:
    """Pixels of all views that a fit takes.

    design (6, n), target (n,) m, weight (n,), block (n,): number of the block of the wall; expected: standard deviation of a
    weighted residual by the heights' own errors, m.
    """

    design: FloatArray
    target: FloatArray
    weight: FloatArray
    block: NDArray[np.int64]
    expected: float

    @classmethod
    def of(
        cls, pairs: Sequence[RasterPair], designs: Sequence[NDArray[np.float32]], where: Sequence[NDArray[np.bool_]]
    ) -> _Columns:
        """Take every so many pixels: heights of 3 x 3 pixels share their points anyway."""
        step = int(np.ceil(np.sqrt(sum(int(each.sum()) for each in where) / _MOST_FITTED)))
        few = [_every(each, max(step, 1)) for each in where]
        shown = [view for view, each in enumerate(few) if each.any()]
        weight = [_weights_by_sigma(pairs[view], few[view]) for view in shown]
        sigma = [np.hypot(pairs[view].reference.sigma[few[view]], pairs[view].epoch.sigma[few[view]]) for view in shown]
        block = _blocks([few[view] for view in shown], max(_extent(pair) for pair in pairs))
        target = [pairs[view].difference[few[view]].astype(np.float64) for view in shown]
        weights = np.concatenate(weight)
        expected = float(np.median(np.sqrt(weights) * np.concatenate(sigma)))
        design = np.concatenate([designs[view][:, few[view]] for view in shown], axis=1).astype(np.float64)
        return cls(design, np.concatenate(target), weights, np.concatenate(block), expected)


def _every(where: NDArray[np.bool_], step: int) -> NDArray[np.bool_]:
    """(h, w) every so many rows and columns of a mask."""
    few = np.zeros_like(where)
    few[::step, ::step] = where[::step, ::step]
    return few


@dataclass(frozen=True)
class _RobustFit:
    """Shift and rotation (6,), Tukey's weights (n,), and the weighted residual, m, beyond which a weight is zero."""

    parameters: FloatArray
    robust: FloatArray
    limit: float

    def residuals(self, pair: RasterPair, design: NDArray[np.float32]) -> NDArray[np.float32]:
        """(h, w) what the fit leaves of the differences, m."""
        return np.asarray(pair.difference - np.tensordot(self.parameters.astype(np.float32), design, 1))


def _robust_fit(columns: _Columns, expected: float) -> _RobustFit:
    """Iteratively reweighted least squares with Tukey's weights, from the median on.

    The scale begins at the spread of the residuals. Where much of the wall moved, that is far more than noise: it is lowered step
    by step towards what noise explains, as long as enough pixels agree, so that the fit settles on what did not move.

    expected: standard deviation of a weighted residual by the heights' own errors, m.
    """
    design, target, weight = columns.design, columns.target, columns.weight
    parameters = np.zeros(6)
    parameters[2] = np.median(target)
    standard = np.sqrt(weight) * (target - parameters @ design)
    scale, robust = max(1.4826 * float(np.median(np.abs(standard))), 1e-9), np.ones(len(target))
    for _ in range(_ROUNDS):
        standard = np.sqrt(weight) * (target - parameters @ design)
        own = max(1.4826 * float(np.median(np.abs(standard))), 1e-9)
        smaller = max(_LOWERED * scale, _MORE_THAN_EXPECTED * expected)
        agree = float((np.abs(standard) < _TUKEY * smaller).mean())
        scale = min(own, smaller if agree >= _ENOUGH_AGREE else scale)
        robust = np.maximum(1 - (standard / (_TUKEY * scale)) ** 2, 0.0) ** 2
        before, parameters = parameters, _solved(*_normal_equations(design, target, weight * robust))
        settled = scale in (own, _MORE_THAN_EXPECTED * expected) or agree < _ENOUGH_AGREE
        if settled and np.abs((parameters - before) @ design).max() < _SETTLED_M:
            break
    return _RobustFit(parameters, robust, _TUKEY * scale)


def _normal_equations(design: FloatArray, target: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(6, 6) and (6,) of weighted least squares."""
    return (design * weight) @ design.T, design @ (weight * target)


def _solved(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Solve normal equations; motions that the heights do not determine are left at zero."""
    scale = np.sqrt(np.where(np.diag(normal) > 0, np.diag(normal), 1.0))
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    kept = values > _UNDETERMINED * values[-1]
    return np.asarray(vectors[:, kept] @ ((vectors[:, kept].T @ (right / scale)) / values[kept]) / scale)


def _extent(pair: RasterPair) -> int:
    """Pixels along the longer side of the map; of what has data in both epochs where this is less than half of it."""
    known = np.isfinite(pair.difference)
    places = [np.flatnonzero(known.any(axis=axis)) for axis in (0, 1)]
    compared = max(int(each[-1] - each[0]) + 1 if len(each) else 0 for each in places)
    whole = max(pair.difference.shape)
    return compared if 2 * compared < whole else whole


def _blocks(where: Sequence[NDArray[np.bool_]], extent: int) -> list[NDArray[np.int64]]:
    """Number of the block of the wall of each pixel, for each view; blocks are made smaller until there are two."""
    side = max(extent // _BLOCKS, 1)
    while True:
        found = [_block_numbers(each, side) + view * _MOST_BLOCKS for view, each in enumerate(where)]
        if side == 1 or len(np.unique(np.concatenate(found))) > 1:
            return found
        side //= 2


def _block_numbers(where: NDArray[np.bool_], side: int) -> NDArray[np.int64]:
    """Number of the block of the wall, of so many pixels a side, of each pixel in `where`."""
    row, column = np.nonzero(where)
    return np.asarray((row // side) * (where.shape[1] // side + 1) + column // side)


def _jackknife(columns: _Columns, robust: FloatArray) -> tuple[FloatArray, int]:
    """Covariance (6, 6) of the parameters by leaving out one block at a time, and the number of blocks."""
    design, target, weight, block = columns.design, columns.target, columns.weight * robust, columns.block
    numbers = [number for number in np.unique(block) if weight[block == number].any()]
    if len(numbers) < 2:
        return np.diag(np.full(6, np.inf)), len(numbers)
    parts = [_normal_equations(design[:, block == n], target[block == n], weight[block == n]) for n in numbers]
    normal, right = (sum(each) for each in zip(*parts, strict=True))
    whole = _solved(normal, right)
    apart = np.array([_solved(normal - part[0], right - part[1]) - whole for part in parts])
    return (len(numbers) - 1) / len(numbers) * np.einsum("gk,gl->kl", apart, apart), len(numbers)


def _notes(share: float, blocks: int, given: bool) -> tuple[str, ...]:
    notes = []
    if share < _FEW_STABLE and not given:
        notes.append(f"only {100 * share:.0f} % of the compared pixels are stable: name stable areas with --stable")
    if blocks < _FEWEST_BLOCKS:
        notes.append(
            f"the stable rock lies in {blocks} blocks of the wall: the registration's uncertainty is known poorly, "
            "and events far from it should be checked"
        )
    return tuple(notes)
