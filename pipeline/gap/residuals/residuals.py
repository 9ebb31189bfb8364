"""Hold the residuals (measured minus predicted observable) of one measurement, in the form that both sensors share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.residuals.correlated_noise import NO_CORRELATED_NOISE, GridCorrelatedNoise
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray
from sensors.effects import Effects, catalogue
from sensors.effects.base import Effect, Sensor

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

BoolArray = NDArray[np.bool_]
Rows = BoolArray | NDArray[np.int64] | slice
"""Which of n points are meant: a mask, row numbers or a slice."""
_Columns = TypeVar("_Columns", bound="DataclassInstance")


class Geometry(Protocol):
    """Geometry of n measured points, as the equations of the effects use it. Each kind of sensor has a class of its own."""

    def __len__(self) -> int: ...

    def part(self, rows: Rows) -> Self:
        """Return the geometry of a subset of the n points, given as row numbers, a mask or a slice."""

    @property
    def sensor_coordinates(self) -> FloatArray:
        """(n, 2) direction of each point in sensor coordinates: azimuth and zenith, rad, or image column and row, px."""

    @property
    def departure(self) -> FloatArray:
        """(n,) measured minus geometric observable, m or px, without any effect of the model."""


def _order(values: FloatArray) -> NDArray[np.int32]:
    """Row numbers that sort the values, ascending; equal values keep their order."""
    return np.argsort(values, kind="stable").astype(np.int32)


def select_rows(columns: _Columns, rows: Rows) -> _Columns:
    """Return the same dataclass with only some rows of its (n, ...) arrays; fields that are None stay None.

    Parameters
    ----------
    columns : A dataclass whose fields are arrays with n rows, or None.
    rows : Row numbers, a mask or a slice.
    """
    values: dict[str, Any] = {column.name: getattr(columns, column.name) for column in fields(columns)}
    return replace(columns, **{name: value[rows] for name, value in values.items() if value is not None})


@dataclass(frozen=True)
class Residuals(ABC):
    """Residuals of n points, measured minus predicted observable, with all that is needed to explain them.

    The observable is a range (m) for a laser scan, a disparity (px) for a stereo pair, or a distance along the normal (m) for a
    surface without cameras.

    Attributes
    ----------
    value : (n,) residuals, in the unit of the observable.
    sigma : (n,) standard deviation that the model predicts, same unit.
    unit_m : (n,) metres of range or depth per unit of the observable, always positive (`depth_m` has the sign).
    usable : (n,) whether a point is used for fitting: the surface around it is smooth, and it lies on stable ground.
    on_smooth_surface : (n,) whether the surface around a point is smooth, on stable ground or not.
    pose_jacobian : (n, 6 k) derivatives of the observable by the poses of k set-ups: shift (m) and small rotation (rad) of each
        in the wall frame. A surface without cameras has up to seven columns (with a scale).
    wall_xy : (n, 2) x and y of the reference's point in the wall frame, m. It does not move with the noise of the measured point.
    covariates : (n,) arrays by name, on which an error may depend.
    index : (n,) rows of the points in the measurement.
    geometry : The rays or pixels behind the points.
    epoch_offset : (n,) what was subtracted from `value` because each epoch had its own pose; None for a single epoch.
    notes : Remarks for the user.
    expected_pulses : Pulses that should have hit the wall; None if the scan pattern is not known.
    correlated_noise : The part of the predicted noise that neighbouring points share.

    Class attributes
    ----------------
    sensor : Sensor whose catalogue of effects applies.
    position_covariates : Names of the two covariates of the point's position in the sensor's field of view, along which an error
        may vary jointly.
    empirical_term, white_noise : The effect class of an empirical term and of white noise for this observable, each with the name
        of the field that holds its values.
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
        """(n,) signed change of depth per unit of the observable, m: positive if a larger value means missing rock."""

    @property
    def with_sigma_of_means(self) -> Self:
        """Return the residuals with the sigma that counts for means over many neighbours: sqrt(n) times the sigma of a mean of n.

        It is larger than the sigma of single points if neighbours share noise.
        """
        return self

    def reference_covariance_with(self, other: NDArray[np.int64]) -> FloatArray:
        """Return the covariance of each point's error with that of another point, as far as errors of the reference cause it.

        Parameters
        ----------
        other : (n,) row of the other point.

        Returns
        -------
        (n,) covariances, squared unit of the observable.
        """
        return np.zeros(len(other))

    @property
    def candidates(self) -> Effects:
        """Classes of the effects that may be named for this kind of measurement."""
        return catalogue(self.sensor)

    @property
    def total_departure(self) -> FloatArray:
        """(n,) measured minus geometric observable without any effect of the model, with each epoch's own pose removed."""
        return self.geometry.departure if self.epoch_offset is None else self.geometry.departure - self.epoch_offset

    @cached_property
    def sort_orders(self) -> dict[str, NDArray[np.int32]]:
        """For each covariate, the (n,) row numbers that sort it in ascending order; equal values keep their order."""
        return dict(zip(self.covariates, map_in_threads(_order, self.covariates.values()), strict=True))

    def values_at(self, values: FloatArray, index: NDArray[np.int64]) -> FloatArray:
        """Look values up by the row numbers of points in the measurement.

        Parameters
        ----------
        values : (n,) one value for each residual.
        index : (m,) rows of points in the measurement.

        Returns
        -------
        (m,) values; NaN for points without a residual.
        """
        found = np.full(int(max(self.index.max(initial=-1), index.max(initial=-1))) + 1, np.nan)
        found[self.index] = values
        return np.asarray(found[index])

    def part(self, rows: Rows) -> Self:
        """Return the residuals of a subset of the n points, given as row numbers, a mask or a slice."""
        return replace(
            self,
            value=self.value[rows],
            sigma=self.sigma[rows],
            unit_m=self.unit_m[rows],
            usable=self.usable[rows],
            on_smooth_surface=self.on_smooth_surface[rows],
            pose_jacobian=self.pose_jacobian[rows],
            wall_xy=self.wall_xy[rows],
            covariates={name: values[rows] for name, values in self.covariates.items()},
            index=self.index[rows],
            geometry=self.geometry.part(rows),
            epoch_offset=None if self.epoch_offset is None else self.epoch_offset[rows],
            correlated_noise=self.correlated_noise.part(rows),
        )

    def with_rows_from(self, known: BoolArray, other: Self) -> Self:
        """Replace some rows by those of other residuals, except `usable` and `on_smooth_surface`, which stay.

        Parameters
        ----------
        known : (n,) true for rows to replace.
        other : Residuals of just those points, in the same order.
        """
        names = ("value", "sigma", "unit_m", "pose_jacobian", "wall_xy")
        columns: dict[str, Any] = {name: _merged(getattr(self, name), getattr(other, name), known) for name in names}
        columns["covariates"] = {name: _merged(values, other.covariates[name], known) for name, values in self.covariates.items()}
        mine, theirs = vars(self.geometry), vars(other.geometry)
        pairs = {name: _merged(values, theirs[name], known) for name, values in mine.items() if values is not None}
        geometry: Any = self.geometry
        return replace(self, **columns, geometry=replace(geometry, **pairs))


