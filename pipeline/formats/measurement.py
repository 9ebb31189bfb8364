"""A measurement as `scarpsim gap` takes it: points, the surface as known, the instrument and what is believed about it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from pipeline.change.areas import Area, in_areas
from pipeline.formats.camera_files import read_oriented, stereo_pair
from pipeline.formats.cameras import read_cameras_yaml
from pipeline.formats.measurement_checks import (
    PointFit,
    Sweep,
    check_different,
    check_frame,
    check_inside,
    check_pixels,
    check_power,
    check_pulses,
    check_seen,
    finite,
)
from pipeline.formats.point_cloud import SCAN, PointCloud, joined
from pipeline.formats.points import read_points
from pipeline.formats.rounded_points import check_rounded_points
from pipeline.formats.scanner_poses import Face, Pose, Scanned, ScannerPose, ScannerScan, set_ups
from pipeline.registration.rigid import rotation_matrix
from scene.config import Config, load_yaml, parse
from scene.errors import InputError
from scene.frame import WallFrame
from scene.imported import read_reference
from scene.mesh import FloatArray, TriangleMesh
from scene.plane_normals import plane_normals
from scene.raycast import RayCaster
from scene.winding import check_near, facing
from sensors.camera import Camera, CameraPair
from sensors.effects.base import Sensor
from sensors.model import StereoModel, TlsModel

FILE = "measurement.yaml"
MOST_EPOCHS = 1000
_NAME_CAMERAS = "name cameras.yaml or a Metashape XML"


class ScanPattern(Config):
    """The nominal directions of a scan: start, stop and step of each angle."""

    azimuth_rad: Sweep = Field(description="start, stop, step [rad]; or azimuth_deg")
    zenith_rad: Sweep = Field(description="start, stop, step [rad]; or zenith_deg")

    @model_validator(mode="before")
    @classmethod
    def _from_degrees(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        found = dict(values)
        for name in ("azimuth", "zenith"):
            sweep = found.get(f"{name}_deg")
            if isinstance(sweep, list | tuple) and all(isinstance(each, int | float) for each in sweep):
                if f"{name}_rad" in found:
                    raise ValueError(f"'{name}_deg' stands beside '{name}_rad'; give one of them")
                found[f"{name}_rad"] = [math.radians(each) for each in found.pop(f"{name}_deg")]
        return found

    @field_validator("azimuth_rad", "zenith_rad")
    @classmethod
    def _forward(cls, sweep: Sweep) -> Sweep:
        """A sweep of a scanner that turns the other way (step below 0) is the same directions from its other end."""
        start, stop, step = sweep
        if step < 0 and stop < start:
            sweep = start + step * math.floor((stop - start) / step + 1e-6), start, -step
        if not (sweep[2] > 0 and sweep[1] > sweep[0]):
            raise ValueError("needs start < stop and a step above 0, or start > stop and a step below 0")
        if max(map(abs, sweep)) > 2 * math.pi:
            raise ValueError(
                f"is beyond a full turn; angles are in radians: {sweep[1]:g} degrees are {math.radians(sweep[1]):.4g}"
            )
        return sweep

    @field_validator("zenith_rad")
    @classmethod
    def _above_nadir(cls, sweep: Sweep) -> Sweep:
        if sweep[0] < -sweep[2] or sweep[1] > math.pi + sweep[2]:
            raise ValueError("zenith angles run from 0, straight up, to pi, straight down")
        return sweep


class MeasurementConfig(Config):
    """The file measurement.yaml."""

    sensor: Literal["tls", "stereo"]
    reference: Path = Field(description="the surface as known, world frame, m")
    points: Path | Annotated[list[Path], Field(max_length=MOST_EPOCHS)] = Field(description="point cloud; several epochs: a list")
    frame: Literal["scanner", "world"] = Field("world", description="of the points")
    scanner: ScannerPose | None = None
    scanners: tuple[ScannerScan, ...] = Field(
        (), description="instead of `scanner` where each file of `points` is a scan from a place or in a face of its own"
    )
    pattern: ScanPattern | None = None
    cameras: Path | None = Field(None, description="cameras.yaml or a Metashape XML: the nominal calibration (stereo)")
    stable_areas: tuple[Area, ...] = Field(
        (), description="where nothing moved: boxes [x0, y0, x1, y1] or polygons [[x, y], ...], wall frame [m]"
    )
    model: Path = Field(description="what the simulation believes about the sensor today")
    incidence: Literal["triangles", "planes"] = Field(
        "triangles", description="what rays are inclined to: the triangle hit, or a plane through 24 vertices around it (tls)"
    )
    notes: tuple[str, ...] = Field(
        (), description="what the report should say of the measurement, such as what a reference cannot show"
    )

    @field_validator("points")
    @classmethod
    def _some(cls, points: Path | list[Path]) -> Path | list[Path]:
        if points == []:
            raise ValueError("names no file; give a path, or a list of one path an epoch")
        if isinstance(points, list) and len(set(points)) < len(points):
            raise ValueError("names a file twice; give a path of its own for each epoch")
        return points

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.sensor == "stereo" and self.incidence != "triangles":
            raise ValueError("'incidence: planes' is of laser scans; leave it out")
        files = [self.points] if isinstance(self.points, Path) else self.points
        if self.scanners and len(self.scanners) != len(files):
            raise ValueError(f"'scanners' has {len(self.scanners)} poses for {len(files)} files of points; give one for each")
        if self.scanners and (self.scanner is not None or self.pattern is not None):
            raise ValueError("'scanners' stands instead of 'scanner', and without 'pattern'")
        return self


def _kind(values: Any) -> str:
    return str(values.get("sensor") if isinstance(values, dict) else getattr(values, "sensor", None))


class _ModelFile(Config):
    sensor: Annotated[Annotated[StereoModel, Tag("stereo")] | Annotated[TlsModel, Tag("tls")], Discriminator(_kind)]


@dataclass(frozen=True, kw_only=True)
class MeasurementBase(ABC):
    """What was measured, with everything that predicts it; what a laser scan and a stereo pair have in common.

    cloud: points in the wall frame; reference: wall frame; frame: the wall frame; stable_areas: outside of which the scene may
    have changed, everywhere where there are none; notes: what should be said of the files.
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
        """(n,) the epoch of each point, from 0."""
        return np.asarray(self.cloud.extra.get("epoch", np.zeros(len(self.cloud.points))), dtype=np.int64)

    @property
    def stable(self) -> NDArray[np.bool_]:
        """(n,) points in the areas where nothing moved; all where none are given."""
        x, y = self.cloud.points[:, :2].T
        return in_areas(self.stable_areas, x, y) if self.stable_areas else np.ones(len(x), dtype=bool)

    @cached_property
    def scene(self) -> RayCaster:
        return RayCaster(self.reference)

    @property
    @abstractmethod
    def viewpoint(self) -> FloatArray:
        """(3,) where the rays begin, wall frame, m: the scanner's centre, the left camera's."""

    @property
    def fit(self) -> PointFit:
        """How the points lie against the reference."""
        return PointFit.of(self.cloud.points, self.viewpoint, self.scene, self.sensor)

    def changed(self, **values: Any) -> Self:
        """The same with other points, cameras or pose, in front of the same ray caster."""
        other = replace(self, **values)
        other.__dict__["scene"] = self.scene  # where cached_property keeps it
        return other

    def part(self, rows: NDArray[np.int64]) -> Self:
        """Some of the points."""
        return self.changed(cloud=self.cloud.part(rows))

    def moved(self, pose: FloatArray) -> Self:
        """The measurement with its sensor shifted (m) and turned (rad) by a pose (6,) in the wall frame, and its points with it.

        What the sensor recorded stays as it is. A pair of cameras turns about the left one.
        """
        turn, centre = rotation_matrix(pose[3:]), self.viewpoint
        points = (self.cloud.points - centre) @ turn.T + centre + pose[:3]
        return self.changed(cloud=replace(self.cloud, points=points), **self._moved_sensor(turn, pose[:3]))

    @abstractmethod
    def _moved_sensor(self, turn: FloatArray, shift: FloatArray) -> dict[str, Any]:
        """The field that says where the sensor stands, with another value. turn: (3, 3), shift: (3,), wall frame, m."""


