"""Define the measurement that `scarpsim gap` analyses (points, reference, instrument, sensor model), and read it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.change.areas import Area, check_some_inside, in_areas
from pipeline.formats.cameras.camera_files import read_oriented, stereo_pair
from pipeline.formats.cameras.cameras import read_cameras_yaml
from pipeline.formats.measurements.checks import (
    PointFit,
    check_different,
    check_frame,
    check_inside,
    check_near_rays,
    check_pixels,
    check_power,
    check_pulses,
    check_seen,
    check_sensor,
)
from pipeline.formats.measurements.config import MeasurementConfig, ScanPattern
from pipeline.formats.measurements.model_file import read_model
from pipeline.formats.measurements.reference_points import ReferencePoints
from pipeline.formats.measurements.rounded_points import check_rounded_points
from pipeline.formats.measurements.scanner_poses import Face, Pose, Scanned, ScannerPose, set_ups
from pipeline.formats.measurements.surface_datum import told_datum
from pipeline.formats.measurements.surface_fit import SurfaceFit, air_side, check_in_metres
from pipeline.formats.measurements.surroundings import Surroundings
from pipeline.formats.point_cloud import SCAN, PointCloud, joined
from pipeline.formats.points.finite import finite
from pipeline.formats.points.points import read_points
from pipeline.registration.rigid import rotation_matrix
from scene.common.config import load_yaml, parse
from scene.common.errors import InputError
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.geometry.point_planes import PointPlanes
from scene.meshes.cleaning import weld
from scene.meshes.winding import check_distances, orient_to_sensors
from scene.ray_casting.raycast import RayCaster
from scene.walls.imported import read_reference
from sensors.cameras.camera import Camera, CameraPair
from sensors.effects.base import Sensor
from sensors.models.sensor_model import StereoModel, TlsModel
from sensors.signal_chain.surface_places import ShapedSurface

FILE = "measurement.yaml"


@dataclass(frozen=True, kw_only=True)
class MeasurementBase(ABC):
    """Measured points, with the reference surface and the sensor model that predict them.

    Attributes
    ----------
    cloud, reference : The measured points and the reference surface, wall frame, m.
    frame : Transform between the world frame and the wall frame.
    model : The sensor model that is tested.
    stable_areas : Where the scene did not change, wall frame, m; empty: everywhere.
    notes : Sentences for the report.
    """

    sensor: ClassVar[Sensor]
    cloud: PointCloud
    reference: TriangleMesh
    frame: WallFrame
    model: TlsModel | StereoModel
    stable_areas: tuple[Area, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def epochs(self) -> NDArray[np.int64]:
        """(n,) number of the epoch in which each point was measured, from 0."""
        return np.asarray(self.cloud.extra.get("epoch", np.zeros(len(self.cloud.points))), dtype=np.int64)

    @property
    def stable(self) -> NDArray[np.bool_]:
        """(n,) whether each point is in an area where the scene is known not to have changed."""
        x, y = self.cloud.points[:, :2].T
        return in_areas(self.stable_areas, x, y) if self.stable_areas else np.ones(len(x), dtype=bool)

    @cached_property
    def scene(self) -> RayCaster:
        """The reference surface, wall frame, prepared for casting the sensor's rays on it."""
        return RayCaster(self.reference)

    @property
    @abstractmethod
    def viewpoint(self) -> FloatArray:
        """(3,) origin of the rays, wall frame, m: centre of the scanner or of the left camera."""

    @property
    def fit(self) -> PointFit:
        """How well the points fit the reference along the sensor's rays, to find a wrong frame, unit or pose."""
        return PointFit.of(self.cloud.points, self.viewpoint, self.scene, self.sensor)

    def check_near(self, where: str) -> None:
        """Raise InputError, naming the file `where`, if most points are so far from the reference that they show another wall."""
        check_near_rays(self.fit, where)

    def changed(self, **values: Any) -> Self:
        """Return a copy with new `values` of some fields, by name, such as points or cameras; the prepared ray caster is kept."""
        other = replace(self, **values)
        other.__dict__["scene"] = self.scene  # where cached_property keeps it
        return other

    def part(self, rows: NDArray[np.int64]) -> Self:
        """Return the measurement with only those points whose indices are in `rows`."""
        return self.changed(cloud=self.cloud.part(rows))

    def moved(self, pose: FloatArray) -> Self:
        """Return the measurement with points and sensor moved by pose (6,): shift, m, and rotation about the viewpoint, rad."""
        turn, centre = rotation_matrix(pose[3:]), self.viewpoint
        points = (self.cloud.points - centre) @ turn.T + centre + pose[:3]
        return self.changed(cloud=replace(self.cloud, points=points), **self._moved_sensor(turn, pose[:3]))

    @abstractmethod
    def _moved_sensor(self, turn: FloatArray, shift: FloatArray) -> dict[str, Any]:
        """Return the field with the sensor's pose after a rotation (3, 3) and a shift (3,), wall frame, m."""


