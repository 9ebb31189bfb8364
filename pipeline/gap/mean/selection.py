"""Which effects explain the mean: sets of up to three, the null distribution of the largest gain, classes, a check by free forms.

The score of a candidate is its gain in log-likelihood less twice what it gains on average where there is nothing (for k free
columns k, as Akaike's criterion; more where a period is searched): the expected gain on new data. Sets are grown from the few
best of each size, so that two effects are found too where neither, or a third that looks like their sum, is best alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from pipeline.gap.decisions import decided
from pipeline.gap.mean.candidates import POLYNOMIAL, SPATIAL_NULL, Candidate
from sensors.effects.range_offset import RangeOffset

_WIDTH = 5
"""Sets of one size that are grown further."""
_NOT_PLACES = ("intensity", "disparity_fraction")
"""Covariates that do not change along the wall."""


@dataclass(frozen=True)
class FamilyScore:
    """What a family of candidates gained beside the effects of a set. candidate: its best variant; slight: whether the gain only
    makes up for what those are not exact in."""

    name: str
    empirical: bool
    score: float
    log_likelihood_ratio: float
    candidate: Candidate
    negligible: bool = False


EffectSet = tuple[FamilyScore, ...]
"""Effects that stand together."""
SetScores = dict[frozenset[str], float]
"""Of sets of effects, by their names."""


@dataclass(frozen=True)
class SelectedEffect:
    """One explanation that was accepted. alike: others that score as well; tried: all that stood beside it."""

    candidate: Candidate
    indistinguishable: tuple[str, ...]
    p_value: float
    log_likelihood_ratio: float
    score: float
    family_scores: tuple[FamilyScore, ...]


@dataclass(frozen=True)
class _Set:
    """Some effects of the catalogue together, and what was tried beside them. score: of all together."""

    members: EffectSet
    score: float
    family_scores: tuple[FamilyScore, ...]

    @property
    def names(self) -> frozenset[str]:
        return frozenset(member.name for member in self.members)

    @property
    def catalogue(self) -> list[FamilyScore]:
        """Of what was tried, the effects of the catalogue that are not in the set yet, best first."""
        return [item for item in self.family_scores if not (item.empirical or item.negligible) and item.name not in self.names]

    @property
    def spatial_null_score(self) -> float:
        """Score of mere places."""
        return max([0.0, *(item.score for item in self.family_scores if item.name.startswith(SPATIAL_NULL))])

    @property
    def nonparametric(self) -> FamilyScore | None:
        """The best free form; of a covariate that changes along the wall only where it does better than mere places do."""
        decoy = self.spatial_null_score
        free = [
            item for item in self.family_scores if item.empirical and not (item.negligible or item.name.startswith(SPATIAL_NULL))
        ]
        found = [item for item in free if _stands_out(item, decoy)]
        plain = next((item for item in found if item.candidate.form != POLYNOMIAL), None)
        by = decided().mean
        if plain is None or found[0].score > max(plain.score + by.free_margin, by.surface_ratio * plain.score):
            return found[0] if found else None
        return plain


def equivalence_margin(gain: float) -> float:
    """Within which of a score, of so large a gain, others belong to its class: signatures are exact to a share of the gain."""
    return max(decided().mean.class_margin, decided().mean.class_share * gain)


def _in_its_place(names: frozenset[str], name: str, margin: float, scores: SetScores) -> list[str]:
    """Names in the place of which a set would score as well, best first."""
    others, least = names - {name}, scores.get(names, math.inf) - margin
    as_good = [each for each, score in scores.items() if others < each and len(each) == len(names) and score > least]
    return [other for each in sorted(as_good, key=lambda each: -scores[each]) for other in each - others if other != name]


def _weak(form: FamilyScore | None) -> float:
    """Score of a free form that is too weak to be said, and that a weak effect of the catalogue has to do better than; else 0."""
    return form.score if form is not None and form.score < decided().mean.least_free_score else 0.0


def _stands_out(item: FamilyScore, decoy: float) -> bool:
    """Whether a free form does better than mere places, of which the best scores `decoy`."""
    by = decided().mean
    if item.candidate.form == POLYNOMIAL:
        return item.score > max(decoy + by.free_margin, by.least_surface_score)
    least = (by.wave_ratio if item.candidate.form == "wave" else 1.0) * decoy + by.free_margin
    return item.name in _NOT_PLACES or item.score > least


class CandidateScorer(Protocol):
    """What a choice rests on."""

    def score_families(self, members: EffectSet) -> tuple[FamilyScore, ...]:
        """Every family's best variant beside some effects, best score first."""

    def p_value(self, score: float) -> float:
        """Of the largest score over all families where there is nothing."""

    def joint_score(self, members: EffectSet) -> float:
        """Of effects together, their periods at the top of the likelihood."""

    def correlated_covariates(self, form: FamilyScore) -> set[str]:
        """Covariates that change as that of a free form does."""

    def with_harmonics(self, members: EffectSet, form: FamilyScore) -> FamilyScore:
        """A wave with its overtones where the data ask for those."""

    def may_be_reference_error(self, members: EffectSet, form: FamilyScore) -> bool:
        """Whether a form beside some effects is no larger than the reference's error, which may hold just such a form."""


