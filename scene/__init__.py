"""Make rock walls, carve blocks out of them, and trace rays against the result.

Nothing here depends on a sensor. The names below can be imported from `scene` itself by code that adds a sensor of its own.
Start with `walls`, `blocks` and `ray_casting`; `common` holds errors, config models and random numbers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scene.common.lazy import lazy_attributes

if TYPE_CHECKING:
    from scene.blocks.block import Blocks as Blocks
    from scene.blocks.carve import Carved as Carved
    from scene.common.errors import InputError as InputError
    from scene.common.keyed_random import KeyedRandom as KeyedRandom
    from scene.geometry.frame import WallFrame as WallFrame
    from scene.geometry.mesh import TriangleMesh as TriangleMesh
    from scene.ray_casting.raycast import RayCaster as RayCaster

_MODULES = {
    "scene.blocks.block": ("Blocks",),
    "scene.blocks.carve": ("Carved",),
    "scene.common.errors": ("InputError",),
    "scene.geometry.frame": ("WallFrame",),
    "scene.common.keyed_random": ("KeyedRandom",),
    "scene.geometry.mesh": ("TriangleMesh",),
    "scene.ray_casting.raycast": ("RayCaster",),
}
__all__ = [name for names in _MODULES.values() for name in names]  # noqa: PLE0604, RUF100
__getattr__, __dir__ = lazy_attributes(__name__, {name: module for module, names in _MODULES.items() for name in names})
