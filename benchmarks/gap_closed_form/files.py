"""Write the files of a measurement folder, as CONTRACT.md specifies them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.gap_closed_form.casting import Array


def write_mesh(path: Path, vertices: Array, faces: Any) -> None:
    """Write a binary PLY mesh in double precision."""
    record = np.zeros(len(faces), dtype=[("n", "u1"), ("v", "<i4", (3,))])
    record["n"], record["v"] = 3, faces
    lines = [f"element vertex {len(vertices)}", *_doubles("xyz"), f"element face {len(faces)}"]
    head = _head([*lines, "property list uchar int vertex_indices"])
    path.write_bytes(head + vertices.astype("<f8").tobytes() + record.tobytes())


def write_points(path: Path, points: Array, fields: dict[str, Array]) -> None:
    """Points (n, 3) with further fields (n,): binary PLY, or text without fields (.xyz)."""
    if path.suffix == ".xyz":
        np.savetxt(path, points, fmt="%.7f")
        return
    table = np.concatenate([points, *(values[:, None] for values in fields.values())], axis=1)
    head = _head([f"element vertex {len(points)}", *_doubles(["x", "y", "z", *fields])])
    path.write_bytes(head + table.astype("<f8").tobytes())


def write_yaml(path: Path, values: dict[str, Any]) -> None:
    """Keys in the order given; arrays become lists."""
    path.write_text(yaml.safe_dump(plain(values), sort_keys=False, default_flow_style=None))


def plain(value: Any) -> Any:
    """Convert values to types that YAML and JSON have."""
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value


def _doubles(names: Any) -> list[str]:
    return [f"property double {name}" for name in names]


def _head(lines: list[str]) -> bytes:
    return "\n".join(["ply", "format binary_little_endian 1.0", *lines, "end_header", ""]).encode()
