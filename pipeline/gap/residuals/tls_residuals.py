"""Compute the range residuals of a laser scan: each recorded direction is traced to the reference surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.config import ScanPattern
from pipeline.formats.measurements.measurement import TlsMeasurement
from pipeline.gap.residuals.ray_hits import RayGeometry, cast_rays, redirect_hits
from pipeline.gap.residuals.residuals import BoolArray, ExpectedPulses, Residuals, range_derivative
from pipeline.gap.residuals.scan_simulation import mean_beam_directions, predict_ranges
from pipeline.gap.thresholds import thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Stage
from sensors.effects.range_empirical import RangeEmpirical
from sensors.effects.range_noise import RangeNoise
from sensors.models.sensor_model import TlsModel
from sensors.signal_chain.polar import polar, polar_axes

_EDGE_SIGMAS = 3.0
"""A surface that deviates from its triangle's plane by more sigmas within a beam's width counts as an edge."""
_LARGEST_SLOPE = 4.0
"""Change of range per metre across the ray beyond which a point counts as grazing."""
_SHORTEST_STEP_RAD = 1e-6
"""Smallest gap between azimuths that separates two scan lines, rad."""
_LEAST_POWER = 1e-9
"""Smallest relative received power: files round small ones to 0, which has no logarithm."""


@dataclass(frozen=True)
class TlsResiduals(Residuals):
    """Residuals of a laser scan: measured minus predicted ranges, m. See `Residuals` for the other attributes.

    Attributes
    ----------
    reference_error_m : Standard deviation along the rays of the errors of the reference surface's vertices, m. Each vertex has
        an error of its own. 0: the vertices have no such errors.
    error_is_relief : Whether these errors stand mostly for relief between the vertices. They are then independent from ray to
        ray. Otherwise rays that hit neighbouring triangles share the errors of common vertices.
    """

    sensor = "tls"
    position_covariates = ("azimuth", "zenith")
    empirical_term = RangeEmpirical, "values_m"
    white_noise = RangeNoise, "sigma_m"
    label = "ranges of a laser scan"
    geometry: RayGeometry
    reference_error_m: float = 0.0
    error_is_relief: bool = False

    @property
    def reference_variance(self) -> FloatArray:
        """(n,) part of the ranges' variance due to errors of the reference surface's vertices, m²; 0 without such errors."""
        return _reference_variance(self.reference_error_m, self.geometry)

    @property
    def with_sigma_of_means(self) -> Self:
        """Return the residuals with a `sigma` that is right for means over many neighbouring points (see `Residuals`).

        The sigma of single points would be too small: neighbouring rays hit triangles of the reference with common vertices, and
        the errors of these vertices do not average out.
        """
        corner, weight = self.geometry.corner, self.geometry.weight
        if not self.reference_error_m or self.error_is_relief or corner is None or weight is None:
            return self
        shared = np.sum(weight * np.bincount(corner.ravel(), weight.ravel())[corner], axis=1)
        variance = self.sigma**2 - self.reference_variance + self.reference_error_m**2 * shared
        return replace(self, sigma=np.sqrt(variance))

    def reference_covariance_with(self, other: NDArray[np.int64]) -> FloatArray:
        """Return the covariance (n,), m², of each ray's residual with that of another ray, `other` (n,) (see `Residuals`).

        Rays share errors of the reference if they hit triangles with common vertices.
        """
        corner, weight = self.geometry.corner, self.geometry.weight
        if not self.reference_error_m or corner is None or weight is None:
            return super().reference_covariance_with(other)
        same = corner[:, :, None] == corner[other][:, None]
        return np.asarray(self.reference_error_m**2 * np.einsum("nab,na,nb->n", same, weight, weight[other]))

    def draw_reference_error(self, random: KeyedRandom) -> FloatArray:
        """Draw random errors of the reference surface's vertices, and return the (n,) range errors that they cause, m.

        They are added to simulated ranges. random: source of the random numbers.
        """
        corner, weight = self.geometry.corner, self.geometry.weight
        if not self.reference_error_m or corner is None or weight is None:
            return np.zeros(len(self))
        if self.error_is_relief:
            return np.asarray(np.sqrt(self.reference_variance) * random.generator().standard_normal(len(self)))
        errors = self.reference_error_m * random.generator().standard_normal(int(corner.max(initial=0)) + 1)
        return np.asarray(np.sum(weight * errors[corner], axis=1))

    @property
    def depth_m(self) -> FloatArray:
        """(n,) change of depth per metre of range: 1, because a longer range means that rock is missing."""
        return self.unit_m


def tls_residuals(measurement: TlsMeasurement) -> TlsResiduals:
    """Compute the residuals of one laser scan: measured ranges minus those that reference surface and sensor model predict.

    They come with predicted standard deviations, covariates and the derivatives by the pose. Points whose ray misses the
    reference are left out.
    """
    (position, rotation), model = measurement.station, measurement.model
    azimuth, zenith, measured = recorded_polar(measurement)
    line, share = measurement.order or _scan_order(measurement, azimuth)
    intensity = measurement.cloud.intensity
    real = azimuth, zenith
    if any(effect.stage == Stage.AIM for effect in model.effects):
        real = mean_beam_directions(measurement, RayGeometry(azimuth, zenith, line=line, share=share, power=intensity))
    axes = [np.einsum("ij,nj->ni", rotation, vectors) for vectors in polar_axes(*real)]
    along_planes = measurement.planes is not None and measurement.planes.noise_dominates
    if along_planes:
        nominal = [np.einsum("ij,nj->ni", rotation, vectors) for vectors in polar_axes(azimuth, zenith)]
        seen = redirect_hits(cast_rays(measurement, nominal), nominal[0], axes[0])
    else:
        seen = cast_rays(measurement, axes)
    distance, normal = seen.distance, seen.normal
    geometry = RayGeometry(
        azimuth=azimuth,
        zenith=zenith,
        range_m=distance,
        measured_m=measured,
        bulge_m=seen.bulge,
        corner=seen.corner,
        weight=seen.weight,
        plane_normal=normal @ rotation if along_planes else None,
        by_azimuth=range_derivative(normal, axes[0], axes[1], distance) * np.sin(zenith),
        by_zenith=range_derivative(normal, axes[0], axes[2], distance),
        cos_incidence=seen.cos_incidence,
        line=line,
        share=share,
        power=None if intensity is None else np.maximum(intensity, _LEAST_POWER),
    )
    predicted = predict_ranges(measurement, geometry) if model.effects else distance
    if measurement.error_like_scanner and geometry.weight is not None:
        geometry = replace(geometry, weight=geometry.weight * _relative_noise(model, geometry)[:, None])
    sigma = np.sqrt(model.variance(geometry) + _reference_variance(measurement.reference_error_m, geometry))
    slope = np.hypot(geometry.by_azimuth / np.sin(zenith), geometry.by_zenith) / distance
    hit = np.isfinite(predicted) & np.isfinite(distance)
    flat = (seen.curvature < np.maximum(_EDGE_SIGMAS * sigma, 0.01)) & (slope < _LARGEST_SLOPE)
    if seen.scatter is not None:
        flat &= seen.scatter < thresholds().points.most_reference_scatter
    whole = TlsResiduals(
        value=measured - predicted,
        sigma=sigma,
        unit_m=np.ones_like(measured),
        usable=hit & flat & measurement.stable,
        on_smooth_surface=hit & flat,
        pose_jacobian=_pose_jacobian(axes[0], normal, distance),
        wall_xy=(position + distance[:, None] * axes[0])[:, :2],
        covariates=_covariates(geometry, seen.curvature),
        index=np.arange(len(measured)),
        geometry=geometry,
        notes=_notes(measurement),
        reference_error_m=measurement.reference_error_m,
        error_is_relief=measurement.error_is_relief,
    )
    return whole.part(hit)


def _relative_noise(model: TlsModel, geometry: RayGeometry) -> FloatArray:
    """(n,) standard deviation of a range by the model's noise, relative to its median: larger on steep and distant rock."""
    sigma = np.sqrt(model.model_copy(update={"effects": ()}).variance(geometry))
    return np.asarray(np.nan_to_num(sigma / np.nanmedian(sigma), nan=1.0))


