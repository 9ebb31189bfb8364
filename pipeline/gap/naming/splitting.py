"""Which further measurement would part the effects of a class, at this site and for this sensor."""

from __future__ import annotations

from dataclasses import replace

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.naming.entries import Named
from pipeline.gap.survey.identifiability import SIMILAR_COSINE, Identifiability, identifiability
from pipeline.gap.survey.survey_views import measured_survey
from sensors.effects import effect_of

_POINTS = 4000
_IN_GENERAL = {
    "tls": "a second station at another range and azimuth, or targets of known position",
    "stereo": "a second distance, or check points of known position across the whole frame",
}


def with_splits(measurement: Measurement, named: list[Named]) -> list[Named]:
    """Effects that are alike to others with what would split them, by their signatures in the survey and one measurement more."""
    if not any(item.alike for item in named):
        return named
    found = identifiability(measured_survey(measurement, _POINTS))
    return [replace(item, split_by=_split(found, item)) if item.alike else item for item in named]


def split_of_noises(item: Named, sensor: str) -> str:
    """What would show which of some noises it is, by what they depend on; white noise depends on nothing."""
    told = (effect_of(name).told_by for name in (item.name, *item.alike))
    return " or ".join(filter(None, told)) or _IN_GENERAL[sensor]


def _split(found: Identifiability, item: Named) -> str:
    if item.spreads:
        return split_of_noises(item, found.sensor)
    known = [found.names.index(name) for name in item.alike if name in found.names]
    if item.name not in found.names or len(known) < len(item.alike):
        return _IN_GENERAL[found.sensor]  # lost returns, and effects beside edges, have no signature in the mean
    own = found.names.index(item.name)
    cosine = {each.name: max(float(each.cosines[own, other]) for other in known) for each in found.extensions}
    best = min(cosine, key=lambda name: cosine[name])
    if cosine[best] < SIMILAR_COSINE:
        return " or ".join(name for name in sorted(cosine, key=lambda name: cosine[name]) if cosine[name] < SIMILAR_COSINE)
    return f"no single further measurement; {best} comes nearest (cosine {cosine[best]:.2f})"