@dataclass(frozen=True, kw_only=True)
class TlsMeasurement(MeasurementBase):
    """n points of one laser scan or several; the cloud's channels `scan` and `epoch` number each point's scan and time.

    Attributes
    ----------
    station, face : Pose of the first scan (scanner to wall frame), and the face of the instrument in which it was made.
    scans : Pose and face of each of several scans, in the order of their numbers; empty for one scan.
    pattern : Nominal directions of the pulses; None if unknown.
    pulses : (m,) mask of the m pulses of the pattern: true for those from which the points may come; None: all.
    order : (n,) scan line and (n,) elapsed share of the scan's duration of each point, if known.
    planes : Planes through the reference's vertices, to which incidence angles refer; None: its triangles.
    reference_error_m : Standard deviation of each vertex of the reference along the rays, m.
    error_is_relief : Whether that error is mostly relief between the vertices, which is independent from ray to ray.
    error_like_scanner : Whether that error is larger where the noise of the scanner is, as in a scan by the same scanner;
        `reference_error_m` is then its median.
    """

    sensor = "tls"
    model: TlsModel
    station: Pose
    face: Face = 1
    scans: tuple[Scanned, ...] = ()
    pattern: ScanPattern | None = None
    pulses: NDArray[np.bool_] | None = None
    order: tuple[FloatArray | None, FloatArray | None] | None = None
    planes: PointPlanes | None = None
    reference_error_m: float = 0.0
    error_is_relief: bool = False
    error_like_scanner: bool = False

    @property
    def viewpoint(self) -> FloatArray:
        """Position (3,) of the scanner in the first scan, wall frame, m."""
        return self.station[0]

    @property
    def scan_of(self) -> NDArray[np.int64]:
        """(n,) number of the laser scan in which each point was measured, from 0."""
        return np.asarray(self.cloud.extra.get(SCAN, np.zeros(len(self.cloud.points))), dtype=np.int64)

    def each_scan(self) -> Iterator[tuple[Scanned, NDArray[np.int64], Self]]:
        """Yield each of several scans (nothing for one): its pose, its points' indices, and a measurement of these alone."""
        for number, scan in enumerate(self.scans):
            rows = np.flatnonzero(self.scan_of == number)
            yield scan, rows, self.part(rows).changed(station=scan.pose, face=scan.face, scans=())

    @property
    def fit(self) -> PointFit:
        """How well the points fit the reference along the sensor's rays; of several scans, the fit of the worst one."""
        several = self.each_scan()
        fits = [PointFit.of(one.cloud.points, one.viewpoint, self.scene, self.sensor) for _, rows, one in several if len(rows)]
        return min(fits, key=lambda each: (each.good, each.near)) if fits else super().fit

    def moved(self, pose: FloatArray) -> Self:
        """Return the measurement with each of k set-ups moved; pose (6 k,): shifts, m, and rotations about each scanner, rad."""
        if not self.scans:
            return super().moved(pose)
        points, scans = self.cloud.points.copy(), []
        for scan, rows, one in self.each_scan():
            there = one.moved(pose[6 * scan.set_up : 6 * scan.set_up + 6])
            points[rows] = there.cloud.points
            scans.append(replace(scan, pose=there.station))
        return self.changed(cloud=replace(self.cloud, points=points), scans=tuple(scans), station=scans[0].pose)

    def part(self, rows: NDArray[np.int64]) -> Self:
        """Return the measurement with only the points whose indices are in `rows`, and their scan lines and times."""
        line, share = (None if values is None else values[rows] for values in self.order or (None, None))
        return super().part(rows).changed(order=self.order and (line, share))

    def _moved_sensor(self, turn: FloatArray, shift: FloatArray) -> dict[str, Any]:
        position, rotation = self.station
        return {"station": (position + shift, turn @ rotation)}


