"""Meshes for the tests of imported walls, and files of them."""

from __future__ import annotations

import numpy as np
from surfaces import heightfield

from scene.geometry.mesh import TriangleMesh

UTM = np.array([500_000.0, 5_000_000.0, 800.0])


def sheet(rows=6, columns=8, step=1.0):
    """Return an open, slightly wavy sheet of 2 (rows - 1)(columns - 1) triangles."""
    v, u = np.meshgrid(np.arange(rows) * step, np.arange(columns) * step, indexing="ij")
    vertices = np.stack([u, 0.1 * np.sin(u + 2 * v) + 1 / 3, v], axis=-1).reshape(-1, 3)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + columns + 1], axis=1)
    upper = np.stack([corner, corner + columns + 1, corner + columns], axis=1)
    return TriangleMesh(vertices, np.concatenate([lower, upper]).astype(np.int32))


def written(path, mesh, colours=None):
    """Write a mesh: .obj and .off as text; .ply binary in double precision (trimesh itself writes float32)."""
    vertices, faces = mesh.vertices, mesh.faces
    if path.suffix == ".obj":
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
        path.write_text("\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist())]) + "\n")
    elif path.suffix == ".off":
        lines = [f"{x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
        lines = ["OFF", f"{len(vertices)} {len(faces)} 0", *lines, *(f"3 {a} {b} {c}" for a, b, c in faces.tolist())]
        path.write_text("\n".join(lines) + "\n")
    else:
        fields = [("position", "<f8", 3)] + ([("colour", "u1", 3)] if colours is not None else [])
        points = np.zeros(len(vertices), fields)
        points["position"] = vertices
        header = "ply\nformat binary_little_endian 1.0\n" + f"element vertex {len(vertices)}\n"
        header += "".join(f"property double {axis}\n" for axis in "xyz")
        if colours is not None:
            points["colour"] = colours
            header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
        triangles = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
        triangles["count"], triangles["corners"] = 3, faces
        header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        path.write_bytes(header.encode() + points.tobytes() + triangles.tobytes())
    return path


def rock(spacing=0.35, seed=3):
    """Return a rough upright wall of 14 x 10 m, oblique to the axes, whose coordinates use all digits."""
    mesh = heightfield(14.0, 10.0, spacing, seed=seed)
    x, y, z = mesh.vertices.T
    return mesh.with_vertices(np.stack([0.8 * x + 0.6 * z, 0.6 * x - 0.8 * z, y + 0.03 * z], axis=1))
