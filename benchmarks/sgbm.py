"""Measure real matching of a full Glendale pair (7360 x 4912, medium) against the bare render and OpenCV matching; target: 1.5.

Bare means the same photographs (rays, texture, shadows), and one call of OpenCV's matcher on each tile of the rectified pictures.
"""

from __future__ import annotations

import numpy as np
from measure import medians, peak_memory_gb

from scene.appearance.illumination import IlluminationConfig
from scene.appearance.texture import TextureConfig
from scene.common.backend import VARIANT, dr
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.ray_casting.raycast import RayCaster
from scene.walls.procedural import ProceduralWall
from sensors.cameras.rectification import rectify
from sensors.models.placement import RigConfig, Target
from sensors.models.sensor_model import StereoModel
from sensors.stereo.exposure import ExposureConfig, Studio
from sensors.stereo.matching import MatchingConfig, SearchRange, match
from sensors.stereo.rectified import RectifiedGrid
from sensors.stereo.stereo_matched import MatchedStereoPair
from sensors.stereo.stereo_pair import REDUCTION, StereoPair


def main() -> None:
    random = KeyedRandom(1)
    world = ProceduralWall(style="glendale", resolution_m=0.0697).mesh(random)
    cameras = RigConfig().place(Target(world))
    frame = WallFrame.fit(world.vertices, cameras.left.position)
    caster = RayCaster(world.with_vertices(frame.to_wall(world.vertices)))
    simulated = StereoPair(cameras, frame, StereoModel())
    light, exposure, matching = IlluminationConfig(), ExposureConfig(), MatchingConfig()
    pair = MatchedStereoPair(simulated, TextureConfig().texture(random), light, exposure, matching)

    wall_pair, step = cameras.in_wall_frame(frame), REDUCTION[simulated.quality]
    distance = float(np.linalg.norm(caster.mesh.bounds.mean(axis=0) - wall_pair.left.position))
    studio = Studio(caster, light.in_wall_frame(frame), pair.texture, distance * step / cameras.left.f_px)
    geometry = rectify(wall_pair)
    grid = RectifiedGrid.cover(wall_pair, geometry, step)
    photographs = pair.photograph(caster, wall_pair, (), random)
    left, right = grid.left(photographs[0].image), grid.right(photographs[1].image)
    seen = simulated.observe(caster, random)
    axis = wall_pair.left.rotation @ geometry.left.T[:, 2]
    depth = (seen.points[seen.valid] - seen.viewpoint) @ axis
    reach = np.array([depth.min() - matching.depth_margin_m, depth.max() + matching.depth_margin_m])
    disparity = (geometry.f * geometry.base_m / reach + geometry.offset) / step - grid.disparity_offset
    search = SearchRange.between(float(disparity.min()), float(disparity.max()))

    def render() -> None:
        for camera in (wall_pair.left, wall_pair.right):
            studio.radiance(camera, step, exposure.samples_per_side)

    ours, rendered, matched = medians(
        lambda: pair.observe(caster, random), render, lambda: match(left, right, search, matching), rounds=3
    )
    rows, columns = simulated.shape
    size = f"{len(caster.mesh.faces):,} triangles, {columns} x {rows}, {search.count} disparities"
    print(f"{VARIANT}, {dr.thread_count()} threads, {size}")
    print(f"bare render, bare matching          {rendered:6.2f} + {matched:.2f} s")
    print(f"observation                         {ours:6.2f} s")
    print(f"ratio                               {ours / (rendered + matched):6.2f}   (target: at most 1.5)")
    print(f"peak memory                         {peak_memory_gb():6.2f} GB (target: at most 8)")


if __name__ == "__main__":
    main()
