"""The verdict, and what may be said beside it: both follow from the same numbers, so that words never contradict them.

`no_gap` says that the model is not rejected: the gap before is within its uncertainty of the floor, and what remains is no more
than chance would give. A number that was not drawn speaks for nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.gap.naming.gap_score import Gap
from pipeline.gap.naming.named_effects import NamedEffect
from pipeline.gap.thresholds import thresholds
from sensors.models.sensor_model import StereoModel, TlsModel

VERDICTS = {
    "no_gap": "The measurement agrees with the model: nothing was found that the model does not hold.",
    "named": "One effect explains where measurement and model disagree.",
    "several": "More than one effect is needed to explain where measurement and model disagree.",
    "ambiguous": "An effect is there, but this measurement cannot tell it from others that would look the same.",
    "unknown": "The model is rejected, and no effect of the catalogue passes its own test; an empirical term describes it.",
    "insufficient_data": "There are too few points on smooth parts of the reference to say anything.",
}
_NOISES = ("range_sigma_m", "range_ppm", "angle_sigma_rad", "parallax_sigma_px", "regularization_sigma_px",
           "point_sigma_m", "point_shared_sigma_m")  # fmt: skip
STILL_OPEN = (
    "Effects were named, but most of the gap stays open: the model is rejected with them too, and nothing else explains it."
)
STILL_OVERDISPERSED = (
    "Effects were named, but with them too the residuals spread far more than the model predicts, and nothing explains that."
)
STILL_REJECTED = (
    "Effects were named, but the model is rejected with them too, and the gap is too small to show that they close any of it."
)
UNSUPPORTED = "Effects were named, but with them the gap is no smaller, and what remains was not tested: nothing speaks for them."
PARTLY = (
    "The model is rejected: effects of the catalogue explain a part of what is missing, and an empirical term describes more."
)
NOT_DESCRIBED = "The model is rejected, and nothing that was tried describes what is missing."
MUCH_MOVED = "Much of the wall is not where the reference has it: of what is left nothing can be said of the sensor."
TOO_NOISY = "No effect was found to be missing, but the model's noise is too large."


@dataclass(frozen=True)
class Evidence:
    """The numbers that a verdict rests on.

    gap: on held-out points, None where there are too few; p_value: of what remains, None where it was not drawn; spread: share of
    the predicted standard deviation that the residuals have where that is clearly less, else 1; far: share of points far out all
    over the wall, 0 where they are as few as noise leaves; moved: of points that lie off the reference together with their
    neighbours, where that was asked; wide: how many predicted sigmas the residuals spread where no effect explains that, else 1.
    """

    gap: Gap | None
    p_value: float | None
    spread: float = 1.0
    far: float = 0.0
    moved: float = 0.0
    wide: float = 1.0

    @property
    def much_moved(self) -> bool:
        """Whether too much of the wall is not where the reference has it for anything to be said of the sensor."""
        return self.moved >= thresholds().changes.moved_share

    @property
    def rejects(self) -> bool:
        """Whether what remains is more than chance would give."""
        return self.p_value is not None and self.p_value <= thresholds().verdict.rejection_p

    @property
    def too_wide(self) -> bool:
        """Whether the residuals spread so much more than predicted that the model is rejected, whatever else says."""
        return self.wide >= thresholds().verdict.overdispersion

    @property
    def agrees(self) -> bool:
        """Whether the model without any effect is not rejected: by the gap on held-out points, by what remains, and by how much
        the residuals spread."""
        measured = self.gap is not None and not self.gap.above_floor and self.p_value is not None
        return measured and not (self.rejects or self.far or self.too_wide)

    @property
    def stays_open(self) -> bool:
        """Whether the gap with the named effects is above the floor, and most of what it was, by more than its uncertainty; or no
        smaller than without them while more remains than chance would leave."""
        gap = self.gap
        if gap is not None and gap.after > gap.before and self.rejects:
            return True
        return gap is not None and gap.closed is not None and gap.left_open and self.closes_little

    @property
    def stays_rejected(self) -> bool:
        """Whether more remains beside the named effects than chance would leave, and no gap tells what they are worth."""
        return self.rejects and self.gap is not None and self.gap.closed is None

    @property
    def supports_nothing(self) -> bool:
        """Whether the gap is no smaller with the named effects, and what remains beside them was not drawn."""
        return self.gap is not None and self.gap.after > self.gap.before and self.p_value is None

    @property
    def closes_little(self) -> bool:
        """Whether the gap with the named effects is most of what it was, by more than its uncertainty, or not known at all."""
        gap = self.gap
        by = thresholds().verdict
        if gap is None or gap.closed is None:
            return True
        return gap.before - gap.after + by.gap_sigmas * gap.error < by.least_closed * (gap.before - gap.floor)

    def only_too_noisy(self, named: Sequence[NamedEffect]) -> bool:
        """Whether the model's noise is too large and nothing else was found to be wrong: with a lower one the floor is met."""
        open_still = self.gap is not None and self.gap.left_open and not self.agrees
        return self.spread < 1.0 and not (named or self.rejects or self.far or self.too_wide or open_still)


