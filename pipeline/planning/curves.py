"""Compute the detection probability in the middle of the wall against range, angular step or cell, and angle of incidence.

The main statement of a plan, the column "middle" of its table and the curves all refer to the median over the same places, so
that they are consistent: the median of the smallest blocks is the size from which the median probability suffices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.precision.detectability import PlanningConfig, Sampling, detection_probability
from pipeline.precision.surface import BoolArray, Places, WallRaster
from scene.geometry.mesh import FloatArray

_MIDDLE_SHARE = 0.1
"""The middle of the wall consists of the places within this share of its smaller side from the centre of its extent."""
_MOST_PLACES = 201
"""Most places that represent the middle."""
_CURVE_POINTS = 80
"""Number of points of a curve."""
_LARGEST_INCIDENCE_RAD = np.radians(85)
"""Largest angle of incidence of a curve."""


@dataclass(frozen=True)
class Curve:
    """Store the detection probability of a fallen block as a function of one quantity, such as the range, to be drawn as a curve.

    It is the median over places in the middle of the wall. All other quantities have their values at these places.

    Attributes
    ----------
    label : str
        The quantity, with its unit.
    x : (k,) array
        Values of the quantity, in this unit.
    at : float
        Value of the quantity in the planned set-up, one of x.
    probability : dict of float to (k,) array
        Key: side of a cubic block, m. Value: the probability, 0 to 1, that its fall is detected, at each x.
    """

    label: str
    x: FloatArray
    at: float
    probability: dict[float, FloatArray]


def middle_places(raster: WallRaster, seen: BoolArray) -> BoolArray:
    """Select places that represent the middle of the wall: at most 201 that the sensor sees there, evenly spread.

    The statements of a plan about a typical place of the wall are medians over these places.

    Parameters
    ----------
    raster : WallRaster
        The wall, sampled at n places.
    seen : (n,) bool array
        True for places that the sensor sees.

    Returns
    -------
    (n,) bool array
        True for the selected places.
    """
    points = raster.places.points[:, :2]
    low, high = points.min(axis=0), points.max(axis=0)
    near = np.hypot(*(points - (low + high) / 2).T) <= _MIDDLE_SHARE * (high - low).min()
    rows = np.flatnonzero(near & seen)
    chosen = np.zeros(len(seen), dtype=bool)
    chosen[rows[:: max(-(-len(rows) // _MOST_PLACES), 1)]] = True
    return chosen


@dataclass(frozen=True)
class Views:
    """Describe how the sensor sees k places in the middle of the wall, to predict what it would see at other ranges and angles.

    Attributes
    ----------
    viewpoint : (3,) array
        Position of the sensor (of a stereo pair: middle of its base), wall frame, m.
    places : Places
        Positions, normals and albedo of the k places.
    aside : (k, 3) array
        Unit vectors perpendicular to the lines of sight, in the direction in which the normals deviate from them.
    range_m, incidence_rad : (k,) arrays
        Distance from the viewpoint, m, and angle between normal and line of sight, rad.
    """

    viewpoint: FloatArray
    places: Places
    aside: FloatArray
    range_m: FloatArray
    incidence_rad: FloatArray

    @classmethod
    def of(cls, places: Places, viewpoint: FloatArray, upright: FloatArray) -> Views:
        """Compute range and angle of incidence of places seen from a viewpoint.

        Parameters
        ----------
        places : Places
            The k places.
        viewpoint : (3,) array
            Position of the sensor, wall frame, m.
        upright : (3,) array
            Vertical axis of the sensor, wall frame. It says which way `seen_at` tilts a place that the sensor sees exactly at
            right angles: sideways, about this axis.
        """
        sight = places.points - viewpoint
        distance = np.linalg.norm(sight, axis=1)
        back = -sight / distance[:, None]
        cosine = np.clip(np.einsum("ni,ni->n", back, places.normals), -1.0, 1.0)
        aside = places.normals - cosine[:, None] * back
        length = np.linalg.norm(aside, axis=1, keepdims=True)
        sideways = np.cross(upright, -back)
        sideways /= np.maximum(np.linalg.norm(sideways, axis=1, keepdims=True), 1e-12)
        aside = np.where(length > 1e-9, aside / np.maximum(length, 1e-12), sideways)
        return cls(viewpoint, places, aside, distance, np.arccos(cosine))

    def seen_at(self, ratio: float = 1.0, turn_rad: float = 0.0) -> Places:
        """Return what the places would be at another range or angle of incidence, to predict how the sensor would measure them.

        They are moved along their lines of sight, and their normals are tilted.

        Parameters
        ----------
        ratio : float
            New range divided by the present range.
        turn_rad : float
            Amount, rad, that is added to every angle of incidence; the sum is limited to 0 to 85 degrees.
        """
        sight = self.places.points - self.viewpoint
        if turn_rad == 0:
            return replace(self.places, points=self.viewpoint + ratio * sight)
        angle = np.clip(self.incidence_rad + turn_rad, 0.0, _LARGEST_INCIDENCE_RAD)[:, None]
        normals = np.cos(angle) * -sight / self.range_m[:, None] + np.sin(angle) * self.aside
        return Places(self.viewpoint + ratio * sight, normals, self.places.albedo)


def probability_curves(
    sampling_of: Callable[[Places], tuple[Sampling, BoolArray]], views: Views, config: PlanningConfig, step: tuple[str, float]
) -> list[Curve]:
    """Compute how the detection probability of fallen blocks depends on range, sampling step and angle of incidence.

    Parameters
    ----------
    sampling_of : callable
        Function from places to their `Sampling` (density and precision of the points there) and a bool array, True for places
        within the sensor's reach.
    views : Views
        The places in the middle of the wall, as the sensor sees them.
    config : PlanningConfig
        Sizes of the blocks, and settings of the test for a change.
    step : (str, float)
        Name and unit of the sampling step for the axis of the curve, and its value in the planned set-up.

    Returns
    -------
    list of Curve
        Three curves, one for each quantity; an empty list if nothing is seen in the middle of the wall.
    """
    if not len(views.range_m):
        return []
    ratios = _with(np.geomspace(0.2, 5.0, _CURVE_POINTS), 1.0)
    steps = _with(np.geomspace(0.1, 10.0, _CURVE_POINTS), 1.0)
    here = float(np.median(views.incidence_rad))
    turns = _with(np.linspace(0.0, _LARGEST_INCIDENCE_RAD, _CURVE_POINTS) - here, 0.0)
    own = sampling_of(views.seen_at())

    def stretched(scale: float) -> tuple[Sampling, BoolArray]:
        sampling, reached = own
        return replace(sampling, step_a=sampling.step_a * scale, step_b=sampling.step_b * scale), reached

    def curve(label: str, x: FloatArray, at: float, found: list[tuple[Sampling, BoolArray]]) -> Curve:
        shares = {size: np.array([_median(each, size, config) for each in found]) for size in config.block_size_m}
        return Curve(label, x, at, shares)

    distance = float(np.median(views.range_m))
    return [
        curve("range, m", ratios * distance, distance, [sampling_of(views.seen_at(ratio)) for ratio in ratios]),
        curve(step[0], steps * step[1], step[1], [stretched(scale) for scale in steps]),
        curve(
            "angle of incidence, deg",
            np.degrees(turns + here),
            float(np.degrees(here)),
            [sampling_of(views.seen_at(turn_rad=turn)) for turn in turns],
        ),
    ]


def _median(found: tuple[Sampling, BoolArray], size: float, config: PlanningConfig) -> float:
    """Return the median over places of the detection probability of a block of side `size`, m; 0 where nothing is seen."""
    return float(np.median(np.where(found[1], detection_probability(found[0], size, config), 0.0)))


def _with(x: FloatArray, value: float) -> FloatArray:
    """Return the values with one more among them, sorted."""
    return np.unique(np.append(x, value))
