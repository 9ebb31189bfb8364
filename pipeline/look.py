"""One look at the wall: what the sensor records, the depth maps that go to others, and the surface made of them."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.config import SimulationConfig
from pipeline.depth_maps import DepthMap
from pipeline.mesh import mesh_observation
from pipeline.reconstruct import colmap_surface
from pipeline.site import Site
from scene.errors import InputError
from scene.keyed_random import KeyedRandom
from scene.mesh import TriangleMesh
from scene.raycast import RayCaster
from sensors.exchanged import depth_cameras, observe_right, pair_of
from sensors.observation import Observation
from sensors.stereo import StereoPair
from sensors.stereo_matched import MatchedStereoPair

DepthMaps = tuple[DepthMap, DepthMap]
"""Of the left and of the right camera."""


@dataclass(frozen=True)
class Look:
    """observation: the sensor's; depth_maps: where the config sends them to others."""

    observation: Observation
    depth_maps: DepthMaps | None


def look(config: SimulationConfig, site: Site, scene: RayCaster, random: KeyedRandom) -> Look:
    """Observe `scene`; the right depth map costs a second observation and is made only where it is needed.

    Raises InputError where a laser scanner's points should be reconstructed by COLMAP.
    """
    sensor, colmap = site.sensor, config.reconstruction == "colmap"
    seen = sensor.observe(scene, random)
    if not isinstance(sensor, StereoPair | MatchedStereoPair):
        if colmap:
            raise InputError("colmap fuses depth maps", where="reconstruction", allowed="direct, for the tls sensor")
        return Look(seen, None)
    if not (colmap or config.products.metashape):
        return Look(seen, None)
    left, right = depth_cameras(pair_of(sensor))
    return Look(seen, (DepthMap(left, seen.depth), DepthMap(right, observe_right(sensor, scene, random).depth)))


def reconstruct(config: SimulationConfig, seen: Look) -> TriangleMesh:
    """The surface of a look, wall frame, by the config's reconstruction."""
    observation = seen.observation
    if config.reconstruction == "direct" or seen.depth_maps is None:
        return mesh_observation(observation, config.surface)
    valid = observation.valid
    return colmap_surface(*seen.depth_maps, observation.points[valid], observation.block[valid], config.surface, config.fusion)
