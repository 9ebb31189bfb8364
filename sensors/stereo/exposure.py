"""Take photographs of the scene: render by ray casting in Mitsuba, expose with noise, code in 8 bits.

A picture has one pixel per cell of the depth map, because a matcher works on reduced images. Its noise is that of `step` x
`step` frame pixels binned together. Limits: Lambertian rock, one bounce of light, sharp optics (samples on a fixed grid within
each pixel are averaged).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from scene.appearance.illumination import Illumination
from scene.appearance.texture import RockTexture
from scene.common.backend import dr, mi
from scene.common.config import Config
from scene.common.keyed_random import KeyedRandom
from scene.ray_casting.raycast import RayCaster
from scene.ray_casting.upload import on_device
from sensors.cameras.camera import Camera
from sensors.numerics.device import bounded, opaque, rotated, vector

Radiance = NDArray[np.float32]

Displacement = Callable[[mi.Float64], mi.Float64]
"""Function that returns recorded minus ideal column of pixels in rows v, px of the frame."""

WHITE_PERCENTILE = 99.0
WHITE_LEVEL = 0.85
"""Automatic exposure maps this percentile of the pair's radiance to this share of full scale."""


class ExposureConfig(Config):
    """How light is converted to grey values.

    It describes the image sensor of the simulated cameras, which take the photographs that are matched. A
    pixel of the frame is one of the full image sensor; a pixel of a simulated photograph may bin several of them.
    """

    samples_per_side: int = Field(2, ge=1, le=8, description="rays per pixel along a row or a column, averaged")
    compensation_ev: float = Field(
        0.0, ge=-10, le=10, description="exposure relative to the automatic one, in powers of two [EV]"
    )
    gamma: float = Field(2.2, gt=0, le=4, description="grey value = 255 signal^(1/gamma)")
    full_well_e: float = Field(78_000.0, gt=0, description="electrons of a full pixel of the frame (Nikon D810 at ISO 64) [e]")
    read_noise_e: float = Field(5.0, ge=0, description="standard deviation of the read noise of a pixel of the frame [e]")


@dataclass(frozen=True)
class Photograph:
    """A simulated photograph.

    Attributes
    ----------
    image : (rows, columns) uint8 array
        Grey values.
    clipped_share : float
        Share of the pixels (0 to 1) that are overexposed, at full scale.
    """

    image: NDArray[np.uint8]
    clipped_share: float


def _still(v: mi.Float64) -> mi.Float64:
    """Displacement of a camera whose rows do not move."""
    return mi.Float64(0.0)


@dataclass(frozen=True)
class Studio:
    """The scene of a simulated photograph: what it depends on besides the camera.

    Attributes
    ----------
    scene : RayCaster
        The wall, wall frame.
    light : Illumination
        Sun and sky.
    texture : RockTexture
        Texture of the rock beyond the mesh's albedo.
    footprint_m : float
        Size of a photograph's pixel on the rock, m.
    """

    scene: RayCaster
    light: Illumination
    texture: RockTexture
    footprint_m: float

    def radiance(self, camera: Camera, step: int, samples_per_side: int, displaced: Displacement = _still) -> Radiance:
        """Render the light that reaches each pixel of a camera (rows, columns): the radiance times pi.

        It is relative to that of an unshadowed white face that points at the sun. Pixels without rock show the sky. The
        positions of the samples are the same in every pixel, because random ones would add noise that differs between the
        views.

        Parameters
        ----------
        camera : Camera
            The camera, wall frame.
        step : int
            Frame pixels per pixel of the picture, along a row or a column.
        samples_per_side : int
            Rays per pixel along a row or a column.
        displaced : callable
            Function that returns, for image rows v (n,), px of the frame, by how far they are displaced sideways, (n,), px:
            recorded minus ideal column. By default 0.
        """
        rows, columns = camera.height // step, camera.width // step
        index = dr.arange(mi.UInt32, rows * columns)
        row, column = index // columns, index % columns
        total = dr.zeros(mi.Float32, rows * columns)
        for sample in range(samples_per_side**2):
            dr.make_opaque(total)  # one kernel per sample bounds the memory
            du, dv = opaque(*((np.array(divmod(sample, samples_per_side)) + 0.5) / samples_per_side))
            u, v = (mi.Float64(column) + du) * step, (mi.Float64(row) + dv) * step
            total += self._seen(camera, u - displaced(v), v)
        return np.array(total / samples_per_side**2).reshape(rows, columns)

    def _seen(self, camera: Camera, u: mi.Float64, v: mi.Float64) -> mi.Float32:
        """Return the radiance (n,) along the rays through the pixels (u, v)."""
        x, y = camera.on_device().tangents(u, v)
        origin, direction = vector(camera.position), rotated(camera.rotation, mi.Array3f64(x, y, 1.0))
        hits = self.scene.intersect(origin, direction)
        point = dr.select(hits.valid, origin + hits.distance * direction, 0.0)
        albedo = hits.albedo * self.texture.factor(point, self.footprint_m)
        rock = bounded(albedo, 0, 1) * self.light.irradiance(self.scene, point, hits.normal)
        return dr.select(hits.valid, rock, dr.opaque(mi.Float32, self.light.sky_share))


def full_scale(*pictures: Radiance) -> float:
    """Return the radiance at which automatic exposure saturates, for the photographs of both cameras.

    pictures: rendered radiances (rows, columns). It is one value for all of them, because both cameras have the same settings.
    """
    bright = np.percentile(np.concatenate([picture.ravel() for picture in pictures]), WHITE_PERCENTILE)
    return max(float(bright) / WHITE_LEVEL, 1e-6)


def expose(radiance: Radiance, white: float, step: int, config: ExposureConfig, random: KeyedRandom) -> Photograph:
    """Convert the rendered light of a picture to a photograph, with the noise of an image sensor.

    The number of electrons is N = N_full 2^EV L / white, with the radiance L, the exposure compensation EV
    (`config.compensation_ev`), and N_full = step^2 full wells, since step^2 pixels of the sensor are added. Their noise is
    Gaussian with variance N + step^2 r^2, where r is the read noise of a pixel in electrons; shot noise is nearly Gaussian
    above a hundred electrons. Beyond N_full a pixel is clipped.

    Parameters
    ----------
    radiance : (rows, columns) array
        The rendered picture, in any unit that `white` shares.
    white : float
        Radiance that saturates the sensor without exposure compensation (0 EV).
    step : int
        Frame pixels per pixel of the picture, along a row or a column.
    config : ExposureConfig
        The camera's sensor.
    random : KeyedRandom
        Source of the noise.
    """
    level = on_device(mi.Float32, radiance) * dr.opaque(mi.Float32, 2.0**config.compensation_ev / white)
    full, read = (dr.opaque(mi.Float32, value) for value in (config.full_well_e * step**2, config.read_noise_e * step))
    noise = random.normals(dr.arange(mi.UInt32, radiance.size)).x * dr.sqrt(level / full + dr.square(read / full))
    level = bounded(level + noise, 0, 1)
    grey = mi.Float32(255) * dr.power(level, dr.opaque(mi.Float32, 1 / config.gamma))
    dr.eval(grey, level)
    image = np.rint(grey.numpy()).astype(np.uint8).reshape(radiance.shape)
    return Photograph(image, float(np.mean(level.numpy() >= 1)))
