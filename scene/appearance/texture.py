"""Add texture to the rock at image resolution: solid noise evaluated where a ray hits, so that all cameras see the same rock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from scene.common.backend import dr, mi
from scene.common.config import Config
from scene.common.keyed_random import KeyedRandom

_DEVIATION = (1 / 3 * (26 / 35) ** 3) ** 0.5
"""Standard deviation of the interpolated lattice: variance 1/3 at the nodes, times the mean of w^2 + (1-w)^2 = 26/35 along each
axis.
"""
_PRIMES = (0x8DA6B343, 0xD8163841, 0xCB1AB31F)
"""Multipliers of the lattice hash, one per axis."""


class TextureConfig(Config):
    """Texture of the rock beyond the mesh's albedo; only the image matcher sees it.

    It is fractal noise: a sum of octaves, each with half the grain size of the one before. It modulates the rock's reflectance
    in rendered photographs, so that a matcher finds details in them.
    """

    contrast: float = Field(0.12, ge=0, le=1, description="standard deviation of each octave, as a share of the albedo")
    coarsest_m: float = Field(1.0, gt=0, le=100, description="grain of the coarsest octave; finer ones follow by halves [m]")

    def texture(self, random: KeyedRandom) -> RockTexture:
        """Return the rock texture with these settings, drawn with the random numbers of `random`.

        Call it once for a run: the texture is then the same in every epoch.
        """
        return RockTexture(self.contrast, self.coarsest_m, random.key & 0xFFFFFFFF)


@dataclass(frozen=True)
class RockTexture:
    """Fractal value noise in space, which gives the rock of rendered photographs details that a matcher can find.

    Octaves have equal contrast, so that the power spectrum falls with 1/f^2 (f: spatial frequency), as in natural images.

    Attributes
    ----------
    contrast : float
        Standard deviation of each octave, as a share of the albedo.
    coarsest_m : float
        Grain size of the coarsest octave, m; each further octave has half the size of the one before.
    key : int
        Seed of the noise, 32 bits.
    """

    contrast: float
    coarsest_m: float
    key: int

    def factor(self, point: mi.Array3f64, footprint_m: float) -> mi.Float32:
        """Return the factor (n,) by which the texture multiplies the rock's albedo at points 3 x (n,), m.

        The factor's logarithm has mean 0 and is nearly Gaussian. Octaves end at `footprint_m`, the size of a pixel on the rock,
        m, because finer grain averages out within a pixel. An octave between half the footprint and the footprint fades in, so
        that the rock looks alike from similar distances.
        """
        octaves = max(1, int(np.ceil(np.log2(self.coarsest_m / footprint_m))) + 1)
        total = mi.Float32(0)
        for octave in range(octaves):
            grain = self.coarsest_m / 2**octave
            weight = np.clip(1 + np.log2(grain / footprint_m), 0, 1)
            total += dr.opaque(mi.Float32, float(weight)) * solid_noise(point, grain, (self.key + octave) & 0xFFFFFFFF)
        return dr.exp(dr.opaque(mi.Float32, self.contrast) * total)


def solid_noise(point: mi.Array3f64, grain_m: float, key: int) -> mi.Float32:
    """Evaluate smooth random noise in space at n points; used for rock texture, wet patches and vegetation.

    The values (n,) have mean 0 and standard deviation 1.

    Hashed random numbers on a lattice with spacing `grain_m` are interpolated with smoothstep weights 3 f^2 - 2 f^3 (Perlin
    1985); the hash of the nodes follows Teschner et al. (2003).

    Parameters
    ----------
    point : 3 x (n,)
        Positions, m.
    grain_m : float
        Spacing of the lattice, m.
    key : int
        Seed, 32 bits.
    """
    position = point * dr.opaque(mi.Float64, 1 / grain_m)
    cell = dr.floor(position)
    near = [mi.UInt32(mi.Int32(axis)) * prime for axis, prime in zip(cell, _PRIMES, strict=True)]
    nodes = [(start, start + prime) for start, prime in zip(near, _PRIMES, strict=True)]
    fraction = [mi.Float32(axis) for axis in position - cell]
    weight = [f * f * (3 - 2 * f) for f in fraction]
    seed = dr.opaque(mi.UInt32, key)

    def along_x(y: int, z: int) -> mi.Float32:
        rest = nodes[1][y] ^ nodes[2][z] ^ seed
        return dr.lerp(_uniform(nodes[0][0] ^ rest), _uniform(nodes[0][1] ^ rest), weight[0])

    near_face, far_face = (dr.lerp(along_x(0, z), along_x(1, z), weight[1]) for z in (0, 1))
    return dr.lerp(near_face, far_face, weight[2]) / _DEVIATION


def _uniform(value: mi.UInt32) -> mi.Float32:
    """Hash the bits of `value` to a number in [-1, 1) (integer hash `lowbias32`, Wellons 2018)."""
    value ^= value >> 16
    value *= 0x7FEB352D
    value ^= value >> 15
    value *= 0x846CA68B
    value ^= value >> 16
    return mi.Float32(value >> 8) * (2.0 / 2**24) - 1.0
