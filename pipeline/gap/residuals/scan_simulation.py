"""Simulate a laser scan ray by ray: the scanner simulation sends its pulses in given directions instead of a pattern."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.formats.measurements.measurement import TlsMeasurement
from pipeline.gap.residuals.ray_hits import RayGeometry
from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster
from scene.ray_casting.upload import on_device
from sensors.effects.base import ShowsIn
from sensors.laser.tls import LaserScanner, Pattern, ScannerConfig
from sensors.models.sensor_model import TlsModel, TlsNoise
from sensors.signal_chain.beam import Beam, Echo, Mode, SubRays
from sensors.signal_chain.pulses import Pulses, direction

_NO_NOISE = TlsNoise(range_sigma_m=0.0, range_ppm=0.0, angle_sigma_rad=0.0)


@dataclass(frozen=True)
class DirectedScanner(LaserScanner):
    """A simulated laser scanner whose pulses leave in given directions, such as the recorded ones of a measured scan.

    Attributes
    ----------
    geometry : Directions of the n pulses. Received powers, scan lines and times that it contains are used in the simulation.
        For a reference surface of noisy points, its `bulge_m` corrects the ranges for the curvature between the points, and its
        `plane_normal` has the planes on which turned rays hit.
    inclined : Whether the incidence angles of `geometry` are used instead of those to the triangles of the reference surface.
    """

    geometry: RayGeometry = field(kw_only=True)
    inclined: bool = False

    def emit(self) -> Pulses:
        """Return one pulse for each direction of `geometry`, before any error, as the input of the scanner simulation."""
        angles, zero = self.geometry, np.zeros(len(self.geometry))
        index = dr.arange(mi.UInt32, len(angles))
        azimuth, zenith = (on_device(mi.Float64, angle) for angle in (angles.azimuth, angles.zenith))
        return Pulses(
            line=on_device(mi.UInt32, zero if angles.line is None else np.maximum(angles.line, 0)),
            share=on_device(mi.Float64, zero if angles.share is None else angles.share),
            line_key=index * 0,
            pulse_key=index,
            azimuth=azimuth,
            zenith=zenith,
            aim_azimuth=azimuth,
            aim_zenith=zenith,
        )

    def echo(self, scene: RayCaster, pulses: Pulses, beam: Beam, merge: Callable[[SubRays], Echo]) -> Echo:
        """Trace the beams (see `LaserScanner.echo`): in their recorded directions, if deflections are followed along planes."""
        if self.geometry.plane_normal is not None:
            pulses = replace(pulses, aim_azimuth=pulses.azimuth, aim_zenith=pulses.zenith)
        return super().echo(scene, pulses, beam, merge)

    def measured(self, pulses: Pulses, echo: Echo, random: KeyedRandom) -> Pulses:
        """Apply the errors that arise when an echo is recorded, such as range noise (see `LaserScanner.measured`).

        Known recorded intensities and incidence angles of the measured scan replace the simulated ones. Ranges are corrected
        for the curvature of the surface between the reference's vertices, where it is known.
        """
        known = {"power": self.geometry.power, "cos_incidence": self.geometry.cos_incidence if self.inclined else None}
        known = {name: on_device(mi.Float32, np.maximum(each, 1e-9)) for name, each in known.items() if each is not None}
        echo = replace(echo, **known)
        if self.geometry.bulge_m is not None:
            echo = replace(echo, range_m=echo.range_m - on_device(mi.Float64, np.nan_to_num(self.geometry.bulge_m)))
        if self.geometry.plane_normal is not None:
            echo = replace(echo, range_m=echo.range_m * _deflection_ratio(pulses, self.geometry.plane_normal))
        return super().measured(pulses, echo, random)

    def ranges(self, pulses: Pulses, echo: Echo, random: KeyedRandom) -> FloatArray:
        """Return the ranges (n,) that are recorded from the echoes of pulses, m; NaN without a return."""
        pulses = self.measured(pulses, echo, random)
        return np.array(dr.select(pulses.returned, pulses.range_m, np.nan))


def _deflection_ratio(pulses: Pulses, normal: FloatArray) -> mi.Float64:
    """(n,) distance to planes with normals (n, 3) in the direction of each pulse, relative to that in its nominal direction."""
    across = mi.Vector3d(*(on_device(mi.Float64, np.ascontiguousarray(each)) for each in normal.T))
    nominal, real = direction(pulses.azimuth, pulses.zenith), direction(pulses.aim_azimuth, pulses.aim_zenith)
    return dr.dot(across, nominal) / dr.dot(across, real)


def _scanner(measurement: TlsMeasurement, model: TlsModel, geometry: RayGeometry) -> DirectedScanner:
    """The scanner of a measurement with another model."""
    pattern = Pattern(0.0, 1.0, len(geometry), 0.0, 1.0, 1)
    config = ScannerConfig(minimum_range_m=0.01, maximum_range_m=1e5)
    inclined = measurement.planes is not None
    return DirectedScanner(*measurement.station, pattern, config, model, geometry=geometry, inclined=inclined)


def simulate_ranges(measurement: TlsMeasurement, model: TlsModel, geometry: RayGeometry, random: KeyedRandom) -> FloatArray:
    """Simulate the ranges that a scanner with a given sensor model would record along measured rays.

    Parameters
    ----------
    measurement : The scan, with the scanner's pose and the reference surface.
    model : The sensor model to simulate, instead of that of the measurement.
    geometry : The n measured rays.
    random : Source of the random numbers.

    Returns
    -------
    (n,) ranges, m; NaN without a return.
    """
    scanner = _scanner(measurement, model, geometry)
    pulses, beam = scanner.emitted(scanner.emit(), random)
    return scanner.ranges(pulses, scanner.echo(measurement.scene, pulses, beam, beam.combine_echoes), random)


def simulate_ranges_by_mode(
    measurement: TlsMeasurement, model: TlsModel, modes: Sequence[Mode], geometry: RayGeometry, random: KeyedRandom
) -> dict[Mode, FloatArray]:
    """Simulate the ranges of a scanner with a wide beam, for several ways in which it may combine the echoes within one beam.

    It serves to find out which way the scanner uses at depth steps, where a beam returns several echoes. The sub-rays over the
    beam's footprint are traced only once for all ways.

    Parameters
    ----------
    measurement, geometry, random : As in `simulate_ranges`.
    model : The sensor model, which states the width of the beam.
    modes : Ways to combine the echoes into one range: strongest, mean or first.

    Returns
    -------
    For each mode the (n,) ranges, m; NaN without a return.
    """
    scanner = _scanner(measurement, model, geometry)
    pulses, beam = scanner.emitted(scanner.emit(), random)
    parts: dict[Mode, list[Echo]] = {mode: [] for mode in modes}

    def merge(rays: SubRays) -> Echo:
        for mode in modes:
            echo = replace(beam, mode=mode).combine_echoes(rays)
            dr.eval(echo)
            parts[mode].append(echo)
        return echo

    scanner.echo(measurement.scene, pulses, beam, merge)
    return {mode: scanner.ranges(pulses, Echo.joined(parts[mode]), random) for mode in modes}


def systematic_part(model: TlsModel) -> TlsModel:
    """Return a sensor model without its noise and lost returns, to predict mean ranges.

    Systematic errors and errors at edges (such as those of a wide beam) are kept.
    """
    kept = tuple(effect for effect in model.effects if effect.shows_in in (ShowsIn.MEAN, ShowsIn.EDGES))
    return model.model_copy(update={"noise": _NO_NOISE, "effects": kept})


def mean_beam_directions(measurement: TlsMeasurement, geometry: RayGeometry) -> tuple[FloatArray, FloatArray]:
    """Predict in which directions the beams really left, given the errors of axes and angles in a scan's sensor model.

    Noise is not included. geometry: the n recorded directions. Returns azimuth (n,) and zenith angle (n,), rad, scanner frame.
    """
    scanner = _scanner(measurement, systematic_part(measurement.model), geometry)
    pulses = scanner.emitted(scanner.emit(), KeyedRandom(0, ("gap", "mean")))[0]
    return np.array(pulses.aim_azimuth), np.array(pulses.aim_zenith)


def predict_ranges(measurement: TlsMeasurement, geometry: RayGeometry) -> FloatArray:
    """Predict the mean ranges (n,) along n measured rays, m, by a simulation without noise; NaN without a return.

    measurement: the scan, with the scanner's pose, the reference surface and the sensor model.
    """
    return simulate_ranges(measurement, systematic_part(measurement.model), geometry, KeyedRandom(0, ("gap", "mean")))
