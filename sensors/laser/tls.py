"""Simulate the terrestrial laser scanner.

Pulses leave in a pattern of azimuth and zenith, are ray-traced, and are recorded in their nominal directions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Literal

import numpy as np
import psutil
from pydantic import Field, model_validator

from scene.common.backend import dr, mi
from scene.common.config import Config
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.common.threads import map_in_threads
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import WALL, FloatArray
from scene.ray_casting.raycast import RayCaster
from sensors.cameras.camera import axis_rotation
from sensors.effects.base import Stage, apply_stage
from sensors.laser.atmosphere import extinction_per_m
from sensors.laser.faces import mean_of_faces
from sensors.models.placement import EXACT_POSE, PoseSigma
from sensors.models.sensor_model import TlsModel
from sensors.numerics.device import opaque, rotated, vector
from sensors.signal_chain.beam import Beam, Echo, SubRays
from sensors.signal_chain.observation import FurtherReturns, Observation, offset_of, packed
from sensors.signal_chain.polar import polar
from sensors.signal_chain.pulses import REFERENCE_RANGE_M, Pulses, direction, tangents
from sensors.signal_chain.returns import MOST_RETURNS, RecordedReturns, further_returns

Window = tuple[float, float]

_RAYS_AT_ONCE = 1 << 20
"""Number of sub-rays whose echoes are held in memory at a time: 25 MB."""
_BYTES_PER_PULSE = 400
"""Peak memory per pulse: rays, points, surface, and the ray tracing of the difference map."""


class ScannerConfig(Config):
    """A laser scanner as an instrument, and the window it scans.

    Its noise and systematic errors are configured elsewhere (`TlsModel`). A file may name a `preset` instead of the properties.
    """

    short_forms: ClassVar[tuple[str, ...]] = ("preset",)
    name: str | None = Field(None, min_length=1, description="manufacturer and model; a preset gives its own")
    zenith_limits_rad: Window = Field((0.5, 2.3), description="field of view in zenith: smallest, largest [rad]")
    azimuth_step_rad: float = Field(0.0005, gt=0, le=0.02, description="angular step between scan lines [rad]")
    zenith_step_rad: float = Field(0.0005, gt=0, le=0.02, description="angular step between the pulses of a line [rad]")
    azimuth_rad: Window | None = Field(None, description="window in azimuth: start, stop; none: the wall's extent [rad]")
    zenith_rad: Window | None = Field(None, description="window in zenith: start, stop; none: the wall's extent [rad]")
    pulse_rate_hz: float = Field(100_000.0, gt=0, description="pulses per second [Hz]")
    minimum_range_m: float = Field(1.0, ge=0, description="nearest range that is recorded [m]")
    maximum_range_m: float = Field(1000.0, gt=0, description="farthest range that is recorded [m]")
    visibility_m: float | None = Field(None, gt=0, description="haze or fog weakens the echoes; none: clear air [m]")
    faces: Literal[1, 2] = Field(1, description="2: scan in both faces and take the mean, in which axis errors cancel")
    face_tolerance_m: float = Field(
        0.1, ge=0, description="ranges of both faces that differ by more are not averaged, the first face's is kept [m]"
    )
    wavelength_nm: float = Field(1550.0, ge=300, le=3000, description="wavelength of the laser, for the extinction in haze [nm]")

    @model_validator(mode="after")
    def _ordered(self) -> ScannerConfig:
        for name in ("zenith_limits_rad", "azimuth_rad", "zenith_rad"):
            window = getattr(self, name)
            if window is not None and not window[0] < window[1]:
                raise ValueError(f"{name}: start must be smaller than stop, got {list(window)}")
        for name, low, high in (("zenith_limits_rad", 0, 1), ("zenith_rad", 0, 1), ("azimuth_rad", -2, 2)):
            window = getattr(self, name)
            if window is not None and not low * np.pi <= window[0] < window[1] <= high * np.pi:
                allowed = "0..pi" if low == 0 else "-2 pi..2 pi"
                raise ValueError(f"{name} must lie in {allowed}, got {list(window)} (are these degrees?)")
        if self.minimum_range_m >= self.maximum_range_m:
            raise ValueError("minimum_range_m must be smaller than maximum_range_m")
        return self

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient of the air, 1/m, by which haze or fog weakens echoes; 0 if no visibility is configured."""
        return 0.0 if self.visibility_m is None else extinction_per_m(self.visibility_m, self.wavelength_nm)


