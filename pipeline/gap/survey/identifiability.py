"""Analyse which effects a survey can detect and distinguish, before any residual is computed.

The signature S (n, k) of each effect is the one that `gap` uses. The pose columns J, one set for each station, are projected
out in the metric of the predicted noise, W = diag(1 / sigma²):

    survival          |S_perp| / |S| with S_perp = S - J (J^T W J)^-1 J^T W S, over all phases
    cosine            largest canonical correlation of two effects' S_perp, over the variants of one of them (such as the camera)
    detectable size   parameter value with a signal-to-noise ratio of 5: 5 sqrt(C), where C is the variance of its estimate
                      beside the pose
    nameable size     parameter value at which the signal-to-noise ratio times the sine of the angle to the nearest other
                      signature is 8

C counts all points of the survey, and a reference error that is correlated over metres (Matern 3/2), which many points do not
average out. The amplitude of an effect with a phase is given for the phase that is hardest to detect.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.gap.mean.candidates import Candidate
from pipeline.gap.survey.known_points import KnownPoints, known_points
from pipeline.gap.survey.noise_detectability import NoiseOrLossEffect, noise_and_loss_effects
from pipeline.gap.survey.survey_design import (
    DETECTION_SNR,
    REFERENCE_LENGTH_M,
    SurveyDesign,
    group_by_effect,
    parameter_label,
)
from pipeline.gap.survey.survey_views import Survey, SurveyView
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

NAMING_SNR = 8.0
"""Signal-to-noise ratio, times the sine of the angle to the nearest other signature, from which an effect can be named."""
SIMILAR_COSINE = 0.9
"""Cosine from which two signatures count as similar."""
REFERENCE_ERRORS_M = {"tls": 0.001, "stereo": 0.005}
"""Default standard deviation of the reference's correlated error, m."""


@dataclass(frozen=True)
class SurveyExtension:
    """A survey with one additional measurement, to see how much better it detects and distinguishes m sensor effects.

    A signature is the change of the observations by an effect, less what another pose of the sensor could explain.

    Attributes
    ----------
    name : The additional measurement, in words.
    cosines : (m, m) absolute cosines between the effects' signatures; 1: indistinguishable.
    detectable_size : (m,) value of each effect's main parameter from which the extended survey detects it (signal-to-noise
        ratio of 5).
    """

    name: str
    cosines: FloatArray
    detectable_size: tuple[float, ...]

    @property
    def nameable_size(self) -> tuple[float, ...]:
        """(m,) value of each effect's main parameter from which the extended survey tells the effect from all other effects."""
        return _nameable_size(self.cosines, self.detectable_size)


