"""Describe a survey before there are data: where the rays of each station or stereo pair would hit the wall.

The sensor simulation observes the wall without noise, on a subsample of its raster; the number of points of the whole survey
is kept with it. Further stations, a second face and further pairs are added in the same way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pipeline.config.simulation import SensorName, SimulationConfig
from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement, SurfaceMeasurement, TlsMeasurement
from pipeline.formats.point_cloud import PointCloud
from pipeline.gap.mean.candidates import Candidate
from pipeline.gap.mean.signatures import systematic_candidates
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.residuals.stereo_residuals import stereo_residuals
from pipeline.gap.residuals.tls_residuals import tls_residuals
from pipeline.run.site import prepare_site
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Camera, CameraPair
from sensors.effects.base import Sensor
from sensors.laser.tls import LaserScanner, ScannerConfig
from sensors.models.sensor_model import StereoModel, TlsModel, TlsNoise
from sensors.stereo.exchanged import pair_of
from sensors.stereo.stereo_pair import REDUCTION, Quality, StereoPair

_MOST_PULSES = 30_000
"""Most pulses or pixels of a view's subsample."""
_MOST_TRACED = 100_000
"""Least number of points of a measured pair from which its view is made. Larger pairs are thinned evenly, to save time."""
_FEWEST_POINTS = 300
"""Fewest points on smooth parts of the wall."""
_ALBEDO_SPREAD = 0.3
"""Standard deviation of ln(albedo) between points, for a wall without albedo."""
_QUIET_TLS = TlsModel(noise=TlsNoise(range_sigma_m=0.0, range_ppm=0.0, angle_sigma_rad=0.0))
"""Sensor models without noise or effects."""
_QUIET_STEREO = StereoModel(noise={"parallax_sigma_px": 0.0, "regularization_sigma_px": 0.0})
Pose = tuple[FloatArray, FloatArray]
"""Position (3,), m, and rotation (3, 3) from the scanner to the wall frame."""


