"""Define the candidate explanations of the residuals: effects of the catalogue and non-parametric terms, as design columns.

A candidate is linear in its coefficients. A sine of unknown period is linear in sine and cosine; its period is searched on a
grid.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray

Rows = NDArray[np.int64]
ExplanationKey = tuple[str, bool]
"""Identifies an effect, or all non-parametric terms of a covariate: its name, and whether it is empirical."""
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
_CHUNK = 32
"""Frequencies whose columns are computed together."""
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
_SCALE_UNKNOWN = 0.03
"""Relative uncertainty of the principal distance in which disparities were computed."""
_MOST_SCALES = 80
"""Most frequencies of a sine of the disparity."""
_DIRECTIONS = (30, 60, 120, 150)
"""Oblique directions on the wall, degrees from x, along which no sensor has an axis."""


@dataclass(frozen=True)
class Wave:
    """A sinusoidal effect along one quantity x, whose period has to be searched.

    Its two design columns are factor * sin(2 pi x / period) and factor * cos(2 pi x / period), so that amplitude and phase are
    linear coefficients.

    Attributes
    ----------
    key : Name of the effect's parameter that holds the period, such as `period_px`.
    factor : (n,) change of the observable (range, disparity or distance) for a sine of amplitude 1.
    x : (n,) quantity along which the sine runs, such as an angle in rad.
    least : Lowest frequency 1 / period to try; a slower sine cannot be distinguished from a linear trend.
    """

    key: str
    factor: FloatArray
    x: FloatArray
    least: float = 0.0

    def columns(self, period: float) -> FloatArray:
        """Return the (n, 2) sine and cosine columns for one period, which is in the unit of x."""
        angle = 2 * np.pi / period * self.x
        return self.factor[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1)

    def stepped_period(self, period: float, change: float) -> float:
        """Take one step of the period search: add `change` to the frequency and return the new period.

        The step is limited to 0.3 / (extent of x), the resolution of the frequency, so that the search cannot jump past a
        maximum.

        Parameters
        ----------
        period : Present period, unit of x.
        change : Wanted change of the frequency 1 / period.

        Returns
        -------
        The new period, unit of x. Its frequency is at least `least`.
        """
        step = 0.3 / float(np.ptp(self.x))
        return 1 / max(1 / period + float(np.clip(change, -step, step)), self.least)

    def with_frequency_derivative(self, period: float, coefficients: FloatArray) -> FloatArray:
        """Return the sine and cosine columns, and a third column with which a fit can correct the frequency.

        The third column is the derivative of the fitted wave with respect to its frequency 1 / period.

        Parameters
        ----------
        period : Period, unit of x.
        coefficients : (2,) present coefficients of the sine and the cosine column.

        Returns
        -------
        (n, 3) columns.
        """
        sine, cosine = self.columns(period).T
        derivative = 2 * np.pi * self.x * (coefficients[0] * cosine - coefficients[1] * sine)
        return np.stack([sine, cosine, derivative], axis=1)

    def part(self, rows: Rows) -> Wave:
        """Return the wave at a subset of the n points, given as row numbers, a mask or a slice."""
        return Wave(self.key, self.factor[rows], self.x[rows], self.least)


@dataclass(frozen=True, eq=False)
class Candidate:
    """One possible explanation of the residuals at n points: a regression term with k linear coefficients.

    It is an effect of the catalogue, such as a range offset, or a non-parametric term of a covariate. Residuals are explained as
    `columns` times coefficients.

    Attributes
    ----------
    name : Tag of the effect, such as "range_offset", or name of the covariate of a non-parametric term.
    matrix : (n, k) change of the observable (range, disparity or distance) per unit of each coefficient; None for a sine, whose
        columns follow from its period.
    parameters : Function from the (k,) coefficients to the effect's parameter values by name.
    names : Parameters that the coefficients stand for.
    fixed : Parameter values of this variant of the effect that are not fitted linearly, such as the camera or a period.
    empirical : True for a non-parametric term, false for an effect of the catalogue.
    form : Form of a non-parametric term, such as "line" or "wave".
    wave, period : For a sine, its wave and its period; overtones have a period too.
    prior_precision : (k,) prior inverse variances of the coefficients, from typical sizes of the effect; None without a prior.
    angle : For a non-parametric term that is an error of a recorded angle, the name of that angle; else "".
    """

    name: str
    matrix: FloatArray | None
    parameters: Callable[[FloatArray], dict[str, float]]
    names: tuple[str, ...]
    fixed: Mapping[str, float | str] = field(default_factory=dict)
    empirical: bool = False
    form: str = ""
    wave: Wave | None = None
    period: float = 0.0
    prior_precision: FloatArray | None = None
    angle: str = ""

    @cached_property
    def columns(self) -> FloatArray:
        """(n, k) design columns: change of the observable per unit of each coefficient."""
        if self.matrix is not None:
            return self.matrix
        return self.sine.columns(self.period)

    @property
    def sine(self) -> Wave:
        """The wave of a sinusoidal candidate. Raises TypeError if the candidate is not a sine."""
        if self.wave is None:
            raise TypeError(f"candidate {self.name} is not a sine")
        return self.wave

    def part(self, rows: Rows) -> Candidate:
        """Return the candidate at a subset of the n points, given as row numbers, a mask or a slice."""
        matrix = None if self.matrix is None else self.matrix[rows]
        return replace(self, matrix=matrix, wave=None if self.wave is None else self.wave.part(rows))

    @property
    def family(self) -> str:
        """Name that all variants of one explanation share.

        Variants differ only in searched or chosen values, such as the period or the camera. The search compares families by their
        best variants.
        """
        return f"free {self.name} {self.form} {self.angle}" if self.empirical else self.name


@dataclass(frozen=True, eq=False)
class SineGrid:
    """A sinusoidal effect that is tried at f evenly spaced frequencies; each frequency is a candidate.

    Attributes
    ----------
    name, fixed, empirical, angle : As in `Candidate`, the same for all frequencies.
    amplitude : Name of the effect's parameter that holds the amplitude.
    wave : The sine, with its values at n points.
    frequencies : (f,) frequencies to try, cycles per unit of the wave's x.
    """

    name: str
    amplitude: str
    wave: Wave
    frequencies: FloatArray
    fixed: Mapping[str, float | str] = field(default_factory=dict)
    empirical: bool = False
    angle: str = ""

    def candidate(self, index: int) -> Candidate:
        """Return the candidate at the frequency with this index, from 0."""
        return self.at_period(1 / float(self.frequencies[index]))

    def at_period(self, period: float) -> Candidate:
        """Return the candidate with the given period, which need not lie on the grid.

        Its coefficients are those of the sine and the cosine. A third coefficient, if present, is a change of the frequency.
        """
        amplitude, key = self.amplitude, self.wave.key

        def parameters(values: FloatArray) -> dict[str, float]:
            changed = 1 / (1 / period + (values[2] if len(values) > 2 else 0.0))
            return amplitude_and_phase(values[:2], amplitude) | {key: float(changed)}

        names = (amplitude, "phase_rad", key)
        form = "wave" if self.empirical else ""
        fixed = {**self.fixed, key: period}
        return Candidate(self.name, None, parameters, names, fixed, self.empirical, form, self.wave, period, angle=self.angle)

    @property
    def chunks(self) -> list[SineGrid]:
        """The grid divided into grids of at most 32 frequencies, so that their columns fit into memory."""
        starts = range(0, len(self.frequencies), _CHUNK)
        return [replace(self, frequencies=self.frequencies[start : start + _CHUNK]) for start in starts]

    def columns(self, rows: FloatArray) -> FloatArray:
        """Compute the design columns of all frequencies at once, each multiplied by a weight per point.

        Frequencies are evenly spaced, so each pair of columns is the preceding pair rotated by the same phase angle.

        Parameters
        ----------
        rows : (n,) factor for each row, such as the inverse standard deviation.

        Returns
        -------
        (n, 2 f) columns: sine and cosine of the first frequency, then of the second one, and so on.
        """
        count = len(self.frequencies)
        spacing = float(self.frequencies[1] - self.frequencies[0]) if count > 1 else 0.0
        turn = np.exp(2j * np.pi * spacing * self.wave.x)
        columns = np.empty((2 * count, len(rows)))
        phasor = self.wave.factor * rows * np.exp(2j * np.pi * float(self.frequencies[0]) * self.wave.x)
        for row in range(count):
            columns[2 * row], columns[2 * row + 1] = phasor.imag, phasor.real
            phasor = phasor * turn
        return columns.T

    def part(self, rows: Rows) -> SineGrid:
        """Return the grid at a subset of the n points, given as row numbers, a mask or a slice."""
        return replace(self, wave=self.wave.part(rows))


def expand_grids(families: list[Candidate | SineGrid]) -> list[Candidate]:
    """Return a flat list of candidates, in which each sine grid is replaced by one candidate per frequency."""
    return [
        candidate
        for family in families
        for candidate in (
            [family.candidate(index) for index in range(len(family.frequencies))] if isinstance(family, SineGrid) else [family]
        )
    ]


def amplitude_and_phase(values: FloatArray, amplitude: str) -> dict[str, float]:
    """Convert the coefficients of sine and cosine to amplitude and phase: a sin x + b cos x = A sin(x + phase).

    Parameters
    ----------
    values : (2,) coefficients a and b.
    amplitude : Name under which A is returned.

    Returns
    -------
    A under the given name, and `phase_rad`.
    """
    return {amplitude: float(np.hypot(*values)), "phase_rad": float(np.arctan2(values[1], values[0]))}


def frequency_grid(low: float, high: float, step: float, most: int = 200) -> FloatArray:
    """Return evenly spaced frequencies from `low` to `high`, for a search of a period.

    Parameters
    ----------
    low, high : First and last frequency, in any unit.
    step : Approximate spacing, same unit.
    most : Largest number of frequencies; the spacing is widened to keep it.
    """
    return np.linspace(low, high, int(np.clip(np.ceil((high - low) / step), 2, most)))


def disparity_frequencies(cycles: float, reach: float) -> FloatArray:
    """Return the frequencies at which pixel locking is searched, in cycles per pixel of disparity.

    The matcher's rectification may have another scale than the nominal one. The nominal frequency is therefore known only to
    about 3 %.

    Parameters
    ----------
    cycles : Nominal frequency, cycles per pixel.
    reach : Difference of the largest and smallest disparity, px; it determines the spacing of the frequencies.
    """
    return frequency_grid(cycles * (1 - _SCALE_UNKNOWN), cycles * (1 + _SCALE_UNKNOWN), 0.3 / max(reach, 1.0), _MOST_SCALES)


def nonparametric_terms(
    covariate: str, values: FloatArray, highest: float = np.inf, most_cycles: float = MOST_CYCLES
) -> list[Candidate | SineGrid]:
    """Make regression terms of one covariate that name no cause: line, parabola, spline, steps and waves.

    They describe errors for which the catalogue has no effect.

    Parameters
    ----------
    covariate : Name of the covariate.
    values : (n,) covariate of each point.
    highest : Waves from this frequency on, in cycles per unit of the values, are left out because an effect of the catalogue has
        them.
    most_cycles : Largest number of cycles of a wave over the extent of the values.
    """
    x = _standardised(values)
    smooth = _spline_columns(x)
    steps = np.unique(np.quantile(x, np.linspace(0, 1, _STEPS + 2)[1:-1]))
    waves = _wave_frequencies(x, most_cycles, highest * float(values.std()))
    return [
        _nonparametric(covariate, "line", smooth[:, :1]),
        _nonparametric(covariate, "parabola", smooth[:, :2]),
        _nonparametric(covariate, "spline", smooth),
        *(_nonparametric(covariate, "step", (x > place).astype(np.float64)[:, None]) for place in steps),
        *(SineGrid(covariate, "amplitude", _wave(np.ones_like(x), x, tried), tried, {}, True) for tried in waves),
    ]


def angle_error_terms(angle: str, covariate: str, values: FloatArray, lever: FloatArray) -> list[Candidate | SineGrid]:
    """Make regression terms for an error of a recorded angle that varies with a covariate: line, spline and waves.

    Waves are made only along the angle itself: an unevenly divided circle may have many cycles in a field of view. Waves of the
    zenith angle along the azimuth are left out, because the catalogue's wobble effect has them.

    Parameters
    ----------
    angle : Name of the recorded angle that has the error.
    covariate : Name of the covariate along which the error varies.
    values : (n,) covariate of each point.
    lever : (n,) change of the observable per radian of the angle.
    """
    x = _standardised(values)
    smooth = _spline_columns(x) * lever[:, None]
    forms = [_nonparametric(covariate, "line", smooth[:, :1]), _nonparametric(covariate, "spline", smooth)]
    waves = _wave_frequencies(x, MOST_CYCLES_OF_A_SENSOR) if angle == covariate else []
    found = [SineGrid(covariate, "amplitude", _wave(lever, x, tried), tried, {}, True, angle) for tried in waves]
    return [*(replace(form, angle=angle) for form in forms), *found]


def _standardised(values: FloatArray) -> FloatArray:
    """Values with mean 0 and standard deviation 1."""
    return np.asarray((values - values.mean()) / (float(values.std()) or 1.0))


def _spline_columns(x: FloatArray) -> FloatArray:
    """(n, k) columns of a cubic spline."""
    knots = np.quantile(x, np.linspace(0, 1, _KNOTS)[1:-1])
    columns = [x, x**2, x**3, *(np.maximum(x - knot, 0) ** 3 for knot in knots)]
    return np.stack([column / max(float(column.std()), 1e-12) for column in columns], axis=1)


def robust_extent(x: FloatArray) -> float:
    """Return the extent of values (n,), without the outermost 0.5 % at either end.

    The cycles of a wave are counted over this extent.
    """
    return float(np.ptp(np.quantile(x, [0.005, 0.995])))


def _wave_frequencies(x: FloatArray, most_cycles: float, highest: float = np.inf) -> list[FloatArray]:
    """Frequencies of waves to try, as a list of one array; empty if there are fewer than two."""
    reach = robust_extent(x)
    if reach <= 0:
        return []
    tried = frequency_grid(0.8 / reach, most_cycles / reach, 0.5 / reach)
    tried = tried[tried < highest]
    return [tried] if len(tried) > 1 else []


def _wave(factor: FloatArray, x: FloatArray, tried: FloatArray) -> Wave:
    """Make a wave for a non-parametric term in x, starting at the lowest of the frequencies `tried`."""
    return Wave("period", factor, x, float(tried[0]))


def with_period(candidate: Candidate, period: float) -> Candidate:
    """Return the same sinusoidal candidate with another period, in the unit of the wave's x."""
    sine, fixed = candidate.sine, candidate.fixed
    return SineGrid(candidate.name, candidate.names[0], sine, np.empty(0), fixed, candidate.empirical, candidate.angle).at_period(
        period
    )


