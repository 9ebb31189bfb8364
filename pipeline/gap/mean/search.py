"""Score the candidates of the mean model on one set of points, beside any effects that are already selected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.gap.mean.candidates import Candidate, ExplanationKey, SineGrid
from pipeline.gap.mean.design import Design
from pipeline.gap.mean.detection_power import DetectableSize, detectable_sizes
from pipeline.gap.mean.nonparametric_terms import HARMONIC_ORDERS, HARMONIC_SERIES, LINE_PATTERN, SPATIAL_NULL, harmonics
from pipeline.gap.mean.null_distribution import NullDistribution
from pipeline.gap.mean.selection import EffectSet, FamilyScore, ForwardSelection, SelectedEffect
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.thresholds import thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

_MOST_LEADING = 8
"""Most effects that are refitted without linearising."""
_ALIKE = 100.0
"""Condition number of a wave's columns above which an overtone is an alias of another one on the points' raster."""


class MeanSearch:
    """Scores every candidate error as an explanation of the residuals, alone or beside errors that are already selected.

    Candidates are the sensor errors of the catalogue (effects) and terms that name no cause. A score is a penalised
    log-likelihood ratio; its p-value comes from simulations without any effect. The method `select` chooses the errors that
    explain the residuals by these scores.

    Attributes
    ----------
    design : The regression problem, with the residuals and the design columns of all candidates.
    single_effect_ratios : Log-likelihood ratio of each explanation fitted alone. The key is a pair: the name of the effect or
        covariate, and True for terms that name no cause, else False.
    """

    def __init__(
        self,
        residuals: Residuals,
        families: list[Candidate | SineGrid],
        random: KeyedRandom,
        pose_precision: FloatArray | None = None,
        single_effect_ratios: Mapping[ExplanationKey, float] | None = None,
    ) -> None:
        """Set up the design and simulate its null distribution.

        Parameters
        ----------
        residuals : Residuals of the points.
        families : Candidates and sine grids.
        random : Source of the random numbers.
        pose_precision : (p,) prior inverse variances of the coefficients of `residuals.pose_jacobian`; 0 by default.
        single_effect_ratios : Log-likelihood ratio of each explanation alone, to be given if the pose Jacobian has columns of
            effects too.
        """
        self.design = Design.of(residuals, families, random, pose_precision)
        self._null = NullDistribution.of(self.design, random)
        self._designs: dict[tuple[Candidate, ...], Design] = {(): self.design}
        self._profiles: dict[tuple[Candidate, ...], tuple[FloatArray, ...]] = {}
        if single_effect_ratios is None:
            alone = sorted(self._score_families((), {}), key=lambda each: each.log_likelihood_ratio)
            single_effect_ratios = {(each.name, each.empirical): each.log_likelihood_ratio for each in alone}
        self.single_effect_ratios = single_effect_ratios

    def select(self) -> tuple[list[SelectedEffect], tuple[FamilyScore, ...]]:
        """Find the errors that explain the residuals, by forward selection.

        It returns the selected errors, and the scores of all families of candidates beside them, best first. A family is all
        variants of one candidate, such as an effect with all trial periods.
        """
        found = ForwardSelection(self).select()
        self._designs = {(): self.design}  # frees memory: each conditioned design is as large as the search itself
        return found

    def score_families(self, members: EffectSet) -> tuple[FamilyScore, ...]:
        """Score every family of candidate errors as an addition to a model, by its best variant; the best score comes first.

        A family is the set of all variants of one candidate, such as an effect with all trial periods.

        members: the errors that are in the model already; may be empty.
        """
        return self._score_families(members, self.single_effect_ratios)

    def _score_families(self, members: EffectSet, alone: Mapping[ExplanationKey, float]) -> tuple[FamilyScore, ...]:
        """Score every family as an addition to `members`. alone: log-likelihood ratio of each explanation without others."""
        plain, fixed, searched = self._profile(tuple(member.candidate for member in members))
        families, found = self.design.families, []
        for name, (rows, sines) in families.by_name.items():
            ratios = np.concatenate([fixed[rows, 0], searched[sines, 0]]) - plain[0]
            best = int(np.argmax(ratios))
            candidate = families.plain[rows[best]] if best < len(rows) else families.sines[sines[best - len(rows)]]
            ratio = float(ratios[best])
            negligible = ratio < thresholds().mean.class_share * alone.get((candidate.name, candidate.empirical), 0.0)
            found.append(
                FamilyScore(candidate.name, candidate.empirical, ratio - self._null.penalty(name), ratio, candidate, negligible)
            )
        return tuple(sorted(found, key=lambda item: -item.score))

    def _profile(self, candidates: tuple[Candidate, ...]) -> tuple[FloatArray, ...]:
        """Profile log-likelihoods beside some candidates, as `NormalEquations.profile_log_likelihood` returns them; cached."""
        if candidates not in self._profiles:
            design = self._conditioned_on(candidates)
            self._profiles[candidates] = design.equations.profile_log_likelihood(design.columns(candidates), design.plain_columns)
        return self._profiles[candidates]

    def _conditioned_on(self, candidates: tuple[Candidate, ...]) -> Design:
        """Return the regression design with some candidates as nuisance columns; cached."""
        if candidates not in self._designs:
            self._designs[candidates] = self._conditioned_on(candidates[:-1]).conditioned_on(candidates[-1])
        return self._designs[candidates]

    def p_value(self, score: float) -> float:
        """Return the p-value of a score: the probability that the best of all candidate errors scores as much by chance.

        It comes from simulations without any sensor error, in which all candidates are tried.

        score: penalised log-likelihood ratio of the candidate.
        """
        return self._null.p_value(score)

    def goodness_of_fit_p_value(self, family_scores: Sequence[FamilyScore]) -> float | None:
        """Test whether the selected systematic errors leave anything to explain.

        The p-value is that of the best score that any further candidate reaches, from simulations without further errors. In
        these the error of the reference surface is drawn from a Gaussian process. A real reference may have larger single
        waves, which would pass for sinusoidal sensor errors. How much larger is estimated along oblique directions on the
        wall, where no sensor has an axis. The null distribution of all sinusoidal candidates is stretched by that factor
        (genomic control, Devlin & Roeder 1999).

        family_scores: scores of all further candidates beside the selected errors, as `select` returns them; without any, there
        is no p-value.
        """
        scores = [item.score for item in family_scores if not item.name.startswith(SPATIAL_NULL)]
        return self._null.p_value(max(scores), self._discounts(family_scores)) if scores else None

    def _discounts(self, family_scores: Sequence[FamilyScore]) -> dict[str, float]:
        """Factors by which the null ratios of all families but the spatial null candidates count; above 1 for sines."""
        oblique_waves = [item for item in family_scores if item.name.startswith(SPATIAL_NULL) and item.candidate.wave is not None]
        expected = sum(float(self._null.log_likelihood_ratios[item.candidate.family].mean()) for item in oblique_waves)
        inflation = max(sum(item.log_likelihood_ratio for item in oblique_waves) / expected, 1.0) if expected else 1.0
        members = self.design.families.by_name
        return {name: inflation if members[name][1] else 1.0 for name in members if not name.startswith(f"free {SPATIAL_NULL}")}

    def detectable_sizes(
        self, members: Sequence[Candidate], family_scores: tuple[FamilyScore, ...], random: KeyedRandom
    ) -> list[DetectableSize]:
        """Compute how large each sensor error that was not found would have to be to show in this measurement.

        An error shows if the goodness-of-fit test rejects the model without it; the size is the one at which it does so with a
        probability of 95 %. Sizes of smooth errors that are not in the catalogue are computed too.

        Parameters
        ----------
        members : Errors that were found in this search; they stay in the model.
        family_scores : Scores of all other candidates beside the found errors, as `select` returns them.
        random : Source of the random numbers of the simulations.
        """
        discounts = self._discounts(family_scores)
        nulls: dict[int, NullDistribution] = {}

        def needed(candidate: Candidate, ranked: Sequence[int]) -> float:
            if ranked[0] not in nulls:
                nulls[ranked[0]] = NullDistribution.of(self.design, random.child("null"), ranked)
            null = nulls[ranked[0]]
            critical = null.critical_score(thresholds().verdict.rejection_p, discounts)
            return critical + null.penalty(candidate.family)

        return detectable_sizes(self._conditioned_on(tuple(members)), members, needed, random)

    def spatial_null_p_value(self, family_scores: Sequence[FamilyScore]) -> float | None:
        """Test whether the reference surface errs more than its error model allows.

        The p-value is that of the best spatial null candidate: a line, wave or other term along an oblique direction on the wall.
        No sensor has an axis there, so only the reference's error can explain it. None if there are no such candidates.

        family_scores: scores of all candidates beside the selected errors, as `select` returns them.
        """
        scores = [item.score for item in family_scores if item.name.startswith(SPATIAL_NULL)]
        places = [name for name in self.design.families.by_name if name.startswith(f"free {SPATIAL_NULL}")]
        return self._null.p_value(max(scores), dict.fromkeys(places, 1.0)) if scores else None

    def joint_score(self, members: EffectSet) -> float:
        """Return the score of several errors together: their joint log-likelihood ratio minus the penalty of each.

        The periods of sines are refined first, because a strong sine loses likelihood on the grid of trial periods.

        members: the errors, each as the search scored it; its penalty is its log-likelihood ratio minus its score.
        """
        candidates = tuple(member.candidate for member in members)
        design = self._conditioned_on(candidates)
        both = (design.equations.log_likelihood(base)[:, 0].max() for base in (design.columns(candidates), design.pose_columns))
        with_them, without = both
        return float(with_them - without - sum(member.log_likelihood_ratio - member.score for member in members))

    def with_harmonics(self, members: EffectSet, form: FamilyScore) -> FamilyScore:
        """Replace a non-parametric term that describes a periodic error by its best periodic form, to name the error's shape.

        A wave gets overtones if they fit clearly better, because a periodic error need not be a sine. Among patterns that
        repeat every few scan lines, columns or rows, the one with the fewest lines is taken, because multiples of it fit as
        well. Other terms are returned unchanged.

        members: the other errors in the model, fitted jointly. form: the term, such as a wave along a covariate, with its score.
        """
        if form.candidate.form.startswith(LINE_PATTERN):
            return self._of_fewest_lines(members, form)
        return self._with_overtones(members, form) if form.candidate.form == "wave" else form

    def _of_fewest_lines(self, members: EffectSet, form: FamilyScore) -> FamilyScore:
        """Return the pattern with the fewest scan lines a cycle among those whose score is nearly that of `form`."""
        least = form.score - thresholds().mean.class_margin
        alike = (each for each in self.score_families(members) if each.name == form.name and each.score > least)
        return min(
            (each for each in alike if each.candidate.form.startswith(LINE_PATTERN)), key=lambda each: each.candidate.period
        )

    def _with_overtones(self, members: EffectSet, form: FamilyScore) -> FamilyScore:
        """Return the wave `form` with its overtones if they improve the score clearly, else the wave itself."""
        (sine, *others), fit = self.design.fit_refined([form.candidate, *(member.candidate for member in members)])
        unit = float(self.design.residuals.covariates[form.name].std()) or 1.0

        def with_overtones(last: int) -> FamilyScore:
            overtones = harmonics(form.name, sine, last)
            columns = np.concatenate([sine.columns, overtones.columns], axis=1)
            if np.linalg.cond(columns.T @ columns) > _ALIKE:
                return form
            both = replace(overtones, matrix=columns, form=HARMONIC_SERIES, period=unit * sine.period)
            ratio = self.design.fit([both, *others]).log_likelihood - fit.log_likelihood
            score = ratio - overtones.columns.shape[1]
            return replace(form, candidate=both, log_likelihood_ratio=form.log_likelihood_ratio + ratio, score=form.score + score)

        best = max(map(with_overtones, HARMONIC_ORDERS), key=lambda each: each.score)
        return best if best.score >= form.score + thresholds().variance.least_gain else form

    def fitted_std(self, item: FamilyScore) -> float:
        """Return how large a candidate error is: the standard deviation of its fitted values over the points, m (or px).

        item: the candidate with its score; it is fitted with the pose of the sensor, and without any other candidate.
        """
        (candidate,), fit = self.design.fit_refined([item.candidate])
        (values,) = self.design.split_coefficients(fit.coefficients, [candidate])
        return float(np.std(candidate.columns @ values[: candidate.columns.shape[1]]))

    def effect_variants(self) -> list[Candidate]:
        """List the sensor errors of the catalogue, once for each camera that can have them, those that explain most first.

        Of the variants of one error in one camera, the one that explains most stands for all. Sines of unknown period are not
        included.
        """
        best: dict[tuple[str, float | str | None], Candidate] = {}
        for _, each in self._ranked_variants():
            best.setdefault((each.name, each.fixed.get("camera")), each)
        return list(best.values())

    def leading_effects(self) -> list[Candidate]:
        """List the sensor errors that explain the most on their own, which are worth refitting without linearisation.

        They are at most eight effects of the catalogue, best first; sines of unknown period are not included. Each reaches at
        least the log-likelihood ratio `mean.refit_gain`, and the share `mean.refit_share` of the largest ratio (thresholds).
        """
        ranked = self._ranked_variants()
        least = max(thresholds().mean.refit_share * ranked[0][0], thresholds().mean.refit_gain) if ranked else 0.0
        return [each for ratio, each in ranked if ratio >= least][:_MOST_LEADING]

    def _ranked_variants(self) -> list[tuple[float, Candidate]]:
        """Effects with each choice of parameters and camera, and their log-likelihood ratios, best first.

        Of variants that differ only in a trial value, such as a limit, the best one stands for all.
        """
        ascending = sorted((item for item in self._ratios_alone() if not item[1].empirical), key=lambda item: item[0])
        best = {(each.name, each.names, each.fixed.get("camera")): (ratio, each) for ratio, each in ascending}
        return sorted(best.values(), key=lambda item: -item[0])

    def _ratios_alone(self) -> list[tuple[float, Candidate]]:
        """Log-likelihood ratio of each variant (such as the camera) of each error that is no sine, alone in the model."""
        plain, fixed, _ = self._profile(())
        return list(zip(fixed[:, 0] - plain[0], self.design.families.plain, strict=True))

    def score_alone(self, candidate: Candidate) -> float:
        """Return the penalised log-likelihood ratio of one variant of an error, without other errors in the model.

        candidate: the variant, such as an effect in one camera; one of those that `effect_variants` lists.
        """
        ratio = next(ratio for ratio, each in self._ratios_alone() if each is candidate)
        return float(ratio) - self._null.penalty(candidate.family)

    def selected_alone(self, candidate: Candidate) -> SelectedEffect:
        """Describe a candidate effect as if it were the only selected one, to refit it alone without linearisation.

        The result has its p-value, and names the effects that cannot be distinguished from it.

        candidate: the effect, with the parameter values that are kept, such as its camera.
        """
        best = next(item for item in self.score_families(()) if item.name == candidate.name and not item.empirical)
        item = replace(best, candidate=candidate)
        return ForwardSelection(self).with_equivalents((item,), item, {})
