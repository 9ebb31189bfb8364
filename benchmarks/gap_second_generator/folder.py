"""Write measurement folders as CONTRACT.md specifies them: PLY (binary), .xyz, and the YAML files, with NumPy only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .surface import Array


def write_ply(path: Path, points: Array, fields: dict[str, Array], faces: np.ndarray[Any, Any] | None = None) -> None:
    """Binary little-endian: doubles x, y, z and `fields`, triangles where given."""
    names = ["x", "y", "z", *fields]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    head += [f"property double {each}" for each in names]
    if faces is not None:
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    table = np.column_stack([points, *fields.values()]).astype("<f8")
    with path.open("wb") as file:
        file.write(("\n".join([*head, "end_header"]) + "\n").encode())
        file.write(table.tobytes())
        if faces is not None:
            rows = np.zeros(len(faces), np.dtype([("count", "u1"), ("index", "<i4", 3)]))
            rows["count"], rows["index"] = 3, faces
            file.write(rows.tobytes())


def write_points(path: Path, points: Array, fields: dict[str, Array]) -> None:
    """As the name's ending says: .ply with fields, or .xyz (micrometres) without."""
    if path.suffix == ".xyz":
        np.savetxt(path, points, fmt="%.6f")
    else:
        write_ply(path, points, fields)


def yaml_text(value: Any, indent: int = 0) -> str:
    """Block YAML of nested dicts with flow lists; floats with all their digits."""
    lines = []
    for key, each in value.items():
        if isinstance(each, dict):
            lines.append(" " * indent + f"{key}:\n" + yaml_text(each, indent + 2))
        else:
            lines.append(" " * indent + f"{key}: {_flow(each)}\n")
    return "".join(lines)


def _flow(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_flow(each) for each in value) + "]"
    return f"{value:.12f}" if isinstance(value, float) else str(value)
