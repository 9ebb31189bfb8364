"""Make the non-parametric candidate terms: lines, splines, steps, waves and polynomials that describe an error without its cause.

They compete with the effects of the catalogue in the search for an explanation of the residuals.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.gap.mean.candidates import Candidate, SineGrid, Wave, disparity_frequencies, frequency_grid
from scene.geometry.mesh import FloatArray

_KNOTS = 5
"""Knots of the spline, both ends included."""
_STEPS = 13
"""Places at which a step in a covariate is tried: quantiles of its values."""
MOST_CYCLES = 12.0
"""Most cycles of a wave over the extent of a covariate."""
MOST_CYCLES_OF_A_SENSOR = 40.0
"""The same for errors that only a sensor can have: graduation errors of a circle, or column read-out, repeat tens of times in
a field of view; properties of a wall do not.
"""
SPATIAL_NULL = "spatial null"
"""Start of the names of spatial null candidates."""
HARMONICS, HARMONIC_SERIES, POLYNOMIAL = "harmonics", "wave with overtones", "polynomial"
"""Forms of candidates: overtones beside a sine of the catalogue, a wave with its overtones, and a polynomial of two covariates.
"""
LINE_PATTERN = "repeating every"
"""Start of the form of patterns that repeat after `fixed["lines"]` scan lines, columns or rows."""
_DEGREE = 4
"""Degree of the polynomial of two covariates."""
HARMONIC_ORDERS = 5, 11
"""Highest overtones that are tried beside a sine: few for a smooth periodic error, more for one that jumps."""
_PATTERN_LINES = range(2, 9)
"""Numbers of lines after which a pattern may repeat."""
_DIRECTIONS = (30, 60, 120, 150)
"""Oblique directions on the wall, degrees from x, along which no sensor has an axis."""


def nonparametric_terms(
    covariate: str, values: FloatArray, highest: float = np.inf, most_cycles: float = MOST_CYCLES
) -> list[Candidate | SineGrid]:
    """Make candidate regression terms along one covariate that name no cause: a line, a parabola, a spline, steps and waves.

    They describe errors for which the catalogue of sensor errors has no effect. All change the observable (range, disparity or
    distance) itself, and all are functions of the standardised covariate (mean 0, standard deviation 1).

    All waves are one `SineGrid`: a wave with a grid of trial frequencies.

    Parameters
    ----------
    covariate : Name of the covariate, such as "range".
    values : (n,) covariate of each point, in its own unit.
    highest : Only waves below this frequency are made, in cycles per unit of the covariate, because an effect of the catalogue
        has the faster ones.
    most_cycles : Largest number of cycles of a wave over the extent of the values.
    """
    x = _standardised(values)
    smooth = _spline_columns(x)
    steps = np.unique(np.quantile(x, np.linspace(0, 1, _STEPS + 2)[1:-1]))
    return [
        _nonparametric(covariate, "line", smooth[:, :1]),
        _nonparametric(covariate, "parabola", smooth[:, :2]),
        _nonparametric(covariate, "spline", smooth),
        *(_nonparametric(covariate, "step", (x > place).astype(np.float64)[:, None]) for place in steps),
        *_waves(covariate, np.ones_like(x), x, _frequencies(x, most_cycles, highest * float(values.std()))),
    ]


def angle_error_terms(angle: str, covariate: str, values: FloatArray, lever: FloatArray) -> list[Candidate | SineGrid]:
    """Make candidate regression terms for an error of a recorded angle that varies with a covariate: line, spline and waves.

    An example is an error of the azimuth that varies with the zenith angle. Waves are made only if the covariate is the angle
    itself: an unevenly divided circle may have many cycles in a field of view. They are one grid of trial frequencies. Waves of
    the zenith angle along the azimuth are left out, because the wobble effect of the catalogue has them.

    Parameters
    ----------
    angle : Name of the recorded angle that has the error, such as "azimuth".
    covariate : Name of the covariate along which the error varies.
    values : (n,) covariate of each point.
    lever : (n,) change of the observable (range or disparity) per radian of the angle.
    """
    x = _standardised(values)
    smooth = _spline_columns(x) * lever[:, None]
    forms = [_nonparametric(covariate, "line", smooth[:, :1]), _nonparametric(covariate, "spline", smooth)]
    waves = _waves(covariate, lever, x, _frequencies(x, MOST_CYCLES_OF_A_SENSOR)) if angle == covariate else []
    return [*(replace(form, angle=angle) for form in forms), *(replace(wave, angle=angle) for wave in waves)]


def _standardised(values: FloatArray) -> FloatArray:
    """Values with mean 0 and standard deviation 1."""
    return np.asarray((values - values.mean()) / (float(values.std()) or 1.0))


def _spline_columns(x: FloatArray) -> FloatArray:
    """(n, k) columns of a cubic spline."""
    knots = np.quantile(x, np.linspace(0, 1, _KNOTS)[1:-1])
    columns = [x, x**2, x**3, *(np.maximum(x - knot, 0) ** 3 for knot in knots)]
    return np.stack([column / max(float(column.std()), 1e-12) for column in columns], axis=1)


def robust_extent(x: FloatArray) -> float:
    """Return the extent of n values, largest minus smallest, without the outermost 0.5 % at either end.

    The trial periods of a wave along a covariate are chosen from this extent, so that single far values do not matter.

    x: (n,) values, in any unit.
    """
    return float(np.ptp(np.quantile(x, [0.005, 0.995])))


def _frequencies(x: FloatArray, most_cycles: float, highest: float = np.inf) -> FloatArray:
    """Frequencies of waves to try."""
    reach = robust_extent(x)
    tried = frequency_grid(0.8 / reach, most_cycles / reach, 0.5 / reach) if reach > 0 else np.empty(0)
    return tried[tried < highest]


def _waves(covariate: str, factor: FloatArray, x: FloatArray, tried: FloatArray) -> list[SineGrid]:
    """Make a wave in x with the frequencies `tried`, as a list of one grid; empty if they are fewer than two, or 0."""
    if len(tried) < 2 or tried[0] <= 0:
        return []
    wave = Wave("period", factor, x, float(np.mean(x)), float(tried[0]))
    return [SineGrid(covariate, "amplitude", wave, tried, empirical=True)]


def harmonics(covariate: str, sine: Candidate, last: int) -> Candidate:
    """Make one candidate of the overtones of a sine (1/2, 1/3, 1/4 ... of its period), each with a sine and a cosine column.

    Fitted together with the sine itself, they describe a periodic error that is not sinusoidal, such as one that jumps.

    Parameters
    ----------
    covariate : Name of the covariate along which the error repeats.
    sine : The fundamental: a sinusoidal candidate with the period to divide. It is not part of the result.
    last : Order of the highest overtone; 5 includes a fifth of the period.
    """
    columns = np.concatenate([sine.sine.columns(sine.period / overtone) for overtone in range(2, last + 1)], axis=1)
    return replace(_nonparametric(covariate, HARMONICS, columns), period=sine.period, angle=sine.angle)


def line_pattern_terms(covariate: str, number: FloatArray, step: float) -> list[Candidate]:
    """Make candidate regression terms for errors that repeat every 2, 3, ... 8 scan lines, image columns or rows.

    Such patterns come from the facets of a scanner's mirror, or from a sensor that is read out in blocks. Each line of the
    pattern has its own free value, relative to the first one.

    Parameters
    ----------
    covariate : Name of the covariate that advances from line to line, such as "azimuth".
    number : (n,) number of the line on which each point lies.
    step : Difference of the covariate from one line to the next, in its unit.

    Returns
    -------
    One candidate for each length of the pattern, except lengths of which some line has no points.
    """
    found = []
    for lines in _PATTERN_LINES:
        place = np.mod(np.rint(number), lines)
        columns = (place[:, None] == np.arange(1, lines)) - 1 / lines
        if all(np.ptp(column) > 0 for column in columns.T):
            form = _nonparametric(covariate, f"{LINE_PATTERN} {lines}", columns)
            found.append(replace(form, fixed={"lines": lines}, period=lines * abs(step)))
    return found


def half_pixel_sine(covariate: str, disparity: FloatArray) -> list[SineGrid]:
    """Make a candidate sine with about two cycles per pixel of disparity, for interpolation errors of period half a pixel.

    The sine with one cycle per pixel, pixel locking, is an effect of the catalogue and is not made here. The trial frequencies
    are up to 3 % from the nominal one.

    covariate: name of the covariate, the disparity. disparity: (n,) values, px; if all are equal, the list is empty.
    """
    x = _standardised(disparity)
    tried = float(disparity.std()) * disparity_frequencies(2.0, robust_extent(disparity))
    return _waves(covariate, np.ones_like(x), x, tried)


def polynomial_term(first: str, second: str, x: FloatArray, y: FloatArray) -> Candidate:
    """Make a candidate regression term that is a polynomial of degree 4 in two covariates, without a constant.

    It describes a smooth error over the field of view that no effect of the catalogue has.

    Parameters
    ----------
    first, second : Names of the covariates, such as azimuth and zenith angle.
    x, y : (n,) values of the first and of the second covariate at n points.
    """
    s, t = _standardised(x), _standardised(y)
    powers = [(a, degree - a) for degree in range(1, _DEGREE + 1) for a in range(degree + 1)]
    columns = np.stack([s**a * t**b for a, b in powers], axis=1)
    return _nonparametric(f"{first} and {second}", POLYNOMIAL, columns / columns.std(axis=0))


def spatial_null_candidates(at: FloatArray) -> list[Candidate | SineGrid]:
    """Make regression terms along oblique directions on the wall, which show what errors of the reference surface can imitate.

    The terms are lines, splines, steps and waves, as along a covariate of the sensor. No sensor has an axis along these
    directions, so what they explain is most likely the reference's error. A term of a covariate that varies along the wall is
    accepted only if it explains more than they do.

    Parameters
    ----------
    at : (n, 2) x and y of the points in the wall frame, m.
    """
    turned = [(angle, at @ np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])) for angle in _DIRECTIONS]
    return [form for angle, x in turned for form in nonparametric_terms(f"{SPATIAL_NULL} {angle}", x)]


def _nonparametric(covariate: str, form: str, matrix: FloatArray) -> Candidate:
    """Make the candidate of a non-parametric term of a covariate. form: its kind, such as "spline"; matrix: (n, k) columns."""
    names = tuple(f"c{index}" for index in range(matrix.shape[1]))
    return Candidate(covariate, matrix, lambda c: dict(zip(names, map(float, c), strict=True)), names, {}, True, form)