@dataclass(frozen=True, kw_only=True)
class StereoMeasurement(MeasurementBase):
    """n points that were measured by a stereo pair with known cameras.

    Attributes
    ----------
    cameras : Nominal calibration and poses, world frame.
    matches : (n, 3) column and row of each point in the left image, and its disparity, px; None if not computed.
    shaped_px : (n,) change of each point's disparity, px, by effects that depend on neighbouring pixels, such as smoothing.
        Like `surroundings`, it holds for poses close to the present ones, and is None if it was not computed.
    surroundings : What the cameras see around each point.
    """

    sensor = "stereo"
    model: StereoModel
    cameras: CameraPair
    matches: FloatArray | None = None
    shaped_px: FloatArray | None = None
    surroundings: Surroundings | None = None

    def part(self, rows: NDArray[np.int64]) -> Self:
        """Return the measurement with only the points whose indices are in `rows`, and what the cameras see around them."""
        matches, shaped = (None if values is None else values[rows] for values in (self.matches, self.shaped_px))
        surroundings = self.surroundings and self.surroundings.part(rows)
        return super().part(rows).changed(matches=matches, shaped_px=shaped, surroundings=surroundings)

    @property
    def viewpoint(self) -> FloatArray:
        """Position (3,) of the left camera, wall frame, m."""
        return self.frame.to_wall(self.cameras.left.position)

    def _moved_sensor(self, turn: FloatArray, shift: FloatArray) -> dict[str, Any]:
        axes = self.frame.rotation
        world, along = axes.T @ turn @ axes, axes.T @ shift
        left = self.cameras.left.position

        def each(camera: Camera) -> Camera:
            return replace(camera, rotation=world @ camera.rotation, position=left + world @ (camera.position - left) + along)

        return {"cameras": CameraPair(each(self.cameras.left), each(self.cameras.right))}


