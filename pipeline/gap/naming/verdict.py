"""Decide the verdict, and write the sentences beside it; both use the same numbers, so that they never contradict each other.

`no_gap` says that the model is not rejected: the gap before is within its uncertainty of the floor, and the residual misfit is no
larger than chance would give. A number that was not computed counts for nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.gap.naming.gap_score import Gap
from pipeline.gap.naming.named_effects import NamedEffect
from pipeline.gap.thresholds import thresholds
from sensors.models.sensor_model import StereoModel, TlsModel

VERDICTS = {
    "no_gap": "The measurement agrees with the model: no missing effect was found.",
    "named": "One effect explains where measurement and model disagree.",
    "several": "More than one effect is needed to explain where measurement and model disagree.",
    "ambiguous": "An effect was found, but this measurement cannot tell it from others that would look the same.",
    "unknown": "The model is rejected, and no effect of the catalogue passes its own test; an empirical term describes it.",
    "insufficient_data": "There are too few points on smooth parts of the reference for a diagnosis.",
}
"""Each verdict in a sentence."""
_NOISES = ("range_sigma_m", "range_ppm", "angle_sigma_rad", "parallax_sigma_px", "regularization_sigma_px",
           "point_sigma_m", "point_shared_sigma_m")  # fmt: skip
"""Keys of the models' noise that are lowered together."""
STILL_OPEN = (
    "Effects were named, but most of the gap stays open: the model is rejected with them too, and nothing else explains it."
)
STILL_OVERDISPERSED = (
    "Effects were named, but with them the residuals still vary far more than the model predicts, and nothing explains it."
)
STILL_REJECTED = (
    "Effects were named, but the model is rejected with them too, and the validation points do not show that the gap is smaller."
)
UNSUPPORTED = "Effects were named, but the gap is no smaller with them, and the misfit was not tested: nothing supports them."
PARTLY_EXPLAINED = (
    "The model is rejected: effects of the catalogue explain part of the misfit, and an empirical term describes more of it."
)
NOT_DESCRIBED = "The model is rejected, and nothing that was tried describes the misfit."
MUCH_MOVED = "Much of the wall is not where the reference has it, so nothing can be said about the sensor."
TOO_NOISY = "No missing effect was found, but the model's noise is too large."


