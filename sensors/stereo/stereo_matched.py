"""Simulate a stereo pair with a real matcher: photographs of the rock are rendered and matched by OpenCV.

1  The real pair (nominal calibration plus camera effects) photographs the scene, rendered by ray casting in Mitsuba: textured
   rock, sun and shadows, sky, sensor noise, 8 bits, one pixel per cell of the depth map. Effects on image rows displace them.
2  Both pictures are resampled with the nominal calibration to rows that are epipolar lines.
3  They are matched semi-globally in tiles, with a left-right check; least-squares matching then removes the pixel locking.
4  The disparities are interpolated at the depth map's cells and reprojected with the nominal calibration, like simulated ones.

Effects on the matching do not apply, because the matcher makes its own errors. The depth range that is searched is that of the
visible surface plus a margin, as a photogrammetric package knows it from its tie points. A vertical parallax, where real and
nominal calibration differ, disturbs the matching as it would in reality.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from scene.appearance.illumination import IlluminationConfig
from scene.appearance.texture import RockTexture
from scene.common.backend import dr, mi
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster
from scene.ray_casting.upload import on_device
from sensors.cameras.camera import Camera, CameraPair
from sensors.cameras.rectification import Rectification, rectify
from sensors.effects.base import Effect, Stage, apply_stage
from sensors.numerics.device import vector
from sensors.signal_chain.matches import Matches
from sensors.signal_chain.observation import Observation
from sensors.stereo.exposure import ExposureConfig, Photograph, Radiance, Studio, expose, full_scale
from sensors.stereo.matching import MatchingConfig, SearchRange, match, without_speckles
from sensors.stereo.rectified import Disparity, RectifiedGrid
from sensors.stereo.refinement import refine
from sensors.stereo.stereo_pair import REDUCTION, StereoPair, rectified_pixel, reproject, row_displacement, row_tangent, view

STEP_PX = 1.0
"""If neighbouring disparities differ by more than this, a cell between them takes the nearest one instead of a mean."""


@dataclass(frozen=True)
class MatchedStereoPair:
    """A calibrated stereo pair whose photographs are rendered and matched, instead of simulating the matcher's errors.

    Raises InputError at construction if the model names an effect on the matching.

    Attributes
    ----------
    pair : StereoPair
        Cameras, wall frame, noise and effects, and quality of the depth map.
    texture : RockTexture
        Texture of the rock beyond the mesh's albedo.
    illumination : IlluminationConfig
        Sun and sky.
    exposure : ExposureConfig
        How the cameras convert light to grey values.
    matching : MatchingConfig
        The matcher.
    """

    pair: StereoPair
    texture: RockTexture
    illumination: IlluminationConfig
    exposure: ExposureConfig
    matching: MatchingConfig

    def __post_init__(self) -> None:
        """Refuse a model with effects on the matching."""
        named = [effect.name for effect in self.pair.model.effects if effect.stage == Stage.MATCH and not effect.is_null]
        if named:
            raise InputError(
                f"these effects act on simulated matching, but `matcher` is a real image matcher: {', '.join(named)}",
                where="sensor.effects",
                remedy="remove them, or set matcher: simulated",
            )

    def observe(self, scene: RayCaster, random: KeyedRandom) -> Observation:
        """Take and match photographs of the scene once, and return the depth map of the left image as an observation.

        scene: the wall, wall frame. random: source of random numbers. The labels in `block` and the error-free quantities are
        those of what the left pixel really sees.
        """
        effects = self.pair.model.chain(random)
        nominal = self.pair.cameras.in_wall_frame(self.pair.frame)
        real = self.pair.real_pair(effects, random).in_wall_frame(self.pair.frame)
        geometry, step = rectify(nominal), REDUCTION[self.pair.quality]
        index, u, v = self.pair.cells()
        hits, point = view(scene, real.left, u - row_displacement(effects, "left", v, random), v)
        true_z = _depth(point, nominal.left, geometry)
        dr.eval(hits, true_z)
        search_m = _range(true_z, hits.valid)
        photographs = self.photograph(scene, real, effects, random)
        grid = RectifiedGrid.cover(nominal, geometry, step)
        disparity = self.matched(photographs, grid, search_m)
        left_u, left_v = rectified_pixel(nominal.left, geometry.left, u, v, geometry.f, geometry.u_left, geometry.v)
        found = sampled_disparity(disparity, *grid.cells(left_u, left_v))
        full_px = (mi.Float64(found) + grid.disparity_offset) * step
        seen = hits.block, hits.distance, None if scene.mesh.vertex_albedo is None else hits.albedo
        rows = row_tangent(geometry, left_v), float(geometry.offset)
        matches = Matches(index, u, v, full_px, ~dr.isnan(found), *seen, nominal.left.width, nominal.left.height, step, *rows)
        matches = apply_stage(effects, Stage.FILL, matches, random)
        camera_point = reproject(geometry, left_u, left_v, matches.disparity)
        return self.pair.recorded(matches, camera_point, nominal.left, point)

    def photograph(
        self, scene: RayCaster, real: CameraPair, effects: tuple[Effect, ...], random: KeyedRandom
    ) -> tuple[Photograph, Photograph]:
        """Take the left and the right photograph of the wall with the same exposure.

        Parameters
        ----------
        scene : RayCaster
            The wall, wall frame.
        real : CameraPair
            The cameras as they really are, wall frame.
        effects : tuple of Effect
            Errors of the sensor, of which those that displace image rows act here.
        random : KeyedRandom
            Source of random numbers.
        """
        step = REDUCTION[self.pair.quality]
        distance = np.linalg.norm(scene.mesh.bounds.mean(axis=0) - real.left.position)
        light = self.illumination.in_wall_frame(self.pair.frame)
        studio = Studio(scene, light, self.texture, float(distance * step / self.pair.cameras.left.f_px))

        def picture(side: Literal["left", "right"], camera: Camera) -> Radiance:
            return studio.radiance(
                camera, step, self.exposure.samples_per_side, lambda v: row_displacement(effects, side, v, random)
            )

        pictures = picture("left", real.left), picture("right", real.right)
        white = full_scale(*pictures)
        left, right = (
            expose(one, white, step, self.exposure, random.child("photograph", side))
            for one, side in zip(pictures, ("left", "right"), strict=True)
        )
        return left, right

    def matched(
        self, photographs: tuple[Photograph, Photograph], grid: RectifiedGrid, depths_m: tuple[float, float]
    ) -> Disparity:
        """Rectify and match the photographs.

        Parameters
        ----------
        photographs : (left, right)
            One pixel per cell of the depth map.
        grid : RectifiedGrid
            Grids of cells on the rectified images.
        depths_m : (float, float)
            Nearest and farthest depth of the surface, m.

        Returns
        -------
        (h, w) array
            Disparities in cells of the left rectified grid; NaN without a match. The caller adds `grid.disparity_offset`, by
            which the right grid is shifted.
        """
        margin, geometry, config = self.matching.depth_margin_m, grid.geometry, self.matching
        reach = max(depths_m[0] - margin, depths_m[0] / 2), depths_m[1] + margin
        far, near = (
            (geometry.f * geometry.base_m / z + geometry.offset) / grid.step - grid.disparity_offset for z in reach[::-1]
        )
        left, right = grid.left(photographs[0].image), grid.right(photographs[1].image)
        coarse = match(left, right, SearchRange.between(far, near), config)
        fine = coarse if config.refinement is None else refine(left, right, coarse, config.refinement)
        return without_speckles(fine, config.speckle_px)


def _depth(point: mi.Array3f64, left: Camera, geometry: Rectification) -> mi.Float64:
    """Return the depth (n,), m, of points 3 x (n,), wall frame, along the rectified left camera's axis."""
    axis: FloatArray = left.rotation @ geometry.left.T[:, 2]
    return dr.dot(vector(axis), point - vector(left.position))