@dataclass(frozen=True)
class ForwardSelection:
    """Sets of effects, grown from the few best of each size."""

    search: CandidateScorer

    def select(self) -> tuple[list[SelectedEffect], tuple[FamilyScore, ...]]:
        """Explanations, and what was tried beside all of them."""
        empty = _Set((), 0.0, self.search.score_families(()))
        levels, scores = [[empty]], SetScores()
        while len(levels) <= decided().mean.most_effects:
            grown, of_sets = self._grown(levels[-1])
            if not grown or not self._significant(grown[0].score - levels[-1][0].score):
                break
            levels.append(grown)
            scores |= of_sets
        best = levels[-1][0]
        members, form = self._free(levels) or ((), None)
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
        best, chosen = self._beyond_places(best, scores)
        nearly = (1 - decided().mean.practical_share) * empty.spatial_null_score
        if best.score <= max(nearly, _weak(empty.nonparametric)):  # no effect of the catalogue says it as well
            return [], empty.family_scores
        return chosen, best.family_scores

    def _beyond_places(self, found: _Set, scores: SetScores) -> tuple[_Set, list[SelectedEffect]]:
        """A set without effects that, beside its others, say no more than mere places do beside all of them."""
        chosen = [self.with_equivalents(found.members, item, scores) for item in found.members]
        least = min(chosen, key=lambda each: each.score, default=None)
        if least is None or least.score > found.spatial_null_score:
            return found, chosen
        members = tuple(item for item, each in zip(found.members, chosen, strict=True) if each is not least)
        return self._beyond_places(_Set(members, found.score - least.score, self.search.score_families(members)), scores)

    def _grown(self, level: list[_Set]) -> tuple[list[_Set], SetScores]:
        """The best sets of one effect more, best first, and what each set that was looked at scores."""
        found: dict[frozenset[str], EffectSet] = {}
        scores = SetScores()
        for each in level:
            for item in each.catalogue[:_WIDTH]:
                names, score = each.names | {item.name}, each.score + item.score
                if score > scores.get(names, -math.inf):
                    scores[names], found[names] = score, (*each.members, item)
        ranked = sorted(scores, key=lambda names: -scores[names])[:_WIDTH]
        return [_Set(found[names], scores[names], self.search.score_families(found[names])) for names in ranked], scores

    def _free(self, levels: list[list[_Set]]) -> tuple[EffectSet, FamilyScore] | None:
        """A free form that the data ask for beside or in place of effects of the catalogue, and the effects it stands beside."""
        best, empty = levels[-1][0], levels[0][0]
        if (
            best.nonparametric is not None
            and best.nonparametric.score >= decided().mean.least_free_score
            and self._significant(best.nonparametric.score)
        ):
            found: tuple[_Set, FamilyScore] | None = None
            for state in (level[0] for level in levels):
                form = state.nonparametric
                if form is None:
                    continue
                if found is None or self._adds(state, state.score + form.score - found[0].score - found[1].score, found[1]):
                    found = state, form
            if found is not None:
                return found[0].members, found[1]
        alone = empty.nonparametric
        if not best.members or alone is None:
            return None
        score = max(best.score, self.search.joint_score(best.members))
        margin = max(decided().mean.free_margin, decided().mean.practical_share * score) if len(best.members) < 2 else 0.0
        if alone.score > score + margin:
            return (), alone
        return None

    def _adds(self, state: _Set, score: float, form: FamilyScore) -> bool:
        """Whether the data ask for effects of the catalogue beside a free form: no form is exact, nor has it a constant, and so
        each effect has to add more than a second form of the same covariate, one of two covariates, or a constant, does."""
        if not self._significant(score):
            return False
        kin = self.search.correlated_covariates(form)
        second = [
            item.score
            for item in self.search.score_families((form,))
            if item.name == RangeOffset.tag() or item.candidate.form == POLYNOMIAL or (item.empirical and item.name in kin)
        ]
        return score > len(state.members) * max([0.0, *second])

    def with_equivalents(self, among: EffectSet, item: FamilyScore, scores: SetScores) -> SelectedEffect:
        """An effect with those that would do as well in its place beside the others.

        scores: of sets with other variants of the others, as of another camera, beside which they may do as well.
        """
        others = tuple(member for member in among if member is not item)
        beside = [
            each
            for each in self.search.score_families(others)
            if not each.empirical and each.name not in {o.name for o in others}
        ]
        mine = next(each for each in beside if each.name == item.name)
        margin, p_value = equivalence_margin(mine.log_likelihood_ratio), self.search.p_value(mine.score)
        alike = [each.name for each in beside if each is not mine and each.score > mine.score - margin]
        alike += _in_its_place(frozenset(member.name for member in among), item.name, margin, scores)
        tried = self.search.score_families(others)
        return SelectedEffect(item.candidate, tuple(dict.fromkeys(alike)), p_value, mine.log_likelihood_ratio, mine.score, tried)

    def _significant(self, score: float) -> bool:
        return score >= decided().mean.least_score and self.search.p_value(score) <= decided().mean.significance
