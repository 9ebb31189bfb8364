"""Simulate a laser scan ray by ray: the scanner simulation sends its pulses in given directions instead of a pattern."""

from __future__ import annotations

from collections.abc import Sequence
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
from sensors.signal_chain.beam import Echo, Mode, SubRays
from sensors.signal_chain.pulses import PulseGeometry, Pulses, direction

_NO_NOISE = TlsNoise(range_sigma_m=0.0, range_ppm=0.0, angle_sigma_rad=0.0)


@dataclass(frozen=True)
class DirectedScanner(LaserScanner):
    """A simulated laser scanner whose pulses leave in given directions, such as the recorded ones of a measured scan.

    Attributes
    ----------
    geometry : Directions of the n pulses. If it contains received powers or scan lines and times, these are used in the
        simulation.
    inclined : Whether the incidence angles of `geometry` are used instead of those to the triangles of the reference surface.
    between : For a reference surface of noisy points: geometry of the same n rays. Its field `bulge_m` corrects the ranges for
        the curvature between the points, and `plane_normal` has the planes on which turned rays hit. None: no correction.
    """

    geometry: PulseGeometry = field(kw_only=True)
    inclined: bool = False
    between: RayGeometry | None = None

    def emit(self) -> Pulses:
        """Return one pulse for each direction of `geometry`, before any error, as the input of the scanner simulation."""
        angles, count = self.geometry, len(self.geometry.azimuth)
        index = dr.arange(mi.UInt32, count)
        zero = np.zeros(count)
        line = zero if angles.line is None else np.maximum(angles.line, 0)
        share = zero if angles.share is None else angles.share
        azimuth, zenith = (on_device(mi.Float64, angle) for angle in (angles.azimuth, angles.zenith))
        number = on_device(mi.UInt32, line)
        return Pulses(
            line=number,
            share=on_device(mi.Float64, share),
            line_key=index * 0,
            pulse_key=index,
            azimuth=azimuth,
            zenith=zenith,
            aim_azimuth=azimuth,
            aim_zenith=zenith,
        )

    def ranges(self, scene: RayCaster, random: KeyedRandom) -> FloatArray:
        """Simulate the ranges that the scanner records for all its n pulses.

        Parameters
        ----------
        scene : The reference surface, wall frame, prepared for ray tracing.
        random : Source of the random numbers.

        Returns
        -------
        (n,) ranges, m; NaN without a return.
        """
        pulses, beam = self.emitted(self.emit(), random)
        return self._recorded_ranges(pulses, self.echo(scene, self._traced_pulses(pulses), beam, beam.combine_echoes), random)

    def ranges_by_mode(self, scene: RayCaster, random: KeyedRandom, modes: Sequence[Mode]) -> dict[Mode, FloatArray]:
        """Simulate the recorded ranges for several ways in which a scanner may combine the echoes within one beam.

        A beam that meets a depth step returns several echoes. It is simulated by sub-rays over its footprint, which are traced
        only once for all ways.

        Parameters
        ----------
        scene : The reference surface, wall frame, prepared for ray tracing.
        random : Source of the random numbers.
        modes : Ways to combine the echoes into one range: strongest, mean or first.

        Returns
        -------
        For each mode the (n,) ranges, m; NaN without a return.
        """
        pulses, beam = self.emitted(self.emit(), random)
        parts: dict[Mode, list[Echo]] = {mode: [] for mode in modes}

        def merge(rays: SubRays) -> Echo:
            for mode in modes:
                echo = replace(beam, mode=mode).combine_echoes(rays)
                dr.eval(echo)
                parts[mode].append(echo)
            return echo

        self.echo(scene, self._traced_pulses(pulses), beam, merge)
        return {mode: self._recorded_ranges(pulses, Echo.joined(parts[mode]), random) for mode in modes}

    def _traced_pulses(self, pulses: Pulses) -> Pulses:
        """The pulses in their recorded directions if deflections are followed along planes; else unchanged."""
        return pulses if self._planes is None else replace(pulses, aim_azimuth=pulses.azimuth, aim_zenith=pulses.zenith)

    def _recorded_ranges(self, pulses: Pulses, echo: Echo, random: KeyedRandom) -> FloatArray:
        """(n,) ranges of echoes after the effects on measured values, m; NaN without a return."""
        pulses = self.measured(pulses, echo, random)
        return np.array(dr.select(pulses.returned, pulses.range_m, np.nan))

    def measured(self, pulses: Pulses, echo: Echo, random: KeyedRandom) -> Pulses:
        """Apply the errors that arise when an echo is recorded, such as range noise or a bias that depends on the intensity.

        Known recorded intensities and incidence angles of the measured scan replace the simulated ones. Ranges are corrected
        for the curvature of the surface between the reference's vertices, where it is known.

        Parameters
        ----------
        pulses : The pulses as emitted.
        echo : What returned from the surface for each pulse.
        random : Source of the random numbers.

        Returns
        -------
        The pulses with their recorded values.
        """
        known = {"power": self.geometry.power, "cos_incidence": self.geometry.cos_incidence if self.inclined else None}
        known = {name: on_device(mi.Float32, np.maximum(each, 1e-9)) for name, each in known.items() if each is not None}
        echo = replace(echo, **known)
        if self.between is not None and self.between.bulge_m is not None:
            echo = replace(echo, range_m=echo.range_m - on_device(mi.Float64, np.nan_to_num(self.between.bulge_m)))
        if self._planes is not None:
            echo = replace(echo, range_m=echo.range_m * _deflection_ratio(pulses, self._planes))
        return super().measured(pulses, echo, random)

    @property
    def _planes(self) -> FloatArray | None:
        """(n, 3) normals of the planes along which deflected pulses are followed; None: along the reference's triangles."""
        return None if self.between is None else self.between.plane_normal