def _range(depth: mi.Float64, valid: mi.Bool) -> tuple[float, float]:
    """Return nearest and farthest depth, m. Raises InputError if nothing is seen."""
    values = depth.numpy()[valid.numpy()]
    values = values[values > 0]
    if values.size == 0:
        raise InputError(
            "no part of the wall is seen by the left camera",
            where="cameras",
            remedy="correct position_m and rotation of the left camera (camera to world; x right, y down, z forward)",
        )
    return float(values.min()), float(values.max())


def sampled_disparity(disparity: Disparity, column: mi.Float64, row: mi.Float64) -> mi.Float32:
    """Interpolate the disparities of a depth map (h, w), NaN without a match, at n places.

    On one surface the interpolation is bilinear; at a depth step it takes the nearest cell's. column, row: (n,) fractional
    positions in the map, cells.
    """
    height, width = disparity.shape
    values = on_device(mi.Float32, disparity)
    columns, rows = dr.opaque(mi.Int32, width), dr.opaque(mi.Int32, height)
    left, top = mi.Int32(dr.floor(column)), mi.Int32(dr.floor(row))
    inside = (column >= 0) & (row >= 0) & (column < columns - 1) & (row < rows - 1)  # in floating point: NaN is outside
    across, down = mi.Float32(column - left), mi.Float32(row - top)
    corner = top * columns + left
    a, b, c, d = (dr.gather(mi.Float32, values, corner + offset, inside) for offset in (0, 1, columns, columns + 1))
    mean = dr.lerp(dr.lerp(a, b, across), dr.lerp(c, d, across), down)
    upper, lower = dr.select(across < 0.5, a, b), dr.select(across < 0.5, c, d)
    nearest = dr.select(down < 0.5, upper, lower)
    smooth = dr.full(mi.Bool, True, dr.width(mean))
    for cell in (a, b, c, d):
        smooth &= dr.abs(cell - mean) < STEP_PX
    return dr.select(inside, dr.select(smooth, mean, nearest), np.nan)
