"""`scarpsim calibrate`, read from top to bottom: measured maps, their noise, the search, what cannot be told apart, a picture."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.calibration.epochs import EpochNoise, Trend, epoch_noise, systematic, trend
from pipeline.calibration.greedy import Greedy, greedy
from pipeline.calibration.inputs import CalibrationInputs, read_material
from pipeline.calibration.parameters import Model, Parameters, parameters
from pipeline.calibration.reobserve import Reobserver
from pipeline.calibration.search import OBSERVATION_S, Found, NoiseSearch, fresh_cost
from pipeline.calibration.signature import Signature
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
"""Correlation from which two parameters count as inseparable."""
STAGES = {"read": 1.0, "statistics": 1.0, "prepare": 2.0, "round 1": 20.0, "last round": 100.0, "compare": 2.0}
"""Seconds that stages take, for the plan of the progress; the search plans its rounds anew when it knows their sizes."""
_GREEDY_OBSERVATIONS = 300


@dataclass(frozen=True)
class Patterns:
    """What the orientation parameters of the left camera do to the maps, after registration.

    names: k; size_m: (k,) RMS of the map for one sigma; cosines: (k, k) between the maps.
    """

    names: tuple[str, ...]
    size_m: FloatArray
    cosines: FloatArray

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it."""
        return {"names": self.names, "rms_m": self.size_m, "cosines": self.cosines}


@dataclass(frozen=True)
class Baseline:
    """The thesis's greedy search beside this one.

    cost: of fresh simulations at its end; costs: of this search after each round, with the maps till then; overtaken: maps
    simulated when this search first had a set nearer to the measurement than `cost`, None if never.
    """

    result: Greedy
    cost: float
    costs: tuple[tuple[int, float], ...]
    overtaken: int | None


@dataclass(frozen=True)
class CalibrationResult:
    """The result. predicted: (k, n, n) windows of one simulated map; rate: observations per second; cells: traced in each."""

    config: SimulationConfig
    sensor: SensorName
    material: CalibrationInputs
    windows: Windows
    epochs: tuple[EpochNoise, ...]
    median_trend: Trend
    std_trend: Trend
    systematic: NDArray[np.float32]
    parameters: Parameters
    found: Found
    statistics: tuple[str, ...]
    observed: FloatArray
    patterns: Patterns | None
    baseline: Baseline | None
    predicted: FloatArray
    rate: float
    cells: int
    seconds: float

    @property
    def confidence(self) -> float:
        """Of the intervals."""
        return self.config.calibration.confidence

    def simulated_site(self) -> SensorSite:
        """The site with the calibrated model."""
        sensor: Any = self.material.site.sensor
        return replace(self.material.site, sensor=replace(sensor, model=self.model))

    @property
    def model(self) -> Model:
        """The sensor model with the calibrated noise."""
        return self.parameters.model(np.exp(self.found.x))

    def inseparable(self) -> list[tuple[str, str, float]]:
        """Pairs of fitted parameters whose errors are correlated by more than 0.9, with the correlation."""
        names, matrix = self.parameters.names, self.found.correlation
        rows, columns = np.nonzero(np.triu(np.abs(matrix) > _ALIKE, 1))
        return [(names[i], names[j], float(matrix[i, j])) for i, j in zip(rows, columns, strict=True)]


def calibrate(
    config: SimulationConfig, sensor: SensorName, paths: Sequence[Path], progress: Progress, *, with_greedy: bool = True
) -> CalibrationResult:
    """Calibrate the noise of a sensor's model on measured maps; `config.seed` keys all random numbers.

    paths: see `inputs.read_material`. Raises InputError for whatever is wrong with them or with the config.
    """
    began, random = time.perf_counter(), KeyedRandom(config.seed)
    progress.plan(STAGES | ({"compare": OBSERVATION_S * _GREEDY_OBSERVATIONS} if with_greedy else {}))
    with progress.stage("read"):
        material = read_material(paths, config, sensor, random)
    return calibrate_material(config, sensor, material, progress, with_greedy=with_greedy, began=began)


