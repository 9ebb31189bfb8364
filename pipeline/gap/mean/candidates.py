"""What may explain a disagreement: an effect of the catalogue, or a free form of one covariate, as columns of a design."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray

Rows = NDArray[np.int64]
ExplanationKey = tuple[str, bool]
"""An effect, or all free forms of a covariate: its name, and whether it is empirical."""
_KNOTS = 5
_STEPS = 13
"""Places at which a step in a covariate is tried: quantiles of it."""
MOST_CYCLES = 12.0
MOST_CYCLES_OF_A_SENSOR = 40.0
"""In a field of view: a divided circle, or columns read out in blocks, repeat tens of times; what lies along a wall does not."""
_CHUNK = 32
SPATIAL_NULL = "place along"
HARMONICS, HARMONIC_SERIES, POLYNOMIAL = "harmonics", "folded", "surface"
LINE_PATTERN = "every"
"""Of forms that repeat after `fixed["lines"]` scan lines, columns or rows."""
_DEGREE = 4
HARMONIC_ORDERS = 5, 11
"""Up to which there may be some beside a sine: what a smooth error has, and what an error that jumps has."""
_REPEATED = range(2, 9)
_SCALE_UNKNOWN = 0.03
"""By how much the principal distance in which disparities were found may be another than the nominal one."""
_MOST_SCALES = 80
"""Frequencies, at the most, that are tried of a sine along the disparity, as of `frequencies`."""
_DIRECTIONS = (30, 60, 120, 150)
"""Degrees on the wall, 0 along x, of covariates that mean nothing to a sensor."""


@dataclass(frozen=True)
class Wave:
    """A searched sine: columns factor * sin, factor * cos of 2 pi x / period.

    key: the parameter that holds the period; least: the lowest frequency that is tried.
    """

    key: str
    factor: FloatArray
    x: FloatArray
    least: float = 0.0

    def columns(self, period: float) -> FloatArray:
        """(n, 2) the two columns at one period."""
        angle = 2 * np.pi / period * self.x
        return self.factor[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1)

    def stepped_period(self, period: float, change: float) -> float:
        """A period whose frequency is changed: by a third of what the reach of x tells apart at a time.

        It stays at the lowest that is tried, below which a sine is not told from a slope.
        """
        step = 0.3 / float(np.ptp(self.x))
        return 1 / max(1 / period + float(np.clip(change, -step, step)), self.least)

    def with_frequency_derivative(self, period: float, coefficients: FloatArray) -> FloatArray:
        """(n, 3) the two columns, and the change of their sum, weighted by `coefficients` (2,), by the frequency 1 / period."""
        sine, cosine = self.columns(period).T
        slope = 2 * np.pi * self.x * (coefficients[0] * cosine - coefficients[1] * sine)
        return np.stack([sine, cosine, slope], axis=1)

    def part(self, rows: Rows) -> Wave:
        """The wave on some of the points."""
        return Wave(self.key, self.factor[rows], self.x[rows], self.least)


@dataclass(frozen=True, eq=False)
class Candidate:
    """One explanation. matrix: (n, k) observable per unit of each coefficient; parameters: coefficients to the effect's values.

    names: the parameters that the coefficients stand for; fixed: searched or chosen values that belong to this variant, such as
    the camera; form: of an empirical one; wave: of a searched sine, whose period is `period` (that of harmonics too);
    precision: (k,) inverse variance of the coefficients by what is typical of the effect, None where nothing is known;
    angle: the recorded angle of which an empirical one is the error, "" for the observable itself.
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
        """(n, k) the design."""
        if self.matrix is not None:
            return self.matrix
        return self.sine.columns(self.period)

    @property
    def sine(self) -> Wave:
        """The wave of a sine. Raises TypeError where the candidate is none."""
        if self.wave is None:
            raise TypeError(f"{self.name} is no sine")
        return self.wave

    def part(self, rows: Rows) -> Candidate:
        """The candidate on some of the points."""
        matrix = None if self.matrix is None else self.matrix[rows]
        return replace(self, matrix=matrix, wave=None if self.wave is None else self.wave.part(rows))

    @property
    def family(self) -> str:
        """Variants of one family differ in searched or chosen values only."""
        return f"free {self.name} {self.form} {self.angle}" if self.empirical else self.name


