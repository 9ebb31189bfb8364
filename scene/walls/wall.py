"""Build the wall that a run starts from, by rules or from a file."""

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
    """A rock wall, generated or imported, before any rockfall.

    Attributes
    ----------
    mesh : TriangleMesh
        The surface, world frame, m.
    repairs : tuple of str
        What was repaired in it, in words with counts.
    name : str
        Name for reports.
    file : str
        The file that it was read from, for error messages.
    """

    mesh: TriangleMesh
    repairs: tuple[str, ...]
    name: str
    file: str = ""


def _kind(values: Any) -> str:
    """Tell an imported wall, which has the key `mesh`, from a procedural one."""
    named = "mesh" in values if isinstance(values, Mapping) else isinstance(values, ImportedWall)
    return "imported" if named else "procedural"


WallConfig = Annotated[
    Annotated[ProceduralWall, Tag("procedural")] | Annotated[ImportedWall, Tag("imported")],
    Discriminator(_kind),
]
"""The wall section of a config, procedural or imported."""


def build_wall(config: ProceduralWall | ImportedWall, random: KeyedRandom) -> Wall:
    """Build the wall that a config describes: generate it, or read and repair its mesh files.

    `random` serves a generated wall whose config has no seed of its own. Raises InputError if a mesh file cannot be used.
    """
    if isinstance(config, ProceduralWall):
        return Wall(config.mesh(random), (), config.style)
    mesh, repairs = config.load()
    return Wall(mesh, repairs, " + ".join(file.stem for file in config.files), ", ".join(map(str, config.files)))
