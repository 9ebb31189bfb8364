"""Select the systematic effects: forward selection of sets of up to three, tested against a simulated null distribution.

The score of a candidate is its penalised log-likelihood ratio: the log-likelihood ratio minus twice its mean under the
    null. It estimates the ratio on new data; for k linear columns the penalty is k, as in AIC, and it is larger if a period
    is searched. Sets are grown from the five best of each size. Two effects are therefore also found if neither is the best
    one alone, for example because a third effect resembles their sum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from pipeline.gap.mean.candidates import Candidate
from pipeline.gap.mean.nonparametric_terms import POLYNOMIAL, SPATIAL_NULL
from pipeline.gap.thresholds import thresholds
from sensors.effects.range_offset import RangeOffset

_BEAM_WIDTH = 5
"""Number of the best sets of one size that are grown further (beam width)."""
_NOT_SPATIAL = ("intensity", "disparity_fraction")
"""Covariates that do not vary along the wall, so that the reference's error cannot imitate their effects."""


@dataclass(frozen=True)
class FamilyScore:
    """How well one family of candidates (the variants of one explanation) explains residuals in addition to given effects.

    The best variant represents the family.

    Attributes
    ----------
    name, empirical : As in `Candidate`.
    score : Penalised log-likelihood ratio, an estimate of the ratio on new data.
    log_likelihood_ratio : Log-likelihood with the candidate minus that without it.
    candidate : The best variant.
    negligible : Whether the ratio is tiny relative to that of the candidate alone. It may then only absorb the linearisation
        error of the given effects.
    """

    name: str
    empirical: bool
    score: float
    log_likelihood_ratio: float
    candidate: Candidate
    negligible: bool = False


EffectSet = tuple[FamilyScore, ...]
"""Candidates that are fitted together."""
SetScores = dict[frozenset[str], float]
"""Scores of sets of effects, by the effects' names."""


@dataclass(frozen=True)
class SelectedEffect:
    """An explanation that the forward selection chose.

    Attributes
    ----------
    candidate : The best variant of the effect.
    indistinguishable : Names of the other effects in its equivalence class, which would score as well in its place.
    p_value : p-value of the score, corrected for multiple testing over all families.
    log_likelihood_ratio : Log-likelihood with it minus that without it; the other selected effects are in the model both times.
    score : Penalised log-likelihood ratio.
    family_scores : Scores of all families in addition to the other selected effects.
    """

    candidate: Candidate
    indistinguishable: tuple[str, ...]
    p_value: float
    log_likelihood_ratio: float
    score: float
    family_scores: tuple[FamilyScore, ...]


@dataclass(frozen=True)
class _Set:
    """A set of effects of the catalogue, and the scores of all families beside it.

    Attributes
    ----------
    members : The effects.
    score : Joint score of all of them.
    family_scores : Scores of further candidates, best first.
    """

    members: EffectSet
    score: float
    family_scores: tuple[FamilyScore, ...]

    @property
    def names(self) -> frozenset[str]:
        """Names of the effects."""
        return frozenset(member.name for member in self.members)

    @property
    def catalogue(self) -> list[FamilyScore]:
        """Effects of the catalogue that may be added, best first."""
        return [item for item in self.family_scores if not (item.empirical or item.negligible) and item.name not in self.names]

    @property
    def spatial_null_score(self) -> float:
        """Best score of a spatial null candidate, at least 0."""
        return max([0.0, *(item.score for item in self.family_scores if item.name.startswith(SPATIAL_NULL))])

    @property
    def nonparametric(self) -> FamilyScore | None:
        """The best non-parametric term, or None.

        It must clearly beat the spatial null candidates if its covariate varies along the wall.
        """
        null_score = self.spatial_null_score
        terms = [
            item for item in self.family_scores if item.empirical and not (item.negligible or item.name.startswith(SPATIAL_NULL))
        ]
        found = [item for item in terms if _beats_spatial_null(item, null_score)]
        one_covariate = next((item for item in found if item.candidate.form != POLYNOMIAL), None)
        by = thresholds().mean
        if one_covariate is None or found[0].score > max(
            one_covariate.score + by.nonparametric_margin, by.surface_ratio * one_covariate.score
        ):
            return found[0] if found else None
        return one_covariate


def equivalence_margin(log_likelihood_ratio: float) -> float:
    """Return the difference of scores within which two effects count as indistinguishable.

    It is the threshold `mean.class_margin`, or the share `mean.class_share` of the log-likelihood ratio if that is larger,
    because linearised signatures are inexact by such a share.
    """
    return max(thresholds().mean.class_margin, thresholds().mean.class_share * log_likelihood_ratio)