def prior_precision(candidate: Candidate, width: int) -> FloatArray:
    """Return the prior inverse variances of a candidate's coefficients, padded with 0 (no prior) to `width`.

    Parameters
    ----------
    candidate : The candidate.
    width : Number of columns that are fitted; one more than the candidate's own if its frequency is fitted too.

    Returns
    -------
    (width,) prior inverse variances.
    """
    return np.zeros(width) if candidate.prior_precision is None else candidate.prior_precision


def harmonics(covariate: str, sine: Candidate, last: int) -> Candidate:
    """Make one candidate of all overtones of a sine, which describe a periodic error that is not sinusoidal.

    Parameters
    ----------
    covariate : Covariate along which the error repeats.
    sine : The fundamental.
    last : Order of the highest overtone, such as 5 for a fifth of the period.
    """
    columns = np.concatenate([sine.sine.columns(sine.period / overtone) for overtone in range(2, last + 1)], axis=1)
    return replace(_nonparametric(covariate, HARMONICS, columns), period=sine.period, angle=sine.angle)


def line_pattern_terms(covariate: str, number: FloatArray, step: float) -> list[Candidate]:
    """Make regression terms for errors that repeat every 2 to 8 scan lines, columns or rows, with a free value for each line.

    Such patterns come from the facets of a mirror, or from a sensor that is read out in blocks.

    Parameters
    ----------
    covariate : Name of the covariate that counts the lines.
    number : (n,) number of the line on which each point lies.
    step : Difference of the covariate from one line to the next.
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
    """Make a sine with two cycles per pixel of disparity, for interpolation errors that repeat every half pixel.

    One cycle per pixel is an effect of the catalogue (pixel locking).

    Parameters
    ----------
    covariate : Name of the covariate.
    disparity : (n,) disparities, px.
    """
    x, reach, unit = _standardised(disparity), robust_extent(disparity), float(disparity.std())
    tried = unit * disparity_frequencies(2.0, reach)
    return [SineGrid(covariate, "amplitude", _wave(np.ones_like(x), x, tried), tried, {}, True)] if unit else []


def polynomial_term(first: str, second: str, x: FloatArray, y: FloatArray) -> Candidate:
    """Make a polynomial of degree 4 in two covariates, as a non-parametric term.

    Parameters
    ----------
    first, second : Names of the covariates.
    x, y : (n,) values of the first and of the second covariate.
    """
    s, t = _standardised(x), _standardised(y)
    powers = [(a, degree - a) for degree in range(1, _DEGREE + 1) for a in range(degree + 1)]
    columns = np.stack([s**a * t**b for a, b in powers], axis=1)
    return _nonparametric(f"{first} and {second}", POLYNOMIAL, columns / columns.std(axis=0))


def spatial_null_candidates(at: FloatArray) -> list[Candidate | SineGrid]:
    """Make regression terms along oblique directions on the wall, as a control for errors of the reference surface.

    No sensor has an axis along these directions, so what the terms explain is most likely the reference's error. A term of a
    covariate that varies along the wall must explain more than they do.

    Parameters
    ----------
    at : (n, 2) points, wall frame, m.
    """
    turned = [(angle, at @ np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])) for angle in _DIRECTIONS]
    return [form for angle, x in turned for form in nonparametric_terms(f"{SPATIAL_NULL} {angle}", x)]


def _nonparametric(covariate: str, form: str, matrix: FloatArray) -> Candidate:
    """Make the candidate of a non-parametric term of a covariate. form: its kind, such as "spline"; matrix: (n, k) columns."""
    names = tuple(f"c{index}" for index in range(matrix.shape[1]))
    return Candidate(covariate, matrix, lambda c: dict(zip(names, map(float, c), strict=True)), names, {}, True, form)