@dataclass(frozen=True, kw_only=True)
class SurfaceMeasurement(MeasurementBase):
    """A surface from photographs with unknown cameras: points with noise in metres, up to shift, rotation and scale (datum)."""

    sensor = "stereo"
    model: StereoModel

    @property
    def centre(self) -> FloatArray:
        """(3,) middle of the reference surface, about which the measured points are rotated and scaled, wall frame, m."""
        return np.asarray(self.reference.bounds.mean(axis=0))

    @property
    def viewpoint(self) -> FloatArray:
        """(3,) a place in front of the wall, m, which only says on which side it is seen; nothing was observed from there."""
        away = 2 * float(np.linalg.norm(np.ptp(self.reference.bounds, axis=0)))
        return np.asarray(self.centre + np.array([0.0, 0.0, away]))

    @cached_property
    def shape(self) -> ShapedSurface:
        """The reference surface with normal, roughness and convexity at each vertex, on which errors of such points depend."""
        return ShapedSurface(self.reference)

    @cached_property
    def datum(self) -> FloatArray:
        """(7, k) combinations of 3 shifts, m, 3 rotations, rad, and scale that a comparison with the reference can determine."""
        vertices = np.arange(len(self.reference.vertices))
        return told_datum(self.reference.vertices - self.centre, self.shape.normals(vertices))

    @property
    def surface_fit(self) -> SurfaceFit:
        """How well the measured points fit the reference surface, by the distances of a subsample to its nearest vertices."""
        return SurfaceFit.of(self.cloud.points, self.reference)

    def check_near(self, where: str) -> None:
        """Raise InputError, naming the file `where`, if most points are too far from the reference surface."""
        self.surface_fit.check(where)

    def changed(self, **values: Any) -> Self:
        """Return a copy with new `values` of some fields, by name, such as points; what the reference determines is kept."""
        other = super().changed(**values)
        other.__dict__["shape"], other.__dict__["datum"] = self.shape, self.datum
        return other

    def moved(self, pose: FloatArray) -> Self:
        """Shift (m), rotate (rad) and scale the points about `centre`; pose (k,): a factor for each column of `datum`."""
        whole = self.datum @ pose
        turn = (1 + whole[6]) * rotation_matrix(whole[3:6])
        points = (self.cloud.points - self.centre) @ turn.T + self.centre + whole[:3]
        return self.changed(cloud=replace(self.cloud, points=points))

    def _moved_sensor(self, turn: FloatArray, shift: FloatArray) -> dict[str, Any]:
        return {}


Measurement = TlsMeasurement | StereoMeasurement | SurfaceMeasurement


@dataclass(frozen=True)
class Material:
    """The parts of a measurement in memory, from which `assembled` makes the measurement.

    Attributes
    ----------
    reference : The reference surface, world frame, m.
    points : Point clouds by file name, one for each epoch, in the frame that the config states.
    model : The sensor model.
    cameras : The stereo pair, world frame; None if there is none or it is unknown.
    notes : Notes on the reference for the report.
    """

    reference: TriangleMesh
    points: dict[str, PointCloud]
    model: TlsModel | StereoModel
    cameras: CameraPair | None = None
    notes: tuple[str, ...] = ()


def read_measurement(folder: Path) -> Measurement:
    """Read a measurement from a folder with measurement.yaml; raise InputError that names the file and the wrong key."""
    path = folder / FILE if folder.is_dir() else folder
    if not path.is_file():
        problem = f"there is no {FILE}" if folder.exists() else "there is no such folder"
        raise InputError(problem, where=str(folder), remedy="name the folder of a measurement")
    values = load_yaml(path)
    config, base = parse(MeasurementConfig, values, str(path)), path.parent
    model = read_model(base / config.model)
    check_sensor(config.sensor, model.sensor, str(path))
    cameras = _cameras(config, base)
    mesh, notes = read_reference(base / config.reference)
    points = {str(base / name): read_points(base / name) for name in config.files}
    notes = (*notes, *_mended(config, values))
    return assembled(config, Material(mesh, points, model, cameras, notes), str(base / config.reference), str(path))


def _mended(config: MeasurementConfig, values: Any) -> tuple[str, ...]:
    """Return a note if the scanner's rotation was made orthonormal."""
    if config.scanner is None:
        return ()
    off = float(np.abs(np.array(config.scanner.rotation) - np.array(values["scanner"]["rotation"], dtype=float)).max())
    return (f"the scanner's rotation has few digits and was made orthonormal, by up to {off:.1g}",) if off > 0 else ()


