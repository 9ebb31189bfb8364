"""Walls, blocks, carving, ray casting, random numbers; what one's own sensor looks at stands at the top level."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scene.lazy import lazily

if TYPE_CHECKING:
    from scene.blocks import Blocks as Blocks
    from scene.carve import Carved as Carved
    from scene.errors import InputError as InputError
    from scene.frame import WallFrame as WallFrame
    from scene.keyed_random import KeyedRandom as KeyedRandom
    from scene.mesh import TriangleMesh as TriangleMesh
    from scene.raycast import RayCaster as RayCaster

_MODULES = {
    "scene.blocks": ("Blocks",),
    "scene.carve": ("Carved",),
    "scene.errors": ("InputError",),
    "scene.frame": ("WallFrame",),
    "scene.keyed_random": ("KeyedRandom",),
    "scene.mesh": ("TriangleMesh",),
    "scene.raycast": ("RayCaster",),
}
__all__ = [name for names in _MODULES.values() for name in names]  # noqa: PLE0604, RUF100
__getattr__, __dir__ = lazily(__name__, {name: module for module, names in _MODULES.items() for name in names})
