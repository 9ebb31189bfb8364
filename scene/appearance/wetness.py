"""Darken wet rock: smooth patches, fixed in space, where a film of water lowers the albedo."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from pydantic import Field

from scene.appearance.texture import solid_noise
from scene.common.config import Config
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import DEFAULT_ALBEDO, FloatArray, TriangleMesh
from scene.ray_casting.upload import vectors_on_device

_RAMP = 0.2
"""Width of the transition from dry to wet, in standard deviations of the noise: a few hundredths of a patch."""
_SAMPLES = 1 << 18
"""Number of noise samples from which the threshold for a share is taken."""


class WetnessConfig(Config):
    """Wet patches of rock, which return weaker echoes to a laser scanner and are darker in photographs.

    The albedo of the rock in a patch is multiplied by `albedo_factor`. The patches are drawn at random from `seed` and lie in the
    same places in every epoch.
    """

    share: float = Field(0.3, ge=0, le=1, description="share of the rock that is wet, on a wall much larger than a patch")
    albedo_factor: float = Field(
        0.5,
        gt=0,
        le=1,
        description="albedo of wet over dry rock; about 0.5 in the visible (Lekner and Dorf 1988), less near 1.5 um",
    )
    patch_m: float = Field(4.0, gt=0, le=1000, description="size of a patch [m]")
    seed: int = Field(1, ge=0, lt=2**63, description="seed of the patches")

    def with_wet_patches(self, mesh: TriangleMesh) -> TriangleMesh:
        """Return the mesh (wall frame) with lower albedo at wet vertices, as a sensor meets the wet rock.

        If nothing is wet or darkened, it is the argument `mesh` itself.
        """
        if self.share == 0 or self.albedo_factor == 1:
            return mesh
        dry = np.full(len(mesh.vertices), DEFAULT_ALBEDO, np.float32) if mesh.vertex_albedo is None else mesh.vertex_albedo
        factor = 1 - (1 - self.albedo_factor) * self.wetness(mesh.vertices)
        return replace(mesh, vertex_albedo=(dry * factor).astype(np.float32))

    def wetness(self, points: FloatArray) -> FloatArray:
        """Return how wet the rock is, (n,), at points (n, 3), m, wall frame: 0 dry, 1 wet, with a smooth transition.

        Wet patches lie at the same places in every epoch; elsewhere the rock is dry.
        """
        key = KeyedRandom(self.seed).child("wetness").key & 0xFFFFFFFF
        ramp = np.clip((_noise(points / self.patch_m, key) - _threshold(self.share)) / _RAMP + 0.5, 0, 1)
        return ramp * ramp * (3 - 2 * ramp)


def _noise(points: FloatArray, key: int) -> FloatArray:
    """Return smooth noise (n,) at points (n, 3), given in units of its grain."""
    return solid_noise(vectors_on_device(points), 1.0, key).numpy().astype(np.float64)


@cache
def _threshold(share: float) -> float:
    """Return the value that a share of the noise exceeds, over many patches; infinite if all or none does."""
    if share in (0, 1):
        return np.inf if share == 0 else -np.inf
    points = np.random.Generator(np.random.Philox(key=0)).uniform(0, 4096, (_SAMPLES, 3))
    return float(np.quantile(_noise(points, 0), 1 - share))