@dataclass(frozen=True, kw_only=True)
class TlsMeasurement(MeasurementBase):
    """A laser scan, or epochs of it.

    station: scanner to wall frame, of the first scan where there are several; face: in which it was scanned; scans: of several,
    whose numbers are the points' channel `scan`, empty where there is one; pattern: the nominal directions, None where not known;
    pulses: (m,) those of the pattern that the points are a part of, None for all of them; order: each point's scan line and share
    of the scan's duration (n,), None where not known, once they were counted (see `with_order`); normals: (v, 3) at the
    reference's vertices, to which rays are inclined, None where it is to its triangles.
    """

    sensor = "tls"
    model: TlsModel
    station: Pose
    face: Face = 1
    scans: tuple[Scanned, ...] = ()
    pattern: ScanPattern | None = None
    pulses: NDArray[np.bool_] | None = None
    order: tuple[FloatArray | None, FloatArray | None] | None = None
    normals: FloatArray | None = None

    @property
    def viewpoint(self) -> FloatArray:
        return self.station[0]

    @property
    def scan_of(self) -> NDArray[np.int64]:
        """(n,) number of each point's scan."""
        return np.asarray(self.cloud.extra.get(SCAN, np.zeros(len(self.cloud.points))), dtype=np.int64)

    def each_scan(self) -> Iterator[tuple[Scanned, NDArray[np.int64], Self]]:
        """Of several scans each with its points' rows and its own measurement."""
        for number, scan in enumerate(self.scans):
            rows = np.flatnonzero(self.scan_of == number)
            yield scan, rows, self.part(rows).changed(station=scan.pose, face=scan.face, scans=())

    @property
    def fit(self) -> PointFit:
        several = self.each_scan()
        fits = [PointFit.of(one.cloud.points, one.viewpoint, self.scene, self.sensor) for _, rows, one in several if len(rows)]
        return min(fits, key=lambda each: (each.good, each.near)) if fits else super().fit

    def moved(self, pose: FloatArray) -> Self:
        """Of several scans each by the six values of its set-up: pose (6 k,)."""
        if not self.scans:
            return super().moved(pose)
        points, scans = self.cloud.points.copy(), []
        for scan, rows, one in self.each_scan():
            there = one.moved(pose[6 * scan.set_up : 6 * scan.set_up + 6])
            points[rows] = there.cloud.points
            scans.append(replace(scan, pose=there.station))
        return self.changed(cloud=replace(self.cloud, points=points), scans=tuple(scans), station=scans[0].pose)

    def part(self, rows: NDArray[np.int64]) -> Self:
        line, share = (None if values is None else values[rows] for values in self.order or (None, None))
        return super().part(rows).changed(order=self.order and (line, share))

    def _moved_sensor(self, turn: FloatArray, shift: FloatArray) -> dict[str, Any]:
        position, rotation = self.station
        return {"station": (position + shift, turn @ rotation)}


