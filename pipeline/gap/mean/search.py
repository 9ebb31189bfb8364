"""The search for effects on the mean: what every explanation gains beside others, over one design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.gap.mean.candidates import FOLDED, OVERTONES, PLACE, REPEATED, Candidate, Explanation, SineGrid, harmonics
from pipeline.gap.mean.design import Design
from pipeline.gap.mean.mean_model import MeanFit
from pipeline.gap.mean.null_gains import NullGains
from pipeline.gap.mean.selection import Choice, Chosen, Members, Tried
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.thresholds import thresholds
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
        gains_alone: Mapping[Explanation, float] | None = None,
    ) -> None:
        """pose_precision: (p,) inverse variance of the coefficients of `residuals.pose` before there are data, 0 by default."""
        self.design = Design.of(residuals, families, random, pose_precision)
        self._null = NullGains.of(self.design, random)
        self._holding: dict[tuple[Candidate, ...], Design] = {(): self.design}
        self._profiles: dict[tuple[Candidate, ...], tuple[FloatArray, ...]] = {}
        alone = sorted(self._tried((), {}), key=lambda each: each.gain) if gains_alone is None else []
        self.gains_alone = gains_alone or {(each.name, each.empirical): each.gain for each in alone}

    def select(self) -> tuple[list[Chosen], tuple[Tried, ...]]:
        """Explanations, and what was tried beside all of them."""
        found = Choice(self).select()
        self._holding = {(): self.design}  # a design with a sine is as large as the search itself
        return found

    def tried(self, members: Members) -> tuple[Tried, ...]:
        """Every family's best variant beside some effects, best score first."""
        return self._tried(members, self.gains_alone)

    def _tried(self, members: Members, alone: Mapping[Explanation, float]) -> tuple[Tried, ...]:
        plain, fixed, searched = self._profile(tuple(member.candidate for member in members))
        families, found = self.design.families, []
        for name, (rows, sines) in families.members.items():
            gains = np.concatenate([fixed[rows, 0], searched[sines, 0]]) - plain[0]
            best = int(np.argmax(gains))
            candidate = families.plain[rows[best]] if best < len(rows) else families.sine(sines[best - len(rows)])
            gain = float(gains[best])
            slight = gain < thresholds().mean.least_relative_gain * alone.get((candidate.name, candidate.empirical), 0.0)
            found.append(Tried(candidate.name, candidate.empirical, gain - self._null.penalty(name), gain, candidate, slight))
        return tuple(sorted(found, key=lambda item: -item.score))

    def _profile(self, candidates: tuple[Candidate, ...]) -> tuple[FloatArray, ...]:
        """As `Equations.profile`, beside some candidates; kept, since the same sets are asked for again and again."""
        if candidates not in self._profiles:
            design = self._with(candidates)
            self._profiles[candidates] = design.equations.profile(design.columns(candidates), design.plain_columns)
        return self._profiles[candidates]

    def _with(self, candidates: tuple[Candidate, ...]) -> Design:
        """The design that holds all of them."""
        if candidates not in self._holding:
            self._holding[candidates] = self._with(candidates[:-1]).holding(candidates[-1])
        return self._holding[candidates]

    def p_value(self, score: float) -> float:
        """Of the largest score over all families where there is nothing."""
        return self._null.p_value(score)

    def p_of_rest(self, tried: Sequence[Tried]) -> float | None:
        """p-value of what is left beside some effects, by all that was tried there but mere places; None where nothing was.

        Null draws are wrong by a Gaussian process; a reference that is wrong by a few waves has larger single ones. How much
        larger is seen slantwise across the wall, where no sensor has an axis, and so much more may all sines gain where there is
        nothing (as in genomic control, Devlin & Roeder 1999).
        """
        scores = [item.score for item in tried if not item.name.startswith(PLACE)]
        if not scores:
            return None
        slanting = [item for item in tried if item.name.startswith(PLACE) and item.candidate.wave is not None]
        usual = sum(float(self._null.gains[item.candidate.family].mean()) for item in slanting)
        larger = max(sum(item.gain for item in slanting) / usual, 1.0) if usual else 1.0
        members = self.design.families.members
        allowed = {name: larger if members[name][1] else 1.0 for name in members if not name.startswith(f"free {PLACE}")}
        return self._null.p_value(max(scores), allowed)

    def p_of_places(self, tried: Sequence[Tried]) -> float | None:
        """The same of mere places."""
        scores = [item.score for item in tried if item.name.startswith(PLACE)]
        places = [name for name in self.design.families.members if name.startswith(f"free {PLACE}")]
        return self._null.p_value(max(scores), dict.fromkeys(places, 1.0)) if scores else None

    def score(self, members: Members) -> float:
        """Of effects together, their periods at the top of the likelihood: the steps of the search cost a strong sine some."""
        candidates = tuple(member.candidate for member in members)
        design = self._with(candidates)
        both = (design.equations.log_likelihood(base)[:, 0].max() for base in (design.columns(candidates), design.base))
        with_them, without = both
        return float(with_them - without - sum(member.gain - member.score for member in members))

    def kin(self, form: Tried) -> set[str]:
        """Covariates that change as that of a free form does."""
        found = self.design.residuals.covariates
        covariates = {name: values for name, values in found.items() if np.ptp(values) > 0}
        parts = form.name.split(" and ")
        alike = np.abs(np.corrcoef([*covariates.values(), *(covariates[part] for part in parts)])[:, -len(parts) :])
        return {name for name, row in zip(covariates, alike, strict=False) if row.max() > thresholds().mean.same_covariate}

    def folded(self, members: Members, form: Tried) -> Tried:
        """What is periodic in its plainest form beside some effects.

        A wave has its overtones where the data ask for those, as what is periodic need not be a sine; of what repeats every few
        lines it is the form of the fewest, as twice as many say it too.
        """
        if form.candidate.form.startswith(REPEATED):
            return self._of_fewest_lines(members, form)
        if form.candidate.form == "smooth":
            form = self._as_wave(members, form)
        return self._with_overtones(members, form) if form.candidate.form == "wave" else form

    def _of_fewest_lines(self, members: Members, form: Tried) -> Tried:
        alike = [each for each in self.tried(members) if each.candidate.form.startswith(REPEATED) and each.name == form.name]
        good = [each for each in alike if each.score > form.score - thresholds().mean.nonparametric_margin]
        return min(good, key=lambda each: each.candidate.period)

    def _as_wave(self, members: Members, form: Tried) -> Tried:
        """The wave of the same covariate where that, at the top of its period, says it as well as a curve does."""
        alike = [each for each in self.tried(members) if each.candidate.form == "wave" and _of_one_kind(each, form)]
        if not alike:
            return form
        wave, others = alike[0], [member.candidate for member in members]
        (sine, *_), fit = self.design.refined([wave.candidate, *others])
        gain = wave.gain + fit.log_likelihood - self.design.fit([wave.candidate, *others]).log_likelihood
        score = gain - (wave.gain - wave.score)
        return replace(wave, candidate=sine, gain=gain, score=score) if score > form.score else form

    def _with_overtones(self, members: Members, form: Tried) -> Tried:
        (sine, *others), fit = self.design.refined([form.candidate, *(member.candidate for member in members)])
        unit = float(self.design.residuals.covariates[form.name].std()) or 1.0

        def with_overtones(last: int) -> Tried:
            overtones = harmonics(form.name, sine, last)
            columns = np.concatenate([sine.columns, overtones.columns], axis=1)
            if np.linalg.cond(columns.T @ columns) > _ALIKE:
                return form
            both = replace(overtones, matrix=columns, form=FOLDED, period=unit * sine.period)
            gain = self.design.fit([both, *others]).log_likelihood - fit.log_likelihood
            score = gain - overtones.columns.shape[1]
            return replace(form, candidate=both, gain=form.gain + gain, score=form.score + score)

        best = max(map(with_overtones, OVERTONES), key=lambda each: each.score)
        return best if best.score >= form.score + thresholds().mean.nonparametric_margin else form

    def may_be_the_reference(self, members: Members, form: Tried) -> bool:
        """Whether a wave is no larger than the reference's error beside it, which may hold just such a wave.

        More than a reference may be wrong by is not its error: it is what the wave leaves of whatever is not quite a wave.
        """
        if form.candidate.form != "wave":
            return False
        size, fit = self._said(form, members)
        most = thresholds().grid_noise.reference_error / float(np.median(self.design.residuals.unit_m))
        error = min(float(np.sqrt(fit.at.ratio)) * self.design.model.typical_sigma, most)
        return size < thresholds().mean.least_wave_sigmas * error

    def size(self, item: Tried) -> float:
        """Standard deviation of what an explanation by itself says, in the observable's unit."""
        return self._said(item, ())[0]

    def _said(self, form: Tried, members: Members) -> tuple[float, MeanFit]:
        """The same beside some effects, and the fit of all."""
        candidates, fit = self.design.refined([form.candidate, *(member.candidate for member in members)])
        columns = candidates[0].columns
        values = self.design.split(fit.coefficients, candidates)[0][: columns.shape[1]]
        return float(np.std(columns @ values)), fit

    def leading(self) -> list[Candidate]:
        """Effects of the catalogue that are large and explain much by themselves, each variant for itself, best first."""
        plain, fixed, _ = self._profile(())
        gains = fixed[:, 0] - plain[0]
        found = [(gain, each) for gain, each in zip(gains, self.design.families.plain, strict=True) if not each.empirical]
        ranked = sorted(found, key=lambda item: -item[0])
        least = max(thresholds().mean.refit_share * ranked[0][0], thresholds().mean.refit_gain) if ranked else 0.0
        return [each for gain, each in ranked if gain >= least][:_MOST_LEADING]

    def alone(self, candidate: Candidate) -> Chosen:
        """A candidate by itself."""
        best = next(item for item in self.tried(()) if item.name == candidate.name and not item.empirical)
        item = replace(best, candidate=candidate)
        return Choice(self).chosen((item,), item, {})


def _of_one_kind(one: Tried, other: Tried) -> bool:
    return one.name == other.name and one.candidate.angle == other.candidate.angle
