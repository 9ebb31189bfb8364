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
    """Say for each named effect (sensor error) that has alternatives which further measurement would tell it from them.

    Several additional measurements, such as a second station, are tried by computation. One tells two effects apart if it makes
    their signatures (the patterns of residuals that they make) clearly different. The attribute `split_by` of the returned
    effects names it.

    measurement: measurement as it was taken. named: effects; each lists those from which this measurement cannot tell it.
    """
    if not any(item.indistinguishable for item in named):
        return named
    found = identifiability(measured_survey(measurement, _POINTS))
    return [replace(item, split_by=_separating_measurement(found, item)) if item.indistinguishable else item for item in named]


def measurement_separating_noises(item: NamedEffect, sensor: str) -> str:
    """Say which further measurement would tell noise effects apart that explain the same variance.

    The answer follows from the quantities, such as range or intensity, on which each noise depends.

    item: a named noise effect, with the effects that it cannot be told from. sensor: "tls" or "stereo".
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
    best, *others = sorted(cosine, key=lambda name: cosine[name])
    if cosine[best] < SIMILAR_COSINE:
        return " or ".join([best, *(name for name in others if cosine[name] < SIMILAR_COSINE)])
    return f"no single further measurement; the best is {best} (signatures still alike: cosine {cosine[best]:.2f})"
