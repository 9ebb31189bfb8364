"""Define the candidate explanations of the residuals as design columns of a regression.

A candidate is an effect of the catalogue (`signatures.py` makes them) or a term that names no cause
(`nonparametric_terms.py`). It is linear in its coefficients. A sine of unknown period is linear in sine and cosine; its period
is searched on a grid.
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
_CHUNK = 32
"""Frequencies whose columns are computed together."""
_SCALE_UNKNOWN = 0.03
"""Relative uncertainty of the principal distance in which disparities were computed."""
_MOST_SCALES = 80
"""Most frequencies of a sine of the disparity."""


@dataclass(frozen=True)
class Wave:
    """A sinusoidal error along one quantity x, such as a wobble along the azimuth, whose period is not known in advance.

    In a regression it has two design columns, factor * sin(2 pi x / period) and factor * cos(2 pi x / period). Amplitude and
    phase follow from their two coefficients; the period has to be searched.

    Attributes
    ----------
    key : Name of the effect's parameter that holds the period, such as `period_px`.
    factor : (n,) change of the observable (range in m, disparity in px, or distance in m) at n points for a sine of value 1.
    x : (n,) quantity along which the sine runs, such as an angle in rad.
    middle : Mean of x, at which the phase hardly depends on the period.
    least : Lowest frequency 1 / period to try; a slower sine cannot be distinguished from a linear trend.
    """

    key: str
    factor: FloatArray
    x: FloatArray
    middle: float
    least: float

    def columns(self, period: float) -> FloatArray:
        """Return the two design columns of a sinusoidal error at n points for one trial period: sine and cosine, (n, 2).

        period: period in the unit of the quantity x along which the sine runs.
        """
        angle = 2 * np.pi / period * self.x
        return self.factor[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1)

    def stepped_period(self, period: float, change: float) -> float:
        """Take one step of the search for a sine's period: add `change` to the frequency 1 / period and return the new period.

        The step is at most 0.3 cycles over the extent of x, the quantity along which the sine runs. The search then cannot jump
        past a maximum of the likelihood. The frequency is at least the lowest one to try, the attribute `least`.

        period: present period, unit of x. change: wanted change of the frequency, from a Gauss-Newton fit.
        """
        step = 0.3 / float(np.ptp(self.x))
        return 1 / max(1 / period + float(np.clip(change, -step, step)), self.least)

    def with_frequency_derivative(self, period: float, coefficients: FloatArray) -> FloatArray:
        """Return the design columns of a sinusoidal error for one Gauss-Newton step, which also corrects the frequency.

        There are (n, 3) columns for n points. The first two are the sine and the cosine at the present period. The third one is
        the derivative of the fitted wave with respect to the frequency 1 / period, at a constant phase in the middle of the
        points; its coefficient is the correction (see `with_folded_step`).

        period: present period, in the unit of x. coefficients: (2,) present coefficients of the sine and the cosine column.
        """
        sine, cosine = self.columns(period).T
        derivative = 2 * np.pi * (self.x - self.middle) * (coefficients[0] * cosine - coefficients[1] * sine)
        return np.stack([sine, cosine, derivative], axis=1)

    def with_folded_step(self, coefficients: FloatArray, change: float) -> FloatArray:
        """Return the (2,) coefficients of sine and cosine that keep the wave in the middle of the points at another frequency.

        The coefficients belong to the phase at x = 0, which is far outside the points if, for example, x is the range. They
        therefore depend much on the frequency.

        coefficients: (2,) coefficients at the present frequency. change: change of the frequency 1 / period.
        """
        angle = 2 * np.pi * self.middle * change
        rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        return np.asarray(rotation @ coefficients)

    def part(self, rows: Rows) -> Wave:
        """Return the sinusoidal error at some of its n points. rows: their numbers, from 0, in the wanted order."""
        return replace(self, factor=self.factor[rows], x=self.x[rows])


@dataclass(frozen=True, eq=False)
class Candidate:
    """One possible explanation of the residuals at n points: a regression term with k coefficients to fit.

    It is either an effect, a sensor error of the catalogue such as a range offset, or a non-parametric term: a line, spline or
    wave along a covariate that names no cause. It explains the residuals as its design columns (n, k) times the coefficients.

    Attributes
    ----------
    name : Tag of the effect, such as "range_offset", or name of the covariate of a non-parametric term, such as "azimuth".
    matrix : (n, k) design columns: change of the observable (range in m, disparity in px, or distance in m) per unit of each
        coefficient. None for a sine, whose columns follow from `wave` and `period`.
    parameters : Function from the (k,) coefficients to the effect's parameter values by name, such as amplitude and phase.
    names : Names of the parameters that are fitted.
    fixed : Parameter values by name that are not fitted, such as the camera or a trial period. They tell the variants of one
        effect apart.
    empirical : True for a non-parametric term, false for an effect of the catalogue.
    form : Form of a non-parametric term, such as "line" or "wave"; "" for an effect.
    wave : For a sine, the quantity along which it runs, and the change of the observable for a sine of value 1; else None.
    period : Period of a sine, of its overtones, or of a pattern of scan lines; 0 for other terms.
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
        """(n, k) design columns at n points: change of the observable (range, disparity, distance) per unit of a coefficient."""
        return self.sine.columns(self.period) if self.matrix is None else self.matrix

    @property
    def sine(self) -> Wave:
        """The `Wave` of a candidate that is a sinusoidal error, from which columns for other periods follow; else a TypeError."""
        if self.wave is None:
            raise TypeError(f"candidate {self.name} is not a sine")
        return self.wave

    def columns_with_derivative(self, coefficients: FloatArray | None) -> FloatArray:
        """Return the design columns of a candidate, and for a sine with known coefficients the derivative by its frequency.

        coefficients: (2,) present coefficients of the sine and the cosine column; None: no correction of a frequency is fitted.
        """
        return self.columns if coefficients is None else self.sine.with_frequency_derivative(self.period, coefficients)

    def part(self, rows: Rows) -> Candidate:
        """Return the candidate at some of its n points. rows: their numbers, from 0, in the wanted order."""
        matrix = None if self.matrix is None else self.matrix[rows]
        return replace(self, matrix=matrix, wave=None if self.wave is None else self.wave.part(rows))

    @property
    def family(self) -> str:
        """Name under which the search groups all variants of one explanation; it represents the group by its best variant.

        The variants of an effect differ in values that are tried, such as the period or the camera; the name is that of the
        effect. For a non-parametric term it is made of covariate, form and angle.
        """
        return f"free {self.name} {self.form} {self.angle}" if self.empirical else self.name


