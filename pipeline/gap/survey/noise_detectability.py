"""Compute, before there are data, from which size effects on the noise and on missing returns can be detected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.gap.noise_and_edges.variance_model import variance_candidates
from pipeline.gap.residuals.ray_hits import RayGeometry
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from pipeline.gap.survey.survey_design import DETECTION_SNR
from pipeline.gap.survey.survey_views import Survey, SurveyView
from pipeline.gap.thresholds import thresholds
from sensors.effects import catalogue
from sensors.effects.detection_limit import DetectionLimit
from sensors.effects.precipitation import Precipitation
from sensors.effects.range_quantization import RangeQuantization

_LOSSES = 0.01
"""Share of returns that is assumed to be missing anyway."""
_NO_NUMBER = "no closed-form signature: gap tests it, but its detectable size is not computed here"
"""Note for effects whose detectable size is not computed."""


@dataclass(frozen=True)
class NoiseOrLossEffect:
    """A sensor effect on the noise or on missing returns, and the size from which a survey can detect it.

    Attributes
    ----------
    name : Name of the effect, with the sensor as prefix.
    parameter : Name of its main parameter.
    detectable_size : Value of that parameter from which the effect is detected (signal-to-noise ratio of 5); NaN if it cannot
        be computed.
    note : Condition under which that size holds, or why there is none, in words.
    """

    name: str
    parameter: str
    detectable_size: float
    note: str

    def to_dict(self) -> dict[str, Any]:
        """Return the effect and its detectable size as an entry of the file identifiability.json."""
        return {
            "name": self.name,
            "parameter": self.parameter,
            "seen_from": self.detectable_size if np.isfinite(self.detectable_size) else None,
            "note": self.note,
        }


def noise_and_loss_effects(survey: Survey) -> tuple[NoiseOrLossEffect, ...]:
    """List the sensor effects on the noise and on missing returns, with the size from which a survey can detect each.

    survey: the planned or measured survey; its first view is used. The size is NaN if it cannot be computed.
    """
    view = survey.views[0]
    found = {each.name: each for each in _variance_effects(view)}
    if isinstance(view.residuals, TlsResiduals):
        rays, count = view.residuals.geometry, view.point_count
        found |= {each.name: each for each in (_quantisation(), _detection_limit(rays, count), _precipitation(rays, count))}
    systematic = {candidate.name for candidate in view.signatures}
    others = []
    for effect in catalogue(survey.sensor):
        name = f"{survey.sensor}.{effect.tag()}"
        note = f"needs {' and '.join(effect.needs)}: gap does not test it" if effect.needs else _NO_NUMBER
        if effect.tag() not in systematic:
            others.append(found.get(name) or NoiseOrLossEffect(name, "", np.nan, note))
    return tuple(others)


def _variance_effects(view: SurveyView) -> list[NoiseOrLossEffect]:
    """Effects on the variance: sigma_i² = model + theta f_i has the information sum (f_i / sigma_i²)² / 2 on theta."""
    residuals = view.residuals
    found: dict[str, NoiseOrLossEffect] = {}
    excess = thresholds().variance.least_excess
    for candidate in variance_candidates(residuals):
        form = candidate.variance.sum(axis=1) / residuals.sigma**2
        information = 0.5 * float(np.sum(form**2)) * view.point_count / len(residuals)
        theta = DETECTION_SNR / np.sqrt(max(information, 1e-300))
        least = excess / max(float(np.mean(form)), 1e-300)
        note = "" if theta > least else f"smaller ones add less than {100 * excess:.0f} % to the variance and are not named"
        parameter, value = candidate.main_parameter(max(theta, least))
        name = f"{residuals.sensor}.{candidate.name}"
        if name not in found or value < found[name].detectable_size:
            found[name] = NoiseOrLossEffect(name, parameter, value, note)
    return list(found.values())


def _quantisation() -> NoiseOrLossEffect:
    """Range quantisation, which shows as a comb in the distribution of the ranges."""
    note = "from the comb of ranges, if the file stores them more finely than the step"
    return NoiseOrLossEffect(f"tls.{RangeQuantization.tag()}", "step_m", 1e-4, note)


def _detection_limit(rays: RayGeometry, count: int) -> NoiseOrLossEffect:
    """The detection limit: losing the k weakest echoes has the log-likelihood ratio k ln(1 / losses); SNR 5 means 12.5.

    rays: a subsample of `count` rays.
    """
    value, note = np.nan, "needs recorded powers"
    if rays.power is not None:
        share = 0.5 * DETECTION_SNR**2 / np.log(1 / _LOSSES) / count
        value = float(np.quantile(rays.power, min(max(share, 1 / len(rays)), 1.0)))
        note = "as soon as the weakest echoes are lost; needs the pattern"
    return NoiseOrLossEffect(f"tls.{DetectionLimit.tag()}", "minimum_power", value, note)


def _precipitation(rays: RayGeometry, count: int) -> NoiseOrLossEffect:
    """Precipitation: information on beta in the share of losses p = 1 - (1 - p0) exp(-2 beta R), with p0 unknown too.

    rays: a subsample of `count` rays.
    """
    distance = rays.range_m
    jacobian = np.stack([2 * distance * (1 - _LOSSES), np.ones_like(distance)], axis=1)
    weight = count / len(distance) / (_LOSSES * (1 - _LOSSES))
    information = weight * jacobian.T @ jacobian
    rate = DETECTION_SNR * float(np.sqrt(np.linalg.inv(information)[0, 0]))
    return NoiseOrLossEffect(f"tls.{Precipitation.tag()}", "rate_per_m", rate, f"beside {100 * _LOSSES:.0f} % of other losses")