@dataclass(frozen=True, eq=False)
class SineGrid:
    """A sine of which evenly spaced frequencies are tried. amplitude: name of the parameter; fixed: values of all variants;
    angle: as of a `Candidate`."""

    name: str
    amplitude: str
    wave: Wave
    frequencies: FloatArray
    fixed: Mapping[str, float | str] = field(default_factory=dict)
    empirical: bool = False
    angle: str = ""

    def candidate(self, index: int) -> Candidate:
        """The variant at one of the frequencies."""
        return self.at_period(1 / float(self.frequencies[index]))

    def at_period(self, period: float) -> Candidate:
        """The variant of any period: its coefficients are those of sine and cosine, and where given a change of the frequency."""
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
        """Some frequencies at a time."""
        starts = range(0, len(self.frequencies), _CHUNK)
        return [replace(self, frequencies=self.frequencies[start : start + _CHUNK]) for start in starts]

    def columns(self, rows: FloatArray) -> FloatArray:
        """(n, 2 f) columns times `rows` (n,): sine and cosine of each frequency, one after another.

        Frequencies are evenly spaced, so that each is the one before turned by the same angle.
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
        """The grid on some of the points."""
        return replace(self, wave=self.wave.part(rows))


def expand_grids(families: list[Candidate | SineGrid]) -> list[Candidate]:
    """Every candidate, the searched ones at each of their frequencies."""
    return [
        candidate
        for family in families
        for candidate in (
            [family.candidate(index) for index in range(len(family.frequencies))] if isinstance(family, SineGrid) else [family]
        )
    ]


def amplitude_and_phase(values: FloatArray, amplitude: str) -> dict[str, float]:
    """a sin x + b cos x as amplitude and phase."""
    return {amplitude: float(np.hypot(*values)), "phase_rad": float(np.arctan2(values[1], values[0]))}


def frequency_grid(low: float, high: float, step: float, most: int = 200) -> FloatArray:
    """Evenly from low to high by about `step`, at most some hundreds."""
    return np.linspace(low, high, int(np.clip(np.ceil((high - low) / step), 2, most)))


def disparity_frequencies(cycles: float, reach: float) -> FloatArray:
    """Frequencies to try of a sine of so many cycles per pixel of the disparity, of unsure scale; reach: of the disparity, px."""
    return frequency_grid(cycles * (1 - _SCALE_UNKNOWN), cycles * (1 + _SCALE_UNKNOWN), 0.3 / max(reach, 1.0), _MOST_SCALES)


def nonparametric_terms(
    covariate: str, values: FloatArray, highest: float = np.inf, most_cycles: float = MOST_CYCLES
) -> list[Candidate | SineGrid]:
    """Forms of one covariate that stand for no effect: a line, a parabola, a smooth curve, a step, a wave.

    highest: frequency from which on a wave is an effect of the catalogue; most_cycles: of a wave over the reach of the values.
    """
    x = _standardised(values)
    smooth = _smooth(x)
    steps = np.unique(np.quantile(x, np.linspace(0, 1, _STEPS + 2)[1:-1]))
    waves = _waves(x, most_cycles, highest * float(values.std()))
    return [
        _free(covariate, "line", smooth[:, :1]),
        _free(covariate, "parabola", smooth[:, :2]),
        _free(covariate, "smooth", smooth),
        *(_free(covariate, "step", (x > place).astype(np.float64)[:, None]) for place in steps),
        *(SineGrid(covariate, "amplitude", _wave(np.ones_like(x), x, tried), tried, {}, True) for tried in waves),
    ]


def angle_error_terms(angle: str, covariate: str, values: FloatArray, lever: FloatArray) -> list[Candidate | SineGrid]:
    """Forms of an error of a recorded angle along a covariate; lever: (n,) what the observable changes by per radian of it.

    A circle that is divided unevenly may have many cycles in a field of view. Waves of the zenith along the azimuth are left out:
    they are a wobble.
    """
    x = _standardised(values)
    smooth = _smooth(x) * lever[:, None]
    forms = [_free(covariate, "line", smooth[:, :1]), _free(covariate, "smooth", smooth)]
    waves = _waves(x, MOST_CYCLES_OF_A_SENSOR) if angle == covariate else []
    found = [SineGrid(covariate, "amplitude", _wave(lever, x, tried), tried, {}, True, angle) for tried in waves]
    return [*(replace(form, angle=angle) for form in forms), *found]


def _standardised(values: FloatArray) -> FloatArray:
    return np.asarray((values - values.mean()) / (float(values.std()) or 1.0))


def _smooth(x: FloatArray) -> FloatArray:
    """(n, k) columns of a cubic spline."""
    knots = np.quantile(x, np.linspace(0, 1, _KNOTS)[1:-1])
    columns = [x, x**2, x**3, *(np.maximum(x - knot, 0) ** 3 for knot in knots)]
    return np.stack([column / max(float(column.std()), 1e-12) for column in columns], axis=1)


def robust_extent(x: FloatArray) -> float:
    """What all values but a few cover, which a wave's cycles are counted over."""
    return float(np.ptp(np.quantile(x, [0.005, 0.995])))


