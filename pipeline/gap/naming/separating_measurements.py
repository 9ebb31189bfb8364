"""Find the further measurement that would separate the effects of an equivalence class, at this site and for this sensor."""

from __future__ import annotations

from dataclasses import replace

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.naming.named_effects import NamedEffect
from pipeline.gap.survey.identifiability import SIMILAR_COSINE, Identifiability, identifiability
from pipeline.gap.survey.survey_views import measured_survey
from sensors.effects import effect_of

_POINTS = 4000
_IN_GENERAL = {
    "tls": "a second station at another range and azimuth, or targets of known position",
    "stereo": "a second distance, or check points of known position across the whole frame",
}


def with_separating_measurements(measurement: Measurement, named: list[NamedEffect]) -> list[NamedEffect]:
    """Fill in, for each effect that cannot be told from others, which further measurement would tell them apart.

    Each of several additional measurements is tried: the signatures of the effects must then differ enough.

    Parameters
    ----------
    measurement : measurement as it was taken.
    named : named effects.

    Returns
    -------
    list : the effects with `split_by` filled in.
    """
    if not any(item.indistinguishable for item in named):
        return named
    found = identifiability(measured_survey(measurement, _POINTS))
    return [replace(item, split_by=_separating_measurement(found, item)) if item.indistinguishable else item for item in named]


def measurement_separating_noises(item: NamedEffect, sensor: str) -> str:
    """Return in words what would separate noise terms that cannot be told apart, by the covariates on which they depend.

    Parameters
    ----------
    item : a named noise term with its equivalence class.
    sensor : "tls" or "stereo".
    """
    told = (effect_of(name).told_by for name in (item.name, *item.indistinguishable))
    return " or ".join(filter(None, told)) or _IN_GENERAL[sensor]


def _separating_measurement(found: Identifiability, item: NamedEffect) -> str:
    """Return the additional measurement after which the signatures of a class are no longer alike."""
    if item.adds_variance:
        return measurement_separating_noises(item, found.sensor)
    known = [found.names.index(name) for name in item.indistinguishable if name in found.names]
    if item.name not in found.names or len(known) < len(item.indistinguishable):
        return _IN_GENERAL[found.sensor]  # effects on returns and edge effects have no signature in the mean
    own = found.names.index(item.name)
    cosine = {each.name: max(float(each.cosines[own, other]) for other in known) for each in found.extensions}
    best = min(cosine, key=lambda name: cosine[name])
    if cosine[best] < SIMILAR_COSINE:
        return " or ".join(name for name in sorted(cosine, key=lambda name: cosine[name]) if cosine[name] < SIMILAR_COSINE)
    return f"no single further measurement; the best is {best} (signatures still alike: cosine {cosine[best]:.2f})"