def _reference_variance(error_m: float, geometry: RayGeometry) -> FloatArray:
    """(n,) variance of the ranges by independent errors of the reference's vertices, m²."""
    if not error_m or geometry.weight is None:
        return np.zeros(len(geometry))
    return np.asarray(error_m**2 * np.sum(geometry.weight**2, axis=1))


def with_scan_order(measurement: TlsMeasurement) -> TlsMeasurement:
    """Find the scan line and the time of each point of a laser scan, and return the scan with both stored.

    Some errors depend on them. Call it before the scan is subsampled: a subsample has gaps from which they could not be
    recovered. Times are shares of the scan's duration, from 0 to 1.
    """
    if measurement.scans:
        found = [(rows, with_scan_order(one).order or (None, None)) for _, rows, one in measurement.each_scan() if len(rows)]
        line, share = (_assembled([(rows, order[which]) for rows, order in found], len(measurement.scan_of)) for which in (0, 1))
        return measurement.changed(order=(line, share))
    return measurement.changed(order=_scan_order(measurement, recorded_polar(measurement)[0]))


def _assembled(parts: list[tuple[NDArray[np.int64], FloatArray | None]], count: int) -> FloatArray | None:
    """(count,) values assembled from (rows, values) of each scan; None if one scan has no values."""
    found = np.zeros(count)
    for rows, values in parts:
        if values is None:
            return None
        found[rows] = values
    return found


