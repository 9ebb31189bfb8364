"""Thresholds of what is no systematic effect: variance model, pixel locking, rounding, edges, missing returns.

A gain is a log-likelihood ratio of the models with and without an effect; a score is a gain minus a penalty for the parameters.
Wall blocks are squares of the wall, which count as independent. Their agreement is measured like a number of standard deviations:
the sum of their gains over the root of the sum of squared gains. The last text of each field states where its value comes from.
"""

from __future__ import annotations

from pydantic import PositiveFloat

from pipeline.gap.threshold_field import DEVELOPMENT, JUDGEMENT, ThresholdGroup, threshold_field


class VarianceThresholds(ThresholdGroup):
    """Thresholds by which `gap` accepts noise terms: effects that change the variance of the residuals (variance model).

    An empirical term is a variance that is fitted freely in bins of a covariate, such as the range. Losses of laser pulses that
    are free by direction have a probability that is fitted likewise in bins of the azimuth or zenith angle.
    """

    least_gain: PositiveFloat = threshold_field(
        6.0,
        "log-likelihood",
        "The best noise term needs at least this log-likelihood ratio, a second one beside it and an effect on the returns "
        "too. Beside other effects, an effect must gain more than this on validation blocks to be named, not only mentioned, "
        "unless only it explains a misfit. "
        "A non-parametric term, a variance free in bins or losses free by direction must score this much more than the best "
        "effect of the catalogue to be chosen instead, a term of two covariates this much more than one of one, and any of "
        "them this much more than an error of the reference can. In all, a non-parametric term needs twice this: the "
        "reference error departs a little from its model, and a flexible term absorbs that first. Grid-correlated noise must "
        "improve the fit of the semivariogram by twice this in chi^2.",
        JUDGEMENT,
    )
    least_excess: PositiveFloat = threshold_field(
        0.04,
        "share of the predicted variance",
        "Less additional variance than this is attributed to small errors of the reference, and no noise term is named. Beside "
        "heavy tails, the core of the residuals must have as much more variance for a noise term to be kept.",
        DEVELOPMENT,
    )
    least_unshared_share: PositiveFloat = threshold_field(
        0.75,
        "share of the added variance",
        "A noise term of a laser scan is named only if at least this share differs between neighbouring points. An error "
        "of the reference, correlated over metres, moves both alike.",
        DEVELOPMENT,
        le=1,
    )
    excess_noise_ratio: PositiveFloat = threshold_field(
        0.9,
        "ratio of observed to predicted standard deviation",
        "Below this ratio the model's noise is reported as too large, and a lower one is proposed.",
        JUDGEMENT,
    )
    nonparametric_share: PositiveFloat = threshold_field(
        0.1,
        "share of the named term's log-likelihood ratio",
        "A variance free in bins that gains no more than this over the named term is only a note; beyond, or if the wall blocks "
        "agree by `edges.block_sigmas`, the term is marked empirical. Known noise put into real scans came to 0.05 and 0.09, and "
        "noise outside the catalogue to 0.15.",
        DEVELOPMENT,
    )
    tail_sigmas: PositiveFloat = threshold_field(
        4.0, "standard deviations", "A residual beyond this counts as an outlier of the tails.", JUDGEMENT
    )
    most_tail_share: PositiveFloat = threshold_field(
        0.004,
        "share of the residuals",
        "More outliers than this are reported as heavy tails. Shares up to 0.0016 are normal.",
        DEVELOPMENT,
        le=1,
    )
    most_tail_unevenness: PositiveFloat = threshold_field(
        0.5,
        "standard deviation over mean of the wall blocks' shares of outliers, beyond chance",
        "If the share of outliers differs more than this between blocks, parts of the wall are the cause, not the instrument.",
        JUDGEMENT,
    )


