"""Prepare the first epoch: how it is observed, and to what later epochs are registered (its surface, or the true wall)."""

from __future__ import annotations

from dataclasses import replace

from pipeline.config.simulation import SimulationConfig
from pipeline.registration.closest_points import ReferenceSurface
from pipeline.registration.register import register_to
from pipeline.run.site import SensorSite
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh
from sensors.laser.tls import LaserScanner
from sensors.stereo.exchanged import StereoSensor
from sensors.stereo.stereo_matched import MatchedStereoPair
from sensors.stereo.stereo_pair import StereoPair


def reference_sensor(config: SimulationConfig, site: SensorSite) -> SensorSite:
    """Return the sensor for the first epoch: without noise if the config says so (`noisy_reference: false`), else as it is.

    site: the wall and the sensor; the result is a copy of it with that sensor. Systematic effects stay in any case.
    """
    if config.noisy_reference:
        return site
    sensor = site.sensor
    if isinstance(sensor, MatchedStereoPair):
        quiet: LaserScanner | StereoSensor = replace(sensor, pair=_quiet(sensor.pair))
    elif isinstance(sensor, StereoPair):
        quiet = _quiet(sensor)
    else:
        quiet = replace(sensor, model=sensor.model.without_noise())
    further = tuple(replace(each, model=each.model.without_noise()) for each in site.further_stations)
    return replace(site, sensor=quiet, further_stations=further)


def _quiet(pair: StereoPair) -> StereoPair:
    """Return the pair without noise."""
    return replace(pair, model=pair.model.without_noise())


def reference_and_target(
    config: SimulationConfig, surface: TriangleMesh, wall: TriangleMesh, random: KeyedRandom
) -> tuple[TriangleMesh, ReferenceSurface | None]:
    """Prepare the surface of the first epoch for the comparison, and the surface to which ICP registers later epochs.

    By default later epochs are registered to the first one. With `icp_target: true_wall` all epochs are registered to the
    true wall, the first one too, as its own error of orientation would otherwise appear in every difference map.

    Parameters
    ----------
    config : SimulationConfig
        Registration and its target.
    surface : TriangleMesh
        The reconstructed surface of the first epoch, wall frame.
    wall : TriangleMesh
        The true wall.
    random : KeyedRandom
        Source of random numbers for the points that the registration uses.

    Returns
    -------
    TriangleMesh and ReferenceSurface or None
        The surface of the first epoch, wall frame, and the target of ICP; None without registration.
    """
    if config.icp is None:
        return surface, None
    if config.icp_target == "reference":
        return surface, ReferenceSurface.build(surface.vertices, surface.vertex_normals())
    target = ReferenceSurface.build(wall.vertices, wall.vertex_normals())
    found = register_to(target, surface.vertices, config.icp, random)
    return surface.with_vertices(found.apply(surface.vertices)), target
