"""From which size on a survey would show effects on the spread and on the returns, before there are data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.gap.decisions import decided
from pipeline.gap.other.spread import spread_candidates
from pipeline.gap.survey.survey_design import DETECTION_SNR, view_signatures
from pipeline.gap.survey.survey_views import Survey, SurveyView, TlsView
from sensors.effects import catalogue
from sensors.effects.base import Effect
from sensors.effects.detection_limit import DetectionLimit
from sensors.effects.precipitation import Precipitation
from sensors.effects.range_quantization import RangeQuantization

_LOSSES = 0.01
"""Share of returns that are taken to be missing anyway."""
_NO_NUMBER = "no signature in closed form: the diagnosis tries it, this table has no number for it"


@dataclass(frozen=True)
class NoiseOrLossEffect:
    """An effect on the spread or on the returns. seen_from: the parameter's value at S/N 5, NaN where none is computed."""

    name: str
    parameter: str
    seen_from: float
    note: str

    def to_dict(self) -> dict[str, Any]:
        """As identifiability.json holds it."""
        return {
            "name": self.name,
            "parameter": self.parameter,
            "seen_from": self.seen_from if np.isfinite(self.seen_from) else None,
            "note": self.note,
        }


def noise_and_loss_effects(survey: Survey) -> tuple[NoiseOrLossEffect, ...]:
    """Every effect of the catalogue that has no signature in the mean, with the value that would be seen where it is known."""
    view = survey.views[0]
    found = {each.name: each for each in _spread(view)}
    if isinstance(view, TlsView):
        found |= {each.name: each for each in (_steps(), _limit(view), _rain(view))}
    names = {f"{survey.sensor}.{effect.tag()}": effect for effect in catalogue(survey.sensor)}
    mean = _mean_names(view)
    unknown = {name: NoiseOrLossEffect(name, "", np.nan, _unknown(effect)) for name, effect in names.items()}
    return tuple(found.get(name, unknown[name]) for name in names if name not in mean)


def _unknown(effect: type[Effect]) -> str:
    """Why a table has no number for an effect."""
    return f"needs {' and '.join(effect.needs)}: the diagnosis does not try it" if effect.needs else _NO_NUMBER


def _mean_names(view: SurveyView) -> set[str]:
    return {f"{view.residuals.sensor}.{candidate.name}" for candidate in view_signatures(view)}


def _spread(view: SurveyView) -> list[NoiseOrLossEffect]:
    """sigma_i^2 = model + theta f_i: the information on theta is sum (f_i / sigma_i^2)^2 / 2."""
    residuals = view.residuals
    candidates = spread_candidates(residuals)
    found: dict[str, NoiseOrLossEffect] = {}
    excess = decided().spread.least_excess
    for candidate in candidates:
        form = candidate.variance.sum(axis=1) / residuals.sigma**2
        information = 0.5 * float(np.sum(form**2)) * view.point_count / len(residuals)
        theta = DETECTION_SNR / np.sqrt(max(information, 1e-300))
        least = excess / max(float(np.mean(form)), 1e-300)
        note = "" if theta > least else f"below that it adds less than {100 * excess:.0f} % to the variance, which is not named"
        value = candidate.parameters(np.full(len(candidate.names), max(theta, least)))[candidate.names[0]]
        name = f"{residuals.sensor}.{candidate.name}"
        if name not in found or value < found[name].seen_from:
            found[name] = NoiseOrLossEffect(name, candidate.names[0], float(value), note)
    return list(found.values())


def _steps() -> NoiseOrLossEffect:
    note = "by its comb, where the file holds ranges more finely than the step"
    return NoiseOrLossEffect(f"tls.{RangeQuantization.tag()}", "step_m", 1e-4, note)


def _limit(view: TlsView) -> NoiseOrLossEffect:
    """Losing the k weakest echoes gains k ln(1 / losses) in likelihood; S/N 5 is a gain of 12.5."""
    power = view.residuals.geometry.power
    if power is None:
        return NoiseOrLossEffect(f"tls.{DetectionLimit.tag()}", "minimum_power", np.nan, "needs recorded powers")
    share = 0.5 * DETECTION_SNR**2 / np.log(1 / _LOSSES) / view.point_count
    value = float(np.quantile(power, min(max(share, 1 / len(power)), 1.0)))
    return NoiseOrLossEffect(
        f"tls.{DetectionLimit.tag()}", "minimum_power", value, "as soon as it takes the weakest echoes; needs the pattern"
    )


def _rain(view: TlsView) -> NoiseOrLossEffect:
    """The share p = 1 - (1 - p0) exp(-2 beta R) of losses, p0 unknown: information on beta beside p0."""
    distance = view.residuals.geometry.range_m
    slopes = np.stack([2 * distance * (1 - _LOSSES), np.ones_like(distance)], axis=1)
    weight = view.point_count / len(distance) / (_LOSSES * (1 - _LOSSES))
    information = weight * slopes.T @ slopes
    rate = DETECTION_SNR * float(np.sqrt(np.linalg.inv(information)[0, 0]))
    return NoiseOrLossEffect(
        f"tls.{Precipitation.tag()}", "rate_per_m", rate, f"beside a loss of {100 * _LOSSES:.0f} % that is there anyway"
    )