class LockingThresholds(ThresholdGroup):
    """Thresholds of the test for pixel locking: measured disparities that crowd around whole pixels.

    The resultant length measures how strongly fractions of a pixel crowd: 0 not at all, 1 all alike.
    """

    fewest_cycles: PositiveFloat = threshold_field(
        6.0, "pixels of disparity", "The disparities must span at least this for pixel locking to be tested.", JUDGEMENT
    )
    crowding_ratio: PositiveFloat = threshold_field(
        1.5,
        "ratio of resultant lengths",
        "The resultant length of measured disparities must be this many times that of the reference, whose shape may "
        "make them crowd too.",
        DEVELOPMENT,
    )
    significance: PositiveFloat = threshold_field(
        1e-4, "probability", "Significance level: crowding that chance makes more often is not reported.", JUDGEMENT, lt=1
    )


class QuantizationThresholds(ThresholdGroup):
    """Threshold of the test whether a scanner rounded its ranges to a step, such as 1 mm.

    A phase is the remainder of a range after division by the step, as an angle. The mean resultant length is 1 if all phases
    are alike, as for rounded ranges, and near 0 if they are spread evenly.
    """

    least_resultant: PositiveFloat = threshold_field(
        0.2,
        "mean resultant length of the ranges' phases",
        "Ranges count as rounded if their phases modulo the step have at least this; noise never reaches it.",
        DEVELOPMENT,
    )


class EdgeThresholds(ThresholdGroup):
    """Thresholds of effects at depth steps: edge fattening, smoothing, filled occlusions and the beam footprint.

    A cell is a pixel of the disparity raster.
    """

    least_gain: PositiveFloat = threshold_field(
        30.0, "log-likelihood", "An edge effect needs at least this log-likelihood ratio, filled occlusions too.", DEVELOPMENT
    )
    least_block_sigmas: PositiveFloat = threshold_field(
        2.0,
        "root sums of squares of the wall blocks' gains",
        "The wall blocks must agree by this much on a beam divergence, or that a variance free in bins fits better than a "
        "named one: for example four blocks of four. None of 60 development cases without a footprint came to 1.9.",
        DEVELOPMENT,
    )
    block_sigmas: PositiveFloat = threshold_field(
        3.0,
        "root sums of squares of the wall blocks' gains",
        "The wall blocks must agree by this much on an edge effect, on a second noise term, on a variance free in bins for which "
        "a noise term loses its name, on grid-correlated noise where single points show no added variance, or on noise that is "
        "lower than predicted.",
        JUDGEMENT,
    )
    least_filled_share: PositiveFloat = threshold_field(
        0.6,
        "share of the half-occluded cells",
        "In strips beside depth steps that only one camera sees, at least this share of the cells up to the estimated "
        "width must hold a point.",
        JUDGEMENT,
        le=1,
    )


class MissingReturnsThresholds(ThresholdGroup):
    """Thresholds of the effects that explain why laser pulses did not return: a detection limit, precipitation or a direction.

    Drops are rain or snow, which return some pulses from in front of the wall.
    """

    cutoff_ratio: PositiveFloat = threshold_field(
        0.7,
        "ratio of log-power intervals: lowest 0.5 % over lowest 1 %",
        "The recorded powers end abruptly, as at a detection limit, if the ratio is below this; a normal tail gives 0.8.",
        DEVELOPMENT,
        le=1,
    )
    least_agreement: PositiveFloat = threshold_field(
        0.8,
        "share of full agreement between parts of the wall or of the scan",
        "Early returns count as drops if they lie in at least this share of the wall blocks that scattered returns would "
        "reach; objects return many side by side. A sector without returns is divided into strips across it, whose gains must "
        "agree this well: the highest of 35 cases without losses by direction is 0.73, the lowest of 3 sectors 0.96.",
        DEVELOPMENT,
        le=1,
    )
    early_m: PositiveFloat = threshold_field(
        0.5, "m", "A return counts as early, possibly from a drop, if it lies this far before the surface.", JUDGEMENT
    )
