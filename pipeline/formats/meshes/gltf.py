"""Write meshes as binary glTF, for slides and web pages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.files.atomic import write_bytes
from scene.common.errors import InputError
from scene.geometry.mesh import TriangleMesh


@dataclass(frozen=True)
class GltfPart:
    """A named part of a glTF model, such as a wall or a block: a mesh with RGBA colours (n, 4), 0 to 255, of its n vertices."""

    name: str
    mesh: TriangleMesh
    colours: NDArray[np.uint8]


def write_gltf(path: Path, parts: Sequence[GltfPart]) -> None:
    """Write meshes to a .glb file (glTF), for viewers of 3D models, with one named node for each part.

    The wall frame's axes are glTF's: x right, y up, z towards the viewer. Positions are float32, as glTF requires: 4
    micrometres at 60 m. Raises InputError for another suffix.
    """
    if path.suffix.lower() != ".glb":
        raise InputError(
            f"unknown format '{path.suffix}'", where=str(path), allowed=".glb", remedy="choose a file name that ends in .glb"
        )
    import trimesh

    scene = trimesh.Scene()
    for part in parts:
        shown = trimesh.Trimesh(part.mesh.vertices, part.mesh.faces, vertex_colors=part.colours, process=False)
        scene.add_geometry(shown, node_name=part.name, geom_name=part.name)
    write_bytes(path, trimesh.exchange.gltf.export_glb(scene))