def _deflection_ratio(pulses: Pulses, normal: FloatArray) -> mi.Float64:
    """(n,) distance to planes with normals (n, 3) in the direction of each pulse, relative to that in its nominal direction."""
    across = mi.Vector3d(*(on_device(mi.Float64, np.ascontiguousarray(each)) for each in normal.T))
    nominal, real = direction(pulses.azimuth, pulses.zenith), direction(pulses.aim_azimuth, pulses.aim_zenith)
    return dr.dot(across, nominal) / dr.dot(across, real)


def _scanner(
    measurement: TlsMeasurement, model: TlsModel, geometry: PulseGeometry, between: RayGeometry | None = None
) -> DirectedScanner:
    """The scanner of a measurement with another model."""
    position, rotation = measurement.station
    pattern = Pattern(0.0, 1.0, len(geometry.azimuth), 0.0, 1.0, 1)
    config = ScannerConfig(minimum_range_m=0.01, maximum_range_m=1e5)
    inclined = measurement.planes is not None
    return DirectedScanner(position, rotation, pattern, config, model, geometry=geometry, inclined=inclined, between=between)


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
    return _scanner(measurement, model, geometry, geometry).ranges(measurement.scene, random)


def simulate_ranges_by_mode(
    measurement: TlsMeasurement, model: TlsModel, modes: Sequence[Mode], geometry: RayGeometry, random: KeyedRandom
) -> dict[Mode, FloatArray]:
    """Simulate the ranges of a scanner with a wide beam, for several ways in which it may combine the echoes within one beam.

    It serves to find out which way the scanner uses at depth steps.

    Parameters
    ----------
    measurement : The scan, with the scanner's pose and the reference surface.
    model : The sensor model, which states the width of the beam.
    modes : Ways to combine the echoes into one range: strongest, mean or first.
    geometry : The n measured rays.
    random : Source of the random numbers.

    Returns
    -------
    For each mode the (n,) ranges, m; NaN without a return.
    """
    return _scanner(measurement, model, geometry, geometry).ranges_by_mode(measurement.scene, random, modes)


def systematic_part(model: TlsModel) -> TlsModel:
    """Return a sensor model without its noise and lost returns, to predict mean ranges.

    Systematic errors and errors at edges (such as those of a wide beam) are kept.
    """
    kept = tuple(effect for effect in model.effects if effect.shows_in in (ShowsIn.MEAN, ShowsIn.EDGES))
    return model.model_copy(update={"noise": _NO_NOISE, "effects": kept})


def mean_beam_directions(measurement: TlsMeasurement, geometry: PulseGeometry) -> tuple[FloatArray, FloatArray]:
    """Predict in which directions the beams really left, given the errors of axes and angles in the sensor model.

    Noise is not included.

    Parameters
    ----------
    measurement : The scan with its sensor model.
    geometry : The n recorded directions.

    Returns
    -------
    (n,) azimuth and (n,) zenith angle, rad, scanner frame.
    """
    scanner = _scanner(measurement, systematic_part(measurement.model), geometry)
    pulses = scanner.emitted(scanner.emit(), KeyedRandom(0, ("gap", "mean")))[0]
    return np.array(pulses.aim_azimuth), np.array(pulses.aim_zenith)


def predict_ranges(measurement: TlsMeasurement, geometry: RayGeometry) -> FloatArray:
    """Predict the mean ranges along measured rays under the measurement's sensor model, by a simulation without noise.

    Parameters
    ----------
    measurement : The scan, with the scanner's pose, the reference surface and the sensor model.
    geometry : The n measured rays.

    Returns
    -------
    (n,) ranges, m; NaN without a return.
    """
    return simulate_ranges(measurement, systematic_part(measurement.model), geometry, KeyedRandom(0, ("gap", "mean")))
