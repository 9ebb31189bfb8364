"""Stereo pairs with known disparities: rendered walls (ray-traced truth) and the Middlebury motorcycle (measured truth).

Disparities are in px of the matched pictures, that is, in cells of the depth map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scene.appearance.illumination import IlluminationConfig
from scene.appearance.texture import TextureConfig
from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.ray_casting.raycast import RayCaster
from scene.walls.procedural import ProceduralWall
from sensors.cameras.rectification import rectify
from sensors.effects.base import Stage, apply_stage
from sensors.models.placement import RigConfig, Target
from sensors.models.sensor_model import StereoModel
from sensors.signal_chain.matches import Matches
from sensors.signal_chain.observation import Observation
from sensors.stereo.exposure import ExposureConfig
from sensors.stereo.matching import MatchingConfig, SearchRange, match, without_speckles
from sensors.stereo.refinement import RefinementConfig, refine
from sensors.stereo.stereo_matched import MatchedStereoPair
from sensors.stereo.stereo_pair import REDUCTION, StereoPair

Raster = NDArray[np.float64]
QUIET = StereoModel(noise={"parallax_sigma_px": 0.0, "regularization_sigma_px": 0.0})
SGBM, REFINED = "sgbm", "sgbm, refined"
MATCHERS: dict[str, RefinementConfig | None] = {SGBM: None, REFINED: RefinementConfig()}


@dataclass(frozen=True)
class Case:
    """One pair of pictures with true and matched disparities.

    Attributes
    ----------
    true : (rows, columns) disparities, NaN where unknown or seen by one camera only.
    found : Matched disparities by matcher.
    reduction : Frame px per cell.
    """

    name: str
    true: Raster
    found: dict[str, Raster]
    reduction: int

    def middle(self) -> Case:
        """Return the middle quarter of the pair."""
        rows, columns = (slice(size // 4, size // 4 + size // 2) for size in self.true.shape)
        found = {name: raster[rows, columns] for name, raster in self.found.items()}
        return replace(self, true=self.true[rows, columns], found=found)

    def simulated(self, model: StereoModel, seed: int) -> Raster:
        """(rows, columns) what the simulated matching of `model` (px of the frame) makes of the true disparities."""
        random = KeyedRandom(seed)
        rows, columns = self.true.shape
        index = dr.arange(mi.UInt32, rows * columns)
        u, v = ((mi.Float64(place) + 0.5) * self.reduction for place in (index % columns, index // columns))
        none, size = mi.Float64(0), (columns * self.reduction, rows * self.reduction, self.reduction)
        frontal = none, 0.0  # rows along the rectified axis, disparity 0 at infinity: the matching's effects use neither
        ideal = Matches(index, u, v, none, mi.Bool(True), mi.Int32(0), none, None, *size, *frontal)
        ideal = ideal.with_raster(self.true * self.reduction)
        return apply_stage(model.chain(random), Stage.MATCH, ideal, random).raster() / self.reduction


def rendered(style: str, seed: int) -> Case:
    """Return a wall at 50 m, base 13 m, at medium quality: the middle 3680 x 2456 px of the frame, 18 x 12 m."""
    random = KeyedRandom(seed)
    world = ProceduralWall(style=style, width_m=24.0, height_m=15.0, resolution_m=0.03, seed=seed).mesh(random)
    rig = RigConfig(distance_m=50.0, base_m=13.0, width=3680, height=2456, sensor_width_m=0.01795)
    cameras = rig.place(Target(world))
    frame = WallFrame.fit(world.vertices, cameras.left.position)
    caster = RayCaster(world.with_vertices(frame.to_wall(world.vertices)))
    quiet, texture = StereoPair(cameras, frame, QUIET), TextureConfig().texture(random)
    found = {}
    for name, refinement in MATCHERS.items():
        matching = MatchingConfig(refinement=refinement)
        pair = MatchedStereoPair(quiet, texture, IlluminationConfig(), ExposureConfig(), matching)
        found[name] = disparity(pair.observe(caster, random), quiet)
    return Case(f"{style} {seed}", disparity(quiet.observe(caster, random), quiet), found, REDUCTION[quiet.quality])


def disparity(seen: Observation, pair: StereoPair) -> Raster:
    """(rows, columns) disparity of the recorded points in the rectified nominal pair, px of the depth map."""
    nominal = pair.cameras.in_wall_frame(pair.frame)
    geometry = rectify(nominal)
    depth = (seen.points - nominal.left.position) @ nominal.left.rotation @ geometry.left.T[:, 2]
    return (geometry.f * geometry.base_m / depth + geometry.offset) / REDUCTION[pair.quality]


def motorcycle(folder: Path) -> Case:
    left, right = (cv2.imread(str(folder / f"motorcycle_{side}.png"), cv2.IMREAD_GRAYSCALE) for side in ("left", "right"))
    true = np.load(folder / "motorcycle_disp.npz")["arr_0"].astype(float)
    true[~np.isfinite(true)] = np.nan
    config, pictures = MatchingConfig(), (left.astype(np.float32), right.astype(np.float32))
    coarse = match(*pictures, SearchRange.between(float(np.nanmin(true)), float(np.nanmax(true))), config)
    fine = {name: coarse if how is None else refine(*pictures, coarse, how) for name, how in MATCHERS.items()}
    found = {name: without_speckles(raster, config.speckle_px).astype(float) for name, raster in fine.items()}
    return Case("motorcycle", true, found, 1)
