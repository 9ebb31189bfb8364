"""Export a run's wall and the niches of its blocks as glTF, for slides and web pages."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.export.exported_run import ExportedRun
from pipeline.export.perspective import colours_of, difference_at
from pipeline.formats.meshes.gltf import GltfPart, write_gltf
from scene.geometry.mesh import WALL, TriangleMesh, compact_vertices


def save_gltf(run: ExportedRun, number: int, path: Path) -> None:
    """Write the measured surface of an epoch as a .glb file (glTF), for viewers of 3D models.

    The wall and the niche of each block (`block_12`) are separate parts, coloured by the difference as in the report,
    grey without data. run: the run. number: of the epoch, from 1. path: the .glb file. Raises InputError if the run wrote
    no surface.
    """
    surface, (values, grid) = run.surface(number), run.difference(number)
    colours = colours_of(difference_at(surface.vertices, values, grid), run.limit_m(number))
    label = np.full(len(surface.faces), WALL) if surface.face_block is None else surface.face_block
    parts = []
    for block in np.unique(label).tolist():
        used, faces = compact_vertices(surface.faces[label == block])
        mesh = TriangleMesh(surface.vertices[used], faces)
        parts.append(GltfPart("wall" if block == WALL else f"block_{block}", mesh, colours[used]))
    write_gltf(path, parts)
