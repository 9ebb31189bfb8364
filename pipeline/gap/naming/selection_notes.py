"""Remarks for the report on what a selection of systematic effects left out, and on what it could not explain."""

from __future__ import annotations

import numpy as np

from pipeline.gap.mean.nonparametric_terms import LINE_PATTERN, SPATIAL_NULL
from pipeline.gap.naming.named_effects import Estimate
from pipeline.gap.naming.search_outcome import SearchOutcome
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.thresholds import thresholds


def note_left_out(excluded: frozenset[tuple[str, bool]]) -> list[str]:
    """Return remarks for the report on families of effects that were not tried.

    excluded: these families, as pairs (name, whether it is a non-parametric term).
    """
    said = (f"non-parametric terms of {name}" if empirical else name for name, empirical in sorted(excluded))
    why = (
        "its best value is outside the bounds of the effect, or it is many typical sizes, the registration absorbs nearly all "
        "of it, and a misfit is left"
    )
    return [f"{what} left out: {why}" for what in said]


def notes_on_outcome(found: SearchOutcome, part: Residuals) -> list[str]:
    """Return remarks for the report on an explanation of residuals, and on a misfit that it leaves.

    They tell of terms that repeat after a few scan lines, of waves that belong to the reference, and of the candidate that is
    most similar to a misfit where nothing was accepted.

    found: the explanation. part: the residuals of the n points that were searched.
    """
    return [*_note_repetition(found.estimates), *_note_oblique_waves(found), *_note_most_similar(found, part)]


def _note_repetition(estimates: list[Estimate]) -> list[str]:
    """Return remarks for the report on terms that repeat after a few scan lines."""
    lines = [each.candidate.fixed["lines"] for each in estimates if each.candidate.form.startswith(LINE_PATTERN)]
    return [
        f"the empirical term repeats after exactly {each} lines: think of the facets of a mirror, or of a read-out in blocks"
        for each in lines
    ]


def _note_most_similar(found: SearchOutcome, part: Residuals) -> list[str]:
    """Note on the best candidate where a misfit is left and nothing was accepted."""
    if found.estimates or found.p_value is None or found.p_value > thresholds().verdict.rejection_p:
        return []
    best = max((item for item in found.tried if not item.name.startswith(SPATIAL_NULL)), key=lambda item: item.score)
    what = f"a change with {best.name} ({best.candidate.form})" if best.empirical else best.name
    size = 1e3 * found.search.fitted_std(best) * float(np.median(part.unit_m))
    return [
        f"the remaining misfit is most similar to {what}, {size:.2g} mm (standard deviation). A reference that errs along whole "
        "lines or columns, as in strips, looks the same; a scan from another station would separate the two"
    ]


def _note_oblique_waves(found: SearchOutcome) -> list[str]:
    """Note on oblique waves on the wall that the error model of the reference does not explain."""
    p_value = found.search.spatial_null_p_value(found.tried)
    if p_value is None or p_value > thresholds().verdict.rejection_p:
        return []
    return [
        f"the residuals contain waves at an oblique angle that the reference's error model does not explain (p = {p_value:.2g}). "
        "No sensor effect is aligned like that; they are attributed to the reference"
    ]
