"""What `gap` decides by: every threshold of the diagnosis, with its unit, what it decides, and where it comes from.

Numerical limits (rounds, draws, grids, what is too small to divide by) stand where they are used. `scarpsim gap --set
mean.class_margin=4` changes one; gap.json holds all of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt

from pipeline.config.overrides import apply_overrides
from scene.common.config import parse

_DEVELOPMENT, _JUDGEMENT = "development cases", "judgement"


def _by(default: float, unit: str, decides: str, source: str, **bounds: Any) -> Any:
    """A decision: its value, its unit, what it decides, and where the value comes from."""
    return Field(default, description=decides, json_schema_extra={"unit": unit, "source": source}, **bounds)


class _Group(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PointsDecisions(_Group):
    """Which points have a say, and how many there must be."""

    fewest: PositiveInt = _by(800, "points", "On smooth, stable rock below which the answer is insufficient_data.", _JUDGEMENT)
    most: PositiveInt = _by(
        2_000_000,
        "points of a laser scan",
        "Beyond which so many, drawn at random, are looked at.",
        "memory: 1.5 kB a point; naming rests on 60,000 of them in any case",
    )
    fewest_epochs: PositiveInt = _by(3, "epochs", "From which on the last is held out as a whole.", _JUDGEMENT)
    outlier: PositiveFloat = _by(
        5.0, "predicted sigmas, times what the residuals spread of them", "Beyond which a point has no say.", _JUDGEMENT
    )
    scattered: PositiveFloat = _by(
        2.0,
        "times the typical scatter about planes of 24 points, along the ray",
        "Of a reference made of points: beyond which edges and thin things lie between them, and points have no say.",
        "beyond it lie the tenth of a workshop's points, and the twelfth of a forest's ground, with most of the far ones",
    )
    unregistered: PositiveFloat = _by(3.5, "sigmas", "Beyond which a point has no say in the registration.", _JUDGEMENT)
    kept: PositiveFloat = _by(
        0.9, "share", "Of the points whose rays must still meet the reference with an effect in the model.", _JUDGEMENT, le=1
    )


class MeanDecisions(_Group):
    """What explains the mean of the residuals."""

    significance: PositiveFloat = _by(
        0.004,
        "probability",
        "Of the largest score where there is nothing, at or below which an effect is there.",
        "GAP.md's 1 % of false alarms over all steps",
        lt=1,
    )
    least_score: PositiveFloat = _by(4.0, "log-likelihood", "That an effect must gain on new data.", _JUDGEMENT)
    class_margin: PositiveFloat = _by(
        3.0,
        "log-likelihood",
        "Within which of the best others belong to its class: e^-3 bounds by 5 % how often the truth is left out.",
        "GAP.md's 93 to 97 % of classes that hold the truth",
    )
    class_share: PositiveFloat = _by(
        0.01,
        "share",
        "Of its gain by which a score must be ahead too for the others not to belong to its class: no signature is exact, and "
        "what it misses grows with the gain (6 degrees off the truth leave so much).",
        "geometry of small angles",
        lt=1,
    )
    free_margin: PositiveFloat = _by(
        5.0, "log-likelihood", "By which a free form must do better than the catalogue's best to be called unknown.", _DEVELOPMENT
    )
    least_free_score: PositiveFloat = _by(
        12.0,
        "log-likelihood",
        "Of a free form: the reference's error is not quite as its model says, and a flexible form takes that up first.",
        _DEVELOPMENT,
    )
    least_surface_score: PositiveFloat = _by(15.0, "log-likelihood", "Of a form of two covariates.", _DEVELOPMENT)
    surface_ratio: PositiveFloat = _by(
        1.15, "ratio", "How many times the score of a form of one covariate one of two has to have.", _DEVELOPMENT
    )
    wave_ratio: PositiveFloat = _by(
        2.0,
        "ratio",
        "How many times the score of waves in slanting directions a wave along a covariate has to have.",
        _DEVELOPMENT,
    )
    most_effects: PositiveInt = _by(3, "effects", "Named at the most for the mean.", _JUDGEMENT)
    undone_size: PositiveFloat = _by(
        10.0,
        "typical sizes",
        "From which on an effect that the registration undoes nearly is not committed to where more is left than chance gives.",
        _JUDGEMENT,
    )
    undone_share: PositiveFloat = _by(
        0.1,
        "share",
        "Of an effect that the registration, or a curve of an angle, leaves, below which that holds it nearly.",
        _JUDGEMENT,
        lt=1,
    )
    practical_share: PositiveFloat = _by(
        0.02,
        "share",
        "Of what a candidate gains by itself that it has to gain beside others: less is what those are not exact in (8 "
        "degrees off the truth leave so much).",
        "geometry of small angles",
        le=1,
    )
    wave_sigmas: PositiveFloat = _by(
        1.0, "standard deviations of the reference's error", "That a wave without a name has to have at least.", _JUDGEMENT
    )
    kin: PositiveFloat = _by(0.95, "correlation", "From which on two covariates are one to a free form.", _JUDGEMENT, lt=1)
    leading_share: PositiveFloat = _by(
        0.5, "share", "Of the largest gain that an effect must gain by itself to be taken exactly too.", _JUDGEMENT, le=1
    )
    leading_gain: PositiveFloat = _by(
        50.0, "log-likelihood", "Below which slopes serve and no effect is taken exactly.", _DEVELOPMENT
    )
    slopes_serve: PositiveFloat = _by(
        10.0, "log-likelihood", "By which slopes may be wrong on an effect for them to serve.", _JUDGEMENT
    )
    typical_sizes: PositiveFloat = _by(
        20.0, "typical sizes", "Standard deviation of an effect's size before there are data.", _JUDGEMENT
    )
    largest_size: PositiveFloat = _by(
        100.0, "typical sizes", "Beyond which no instrument is out, and an effect explains nothing.", _JUDGEMENT
    )


class SpreadDecisions(_Group):
    """What explains the spread of the residuals."""

    significance: PositiveFloat = _by(
        0.004,
        "probability",
        "Of the largest standardised score under signs drawn by block, at or below which the spread is not the predicted one.",
        "GAP.md's 1 % of false alarms over all steps",
        lt=1,
    )
    least_gain: PositiveFloat = _by(6.0, "log-likelihood", "That the best form must gain.", _JUDGEMENT)
    least_excess: PositiveFloat = _by(
        0.04, "share of the predicted variance", "Below which the reference's own small errors may be meant.", _DEVELOPMENT
    )
    least_between: PositiveFloat = _by(
        0.75,
        "share",
        "Of the added variance by which neighbours must differ: an error of the reference, correlated over metres, moves both.",
        _DEVELOPMENT,
        le=1,
    )
    too_noisy: PositiveFloat = _by(
        0.9, "share of the predicted spread", "Less is worth a word, and a lower noise is proposed.", _JUDGEMENT
    )
    clip: PositiveFloat = _by(4.5, "sigmas", "Beyond which a deviation has no say in the spread.", _JUDGEMENT)
    class_margin: PositiveFloat = _by(
        5.0,
        "log-likelihood",
        "Within which of the best others belong to its class: more than for the mean, as a few steep blocks decide. In "
        "three development scans the right one was 9 to 15 ahead of its nearest.",
        _DEVELOPMENT,
    )
    class_share: PositiveFloat = _by(
        0.01, "share", "Of its gain by which a score must be ahead too: no form of a variance is exact.", _JUDGEMENT, lt=1
    )
    free_margin: PositiveFloat = _by(
        6.0, "log-likelihood", "By which a free form must do better than the catalogue's best.", _DEVELOPMENT
    )
    free_gain: PositiveFloat = _by(15.0, "log-likelihood", "That a free form must gain over the named one.", _DEVELOPMENT)
    free_share: PositiveFloat = _by(
        0.1,
        "share",
        "Of the named one's gain: up to there a free form is a note. Known noises put into real scans came to 0.05 and 0.09, one "
        "of no effect of the catalogue in a development case to 0.15.",
        _DEVELOPMENT,
    )
    free_block_sigmas: PositiveFloat = _by(
        2.0, "scatter of the blocks' sums", "By which the blocks must prefer a free form.", _DEVELOPMENT
    )
    second_gain: PositiveFloat = _by(
        3.0, "log-likelihood", "That a second effect must gain where the first leaves something over.", _JUDGEMENT
    )
    block_sigmas: PositiveFloat = _by(
        3.0,
        "scatter of the blocks' sums",
        "By which blocks must agree on a second effect, or on a spread that is too small.",
        _JUDGEMENT,
    )
    cost_of_a_trial: PositiveFloat = _by(0.5, "log-likelihood", "Of a value of which some are tried.", _JUDGEMENT)
    far: PositiveFloat = _by(4.0, "sigmas", "From which on a residual counts as a tail.", _JUDGEMENT)
    most_far: PositiveFloat = _by(
        0.004,
        "share",
        "Of residuals in the tails that normal noise and small faults of a reference leave: up to 0.0016 without an "
        "effect, 0.02 with 3 % of outliers.",
        _DEVELOPMENT,
        le=1,
    )
    most_uneven: PositiveFloat = _by(
        0.5,
        "standard deviation over mean",
        "Of the blocks' shares of far points beyond chance: more is of parts of the wall, not the instrument's own.",
        _JUDGEMENT,
    )
    core_excess: PositiveFloat = _by(
        0.15,
        "share of the predicted variance",
        "By which the middle of the residuals must be wider for an effect on the spread to hold beside far points all over "
        "the wall.",
        _JUDGEMENT,
    )


class NodesDecisions(_Group):
    """Noise of disparities that neighbours share."""

    margin: PositiveFloat = _by(6.0, "chi^2", "From which on white noise or noise on nodes is named alone.", _JUDGEMENT)
    least_gain: PositiveFloat = _by(
        12.0, "chi^2", "That noise on nodes needs where points by themselves show none.", _DEVELOPMENT
    )
    least_sigmas: PositiveFloat = _by(
        4.0, "standard deviations", "Of its variance that noise on nodes needs there.", _DEVELOPMENT
    )
    finest: PositiveFloat = _by(2.0, "cells of the raster", "From which on a grid of nodes differs from white noise.", _JUDGEMENT)
    reference_error: PositiveFloat = _by(
        0.02,
        "m",
        "Of the reference, correlated over metres, that there may be; a wave that is no larger may be it.",
        _JUDGEMENT,
    )
    reference_length: PositiveFloat = _by(
        0.45,
        "m, standard deviation of a Gaussian correlation",
        "From which on the reference may be wrong by that much: errors in waves of 1.5 m have this correlation (0.3 of a wave).",
        _JUDGEMENT,
    )
    reference_relief: PositiveFloat = _by(
        0.005, "m", "Of the reference, correlated over less: larger noise on nodes is not its error.", _JUDGEMENT
    )


class LockingDecisions(_Group):
    """Whether measured disparities crowd at whole pixels."""

    fewest_cycles: PositiveFloat = _by(6.0, "pixels of disparity", "That the measurement has to span.", _JUDGEMENT)
    crowding: PositiveFloat = _by(
        1.5, "ratio", "How much more than the reference itself the measured disparities must crowd.", _DEVELOPMENT
    )
    most_blur: PositiveFloat = _by(0.35, "px", "Of noise beyond which nothing is left of a crowding.", _JUDGEMENT)
    significance: PositiveFloat = _by(1e-4, "probability", "Of such a crowding by chance.", _JUDGEMENT, lt=1)
    alike: PositiveFloat = _by(6.0, "chi^2 of four values", "Within which two amplitudes fit alike.", _JUDGEMENT)
    fits: PositiveFloat = _by(20.0, "chi^2 of four values", "With which an amplitude fits at the most.", _DEVELOPMENT)


class ShapesDecisions(_Group):
    """Effects where the surface is not smooth."""

    least_gain: PositiveFloat = _by(30.0, "log-likelihood", "That such an effect must gain.", _DEVELOPMENT)
    block_sigmas: PositiveFloat = _by(3.0, "scatter of the blocks' sums", "By which the blocks must agree.", _JUDGEMENT)
    most_of_a_point: PositiveFloat = _by(
        3.0, "log-likelihood", "That one point may say where blocks are asked to agree.", _JUDGEMENT
    )
    footprint_block_sigmas: PositiveFloat = _by(
        2.0,
        "scatter of the blocks' sums",
        "By which the blocks must agree on a beam's width: four of four. Of 60 development cases without a footprint "
        "none came to 1.9.",
        _DEVELOPMENT,
    )
    footprint_fewest: PositiveInt = _by(20, "points", "Between the two sides of an edge.", _JUDGEMENT)
    clear_sigmas: PositiveFloat = _by(
        3.0, "sigmas", "By which an effect at depth steps must move a point for it to bear witness.", _JUDGEMENT
    )
    wider: PositiveFloat = _by(
        1.5,
        "ratio",
        "How many times the least spread of all attempts, with and without such effects, one may leave to be the answer.",
        _JUDGEMENT,
    )
    wide: PositiveFloat = _by(
        2.0,
        "ratio",
        "How many times the predicted spread the residuals must have for outlines to be looked for beside the registration and "
        "the spread that they leave, and by how many times they must lower it.",
        _JUDGEMENT,
    )
    clear_step: PositiveFloat = _by(
        1.3, "ratio", "How many times the least depth step it must be: what counts as one, matchers do not agree.", _JUDGEMENT
    )
    fewest_filled: PositiveInt = _by(8, "cells", "Of filled strips.", _JUDGEMENT)
    least_filled_gain: PositiveFloat = _by(10.0, "log-likelihood", "That filled strips must gain.", _JUDGEMENT)
    least_held: PositiveFloat = _by(0.6, "share", "Of the gain that must hold on blocks that were held out.", _JUDGEMENT, le=1)


class LossesDecisions(_Group):
    """What explains returns that are missing."""

    least_gain: PositiveFloat = _by(9.0, "log-likelihood", "That an effect on the returns must gain.", _JUDGEMENT)
    abrupt: PositiveFloat = _by(0.7, "share", "Of the change at a limit that must happen at once.", _DEVELOPMENT, le=1)
    scattered: PositiveFloat = _by(0.8, "share", "Of single losses among all, from which on they are drops'.", _DEVELOPMENT, le=1)
    free_margin: PositiveFloat = _by(
        6.0, "log-likelihood", "By which a free form must do better than the catalogue's effects.", _JUDGEMENT
    )
    free_ratio: PositiveFloat = _by(1.5, "ratio", "How many times their score it must have.", _JUDGEMENT)
    agreement: PositiveFloat = _by(
        0.85,
        "ratio",
        "How well strips across a sector must agree on its losses (1: each gains as much as any other): of 35 cases "
        "without losses by direction the highest is 0.73, of 3 sectors the lowest 0.96.",
        _DEVELOPMENT,
    )
    early_sigmas: PositiveFloat = _by(8.0, "sigmas", "By which a return of a drop is early.", _JUDGEMENT)
    early: PositiveFloat = _by(0.5, "m", "By which it is early at the least.", _JUDGEMENT)


class QuantizationDecisions(_Group):
    """Whether ranges are rounded."""

    strong: PositiveFloat = _by(
        0.2, "mean resultant length", "Of the ranges' phases that a comb has and noise never.", _DEVELOPMENT
    )


class ChangesDecisions(_Group):
    """What is a change of the scene and no fault of the sensor."""

    by_chance: PositiveFloat = _by(
        0.01, "changes", "That may be found in a measurement in which nothing moved.", "GAP.md's 1 % of false alarms"
    )
    fewest: PositiveInt = _by(5, "points", "Of a change.", "the issue on missed rockfalls: five points of five sigma")
    middle_sigmas: PositiveFloat = _by(3.5, "sigmas", "That the median of a change must depart.", _JUDGEMENT)
    faint: PositiveFloat = _by(
        3.0, "standard deviations of medians of nine points", "From which on they belong together.", _JUDGEMENT
    )
    smallest: PositiveFloat = _by(
        0.02,
        "m",
        "A median of neighbours that departs less tells no change: what is wrong with the reference and with rays is as large.",
        _DEVELOPMENT,
    )
    margin: PositiveFloat = _by(3.0, "spacings", "Around a change in which points are set aside with it.", _JUDGEMENT)
    largest_share: PositiveFloat = _by(0.25, "share of the wall", "A region that takes more is no compact change.", _JUDGEMENT)
    moved_sigmas: PositiveFloat = _by(
        3.0,
        "predicted sigmas",
        "By which the median of a point and its neighbours lies off the reference where the wall is not the one that it was.",
        "development cases: 41 to 88 % of walls on which 40 % of the rock moved, at most 18 % beside any effect",
    )
    moved_share: PositiveFloat = _by(
        0.3, "share of the wall", "That lies so far off, from which on nothing is said of the sensor.", _DEVELOPMENT, le=1
    )
    moved_beside_noise: PositiveFloat = _by(
        0.1,
        "share of the wall",
        "The same with a noise in the model that was named, which closes some of any gap and moves no neighbours together.",
        "six walls a third of which moved: 0.22 to 0.31; next to nothing beside a true noise",
        le=1,
    )
    stripe: PositiveFloat = _by(
        30.0,
        "spacings",
        "From which on a region that is less than a tenth as wide as long is a stripe, and no compact change.",
        _JUDGEMENT,
    )


class HeldOutDecisions(_Group):
    """What holds on blocks that no step of naming has used."""

    clip: PositiveFloat = _by(5.0, "sigmas", "At which deviations are cut off: an outlier has no more to say.", _JUDGEMENT)
    sigmas: PositiveFloat = _by(
        2.5,
        "standard deviations",
        "By which the gain of a true effect may chance to lie below what the training blocks let expect.",
        _JUDGEMENT,
    )
    most_lost: PositiveFloat = _by(
        1.5,
        "log-likelihood",
        "That chance may take: held-out blocks that are less likely by more with an effect speak against it.",
        _DEVELOPMENT,
    )
    least_beside: PositiveFloat = _by(
        2.0,
        "log-likelihood",
        "That an effect must gain beside others to be named, not only mentioned: where a gain is as large as its standard error.",
        "the gain of a true effect, half a difference of two chi^2, has twice its expectation as variance",
    )
    sigmas_of_none: PositiveFloat = _by(
        2.0,
        "standard deviations",
        "Within which of none the one value of an effect beside others lies that is only mentioned.",
        _JUDGEMENT,
    )
    left_over: PositiveFloat = _by(
        0.02,
        "share",
        "Of the gain of an empirical term on the mean, what a spread gains that is only the part of the form that the "
        "term misses.",
        _DEVELOPMENT,
        le=1,
    )


class RejectionDecisions(_Group):
    """Whether the model is rejected."""

    least_p: PositiveFloat = _by(
        0.01, "probability", "Of what remains, at or below which the model is rejected.", "CONTRACT.md", lt=1
    )
    least_closed: PositiveFloat = _by(
        0.5, "share", "Of a gap, if it is none of chance, that named effects must close to be the answer.", _JUDGEMENT, lt=1
    )
    most_wide: PositiveFloat = _by(
        1.5,
        "times the predicted spread",
        "That residuals have, with nothing named that explains it, from which on the model is rejected.",
        _JUDGEMENT,
        gt=1,
    )
    gap_sigmas: PositiveFloat = _by(
        2.0, "standard errors", "By which after may differ from before for the two to agree.", _JUDGEMENT
    )
    floor_sigmas: PositiveFloat = _by(
        2.6,
        "standard errors",
        "By which a score may lie above the floor for the two to agree: half a percent lies beyond by chance.",
        _JUDGEMENT,
    )


class Decisions(_Group):
    """All of them, by what they decide."""

    points: PointsDecisions = PointsDecisions()
    mean: MeanDecisions = MeanDecisions()
    spread: SpreadDecisions = SpreadDecisions()
    nodes: NodesDecisions = NodesDecisions()
    locking: LockingDecisions = LockingDecisions()
    shapes: ShapesDecisions = ShapesDecisions()
    losses: LossesDecisions = LossesDecisions()
    quantization: QuantizationDecisions = QuantizationDecisions()
    changes: ChangesDecisions = ChangesDecisions()
    held_out: HeldOutDecisions = HeldOutDecisions()
    verdict: RejectionDecisions = RejectionDecisions()


_USUAL = Decisions()
_DECIDED: ContextVar[Decisions] = ContextVar("decisions", default=_USUAL)


def read_decisions(overrides: Sequence[str]) -> Decisions:
    """With some values given as `group.key=value`. Raises InputError where one is unknown or beyond its bounds."""
    return parse(Decisions, apply_overrides({}, overrides), "--set")


def decided() -> Decisions:
    """Those of the diagnosis that is being made."""
    return _DECIDED.get()


@contextmanager
def deciding(by: Decisions) -> Iterator[None]:
    """Make what is called within decide by these."""
    token = _DECIDED.set(by)
    try:
        yield
    finally:
        _DECIDED.reset(token)