@dataclass(frozen=True)
class Evidence:
    """The numbers that decide the verdict of a diagnosis, such as "no_gap" (the measurement agrees with the sensor model).

    Attributes
    ----------
    gap : scores of the model without and with the named effects on validation points; None if too few could be scored.
    p_value : p-value of the misfit that the named effects leave (goodness of fit); None if it was not computed.
    noise_ratio : observed over predicted standard deviation if it is clearly below 1, else 1.
    outlier_share : share of outliers if they lie all over the wall and are more than normal noise makes, else 0.
    moved_share : share of points that lie off the reference together with their neighbours; 0 if it was not computed.
    overdispersion : observed over predicted standard deviation if no noise term explains it, else 1.
    """

    gap: Gap | None
    p_value: float | None
    noise_ratio: float = 1.0
    outlier_share: float = 0.0
    moved_share: float = 0.0
    overdispersion: float = 1.0

    @property
    def much_moved(self) -> bool:
        """Whether so much of the wall moved (20 % of the points by default) that nothing can be said about the sensor."""
        return self.moved_share >= thresholds().changes.moved_share

    @property
    def misfit_is_significant(self) -> bool:
        """Whether the misfit that the named effects leave is larger than chance makes it: p-value at most 0.01 by default."""
        return self.p_value is not None and self.p_value <= thresholds().verdict.rejection_p

    @property
    def is_overdispersed(self) -> bool:
        """Whether the residuals have so much more variance than predicted that the model is rejected for this alone.

        Their standard deviation must be at least 1.5 times the predicted one by default, and no noise term may explain it.
        """
        return self.overdispersion >= thresholds().verdict.overdispersion

    @property
    def model_is_accepted(self) -> bool:
        """Whether the sensor model agrees with the measurement without any further sensor error (effect).

        Its score on validation points must be within its uncertainty of the score that noise alone leaves. The misfit must have
        been tested, and neither misfit nor variance may be significantly large. There may be no excess of outliers.
        """
        measured = self.gap is not None and not self.gap.above_floor and self.p_value is not None
        return measured and not (self.misfit_is_significant or self.outlier_share or self.is_overdispersed)

    @property
    def gap_stays_open(self) -> bool:
        """Whether the named effects leave most of the gap open: the model still fits much worse than noise explains.

        The gap is the score on validation points minus the score that noise alone leaves. It stays open in two cases. First, the
        score with the effects exceeds that of noise, and the effects close less of the gap than a diagnosis must, both beyond
        uncertainty. Second, the score is worse with the effects than without, and the remaining misfit is significant.
        """
        gap = self.gap
        if gap is None:
            return False
        worse = gap.after > gap.before and self.misfit_is_significant
        return worse or (gap.closed is not None and gap.left_open and self.closes_little)

    @property
    def misfit_stays(self) -> bool:
        """Whether nothing shows that the named effects help: the remaining misfit is significant, and they close no gap for sure.

        The gap is how much worse the model predicts validation points than noise explains. It may be too uncertain to tell
        whether the effects close it, or the score with them may be better by no more than the uncertainty.
        """
        gap = self.gap
        if gap is None or not self.misfit_is_significant:
            return False
        return gap.closed is None or gap.before - gap.after <= thresholds().verdict.gap_sigmas * gap.error

    @property
    def effects_unsupported(self) -> bool:
        """Whether nothing supports the named effects: validation scores are worse with them, and no misfit was tested."""
        return self.gap is not None and self.gap.after > self.gap.before and self.p_value is None

    @property
    def closes_little(self) -> bool:
        """Whether the named effects close clearly less of the gap between model and measurement than a diagnosis must.

        The required share is the threshold `verdict.least_closed`, by default one half. Also true if the gap is too small to be
        measured.
        """
        gap = self.gap
        by = thresholds().verdict
        if gap is None or gap.closed is None:
            return True
        return gap.before - gap.after + by.gap_sigmas * gap.error < by.least_closed * (gap.before - gap.floor)

    def only_noise_too_large(self, named: Sequence[NamedEffect]) -> bool:
        """Tell whether the sensor model's only fault is too large noise. named: sensor errors; with any, the answer is false."""
        still_open = self.gap is not None and self.gap.left_open and not self.model_is_accepted
        return self.noise_ratio < 1.0 and not (
            named or self.misfit_is_significant or self.outlier_share or self.is_overdispersed or still_open
        )


def verdict_of(named: Sequence[NamedEffect], evidence: Evidence) -> str:
    """Decide the verdict of a diagnosis: whether the sensor model agrees with the measurement, and if not, what explains it.

    It is "no_gap" if they agree; "named" or "several" if one or more effects explain the misfit; "ambiguous" if the one effect
    cannot be told from others; "unknown" if no effect of the catalogue explains it; "insufficient_data" if nothing can be said.

    named: sensor errors (effects) that the diagnosis names. evidence: scores and p-values that decide.
    """
    if evidence.much_moved:
        return "insufficient_data"
    if not named:
        if evidence.gap is None and not evidence.misfit_is_significant:
            return "insufficient_data"
        return "no_gap" if evidence.model_is_accepted else "unknown"
    unsupported = evidence.gap_stays_open or evidence.effects_unsupported or evidence.misfit_stays or evidence.is_overdispersed
    if unsupported or any(item.kind == "empirical" for item in named):
        return "unknown"
    if len(named) > 1:
        return "several"
    return "ambiguous" if named[0].indistinguishable else "named"


def verdict_sentence(verdict: str, named: Sequence[NamedEffect], evidence: Evidence) -> str:
    """Return the verdict of a diagnosis as a sentence for the report, which says more than the verdict where it can.

    Parameters
    ----------
    verdict : the verdict, a key of `VERDICTS` such as "no_gap" or "unknown".
    named : sensor errors that the diagnosis names.
    evidence : the scores and p-values that decided the verdict.
    """
    if evidence.much_moved:
        return MUCH_MOVED
    if verdict in ("no_gap", "unknown") and evidence.only_noise_too_large(named):
        return TOO_NOISY
    kinds = {item.kind for item in named}
    if verdict != "unknown" or kinds == {"empirical"}:
        return VERDICTS[verdict]
    if len(kinds) != 1:
        return PARTLY_EXPLAINED if kinds else NOT_DESCRIBED
    if evidence.gap_stays_open:
        return STILL_OPEN
    if evidence.effects_unsupported:
        return UNSUPPORTED
    return STILL_REJECTED if evidence.misfit_stays else STILL_OVERDISPERSED


