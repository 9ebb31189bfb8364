"""Define the input of the searches for systematic sensor errors in one measurement, and the explanation that a search finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.mean.candidates import Candidate, SineGrid
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.mean.selection import FamilyScore, SelectedEffect
from pipeline.gap.naming.named_effects import Estimate
from pipeline.gap.noise_and_edges.variance_model import VarianceTerm
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.thresholds import equivalence_margin, thresholds
from scene.common.keyed_random import KeyedRandom


@dataclass(frozen=True)
class SearchInput:
    """Input that all searches for systematic sensor errors (effects) in one measurement share.

    Attributes
    ----------
    measurement : the training points (those that are not kept for validation), with their sensor model.
    part : residuals of these points, measured minus predicted.
    families : effects to search, as regression terms. A sinusoidal effect comes with all its trial frequencies as one
        `SineGrid`.
    variance_at : function that fits noise terms to residuals and returns them. The noise is fitted anew whenever effects are put
        into the model, because residuals change then.
    added : variance to add to the predicted one, squared unit of the observable; it covers errors found before, such as
        rounding.
    random : source of random numbers for the null distributions.
    """

    measurement: Measurement
    part: Residuals
    families: list[Candidate | SineGrid]
    variance_at: Callable[[Residuals], list[VarianceTerm]]
    added: float
    random: KeyedRandom


@dataclass(frozen=True)
class SearchOutcome:
    """One explanation of the residuals by systematic sensor errors (effects), found by one or two searches.

    The second search finds further effects, with those of the first in the sensor model without linearisation.

    Attributes
    ----------
    chosen : effects that the first search selected.
    estimates : effects of both searches with their coefficients.
    search : the last search: the second one, or the first if there was no second.
    residuals : residuals that the last search explains.
    further : effects that the last search selected.
    tried : scores of all candidate effects beside those that the last search selected.
    """

    chosen: list[SelectedEffect]
    estimates: list[Estimate]
    search: MeanSearch
    residuals: Residuals
    further: list[SelectedEffect]
    tried: tuple[FamilyScore, ...]

    @property
    def complexity(self) -> tuple[int, int]:
        """Number of empirical terms in this explanation of residuals, then number of all effects, to prefer the simplest one."""
        return sum(each.candidate.empirical for each in self.estimates), len(self.estimates)

    @property
    def p_value(self) -> float | None:
        """P-value of the misfit that this explanation leaves; None if no effect was left to try."""
        return self.search.goodness_of_fit_p_value(self.tried)

    def leaves_more_misfit_than(self, other: SearchOutcome) -> bool:
        """Tell whether this explanation leaves a misfit, so that it may lack an effect, where another one leaves none."""
        mine, theirs = (each.p_value is not None and each.p_value <= thresholds().verdict.rejection_p for each in (self, other))
        return mine and not theirs

    def with_classes_of(self, linear: SearchOutcome) -> SearchOutcome:
        """Add to the class of each effect what a linearised search could not tell from it, unless this explanation clearly can.

        A class holds the effects that the measurement cannot tell apart. Either search has its own error, so an effect is left
        out only if it scores worse here by twice the margin. Nothing is added unless both explain the residuals by the same
        effects, two or more. Effects that were refitted one by one have no scores beside the others here, so all
        that the linearised search could not tell from them is added.

        linear: the explanation of the linearised search.
        """
        known = {each.candidate.name: set(each.indistinguishable) for each in linear.chosen}
        if len(known) < 2 or known.keys() != {each.candidate.name for each in self.estimates}:
            return self
        together = len(self.chosen) == len(known)

        def widened(estimate: Estimate) -> Estimate:
            item = estimate.chosen
            scores = {each.name: each.score for each in item.family_scores if together and not each.empirical}
            least = item.score - 2 * equivalence_margin(item.log_likelihood_ratio)
            near = {name for name in known[estimate.candidate.name] if scores.get(name, np.inf) > least}
            return replace(estimate, chosen=replace(item, indistinguishable=tuple(sorted({*item.indistinguishable, *near}))))

        return replace(self, estimates=[widened(each) for each in self.estimates])