def assembled(config: MeasurementConfig, material: Material, reference: str, where: str) -> Measurement:
    """Make a measurement from its parts in memory (material) and the settings of measurement.yaml, whose paths are ignored.

    reference, where: names of mesh and config, for errors. Raises InputError if the parts do not fit together.
    """
    mesh, model, cameras = material.reference, material.model, material.cameras
    check_sensor(config.sensor, model.sensor, where)
    viewpoints = _viewpoints(config, material, where)
    check_distances(mesh.vertices, viewpoints, reference)
    frame = WallFrame.fit(mesh.vertices, np.mean([*viewpoints.values()], axis=0))
    local = mesh.with_vertices(frame.to_wall(mesh.vertices))
    local, words = orient_to_sensors(local, [frame.to_wall(position) for position in viewpoints.values()], reference)
    clouds = [check_power(finite(cloud, name), name) for name, cloud in material.points.items()]
    check_different(dict(zip(material.points, clouds, strict=True)))
    if cameras is not None:
        for name, each in zip(material.points, clouds, strict=True):
            check_seen(cameras, each.points, name)
            check_pixels(cameras.left, each, name)
    said = [(reference, (*material.notes, words))]
    for name, each in zip(material.points, clouds, strict=True):
        said.append((name, (*each.notes, *_rounding(each.points, config, material, name))))
    cloud = joined(clouds, SCAN if config.scanners else "epoch")
    found = _of_sensor(
        config,
        material,
        where,
        cloud=_all_in_wall_frame(config, clouds, cloud, frame),
        reference=local,
        frame=frame,
        stable_areas=config.stable_areas,
        notes=(*config.notes, *(f"{Path(name).name}: {note}" for name, texts in said for note in texts if note)),
    )
    _check(found, cloud, config, where)
    return found


def _of_sensor(config: MeasurementConfig, material: Material, where: str, **shared: Any) -> Measurement:
    """Make the measurement of the config's sensor. shared: fields that all kinds have."""
    if isinstance(material.model, StereoModel):
        if material.cameras is None:
            check_in_metres(material.model, where)
            return SurfaceMeasurement(model=material.model, **{**shared, "reference": weld(shared["reference"])[0]})
        return StereoMeasurement(model=material.model, cameras=material.cameras, **shared)
    pose, frame = _scanner_pose(config, where), shared["frame"]
    scans = tuple(
        Scanned(_to_wall(each, frame), each.face, number)
        for each, number in zip(config.scanners, set_ups(config.scanners), strict=True)
    )
    station, vertices = _to_wall(pose, frame), shared["reference"].vertices
    points = ReferencePoints.of(config, vertices, station[0], material.model.noise.range_sigma_m)
    known: dict[str, Any] = {"planes": points.planes, "reference_error_m": points.error_m}
    known |= {"error_is_relief": points.error_is_relief, "error_like_scanner": config.reference_error_kind == "scanner"}
    known |= {"notes": (*shared.pop("notes"), *points.words)}
    return TlsMeasurement(model=material.model, station=station, scans=scans, pattern=config.pattern, **known, **shared)


def _to_wall(pose: ScannerPose, frame: WallFrame) -> Pose:
    return frame.to_wall(np.array(pose.position_m)), frame.rotation @ np.array(pose.rotation)


def _scanner_pose(config: MeasurementConfig, where: str) -> ScannerPose:
    if config.scanners:
        return config.scanners[0]
    if config.scanner is None:
        raise InputError("a TLS measurement needs `scanner`", where=where, remedy="add `scanner` with position_m and rotation")
    return config.scanner


def _check(found: Measurement, cloud: PointCloud, config: MeasurementConfig, where: str) -> None:
    """Raise InputError if the points (`cloud`: as read) fit neither pattern nor reference, or no stable area has points."""
    check_some_inside(found.stable, found.cloud.points[:, 0], found.cloud.points[:, 1], f"{where}: stable_areas")
    if isinstance(found, SurfaceMeasurement):
        found.check_near(where)
        return
    if config.pattern is not None:
        check_pulses(config.pattern.azimuth_rad, config.pattern.zenith_rad, len(cloud.points), len(config.files), where)
    here, other = found.fit, None
    if not here.good and config.scanner is not None:
        unsaid: Literal["scanner", "world"] = "world" if config.frame == "scanner" else "scanner"
        other = found.changed(cloud=_in_wall_frame(cloud, unsaid, config.scanner, found.frame)).fit
    check_frame(here, other, config.frame, where)
    if config.pattern is not None and isinstance(found, TlsMeasurement):
        position, rotation = found.station
        local = np.einsum("ji,nj->ni", rotation, found.cloud.points - position)
        check_inside(local, config.pattern.azimuth_rad, config.pattern.zenith_rad, where)


