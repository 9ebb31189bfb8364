"""Read the input of a calibration: the measured difference maps, their stable ground, and the site to simulate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.calibration.reference_error import ReferenceError
from pipeline.calibration.windows import Windows, choose_windows, stable_ground
from pipeline.change.areas import Area, check_some_inside
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
from pipeline.noise.measured import MeasuredMaps, area_mask, map_files, read_measured
from pipeline.run.site import SensorSite, prepare_site
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from sensors.laser.tls import LaserScanner, Pattern
from sensors.stereo.stereo_pair import StereoPair

BoolArray = NDArray[np.bool_]
_NEIGHBOURS, _SAMPLE = 64, 5000
"""Points in the circle whose size gives the point density, many so that those on its rim hardly matter; number of
such circles.
"""
_REACH_PX = 2
"""Largest gap between a point cloud's pixels, px, that still counts as covered ground."""


@dataclass(frozen=True)
class CalibrationInputs:
    """Input of a calibration: measured difference maps on one grid, their stable ground, and the site to simulate.

    Attributes
    ----------
    names : (e,) names of the maps.
    grid : Raster that all maps share.
    maps : (e, h, w) differences, m; NaN without data.
    stable : (h, w) true on stable ground (where nothing fell) that has data in every map.
    drawn : Whether the config or the measurement states the stable areas; otherwise they were detected in the maps.
    site : The wall or reference surface, with the sensor in front of it.
    of_points : True if a pixel's value is the mean distance of the points in it from the reference surface; false if it
        is the difference between two reconstructed surfaces.
    reference_error : Error of a reference surface that is made of points; None if it is unknown or zero.
    measurement : The measured points, if a pixel is a mean of points; else None.
    """

    names: tuple[str, ...]
    grid: Grid
    maps: NDArray[np.float32]
    stable: BoolArray
    drawn: bool
    site: SensorSite
    of_points: bool
    reference_error: ReferenceError | None = None
    measurement: Measurement | None = None

    def windows(self, config: SimulationConfig) -> Windows:
        """Choose the windows, square parts of the maps on stable ground, in which measured and simulated maps are compared.

        config: its section `calibration` gives the number and the size of the windows.
        """
        return choose_windows(self.stable, self.grid, config.calibration)

    def on_stable(self, number: int) -> NDArray[np.floating]:
        """Return one measured difference map, (h, w) in m, with NaN outside stable ground.

        number: index of the map, from 0.
        """
        return np.where(self.stable, self.maps[number], np.float32(np.nan))


def config_of(paths: Sequence[Path]) -> Path | None:
    """Find a config among the inputs of a calibration, for a user who names none.

    paths: the input folders and files. Returns the path of the first `run.json` in the folders, the record of a
    simulation, which contains its config; None if no folder has one.
    """
    return next((path / RUN_FILE for path in paths if (path / RUN_FILE).is_file()), None)


def sensor_of(paths: Sequence[Path], config: SimulationConfig, wanted: SensorName | None) -> SensorName:
    """Return which sensor measured the difference maps of a calibration: "stereo" or "tls" (laser scanner).

    Parameters
    ----------
    paths : The input folders or files. A folder of a simulation or a measurement states its sensor.
    config : If neither the inputs nor `wanted` say which sensor it was, and the config has only one sensor, it is that one.
    wanted : The sensor that the user named; None if the user named none.

    Raises
    ------
    InputError
        If the inputs are of another sensor than `wanted`, if an input does not exist, or if nothing says which sensor it was.
    """
    for path in paths:
        if not path.exists():
            raise InputError(
                "there is no such folder or file", where=str(path), remedy="give the path of an existing folder or file"
            )
        if (path / FILE).is_file():
            return _matching_sensor(read_measurement(path).sensor, wanted, path)
        if (path / RUN_FILE).is_file():
            return _matching_sensor(read_run(path / RUN_FILE, "run it again with simulate")["sensor"], wanted, path)
        if path.is_dir():
            map_files(path)
    if wanted is not None:
        return wanted
    names = config.sensor_names()
    if len(names) == 1:
        return names[0]
    raise InputError("the sensor of the maps is unknown", where="calibrate", remedy="add --sensor stereo or --sensor tls")