def recorded_polar(measurement: TlsMeasurement) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what the scanner recorded for n points: azimuth without jumps by 2 π, zenith angle, and range, (n,) each.

    Angles are in rad in the scanner frame, ranges in m. Angles follow the face in which the instrument measured: in face 2 the
    zenith angle is 2 π minus that of face 1, and the azimuth is larger by π.
    """
    position, rotation = measurement.station
    local = np.einsum("ji,nj->ni", rotation, measurement.cloud.points - position)
    measured, azimuth, zenith = polar(local)
    middle = np.angle(np.mean(np.exp(1j * azimuth)))  # whichever side of pi the points lie on
    around = middle + np.angle(np.exp(1j * (azimuth - middle)))
    return (around, zenith, measured) if measurement.face == 1 else (around + np.pi, 2 * np.pi - zenith, measured)


def _pose_jacobian(ray: FloatArray, normal: FloatArray, distance: FloatArray) -> FloatArray:
    """(n, 6) pose Jacobian of measured minus predicted range: shift (m) and rotation (rad) of the scanner from the survey.

    The true ray starts at o + t with direction u + w x u, so dR = -n·t / (n·u) - R n·(w x u) / (n·u).
    """
    scale = -1 / np.einsum("ni,ni->n", ray, normal)[:, None]
    return np.concatenate([normal * scale, distance[:, None] * np.cross(ray, normal) * scale], axis=1)


def _scan_order(measurement: TlsMeasurement, azimuth: FloatArray) -> tuple[FloatArray | None, FloatArray | None]:
    """Scan line and share of the scan's duration of each point, each (n,) or None.

    Lines come from the pattern, else from the channel `line`, else from gaps between azimuths; shares come from times, else
    lines.
    """
    stated = measurement.cloud.extra.get("line")
    known = measurement.pattern is None and stated is not None and bool(np.isfinite(stated).all())
    line = np.asarray(stated, dtype=np.float64) if known else _scan_lines(measurement.pattern, azimuth)
    time = measurement.cloud.gps_time
    if time is not None and np.ptp(time) > 0:
        return line, _shares_of_duration(time, measurement.epochs)
    return line, None if line is None or np.ptp(line) == 0 else (line - line.min()) / np.ptp(line)


def _shares_of_duration(time: FloatArray, epochs: NDArray[np.int64]) -> FloatArray:
    """(n,) share of its epoch's duration that had passed at each point, from 0 to 1."""
    first, last = np.full(epochs.max() + 1, np.inf), np.full(epochs.max() + 1, -np.inf)
    np.minimum.at(first, epochs, time)
    np.maximum.at(last, epochs, time)
    return np.asarray((time - first[epochs]) / np.maximum(last - first, 1e-300)[epochs])


def _scan_lines(pattern: ScanPattern | None, azimuth: FloatArray) -> FloatArray | None:
    """(n,) scan line of each azimuth; None if the azimuths lie on no raster."""
    if pattern is not None:
        return _line_number(pattern, azimuth)
    gaps = np.diff(np.sort(azimuth))
    wide = gaps[gaps > _SHORTEST_STEP_RAD]
    if len(wide) < 10 or len(wide) > 0.2 * len(azimuth):
        return None  # the azimuths lie on no raster
    return np.asarray(np.rint((azimuth - azimuth.min()) / np.median(wide)), dtype=np.float64)


def _covariates(geometry: RayGeometry, curvature: FloatArray) -> dict[str, FloatArray]:
    """The covariates of a range by name; log intensity over its median, line and time only where they were recorded."""
    found = {
        "range": geometry.range_m,
        "azimuth": geometry.azimuth,
        "zenith": geometry.zenith,
        "incidence": np.arccos(np.clip(geometry.cos_incidence, 0, 1)),
        "edge_step": np.minimum(curvature, 10.0),
    }
    optional = {
        "intensity": None if geometry.power is None else np.log(geometry.power / np.median(geometry.power)).astype(np.float64),
        "line": geometry.line,
        "time": geometry.share,
    }
    return found | {name: values for name, values in optional.items() if values is not None}


