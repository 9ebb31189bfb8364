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
    """A sine of one quantity with unknown period: columns factor * sin and factor * cos of 2 pi x / period.

    Attributes
    ----------
    key : Name of the effect's parameter that holds the period.
    factor : (n,) observable per unit of the sine.
    x : (n,) the quantity along which the sine runs.
    least : Lowest frequency that is tried, below which a sine cannot be distinguished from a linear trend.
    """

    key: str
    factor: FloatArray
    x: FloatArray
    least: float = 0.0

    def columns(self, period: float) -> FloatArray:
        """Return the (n, 2) sine and cosine columns at one period."""
        angle = 2 * np.pi / period * self.x
        return self.factor[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1)

    def stepped_period(self, period: float, change: float) -> float:
        """Change the frequency of a period, by at most 0.3 of the resolution that the extent of x gives.

        Parameters
        ----------
        period : Present period, unit of x.
        change : Wanted change of the frequency 1 / period.

        Returns
        -------
        The new period; its frequency is at least `least`.
        """
        step = 0.3 / float(np.ptp(self.x))
        return 1 / max(1 / period + float(np.clip(change, -step, step)), self.least)

    def with_frequency_derivative(self, period: float, coefficients: FloatArray) -> FloatArray:
        """Return the sine and cosine columns, and the derivative of the fitted wave by its frequency 1 / period.

        Parameters
        ----------
        period : Period, unit of x.
        coefficients : (2,) present coefficients of sine and cosine.

        Returns
        -------
        (n, 3) columns.
        """
        sine, cosine = self.columns(period).T
        derivative = 2 * np.pi * self.x * (coefficients[0] * cosine - coefficients[1] * sine)
        return np.stack([sine, cosine, derivative], axis=1)

    def part(self, rows: Rows) -> Wave:
        """Return the wave on some of the points."""
        return Wave(self.key, self.factor[rows], self.x[rows], self.least)


@dataclass(frozen=True, eq=False)
class Candidate:
    """One explanation of the residuals, linear in k coefficients.

    Attributes
    ----------
    name : Tag of the effect, or name of the covariate of a non-parametric term.
    matrix : (n, k) change of the observable per unit of each coefficient; None for a sine, whose columns follow from its period.
    parameters : Function from coefficients to the effect's parameter values.
    names : Parameters that the coefficients stand for.
    fixed : Searched or chosen values of this variant, such as the camera.
    empirical : Whether it is a non-parametric term instead of an effect of the catalogue.
    form : Form of a non-parametric term, such as "line" or "wave".
    wave, period : The wave of a sine, and its period; overtones have a period too.
    prior_precision : (k,) prior inverse variance of the coefficients, from typical sizes of the effect; None if nothing is known.
    angle : Recorded angle of which a non-parametric term is the error; "" for the observable itself.
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
        """(n, k) design columns."""
        if self.matrix is not None:
            return self.matrix
        return self.sine.columns(self.period)

    @property
    def sine(self) -> Wave:
        """The wave of a sine. Raises TypeError if the candidate is no sine."""
        if self.wave is None:
            raise TypeError(f"candidate {self.name} is not a sine")
        return self.wave

    def part(self, rows: Rows) -> Candidate:
        """Return the candidate on some of the points."""
        matrix = None if self.matrix is None else self.matrix[rows]
        return replace(self, matrix=matrix, wave=None if self.wave is None else self.wave.part(rows))

    @property
    def family(self) -> str:
        """Name of the family. The variants of a family differ only in searched or chosen values; the best one represents it."""
        return f"free {self.name} {self.form} {self.angle}" if self.empirical else self.name


@dataclass(frozen=True, eq=False)
class SineGrid:
    """A sine that is tried at evenly spaced frequencies.

    Attributes
    ----------
    name, fixed, empirical, angle : As in `Candidate`, the same for all frequencies.
    amplitude : Name of the amplitude parameter.
    wave : The sine.
    frequencies : (f,) frequencies that are tried, per unit of the wave's x.
    """

    name: str
    amplitude: str
    wave: Wave
    frequencies: FloatArray
    fixed: Mapping[str, float | str] = field(default_factory=dict)
    empirical: bool = False
    angle: str = ""

    def candidate(self, index: int) -> Candidate:
        """Return the candidate at one of the frequencies, by its number."""
        return self.at_period(1 / float(self.frequencies[index]))

    def at_period(self, period: float) -> Candidate:
        """Return the candidate with any period.

        Its coefficients are those of sine and cosine and, as an optional third one, a change of the frequency.
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
        """The same grid in parts of a few frequencies."""
        starts = range(0, len(self.frequencies), _CHUNK)
        return [replace(self, frequencies=self.frequencies[start : start + _CHUNK]) for start in starts]

    def columns(self, rows: FloatArray) -> FloatArray:
        """Return the (n, 2 f) columns, sine and cosine of each frequency in turn, each multiplied by `rows` (n,).

        Frequencies are evenly spaced, so each column pair is the preceding one turned by the same angle.
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
        """Return the grid on some of the points."""
        return replace(self, wave=self.wave.part(rows))


def expand_grids(families: list[Candidate | SineGrid]) -> list[Candidate]:
    """List all candidates; sines at each of their frequencies."""
    return [
        candidate
        for family in families
        for candidate in (
            [family.candidate(index) for index in range(len(family.frequencies))] if isinstance(family, SineGrid) else [family]
        )
    ]


def amplitude_and_phase(values: FloatArray, amplitude: str) -> dict[str, float]:
    """Convert a sin x + b cos x, `values` = (a, b), to the parameters amplitude (under the given name) and phase_rad."""
    return {amplitude: float(np.hypot(*values)), "phase_rad": float(np.arctan2(values[1], values[0]))}


def frequency_grid(low: float, high: float, step: float, most: int = 200) -> FloatArray:
    """Return evenly spaced frequencies.

    Parameters
    ----------
    low, high : First and last frequency.
    step : Approximate spacing.
    most : Most frequencies.
    """
    return np.linspace(low, high, int(np.clip(np.ceil((high - low) / step), 2, most)))


def disparity_frequencies(cycles: float, reach: float) -> FloatArray:
    """Return frequencies to try for a sine of the disparity whose period in pixels is known up to the scale of the rectification.

    Parameters
    ----------
    cycles : Nominal cycles per pixel.
    reach : Extent of the disparities, px.
    """
    return frequency_grid(cycles * (1 - _SCALE_UNKNOWN), cycles * (1 + _SCALE_UNKNOWN), 0.3 / max(reach, 1.0), _MOST_SCALES)


def nonparametric_terms(
    covariate: str, values: FloatArray, highest: float = np.inf, most_cycles: float = MOST_CYCLES
) -> list[Candidate | SineGrid]:
    """Make the non-parametric terms of one covariate: line, parabola, spline, steps and waves.

    They describe errors that the catalogue lacks, without naming a cause.

    Parameters
    ----------
    covariate : Its name.
    values : (n,) its values.
    highest : Frequency, per unit of the values, from which a wave belongs to an effect of the catalogue instead.
    most_cycles : Most cycles of a wave over the extent of the values.
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
    """Make the non-parametric terms of an error of a recorded angle: line, spline and, along the angle itself, waves.

    An unevenly divided circle may have many cycles in a field of view. Waves of the zenith angle along the azimuth are left out,
    because they are the wobble of the catalogue.

    Parameters
    ----------
    angle : Name of the angle that has the error.
    covariate : Name of the covariate along which the error varies.
    values : (n,) its values.
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
    """Return the extent of values without the outermost 0.5 % on either side; cycles of a wave are counted over it."""
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
    """A wave of a non-parametric term, with its lowest frequency."""
    return Wave("period", factor, x, float(tried[0]))


def with_period(candidate: Candidate, period: float) -> Candidate:
    """Return the same sine with another period."""
    sine, fixed = candidate.sine, candidate.fixed
    return SineGrid(candidate.name, candidate.names[0], sine, np.empty(0), fixed, candidate.empirical, candidate.angle).at_period(
        period
    )


def prior_precision(candidate: Candidate, width: int) -> FloatArray:
    """Return the (width,) prior inverse variances of a candidate's coefficients; 0 where nothing is known."""
    return np.zeros(width) if candidate.prior_precision is None else candidate.prior_precision