def _matching_sensor(found: SensorName, wanted: SensorName | None, path: Path) -> SensorName:
    """Return the sensor found in the input, or raise InputError if the user named the other one."""
    if wanted not in (None, found):
        raise InputError(
            f"the maps were measured by the sensor {found}, but --sensor is {wanted}",
            where=str(path),
            remedy="leave --sensor out, or give maps of the other sensor",
        )
    return found


def read_inputs(paths: Sequence[Path], config: SimulationConfig, sensor: SensorName, random: KeyedRandom) -> CalibrationInputs:
    """Read the measured difference maps of a calibration, find their stable ground and prepare the site to simulate.

    Parameters
    ----------
    paths : One folder (of a simulation or a measurement), or GeoTIFFs that share a grid.
    config : Gives the site, and the stable areas if the user drew them.
    sensor : "stereo" or "tls" (laser scanner).
    random : Source of the random numbers for building the wall and registering points.

    Raises
    ------
    InputError
        If an input is not a difference map, the maps differ in their grids or contain no noise, or one is given twice.
    """
    measured, names = _maps(paths, config, random)
    _check_noise(measured.maps, names)
    drawn = _drawn_areas(config.calibration.stable_areas, measured)
    of_points = bool(measured.points)
    measurement = read_measurement(paths[0]) if of_points else None
    if measurement is not None:
        site, error = _measured_site(measurement, config), ReferenceError.of(measurement)
    else:
        site, error = prepare_site(config, sensor, random), None
    stable = _covered(measured.maps, of_points) & (stable_ground(list(measured.maps)) if drawn is None else drawn)
    return CalibrationInputs(names, measured.grid, measured.maps, stable, drawn is not None, site, of_points, error, measurement)


def _drawn_areas(areas: Sequence[Area], measured: MeasuredMaps) -> BoolArray | None:
    """Return the pixels (h, w) in the config's stable areas, or else in the measurement's; None if nobody drew any.

    Raises InputError if the config's lie outside the maps.
    """
    if not areas:
        return measured.stable
    drawn, grid = area_mask(areas, measured.grid), measured.grid
    x = np.array([grid.x_min, grid.x_min + grid.width * grid.gsd])
    y = np.array([grid.y_max - grid.height * grid.gsd, grid.y_max])
    check_some_inside(drawn, x, y, "calibration.stable_areas")
    return drawn


def _maps(paths: Sequence[Path], config: SimulationConfig, random: KeyedRandom) -> tuple[MeasuredMaps, tuple[str, ...]]:
    """Read the maps of one folder, or map files, and return them with their names."""
    if len(paths) == 1 and paths[0].is_dir():
        found = read_measured(paths[0], config.difference, config.icp, random)
        return found, tuple(f"epoch {number}" for number in range(1, len(found.maps) + 1))
    for path in paths:
        if path.suffix.lower() not in (".tif", ".tiff"):
            raise InputError(
                "the file is not a difference map",
                where=str(path),
                allowed="one folder of results or measurements, or GeoTIFFs (.tif) that share a grid",
                remedy="give the folder alone, or only maps in GeoTIFF",
            )
    rasters, grids = zip(*map(read_geotiff, paths), strict=True)
    for path, grid in zip(paths, grids, strict=True):
        if grid != grids[0]:
            raise InputError(
                f"the raster of the map ({grid}) differs from that of {paths[0].name} ({grids[0]})",
                where=str(path),
                remedy="resample all maps to the same origin, pixel size and shape",
            )
    return MeasuredMaps("maps", grids[0], np.stack(rasters), None), tuple(path.stem for path in paths)


