"""Run a calibration (`scarpsim calibrate`) from measured difference maps to the fitted noise and its diagnostics.

The steps, in order: read the maps, describe the noise of each epoch, search for the noise parameters, then find which parameters
the data cannot separate and how a simpler search would have done.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.calibration.epochs import EpochNoise, Trend, epoch_noise, systematic, trend
from pipeline.calibration.greedy import GreedyResult, greedy_search
from pipeline.calibration.inputs import CalibrationInputs, read_inputs
from pipeline.calibration.parameters import Model, NoiseParameters, noise_parameters
from pipeline.calibration.search import OBSERVATION_S, NoiseSearch, SearchResult, cost_of_new_simulations
from pipeline.calibration.single_ranges import SingleRanges
from pipeline.calibration.summary_statistics import SummaryStatistics
from pipeline.calibration.window_simulator import WindowSimulator
from pipeline.calibration.windows import Windows
from pipeline.config.simulation import SensorName, SimulationConfig
from pipeline.report.progress import Progress
from pipeline.run.site import SensorSite
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Side
from sensors.effects.base import Effect
from sensors.models.sensor_model import DrawnParameter, OrientationNoise
from sensors.stereo.stereo_pair import StereoPair

_ALIKE = 0.9
"""Absolute correlation above which two parameters count as inseparable."""
STAGES = {
    "read maps": 1.0,
    "describe noise": 1.0,
    "prepare simulation": 2.0,
    "search, round 1": 20.0,
    "search, last round": 100.0,
    "compare searches": 2.0,
}
"""Expected duration of each stage, s, for the progress display; the search corrects them when it knows how many maps it needs."""
_GREEDY_OBSERVATIONS = 300
"""Observations that the greedy search is expected to simulate, for the progress display."""


@dataclass(frozen=True)
class OrientationPatterns:
    """Say which orientation parameters (angles or coordinates) of a stereo pair's cameras a calibration can tell apart.

    An error of each parameter causes a difference map of its own. Parameters with similar maps cannot be told apart. A
    map is that of an error of the left camera, or of both cameras if the sensor model moves them alike, after
    registration of the epoch.

    Attributes
    ----------
    names : (k,) names of the orientation parameters with a non-zero standard deviation (sigma) in the sensor model.
    size_m : (k,) RMS of the difference map that an error of one sigma causes, m.
    cosines : (k, k) cosines of the angles between the maps as vectors; near 1 in magnitude, two parameters make the same
        pattern.
    """

    names: tuple[str, ...]
    size_m: FloatArray
    cosines: FloatArray

    def to_dict(self) -> dict[str, Any]:
        """Return parameter names, RMS of their difference maps in m, and cosines between the maps, for `calibration.json`."""
        return {"names": self.names, "rms_m": self.size_m, "cosines": self.cosines}


@dataclass(frozen=True)
class GreedyComparison:
    """How well a greedy search, which changes one noise parameter at a time, fits beside the calibration's own search.

    Costs are squared Mahalanobis distances of the measured summary statistics (of size and pattern of the noise) from those of
    newly simulated maps; lower is better.

    Attributes
    ----------
    result : End point of the greedy search.
    cost : Cost of that end point.
    costs : For each round of the calibration's search, the number of maps simulated so far and the cost of its estimate.
    overtaken : Number of simulated maps after which the calibration's search first had a simulation with a cost below `cost`;
        None: never.
    """

    result: GreedyResult
    cost: float
    costs: tuple[tuple[int, float], ...]
    overtaken: int | None


@dataclass(frozen=True)
class CalibrationResult:
    """Result of a calibration: the fitted noise parameters of a sensor model, with all that its report needs.

    Attributes
    ----------
    config : The config of the calibration, with all defaults filled in.
    sensor : "stereo" or "tls" (laser scanner).
    inputs : The measured difference maps, their stable ground and the simulated site.
    windows : The k square parts of the maps, n x n pixels each, in which measured and simulated maps were compared.
    epochs : Noise statistics of each measured map.
    median_trend, std_trend : Linear trends of the maps' median and standard deviation over the epochs.
    systematic : (h, w) mean of the measured maps, m; NaN outside stable ground.
    parameters : Names and bounds of the fitted parameters.
    found : Estimate, intervals and goodness of fit.
    statistics : (m,) names of the summary statistics of the noise that were compared, such as "size.nmad".
    observed : (m,) summary statistics of the measurement (natural logarithms of lengths in m).
    patterns : Similarity of the maps of orientation errors; None for a laser scanner or a model without such errors.
    baseline : Comparison with a search that changes one parameter at a time; None if it was not asked for.
    predicted : (k, n, n) windows of one difference map simulated with the fitted noise, m.
    rate : Simulated measurements of the wall (observations) per second.
    cells : Number of depth-map pixels or laser pulses that each simulated observation traces.
    seconds : Duration of the whole calibration, s.
    single_ranges : Scatter of single ranges beside the fitted noise, for points of a laser scanner; else None.
    """

    config: SimulationConfig
    sensor: SensorName
    inputs: CalibrationInputs
    windows: Windows
    epochs: tuple[EpochNoise, ...]
    median_trend: Trend
    std_trend: Trend
    systematic: NDArray[np.float32]
    parameters: NoiseParameters
    found: SearchResult
    statistics: tuple[str, ...]
    observed: FloatArray
    patterns: OrientationPatterns | None
    baseline: GreedyComparison | None
    predicted: FloatArray
    rate: float
    cells: int
    seconds: float
    single_ranges: SingleRanges | None = None

    @property
    def confidence(self) -> float:
        """Confidence level of the intervals of the fitted noise parameters, 0 to 1."""
        return self.config.calibration.confidence

    def simulated_site(self) -> SensorSite:
        """Return the wall with the sensor in front of it, where the sensor has the fitted noise, to simulate further maps."""
        sensor: Any = self.inputs.site.sensor
        return replace(self.inputs.site, sensor=replace(sensor, model=self.model))

    @property
    def model(self) -> Model:
        """The sensor model (noise and effects of the stereo pair or scanner) with the fitted values of its noise parameters."""
        return self.parameters.model(np.exp(self.found.x))

    def inseparable(self) -> list[tuple[str, str, float]]:
        """Return the pairs of noise parameters that the maps cannot separate: they determine only a combination of both.

        Returns
        -------
        For each pair, both names and the correlation of the errors of their estimates, which exceeds 0.9 in magnitude.
        """
        names, matrix = self.parameters.names, self.found.correlation
        rows, columns = np.nonzero(np.triu(np.abs(matrix) > _ALIKE, 1))
        return [(names[i], names[j], float(matrix[i, j])) for i, j in zip(rows, columns, strict=True)]


def calibrate(
    config: SimulationConfig, sensor: SensorName, paths: Sequence[Path], progress: Progress, *, with_greedy: bool = True
) -> CalibrationResult:
    """Fit the noise parameters of a sensor model to measured difference maps, so that simulated maps have the same noise.

    Parameters
    ----------
    config : Config of the simulated site; `config.seed` determines all random numbers.
    sensor : "stereo" or "tls" (laser scanner).
    paths : One folder of a simulation or a measurement, or difference maps as GeoTIFFs.
    progress : Display of the progress, which is told each stage and how much of it is done.
    with_greedy : Whether to also run a search that changes one parameter at a time, for comparison.

    Returns
    -------
    The fitted noise with its intervals and diagnostics.

    Raises
    ------
    InputError
        If the maps or the config cannot be used.
    """
    began, random = time.perf_counter(), KeyedRandom(config.seed)
    progress.plan(STAGES | ({"compare searches": OBSERVATION_S * _GREEDY_OBSERVATIONS} if with_greedy else {}))
    with progress.stage("read maps"):
        inputs = read_inputs(paths, config, sensor, random)
    return calibrate_inputs(config, sensor, inputs, progress, with_greedy=with_greedy, began=began)


def calibrate_inputs(
    config: SimulationConfig,
    sensor: SensorName,
    inputs: CalibrationInputs,
    progress: Progress,
    *,
    with_greedy: bool = True,
    began: float | None = None,
) -> CalibrationResult:
    """Fit the noise parameters of a sensor model to difference maps that are already in memory.

    Parameters
    ----------
    config : Config of the simulated site; `config.seed` determines all random numbers.
    sensor : "stereo" or "tls" (laser scanner).
    inputs : The measured difference maps, their stable ground and the site to simulate.
    progress : Display of the progress, which is told each stage and how much of it is done.
    with_greedy : Whether to also run a search that changes one parameter at a time, for comparison.
    began : Time when the calibration began, from `time.perf_counter`, s, for its duration; None: now.

    Returns
    -------
    The fitted noise with its intervals and diagnostics.

    Raises
    ------
    InputError
        If no stable part of the maps is large enough to compare, or the sensor cannot be simulated in parts of the wall.
    """
    began = time.perf_counter() if began is None else began
    random, settings = KeyedRandom(config.seed).child("calibrate"), config.calibration
    windows = inputs.windows(config)
    measured = np.stack([windows.cut(values) for values in inputs.maps]).astype(np.float64)
    with progress.stage("describe noise"):
        epochs = tuple(
            epoch_noise(name, inputs.on_stable(number), measured[number], inputs.grid.gsd, random.child("normality", number))
            for number, name in enumerate(inputs.names)
        )
    with progress.stage("prepare simulation"):
        error = inputs.reference_error
        simulator = WindowSimulator(config, inputs.site, windows, of_points=inputs.of_points, reference_error=error)
        summary = SummaryStatistics(windows, simulator.noiseless_heights, _direction_to_sensor(inputs.site.sensor, windows))
    fitted = noise_parameters(simulator.sensor.model, settings.fit)
    observed = summary.compute(measured)

    def simulate(values: FloatArray, count: int, source: KeyedRandom) -> FloatArray:
        return summary.compute(simulator.maps(fitted.model(values), count, source))

    search = NoiseSearch(simulate, fitted, len(measured), random, progress)
    started, before = time.perf_counter(), simulator.observations
    found = search.run(observed, settings.simulations, settings.confidence)
    rate = (simulator.observations - before) / (time.perf_counter() - started)
    with progress.stage("compare searches"):
        baseline = _baseline(search, found, summary, observed, random) if with_greedy else None
        patterns = _patterns(simulator, inputs.site.sensor) if isinstance(inputs.site.sensor, StereoPair) else None
        predicted = simulator.maps(fitted.model(np.exp(found.x)), 1, random.child("predicted"))[0]
    return CalibrationResult(
        config=config,
        sensor=sensor,
        inputs=inputs,
        windows=windows,
        epochs=epochs,
        median_trend=trend([each.size.median for each in epochs]),
        std_trend=trend([each.size.standard_deviation for each in epochs]),
        systematic=systematic(np.stack([inputs.on_stable(number) for number in range(len(epochs))])),
        parameters=fitted,
        found=found,
        statistics=summary.names,
        observed=observed,
        patterns=patterns,
        baseline=baseline,
        predicted=predicted,
        rate=rate,
        cells=len(simulator.cells),
        seconds=time.perf_counter() - began,
        single_ranges=SingleRanges.of(inputs.measurement, fitted.model(np.exp(found.x))),
    )


def _baseline(
    search: NoiseSearch, found: SearchResult, summary: SummaryStatistics, observed: FloatArray, random: KeyedRandom
) -> GreedyComparison:
    """Run the greedy search on the same maps, starting at the noise of the model before the calibration."""
    std, fitted = summary.names.index("size.std"), search.parameters
    result = greedy_search(search.simulate, fitted, _values_before(fitted), std, observed[std], random)
    costs = tuple((maps, cost_of_new_simulations(search, found.surface, observed, x)) for maps, x in found.history)
    cost = cost_of_new_simulations(search, found.surface, observed, result.x)
    whitened = ((maps, found.surface.whitening @ (observed - statistics)) for maps, statistics in search.approached)
    overtaken = next((maps for maps, left in whitened if np.sum(left**2) < cost), None)
    return GreedyComparison(result, cost, costs, overtaken)


def _values_before(fitted: NoiseParameters) -> FloatArray:
    """Return the (k,) parameter values of the model before the calibration, clipped to the bounds."""
    noise: Any = fitted.base.noise
    values = []
    for name in fitted.names:
        if name == "orientation":
            values.append(1.0)
        elif name.startswith("orientation."):
            values.append(getattr(noise.orientation, name.split(".")[1]).sigma)
        else:
            values.append(getattr(noise, name))
    return np.clip(values, fitted.low, fitted.high)


def _direction_to_sensor(sensor: Any, windows: Windows) -> FloatArray:
    """Return the (3,) unit vector from the middle of the windows to the sensor, wall frame."""
    eye = sensor.cameras.in_wall_frame(sensor.frame).left.position if isinstance(sensor, StereoPair) else sensor.position
    towards = eye - np.array([*windows.centres().mean(axis=0), 0.0])
    return towards / np.linalg.norm(towards)


def _patterns(simulator: WindowSimulator, pair: StereoPair) -> OrientationPatterns | None:
    """Simulate the map of a one-sigma error of each orientation parameter; None if the model has no orientation noise."""
    spreads = {name: getattr(pair.model.noise.orientation, name).sigma for name in OrientationNoise.model_fields}
    moving = {name: sigma for name, sigma in spreads.items() if sigma > 0}
    if not moving:
        return None
    still, maps = simulator.heights(simulator.noiseless_model, KeyedRandom(0)), []
    for name, sigma in moving.items():
        side: Side = "both" if pair.model.noise.orientation_drawn == "both_alike" else "left"
        alone = OrientationNoise(**{name: DrawnParameter(mean=sigma)}).draw(side, KeyedRandom(0))
        effects: tuple[Effect, ...] = tuple(effect for effect in alone if not effect.is_null)
        model = simulator.noiseless_model.model_copy(update={"effects": (*pair.model.effects, *effects)})
        maps.append(still - simulator.heights(model, KeyedRandom(0)))
    known = np.isfinite(maps).all(axis=0) & simulator.windows.stable
    flat = np.stack([values[known] for values in maps])
    flat = np.clip(flat, *np.quantile(flat, [0.005, 0.995], axis=1, keepdims=True))  # else a moved step edge would dominate
    size = np.sqrt(np.mean(flat**2, axis=1))
    unit = flat / np.maximum(size, 1e-12)[:, None]
    return OrientationPatterns(tuple(moving), size, unit @ unit.T / flat.shape[1])
