"""Observe the wall once: the sensor's observation, the depth maps for other programs, and the surface made of them."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.config.simulation import SimulationConfig
from pipeline.run.site import SensorSite
from pipeline.surface.depth_maps import DepthMap
from pipeline.surface.mesh import mesh_observation
from pipeline.surface.reconstruct import colmap_surface
from pipeline.surface.stations import JoinedStations, join_stations
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.laser.tls import LaserScanner
from sensors.signal_chain.observation import Observation
from sensors.stereo.exchanged import depth_cameras, observe_right, pair_of
from sensors.stereo.stereo_matched import MatchedStereoPair
from sensors.stereo.stereo_pair import StereoPair
from sensors.stereo.stereo_vertices import observe_vertices

DepthMaps = tuple[DepthMap, DepthMap]
"""Depth maps of the left and the right camera."""


@dataclass(frozen=True)
class Acquisition:
    """Everything that the sensor records of the wall in one epoch (one visit), simulated.

    Attributes
    ----------
    observation : Observation
        The grid of measured points; for a laser scanner with several stations (set-ups) that of the first.
    depth_maps : DepthMaps, optional
        Depth maps of a stereo pair's left and right camera; None unless the config asks for an export to Metashape or for a
        reconstruction with COLMAP.
    joined : JoinedStations, optional
        For a laser scanner with several stations: the observations of all and the surface merged from them.
    vertices : TriangleMesh, optional
        For a stereo pair with `reconstruction: vertices`: the wall's own mesh, each vertex with the error of its measurement.
    """

    observation: Observation
    depth_maps: DepthMaps | None
    joined: JoinedStations | None = None
    vertices: TriangleMesh | None = None

    @property
    def observations(self) -> tuple[Observation, ...]:
        """What the sensor recorded: one observation for each station (set-up) of a laser scanner; a stereo pair has one."""
        return (self.observation,) if self.joined is None else self.joined.observations


def acquire(config: SimulationConfig, site: SensorSite, scene: RayCaster, random: KeyedRandom) -> Acquisition:
    """Simulate what the sensor measures of a wall in one epoch.

    Parameters
    ----------
    config : SimulationConfig
        Says how surfaces are reconstructed and which products are written. A stereo pair's right depth map is only made
        if one of them needs it.
    site : SensorSite
        The sensor and its position.
    scene : RayCaster
        The wall of this epoch, wall frame.
    random : KeyedRandom
        Source of the sensor's noise.

    Returns
    -------
    Acquisition
        The measurement.

    Raises
    ------
    InputError
        If the reconstruction does not fit the sensor: `colmap` for a laser scanner, or `vertices` for anything but a
        stereo pair with simulated matching.
    """
    sensor, colmap = site.sensor, config.reconstruction == "colmap"
    vertices = None
    if config.reconstruction == "vertices":
        if not isinstance(sensor, StereoPair):
            allowed = "direct, for the tls sensor" if isinstance(sensor, LaserScanner) else "direct, colmap, for matcher: sgbm"
            raise InputError(
                "the reconstruction `vertices` needs a stereo pair with simulated matching",
                where="reconstruction",
                allowed=allowed,
                remedy="choose one of these reconstructions",
            )
        vertices = observe_vertices(sensor, scene, random)
    seen = sensor.observe(scene, random)
    if not isinstance(sensor, StereoPair | MatchedStereoPair):
        if colmap:
            raise InputError(
                "the reconstruction colmap needs the depth maps of a stereo pair",
                where="reconstruction",
                allowed="direct, for the tls sensor",
                remedy="set reconstruction to direct, or simulate a stereo pair",
            )
        return Acquisition(seen, None, _join_stations(config, site, scene, seen, random))
    if not (colmap or config.products.metashape):
        return Acquisition(seen, None, vertices=vertices)
    left, right = depth_cameras(pair_of(sensor))
    return Acquisition(
        seen, (DepthMap(left, seen.depth), DepthMap(right, observe_right(sensor, scene, random).depth)), vertices=vertices
    )


def reconstruct(config: SimulationConfig, seen: Acquisition) -> TriangleMesh:
    """Make a surface from what the sensor recorded in one epoch, by the method that the config names (`reconstruction`).

    config: method and settings of the surface. seen: the measurement. Returns the surface as a mesh, wall frame.
    """
    observation = seen.observation
    if seen.joined is not None:
        return seen.joined.surface
    if seen.vertices is not None:
        return seen.vertices
    if config.reconstruction != "colmap" or seen.depth_maps is None:
        return mesh_observation(observation, config.surface)
    valid = observation.valid
    return colmap_surface(*seen.depth_maps, observation.points[valid], observation.block[valid], config.surface, config.fusion)


def _join_stations(
    config: SimulationConfig, site: SensorSite, scene: RayCaster, first: Observation, random: KeyedRandom
) -> JoinedStations | None:
    """Observe from the further stations of a laser scanner, if there are any, and join all."""
    if not (isinstance(site.sensor, LaserScanner) and site.further_stations):
        return None
    others = [each.observe(scene, random.child("station", number)) for number, each in enumerate(site.further_stations, start=2)]
    scanners = site.sensor, *site.further_stations
    return join_stations(scanners, [first, *others], config.stations, config.surface, config.difference, random.child("stations"))
