"""The disagreement at the level of the raw observable, common to both sensors."""

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
"""Some of n points: a mask or indices."""
_Columns = TypeVar("_Columns", bound="DataclassInstance")


class Geometry(Protocol):
    """What the equations of either sensor's effects look at, at n points."""

    def __len__(self) -> int: ...

    def part(self, rows: Rows) -> Self:
        """The same of some of the points."""

    @property
    def sensor_coordinates(self) -> FloatArray:
        """(n, 2) direction as the sensor counts it: azimuth and zenith, rad, or column and row, px."""

    @property
    def departure(self) -> FloatArray:
        """(n,) measured minus geometric observable, m or px, without any effect of the model."""


def _order(values: FloatArray) -> NDArray[np.int32]:
    return np.argsort(values, kind="stable").astype(np.int32)


def select_rows(columns: _Columns, rows: Rows) -> _Columns:
    """Some rows of a dataclass of (n, ...) arrays, some of which may be None."""
    values: dict[str, Any] = {column.name: getattr(columns, column.name) for column in fields(columns)}
    return replace(columns, **{name: value[rows] for name, value in values.items() if value is not None})


@dataclass(frozen=True)
class Residuals(ABC):
    """Measured minus predicted observable of n points, with what it may depend on; what ranges and disparities have in common.

    value, sigma: (n,), m of range (TLS) or px of disparity (stereo), sigma being what the model predicts; unit_m: (n,) metres of
    range or depth per unit of the observable, without the sign that `depth_m` has; smooth: (n,) where the surface around the
    point is smooth enough for a mean to make sense, and of stable ground; even: the same of any ground; pose: (n, 6) derivatives
    by translation (m) and rotation (rad) of the sensor in the wall frame; at: (n, 2) wall frame x, y of the reference's point,
    which unlike the measured one does not move with the noise, m; covariates: named (n,) arrays; index: (n,) rows of the
    measurement's points; away: (n,) what was taken off `value` because epochs were taken from places of their own, None where
    they were not; missing: of the pulses that were sent and should have met the wall, None where the pattern is not known;
    shared_noise: predicted noise that neighbours share.

    What stands on the class: planes, the two covariates that an error may depend on together; described_by, noise: the empirical
    term and the white noise in the observable's unit, each with the name of its values; called: what they are in words.
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
        """(n,) metres by which the surface lies deeper per unit of the observable: positive where rock is missing."""

    @property
    def with_sigma_of_means(self) -> Self:
        """With the spread that counts for means of many neighbours: root n times that of a mean of n."""
        return self

    def reference_covariance_with(self, other: NDArray[np.int64]) -> FloatArray:
        """(n,) covariance of each point's predicted noise with that of another, the row `other` (n,), by the reference's."""
        return np.zeros(len(other))

    @property
    def candidates(self) -> Effects:
        """The effects that may be named."""
        return catalogue(self.sensor)

    @property
    def total_departure(self) -> FloatArray:
        """(n,) measured minus geometric observable, without any effect of the model, as if all epochs had one place."""
        return self.geometry.departure if self.epoch_offset is None else self.geometry.departure - self.epoch_offset

    @cached_property
    def sort_orders(self) -> dict[str, NDArray[np.int32]]:
        """(n,) rows by the value of each covariate, rising, and where that is the same as they are."""
        return dict(zip(self.covariates, map_in_threads(_order, self.covariates.values()), strict=True))

    def values_at(self, values: FloatArray, index: NDArray[np.int64]) -> FloatArray:
        """(m,) values (n,) of these residuals at the measurement's points `index` (m,); NaN where there is no residual."""
        found = np.full(int(max(self.index.max(initial=-1), index.max(initial=-1))) + 1, np.nan)
        found[self.index] = values
        return np.asarray(found[index])

    def part(self, rows: Rows) -> Self:
        """The residuals of some of the points."""
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
        """With what `other` has of the points `known` (n,), in their order, but for which of them are smooth or even."""
        names = ("value", "sigma", "unit_m", "pose_jacobian", "wall_xy")
        columns: dict[str, Any] = {name: _merged(getattr(self, name), getattr(other, name), known) for name in names}
        columns["covariates"] = {name: _merged(values, other.covariates[name], known) for name, values in self.covariates.items()}
        mine, theirs = vars(self.geometry), vars(other.geometry)
        pairs = {name: _merged(values, theirs[name], known) for name, values in mine.items() if values is not None}
        geometry: Any = self.geometry
        return replace(self, **columns, geometry=replace(geometry, **pairs))


def _merged(mine: NDArray[Any], theirs: NDArray[Any], known: BoolArray) -> NDArray[Any]:
    """(n, ...) values with others in the rows `known`."""
    found = mine.copy()
    found[known] = theirs
    return found


@dataclass(frozen=True)
class ExpectedPulses:
    """Pulses of the pattern that should have met the wall. lost: (m,) whether no point stands in that direction."""

    lost: BoolArray
    covariates: dict[str, FloatArray] = field(default_factory=dict)
    wall_xy: FloatArray = field(default_factory=lambda: np.empty((0, 2)))


def range_derivative(normal: FloatArray, direction: FloatArray, moved: FloatArray, distance: FloatArray) -> FloatArray:
    """(n,) change of the distance to a plane along a ray whose unit direction changes by `moved`, m per unit.

    From t = (p - o).n / (u.n): dt = -t (du.n) / (u.n).
    """
    return -distance * np.einsum("ni,ni->n", moved, normal) / np.einsum("ni,ni->n", direction, normal)