def harmonics(covariate: str, sine: Candidate, last: int) -> Candidate:
    """Make a candidate of the overtones that a periodic error has beside a sine, to describe a non-sinusoidal shape.

    Parameters
    ----------
    covariate : Covariate along which the error repeats.
    sine : The fundamental.
    last : Highest overtone.
    """
    columns = np.concatenate([sine.sine.columns(sine.period / overtone) for overtone in range(2, last + 1)], axis=1)
    return replace(_nonparametric(covariate, HARMONICS, columns), period=sine.period, angle=sine.angle)


def line_pattern_terms(covariate: str, number: FloatArray, step: float) -> list[Candidate]:
    """Make terms with free values within a few scan lines, columns or rows, which repeat: facets of a mirror, blocks of a
    read-out.

    Parameters
    ----------
    covariate : Covariate that counts the lines.
    number : (n,) line of each point.
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
    """Make a sine with two cycles per pixel of the disparity: an interpolation error that repeats at each half pixel.

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
    """Make a polynomial of two covariates, as a non-parametric term.

    Parameters
    ----------
    first, second : Names of the covariates.
    x, y : (n,) their values.
    """
    s, t = _standardised(x), _standardised(y)
    powers = [(a, degree - a) for degree in range(1, _DEGREE + 1) for a in range(degree + 1)]
    columns = np.stack([s**a * t**b for a, b in powers], axis=1)
    return _nonparametric(f"{first} and {second}", POLYNOMIAL, columns / columns.std(axis=0))


def spatial_null_candidates(at: FloatArray) -> list[Candidate | SineGrid]:
    """Make non-parametric terms along oblique directions on the wall, where no sensor has an axis.

    They show how much the error of the reference can imitate: what they explain is most likely due to the reference, so a
    covariate that varies along the wall must explain more. `at`: (n, 2) points, wall frame, m.
    """
    turned = [(angle, at @ np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])) for angle in _DIRECTIONS]
    return [form for angle, x in turned for form in nonparametric_terms(f"{SPATIAL_NULL} {angle}", x)]


def _nonparametric(covariate: str, form: str, matrix: FloatArray) -> Candidate:
    """A non-parametric term with the given columns."""
    names = tuple(f"c{index}" for index in range(matrix.shape[1]))
    return Candidate(covariate, matrix, lambda c: dict(zip(names, map(float, c), strict=True)), names, {}, True, form)
