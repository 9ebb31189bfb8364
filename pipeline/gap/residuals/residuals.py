"""Hold the residuals (measured minus predicted observable) of one measurement, in the form that both sensors share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.residuals.correlated_noise import NO_CORRELATED_NOISE, GridCorrelatedNoise
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray
from sensors.effects import Effects, catalogue
from sensors.effects.base import Effect, Sensor

BoolArray = NDArray[np.bool_]
Rows = BoolArray | NDArray[np.int64] | slice
"""Which of n points are meant: a mask, row numbers or a slice."""
_Columns = TypeVar("_Columns")
POINT_COLUMNS = ("value", "sigma", "unit_m", "usable", "on_smooth_surface", "pose_jacobian", "wall_xy", "index")
"""Fields of `Residuals` that are arrays with a row for each point."""


class Geometry(Protocol):
    """Interface of the geometry of n measured points: the quantities on which errors of the sensor depend, such as the range.

    There is a geometry of laser rays, one of matched pixels, and one of the points of a cloud without cameras.
    """

    def __len__(self) -> int: ...

    def part(self, rows: Rows) -> Self:
        """Return the geometry of a subset of the n points, given as row numbers, a mask (n,) or a slice."""

    @property
    def sensor_coordinates(self) -> FloatArray:
        """(n, 2) position of each point in the sensor's field of view.

        For a scanner these are azimuth and zenith angle, rad; for a stereo pair column and row of the left image, px; for a
        cloud without cameras positions along and up the wall, m.
        """

    @property
    def departure(self) -> FloatArray:
        """(n,) measured observable minus that of the reference surface, m or px, with predicted systematic errors still in it."""


def select_rows(columns: _Columns, rows: Rows) -> _Columns:
    """Return a copy of a dataclass of arrays with chosen rows only, to restrict measured quantities to a subset of the points.

    columns: its fields are arrays (n, ...), one row for each of n points, or None (which stays None). rows: row numbers, a mask
    (n,) or a slice.
    """
    found: Any = columns
    kept, values = _without_mask(rows), {column.name: getattr(found, column.name) for column in fields(found)}
    return replace(found, **{name: _rows_of(value, kept) for name, value in values.items() if value is not None})


def _without_mask(rows: Rows) -> NDArray[np.int64] | slice:
    """Replace a mask by its row numbers, which are found once for many arrays."""
    return rows if isinstance(rows, slice) else np.flatnonzero(rows) if rows.dtype == bool else np.asarray(rows, dtype=np.int64)


def _rows_of(values: NDArray[Any], rows: NDArray[np.int64] | slice) -> NDArray[Any]:
    """Rows of an array (n, ...). `take` copies rows of several values two to four times faster than indexing does."""
    return values[rows] if isinstance(rows, slice) else values.take(rows, axis=0)


@dataclass(frozen=True)
class Residuals(ABC):
    """Residuals of n points (measured minus predicted observable) with all that is needed to explain them by sensor errors.

    The observable is a range (m) for a laser scan, a disparity (px) for a stereo pair, or a distance along the normal (m) for a
    point cloud without cameras. It is predicted from the reference surface and the sensor model.

    Attributes
    ----------
    value : (n,) residuals, in the unit of the observable.
    sigma : (n,) standard deviation that the sensor model predicts, same unit.
    unit_m : (n,) metres of range or depth per unit of the observable, always positive (`depth_m` has the sign).
    usable : (n,) whether a point is used for fitting: the surface around it is smooth, and it lies on stable ground.
    on_smooth_surface : (n,) whether the surface around a point is smooth, on stable ground or not.
    pose_jacobian : (n, 6 k) derivatives of the observable by the poses of k set-ups (positions of the sensor): shift (m) and
        small rotation (rad) of each in the wall frame. A cloud without cameras has up to seven columns (with a scale).
    wall_xy : (n, 2) x (along the wall) and y (up) of the place on the reference, wall frame, m. It does not move with the noise
        of the measured point.
    covariates : (n,) arrays by name, such as "range" or "incidence", on which an error may depend.
    index : (n,) row number of each point in the measurement.
    geometry : Geometry of the rays, pixels or points.
    epoch_offset : (n,) what was subtracted from `value` because each epoch had its own pose; None for a single epoch.
    notes : Remarks for the user.
    expected_pulses : Laser pulses that should have hit the wall, returned or not; None if the scan pattern is not known.
    correlated_noise : The part of the predicted noise that neighbouring points share.

    Class attributes
    ----------------
    sensor : Kind of sensor, "tls" or "stereo", which decides the effects that may explain the residuals.
    position_covariates : Names of the two covariates of the point's position in the sensor's field of view. An error may depend
        on both jointly.
    empirical_term, white_noise : For this observable the effect class of a fitted curve or surface without physical cause, and
        that of white noise, each with the name of the field that holds its values.
    label : What the points are, in words for the report.
    """

    sensor: ClassVar[Sensor]
    position_covariates: ClassVar[tuple[str, str]]
    empirical_term: ClassVar[tuple[type[Effect], str]]
    white_noise: ClassVar[tuple[type[Effect], str]]
    label: ClassVar[str]
    value: FloatArray
    sigma: FloatArray
    unit_m: FloatArray
    usable: BoolArray
    on_smooth_surface: BoolArray
    pose_jacobian: FloatArray
    wall_xy: FloatArray
    covariates: dict[str, FloatArray]
    index: NDArray[np.int64]
    geometry: Geometry
    epoch_offset: FloatArray | None = None
    notes: tuple[str, ...] = ()
    expected_pulses: ExpectedPulses | None = None
    correlated_noise: GridCorrelatedNoise = NO_CORRELATED_NOISE

    def __len__(self) -> int:
        return len(self.value)

    @property
    @abstractmethod
    def depth_m(self) -> FloatArray:
        """(n,) signed change of depth per unit of the observable, m: positive if a larger value means that rock is missing."""

    @property
    def with_sigma_of_means(self) -> Self:
        """Return the residuals with a `sigma` that is right for means over many neighbouring points.

        Divided by sqrt(k), this `sigma` is the standard deviation of a mean of k neighbours. It is larger than that of single
        points if neighbours share noise. This base class assumes that they do not.
        """
        return self

    def reference_covariance_with(self, other: NDArray[np.int64]) -> FloatArray:
        """Return the covariance (n,), m² or px², of each point's residual with another one's due to errors of the reference.

        It is needed for the variance of differences of neighbouring residuals. other: (n,) row numbers of the other points. This
        base class assumes that the reference has no such errors.
        """
        return np.zeros(len(other))

    @property
    def candidates(self) -> Effects:
        """Classes of the effects (error terms of a sensor model) that may explain residuals of this kind of measurement."""
        return catalogue(self.sensor)

    @property
    def total_departure(self) -> FloatArray:
        """(n,) measured observable minus that of the reference, m or px, with predicted systematic errors still in it.

        The difference of each of several epochs' poses from the mean pose has been removed; the error of the mean pose has not.
        """
        return self.geometry.departure if self.epoch_offset is None else self.geometry.departure - self.epoch_offset

    @cached_property
    def sort_orders(self) -> dict[str, NDArray[np.int32]]:
        """For each covariate by name, the (n,) row numbers that sort the points by it, to divide them into bins."""
        orders = map_in_threads(lambda x: np.argsort(x, kind="stable").astype(np.int32), self.covariates.values())
        return dict(zip(self.covariates, orders, strict=True))

    def values_at(self, values: FloatArray, index: NDArray[np.int64]) -> FloatArray:
        """Look up values of these residuals' points by row numbers in the measurement, to compare residuals of other points.

        values: one for each of the n points of these residuals. index: (m,) row numbers in the measurement of the wanted points.
        Returns the values (m,); NaN for points that have no residual here.
        """
        found = np.full(int(max(self.index.max(initial=-1), index.max(initial=-1))) + 1, np.nan)
        found[self.index] = values
        return np.asarray(found[index])

    def part(self, rows: Rows) -> Self:
        """Return the residuals of a subset of the n points, given as row numbers, a mask (n,) or a slice."""
        kept = _without_mask(rows)
        columns: dict[str, Any] = {name: _rows_of(getattr(self, name), kept) for name in POINT_COLUMNS}
        return replace(
            self,
            **columns,
            covariates={name: _rows_of(values, kept) for name, values in self.covariates.items()},
            geometry=self.geometry.part(kept),
            epoch_offset=None if self.epoch_offset is None else _rows_of(self.epoch_offset, kept),
            correlated_noise=self.correlated_noise.part(kept),
        )

    def with_rows_from(self, known: BoolArray, other: Self) -> Self:
        """Replace the residuals of some points, for example by those under a sensor model with more effects.

        known: (n,) true for the points to replace. other: new residuals of just these points, in the same order. `usable` and
        `on_smooth_surface` stay.
        """

        def merged(mine: dict[str, Any], theirs: dict[str, Any]) -> dict[str, Any]:
            found = {name: values.copy() for name, values in mine.items() if values is not None}
            for name, values in found.items():
                values[known] = theirs[name]
            return found

        columns = {name: getattr(self, name) for name in ("value", "sigma", "unit_m", "pose_jacobian", "wall_xy")}
        covariates = merged(self.covariates, other.covariates)
        geometry: Any = self.geometry
        geometry = replace(geometry, **merged(vars(geometry), vars(other.geometry)))
        return replace(self, **merged(columns, vars(other)), covariates=covariates, geometry=geometry)


@dataclass(frozen=True)
class ExpectedPulses:
    """The m pulses of a scan pattern that should have hit the wall, and whether each returned; used to explain lost returns.

    Attributes
    ----------
    lost : (m,) true for a pulse in whose direction no point was recorded.
    covariates : (m,) arrays by name, such as "range" or "incidence", on which the probability of a loss may depend.
    wall_xy : (m, 2) x (along the wall) and y (up) of the place that the pulse should have hit, wall frame, m.
    """

    lost: BoolArray
    covariates: dict[str, FloatArray]
    wall_xy: FloatArray


def range_derivative(normal: FloatArray, direction: FloatArray, moved: FloatArray, distance: FloatArray) -> FloatArray:
    """Return how the range along a ray to a plane changes as the ray turns, (n,), m/rad: -t (du·n) / (u·n).

    This is the derivative of the range t = (p - o)·n / (u·n) from o to a plane through p.

    Parameters
    ----------
    normal : (n, 3) unit normals n of the planes.
    direction : (n, 3) unit directions u of the rays, same frame.
    moved : (n, 3) derivative du of the direction by the turning angle, per rad.
    distance : (n,) ranges t, m.
    """
    return -distance * np.einsum("ni,ni->n", moved, normal) / np.einsum("ni,ni->n", direction, normal)