def _notes(measurement: TlsMeasurement) -> tuple[str, ...]:
    """Notes that name the candidates which were left out because a field was not recorded."""
    cloud = measurement.cloud
    absent = {
        "no intensity: range_intensity_bias and range_noise_intensity were not tested": cloud.intensity is None,
        "no gps_time: times were estimated from the scan lines": cloud.gps_time is None,
        "the reference's points have noise: beam_divergence was not tested": measurement.reference_error_m > 0
        and not measurement.error_is_relief,
        "no pattern: missing returns (detection_limit, precipitation) were not tested": measurement.pattern is None,
    }
    return (*measurement.notes, *(note for note, true in absent.items() if true))


def find_expected_pulses(measurement: TlsMeasurement, residuals: TlsResiduals) -> ExpectedPulses | None:
    """List every pulse of the scan pattern that should hit the wall, and whether it returned, to explain lost returns.

    measurement: the scan, with its pattern of nominal directions. residuals: residuals of all its points. Returns the pulses,
    epoch after epoch; None if the pattern is not known.
    """
    pattern = measurement.pattern
    if pattern is None:
        return None
    position, rotation = measurement.station
    sweeps = _sweeps(pattern)
    sent = np.arange(pulse_count(pattern)) if measurement.pulses is None else np.flatnonzero(measurement.pulses)
    azimuth, zenith = (sweep[place] for sweep, place in zip(sweeps, np.divmod(sent, len(sweeps[1])), strict=True))
    axes = [np.einsum("ij,nj->ni", rotation, vectors) for vectors in polar_axes(azimuth, zenith)]
    seen_by = cast_rays(measurement, axes)
    distance = seen_by.distance
    usable = np.isfinite(distance) & (seen_by.curvature < 0.3)
    covariates = {
        "range": distance,
        "incidence": np.arccos(np.clip(seen_by.cos_incidence, 0, 1)),
        "log_power": np.log(np.maximum(seen_by.cos_incidence, 1e-6) * (100.0 / distance) ** 2),
        "azimuth": azimuth,
        "zenith": zenith,
    }
    at = (position + distance[:, None] * axes[0])[:, :2]
    epochs = measurement.epochs[residuals.index]
    seen = [_returned(pattern, residuals.geometry.part(epochs == number))[sent[usable]] for number in np.unique(epochs)]
    chosen = {name: np.tile(values[usable], len(seen)) for name, values in covariates.items()}
    return ExpectedPulses(~np.concatenate(seen), chosen, np.tile(at[usable], (len(seen), 1)))


def pulse_count(pattern: ScanPattern) -> int:
    """Return the number of pulses of a scan pattern, to know how many returns to expect: scan lines times pulses in a line."""
    lines, pulses = _sweeps(pattern)
    return len(lines) * len(pulses)


def pulse_number(pattern: ScanPattern, azimuth: FloatArray, zenith: FloatArray) -> NDArray[np.int64]:
    """Find the pulse of the scan pattern whose nominal direction is nearest to each recorded one, to detect lost returns.

    azimuth, zenith: (n,) recorded directions, rad, scanner frame. Returns the numbers (n,) of the pulses, counted from 0, scan
    line (azimuth) by scan line.
    """
    sweeps, (start, _, step) = _sweeps(pattern), pattern.zenith_rad
    columns = _line_number(pattern, azimuth), np.rint((zenith - start) / step)
    line, pulse = (np.clip(column, 0, len(sweep) - 1).astype(np.int64) for column, sweep in zip(columns, sweeps, strict=True))
    return np.asarray(line * len(sweeps[1]) + pulse)


def _line_number(pattern: ScanPattern, azimuth: FloatArray) -> FloatArray:
    """(n,) number of the scan line that is nearest to each azimuth, which may differ by full turns from those of the pattern."""
    start, stop, step = pattern.azimuth_rad
    turn = 2 * np.pi * np.round((azimuth.mean() - start - (stop - start) / 2) / (2 * np.pi))
    return np.asarray(np.rint((azimuth - turn - start) / step), dtype=np.float64)


def _returned(pattern: ScanPattern, geometry: RayGeometry) -> BoolArray:
    """(m,) whether a point was recorded in the direction of each pulse of the pattern."""
    seen = np.zeros(pulse_count(pattern), dtype=bool)
    seen[pulse_number(pattern, geometry.azimuth, geometry.zenith)] = True
    return seen


def _sweeps(pattern: ScanPattern) -> list[FloatArray]:
    """Azimuths of the scan lines, and zenith angles of the pulses in a line, rad, from start to stop, inclusive."""
    ranges = (pattern.azimuth_rad, pattern.zenith_rad)
    counts = [int(np.floor((stop - start) / step + 1e-6)) + 1 for start, stop, step in ranges]
    return [start + step * np.arange(count, dtype=np.float64) for (start, _, step), count in zip(ranges, counts, strict=True)]
