"""The search for effects on the mean: what every explanation gains beside others, over one design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.gap.decisions import decided
from pipeline.gap.mean.candidates import (
    HARMONIC_ORDERS,
    HARMONIC_SERIES,
    LINE_PATTERN,
    SPATIAL_NULL,
    Candidate,
    ExplanationKey,
    SineGrid,
    harmonics,
)
from pipeline.gap.mean.design import Design
from pipeline.gap.mean.mean_model import MeanFit
from pipeline.gap.mean.null_distribution import NullDistribution
from pipeline.gap.mean.selection import EffectSet, FamilyScore, ForwardSelection, SelectedEffect
from pipeline.gap.residuals.residuals import Residuals
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

_MOST_LEADING = 8
"""Effects that are taken exactly."""
_ALIKE = 100.0
"""Condition of a form's columns beyond which one of them is others: an overtone that the points' raster shows as a lower one."""


class MeanSearch:
    """All explanations on one set of points, as `Choice` asks for them.

    gains_alone: what each gains by itself, given where the residuals' pose holds effects too.
    """

    def __init__(
        self,
        residuals: Residuals,
        families: list[Candidate | SineGrid],
        random: KeyedRandom,
        pose_precision: FloatArray | None = None,
        gains_alone: Mapping[ExplanationKey, float] | None = None,
    ) -> None:
        """pose_precision: (p,) inverse variance of the coefficients of `residuals.pose` before there are data, 0 by default."""
        self.design = Design.of(residuals, families, random, pose_precision)
        self._null = NullDistribution.of(self.design, random)
        self._holding: dict[tuple[Candidate, ...], Design] = {(): self.design}
        self._profiles: dict[tuple[Candidate, ...], tuple[FloatArray, ...]] = {}
        alone = sorted(self._score_families((), {}), key=lambda each: each.log_likelihood_ratio) if gains_alone is None else []
        self.single_effect_ratios = gains_alone or {(each.name, each.empirical): each.log_likelihood_ratio for each in alone}

    def select(self) -> tuple[list[SelectedEffect], tuple[FamilyScore, ...]]:
        """Explanations, and what was tried beside all of them."""
        found = ForwardSelection(self).select()
        self._holding = {(): self.design}  # a design with a sine is as large as the search itself
        return found

    def score_families(self, members: EffectSet) -> tuple[FamilyScore, ...]:
        """Every family's best variant beside some effects, best score first."""
        return self._score_families(members, self.single_effect_ratios)

    def _score_families(self, members: EffectSet, alone: Mapping[ExplanationKey, float]) -> tuple[FamilyScore, ...]:
        plain, fixed, searched = self._profile(tuple(member.candidate for member in members))
        families, found = self.design.families, []
        for name, (rows, sines) in families.by_name.items():
            gains = np.concatenate([fixed[rows, 0], searched[sines, 0]]) - plain[0]
            best = int(np.argmax(gains))
            candidate = families.plain[rows[best]] if best < len(rows) else families.sine(sines[best - len(rows)])
            gain = float(gains[best])
            slight = gain < decided().mean.practical_share * alone.get((candidate.name, candidate.empirical), 0.0)
            found.append(
                FamilyScore(candidate.name, candidate.empirical, gain - self._null.penalty(name), gain, candidate, slight)
            )
        return tuple(sorted(found, key=lambda item: -item.score))

    def _profile(self, candidates: tuple[Candidate, ...]) -> tuple[FloatArray, ...]:
        """As `Equations.profile`, beside some candidates; kept, since the same sets are asked for again and again."""
        if candidates not in self._profiles:
            design = self._with(candidates)
            self._profiles[candidates] = design.equations.profile_log_likelihood(design.columns(candidates), design.plain_columns)
        return self._profiles[candidates]

    def _with(self, candidates: tuple[Candidate, ...]) -> Design:
        """The design that holds all of them."""
        if candidates not in self._holding:
            self._holding[candidates] = self._with(candidates[:-1]).conditioned_on(candidates[-1])
        return self._holding[candidates]

    def p_value(self, score: float) -> float:
        """Of the largest score over all families where there is nothing."""
        return self._null.p_value(score)

    def goodness_of_fit_p_value(self, tried: Sequence[FamilyScore]) -> float | None:
        """p-value of what is left beside some effects, by all that was tried there but mere places; None where nothing was.

        Null draws are wrong by a Gaussian process; a reference that is wrong by a few waves has larger single ones. How much
        larger is seen slantwise across the wall, where no sensor has an axis, and so much more may all sines gain where there is
        nothing (as in genomic control, Devlin & Roeder 1999).
        """
        scores = [item.score for item in tried if not item.name.startswith(SPATIAL_NULL)]
        if not scores:
            return None
        slanting = [item for item in tried if item.name.startswith(SPATIAL_NULL) and item.candidate.wave is not None]
        usual = sum(float(self._null.log_likelihood_ratios[item.candidate.family].mean()) for item in slanting)
        larger = max(sum(item.log_likelihood_ratio for item in slanting) / usual, 1.0) if usual else 1.0
        members = self.design.families.by_name
        allowed = {name: larger if members[name][1] else 1.0 for name in members if not name.startswith(f"free {SPATIAL_NULL}")}
        return self._null.p_value(max(scores), allowed)

    def spatial_null_p_value(self, tried: Sequence[FamilyScore]) -> float | None:
        """The same of mere places."""
        scores = [item.score for item in tried if item.name.startswith(SPATIAL_NULL)]
        places = [name for name in self.design.families.by_name if name.startswith(f"free {SPATIAL_NULL}")]
        return self._null.p_value(max(scores), dict.fromkeys(places, 1.0)) if scores else None

    def joint_score(self, members: EffectSet) -> float:
        """Of effects together, their periods at the top of the likelihood: the steps of the search cost a strong sine some."""
        candidates = tuple(member.candidate for member in members)
        design = self._with(candidates)
        both = (design.equations.log_likelihood(base)[:, 0].max() for base in (design.columns(candidates), design.pose_columns))
        with_them, without = both
        return float(with_them - without - sum(member.log_likelihood_ratio - member.score for member in members))

    def correlated_covariates(self, form: FamilyScore) -> set[str]:
        """Covariates that change as that of a free form does."""
        found = self.design.residuals.covariates
        covariates = {name: values for name, values in found.items() if np.ptp(values) > 0}
        parts = form.name.split(" and ")
        alike = np.abs(np.corrcoef([*covariates.values(), *(covariates[part] for part in parts)])[:, -len(parts) :])
        return {name for name, row in zip(covariates, alike, strict=False) if row.max() > decided().mean.kin}

    def with_harmonics(self, members: EffectSet, form: FamilyScore) -> FamilyScore:
        """What is periodic in its plainest form beside some effects.

        A wave has its overtones where the data ask for those, as what is periodic need not be a sine; of what repeats every few
        lines it is the form of the fewest, as twice as many say it too.
        """
        if form.candidate.form.startswith(LINE_PATTERN):
            return self._of_fewest_lines(members, form)
        if form.candidate.form == "smooth":
            form = self._as_wave(members, form)
        return self._with_overtones(members, form) if form.candidate.form == "wave" else form

    def _of_fewest_lines(self, members: EffectSet, form: FamilyScore) -> FamilyScore:
        alike = [
            each
            for each in self.score_families(members)
            if each.candidate.form.startswith(LINE_PATTERN) and each.name == form.name
        ]
        good = [each for each in alike if each.score > form.score - decided().mean.free_margin]
        return min(good, key=lambda each: each.candidate.period)

    def _as_wave(self, members: EffectSet, form: FamilyScore) -> FamilyScore:
        """The wave of the same covariate where that, at the top of its period, says it as well as a curve does."""
        alike = [each for each in self.score_families(members) if each.candidate.form == "wave" and _of_one_kind(each, form)]
        if not alike:
            return form
        wave, others = alike[0], [member.candidate for member in members]
        (sine, *_), fit = self.design.fit_refined([wave.candidate, *others])
        gain = wave.log_likelihood_ratio + fit.log_likelihood - self.design.fit([wave.candidate, *others]).log_likelihood
        score = gain - (wave.log_likelihood_ratio - wave.score)
        return replace(wave, candidate=sine, log_likelihood_ratio=gain, score=score) if score > form.score else form

    def _with_overtones(self, members: EffectSet, form: FamilyScore) -> FamilyScore:
        (sine, *others), fit = self.design.fit_refined([form.candidate, *(member.candidate for member in members)])
        unit = float(self.design.residuals.covariates[form.name].std()) or 1.0

        def with_overtones(last: int) -> FamilyScore:
            overtones = harmonics(form.name, sine, last)
            columns = np.concatenate([sine.columns, overtones.columns], axis=1)
            if np.linalg.cond(columns.T @ columns) > _ALIKE:
                return form
            both = replace(overtones, matrix=columns, form=HARMONIC_SERIES, period=unit * sine.period)
            gain = self.design.fit([both, *others]).log_likelihood - fit.log_likelihood
            score = gain - overtones.columns.shape[1]
            return replace(form, candidate=both, log_likelihood_ratio=form.log_likelihood_ratio + gain, score=form.score + score)

        best = max(map(with_overtones, HARMONIC_ORDERS), key=lambda each: each.score)
        return best if best.score >= form.score + decided().mean.free_margin else form

    def may_be_reference_error(self, members: EffectSet, form: FamilyScore) -> bool:
        """Whether a wave is no larger than the reference's error beside it, which may hold just such a wave.

        More than a reference may be wrong by is not its error: it is what the wave leaves of whatever is not quite a wave.
        """
        if form.candidate.form != "wave":
            return False
        size, fit = self._fitted_std_and_fit(form, members)
        most = decided().nodes.reference_error / float(np.median(self.design.residuals.unit_m))
        error = min(float(np.sqrt(fit.cell_covariance.variance_ratio)) * self.design.model.typical_sigma, most)
        return size < decided().mean.wave_sigmas * error

    def fitted_std(self, item: FamilyScore) -> float:
        """Standard deviation of what an explanation by itself says, in the observable's unit."""
        return self._fitted_std_and_fit(item, ())[0]

    def _fitted_std_and_fit(self, form: FamilyScore, members: EffectSet) -> tuple[float, MeanFit]:
        """The same beside some effects, and the fit of all."""
        candidates, fit = self.design.fit_refined([form.candidate, *(member.candidate for member in members)])
        columns = candidates[0].columns
        values = self.design.split_coefficients(fit.coefficients, candidates)[0][: columns.shape[1]]
        return float(np.std(columns @ values)), fit

    def leading_effects(self) -> list[Candidate]:
        """Effects of the catalogue that are large and explain much by themselves, each variant for itself, best first."""
        plain, fixed, _ = self._profile(())
        gains = fixed[:, 0] - plain[0]
        found = [(gain, each) for gain, each in zip(gains, self.design.families.plain, strict=True) if not each.empirical]
        ranked = sorted(found, key=lambda item: -item[0])
        least = max(decided().mean.leading_share * ranked[0][0], decided().mean.leading_gain) if ranked else 0.0
        return [each for gain, each in ranked if gain >= least][:_MOST_LEADING]

    def selected_alone(self, candidate: Candidate) -> SelectedEffect:
        """A candidate by itself."""
        best = next(item for item in self.score_families(()) if item.name == candidate.name and not item.empirical)
        item = replace(best, candidate=candidate)
        return ForwardSelection(self).with_equivalents((item,), item, {})


def _of_one_kind(one: FamilyScore, other: FamilyScore) -> bool:
    return one.name == other.name and one.candidate.angle == other.candidate.angle