def _replacements(names: frozenset[str], name: str, margin: float, scores: SetScores) -> list[str]:
    """Names of effects that could replace `name` in the set `names` at nearly the same joint score, best first."""
    others, least = names - {name}, scores.get(names, math.inf) - margin
    as_good = [each for each, score in scores.items() if others < each and len(each) == len(names) and score > least]
    return [other for each in sorted(as_good, key=lambda each: -scores[each]) for other in each - others if other != name]


def _unreported_score(form: FamilyScore | None) -> float:
    """Score of a non-parametric term that is too weak to be reported, which a weak effect must still beat; else 0."""
    return form.score if form is not None and form.score < thresholds().mean.least_nonparametric_score else 0.0


def _beats_spatial_null(item: FamilyScore, null_score: float) -> bool:
    """Tell whether a non-parametric term clearly beats the best spatial null candidate, whose score is `null_score`."""
    by = thresholds().mean
    if item.candidate.form == POLYNOMIAL:
        return item.score > max(null_score + by.nonparametric_margin, by.least_surface_score)
    least = (by.null_wave_ratio if item.candidate.form == "wave" else 1.0) * null_score + by.nonparametric_margin
    return item.name in _NOT_SPATIAL or item.score > least


class CandidateScorer(Protocol):
    """The scores that `ForwardSelection` needs. `MeanSearch` computes them; tests may use a simple stand-in."""

    def score_families(self, members: EffectSet) -> tuple[FamilyScore, ...]:
        """Score each family of candidates by its best variant, when that is added to the effects `members` of a model.

        A family is the set of all variants of one explanation, such as an effect with different cameras or periods. Scores are
        penalised log-likelihood ratios (see `FamilyScore`); the best family is first.
        """

    def p_value(self, score: float) -> float:
        """Return the p-value of a penalised log-likelihood ratio under the null distribution of the largest of all families."""

    def joint_score(self, members: EffectSet) -> float:
        """Return the penalised log-likelihood ratio of the effects `members` together, sine periods refined."""

    def correlated_covariates(self, form: FamilyScore) -> set[str]:
        """Return the covariates that are so highly correlated with that of a non-parametric term that they could replace it."""

    def with_harmonics(self, members: EffectSet, form: FamilyScore) -> FamilyScore:
        """Return the form of a periodic term that fits best in addition to the effects `members`; other terms stay unchanged."""

    def may_be_reference_error(self, members: EffectSet, form: FamilyScore) -> bool:
        """Tell whether a wave, with the effects `members` in the model, is small enough to be part of the reference's error."""


