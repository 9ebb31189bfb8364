"""Set up a simulation: the wall in its frame, and the sensor in front of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from pipeline.config.simulation import SensorName, SimulationConfig
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.meshes.winding import check_distances, orient_to_sensors
from scene.ray_casting.raycast import RayCaster
from scene.walls.imported import ImportedWall
from scene.walls.wall import Wall, build_wall
from sensors.cameras.camera import CameraPair
from sensors.laser.tls import LaserScanner
from sensors.models.placement import Target
from sensors.stereo.exchanged import StereoSensor
from sensors.stereo.stereo_matched import MatchedStereoPair
from sensors.stereo.stereo_pair import StereoPair

Origin = Literal["rule", "file", "given"]
"""Where a wall comes from: generated here, read from a file and repaired, or given by the caller as it is."""


@dataclass(frozen=True)
class SensorSite:
    """The untouched wall (wall frame), its frame, and the sensor that observes it.

    Attributes
    ----------
    name : str
        Name of the wall.
    repairs : tuple of str
        What was repaired in an imported mesh, in words.
    mesh : TriangleMesh
        The wall, wall frame.
    frame : WallFrame
        Transform between world coordinates and the wall frame, whose z axis points from the wall to the sensor.
    sensor : LaserScanner or stereo sensor
        The sensor; for a scanner with several stations (set-ups) that of the first.
    viewpoints : dict of (3,) arrays
        Positions of cameras or stations, wall frame, m, by the name that reports and error messages give them.
    further_stations : tuple of LaserScanner
        The scanner at its second and further stations.
    caster : RayCaster, optional
        A ray caster of the wall, if one was needed to find out which side of the mesh faces the sensor.
    """

    name: str
    repairs: tuple[str, ...]
    mesh: TriangleMesh
    frame: WallFrame
    sensor: LaserScanner | StereoSensor
    viewpoints: dict[str, FloatArray]
    further_stations: tuple[LaserScanner, ...] = ()
    caster: RayCaster | None = None

    def caster_of(self, mesh: TriangleMesh) -> RayCaster:
        """Return a ray caster of a mesh: the one that this site has, if the mesh is its untouched wall, else a new one."""
        return self.caster if self.caster is not None and self.caster.mesh is mesh else RayCaster(mesh)


def prepare_site(config: SimulationConfig, sensor: SensorName, random: KeyedRandom, given: Wall | None = None) -> SensorSite:
    """Set up a simulation: build the wall, place the sensor in front of it, and fit the wall frame.

    The z axis of the wall frame points to the sensor.

    Parameters
    ----------
    config : SimulationConfig
        Wall, sensor and frame.
    sensor : str
        "stereo" or "tls".
    random : KeyedRandom
        The run's source of random numbers.
    given : Wall, optional
        A wall to use instead of the config's.

    Returns
    -------
    SensorSite
        The wall, its frame and the sensor.

    Raises
    ------
    InputError
        If the wall cannot be used or the sensor cannot be placed.
    """
    wall = given or build_wall(config.wall, random.child("wall"))
    origin: Origin = "given" if given is not None else "file" if isinstance(config.wall, ImportedWall) else "rule"
    target = Target(wall.mesh)
    if sensor == "stereo":
        cameras = config.camera_pair(target)
        frame = config.frame.fit(wall.mesh.vertices, (cameras.left.position + cameras.right.position) / 2)
        positions = {f"cameras, {side}": getattr(cameras, side).position for side in ("left", "right")}
        mesh, repairs, caster = _orient_wall(wall, frame, positions, origin)
        pair = _stereo(config, cameras, frame, random)
        eyes = {name: frame.to_wall(position) for name, position in positions.items()}
        return SensorSite(wall.name, repairs, mesh, frame, pair, eyes, caster=caster)
    stations = config.station_configs()
    poses = [station.place(target) for station in stations]
    frame = config.frame.fit(wall.mesh.vertices, poses[0][0])
    positions = {f"station, number {number}": position for number, (position, _) in enumerate(poses, start=1)}
    positions = positions if len(poses) > 1 else {"station": poses[0][0]}
    mesh, repairs, caster = _orient_wall(wall, frame, positions, origin)
    instrument = config.scanner, config.tls_model(), config.products.truth_channels
    scanners = [
        LaserScanner.aimed(pose, frame, mesh.vertices, *instrument, station.pose_sigma)
        for pose, station in zip(poses, stations, strict=True)
    ]
    eyes = {name: scanner.position for name, scanner in zip(positions, scanners, strict=True)}
    return SensorSite(wall.name, repairs, mesh, frame, scanners[0], eyes, tuple(scanners[1:]), caster)


def _orient_wall(
    wall: Wall, frame: WallFrame, positions: Mapping[str, FloatArray], origin: Origin
) -> tuple[TriangleMesh, tuple[str, ...], RayCaster | None]:
    """Return the wall in its frame, with the winding corrected for walls that were not generated here, and all repairs.

    positions: of the sensors, world frame. The third value is a ray caster of the returned wall, if one was made.
    """
    check_distances(wall.mesh.vertices, positions, wall.name)
    mesh = wall.mesh.with_vertices(frame.to_wall(wall.mesh.vertices))
    if origin == "rule":
        return mesh, wall.repairs, None
    eyes = [frame.to_wall(position) for position in positions.values()]
    caster = RayCaster(mesh)
    oriented, words = orient_to_sensors(mesh, eyes, wall.file or wall.name, cleaned=origin == "file", scene=caster)
    return oriented, (*wall.repairs, *([words] if words else [])), caster if oriented is mesh else None


def _stereo(config: SimulationConfig, cameras: CameraPair, frame: WallFrame, random: KeyedRandom) -> StereoSensor:
    """Return the pair with the config's matcher. The rock's texture is the same in every epoch."""
    pair = StereoPair(cameras, frame, config.stereo_model(), config.depth_map, config.products.truth_channels)
    if config.matcher == "simulated":
        return pair
    texture = config.texture.texture(random.child("texture"))
    return MatchedStereoPair(pair, texture, config.illumination, config.exposure, config.matching)
