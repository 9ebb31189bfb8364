"""The thesis's calibration (4.1.5), kept as a baseline: one parameter at a time, by the standard deviation alone.

From a set with four times the measured noise, each parameter in turn is lowered by a tenth of its first value while that
brings the standard deviation of simulated maps nearer to the measured one, and then all again until nothing helps; each test
simulates one map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.calibration.parameters import Parameters
from pipeline.calibration.search import Simulate
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

_STEP = 0.1
_CLOSE = 0.02
"""Relative difference of the standard deviations at which the search ends."""
_START_FACTOR = 4.0
"""The thesis began at about four times the measured noise."""


@dataclass(frozen=True)
class Greedy:
    """x: (k,) logarithms of the parameters at the end; tests: simulated maps; relative_error: of the standard deviation."""

    x: FloatArray
    tests: int
    relative_error: float


def greedy(simulate: Simulate, parameters: Parameters, start: FloatArray, std: int, target: float, random: KeyedRandom) -> Greedy:
    """Run it. start: (k,) values, scaled here; std: place of log StD among the statistics; target: its measured value."""

    def error(values: FloatArray, test: int) -> float:
        return float(simulate(values, 1, random.child("greedy", test))[std] - target)

    first = np.clip(_START_FACTOR * np.exp(-error(start, 0)) * start, parameters.low, parameters.high)
    lengths = np.array(["step" in name for name in parameters.names])
    first[lengths] = start[lengths]  # a length on the image has no size that could be too large
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
    return Greedy(np.log(values), tests, float(np.expm1(best)))