@dataclass(frozen=True)
class ForwardSelection:
    """Forward selection of effects by their scores. The five best sets of each size are extended (beam search).

    Attributes
    ----------
    search : Provides the scores of the candidates.
    """

    search: CandidateScorer

    def select(self) -> tuple[list[SelectedEffect], tuple[FamilyScore, ...]]:
        """Select the effects that explain the residuals.

        Returns
        -------
        The selected effects, among them at most one non-parametric term, and the scores of all families in addition to them.
        """
        empty = _Set((), 0.0, self.search.score_families(()))
        levels, scores = [[empty]], SetScores()
        while len(levels) <= thresholds().mean.most_effects:
            grown, of_sets = self._grow(levels[-1])
            if not grown or not self._significant(grown[0].score - levels[-1][0].score):
                break
            levels.append(grown)
            scores |= of_sets
        best = levels[-1][0]
        members, form = self._nonparametric_term(levels) or ((), None)
        form = None if form is None else self.search.with_harmonics(members, form)
        if form is not None and not self.search.may_be_reference_error(members, form):
            chosen = [self.with_equivalents(members, item, scores) for item in members]
            chosen.append(
                SelectedEffect(
                    form.candidate,
                    (),
                    self.search.p_value(form.score),
                    form.log_likelihood_ratio,
                    form.score,
                    empty.family_scores,
                )
            )
            return chosen, self.search.score_families((*members, form))
        best, chosen = self._drop_below_spatial_null(best, scores)
        nearly = (1 - thresholds().mean.least_relative_gain) * empty.spatial_null_score
        if best.score <= max(nearly, _unreported_score(empty.nonparametric)):  # no effect of the catalogue explains it as well
            return [], empty.family_scores
        return chosen, best.family_scores

    def _drop_below_spatial_null(self, found: _Set, scores: SetScores) -> tuple[_Set, list[SelectedEffect]]:
        """Drop effects that score no better beside the others than a spatial null candidate does beside all of them."""
        chosen = [self.with_equivalents(found.members, item, scores) for item in found.members]
        least = min(chosen, key=lambda each: each.score, default=None)
        if least is None or least.score > found.spatial_null_score:
            return found, chosen
        members = tuple(item for item, each in zip(found.members, chosen, strict=True) if each is not least)
        return self._drop_below_spatial_null(
            _Set(members, found.score - least.score, self.search.score_families(members)), scores
        )

    def _grow(self, level: list[_Set]) -> tuple[list[_Set], SetScores]:
        """The best sets with one more effect, best first, and the score of each set that was considered."""
        found: dict[frozenset[str], EffectSet] = {}
        scores = SetScores()
        for each in level:
            for item in each.catalogue[:_BEAM_WIDTH]:
                names, score = each.names | {item.name}, each.score + item.score
                if score > scores.get(names, -math.inf):
                    scores[names], found[names] = score, (*each.members, item)
        ranked = sorted(scores, key=lambda names: -scores[names])[:_BEAM_WIDTH]
        return [_Set(found[names], scores[names], self.search.score_families(found[names])) for names in ranked], scores

    def _nonparametric_term(self, levels: list[list[_Set]]) -> tuple[EffectSet, FamilyScore] | None:
        """Return a non-parametric term that the data require beside or instead of effects, and those effects.

        None if the data require none.
        """
        best, empty = levels[-1][0], levels[0][0]
        if (
            best.nonparametric is not None
            and best.nonparametric.score >= thresholds().mean.least_nonparametric_score
            and self._significant(best.nonparametric.score)
        ):
            found: tuple[_Set, FamilyScore] | None = None
            for state in (level[0] for level in levels):
                form = state.nonparametric
                if form is None:
                    continue
                if found is None or self._effects_required(
                    state, state.score + form.score - found[0].score - found[1].score, found[1]
                ):
                    found = state, form
            if found is not None:
                return found[0].members, found[1]
        alone = empty.nonparametric
        if not best.members or alone is None:
            return None
        score = max(best.score, self.search.joint_score(best.members))
        margin = (
            max(thresholds().mean.nonparametric_margin, thresholds().mean.least_relative_gain * score)
            if len(best.members) < 2
            else 0.0
        )
        if alone.score > score + margin:
            return (), alone
        return None

    def _effects_required(self, state: _Set, score: float, form: FamilyScore) -> bool:
        """Tell whether the data require the effects of a set beside a non-parametric term.

        Such a term is inexact and has no constant. Each effect must therefore add more than a second term of a correlated
        covariate, a polynomial of two covariates, or a constant would.
        """
        if not self._significant(score):
            return False
        correlated = self.search.correlated_covariates(form)
        second = [
            item.score
            for item in self.search.score_families((form,))
            if item.name == RangeOffset.tag() or item.candidate.form == POLYNOMIAL or (item.empirical and item.name in correlated)
        ]
        return score > len(state.members) * max([0.0, *second])

    def with_equivalents(self, among: EffectSet, item: FamilyScore, scores: SetScores) -> SelectedEffect:
        """Describe one effect of a selected set, with the effects that cannot be distinguished from it.

        Parameters
        ----------
        among : The selected set.
        item : The effect, a member of the set.
        scores : Scores of other sets of effects. They may contain other variants of the other members, such as another camera.
        """
        others = tuple(member for member in among if member is not item)
        beside = [
            each
            for each in self.search.score_families(others)
            if not each.empirical and each.name not in {o.name for o in others}
        ]
        mine = next(each for each in beside if each.name == item.name)
        margin, p_value = equivalence_margin(mine.log_likelihood_ratio), self.search.p_value(mine.score)
        indistinguishable = [each.name for each in beside if each is not mine and each.score > mine.score - margin]
        indistinguishable += _replacements(frozenset(member.name for member in among), item.name, margin, scores)
        tried = self.search.score_families(others)
        return SelectedEffect(
            item.candidate, tuple(dict.fromkeys(indistinguishable)), p_value, mine.log_likelihood_ratio, mine.score, tried
        )

    def _significant(self, score: float) -> bool:
        """Tell whether a score is large enough and significant."""
        return score >= thresholds().mean.least_score and self.search.p_value(score) <= thresholds().mean.significance
