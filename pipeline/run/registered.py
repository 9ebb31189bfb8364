"""The first epoch's surface and what the later ones are registered to: that surface, or the wall as it really is."""

from __future__ import annotations

from pipeline.config.simulation import SimulationConfig
from pipeline.registration.closest_points import ReferenceSurface
from pipeline.registration.register import register_to
from scene.keyed_random import KeyedRandom
from scene.mesh import TriangleMesh


def reference_and_target(
    config: SimulationConfig, surface: TriangleMesh, wall: TriangleMesh, random: KeyedRandom
) -> tuple[TriangleMesh, ReferenceSurface | None]:
    """The reference surface, wall frame, and the target of the later epochs' ICP, None where the config has none.

    surface: as reconstructed; wall: as it really is. With `icp_target: true_wall` (thesis 3.6) the reference itself is registered
    to the wall too, else its own misorientation would stand in every difference map.
    """
    if config.icp is None:
        return surface, None
    if config.icp_target == "reference":
        return surface, ReferenceSurface.build(surface.vertices, surface.vertex_normals())
    target = ReferenceSurface.build(wall.vertices, wall.vertex_normals())
    found = register_to(target, surface.vertices, config.icp, random)
    return surface.with_vertices(found.apply(surface.vertices)), target
