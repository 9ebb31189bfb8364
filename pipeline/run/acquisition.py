"""One look at the wall: what the sensor records, the depth maps that go to others, and the surface made of them."""

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
"""Of the left and of the right camera."""


@dataclass(frozen=True)
class Look:
    """observation: the sensor's, of several stations the first one's; depth_maps: where the config sends them to others; joined:
    all stations of a laser scanner that has several; vertices: the surface of a pair that measures the wall's own vertices."""

    observation: Observation
    depth_maps: DepthMaps | None
    joined: JoinedStations | None = None
    vertices: TriangleMesh | None = None

    @property
    def observations(self) -> tuple[Observation, ...]:
        """Of every station."""
        return (self.observation,) if self.joined is None else self.joined.observations


def look(config: SimulationConfig, site: SensorSite, scene: RayCaster, random: KeyedRandom) -> Look:
    """Observe `scene`; the right depth map costs a second observation and is made only where it is needed.

    Raises InputError where a laser scanner's points should be reconstructed by COLMAP, or any but simulated ones by vertices.
    """
    sensor, colmap = site.sensor, config.reconstruction == "colmap"
    vertices = None
    if config.reconstruction == "vertices":
        if not isinstance(sensor, StereoPair):
            allowed = "direct, for the tls sensor" if isinstance(sensor, LaserScanner) else "direct, colmap, for matcher: sgbm"
            raise InputError("vertices are measured by the simulated stereo pair", where="reconstruction", allowed=allowed)
        vertices = observe_vertices(sensor, scene, random)
    seen = sensor.observe(scene, random)
    if not isinstance(sensor, StereoPair | MatchedStereoPair):
        if colmap:
            raise InputError("colmap fuses depth maps", where="reconstruction", allowed="direct, for the tls sensor")
        return Look(seen, None, _join_stations(config, site, scene, seen, random))
    if not (colmap or config.products.metashape):
        return Look(seen, None, vertices=vertices)
    left, right = depth_cameras(pair_of(sensor))
    return Look(
        seen, (DepthMap(left, seen.depth), DepthMap(right, observe_right(sensor, scene, random).depth)), vertices=vertices
    )


def reconstruct(config: SimulationConfig, seen: Look) -> TriangleMesh:
    """The surface of a look, wall frame, by the config's reconstruction."""
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