@dataclass(frozen=True)
class Identifiability:
    """Which of m systematic effects (sensor errors) a survey can detect, and which of them it can distinguish.

    A signature is the change of the observations by an effect. A fit of the sensor's pose explains part of it; the other part
    is left to detect the effect.

    Attributes
    ----------
    sensor : "tls" or "stereo".
    names : (m,) names of the effects, with the sensor as prefix.
    survival : (m,) share of each signature that is left after the pose fit, 0 to 1.
    cosines : (m, m) absolute cosines between the signatures after the pose fit; 1: indistinguishable.
    parameters : (m,) name of each effect's main parameter.
    detectable_size : (m,) value of that parameter from which the effect is detected (signal-to-noise ratio of 5), with noise
        and an error of the reference surface.
    detectable_size_without_reference_error : (m,) the value if the reference has no error.
    variants : (m,) the choice for which the numbers hold, such as one period or one camera, in words.
    extensions : The survey with each of several additional measurements.
    points : Number of points of the survey.
    reference_error_m : Standard deviation of the reference's error, which is correlated over metres, m.
    others : Effects on the noise and on missing returns, each with its detectable size.
    """

    sensor: str
    names: tuple[str, ...]
    survival: FloatArray
    cosines: FloatArray
    parameters: tuple[str, ...]
    detectable_size: tuple[float, ...]
    detectable_size_without_reference_error: tuple[float, ...]
    variants: tuple[str, ...]
    extensions: tuple[SurveyExtension, ...]
    points: int
    reference_error_m: float
    others: tuple[NoiseOrLossEffect, ...] = ()

    @property
    def nameable_size(self) -> tuple[float, ...]:
        """(m,) value of each effect's main parameter from which the survey can also tell it from all other effects."""
        return _nameable_size(self.cosines, self.detectable_size)

    def best_extension(self, row: int) -> SurveyExtension:
        """Return the survey with the additional measurement that tells one effect from all others at the smallest size.

        row: index of the effect in `names`.
        """
        return min(self.extensions, key=lambda extension: extension.nameable_size[row])

    def similar_effects(self, row: int) -> list[int]:
        """Return the effects that the survey can hardly tell from a given one, as indices into `names`, most similar first.

        Their changes of the observations have a cosine of at least 0.9 with its own.

        row: index of the given effect in `names`.
        """
        order = np.argsort(-self.cosines[row])
        return [int(other) for other in order if other != row and self.cosines[row, other] >= SIMILAR_COSINE]

    def similar_pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of effects that the survey can hardly tell apart, as indices into `names`, most similar first.

        The cosine between their changes of the observations is at least 0.9.
        """
        found = [(a, b) for a in range(len(self.names)) for b in range(a) if self.cosines[a, b] >= SIMILAR_COSINE]
        return sorted(found, key=lambda pair: -self.cosines[pair])

    def to_dict(self) -> dict[str, Any]:
        """Return which effects the survey can detect and distinguish, as its entry in the file identifiability.json."""
        return {
            "sensor": self.sensor,
            "points": self.points,
            "reference_error": {"sigma_m": self.reference_error_m, "length_m": REFERENCE_LENGTH_M},
            "names": list(self.names),
            "survival": self.survival.tolist(),
            "cosines": self.cosines.tolist(),
            "effects": [self._row(row) for row in range(len(self.names))],
            "alike": [
                {
                    "names": [self.names[a], self.names[b]],
                    "cosine": float(self.cosines[a, b]),
                    "with": {extension.name: float(extension.cosines[a, b]) for extension in self.extensions},
                    "split_by": [e.name for e in self.extensions if e.cosines[a, b] < SIMILAR_COSINE],
                }
                for a, b in self.similar_pairs()
            ],
            "spread_and_losses": [other.to_dict() for other in self.others],
        }

    def _row(self, row: int) -> dict[str, Any]:
        """One effect of identifiability.json."""
        return {
            "name": self.names[row],
            "parameter": self.parameters[row],
            "shown": self.variants[row],
            "seen_from": _finite(self.detectable_size[row]),
            "seen_from_by_noise_alone": _finite(self.detectable_size_without_reference_error[row]),
            "named_from": _finite(self.nameable_size[row]),
            "named_from_with": {extension.name: _finite(extension.nameable_size[row]) for extension in self.extensions},
        }


def _shown(candidate: Candidate) -> str:
    """The searched or chosen values of a variant, in words."""
    values = dict(candidate.fixed) | ({} if candidate.wave is None else {candidate.wave.key: candidate.period})
    return ", ".join(f"{key} {value if isinstance(value, str) else f'{value:.3g}'}" for key, value in values.items())


def _finite(value: float) -> float | None:
    """The value; None if it is infinite, which JSON cannot hold."""
    return value if np.isfinite(value) else None


def _nameable_size(cosines: FloatArray, detectable_size: tuple[float, ...]) -> tuple[float, ...]:
    """Size from which each effect can be named, from its detectable size and the cosine to the nearest other signature."""
    nearest = (cosines - np.eye(len(cosines))).max(axis=1)
    sine = np.sqrt(np.maximum(1 - nearest**2, 1e-300))
    return tuple(NAMING_SNR / DETECTION_SNR * value / float(s) for value, s in zip(detectable_size, sine, strict=True))


def identifiability(survey: Survey, reference_error_m: float | None = None) -> Identifiability:
    """Analyse which sensor effects (errors) a planned or measured survey can detect and distinguish.

    It also tells what additional measurements would add, which helps to plan a survey before fieldwork. reference_error_m:
    standard deviation of the error of the reference surface, which is correlated over metres, m; None: 1 mm for a laser scanner
    and 5 mm for a stereo pair.
    """
    error = REFERENCE_ERRORS_M[survey.sensor] if reference_error_m is None else reference_error_m
    families = group_by_effect(survey.views[0].signatures)
    plain = SurveyDesign.of(survey.views, families)
    seen, noise = (plain.detectable_size(sigma) for sigma in (error, 0.0))
    extensions = []
    for name, views, points in _extended(survey):
        design = SurveyDesign.of(views, families, points)
        extensions.append(SurveyExtension(name, design.cosines(), design.detectable_size(error)))
    shown = [variants[0] for variants in families.values()]
    return Identifiability(
        sensor=survey.sensor,
        names=tuple(f"{survey.sensor}.{name}" for name in families),
        survival=plain.survival(),
        cosines=plain.cosines(),
        parameters=tuple(parameter_label(candidate) for candidate in shown),
        detectable_size=seen,
        detectable_size_without_reference_error=noise,
        variants=tuple(_shown(candidate) for candidate in shown),
        extensions=tuple(extensions),
        points=sum(view.point_count for view in survey.views),
        reference_error_m=error,
        others=noise_and_loss_effects(survey),
    )


def format_table(found: Identifiability) -> str:
    """Format which effects (sensor errors) a survey can detect and distinguish, as a text table with a row for each.

    The columns are: the effect's name; the share of its change of the observations that is left after a fit of the sensor's
    pose, in percent; its main parameter and detectable size; and the most similar effect, with the cosine between both changes.
    """
    cosines = found.cosines - np.eye(len(found.names))
    lines = [f"{'effect':<32}{'left by pose':>14}  {'detectable from (S/N 5)':<32}most similar (cosine)"]
    for row, (name, share) in enumerate(zip(found.names, found.survival, strict=True)):
        other = int(np.argmax(cosines[row]))
        value = f"{found.parameters[row]} {found.detectable_size[row]:.2g}"
        lines.append(f"{name:<32}{100 * share:>12.1f} %  {value:<32}{found.names[other]} ({cosines[row, other]:.2f})")
    return "\n".join(lines)


def _extended(survey: Survey) -> list[tuple[str, tuple[SurveyView, ...], KnownPoints | None]]:
    """The survey with each additional measurement: its name, all views, and known points if these are added.

    Measurements that would see too little of the wall are left out.
    """
    number = max(view.station for view in survey.views) + 1
    place = "station" if survey.sensor == "tls" else "pair of exposures"
    wanted: list[Callable[[], tuple[str, SurveyView]]] = [
        lambda: (f"a second {place} at half the range", survey.moved(0.5, 0.0, number)),
        lambda: (f"a second {place} at the same range, 40 degrees aside", survey.moved(1.0, np.radians(40.0), number)),
        lambda: survey.repeated(number),
    ]
    found: list[tuple[str, tuple[SurveyView, ...], KnownPoints | None]] = []
    for observed in wanted:
        with suppress(InputError):
            name, view = observed()
            found.append((name, (*survey.views, view), None))
    points = known_points(survey.views[0])
    return [*found, (points.title, survey.views, points)]