def _check_noise(maps: NDArray[np.floating], names: Sequence[str]) -> None:
    """Raise InputError for a constant map, or one given twice: it would count as two epochs and make the intervals too narrow."""
    for number, (values, name) in enumerate(zip(maps, names, strict=True)):
        known = values[~np.isnan(values)]
        if known.size and np.ptp(known) == 0:
            raise InputError(
                f"the difference is {known[0]:g} m everywhere, so the map has no noise",
                where=name,
                remedy="give measured maps, noise included",
            )
        for other, other_name in zip(maps[:number], names, strict=False):
            if np.array_equal(values, other, equal_nan=True):
                raise InputError(f"the map has the same values as {other_name}", where=name, remedy="give each epoch's map once")


def _covered(maps: NDArray[np.floating], of_points: bool) -> BoolArray:
    """Return the (h, w) mask of pixels with data in every map; for point clouds, small gaps between points count as data."""
    known = ~np.isnan(maps)
    if of_points:
        from scipy import ndimage

        known = np.stack([ndimage.binary_closing(each, iterations=_REACH_PX) | each for each in known])
    return known.all(axis=0)


def _measured_site(measurement: Measurement, config: SimulationConfig) -> SensorSite:
    """Return the site with the instrument of the measurement in front of its reference surface."""
    sensor: StereoPair | LaserScanner
    if isinstance(measurement, StereoMeasurement):
        name, sensor = "cameras", StereoPair(measurement.cameras, measurement.frame, measurement.model, config.depth_map)
    elif isinstance(measurement, SurfaceMeasurement):
        raise InputError(
            "the measurement names no cameras, and a calibration must simulate their pictures",
            where=FILE,
            remedy="add the key `cameras` (cameras.yaml or a Metashape XML), or use scarpsim gap instead of a calibration",
        )
    else:
        name, sensor = "scanner", _scanner(measurement, config)
    eyes = {name: measurement.viewpoint}
    return SensorSite("measured", measurement.notes, measurement.reference, measurement.frame, sensor, eyes)


def _scanner(measurement: TlsMeasurement, config: SimulationConfig) -> LaserScanner:
    """Return a scanner with the measurement's scan pattern.

    If the pattern is unknown, it covers the reference with the angular spacing of the measured points: the noise of a pixel's
    mean depends on how many points the pixel has.
    """
    (position, rotation), model, frame = measurement.station, measurement.model, measurement.frame
    if measurement.pattern is None:
        world = frame.to_world(position), frame.rotation.T @ rotation
        step = _angular_spacing(measurement)
        dense = config.scanner.model_copy(update={"azimuth_step_rad": step, "zenith_step_rad": step})
        return LaserScanner.aimed(world, frame, measurement.reference.vertices, dense, model)
    azimuth, zenith = measurement.pattern.azimuth_rad, measurement.pattern.zenith_rad
    steps = config.scanner.model_copy(update={"azimuth_step_rad": azimuth[2], "zenith_step_rad": zenith[2]})
    return LaserScanner(position, rotation, Pattern.over(azimuth[:2], zenith[:2], steps), steps, model)


def _angular_spacing(measurement: TlsMeasurement) -> float:
    """Estimate the angular spacing of the first epoch's points as seen from the scanner, rad.

    It is the side of the square that one point has to itself: the median, over a sample of points, from the circle that holds the
    64 nearest. Raises InputError if so many points lie in one direction that it would be zero.
    """
    from scipy.spatial import cKDTree

    epochs = measurement.epochs
    ray = measurement.cloud.points[epochs == epochs.min()] - measurement.viewpoint
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    count = min(_NEIGHBOURS, len(ray) - 1)
    reach = cKDTree(ray).query(ray[:: max(len(ray) // _SAMPLE, 1)], [count + 1])[0]
    step = float(np.median(reach) * np.sqrt(np.pi / (count + 0.5)))
    if not step > 0:
        raise InputError(
            f"more than {count} points lie in one direction from the scanner, so its angular steps are unknown",
            where=FILE,
            remedy="add the key `pattern` with the scanner's limits and steps in rad, or remove repeated points",
        )
    return step