@dataclass(frozen=True)
class Pattern:
    """The grid of nominal directions that a scanner scans: lines at equal steps of azimuth, pulses at equal steps of zenith.

    Attributes
    ----------
    azimuth_start, azimuth_step : float
        Azimuth of the first scan line, and step to the next, rad.
    lines : int
        Number of scan lines.
    zenith_start, zenith_step : float
        Zenith angle of a line's first pulse, and step to the next, rad.
    pulses : int
        Number of pulses of a line.
    """

    azimuth_start: float
    azimuth_step: float
    lines: int
    zenith_start: float
    zenith_step: float
    pulses: int

    @classmethod
    def over(cls, azimuth: Window, zenith: Window, config: ScannerConfig) -> Pattern:
        """Make the grid of directions over a window, starting at the window's start and ending at or before its stop.

        azimuth, zenith: (start, stop), rad. config: the instrument, which gives the steps. Raises InputError if the scan would
        not fit in the free memory.
        """
        lines, pulses = (
            int(np.floor((stop - start) / step + 1e-9)) + 1
            for (start, stop), step in ((azimuth, config.azimuth_step_rad), (zenith, config.zenith_step_rad))
        )
        most = min(psutil.virtual_memory().available // _BYTES_PER_PULSE, 2**31)
        if lines * pulses > most:
            raise InputError(
                f"a scan of {lines:,} lines with {pulses:,} pulses each would take "
                f"{lines * pulses * _BYTES_PER_PULSE / 1e9:,.0f} GB of memory",
                where="scanner.azimuth_step_rad, scanner.zenith_step_rad",
                allowed=f"up to {most:,} pulses in all, which fit in the free memory",
                remedy="choose larger steps, or a smaller window of azimuth and zenith",
            )
        return cls(azimuth[0], config.azimuth_step_rad, lines, zenith[0], config.zenith_step_rad, pulses)

    def second_face(self) -> Pattern:
        """Return the directions with which the scanner aims at the same points in its second face.

        They are azimuth + pi, and 2 pi minus the zenith angle.
        """
        return replace(
            self,
            azimuth_start=self.azimuth_start + np.pi,
            zenith_start=2 * np.pi - self.zenith_start,
            zenith_step=-self.zenith_step,
        )


@dataclass(frozen=True)
class LaserScanner:
    """A laser scanner at its place, ready to scan.

    Attributes
    ----------
    position : (3,) array
        Position as surveyed, wall frame, m.
    rotation : (3, 3) array
        Rotation from scanner to wall frame, as surveyed.
    pattern : Pattern
        The directions that are scanned.
    config : ScannerConfig
        The instrument.
    model : TlsModel
        Its noise and other errors.
    truth : bool
        Whether observations keep error-free quantities, such as the true range.
    pose_sigma : PoseSigma
        Standard deviations of the surveyed pose (position and rotation).
    shift_m : (3,) array, optional
        Real minus surveyed position, wall frame, m, before `pose_sigma`; None: none.
    turn : (3, 3) array, optional
        Rotation of the real against the surveyed scanner, in the wall frame; None: none.
    """

    position: FloatArray
    rotation: FloatArray
    pattern: Pattern
    config: ScannerConfig
    model: TlsModel
    truth: bool = False
    pose_sigma: PoseSigma = EXACT_POSE
    shift_m: FloatArray | None = None
    turn: FloatArray | None = None

    @classmethod
    def aimed(
        cls,
        station: tuple[FloatArray, FloatArray],
        frame: WallFrame,
        vertices: FloatArray,
        config: ScannerConfig,
        model: TlsModel,
        truth: bool = False,
        pose_sigma: PoseSigma = EXACT_POSE,
    ) -> LaserScanner:
        """Make a scanner at a place, which scans the window of its config or else the whole wall.

        Parameters
        ----------
        station : (position, rotation)
            Position (3,), world frame, m, and rotation (3, 3), scanner to world.
        frame : WallFrame
            The wall frame.
        vertices : (n, 3) array
            Vertices of the wall, wall frame, m.
        config : ScannerConfig
            The instrument.
        model : TlsModel
            Its noise and other errors.
        truth : bool
            Whether observations keep error-free quantities, such as the true range.
        pose_sigma : PoseSigma
            Standard deviations of the surveyed pose (position and rotation).

        Raises
        ------
        InputError
            If the wall lies outside the scanner's field of view.
        """
        position, rotation = frame.to_wall(station[0]), frame.rotation @ station[1]
        azimuth, zenith = _extent(vertices, position, rotation)
        azimuth = config.azimuth_rad or _padded(azimuth, config.azimuth_step_rad)
        low, high = config.zenith_rad or _padded(zenith, config.zenith_step_rad)
        low, high = max(low, config.zenith_limits_rad[0]), min(high, config.zenith_limits_rad[1])
        if not low < high:
            raise InputError(
                "the wall lies outside the scanner's field of view",
                where="scanner.zenith_limits_rad",
                remedy="move the station (position_m), tilt it (rotation), or widen scanner.zenith_limits_rad",
            )
        return cls(position, rotation, Pattern.over(azimuth, (low, high), config), config, model, truth, pose_sigma)

    def observe(self, scene: RayCaster, random: KeyedRandom) -> Observation:
        """Scan the scene once. Rows are scan lines (azimuth), columns the pulses of a line (zenith).

        Pulses leave from the real pose of the scanner. It is the surveyed pose, displaced by `shift_m` and `turn` and then by a
        random error with the standard deviations `pose_sigma`. Points are computed from angles and range with the surveyed pose,
        so that they have its error.

        scene: the wall, wall frame. random: source of random numbers.
        """
        moved = self.position if self.shift_m is None else self.position + self.shift_m
        rotated = self.rotation if self.turn is None else self.turn @ self.rotation
        position, rotation = self.pose_sigma.displaced(moved, rotated, random.child("pose"))
        real = replace(self, position=position, rotation=rotation)
        seen = self._scan(real, scene, random)
        if self.config.faces == 1:
            return seen
        turned = replace(self, pattern=self.pattern.second_face())
        return mean_of_faces(seen, turned._scan(real, scene, random.child("face", 2)), self.config.face_tolerance_m)

    def _scan(self, real: LaserScanner, scene: RayCaster, random: KeyedRandom) -> Observation:
        """Scan in one face. real: the scanner in its real pose."""
        pulses, beam = self.emitted(self.emit(), random)
        if beam.records_several and self.config.faces == 2:
            raise InputError(
                "two faces cannot be measured in the mode multiple, because faces are averaged pulse by pulse",
                where="scanner.faces",
                allowed="1",
                remedy="set scanner.faces to 1, or choose another mode of beam_divergence",
            )
        echo = real.echo(scene, pulses, beam, beam.combine_echoes)
        seen = self._record(self.measured(pulses, echo, random), real)
        if echo.returns is None or not np.any(echo.returns.numpy() > 1):
            return seen
        return replace(seen, further=self._further(real, scene, random, seen, echo.returns))

    def emitted(self, pulses: Pulses, random: KeyedRandom) -> tuple[Pulses, Beam]:
        """Apply the errors of the beam's direction and width to pulses, before they are traced.

        pulses: nominal pulses. random: source of random numbers. Returns the pulses as they actually leave, and the beam with
        its width.
        """
        effects = self.model.chain()
        return apply_stage(effects, Stage.AIM, pulses, random), apply_stage(effects, Stage.FOOTPRINT, Beam(), random)

    def measured(self, pulses: Pulses, echo: Echo, random: KeyedRandom) -> Pulses:
        """Apply the errors of range, power and returns to pulses that have been traced.

        pulses: the pulses as they left. echo: their echoes. random: source of random numbers. Returns the pulses with recorded
        ranges.
        """
        pulses = replace(
            pulses,
            true_range=echo.range_m,
            range_m=echo.range_m,
            cos_incidence=echo.cos_incidence,
            albedo=echo.albedo,
            power=echo.power,
            block=echo.block,
            returned=echo.returned,
            minimum_range=dr.opaque(mi.Float64, self.config.minimum_range_m),
        )
        for stage in (Stage.RANGE, Stage.POWER, Stage.RETURN):
            pulses = apply_stage(self.model.chain(), stage, pulses, random)
        return pulses

    @property
    def shape(self) -> tuple[int, int]:
        """(lines, pulses per line), the shape of an observation's arrays."""
        return self.pattern.lines, self.pattern.pulses

    def emit(self) -> Pulses:
        """Return all pulses of a scan with their nominal directions, line by line, before any error."""
        return self.pulses_at(dr.arange(mi.UInt32, self.pattern.lines * self.pattern.pulses))

    def pulses_at(self, index: mi.UInt32) -> Pulses:
        """Return some pulses of a scan with their nominal directions, before any error.

        index: (n,) numbers of the pulses, counted line by line.
        """
        pattern = self.pattern
        line = index // dr.opaque(mi.UInt32, pattern.pulses)
        pulse = index - line * dr.opaque(mi.UInt32, pattern.pulses)
        start_azimuth, step_azimuth, start_zenith, step_zenith = opaque(
            pattern.azimuth_start, pattern.azimuth_step, pattern.zenith_start, pattern.zenith_step
        )
        azimuth, zenith = start_azimuth + step_azimuth * mi.Float64(line), start_zenith + step_zenith * mi.Float64(pulse)
        return Pulses(
            line=line,
            share=mi.Float64(index) / dr.opaque(mi.Float64, max(pattern.lines * pattern.pulses - 1, 1)),
            line_key=line + _grid_number(pattern.azimuth_start, pattern.azimuth_step),
            pulse_key=pulse + _grid_number(pattern.zenith_start, pattern.zenith_step),
            azimuth=azimuth,
            zenith=zenith,
            aim_azimuth=azimuth,
            aim_zenith=zenith,
        )

    def echo(self, scene: RayCaster, pulses: Pulses, beam: Beam, merge: Callable[[SubRays], Echo]) -> Echo:
        """Ray-trace the emitted beams and return the echo of each pulse.

        Pulses and echoes are held in memory before and after, so that one compiled kernel serves whatever errors are simulated.

        Parameters
        ----------
        scene : RayCaster
            The wall, wall frame.
        pulses : Pulses
            The pulses as they leave.
        beam : Beam
            The cross section of the beam.
        merge : callable
            Combines the echoes of each pulse's sub-rays into one.
        """
        dr.eval(pulses.aim_azimuth, pulses.aim_zenith)
        count, parts = dr.width(pulses.aim_azimuth, pulses.aim_zenith), []
        step = count if beam.sub_rays == 1 else _RAYS_AT_ONCE // beam.sub_rays
        for start in range(0, count, step):
            echo = merge(self._sub_ray_echoes(scene, pulses, beam, start, min(step, count - start)))
            dr.eval(echo)
            parts.append(echo)
        return Echo.joined(parts)

    def _sub_ray_echoes(self, scene: RayCaster, pulses: Pulses, beam: Beam, start: int, count: int) -> SubRays:
        """Return the echoes of all sub-rays of `count` pulses from number `start` on.

        The rays of one pulse are traced together: they are neighbours, which is several times as fast as one ray per pulse.
        """
        ray, many = dr.arange(mi.UInt32, count * beam.sub_rays), dr.opaque(mi.UInt32, beam.sub_rays)
        own = ray // many
        axis, *across = self._axes(pulses, start, count)
        if beam.sub_rays > 1:
            dr.eval(axis, across)
            axis, *across = (dr.gather(mi.Array3f64, vectors, own) for vectors in (axis, *across))
        echoes = self._traced(scene, beam.sub_ray(axis, across, ray - own * many))
        dr.eval(echoes)
        return SubRays(echoes, beam.sub_rays)

    def _axes(self, pulses: Pulses, start: int, count: int) -> tuple[mi.Array3f64, ...]:
        """Return unit vectors along the beams, and two perpendicular to each; wall frame.

        The beams are those of `count` pulses from number `start` on.
        """
        pulse = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, start)
        azimuth, zenith = (dr.gather(mi.Float64, angle, pulse) for angle in (pulses.aim_azimuth, pulses.aim_zenith))
        vectors = direction(azimuth, zenith), *tangents(azimuth, zenith)
        return tuple(rotated(self.rotation, each) for each in vectors)

    def _traced(self, scene: RayCaster, ray: mi.Array3f64) -> Echo:
        """Trace rays along unit vectors. The power follows the lidar range equation, rho cos i / R^2 exp(-2 sigma R)."""
        hits = scene.intersect(vector(self.position), ray, exact=True)
        cos_incidence = -dr.dot(hits.normal, mi.Vector3f(ray))
        power = hits.albedo * cos_incidence * dr.square(REFERENCE_RANGE_M / mi.Float32(hits.distance))
        power *= dr.exp(dr.opaque(mi.Float32, -2 * self.config.extinction_per_m) * mi.Float32(hits.distance))
        nearest, farthest = opaque(self.config.minimum_range_m, self.config.maximum_range_m)
        in_reach = (hits.distance >= nearest) & (hits.distance <= farthest)
        returned = hits.valid & (cos_incidence > 0) & in_reach
        return Echo(hits.distance, cos_incidence, hits.albedo, power, hits.block, returned)

    def _record(self, pulses: Pulses, real: LaserScanner) -> Observation:
        """Make the observation of the scan's grid. real: the scanner in its real pose."""
        shape = self.shape
        found = self._recorded(pulses, real)
        if np.isnan(found.depth).all():
            raise InputError(
                "no pulse of the scanner returned from the wall",
                where="station, scanner",
                remedy="turn the station towards the wall, widen the scanner's window or range limits, or "
                "remove effects that lose returns",
            )
        return Observation(
            sensor="tls",
            points=found.points.reshape(*shape, 3),
            depth=found.depth.reshape(shape),
            block=found.block.reshape(shape),
            viewpoint=self.position,
            intensity=found.intensity.reshape(shape),
            pulse_interval_s=1.0 / self.config.pulse_rate_hz,
            truth={name: channel.reshape(shape) for name, channel in found.truth.items()},
            zenith_rad=self.pattern.zenith_start + self.pattern.zenith_step * np.arange(self.pattern.pulses, dtype=np.float64),
            offset=found.offset.reshape(*shape, 2),
        )

    def _recorded(self, pulses: Pulses, real: LaserScanner) -> RecordedReturns:
        """Compute points from the nominal direction and the recorded range; NaN and WALL where nothing returned.

        real: the scanner in its real pose.
        """
        returned = pulses.returned
        range_m = dr.select(returned, pulses.range_m, np.nan)
        nominal = rotated(self.rotation, direction(pulses.azimuth, pulses.zenith))
        point = vector(self.position) + range_m * nominal
        aimed = rotated(real.rotation, direction(pulses.aim_azimuth, pulses.aim_zenith))
        offset = offset_of(point, vector(real.position) + pulses.true_range * aimed)
        points = packed(point)
        power = dr.select(returned, pulses.power, np.nan)
        block = dr.select(returned, pulses.block, WALL)
        channels = {"true_range_m": pulses.true_range, "cos_incidence": pulses.cos_incidence} if self.truth else {}
        truth = {name: dr.select(returned, channel, np.nan) for name, channel in channels.items()}
        dr.eval(points, offset, range_m, power, block, truth)
        return RecordedReturns(
            points=points.numpy().reshape(-1, 3),
            offset=offset.numpy().reshape(-1, 2),
            depth=range_m.numpy(),
            intensity=power.numpy(),
            block=block.numpy(),
            truth={name: channel.numpy() for name, channel in truth.items()},
        )

    def _further(
        self, real: LaserScanner, scene: RayCaster, random: KeyedRandom, seen: Observation, count: mi.UInt32
    ) -> FurtherReturns:
        """Find the returns beyond those in the grid, for pulses with `count` returns.

        Each return number is traced again for the few pulses that have it. Every return has its own noise. An effect that
        compares a pulse with the whole scan compares it with the returns of the same number.
        """
        found, emitted = [], self.emit().evaluated()
        for number in range(1, min(int(count.numpy().max()), MOST_RETURNS) + 1):
            index = dr.compress(count >= max(number, 2))
            pulses, beam = self.emitted(emitted.at(index), random)
            echo = real.echo(scene, pulses, beam, partial(beam.return_of_number, number=dr.opaque(mi.UInt32, number)))
            recorded = self._recorded(self.measured(pulses, echo, random.child("return", number)), real)
            found.append((index.numpy().astype(np.int64), np.array(echo.strongest, dtype=bool), recorded))
        return further_returns(found, seen)


