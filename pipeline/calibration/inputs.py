"""What a calibration starts from: measured difference maps, the ground that is stable, and the site that is to give the like."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.calibration.reference_error import ReferenceError
from pipeline.calibration.windows import Windows, choose_windows, unchanged
from pipeline.config.simulation import SensorName, SimulationConfig
from pipeline.formats.measurements.measurement import (
    FILE,
    Measurement,
    StereoMeasurement,
    SurfaceMeasurement,
    TlsMeasurement,
    read_measurement,
)
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.formats.records.result_records import RUN_FILE, read_run
from pipeline.noise.measured import MeasuredMaps, area_mask, read_measured
from pipeline.run.site import SensorSite, prepare_site
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from sensors.laser.tls import LaserScanner, Pattern
from sensors.stereo.stereo_pair import StereoPair

BoolArray = NDArray[np.bool_]
_NEIGHBOURS, _SAMPLE = 64, 5000
"""In the circle around a point whose size tells how densely points lie, enough for those on its rim not to matter; circles."""
_REACH_PX = 2
"""Pixels without a point of their own lie at most so far from one that has, where a cloud covers the ground."""


@dataclass(frozen=True)
class CalibrationInputs:
    """names: of the e maps; grid, maps: (e, h, w), m; stable: (h, w); drawn: whether the user drew it; site: what measured;
    of_points: the maps are mean differences of points to the known surface, not of two surfaces; reference_error: of that
    surface, where it is made of points."""

    names: tuple[str, ...]
    grid: Grid
    maps: NDArray[np.float32]
    stable: BoolArray
    drawn: bool
    site: SensorSite
    of_points: bool
    reference_error: ReferenceError | None = None

    def windows(self, config: SimulationConfig) -> Windows:
        """The windows in which maps are compared."""
        return choose_windows(self.stable, self.grid, config.calibration)

    def on_stable(self, number: int) -> NDArray[np.floating]:
        """(h, w) one map, NaN where it is not stable."""
        return np.where(self.stable, self.maps[number], np.float32(np.nan))


def config_of(paths: Sequence[Path]) -> Path | None:
    """The run.json among the inputs' folders, which is the config of a simulated run; None where there is none."""
    return next((path / RUN_FILE for path in paths if (path / RUN_FILE).is_file()), None)


def sensor_of(paths: Sequence[Path], config: SimulationConfig, wanted: SensorName | None) -> SensorName:
    """Which sensor measured. Raises InputError where the inputs say another than `wanted` (None: any), or nobody says."""
    for path in paths:
        if not path.exists():
            raise InputError("there is no such folder or file", where=str(path), remedy="check the path")
        if (path / FILE).is_file():
            return _agreed(read_measurement(path).sensor, wanted, path)
        if (path / RUN_FILE).is_file():
            return _agreed(read_run(path / RUN_FILE, "run it again with simulate")["sensor"], wanted, path)
    if wanted is not None:
        return wanted
    names = config.sensor_names()
    if len(names) == 1:
        return names[0]
    raise InputError("the maps may be of either sensor", where="calibrate", remedy="add --sensor stereo or --sensor tls")


def _agreed(found: SensorName, wanted: SensorName | None, path: Path) -> SensorName:
    if wanted not in (None, found):
        raise InputError(f"was measured by {found}, and --sensor is {wanted}", where=str(path), remedy="leave --sensor out")
    return found


def read_material(paths: Sequence[Path], config: SimulationConfig, sensor: SensorName, random: KeyedRandom) -> CalibrationInputs:
    """Read the measured maps and find their stable ground. Raises InputError for maps that differ in their grids."""
    measured, names = _maps(paths, config, random)
    _check_noise(measured.maps, names)
    of_points = bool(measured.points)
    if of_points:
        measurement = read_measurement(paths[0])
        site, error = _measured_site(measurement, config), ReferenceError.of(measurement)
    else:
        site, error = prepare_site(config, sensor, random), None
    areas = config.calibration.stable_areas
    drawn = area_mask(areas, measured.grid) if areas else measured.stable
    stable = _covered(measured.maps, of_points) & (unchanged(list(measured.maps)) if drawn is None else drawn)
    return CalibrationInputs(names, measured.grid, measured.maps, stable, drawn is not None, site, of_points, error)


