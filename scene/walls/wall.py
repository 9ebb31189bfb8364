"""The wall that a run starts from: made by rule or read from a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Discriminator, Tag

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh
from scene.walls.imported import ImportedWall
from scene.walls.procedural import ProceduralWall


@dataclass(frozen=True)
class Wall:
    """A rock wall. mesh: world frame, m, float64; repairs: what was mended in it, in words with counts; name: for reports; file:
    where it was read from, for errors."""

    mesh: TriangleMesh
    repairs: tuple[str, ...]
    name: str
    file: str = ""


def _kind(values: Any) -> str:
    """The key `mesh` makes it an imported wall."""
    named = "mesh" in values if isinstance(values, Mapping) else isinstance(values, ImportedWall)
    return "imported" if named else "procedural"


WallConfig = Annotated[
    Annotated[ProceduralWall, Tag("procedural")] | Annotated[ImportedWall, Tag("imported")],
    Discriminator(_kind),
]


def build_wall(config: ProceduralWall | ImportedWall, random: KeyedRandom) -> Wall:
    """The wall that `config` describes; `random` serves a procedural wall without a seed of its own.

    Raises InputError where the mesh file cannot be used.
    """
    if isinstance(config, ProceduralWall):
        return Wall(config.mesh(random), (), config.style)
    mesh, repairs = config.load()
    return Wall(mesh, repairs, " + ".join(file.stem for file in config.files), ", ".join(map(str, config.files)))