def calibrate_material(
    config: SimulationConfig,
    sensor: SensorName,
    material: CalibrationInputs,
    progress: Progress,
    *,
    with_greedy: bool = True,
    began: float | None = None,
) -> CalibrationResult:
    """The same with maps that are in memory."""
    began = time.perf_counter() if began is None else began
    random, settings = KeyedRandom(config.seed).child("calibrate"), config.calibration
    windows = material.windows(config)
    measured = np.stack([windows.cut(values) for values in material.maps]).astype(np.float64)
    with progress.stage("statistics"):
        epochs = tuple(
            epoch_noise(name, material.on_stable(number), measured[number], material.grid.gsd, random.child("normality", number))
            for number, name in enumerate(material.names)
        )
    with progress.stage("prepare"):
        error = material.reference_error
        simulator = Reobserver(config, material.site, windows, of_points=material.of_points, reference_error=error)
        signature = Signature(windows, simulator.silent_heights, _sight(material.site.sensor, windows))
    fitted = parameters(simulator.sensor.model, settings.fit)
    observed = signature.of(measured)

    def simulate(values: FloatArray, count: int, source: KeyedRandom) -> FloatArray:
        return signature.of(simulator.maps(fitted.model(values), count, source))

    search = NoiseSearch(simulate, fitted, len(measured), random, progress)
    started, before = time.perf_counter(), simulator.observations
    found = search.run(observed, settings.simulations, settings.confidence)
    rate = (simulator.observations - before) / (time.perf_counter() - started)
    with progress.stage("compare"):
        baseline = _baseline(search, found, signature, observed, random) if with_greedy else None
        patterns = _patterns(simulator, material.site.sensor) if isinstance(material.site.sensor, StereoPair) else None
        predicted = simulator.maps(fitted.model(np.exp(found.x)), 1, random.child("predicted"))[0]
    return CalibrationResult(
        config=config,
        sensor=sensor,
        material=material,
        windows=windows,
        epochs=epochs,
        median_trend=trend([each.size.median for each in epochs]),
        std_trend=trend([each.size.standard_deviation for each in epochs]),
        systematic=systematic(np.stack([material.on_stable(number) for number in range(len(epochs))])),
        parameters=fitted,
        found=found,
        statistics=signature.names,
        observed=observed,
        patterns=patterns,
        baseline=baseline,
        predicted=predicted,
        rate=rate,
        cells=len(simulator.cells),
        seconds=time.perf_counter() - began,
    )


def _baseline(search: NoiseSearch, found: Found, signature: Signature, observed: FloatArray, random: KeyedRandom) -> Baseline:
    """The thesis's search on the same maps, from the values of the model that was there before."""
    std, fitted = signature.names.index("size.std"), search.parameters
    result = greedy(search.simulate, fitted, _present(fitted), std, observed[std], random)
    costs = tuple((maps, fresh_cost(search, found.surface, observed, x)) for maps, x in found.history)
    cost = fresh_cost(search, found.surface, observed, result.x)
    whitened = ((maps, found.surface.whitening @ (observed - statistics)) for maps, statistics in search.approached)
    overtaken = next((maps for maps, left in whitened if np.sum(left**2) < cost), None)
    return Baseline(result, cost, costs, overtaken)


def _present(fitted: Parameters) -> FloatArray:
    """(k,) values in the model before the calibration, within the bounds."""
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


def _sight(sensor: Any, windows: Windows) -> FloatArray:
    """(3,) unit vector from the windows' middle to the sensor, wall frame."""
    eye = sensor.cameras.in_wall_frame(sensor.frame).left.position if isinstance(sensor, StereoPair) else sensor.position
    towards = eye - np.array([*windows.centres().mean(axis=0), 0.0])
    return towards / np.linalg.norm(towards)


def _patterns(simulator: Reobserver, pair: StereoPair) -> Patterns | None:
    """The maps of one sigma of each orientation parameter of the left camera, or of both alike; None where the model has none."""
    spreads = {name: getattr(pair.model.noise.orientation, name).sigma for name in OrientationNoise.model_fields}
    moving = {name: sigma for name, sigma in spreads.items() if sigma > 0}
    if not moving:
        return None
    still, maps = simulator.heights(simulator.silent, KeyedRandom(0)), []
    for name, sigma in moving.items():
        side: Side = "both" if pair.model.noise.orientation_drawn == "both_alike" else "left"
        alone = OrientationNoise(**{name: DrawnParameter(mean=sigma)}).draw(side, KeyedRandom(0))
        effects: tuple[Effect, ...] = tuple(effect for effect in alone if not effect.is_null)
        model = simulator.silent.model_copy(update={"effects": (*pair.model.effects, *effects)})
        maps.append(still - simulator.heights(model, KeyedRandom(0)))
    known = np.isfinite(maps).all(axis=0) & simulator.windows.stable
    flat = np.stack([values[known] for values in maps])
    flat = np.clip(flat, *np.quantile(flat, [0.005, 0.995], axis=1, keepdims=True))  # a step that moved would outweigh the rest
    size = np.sqrt(np.mean(flat**2, axis=1))
    unit = flat / np.maximum(size, 1e-12)[:, None]
    return Patterns(tuple(moving), size, unit @ unit.T / flat.shape[1])
