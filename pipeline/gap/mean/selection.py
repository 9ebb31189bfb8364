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
from pipeline.gap.thresholds import equivalence_margin, thresholds

_BEAM_WIDTH = 5
"""Number of the best sets of one size that are grown further (beam width)."""
_NOT_SPATIAL = ("intensity", "disparity_fraction")
"""Covariates that do not vary along the wall, so that the reference's error cannot imitate their effects."""


@dataclass(frozen=True)
class FamilyScore:
    """How well one candidate error explains residuals in addition to the errors that are already in a model.

    A candidate may have variants, such as an effect with each trial period; together they are called a family. The best variant
    represents them.

    Attributes
    ----------
    name : Tag of the effect, or name of the covariate of a non-parametric term, which names no cause.
    empirical : True for a non-parametric term, false for an effect of the catalogue.
    score : Log-likelihood ratio minus a penalty for what is fitted: an estimate of the ratio on new data.
    log_likelihood_ratio : Log-likelihood with the candidate minus that without it.
    candidate : The best variant.
    negligible : Whether the ratio is tiny compared with the one that the candidate reaches in a model without other errors. The
        candidate may then only correct the linearisation of those errors.
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
    """An error that the forward selection chose as an explanation of the residuals.

    Attributes
    ----------
    candidate : The best variant of the error, for example with its best period.
    indistinguishable : Names of the effects that would score as well in its place.
    p_value : Probability that the best of all candidates scores as much by chance; so it is corrected for multiple testing.
    log_likelihood_ratio : Log-likelihood with the error minus that without it; the other selected effects are in the model
        both times.
    score : Log-likelihood ratio minus a penalty for what is fitted.
    family_scores : Scores of all candidates in place of this error, with the other selected effects in the model. If the error
        is a non-parametric term, no other effect is in the model.
    replacing_pair : Names of two effects that would score as well together, in its place or in that of it and another selected
        effect; empty if there are none.
    replaced_too : Name of that other selected effect; "" if the pair replaces this one alone.
    """

    candidate: Candidate
    indistinguishable: tuple[str, ...]
    p_value: float
    log_likelihood_ratio: float
    score: float
    family_scores: tuple[FamilyScore, ...]
    replacing_pair: tuple[str, ...] = ()
    replaced_too: str = ""


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
        terms = (item for item in self.family_scores if item.empirical and not item.name.startswith(SPATIAL_NULL))
        found = [item for item in terms if not item.negligible and _beats_spatial_null(item, null_score)]
        one_covariate = next((item for item in found if item.candidate.form != POLYNOMIAL), None)
        if one_covariate is None or found[0].score > one_covariate.score + thresholds().variance.least_gain:
            return found[0] if found else None
        return one_covariate


def _replacements(names: set[str], name: str, margin: float, scores: SetScores) -> list[str]:
    """Names of effects that could replace `name` in the set `names` at nearly the same joint score, best first."""
    others, least = names - {name}, scores.get(frozenset(names), math.inf) - margin
    as_good = [each for each, score in scores.items() if others < each and len(each) == len(names) and score > least]
    return [other for each in sorted(as_good, key=lambda each: -scores[each]) for other in each - others if other != name]


def _replacing_pair(names: set[str], name: str, margin: float, scores: SetScores) -> tuple[tuple[str, ...], str]:
    """Find the two effects that best replace `name` in the set `names`, alone or together with another effect of the set.

    The joint score must be nearly the same for as many effects, and higher for one effect more. The two effects are returned, and
    the other effect that they replace too; both are empty if there is none.
    """
    joint = scores.get(frozenset(names), math.inf)
    least = {len(names): joint - margin, len(names) + 1: joint}
    sets = (each for each in scores if name not in each and len(each - names) == 2)
    as_good = [each for each in sets if scores[each] > least.get(len(each), math.inf)]
    best = max(as_good, key=lambda each: scores[each], default=names)
    return tuple(sorted(best - names)), "".join(names - best - {name})


def _least_nonparametric_score() -> float:
    """Return the score that a non-parametric term needs: `variance.least_gain` against the reference, and against effects."""
    return 2 * thresholds().variance.least_gain


def _beats_spatial_null(item: FamilyScore, null_score: float) -> bool:
    """Tell whether a non-parametric term clearly beats the best spatial null candidate, whose score is `null_score`."""
    beats = item.score > null_score + thresholds().variance.least_gain
    if item.candidate.form == POLYNOMIAL:
        return beats and item.score > _least_nonparametric_score()
    return beats or item.name in _NOT_SPATIAL


class CandidateScorer(Protocol):
    """Interface of what the forward selection of errors needs: scores of candidates and their p-values.

    The class `MeanSearch` computes them from residuals; tests may use a simple stand-in.
    """

    def score_families(self, members: EffectSet) -> tuple[FamilyScore, ...]:
        """Score each family of candidate errors by its best variant, in addition to errors that are in a model already.

        A family is the set of all variants of one candidate, such as an effect with different cameras or periods. The best one
        comes first. members: the errors in the model; may be empty.
        """

    def p_value(self, score: float) -> float:
        """Return the probability that by chance the best of all candidates reaches a score: a penalised log-likelihood ratio."""

    def joint_score(self, members: EffectSet) -> float:
        """Return the score of several errors together: their joint log-likelihood ratio minus the penalty of each.

        The periods of sines among the members are refined first.
        """

    def with_harmonics(self, members: EffectSet, form: FamilyScore) -> FamilyScore:
        """Replace a non-parametric term that describes a periodic error by its best periodic form, such as a wave with overtones.

        members: other errors in the model, fitted jointly. form: the term; one that is not periodic is returned unchanged.
        """


@dataclass(frozen=True)
class ForwardSelection:
    """Forward selection of the errors that explain residuals: sets of errors grow by the one that improves the score most.

    The five best sets of each size are extended (beam search), so that two errors are also found if neither is the best one
    alone.

    Attributes
    ----------
    search : Provides the scores of the candidate errors and their p-values.
    """

    search: CandidateScorer

    def select(self) -> tuple[list[SelectedEffect], tuple[FamilyScore, ...]]:
        """Select the errors that explain the residuals. An error is added only if the score rises significantly.

        Returns
        -------
        The selected errors, among them at most one non-parametric term (which names no cause); and the scores of all families
        of candidates beside them.
        """
        empty = _Set((), 0.0, self.search.score_families(()))
        levels, scores = [[empty]], SetScores()
        while len(levels) <= thresholds().mean.most_effects:
            grown, of_sets = self._grow(levels[-1])
            scores |= of_sets  # those of the size that is not accepted too: two effects may replace one
            if not grown or not self._significant(grown[0].score - levels[-1][0].score):
                break
            levels.append(grown)
        if (found := self._nonparametric_term(levels)) is not None:
            members, form = found[0], self.search.with_harmonics(*found)
            p_value, ratio = self.search.p_value(form.score), form.log_likelihood_ratio
            term = SelectedEffect(form.candidate, (), p_value, ratio, form.score, empty.family_scores)
            chosen = [*(self.with_equivalents(members, item, scores) for item in members), term]
            return chosen, self.search.score_families((*members, form))
        best = levels[-1][0]
        nearly, weak = (1 - thresholds().mean.class_share) * empty.spatial_null_score, empty.nonparametric
        unreported = weak.score if weak is not None and weak.score < _least_nonparametric_score() else 0.0
        if best.score <= max(nearly, unreported):  # no effect of the catalogue explains it as well
            return [], empty.family_scores
        return [self.with_equivalents(best.members, item, scores) for item in best.members], best.family_scores

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
        best, alone = levels[-1][0], levels[0][0].nonparametric
        last = best.nonparametric
        if last is not None and last.score >= _least_nonparametric_score() and self._significant(last.score):
            terms = [(state, form) for state, *_ in levels if (form := state.nonparametric) is not None]
            found, term = terms[0]
            for state, form in terms[1:]:
                if self._significant(state.score + form.score - found.score - term.score):
                    found, term = state, form
            return found.members, term
        if not best.members or alone is None:
            return None
        score = max(best.score, self.search.joint_score(best.members))
        margin = max(thresholds().variance.least_gain, thresholds().mean.class_share * score) if len(best.members) < 2 else 0.0
        return ((), alone) if alone.score > score + margin else None

    def with_equivalents(self, among: EffectSet, item: FamilyScore, scores: SetScores) -> SelectedEffect:
        """Describe one effect of a selected set, with its p-value and the effects that cannot be distinguished from it.

        Parameters
        ----------
        among : The selected set of effects.
        item : The effect to describe, a member of the set.
        scores : Joint score of each set of effects that was tried, by the names of its effects. A set that scores nearly as well
            as the selected one tells which effect could replace `item`.
        """
        others = tuple(member for member in among if member is not item)
        tried, names = self.search.score_families(others), {member.name for member in others}
        beside = [each for each in tried if not each.empirical and each.name not in names]
        mine = next(each for each in beside if each.name == item.name)
        ratio, p_value = mine.log_likelihood_ratio, self.search.p_value(mine.score)
        margin = equivalence_margin(ratio)
        alike = [each.name for each in beside if each is not mine and each.score > mine.score - margin]
        alike += _replacements(names | {item.name}, item.name, margin, scores)
        replacing = _replacing_pair(names | {item.name}, item.name, margin, scores)
        return SelectedEffect(item.candidate, tuple(dict.fromkeys(alike)), p_value, ratio, mine.score, tried, *replacing)

    def _significant(self, score: float) -> bool:
        """Tell whether a score is significant."""
        return self.search.p_value(score) <= thresholds().mean.significance