def describe_misfit(named: Sequence[NamedEffect], evidence: Evidence) -> str:
    """Return a sentence for the report on the misfit that the named effects leave; "" if it may be chance, or without effects.

    named: the effects (sensor errors). evidence: numbers that decide the verdict, with the misfit's p-value.
    """
    if not named or not evidence.misfit_is_significant:
        return ""
    return f"That does not explain everything: the remaining misfit has a p-value of {evidence.p_value:.2g}."


def describe_closing(gap: Gap, model_changed: bool) -> str:
    """Say in words how much of the gap between model and measurement the named effects (sensor errors) close.

    gap: scores of the model without and with the effects. model_changed: whether effects were named or the noise was lowered.
    """
    if gap.closed is None:
        return "before and floor differ by no more than their uncertainty"
    if not model_changed:
        return "before exceeds the floor by more than its uncertainty, and nothing closes the gap"
    share = round(100 * gap.closed)
    return f"{share} % of the gap is closed" if share > 0 else "none of the gap is closed"


def reduced_noise(model: TlsModel | StereoModel, noise_ratio: float) -> dict[str, float]:
    """Return noise values that fit the residuals, if a sensor model's noise is too large: all are lowered by the same factor.

    The lowered values have keys such as `range_sigma_m`; there are none if the noise is not too large.

    noise_ratio: observed over predicted standard deviation of the residuals; below 1 if the noise of the model is too large.
    """
    if noise_ratio >= 1.0:
        return {}
    values = model.noise.model_dump(include=set(_NOISES))
    return {key: float(f"{noise_ratio * value:.3g}") for key, value in values.items() if value > 0}


def note_moved_wall(evidence: Evidence, stable_areas: bool) -> list[str]:
    """Make the note for the report that much of the wall moved since the reference, with what to do about it; none if not so.

    evidence: the numbers that decide the verdict. stable_areas: whether the measurement states areas where nothing moved.
    """
    if not evidence.much_moved:
        return []
    sigmas, least_mm = thresholds().changes.faint_sigmas, 1e3 * thresholds().points.reference_error
    said = (
        f"{100 * evidence.moved_share:.0f} % of the points lie off the reference together with their neighbours, by more than "
        f"{sigmas:g} predicted standard deviations and {least_mm:g} mm: rock moved, or the reference shows another place or time"
    )
    remedy = "the given stable_areas are not stable" if stable_areas else "add stable_areas where nothing moved"
    return [f"{said}; {remedy}, or use a reference of the same time"]


def note_overdispersion(evidence: Evidence, notes: Sequence[str]) -> list[str]:
    """Make the note for the report that the residuals have much more variance than the sensor model predicts.

    evidence: the numbers that decide the verdict. notes: the other notes; if one says so already, none is made.
    """
    if not evidence.is_overdispersed or any("the predicted standard deviation" in note for note in notes):
        return []
    return [
        f"the residuals have {evidence.overdispersion:.2g} times the predicted standard deviation, "
        "and nothing that was tried explains that"
    ]


def note_excess_noise(noise_ratio: float, lower: dict[str, float]) -> list[str]:
    """Make the note for the report that the sensor model's noise is too large.

    noise_ratio: observed over predicted standard deviation; from 1 on there is no note. lower: noise values that would fit, by
    key such as `range_sigma_m`.
    """
    if noise_ratio >= 1.0:
        return []
    said = (
        f"the residuals have {100 * noise_ratio:.0f} % of the predicted standard deviation: the model's noise is too large, "
        "and no effect lowers it"
    )
    proposed = ", ".join(f"{key} {value:g}" for key, value in lower.items())
    return [f"{said}; noise that fits: {proposed}"] if proposed else [said]
