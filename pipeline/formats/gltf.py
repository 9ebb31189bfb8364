"""Meshes as binary glTF, for slides and web pages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.atomic import write_bytes
from scene.errors import InputError
from scene.mesh import TriangleMesh


def write_gltf(path: Path, mesh: TriangleMesh, colours: NDArray[np.uint8]) -> None:
    """Write a .glb file; colours: (n, 4) RGBA of the vertices. The wall frame's axes are glTF's: x right, y up, z to the viewer.

    Positions are float32, as glTF has them: 4 micrometres at 60 m. Raises InputError for another suffix.
    """
    if path.suffix.lower() != ".glb":
        raise InputError(f"is of an unknown format '{path.suffix}'", where=str(path), allowed=".glb")
    import trimesh

    shown = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)
    write_bytes(path, trimesh.exchange.gltf.export_glb(trimesh.Scene(shown)))