def _cameras(config: MeasurementConfig, base: Path) -> CameraPair | None:
    if config.sensor == "tls" or config.cameras is None:
        return None
    return nominal_pair(base / config.cameras)


def nominal_pair(file: Path) -> CameraPair:
    """Read a stereo pair (calibration and poses), world frame, from cameras.yaml or another file with two oriented cameras."""
    found = read_oriented(file)
    return read_cameras_yaml(file) if found is None else stereo_pair(found, None, None, str(file))


def _viewpoints(config: MeasurementConfig, material: Material, where: str) -> dict[str, FloatArray]:
    """Return the positions of the sensors by name, world frame; without cameras, a place in front of the reference."""
    cameras = material.cameras
    if cameras is not None:
        return {"left camera": cameras.left.position, "right camera": cameras.right.position}
    if config.sensor == "stereo":
        return {"the side that the reference shows": air_side(material.reference)}
    scanners = {f"scanner {number}": np.array(each.position_m) for number, each in enumerate(config.scanners, start=1)}
    return scanners or {"scanner": np.array(_scanner_pose(config, where).position_m)}


def _rounding(points: FloatArray, config: MeasurementConfig, material: Material, where: str) -> tuple[str, ...]:
    """Return a note on the rounding of a file's points (n, 3), compared with the noise along the lines of sight."""
    points = points[np.isfinite(points).all(axis=1)]
    model, cameras = material.model, material.cameras
    if not len(points):
        return ()
    if isinstance(model, StereoModel) and cameras is None:
        spread = float(np.sqrt(model.noise.of_points.variance([None])[0]))
        return check_rounded_points(points, air_side(material.reference), spread, where) if spread else ()
    if isinstance(model, TlsModel) or cameras is None:
        viewpoint = np.zeros(3) if config.frame == "scanner" else np.array(_scanner_pose(config, where).position_m)
        noise = model.noise.range_sigma_m if isinstance(model, TlsModel) else np.inf
        return check_rounded_points(points, viewpoint, noise, where)
    left, right = cameras.left, cameras.right
    depth = float(np.median((points - left.position) @ left.rotation[:, 2]))
    disparity = np.hypot(model.noise.parallax_sigma_px, model.noise.regularization_sigma_px)
    base = float(np.linalg.norm(right.position - left.position))
    noise = depth**2 / (left.f_px * base) * disparity  # of Z = f B / d
    return check_rounded_points(points, left.position, float(noise), where)


def _all_in_wall_frame(config: MeasurementConfig, clouds: list[PointCloud], joined: PointCloud, frame: WallFrame) -> PointCloud:
    """Return the joined cloud in the wall frame; each scan may have its own frame."""
    if not config.scanners:
        return _in_wall_frame(joined, config.frame, config.scanner, frame)
    parts = [_in_wall_frame(cloud, config.frame, pose, frame) for cloud, pose in zip(clouds, config.scanners, strict=True)]
    return replace(joined, points=np.concatenate([part.points for part in parts]))


def _in_wall_frame(
    cloud: PointCloud, of: Literal["scanner", "world"], scanner: ScannerPose | None, frame: WallFrame
) -> PointCloud:
    points = cloud.points
    if of == "scanner" and scanner is not None:
        turn = frame.rotation @ np.array(scanner.rotation)
        points = np.einsum("ij,nj->ni", turn, points) + frame.to_wall(np.array(scanner.position_m))
    else:
        points = frame.to_wall(points)
    intensity = None if cloud.intensity is None else np.asarray(cloud.intensity, dtype=np.float64)
    return PointCloud(points, intensity, cloud.gps_time, cloud.extra)