def verdict_of(named: Sequence[NamedEffect], evidence: Evidence) -> str:
    """What the effects that were named, and the numbers, come to."""
    if evidence.much_moved:
        return "insufficient_data"
    if not named:
        if evidence.gap is None and not evidence.rejects:
            return "insufficient_data"
        return "no_gap" if evidence.agrees else "unknown"
    unsaid = evidence.stays_open or evidence.supports_nothing or evidence.stays_rejected or evidence.too_wide
    if unsaid or any(item.kind == "empirical" for item in named):
        return "unknown"
    if len(named) > 1:
        return "several"
    return "ambiguous" if named[0].alike else "named"


def verdict_sentence(verdict: str, named: Sequence[NamedEffect], evidence: Evidence) -> str:
    """A verdict in words."""
    if evidence.much_moved:
        return MUCH_MOVED
    if verdict in ("no_gap", "unknown") and evidence.only_too_noisy(named):
        return TOO_NOISY
    kinds = {item.kind for item in named}
    if verdict == "unknown" and len(kinds) > 1:
        return PARTLY
    if verdict == "unknown" and "empirical" not in kinds:
        if not named:
            return NOT_DESCRIBED
        if evidence.stays_open:
            return STILL_OPEN
        if evidence.supports_nothing:
            return UNSUPPORTED
        return STILL_REJECTED if evidence.stays_rejected else STILL_OVERDISPERSED
    return VERDICTS[verdict]


def describe_misfit(named: Sequence[NamedEffect], evidence: Evidence) -> str:
    """Words for what is left beside what was named, "" where that may be chance."""
    if not named or not evidence.rejects:
        return ""
    return f"That does not explain all of it: what remains has a p-value of {evidence.p_value:.2g}."


def describe_closing(gap: Gap, mended: bool) -> str:
    """How far the gap closes, in words. mended: whether the model after is another one than before."""
    if gap.closed is None:
        return "before and floor differ by no more than their uncertainty"
    if not mended:
        return "before is above the floor by more than its uncertainty, and nothing closes that"
    share = round(100 * gap.closed)
    return f"{share} % of the gap is closed" if share > 0 else "none of the gap is closed"


def reduced_noise(model: TlsModel | StereoModel, spread: float) -> dict[str, float]:
    """The noise that a model would need for the residuals' spread, all of it lowered alike; empty where it fits.

    spread: share of the model's own standard deviation.
    """
    if spread >= 1.0:
        return {}
    values = model.noise.model_dump(include=set(_NOISES))
    return {key: float(f"{spread * value:.3g}") for key, value in values.items() if value > 0}


def note_moved_wall(evidence: Evidence, stable_areas: bool) -> list[str]:
    """Words for a wall much of which moved, with what to do. stable_areas: whether the measurement names some."""
    if not evidence.much_moved:
        return []
    by = thresholds().changes
    said = (
        f"{100 * evidence.moved:.0f} % of the points lie off the reference together with their neighbours, by more than "
        f"{by.moved_sigmas:g} predicted sigmas and {1e3 * by.smallest_departure:g} mm: rock moved, or the reference "
        "is of another place or time"
    )
    remedy = "the stable_areas that were given are not stable" if stable_areas else "name stable_areas where nothing moved"
    return [f"{said}; {remedy}, or bring a reference of the same time"]


def note_overdispersion(evidence: Evidence, notes: Sequence[str]) -> list[str]:
    """Words for residuals that spread more than predicted, where no note says more of that already."""
    if not evidence.too_wide or any("the residuals spread" in note for note in notes):
        return []
    return [f"the residuals spread {evidence.wide:.2g} times what the model predicts, and nothing that was tried explains that"]


def note_excess_noise(spread: float, lower: dict[str, float]) -> list[str]:
    """Words for a model that predicts more spread than there is."""
    if spread >= 1.0:
        return []
    said = (
        f"the residuals spread {100 * spread:.0f} % of what the model predicts: its noise is too large, which no effect can mend"
    )
    proposed = ", ".join(f"{key} {value:g}" for key, value in lower.items())
    return [f"{said}; a noise that fits: {proposed}"] if proposed else [said]
