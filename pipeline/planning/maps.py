"""Compute the maps and figures of a planned set-up: sensors in front of a wall, before anything is simulated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.config.simulation import SimulationConfig
from pipeline.planning.curves import Curve, Views, middle_places, probability_curves
from pipeline.precision import stereo_geometry as stereo
from pipeline.precision import tls_geometry as tls
from pipeline.precision.detectability import (
    CLEAR_SNR,
    PlanningConfig,
    Sampling,
    detection_probability,
    smallest_block,
    smallest_clear_block,
)
from pipeline.precision.surface import BoolArray, Places, WallRaster, visible_from, wall_raster
from pipeline.run.site import SensorSite
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster
from sensors.cameras.rectification import rectify
from sensors.laser.tls import LaserScanner
from sensors.stereo.stereo_pair import REDUCTION, StereoPair

_FACES = {1: "", 2: "mean of two faces"}
"""Remark on the number of faces."""


@dataclass(frozen=True)
class PlanMap:
    """Store a map of one quantity over the wall that is predicted for a sensor, such as the smallest detectable block.

    Attributes
    ----------
    name : str
        Name of its file without ending. A name that ends with _m or _rad tells the unit of the values.
    title : str
        The quantity, in words.
    values : (n,) array
        Values at the n places of the plan's raster, in SI units; NaN where there is no value.
    unit : str
        Unit in which reports show the quantity; "" for a ratio.
    factor : float
        Factor by which `values` are multiplied to get that unit.
    """

    name: str
    title: str
    values: FloatArray
    unit: str = ""
    factor: float = 1.0

    @property
    def si_unit(self) -> str:
        """Unit of the map's values, taken from the end of its name: "m" or "rad", and "1" for numbers without a unit."""
        return next((unit for unit in ("m", "rad") if self.name.endswith(f"_{unit}")), "1")

    def summary(self, middle: BoolArray) -> dict[str, float | None]:
        """Summarise the map by its median in the middle of the wall, and its median and 5 and 95 % quantiles over the whole wall.

        In the middle, a place without a value counts as infinite: in a map of the smallest block, no block is large enough there.

        Parameters
        ----------
        middle : (n,) bool array
            True for the places in the middle of the wall.

        Returns
        -------
        dict
            "middle", "median", "quantile_5" and "quantile_95", in the SI unit of the map; None where there is no value.
        """
        values, centre = self.values[np.isfinite(self.values)], np.nan_to_num(self.values[middle], nan=np.inf)
        there = float(np.median(centre)) if centre.size else np.nan
        low, median, high = np.quantile(values, [0.05, 0.5, 0.95]).tolist() if values.size else (None, None, None)
        return {
            "middle": None if not np.isfinite(there) else there,
            "median": median,
            "quantile_5": low,
            "quantile_95": high,
        }