@dataclass(frozen=True)
class SurveyView:
    """What one scanner station or one stereo pair, real or planned, sees of the wall.

    Precision is predicted from the geometry alone, so that a planned station needs no measured values. A subsample of the
    points is enough for this.

    Attributes
    ----------
    residuals : Geometry of n points, a subsample on smooth parts of the wall; the residual values have no meaning.
    point_count : Number of points on smooth parts in the full view.
    station : Number of the station or pair, from 0; views with the same number share a pose.
    measurement : A measurement that holds the pose of the station or the cameras of the pair. A planned station or pair has
        simulated points without noise.
    """

    residuals: Residuals
    point_count: int
    station: int
    measurement: TlsMeasurement | StereoMeasurement

    @classmethod
    def of(cls, found: Residuals, whole: int, number: int, measurement: TlsMeasurement | StereoMeasurement) -> SurveyView:
        """Make the view of one scanner station or stereo pair. Of a subsample of its points, those on smooth parts are kept.

        Parameters
        ----------
        found : Geometry of the subsample, as residuals whose values have no meaning.
        whole : Number of points of the full view, before the subsample was drawn.
        number, measurement : The fields `station` and `measurement`.

        Raises
        ------
        InputError
            If fewer than 300 points of the subsample lie on smooth parts of the wall.
        """
        smooth = np.flatnonzero(found.usable)
        if len(smooth) < _FEWEST_POINTS:
            raise InputError(
                f"only {len(smooth)} of {len(found)} points lie on smooth parts of the wall, {_FEWEST_POINTS} are needed",
                where="station" if found.sensor == "tls" else "cameras",
                remedy="turn the sensor towards the wall or move it closer; for a scanner, choose smaller angular steps",
            )
        return cls(found.part(smooth), int(whole * len(smooth) / len(found)), number, measurement)

    @classmethod
    def subsampled(cls, found: Residuals, most: int, number: int, measurement: TlsMeasurement | StereoMeasurement) -> SurveyView:
        """Make the view of a station or pair from all its points: about `most` points on smooth parts of the wall are kept."""
        smooth = np.flatnonzero(found.usable)
        return cls(found.part(smooth[:: max(len(smooth) // most, 1)]), len(smooth), number, measurement)

    @property
    def sigma(self) -> FloatArray:
        """(n,) standard deviations of the points of the subsample, m (ranges) or px (disparities), to predict precision.

        They are smaller than those of single points, so that the subsample has the weight of all points of the view.
        """
        return self.residuals.sigma * np.sqrt(len(self.residuals) / max(self.point_count, 1))

    @cached_property
    def signatures(self) -> list[Candidate]:
        """Signatures of all systematic effects: how each would change the observations, as regression terms.

        An effect with parameters that cannot be fitted, such as a camera or a period, is listed once for each trial value.
        """
        return systematic_candidates(self.residuals, self.measurement)

    def signature_columns(self, wanted: list[Candidate]) -> FloatArray:
        """Return the change (n, k) of the n observations, m or px, per unit of each of the k coefficients of given effects.

        wanted: the effects, each with one choice of what is not fitted, such as the camera or the period of a wave. Pass the
        same list for all stations of a survey, so that the columns of all have the same meaning.
        """
        own = {_key(each): each for each in self.signatures}
        found = [(variant, own[_key(variant)]) for variant in wanted]
        return np.concatenate(
            [each.columns if each.wave is None else each.wave.columns(variant.period) for variant, each in found], axis=1
        )


def _key(candidate: Candidate) -> tuple[Any, ...]:
    """Key that an effect has in every view of a survey: its name, fitted parameters and fixed values, without a sine's period."""
    fixed = {key: value for key, value in candidate.fixed.items() if candidate.wave is None or key != candidate.wave.key}
    return candidate.name, candidate.names, tuple(sorted(fixed.items(), key=str))


@dataclass(frozen=True)
class Survey:
    """A survey of one wall by one sensor, from which surveys with additional views can be made.

    Attributes
    ----------
    views : What each scanner station or stereo pair sees.
    centre : (3,) centre of the wall, wall frame, m.
    observe : Function that simulates a further view. Its arguments are a measurement with the pose of the station or the cameras
        of the pair, and the number to give to this pose.
    """

    views: tuple[SurveyView, ...]
    centre: FloatArray
    observe: Callable[[Any, int], SurveyView]

    @property
    def sensor(self) -> Sensor:
        """Kind of sensor, "tls" or "stereo"."""
        return self.views[0].residuals.sensor

    def moved(self, scale: float, turn_rad: float, number: int) -> SurveyView:
        """Simulate what the first station or pair would see from another place, to find out what a further view adds.

        scale: new distance from the wall's centre, relative to the present one. turn_rad: rotation of the sensor about the
        vertical through the wall's centre, rad. number: that of the new pose. Raises InputError if too little of the wall is seen
        from there.
        """
        base = self.views[0].measurement
        turn = _about_vertical(base, turn_rad)
        if isinstance(base, TlsMeasurement):
            position = self.centre + scale * turn @ (base.station[0] - self.centre)
            return self.observe(base.changed(station=(position, turn @ base.station[1])), number)
        world, middle = base.frame.rotation.T @ turn @ base.frame.rotation, base.frame.to_world(self.centre[None])[0]

        def place(camera: Camera) -> Camera:
            position = middle + scale * world @ (camera.position - middle)
            return replace(camera, position=position, rotation=world @ camera.rotation)

        pair = CameraPair(place(base.cameras.left), place(base.cameras.right))
        return self.observe(base.changed(cameras=pair), number)

    def repeated(self, number: int) -> tuple[str, SurveyView]:
        """Repeat the first view with the sensor set up in another way. Returns a description in words, and the view.

        A laser scanner scans from the same pose in its second face, in which azimuths are larger by pi and zenith angles z become
        2 pi - z. The cameras of a pair are rolled by 45 degrees in opposite directions; their new pose gets the given number.
        """
        first = self.views[0]
        if isinstance(first.measurement, StereoMeasurement):
            pair = first.measurement.cameras.rotated("left", 2, np.pi / 4).rotated("right", 2, -np.pi / 4)
            view = self.observe(first.measurement.changed(cameras=pair), number)
            return "the pair repeated with its cameras rolled by 45 degrees in opposite directions", view
        g: Any = first.residuals.geometry
        turned = replace(g, azimuth=g.azimuth + np.pi, zenith=2 * np.pi - g.zenith, by_zenith=-g.by_zenith)
        return "the scan repeated in the second face", replace(first, residuals=replace(first.residuals, geometry=turned))


def planned_survey(config: SimulationConfig, sensor: SensorName) -> Survey:
    """Simulate what the scanner stations or cameras of a config would see of the wall, to judge a survey before fieldwork.

    Raises InputError if the sensor sees too little of the wall.
    """
    site = prepare_site(config, sensor, KeyedRandom(config.seed))
    nothing, mesh, frame, centre = PointCloud(np.empty((0, 3))), site.mesh, site.frame, site.mesh.bounds.mean(axis=0)
    if not isinstance(site.sensor, LaserScanner):
        model, cameras = config.stereo_model(), pair_of(site.sensor).cameras
        pair = StereoMeasurement(cloud=nothing, reference=mesh, frame=frame, model=model, cameras=cameras)
        expose = _pair_observer(config.depth_map)
        return Survey((expose(pair, 0),), centre, expose)
    poses = [(scanner.position, scanner.rotation) for scanner in (site.sensor, *site.further_stations)]
    base = TlsMeasurement(cloud=nothing, reference=mesh, frame=frame, model=config.tls_model(), station=poses[0])
    observe = _scan_observer(config.scanner)
    views = tuple(observe(base.changed(station=pose), number) for number, pose in enumerate(poses))
    return Survey(views, centre, observe)


def measured_survey(measurement: Measurement, most: int = _MOST_PULSES) -> Survey:
    """Describe from where a measurement saw the wall, to find out which sensor effects it could detect and tell apart.

    Each scanner station, or the stereo pair, becomes one view. Only the positions of its points count, not their residuals.
    most: largest number of points in the subsample of each view. Raises InputError if the measurement has no cameras or station.
    """
    centre = measurement.reference.bounds.mean(axis=0)
    if isinstance(measurement, StereoMeasurement):
        every = max(len(measurement.cloud.points) // _MOST_TRACED, 1)
        some = measurement.part(np.arange(0, len(measurement.cloud.points), every))
        pair = SurveyView.subsampled(stereo_residuals(some), most, 0, measurement)
        return Survey((replace(pair, point_count=every * pair.point_count),), centre, _pair_observer("medium"))
    if isinstance(measurement, SurfaceMeasurement):
        raise InputError(
            "the measurement has no cameras, so no effect can be analysed",
            where="--identifiability",
            remedy="add `cameras` (cameras.yaml or a Metashape XML) to measurement.yaml",
        )
    measurement = measurement.changed(order=None)
    set_ups = [(scan.set_up, one) for scan, rows, one in measurement.each_scan() if len(rows)]
    found = [(number, one, tls_residuals(one)) for number, one in set_ups or [(0, measurement)]]
    views = tuple(SurveyView.subsampled(each, most, number, one) for number, one, each in found)
    _, first, residuals = found[0]
    step = float(np.sqrt(np.prod(np.ptp(first.cloud.points[:, :2], axis=0)) / max(views[0].point_count, 1)))
    step_rad = step / float(np.median(residuals.geometry.range_m))  # coarser than the scan on near parts
    update = {"azimuth_step_rad": step_rad, "zenith_step_rad": step_rad}
    scanner = ScannerConfig(zenith_limits_rad=(0.05, 3.09)).model_copy(update=update)
    return Survey(views, centre, _scan_observer(scanner))


def _scan_observer(scanner: ScannerConfig) -> Callable[[TlsMeasurement, int], SurveyView]:
    """Return a function that scans the wall from a measurement's pose: the whole wall, unless the config has a window."""

    def observe(base: TlsMeasurement, number: int) -> SurveyView:
        world = base.frame.to_world(base.station[0][None])[0], base.frame.rotation.T @ base.station[1]
        instrument = LaserScanner.aimed(world, base.frame, base.reference.vertices, scanner, _QUIET_TLS)
        pattern = instrument.pattern
        stride = max(int(np.sqrt(pattern.lines * pattern.pulses / _MOST_PULSES)), 1)
        subsampled = replace(
            pattern,
            azimuth_step=stride * pattern.azimuth_step,
            zenith_step=stride * pattern.zenith_step,
            lines=max(pattern.lines // stride, 1),
            pulses=max(pattern.pulses // stride, 1),
        )
        seen = replace(instrument, pattern=subsampled).observe(base.scene, KeyedRandom(0, ("gap", "planned")))
        valid = seen.valid.ravel()
        power = None if seen.intensity is None else seen.intensity.ravel()[valid].astype(np.float64)
        if power is not None and base.scene.mesh.vertex_albedo is None:
            random = KeyedRandom(0, ("gap", "albedo")).generator()
            power *= np.exp(_ALBEDO_SPREAD * random.standard_normal(len(power)))
        cloud = PointCloud(seen.points.reshape(-1, 3)[valid], power, np.flatnonzero(valid).astype(float))
        measurement = base.changed(cloud=cloud)
        found = tls_residuals(measurement)
        lines = found.geometry.line
        geometry = found.geometry if lines is None else replace(found.geometry, line=stride * lines)
        return SurveyView.of(replace(found, geometry=geometry), int(valid.sum()) * stride**2, number, measurement)

    return observe


def _pair_observer(quality: Quality) -> Callable[[StereoMeasurement, int], SurveyView]:
    """Return a function that observes the wall with a measurement's cameras, at the coarsest depth map."""

    def observe(base: StereoMeasurement, number: int) -> SurveyView:
        pair = StereoPair(base.cameras, base.frame, _QUIET_STEREO, "low")
        points = pair.observe(base.scene, KeyedRandom(0, ("gap", "planned"))).points
        step = REDUCTION["low"]
        stride = max(int(np.sqrt(points.shape[0] * points.shape[1] / _MOST_PULSES)), 1)
        rows, columns = np.mgrid[0 : points.shape[0] : stride, 0 : points.shape[1] : stride]
        some = points[rows, columns].reshape(-1, 3)
        valid = np.isfinite(some).all(axis=1)
        pixels = {"pixel_x": (columns.ravel() + 0.5) * step, "pixel_y": (rows.ravel() + 0.5) * step}
        cloud = PointCloud(some[valid], extra={name: values[valid] for name, values in pixels.items()})
        measurement = base.changed(cloud=cloud, matches=None, surroundings=None)
        whole = int(valid.sum() * stride**2 * (step / REDUCTION[quality]) ** 2)
        return SurveyView.of(stereo_residuals(measurement), whole, number, measurement)

    return observe


def _about_vertical(measurement: Measurement, angle: float) -> FloatArray:
    """(3, 3) rotation about the world's vertical, in the wall frame (Rodrigues)."""
    x, y, z = measurement.frame.rotation[:, 2]
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew)
