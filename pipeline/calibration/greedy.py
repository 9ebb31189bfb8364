"""Search for noise parameters one at a time, by the standard deviation alone (section 4.1.5 of the thesis), as a baseline.

The search starts with four times the measured noise. It lowers each parameter in turn by a tenth of its first value while that
brings the standard deviation of the simulated maps nearer to the measured one, and repeats until nothing helps. Each test
simulates one map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.calibration.parameters import NoiseParameters
from pipeline.calibration.search import Simulate
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

_STEP = 0.1
"""Step of a parameter, as a share of its first value."""
_CLOSE = 0.02
"""Relative difference of the standard deviations at which the search ends."""
_START_FACTOR = 4.0
"""Simulated over measured noise at the start; the thesis began at about four."""


@dataclass(frozen=True)
class GreedyResult:
    """End point of a greedy search for noise parameters, which changes one parameter at a time.

    Attributes
    ----------
    x : (k,) natural logarithms of the noise parameters.
    tests : Number of simulated difference maps.
    relative_error : Standard deviation of the last simulated map over the measured one, minus 1.
    """

    x: FloatArray
    tests: int
    relative_error: float


def greedy_search(
    simulate: Simulate, parameters: NoiseParameters, start: FloatArray, std: int, target: float, random: KeyedRandom
) -> GreedyResult:
    """Lower one noise parameter at a time until the simulated standard deviation equals the measured one.

    This is the method of the thesis that the noise models follow (section 4.1.5). It is a baseline for the calibration's
    search.

    Parameters
    ----------
    simulate : Function that simulates difference maps from (k,) parameter values, a number of epochs and a random source,
        and returns the logarithms of the summary statistics of their noise.
    parameters : Names and bounds of the k noise parameters.
    start : (k,) parameter values. The search begins at a multiple of them that gives four times the measured noise.
    std : Index of the standard deviation among the summary statistics.
    target : Natural logarithm of the measured standard deviation in m.
    random : Source of the simulations' random numbers.

    Returns
    -------
    The parameters at which the standard deviations agree to 2 %, or no further step brings them nearer.
    """

    def error(values: FloatArray, test: int) -> float:
        return float(simulate(values, 1, random.child("greedy", test))[std] - target)

    first = np.clip(_START_FACTOR * np.exp(-error(start, 0)) * start, parameters.low, parameters.high)
    lengths = np.array(["step" in name for name in parameters.names])
    first[lengths] = start[lengths]  # a step length sets the noise's grid spacing, not its size, so it stays
    values, tests = first.copy(), 2
    best = error(values, 1)
    improved = True
    while improved and abs(best) > _CLOSE:
        improved = False
        for place in np.flatnonzero(~lengths):
            while abs(best) > _CLOSE:
                trial = values.copy()
                trial[place] -= _STEP * first[place]
                if trial[place] < max(parameters.low[place], _STEP * first[place] / 2):
                    break
                tried = error(trial, tests)
                tests += 1
                if abs(tried) >= abs(best):
                    break
                values, best, improved = trial, tried, True
    return GreedyResult(np.log(values), tests, float(np.expm1(best)))