@dataclass(frozen=True)
class Plan:
    """Store what a sensor is predicted to achieve on a wall: maps, single figures and curves.

    Attributes
    ----------
    sensor, instrument : str
        "stereo" or "tls", and a description of the instrument.
    station : int or None
        Number of the scanner's position if there are several; None if there is one, and for the plan of all together.
    wall : str
        Name of the wall.
    raster : WallRaster
        The n places on the wall for which values are predicted.
    maps : list of PlanMap
        Maps of the predicted quantities.
    figures : dict of float
        Single numbers by name, in SI units, such as the share of the wall that is seen.
    curves : list of Curve
        Detection probability of a fallen block against range, sampling step and angle of incidence.
    ignored : list of str
        Names of the error sources of the sensor that the prediction does not take into account.
    config : PlanningConfig
        Settings of the prediction.
    in_middle : (n,) bool array
        True for places in the middle of the wall, over which the main statements are medians.
    """

    sensor: str
    instrument: str
    station: int | None
    wall: str
    raster: WallRaster
    maps: list[PlanMap]
    figures: dict[str, float]
    curves: list[Curve]
    ignored: list[str]
    config: PlanningConfig
    in_middle: BoolArray

    @property
    def prefix(self) -> str:
        """Beginning of the names of this plan's files, such as "tls", or "tls_station_2" for one of several stations."""
        return self.sensor if self.station is None else f"{self.sensor}_station_{self.station}"

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as plan.json holds it: figures, curves, settings, and a summary of each map instead of pixels."""
        middle = self.in_middle
        return {
            "sensor": self.sensor,
            "instrument": self.instrument,
            "station": self.station,
            "wall": self.wall,
            "figures": self.figures,
            "maps": {each.name: each.summary(middle) for each in self.maps},
            "curves": [
                {
                    "against": curve.label,
                    "x": curve.x.tolist(),
                    "set_up": curve.at,
                    "probability": {f"{size:g}": values.tolist() for size, values in curve.probability.items()},
                }
                for curve in self.curves
            ],
            "effects_not_counted": self.ignored,
            "planning": self.config.model_dump(),
        }


def plans(config: SimulationConfig, site: SensorSite) -> list[Plan]:
    """Predict what one sensor achieves on a wall, as maps, figures and curves.

    Parameters
    ----------
    config : SimulationConfig
        Its section `planning` has the settings of the prediction, its section `wetness` says where the rock is wet.
    site : SensorSite
        The wall with the sensor, or the scanner's several stations, in front of it.

    Returns
    -------
    list of Plan
        One plan; for a scanner with several stations, the plan of all together and then one for each.

    Raises
    ------
    InputError
        If the sensor, or one of its stations, sees nothing of the wall.
    """
    caster = site.caster_of(site.mesh if config.wetness is None else config.wetness.with_wet_patches(site.mesh))
    raster = wall_raster(caster, config.planning.gsd_m)
    if isinstance(site.sensor, StereoPair):
        return [_stereo_plan(site.name, site.sensor, caster, raster, config.planning)]
    if not isinstance(site.sensor, LaserScanner):
        raise TypeError(f"no plan for a {type(site.sensor).__name__}")
    if not site.further_stations:
        return [_tls_plan(site.name, site.sensor, None, caster, raster, config.planning)]
    single = [
        _tls_plan(site.name, scanner, number, caster, raster, config.planning)
        for number, scanner in enumerate((site.sensor, *site.further_stations), start=1)
    ]
    return [_combine_stations(single), *single]


def _stereo_plan(wall: str, pair: StereoPair, caster: RayCaster, raster: WallRaster, config: PlanningConfig) -> Plan:
    """Compute the plan of a stereo pair."""
    places, nominal = raster.places, pair.cameras.in_wall_frame(pair.frame)
    found = stereo.stereo_geometry(pair, places, config.image_sigma_px)
    left = found.in_left & visible_from(caster, places, nominal.left.position)
    right = found.in_right & visible_from(caster, places, nominal.right.position)
    both = left & right
    _require_seen(
        both,
        "no part of the wall is seen by both cameras",
        "cameras",
        "correct position_m and rotation of both cameras so that they look at the front of the wall",
    )
    middle = middle_places(raster, both)
    sigma = np.sqrt(np.einsum("nii->ni", found.covariance))
    orientation = np.sqrt(np.einsum("nii->ni", found.orientation_covariance))
    maps = [
        PlanMap("views", "Cameras that see the wall", left.astype(float) + right, "cameras"),
        _map("gsd_m", "GSD of the frame, on the surface", found.gsd_m, both, "mm", 1e3),
        _map("cell_m", "GSD of the depth map, on the surface", found.cell_m, both, "mm", 1e3),
        _map("base_to_distance", "Base over distance", found.base_to_distance, both),
        _map("convergence_rad", "Convergence angle", found.convergence_rad, both, "deg", np.degrees(1)),
        _map("incidence_rad", "Angle of incidence, the larger of both", found.incidence_rad, both, "deg", np.degrees(1)),
        *(
            _map(f"sigma_{axis}_m", f"Standard deviation in {axis}", sigma[:, row], both, "mm", 1e3)
            for row, axis in enumerate("xyz")
        ),
        _map("normal_sigma_m", "Standard deviation along the surface's normal", found.normal_sigma_m, both, "mm", 1e3),
        *_if_any(_map("orientation_sigma_z_m", "Standard deviation in z by the orientation", orientation[:, 2], both, "mm", 1e3)),
        *_detection_maps(found.sampling, both, config),
    ]
    noise = stereo.DisparityNoise.of(pair.model)
    in_both = found.in_left & found.in_right
    figures = {
        "seen_by_both": float(both.mean()),
        "seen_by_one": float((left ^ right).mean()),
        "seen_by_none": float((~left & ~right).mean()),
        "overlap": float(in_both.sum() / max((found.in_left | found.in_right).sum(), 1)),
        "base_m": nominal.base_m,
        "disparity_sigma_px": float(np.hypot(noise.white, noise.smooth)),
        "normal_case_sigma_z_m": _normal_case(pair, found.distance_m[both], noise),
    }
    views = Views.of(places.at(middle), (nominal.left.position + nominal.right.position) / 2, nominal.left.rotation[:, 1])

    def sampling_of(virtual: Places) -> tuple[Sampling, BoolArray]:
        geometry = stereo.stereo_geometry(pair, virtual, config.image_sigma_px)
        return geometry.sampling, geometry.in_left & geometry.in_right

    curves = probability_curves(sampling_of, views, config, ("depth map's cell, px of the frame", float(REDUCTION[pair.quality])))
    ignored = _ignored(effect.name for effect in pair.model.effects if not effect.planned)
    found_there = maps, figures, curves, ignored, config, middle
    return Plan("stereo", "Stereo pair", None, wall, raster, *found_there)


def _tls_plan(
    wall: str, scanner: LaserScanner, station: int | None, caster: RayCaster, raster: WallRaster, config: PlanningConfig
) -> Plan:
    """Compute the plan of one station of a laser scanner."""
    places = raster.places
    found = tls.tls_geometry(scanner, places)
    in_sight = visible_from(caster, places, scanner.position)
    seen = in_sight & found.reached
    _require_seen(
        seen,
        "no part of the wall is seen by the scanner",
        "station" if station is None else f"station, number {station}",
        "correct the scanner's position, rotation, window and range limits so that it sees the front of the wall",
    )
    middle = middle_places(raster, seen)
    sigma = np.sqrt(np.einsum("nii->ni", found.covariance))
    maps = [
        PlanMap("views", "Scanners that see the wall", seen.astype(float), "scanners"),
        _map("range_m", "Range", found.range_m, seen, "m"),
        _map("incidence_rad", "Angle of incidence", found.incidence_rad, seen, "deg", np.degrees(1)),
        _map("spacing_line_m", "Point spacing from line to line (azimuth)", found.spacing_line_m, seen, "mm", 1e3),
        _map("spacing_pulse_m", "Point spacing along a line (zenith)", found.spacing_pulse_m, seen, "mm", 1e3),
        *_if_any(_map("footprint_m", "Footprint's diameter, across the beam", found.footprint_m, seen, "mm", 1e3)),
        *_if_any(_map("footprint_long_m", "Footprint's longest extent on the surface", found.footprint_long_m, seen, "mm", 1e3)),
        _map("range_sigma_m", "Standard deviation along the beam", found.range_sigma_m, seen, "mm", 1e3),
        _map("azimuth_sigma_m", "Standard deviation across the beam, azimuth", found.azimuth_sigma_m, seen, "mm", 1e3),
        _map("zenith_sigma_m", "Standard deviation across the beam, zenith", found.zenith_sigma_m, seen, "mm", 1e3),
        *(
            _map(f"sigma_{axis}_m", f"Standard deviation in {axis}", sigma[:, row], seen, "mm", 1e3)
            for row, axis in enumerate("xyz")
        ),
        _map("normal_sigma_m", "Standard deviation along the surface's normal", found.normal_sigma_m, seen, "mm", 1e3),
        _map("power", "Received power over that of albedo 1 at 100 m", found.power, seen),
        *_detection_maps(found.sampling, seen, config),
    ]
    pulses = scanner.pattern.lines * scanner.pattern.pulses * scanner.config.faces
    figures = {
        "seen": float(seen.mean()),
        "hidden": float((~in_sight).mean()),
        "beyond_window_or_reach": float((in_sight & ~seen).mean()),
        "pulses": float(pulses),
        "seconds_to_scan": pulses / scanner.config.pulse_rate_hz,
    }

    def sampling_of(virtual: Places) -> tuple[Sampling, BoolArray]:
        geometry = tls.tls_geometry(scanner, virtual)
        return geometry.sampling, geometry.reached

    step = float(np.sqrt(scanner.pattern.azimuth_step * scanner.pattern.zenith_step))
    views = Views.of(places.at(middle), scanner.position, scanner.rotation[:, 2])
    curves = probability_curves(sampling_of, views, config, ("angular step, mrad", step * 1e3))
    ignored = _ignored(effect.name for effect in scanner.model.effects if not effect.planned)
    words = "Laser scanner", scanner.config.name, station and f"station {station}", _FACES[scanner.config.faces]
    instrument = ", ".join(str(word) for word in words if word)
    return Plan("tls", instrument, station, wall, raster, maps, figures, curves, ignored, config, middle)


def _combine_stations(single: list[Plan]) -> Plan:
    """Combine several stations into one plan: at each place, the values of the station with the best precision along the normal.

    The merged surface is taken from the same station (`pipeline.surface.stations`).
    """
    first = single[0]
    seen = np.sum([_values(plan, "views") for plan in single], axis=0)
    precision = np.nan_to_num(np.stack([_values(plan, "normal_sigma_m") for plan in single]), nan=np.inf)
    best = np.argmin(precision, axis=0)
    maps = [replace(each, values=np.choose(best, [_values(plan, each.name) for plan in single])) for each in first.maps]
    maps[0] = replace(first.maps[0], values=seen)
    figures = {
        "seen": float((seen > 0).mean()),
        "seen_by_several": float((seen > 1).mean()),
        **{name: sum(plan.figures[name] for plan in single) for name in ("pulses", "seconds_to_scan")},
    }
    name = first.instrument.replace("station 1", f"{len(single)} stations together")
    middle = middle_places(first.raster, seen > 0)
    return replace(first, instrument=name, station=None, maps=maps, figures=figures, curves=[], in_middle=middle)


def _values(plan: Plan, name: str) -> FloatArray:
    """Return the values of a map by its name."""
    return next(found.values for found in plan.maps if found.name == name)


def _ignored(names: Any) -> list[str]:
    """Sort names and remove duplicates."""
    return sorted(set(names))


def _require_seen(seen: BoolArray, problem: str, where: str, remedy: str) -> None:
    """Raise InputError, with the given texts, if no place is seen."""
    if not seen.any():
        raise InputError(problem, where=where, remedy=remedy)


def _map(name: str, title: str, values: FloatArray, seen: BoolArray, unit: str = "", factor: float = 1.0) -> PlanMap:
    """Make a map with values only where the wall is seen."""
    return PlanMap(name, title, np.where(seen, values, np.nan), unit, factor)


def _if_any(found: PlanMap) -> list[PlanMap]:
    """Return a list with the map, or an empty one if it is zero everywhere because the model has no such effect."""
    return [found] if np.nanmax(found.values) > 0 else []


def _detection_maps(sampling: Sampling, seen: BoolArray, config: PlanningConfig) -> list[PlanMap]:
    """Compute the maps of the smallest blocks and of the detection probability."""
    title = f"Smallest block seen in {100 * config.probability:g} % of cases"
    maps = [_map("smallest_block_m", title, smallest_block(sampling, config), seen, "cm", 100.0)]
    findable = f"Smallest block that stands out anywhere on the wall (S/N {CLEAR_SNR:g})"
    maps.append(_map("smallest_findable_m", findable, smallest_clear_block(sampling, config), seen, "cm", 100.0))
    for size in config.block_size_m:
        probability = np.where(seen, detection_probability(sampling, size, config), 0.0)
        name, words = f"probability_{size * 1e3:.0f}mm", f"Probability to see a block of {size:g} m"
        maps.append(PlanMap(name, words, probability, "%", 100.0))
    return maps


def _normal_case(pair: StereoPair, distance: FloatArray, noise: stereo.DisparityNoise) -> float:
    """Return sigma_Z = Z^2 / (c B) sigma_p at the median distance, m, as a check by a rule of thumb."""
    return float(np.median(distance) ** 2 / (rectify(pair.cameras).f * pair.cameras.base_m) * np.hypot(noise.white, noise.smooth))