@dataclass(frozen=True, kw_only=True)
class StereoMeasurement(MeasurementBase):
    """A surface that a stereo pair gave. cameras: the nominal calibration, world frame."""

    sensor = "stereo"
    model: StereoModel
    cameras: CameraPair

    @property
    def viewpoint(self) -> FloatArray:
        return self.frame.to_wall(self.cameras.left.position)

    def _moved_sensor(self, turn: FloatArray, shift: FloatArray) -> dict[str, Any]:
        axes = self.frame.rotation
        world, along = axes.T @ turn @ axes, axes.T @ shift
        left = self.cameras.left.position

        def each(camera: Camera) -> Camera:
            return replace(camera, rotation=world @ camera.rotation, position=left + world @ (camera.position - left) + along)

        return {"cameras": CameraPair(each(self.cameras.left), each(self.cameras.right))}


Measurement = TlsMeasurement | StereoMeasurement


def read_model(path: Path) -> TlsModel | StereoModel:
    """A file model.yaml. Raises InputError with the key that is wrong."""
    return sensor_model(load_yaml(path), str(path))


def sensor_model(values: Any, where: str) -> TlsModel | StereoModel:
    """The sensor model that a mapping of keys describes; where: what errors call it."""
    if not isinstance(values, dict) or values.get("sensor") not in ("tls", "stereo"):
        raise InputError("names no sensor", where=where, allowed="sensor: tls, sensor: stereo")
    return parse(_ModelFile, {"sensor": values}, where).sensor


