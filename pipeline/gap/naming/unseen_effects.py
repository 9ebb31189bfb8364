"""List what a diagnosis could not have seen: for each effect that was not named, the size that would have shown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from pipeline.gap.mean.detection_power import DetectableSize
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.thresholds import largest_relative_size
from sensors.effects.base import Effect, ShowsIn

_NOT_COMPUTED = {
    ShowsIn.MEAN: "it was found, but not confirmed",
    ShowsIn.SPREAD: "neighbouring points share this noise; its detectable size is not computed",
    ShowsIn.EDGES: "it shows at depth steps only; its detectable size is not computed",
    ShowsIn.RETURNS: "it shows in missing returns; its detectable size is not computed",
    ShowsIn.VALUES: "it shows in the distribution of the values; its detectable size is not computed",
}
"""Why an effect has no detectable size, by how it shows."""
_NO_SIZE = "no plausible size of it would have shown"


def unseen_effects(residuals: Residuals, computed: Iterable[DetectableSize], named: Sequence[str]) -> tuple[DetectableSize, ...]:
    """List the sensor errors that a diagnosis did not name but that may be there, each with the size that would have shown.

    The list has every effect of the catalogue that was not named, and smooth errors outside the catalogue. An effect without such
    a size has a note that says why: it needs data that were not recorded, or no plausible size would have shown, for example.

    Parameters
    ----------
    residuals : The residuals, which tell the catalogue and the recorded fields.
    computed : The sizes that were computed: an effect this large is found with a probability of 95 %.
    named : Names of the effects that were named, without the sensor's prefix.
    """
    effects = {effect.tag(): effect for effect in residuals.candidates if not effect.empirical and effect.tag() not in named}
    kept = [each for each in computed if each.name not in named]
    others = {name: effect for name, effect in effects.items() if name not in {each.name for each in kept}}
    unknown = (DetectableSize(name, "", np.nan, note=_reason(effect, residuals)) for name, effect in others.items())
    return (*(_plausible(each, effects.get(each.name)) for each in kept), *unknown)


def _plausible(item: DetectableSize, effect: type[Effect] | None) -> DetectableSize:
    """Return the detectable size of an effect, but without a value if it is larger than any plausible one."""
    typical = effect.typical_sizes().get(item.parameter, np.inf) if effect is not None else np.inf
    if item.size <= largest_relative_size() * typical and np.isfinite(item.size):
        return item
    return replace(item, size=np.inf, note=_NO_SIZE)


def _reason(effect: type[Effect], residuals: Residuals) -> str:
    """Why no size was computed for an effect."""
    if not effect.known(residuals.geometry):
        return f"needs {' and '.join(effect.needs)}, which was not recorded"
    return _NOT_COMPUTED[effect.shows_in]
