"""Define the input of the searches for systematic sensor errors in one measurement, and the explanation that a search finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.mean.candidates import Candidate, SineGrid
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.mean.selection import FamilyScore, SelectedEffect
from pipeline.gap.naming.named_effects import Estimate
from pipeline.gap.noise_and_edges.variance_model import VarianceTerm
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.thresholds import thresholds
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