@dataclass(frozen=True)
class Material:
    """What a measurement is made of. reference: world frame; notes: on it; points: clouds by their files' names, an epoch each,
    in the frame that the config says; cameras: world frame, stereo only."""

    reference: TriangleMesh
    points: dict[str, PointCloud]
    model: TlsModel | StereoModel
    cameras: CameraPair | None = None
    notes: tuple[str, ...] = ()


def read_measurement(folder: Path) -> Measurement:
    """Read a folder with measurement.yaml. Raises InputError that names the file and the key."""
    path = folder / FILE if folder.is_dir() else folder
    if not path.is_file():
        raise InputError(f"there is no {FILE}", where=str(folder), remedy="name the folder of a measurement")
    values = load_yaml(path)
    config, base = parse(MeasurementConfig, values, str(path)), path.parent
    model = read_model(base / config.model)
    _check_sensor(config, model, str(path))
    cameras = _cameras(config, base, str(path))
    mesh, notes = read_reference(base / config.reference)
    points = {str(base / name): read_points(base / name) for name in _files(config)}
    notes = (*notes, *_mended(config, values))
    return assembled(config, Material(mesh, points, model, cameras, notes), str(base / config.reference), str(path))


def _mended(config: MeasurementConfig, values: Any) -> tuple[str, ...]:
    """A word where the scanner's rotation is not the one that the file's `values` state."""
    if config.scanner is None:
        return ()
    off = float(np.abs(np.array(config.scanner.rotation) - np.array(values["scanner"]["rotation"], dtype=float)).max())
    return (f"the scanner's rotation has few digits and was made orthonormal, by up to {off:.1g}",) if off > 0 else ()


def assembled(config: MeasurementConfig, material: Material, reference: str, where: str) -> Measurement:
    """A measurement out of what is in memory; its paths are not read. reference, where: what errors call mesh and config.

    Raises InputError for whatever does not fit together.
    """
    mesh, model, cameras = material.reference, material.model, material.cameras
    _check_sensor(config, model, where)
    viewpoints = _viewpoints(config, cameras, where)
    check_near(mesh.vertices, viewpoints, reference)
    frame = WallFrame.fit(mesh.vertices, np.mean([*viewpoints.values()], axis=0))
    local = mesh.with_vertices(frame.to_wall(mesh.vertices))
    local, words = facing(local, [frame.to_wall(position) for position in viewpoints.values()], reference)
    clouds = [check_power(finite(cloud, name), name) for name, cloud in material.points.items()]
    check_different(dict(zip(material.points, clouds, strict=True)))
    if cameras is not None:
        for name, each in zip(material.points, clouds, strict=True):
            check_seen(cameras, each.points, name)
            check_pixels(cameras.left, each, name)
    said = [(reference, (*material.notes, words))]
    for name, each in zip(material.points, clouds, strict=True):
        said.append((name, _rounding(each.points, config, model, cameras, name)))
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
    """A laser scan or a pair's surface. shared: the fields that both have."""
    if isinstance(material.model, StereoModel):
        if material.cameras is None:
            raise InputError("a stereo measurement needs `cameras`", where=where, remedy=_NAME_CAMERAS)
        return StereoMeasurement(model=material.model, cameras=material.cameras, **shared)
    pose, frame = _scanner_pose(config, where), shared["frame"]
    scans = tuple(
        Scanned(_to_wall(each, frame), each.face, number)
        for each, number in zip(config.scanners, set_ups(config.scanners), strict=True)
    )
    normals = plane_normals(shared["reference"].vertices) if config.incidence == "planes" else None
    return TlsMeasurement(
        model=material.model, station=_to_wall(pose, frame), scans=scans, pattern=config.pattern, normals=normals, **shared
    )