def _grid_number(start: float, step: float) -> mi.UInt32:
    """Return the number of a pattern's first line or pulse on the grid of multiples of `step`.

    A start between two multiples belongs to the lower one up to a share (0.618) that no simple fraction equals, so that
    rounding errors do not decide.
    """
    return dr.opaque(mi.UInt32, int(np.floor(start / step + 0.381966)) % 2**32)


def _extent(vertices: FloatArray, position: FloatArray, rotation: FloatArray) -> tuple[Window, Window]:
    """Return the windows in azimuth and zenith, rad, that contain all vertices."""
    middle_x, middle_y, _ = (vertices.mean(axis=0) - position) @ rotation
    middle = float(np.arctan2(middle_y, middle_x))
    turn = rotation @ axis_rotation(2, middle)  # measure azimuths from the mean direction, away from the cut at pi
    parts = [vertices[start : start + _CHUNK] for start in range(0, len(vertices), _CHUNK)]
    limits = np.array(map_in_threads(lambda part: _angles((part - position) @ turn), parts))
    low, high = limits[:, :, 0].min(axis=0), limits[:, :, 1].max(axis=0)
    return (middle + float(low[0]), middle + float(high[0])), (float(low[1]), float(high[1]))


_CHUNK = 1 << 14
"""Number of vertices processed at a time; their arrays then stay in the processor's cache."""


def _angles(local: FloatArray) -> list[list[float]]:
    """Return smallest and largest azimuth, then zenith, rad, of points (n, 3) in the scanner's frame."""
    _, *angles = polar(local)
    return [[angle.min(), angle.max()] for angle in angles]


def _padded(window: Window, step: float) -> Window:
    """Extend a window by one step on both sides."""
    return window[0] - step, window[1] + step