@dataclass(frozen=True, eq=False)
class SineGrid:
    """A sinusoidal error of unknown period that is tried at f evenly spaced frequencies.

    Each frequency gives one candidate: a regression term with a sine and a cosine column at n points.

    Attributes
    ----------
    name : Tag of the effect, or name of the covariate of a non-parametric wave.
    amplitude : Name of the effect's parameter that holds the amplitude.
    wave : The quantity x along which the sine runs, and the change of the observable for a sine of value 1, at n points.
    frequencies : (f,) frequencies to try, cycles per unit of x.
    fixed : Parameter values by name that are not fitted, such as the camera.
    empirical : True for a non-parametric wave, which names no cause; false for an effect of the catalogue.
    angle : For a non-parametric wave that is an error of a recorded angle, the name of that angle; else "".
    """

    name: str
    amplitude: str
    wave: Wave
    frequencies: FloatArray
    fixed: Mapping[str, float | str] = field(default_factory=dict)
    empirical: bool = False
    angle: str = ""

    @property
    def candidates(self) -> list[Candidate]:
        """The sinusoidal error at each of its trial frequencies, as candidates for a regression."""
        return [self.at_period(1 / float(frequency)) for frequency in self.frequencies]

    def at_period(self, period: float) -> Candidate:
        """Return the sinusoidal error with a given period, which need not be one of the trial periods, as a candidate.

        The candidate has two coefficients, of a sine and a cosine column. Its function `parameters` converts them to amplitude,
        phase and period. It also takes a third value, the fitted correction of the frequency 1 / period.

        period: period in the unit of the quantity along which the sine runs.
        """
        amplitude, wave, key = self.amplitude, self.wave, self.wave.key

        def parameters(values: FloatArray) -> dict[str, float]:
            change = float(values[2]) if len(values) > 2 else 0.0
            return amplitude_and_phase(wave.with_folded_step(values[:2], change), amplitude) | {key: 1 / (1 / period + change)}

        names = (amplitude, "phase_rad", key)
        form = "wave" if self.empirical else ""
        fixed = {**self.fixed, key: period}
        return Candidate(self.name, None, parameters, names, fixed, self.empirical, form, self.wave, period, angle=self.angle)

    @property
    def chunks(self) -> list[SineGrid]:
        """The trial frequencies divided into grids of at most 32, so that the design columns of one grid fit into memory."""
        starts = range(0, len(self.frequencies), _CHUNK)
        return [replace(self, frequencies=self.frequencies[start : start + _CHUNK]) for start in starts]

    def columns(self, rows: FloatArray) -> FloatArray:
        """Compute the sine and cosine design columns of all f trial frequencies at once, to score them all in one search.

        This is quicker than one frequency at a time: the frequencies are evenly spaced, so each pair of columns is the
        preceding pair rotated by the same phase angle at each point.

        rows: (n,) weight of each point, such as the inverse of its standard deviation; it multiplies the point's row.

        Returns
        -------
        (n, 2 f) weighted columns: sine and cosine of the first frequency, then of the second one, and so on.
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
        """Return the grid of sines at some of its n points. rows: their numbers, from 0, in the wanted order."""
        return replace(self, wave=self.wave.part(rows))


def amplitude_and_phase(values: FloatArray, amplitude: str) -> dict[str, float]:
    """Convert the fitted coefficients of a sine and a cosine to amplitude and phase: a sin x + b cos x = A sin(x + phase).

    values: (2,) coefficients a and b, in any unit. amplitude: name under which A is returned, such as "amplitude_px". The phase
    is in rad.
    """
    return {amplitude: float(np.hypot(*values)), "phase_rad": float(np.arctan2(values[1], values[0]))}


def frequency_grid(low: float, high: float, step: float, most: int = 200) -> FloatArray:
    """Return evenly spaced trial frequencies from `low` to `high`, with which the period of a sinusoidal error is searched.

    Parameters
    ----------
    low, high : First and last frequency, in any unit.
    step : Approximate spacing, same unit; the spacing is wider where `most` requires it.
    most : Largest number of frequencies.
    """
    return np.linspace(low, high, int(np.clip(np.ceil((high - low) / step), 2, most)))


def disparity_frequencies(cycles: float, reach: float) -> FloatArray:
    """Return trial frequencies for pixel locking, the error of a stereo matcher that repeats with the pixels of the disparity.

    The matcher may have worked in a rectification of another scale than the nominal one. The (f,) frequencies, at most 80,
    therefore reach from 3 % below the nominal one to 3 % above it, in cycles per pixel of disparity.

    cycles: nominal frequency, cycles per pixel. reach: difference of the largest and smallest disparity, px, which determines
    the spacing of the frequencies.
    """
    return frequency_grid(cycles * (1 - _SCALE_UNKNOWN), cycles * (1 + _SCALE_UNKNOWN), 0.3 / max(reach, 1.0), _MOST_SCALES)


def with_period(candidate: Candidate, period: float) -> Candidate:
    """Return a copy of a sinusoidal candidate with another period, as a search for the best period needs it.

    candidate: a sine; TypeError is raised for another one. period: in the unit of the quantity along which the sine runs.
    """
    sine = candidate.sine
    grid = SineGrid(candidate.name, candidate.names[0], sine, np.empty(0), candidate.fixed, candidate.empirical, candidate.angle)
    return grid.at_period(period)


def prior_precision(candidate: Candidate, width: int) -> FloatArray:
    """Return the prior inverse variances of a candidate's coefficients; all 0 if it has no prior, as no sine has.

    width: number of coefficients that are fitted: 2 for a sine, 3 if its frequency is corrected too, else the number of the
    candidate's design columns.
    """
    return np.zeros(width) if candidate.prior_precision is None else candidate.prior_precision