def _maps(paths: Sequence[Path], config: SimulationConfig, random: KeyedRandom) -> tuple[MeasuredMaps, tuple[str, ...]]:
    """One folder, or map files; and the maps' names."""
    if len(paths) == 1 and paths[0].is_dir():
        found = read_measured(paths[0], config.difference, config.icp, random)
        return found, tuple(f"epoch {number}" for number in range(1, len(found.maps) + 1))
    for path in paths:
        if path.suffix.lower() not in (".tif", ".tiff"):
            raise InputError("is no difference map", where=str(path), allowed="one folder, or GeoTIFFs of one grid")
    rasters, grids = zip(*map(read_geotiff, paths), strict=True)
    for path, grid in zip(paths, grids, strict=True):
        if grid != grids[0]:
            raise InputError(f"{grid} is not {grids[0]} of {paths[0].name}", where=str(path), remedy="bring the maps to one grid")
    return MeasuredMaps("maps", grids[0], np.stack(rasters), None), tuple(path.stem for path in paths)


def _check_noise(maps: NDArray[np.floating], names: Sequence[str]) -> None:
    """Maps without any noise are no measurement; one that is given twice would count as two and make the intervals too narrow."""
    for number, (values, name) in enumerate(zip(maps, names, strict=True)):
        known = values[~np.isnan(values)]
        if known.size and np.ptp(known) == 0:
            problem = f"shows the same difference, {known[0]:g} m, everywhere"
            raise InputError(problem, where=name, remedy="give maps of measured differences, noise included")
        for other, other_name in zip(maps[:number], names, strict=False):
            if np.array_equal(values, other, equal_nan=True):
                raise InputError(f"is the same map as {other_name}", where=name, remedy="give each epoch's map once")


def _covered(maps: NDArray[np.floating], of_points: bool) -> BoolArray:
    """(h, w) where every map has data; of points, where some are near in every map."""
    known = ~np.isnan(maps)
    if of_points:
        from scipy import ndimage

        known = np.stack([ndimage.binary_closing(each, iterations=_REACH_PX) | each for each in known])
    return known.all(axis=0)


def _measured_site(measurement: Measurement, config: SimulationConfig) -> SensorSite:
    """The instrument of a measurement in front of its reference surface."""
    sensor: StereoPair | LaserScanner
    if isinstance(measurement, StereoMeasurement):
        name, sensor = "cameras", StereoPair(measurement.cameras, measurement.frame, measurement.model, config.depth_map)
    elif isinstance(measurement, SurfaceMeasurement):
        raise InputError("has no cameras to simulate", where=FILE, remedy="name `cameras`; scarpsim gap needs none")
    else:
        name, sensor = "scanner", _scanner(measurement, config)
    eyes = {name: measurement.viewpoint}
    return SensorSite("measured", measurement.notes, measurement.reference, measurement.frame, sensor, eyes)


def _scanner(measurement: TlsMeasurement, config: SimulationConfig) -> LaserScanner:
    """With the measurement's pattern; where that is not known, over all of the reference as densely as the points lie, since the
    mean of a pixel has the less noise the more points there are."""
    (position, rotation), model, frame = measurement.station, measurement.model, measurement.frame
    if measurement.pattern is None:
        world = frame.to_world(position), frame.rotation.T @ rotation
        step = _angular_spacing(measurement)
        dense = config.scanner.model_copy(update={"azimuth_step_rad": step, "zenith_step_rad": step})
        return LaserScanner.aimed(world, frame, measurement.reference.vertices, dense, model)
    azimuth, zenith = measurement.pattern.azimuth_rad, measurement.pattern.zenith_rad
    steps = config.scanner.model_copy(update={"azimuth_step_rad": azimuth[2], "zenith_step_rad": zenith[2]})  # of any size
    return LaserScanner(position, rotation, Pattern.over(azimuth[:2], zenith[:2], steps), steps, model)


def _angular_spacing(measurement: TlsMeasurement) -> float:
    """Side of the square, seen from the scanner, that a point of the first epoch has to itself, rad: median over a sample, of the
    circle around each that holds 64. Raises InputError where so many lie in one direction."""
    from scipy.spatial import cKDTree

    epochs = measurement.epochs
    ray = measurement.cloud.points[epochs == epochs.min()] - measurement.viewpoint
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    count = min(_NEIGHBOURS, len(ray) - 1)
    reach = cKDTree(ray).query(ray[:: max(len(ray) // _SAMPLE, 1)], [count + 1])[0]
    step = float(np.median(reach) * np.sqrt(np.pi / (count + 0.5)))
    if not step > 0:
        problem = f"more than {count} points lie in one direction from the scanner, so that they do not tell its angular steps"
        raise InputError(problem, where=FILE, remedy="name `pattern`, or give each point once")
    return step