def _to_wall(pose: ScannerPose, frame: WallFrame) -> Pose:
    return frame.to_wall(np.array(pose.position_m)), frame.rotation @ np.array(pose.rotation)


def _scanner_pose(config: MeasurementConfig, where: str) -> ScannerPose:
    if config.scanners:
        return config.scanners[0]
    if config.scanner is None:
        raise InputError("a TLS measurement needs `scanner`", where=where, remedy="give scanner: position_m and rotation")
    return config.scanner


def _check_sensor(config: MeasurementConfig, model: TlsModel | StereoModel, where: str) -> None:
    if model.sensor != config.sensor:
        raise InputError(f"model is of sensor {model.sensor}, the measurement of {config.sensor}", where=where)


def _check(found: Measurement, cloud: PointCloud, config: MeasurementConfig, where: str) -> None:
    """Raise InputError where the points (`cloud`: as read) fit neither pattern nor reference."""
    if config.pattern is not None:
        check_pulses(config.pattern.azimuth_rad, config.pattern.zenith_rad, len(cloud.points), len(_files(config)), where)
    here, other = found.fit, None
    if not here.good and config.scanner is not None:
        unsaid: Literal["scanner", "world"] = "world" if config.frame == "scanner" else "scanner"
        other = found.changed(cloud=_in_wall_frame(cloud, unsaid, config.scanner, found.frame)).fit
    check_frame(here, other, config.frame, where)
    if config.pattern is not None and isinstance(found, TlsMeasurement):
        position, rotation = found.station
        local = np.einsum("ji,nj->ni", rotation, found.cloud.points - position)
        check_inside(local, config.pattern.azimuth_rad, config.pattern.zenith_rad, where)


def _files(config: MeasurementConfig) -> list[Path]:
    return [config.points] if isinstance(config.points, Path) else config.points


def _cameras(config: MeasurementConfig, base: Path, where: str) -> CameraPair | None:
    if config.sensor == "tls":
        return None
    if config.cameras is None:
        raise InputError("a stereo measurement needs `cameras`", where=where, remedy=_NAME_CAMERAS)
    return nominal_pair(base / config.cameras)


def nominal_pair(file: Path) -> CameraPair:
    """The cameras of a file, world frame: cameras.yaml, or another one with two oriented cameras."""
    found = read_oriented(file)
    return read_cameras_yaml(file) if found is None else stereo_pair(found, None, None, str(file))


def _viewpoints(config: MeasurementConfig, cameras: CameraPair | None, where: str) -> dict[str, FloatArray]:
    """Where the sensors stand, by name, world frame."""
    if cameras is not None:
        return {"left camera": cameras.left.position, "right camera": cameras.right.position}
    scanners = {f"scanner {number}": np.array(each.position_m) for number, each in enumerate(config.scanners, start=1)}
    return scanners or {"scanner": np.array(_scanner_pose(config, where).position_m)}


def _rounding(
    points: FloatArray, config: MeasurementConfig, model: TlsModel | StereoModel, cameras: CameraPair | None, where: str
) -> tuple[str, ...]:
    """What to say of the rounding of a file's points (n, 3), against the noise along the lines of sight."""
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return ()
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
    """The joined cloud, of which each scan may be in a frame of its own."""
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