def _waves(x: FloatArray, most_cycles: float, highest: float = np.inf) -> list[FloatArray]:
    """Frequencies to try, as one list; none where there are fewer than two."""
    reach = robust_extent(x)
    if reach <= 0:
        return []
    tried = frequency_grid(0.8 / reach, most_cycles / reach, 0.5 / reach)
    tried = tried[tried < highest]
    return [tried] if len(tried) > 1 else []


def _wave(factor: FloatArray, x: FloatArray, tried: FloatArray) -> Wave:
    return Wave("period", factor, x, float(tried[0]))


def with_period(candidate: Candidate, period: float) -> Candidate:
    """The same sine with another period."""
    sine, fixed = candidate.sine, candidate.fixed
    return SineGrid(candidate.name, candidate.names[0], sine, np.empty(0), fixed, candidate.empirical, candidate.angle).at_period(
        period
    )


def prior_precision(candidate: Candidate, width: int) -> FloatArray:
    """(width,) of its coefficients; 0 where nothing is known of them."""
    return np.zeros(width) if candidate.prior_precision is None else candidate.prior_precision


def harmonics(covariate: str, sine: Candidate, last: int) -> Candidate:
    """What a periodic error along a covariate has beside a sine that is named: its overtones, up to the last of them."""
    columns = np.concatenate([sine.sine.columns(sine.period / overtone) for overtone in range(2, last + 1)], axis=1)
    return replace(_free(covariate, HARMONICS, columns), period=sine.period, angle=sine.angle)


def line_pattern_terms(covariate: str, number: FloatArray, step: float) -> list[Candidate]:
    """Values free within a few scan lines, columns or rows, and again in the next few: facets of a mirror, blocks of a read-out.

    number: (n,) of the line; step: of the covariate from one line to the next.
    """
    found = []
    for lines in _REPEATED:
        place = np.mod(np.rint(number), lines)
        columns = (place[:, None] == np.arange(1, lines)) - 1 / lines
        if all(np.ptp(column) > 0 for column in columns.T):
            form = _free(covariate, f"{LINE_PATTERN} {lines}", columns)
            found.append(replace(form, fixed={"lines": lines}, period=lines * abs(step)))
    return found


def half_pixel_sine(covariate: str, disparity: FloatArray) -> list[SineGrid]:
    """A sine of two cycles per pixel of the disparity (n,), px: an interpolation between pixels is off the same way at each half.

    One cycle per pixel is an effect of the catalogue.
    """
    x, reach, unit = _standardised(disparity), robust_extent(disparity), float(disparity.std())
    tried = unit * disparity_frequencies(2.0, reach)
    return [SineGrid(covariate, "amplitude", _wave(np.ones_like(x), x, tried), tried, {}, True)] if unit else []


def polynomial_term(first: str, second: str, x: FloatArray, y: FloatArray) -> Candidate:
    """A polynomial of two covariates (n,) together, which stands for no effect."""
    s, t = _standardised(x), _standardised(y)
    powers = [(a, degree - a) for degree in range(1, _DEGREE + 1) for a in range(degree + 1)]
    columns = np.stack([s**a * t**b for a, b in powers], axis=1)
    return _free(f"{first} and {second}", POLYNOMIAL, columns / columns.std(axis=0))


def spatial_null_candidates(at: FloatArray) -> list[Candidate | SineGrid]:
    """Free forms of places (n, 2) on the wall in slanting directions, which no sensor knows of.

    What they gain is the reference's doing, in all likelihood, and so may as much be that a covariate gains which changes along
    the wall too.
    """
    turned = [(angle, at @ np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])) for angle in _DIRECTIONS]
    return [form for angle, x in turned for form in nonparametric_terms(f"{SPATIAL_NULL} {angle}", x)]


def _free(covariate: str, form: str, matrix: FloatArray) -> Candidate:
    names = tuple(f"c{index}" for index in range(matrix.shape[1]))
    return Candidate(covariate, matrix, lambda c: dict(zip(names, map(float, c), strict=True)), names, {}, True, form)
