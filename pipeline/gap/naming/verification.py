"""The last step: the gap with the named effects in the model. What makes the model predict worse is taken out again."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.decisions import decided
from pipeline.gap.naming.entries import Named, settled_with, with_effects
from pipeline.gap.naming.verify import LOSS_MEASURE, Gap, Version, measure_gap, measure_losses, thinned
from pipeline.gap.other.missing import MissingFound
from pipeline.gap.residuals.alignment import fit_pose
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import ShowsIn
from sensors.models.sensor_model import StereoModel, TlsModel

_FEWEST_POINTS = 100


@dataclass(frozen=True)
class Shown:
    """The model with some effects, and values of a lower noise, (n,) residuals against it, registered, the pose (6,) of that, and
    the gap that is left."""

    named: list[Named]
    lower: dict[str, float]
    model: TlsModel | StereoModel
    value: FloatArray
    pose: FloatArray
    gap: Gap | None

    @property
    def is_worse(self) -> bool:
        """Whether the model predicts no better with the effects than without them.

        Of losses that is no judge: a shrub before the held-out blocks has more to say than a few drops.
        """
        gap = self.gap
        return gap is not None and gap.measure != LOSS_MEASURE and gap.after > gap.before

    @property
    def is_clearly_worse(self) -> bool:
        """Whether that is by more than its uncertainty."""
        return (
            self.is_worse
            and self.gap is not None
            and self.gap.after - self.gap.before > decided().verdict.gap_sigmas * self.gap.error
        )


@dataclass(frozen=True)
class Showing:
    """What a gap is measured with.

    measurement: where its sensor stood; residuals: against its model, of which the rows `chosen` register; tested, learned: (n,)
    points that no step has looked at, and those that naming may; losses: what was found of them, and the pulses that it was not
    fitted to; reference_sigma: in the observable's unit; largest: predicted sigmas by which points may be off; lower: values of
    the model's noise that are proposed since it is too large.
    """

    measurement: Measurement
    residuals: Residuals
    chosen: NDArray[np.int64]
    tested: BoolArray
    learned: BoolArray
    losses: tuple[MissingFound, BoolArray] | None
    reference_sigma: float
    largest: float
    random: KeyedRandom
    lower: dict[str, float] = field(default_factory=dict)

    @property
    def pose(self) -> FloatArray:
        """(6,) by which the model as it is is registered."""
        return fit_pose(self.residuals, self.chosen)

    def show(self, named: list[Named]) -> tuple[Shown, list[str]]:
        """The gap on points that no step has used, and words for effects that are taken out.

        As long as it is larger with the effects than without, and some effect does harm on points that may be looked at too, by
        more than the uncertainty of that, the one goes that does most; where the gap itself is larger by more than its
        uncertainty one goes in any case. What is described, not named, goes only then. A lower noise is proposed only if it
        predicts better.
        """
        shown, words = self._of(named, self.tested), []
        if self.lower and shown.is_worse:
            return replace(self, lower={}).show(named)
        while shown.is_worse:
            doubtful = [item for item in _scored(shown.named) if shown.is_clearly_worse or _may_be_harmful(item)]
            harms = [self._harm(shown, item) for item in doubtful]
            if max(harms, default=0.0) <= 0:
                break
            out = doubtful[int(np.argmax(harms))]
            words.append(f"{out.name} dropped: with it the model predicts worse")
            shown = self._of([item for item in shown.named if item is not out], self.tested)
        return shown, words

    def _harm(self, shown: Shown, item: Named) -> float:
        """By how much more than its uncertainty the model predicts the points that may be looked at worse with an effect than
        without; the same points, since an effect that moves some far may bring others near."""
        others = [each for each in shown.named if each is not item]
        without = Version(self._model(_scored(others)), self._registered(others)[1])
        gap = self._gap(shown.named, (without, Version(self._model(_scored(shown.named)), shown.pose)), self.learned)
        return 0.0 if gap is None else gap.after - gap.before - decided().verdict.gap_sigmas * gap.error

    def _model(self, named: list[Named]) -> TlsModel | StereoModel:
        return with_effects(self.measurement.model, [item.entry for item in named], self.lower)

    def _of(self, named: list[Named], rows: BoolArray) -> Shown:
        value, pose = self._registered(named)
        versions = Version(self.measurement.model, self.pose), Version(self._model(_scored(named)), pose)
        return Shown(named, self.lower, self._model(named), value, pose, self._gap(named, versions, rows))

    def _registered(self, named: list[Named]) -> tuple[FloatArray, FloatArray]:
        """(n,) residuals of the same points with some effects, NaN where their rays miss the reference; the pose (6,)."""
        if not (named or self.lower):
            return self.residuals.value - self.residuals.pose_jacobian @ self.pose, self.pose
        trusted = self.residuals.index[self.chosen]
        _, found, there = settled_with(self.measurement, named, trusted, self.lower)
        rest = fit_pose(found, found.usable & np.isin(found.index, trusted))
        return found.values_at(found.value - found.pose_jacobian @ rest, self.residuals.index), there + rest

    def _gap(self, named: list[Named], versions: tuple[Version, Version], rows: BoolArray) -> Gap | None:
        missing = self.residuals.expected_pulses
        if self.losses is not None and missing is not None and named and named[0].name == f"tls.{self.losses[0].name}":
            found, held_out = self.losses
            share = np.full(len(held_out), float(missing.lost.mean()))
            return measure_losses(missing, share if found.covariate else found.chance, held_out)
        places = np.flatnonzero(rows)
        if len(places) < _FEWEST_POINTS:
            return None
        part = self.residuals.part(places[thinned(len(places))])
        random = self.random.child("verify")
        return measure_gap(self.measurement, *versions, part, self.reference_sigma, self.largest, random)


def _scored(named: list[Named]) -> list[Named]:
    """Those that ranges are scored with: drops return early, which no range on the wall is like."""
    return [item for item in named if item.effect.shows_in != ShowsIn.RETURNS]


def _may_be_harmful(item: Named) -> bool:
    """Of what is described, only noise: a term on the mean is not exact, and without it nothing would be said of it."""
    return item.spreads or (item.kind == "physical" and item.effect.shows_in != ShowsIn.VALUES)
