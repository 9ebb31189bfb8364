"""Every threshold of the diagnosis (`scarpsim gap`), with its unit, what it decides and where the value comes from.

`scarpsim gap --set mean.class_margin=4` changes one threshold for one diagnosis; gap.json records all values under `decisions`.
The groups of noise, edges and missing returns are in `noise_thresholds.py`. Purely numerical limits (iterations, simulations,
grids, smallest divisors) are constants in the modules that use them. The last text of each field states where its value comes
from: tuning on development cases, or judgement.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

from pydantic import PositiveFloat, PositiveInt

from pipeline.config.overrides import apply_overrides
from pipeline.gap.noise_thresholds import (
    EdgeThresholds,
    LockingThresholds,
    MissingReturnsThresholds,
    QuantizationThresholds,
    VarianceThresholds,
)
from pipeline.gap.threshold_field import DEVELOPMENT, JUDGEMENT, ThresholdGroup, threshold_field
from scene.common.config import parse


class PointThresholds(ThresholdGroup):
    """Thresholds on the number of points that `gap` needs, and on which points it uses for a diagnosis.

    Residuals are measured minus predicted ranges (laser scanner) or disparities (stereo pair).
    """

    fewest: PositiveInt = threshold_field(
        800, "points", "With fewer points on smooth, stable rock the verdict is insufficient_data.", JUDGEMENT
    )
    most: PositiveInt = threshold_field(
        2_000_000,
        "points of a laser scan",
        "A scan with more points is subsampled at random to this number.",
        "memory: 1.5 kB a point; the selection uses 60,000 of them in any case",
    )
    fewest_epochs: PositiveInt = threshold_field(
        3, "epochs", "From this number of epochs on, the whole last epoch is kept for validation.", JUDGEMENT
    )
    outlier_sigmas: PositiveFloat = threshold_field(
        5.0,
        "predicted standard deviations, times the ratio of observed to predicted noise",
        "A residual beyond this is an outlier and is not used for fitting; in validation blocks it is clipped at this. An "
        "effect that lies this many standard deviations of its prior (`mean.prior_size`) from zero is rejected, as no "
        "instrument is that far off.",
        JUDGEMENT,
    )
    most_reference_scatter: PositiveFloat = threshold_field(
        2.0,
        "times the typical scatter about planes through 24 points, along the ray",
        "Points where a reference made of points scatters more than this are not used: edges and thin objects lie there.",
        "a tenth of the points of a workshop lie beyond it, and a twelfth of a forest's ground, with most of the outliers",
    )
    registration_outlier_sigmas: PositiveFloat = threshold_field(
        3.5,
        "standard deviations",
        "A residual beyond this is an outlier in the robust pose estimate. The median residual of a change must exceed it.",
        JUDGEMENT,
    )
    reference_error: PositiveFloat = threshold_field(
        0.02,
        "m",
        "Largest standard deviation that is attributed to an error of the reference correlated over a metre or more; below, "
        "the limit falls in proportion to the correlation length. A median of neighbours that departs by less than this is no "
        "change of the rock.",
        JUDGEMENT,
    )
    least_share_on_reference: PositiveFloat = threshold_field(
        0.9,
        "share of the points",
        "An effect is rejected if, with it in the model, fewer rays than this still meet the reference.",
        JUDGEMENT,
        le=1,
    )


class MeanThresholds(ThresholdGroup):
    """Thresholds by which `gap` accepts systematic effects of a sensor (mean model).

    A log-likelihood ratio compares models with and without an effect; the score is this ratio minus a penalty for the
    parameters. The equivalence class holds effects that explain the residuals as well as the best one. A signature is the
    change of the observations by an effect. A typical size is the value that an effect's parameter commonly has in instruments.
    A non-parametric term is a spline of a covariate, such as the range.
    """

    significance: PositiveFloat = threshold_field(
        0.004,
        "probability",
        "Significance level of systematic effects and of noise terms, and of the misfit with which an amplitude of pixel "
        "locking gives way to a small one that keeps the order of the disparities. An effect is accepted if the p-value of the "
        "best candidate, under a null distribution simulated without effects and maximised over all candidates, is at most "
        "this.",
        "target of 1 % false alarms over all steps",
        lt=1,
    )
    class_margin: PositiveFloat = threshold_field(
        3.0,
        "log-likelihood",
        "Effects whose score is within this of the best one belong to its equivalence class, noise terms likewise. Where a fit "
        "without linearising follows, it must tell members of the class apart by twice this. The linearised model is used if it "
        "misjudges the strongest effect by less. Amplitudes of pixel locking whose chi^2 differ by less than twice this fit "
        "equally well, and the smallest is taken. The gain of one point at a depth step is clipped at this before the wall "
        "blocks are compared. The likelihood factor exp(-3) bounds by 5 % how often the true effect is left out.",
        "target of 93 to 97 % of classes that contain the true effect",
    )
    class_share: PositiveFloat = threshold_field(
        0.01,
        "share of the log-likelihood ratio",
        "Effects whose score is within this share of the best one's log-likelihood ratio belong to its class too, noise terms "
        "likewise. Beside other effects a candidate must gain at least this share of what it gains alone, and an empirical "
        "term at least this share of what the strongest effect gains. No signature is "
        "exact, and the error grows with the ratio: 6 degrees between two signatures leave this share.",
        "geometry of small angles",
        lt=1,
    )
    most_effects: PositiveInt = threshold_field(3, "effects", "At most this many systematic effects are selected.", JUDGEMENT)
    refit_share: PositiveFloat = threshold_field(
        0.5,
        "share of the largest log-likelihood ratio",
        "An effect that alone gains at least this share of the largest ratio is refitted without linearising.",
        JUDGEMENT,
        le=1,
    )
    refit_gain: PositiveFloat = threshold_field(
        50.0,
        "log-likelihood",
        "Below this log-likelihood ratio the linearised model is used, and no effect is refitted without linearising.",
        DEVELOPMENT,
    )
    prior_size: PositiveFloat = threshold_field(
        20.0,
        "typical sizes of the effect",
        "Standard deviation of the Gaussian prior of an effect's size.",
        JUDGEMENT,
    )
    most_reference_error: PositiveFloat = threshold_field(
        1.0,
        "m",
        "Largest standard deviation that the reference's correlated error may have; `--reference-error` sets it.",
        "no limit, unless the user knows the reference",
    )


class ChangesThresholds(ThresholdGroup):
    """Thresholds by which `gap` finds scene changes: regions where the rock itself moved since the reference was measured.

    Points in such regions are not used to find sensor effects.
    """

    fewest: PositiveInt = threshold_field(
        5,
        "points",
        "A change needs at least this many points, and filled occlusions as many cells that hold a point though only one "
        "camera sees them.",
        "reported rockfalls that were missed: five points of 5 sigma",
    )
    faint_sigmas: PositiveFloat = threshold_field(
        3.0,
        "standard deviations of medians of nine points",
        "Neighbouring medians beyond this are joined to one region, which finds faint but wide changes. A point counts as "
        "moved if the median of it and its neighbours lies this many predicted standard deviations off the reference.",
        JUDGEMENT,
    )
    margin: PositiveFloat = threshold_field(
        3.0, "point spacings", "Points within this distance of a change are set aside with it.", JUDGEMENT
    )
    moved_share: PositiveFloat = threshold_field(
        0.2,
        "share of the wall",
        "If at least this share moved, the verdict is insufficient_data and no effect is named. If a noise term was named, as "
        "much must have moved beside that noise. A larger region is not taken for a compact change. If changes and outliers are "
        "at least this share, an effect is sought with which they are less than half as many.",
        "six walls of which a third moved: 0.22 to 0.31 beside a noise term; next to nothing beside a true noise",
        le=1,
    )


class VerdictThresholds(ThresholdGroup):
    """Thresholds of the verdict of `gap`: when the model is rejected, and how much named effects must explain.

    The gap is the distance between model and measurement, as a score on validation points. "Before" and "after" are the scores
    of the model without and with the named effects; the noise floor is the score that noise alone gives.
    """

    rejection_p: PositiveFloat = threshold_field(
        0.01,
        "probability",
        "Significance level of the goodness of fit. The model is rejected if the p-value of the residual misfit is at most "
        "this. A score lies above the noise floor at half this level, one-sided. A region is a change of the rock if noise "
        "would produce fewer than this number of such regions in the whole measurement.",
        "definition of the verdict no_gap",
        lt=1,
    )
    least_closed: PositiveFloat = threshold_field(
        0.5,
        "share of the gap",
        "Named effects that close clearly less than this of a significant gap are not the answer; the verdict is unknown.",
        JUDGEMENT,
        lt=1,
    )
    block_p: PositiveFloat = threshold_field(
        0.1,
        "probability",
        "Beside others, an effect is named only if the wall blocks kept for validation agree that it predicts them better: the "
        "p-value of their gains, with signs flipped at random, must be at most this. Otherwise it is only mentioned.",
        DEVELOPMENT,
        lt=1,
    )
    overdispersion: PositiveFloat = threshold_field(
        1.5,
        "ratio of observed to predicted standard deviation",
        "The model is rejected if the residuals have at least this ratio and no noise term explains it.",
        JUDGEMENT,
        gt=1,
    )
    gap_sigmas: PositiveFloat = threshold_field(
        2.0,
        "standard errors",
        "The scores before and after differ if their difference exceeds this. Beside others, an effect whose only parameter is "
        "within this of zero is only mentioned.",
        JUDGEMENT,
    )


class Thresholds(ThresholdGroup):
    """All thresholds by which `gap` decides when it diagnoses a measurement, in groups of one test each.

    `mean` is about systematic effects, `variance` about noise, `edges` about effects at depth steps.
    """

    points: PointThresholds = PointThresholds()
    mean: MeanThresholds = MeanThresholds()
    variance: VarianceThresholds = VarianceThresholds()
    locking: LockingThresholds = LockingThresholds()
    edges: EdgeThresholds = EdgeThresholds()
    missing_returns: MissingReturnsThresholds = MissingReturnsThresholds()
    quantization: QuantizationThresholds = QuantizationThresholds()
    changes: ChangesThresholds = ChangesThresholds()
    verdict: VerdictThresholds = VerdictThresholds()


_DEFAULTS = Thresholds()
_IN_USE: ContextVar[Thresholds] = ContextVar("thresholds", default=_DEFAULTS)


def read_thresholds(overrides: Sequence[str]) -> Thresholds:
    """Return the thresholds for a diagnosis by `gap`: the defaults, with those replaced that the user set on the command line.

    Parameters
    ----------
    overrides : replacements, each as `group.key=value`, such as `mean.class_margin=4`.

    Raises
    ------
    InputError : a key is unknown or a value outside its bounds.
    """
    return parse(Thresholds, apply_overrides({}, overrides), "--set")


def thresholds() -> Thresholds:
    """Return the thresholds of the diagnosis by `gap` that is running now (see `use_thresholds`), or the defaults if none is."""
    return _IN_USE.get()


def equivalence_margin(log_likelihood_ratio: float) -> float:
    """Return the difference of scores within which two effects count as indistinguishable, so that both are reported.

    It is the threshold `mean.class_margin`, or the share `mean.class_share` of the log-likelihood ratio of the models with and
    without the chosen effect if that is larger: an effect's pattern of residuals is linearised, and is inexact by about this
    share. log_likelihood_ratio: that of the chosen effect.
    """
    by = thresholds().mean
    return max(by.class_margin, by.class_share * log_likelihood_ratio)


def largest_relative_size() -> float:
    """Return the largest plausible size of an effect, in units of its typical size in the catalogue.

    It lies `points.outlier_sigmas` standard deviations of the prior (`mean.prior_size`) from zero.
    """
    return thresholds().points.outlier_sigmas * thresholds().mean.prior_size


@contextmanager
def use_thresholds(chosen: Thresholds) -> Iterator[None]:
    """Make `thresholds()` return the chosen thresholds inside a `with` block, for one diagnosis by `gap`."""
    token = _IN_USE.set(chosen)
    try:
        yield
    finally:
        _IN_USE.reset(token)