def _merged(mine: NDArray[Any], theirs: NDArray[Any], known: BoolArray) -> NDArray[Any]:
    """Return (n, ...) values in which the rows `known` are replaced by `theirs`."""
    found = mine.copy()
    found[known] = theirs
    return found


@dataclass(frozen=True)
class ExpectedPulses:
    """The m pulses of a scan pattern that should have hit the wall, and whether each returned.

    Attributes
    ----------
    lost : (m,) true for a pulse in whose direction no point was recorded.
    covariates : (m,) arrays by name, on which a loss may depend.
    wall_xy : (m, 2) x and y of the place on the wall that the pulse should have hit, wall frame, m.
    """

    lost: BoolArray
    covariates: dict[str, FloatArray] = field(default_factory=dict)
    wall_xy: FloatArray = field(default_factory=lambda: np.empty((0, 2)))


def range_derivative(normal: FloatArray, direction: FloatArray, moved: FloatArray, distance: FloatArray) -> FloatArray:
    """Return how the distance to a plane along a ray changes as the ray turns.

    With t = (p - o)·n / (u·n), for a plane through p and a ray from o, the derivative is dt = -t (du·n) / (u·n).

    Parameters
    ----------
    normal : (n, 3) normals n of the planes.
    direction : (n, 3) unit directions u of the rays.
    moved : (n, 3) derivative du of the direction, per unit of the turning angle.
    distance : (n,) distances t, m.

    Returns
    -------
    (n,) derivative of the distance, m per unit of the turning angle.
    """
    return -distance * np.einsum("ni,ni->n", moved, normal) / np.einsum("ni,ni->n", direction, normal)
