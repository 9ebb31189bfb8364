"""Last step of the diagnosis: measure how much of the gap between model and measurement the named effects close."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.naming.gap_score import LOSS_MEASURE, Gap, RegisteredModel, measure_gap, measure_losses
from pipeline.gap.naming.named_effects import NamedEffect, aligned_with, with_effects
from pipeline.gap.noise_and_edges.missing_returns import LossExplanation
from pipeline.gap.residuals.alignment import fit_pose
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import ShowsIn
from sensors.models.sensor_model import StereoModel, TlsModel

_FEWEST_POINTS, _MOST_POINTS = 100, 30_000
"""Fewest points that are scored. From twice the second number on, only every second, third ... point is used, to save time."""


@dataclass(frozen=True)
class ValidationResult:
    """A sensor model with certain sensor errors (effects) in it, and how well it predicts validation points.

    Validation points are those that no fit used.

    Attributes
    ----------
    named : effects in the model.
    reduced_noise : noise values of the model that were lowered, by key; empty if its noise was kept.
    model : the model.
    value : (n,) residuals against it after registration, in the unit of the observable (m or px); NaN where a ray misses the
        reference.
    pose : pose of that registration, in the form of `RegisteredModel.pose`.
    gap : scores of the model without and with the effects; None if too few points can be scored.
    """

    named: list[NamedEffect]
    reduced_noise: dict[str, float]
    model: TlsModel | StereoModel
    value: FloatArray
    pose: FloatArray
    gap: Gap | None

    @property
    def is_worse(self) -> bool:
        """Whether the sensor model predicts validation points worse with the named sensor errors in it than without them.

        False if the scores are those of missing returns: there, one shrub in front of the validation points outweighs a few
        lost pulses.
        """
        gap = self.gap
        return gap is not None and gap.measure != LOSS_MEASURE and gap.after > gap.before


@dataclass(frozen=True)
class Validation:
    """Measures how well a sensor model predicts validation points with any choice of sensor errors (effects) in it.

    Attributes
    ----------
    measurement : the measured points, with the sensor at its aligned pose.
    residuals : residuals of n points against its model.
    registration_rows : rows of the residuals from which the pose is estimated.
    tested : (n,) true for validation points, which no earlier step has used.
    training : (n,) true for points that the selection of effects may use.
    losses : explanation of the missing laser returns, and a mask of the expected pulses that is true where the explanation was
        not fitted; None if missing returns were not explained.
    reference_sigma : standard deviation of the error of the reference surface, in the unit of the observable (m or px).
    most_sigmas : points farther than this many predicted standard deviations from the models are not scored.
    random : source of random numbers.
    reduced_noise : lower noise values to propose, by key; empty if the model's noise is not too large.
    """

    measurement: Measurement
    residuals: Residuals
    registration_rows: NDArray[np.int64]
    tested: BoolArray
    training: BoolArray
    losses: tuple[LossExplanation, BoolArray] | None
    reference_sigma: float
    most_sigmas: float
    random: KeyedRandom
    reduced_noise: dict[str, float] = field(default_factory=dict)

    @property
    def pose(self) -> FloatArray:
        """Pose that registers the measurement to the model without named effects, in the form of `RegisteredModel.pose`."""
        return fit_pose(self.residuals, self.registration_rows)

    def validate(self, named: list[NamedEffect]) -> ValidationResult:
        """Score the sensor model without and with the named effects on validation points.

        Lower noise values are proposed only if the model predicts better with them.

        named: effects (sensor errors) that passed the selection.
        """
        result = self._result_of(named)
        return replace(self, reduced_noise={}).validate(named) if self.reduced_noise and result.is_worse else result

    def _model(self, named: list[NamedEffect]) -> TlsModel | StereoModel:
        """The model with the effects and the reduced noise."""
        return with_effects(self.measurement.model, [item.entry for item in named], self.reduced_noise)

    def _result_of(self, named: list[NamedEffect]) -> ValidationResult:
        """Put the effects into the model and measure the gap on the validation points."""
        value, pose = self._registered(named)
        versions = RegisteredModel(self.measurement.model, self.pose), RegisteredModel(self._model(_without_losses(named)), pose)
        return ValidationResult(
            named, self.reduced_noise, self._model(named), value, pose, self._gap(named, versions, self.tested)
        )

    def _registered(self, named: list[NamedEffect]) -> tuple[FloatArray, FloatArray]:
        """Return the residuals (n,) and the pose (6,) after registration with some effects in the model.

        The points are always the same. Residuals are NaN where rays miss the reference.
        """
        if not (named or self.reduced_noise):
            return self.residuals.value - self.residuals.pose_jacobian @ self.pose, self.pose
        registered_points = self.residuals.index[self.registration_rows]
        _, found, pose = aligned_with(self.measurement, named, registered_points, self.reduced_noise)
        rest = fit_pose(found, found.usable & np.isin(found.index, registered_points))
        return found.values_at(found.value - found.pose_jacobian @ rest, self.residuals.index), pose + rest

    def _gap(self, named: list[NamedEffect], versions: tuple[RegisteredModel, RegisteredModel], rows: BoolArray) -> Gap | None:
        """Score two models on some points (n,), or on pulses if the first effect explains missing returns."""
        missing = self.residuals.expected_pulses
        if self.losses is not None and missing is not None and named and named[0].name == f"tls.{self.losses[0].name}":
            found, held_out = self.losses
            share = np.full(len(held_out), float(missing.lost.mean()))
            return measure_losses(missing, share if found.covariate else found.probability, held_out)
        places = np.flatnonzero(rows)
        if len(places) < _FEWEST_POINTS:
            return None
        part = self.residuals.part(places[:: max(len(places) // _MOST_POINTS, 1)])
        random = self.random.child("verify")
        return measure_gap(self.measurement, *versions, part, self.reference_sigma, self.most_sigmas, random)


def _without_losses(named: list[NamedEffect]) -> list[NamedEffect]:
    """Return the effects without those that only remove or add returns, because these change no range on the wall."""
    return [item for item in named if item.effect.shows_in != ShowsIn.RETURNS]
