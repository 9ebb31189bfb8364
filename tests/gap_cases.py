"""Measurements for the tests of `gap`, made in closed form with NumPy alone: nothing here comes from `sensors` or `pipeline`.

The wall is a height field, linear on the triangles of a regular grid, in the world's xz plane; rays are intersected with it by
Newton's method. The reference mesh is the wall plus an error that is correlated over metres; the poses have errors; some returns
are lost at random.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

Array = np.ndarray[Any, np.dtype[np.float64]]
STEP = 0.35
WIDTH, HEIGHT = 42.0, 30.0
SIGMA, ANGLE_SIGMA = 0.003, 4e-5


@dataclass(frozen=True)
class Field:
    """A wall: depth y at the nodes of a grid over x and z, linear on triangles that are cut along x - z = constant."""

    nodes: Array

    def at(self, x: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """Return depth, its derivatives by x and by z, and whether the point is inside."""
        rows, columns = self.nodes.shape
        i, j = np.clip(np.floor(x / STEP).astype(int), 0, rows - 2), np.clip(np.floor(z / STEP).astype(int), 0, columns - 2)
        a, b = x / STEP - i, z / STEP - j
        n00, n10, n01, n11 = self.nodes[i, j], self.nodes[i + 1, j], self.nodes[i, j + 1], self.nodes[i + 1, j + 1]
        lower = a >= b
        by_x, by_z = np.where(lower, n10 - n00, n11 - n01), np.where(lower, n11 - n10, n01 - n00)
        inside = (x >= 0) & (z >= 0) & (x <= (rows - 1) * STEP) & (z <= (columns - 1) * STEP)
        return n00 + a * by_x + b * by_z, by_x / STEP, by_z / STEP, inside

    def cast(self, origin: Array, ray: Array) -> tuple[Array, Array]:
        """Return the distance along unit rays (NaN where Newton's method does not converge) and the cosine of the incidence
        angle.
        """
        t = (self.nodes.mean() - origin[1]) / ray[:, 1]
        for _ in range(25):
            point = origin + t[:, None] * ray
            depth, by_x, by_z, inside = self.at(point[:, 0], point[:, 2])
            t = t - (point[:, 1] - depth) / (ray[:, 1] - by_x * ray[:, 0] - by_z * ray[:, 2])
        left = np.abs((origin + t[:, None] * ray)[:, 1] - self.at(*(origin + t[:, None] * ray)[:, [0, 2]].T)[0])
        cosine = np.abs(ray[:, 1] - by_x * ray[:, 0] - by_z * ray[:, 2]) / np.sqrt(1 + by_x**2 + by_z**2)
        return np.where(inside & (left < 1e-7) & (t > 0), t, np.nan), cosine

    def write(self, path: Path) -> None:
        """Write a binary PLY mesh whose faces point towards -y."""
        rows, columns = self.nodes.shape
        x, z = np.meshgrid(STEP * np.arange(rows), STEP * np.arange(columns), indexing="ij")
        vertices = np.stack([x, self.nodes, z], axis=-1).reshape(-1, 3)
        number = np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
        faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
        record = np.zeros(len(faces), dtype=[("n", "u1"), ("v", "<i4", (3,))])
        record["n"], record["v"] = 3, faces
        head = (
            f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\nproperty double x\nproperty double y\n"
            f"property double z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        )
        path.write_bytes(head.encode() + vertices.astype("<f8").tobytes() + record.tobytes())


def smooth_noise(shape: tuple[int, int], length_m: float, rng: np.random.Generator) -> Array:
    """Return a sum of random waves of about `length_m`, with standard deviation 1."""
    x, z = np.meshgrid(*(STEP * np.arange(size) for size in shape), indexing="ij")
    total = np.zeros(shape)
    for _ in range(40):
        angle, phase, k = rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi), 2 * np.pi / (length_m * rng.uniform(0.7, 2.5))
        total += np.sin(k * (np.cos(angle) * x + np.sin(angle) * z) + phase)
    return total / np.sqrt(20)


@dataclass
class Scan:
    """A scan before its points are written; an effect may change it.

    R: ranges to be recorded, m; az, z: azimuth and zenith angle, rad; cos_i: cosine of the incidence angle; power: relative
    received power; line: scan line; share: share of the scan's duration that has passed.
    """

    R: Array
    az: Array
    z: Array
    cos_i: Array
    power: Array
    line: Array
    share: Array
    rng: np.random.Generator


@dataclass(frozen=True)
class ScanCase:
    """What a scan is like.

    angles: function of (azimuth, zenith, line) that returns recorded minus true angles; ranges: function that returns the
    recorded ranges; lost: function that returns which returns are lost; fall: x, z and depth of a niche of 1.2 m that the
    reference lacks; blocks: column, row and depth of nodes that lie deeper than in the reference (pyramids of volume depth x
    STEP^2); scans: position and face of each of several scans; scans from one position share one pose.
    """

    angles: Callable[[Array, Array, Array], tuple[Array, Array]] | None = None
    ranges: Callable[[Scan], Array] | None = None
    lost: Callable[[Scan], Array] | None = None
    fall: tuple[float, float, float] | None = None
    blocks: Sequence[tuple[int, int, float]] = ()
    step_rad: float = 0.0045
    intensity: bool = True
    epochs: int = 1
    scans: Sequence[tuple[tuple[float, float, float], int]] = ()
    stable_areas: list[list[float]] | None = None


def write_scan(folder: Path, seed: int, **how: Any) -> None:
    """Write a laser scan, or several epochs with a pose error each, as a measurement. how: fields of a `ScanCase`."""
    case = ScanCase(**how)
    rng = np.random.default_rng(seed)
    shape = int(WIDTH / STEP) + 1, int(HEIGHT / STEP) + 1
    nodes = 0.5 * smooth_noise(shape, 9.0, rng) + 0.08 * smooth_noise(shape, 2.5, rng)
    x, z = np.meshgrid(*(STEP * np.arange(size) for size in shape), indexing="ij")
    real = nodes.copy()
    if case.fall is not None:
        real += case.fall[2] * ((np.abs(x - case.fall[0]) < 0.6) & (np.abs(z - case.fall[1]) < 0.6))
    for column, row, depth in case.blocks:
        real[column, row] += depth
    wall = Field(real)
    position, turn = np.array([WIDTH * 0.42, -34.0, 2.5]), 0.01
    azimuth = np.arange(0.5 * np.pi - 0.62, 0.5 * np.pi + 0.68, case.step_rad)
    zenith = np.arange(0.85, 1.63, case.step_rad)
    az, ze = (grid.ravel() for grid in np.meshgrid(azimuth, zenith, indexing="ij"))
    line = np.repeat(np.arange(len(azimuth)), len(zenith)).astype(float)
    poses: dict[Any, Any] = {}
    scans = case.scans or [(tuple(position), 1)] * case.epochs
    for epoch, (place, face) in enumerate(scans):
        position = np.array(place)
        if face == 2:
            az, ze = az + np.pi, 2 * np.pi - ze
        daz, dz = (np.zeros_like(az),) * 2 if case.angles is None else case.angles(az, ze, line)
        true_az, true_z = (
            nominal - error - ANGLE_SIGMA * rng.standard_normal(len(az)) for nominal, error in ((az, daz), (ze, dz))
        )
        pose = 0.002 * rng.standard_normal(3), 3e-5 * rng.standard_normal(3)
        pose = poses.setdefault(place, pose) if case.scans else pose
        rotation = _turned(turn)
        skew = np.array([[0, -pose[1][2], pose[1][1]], [pose[1][2], 0, -pose[1][0]], [-pose[1][1], pose[1][0], 0]])
        true_range, cosine = wall.cast(position + pose[0], unit(true_az, true_z) @ (rotation.T @ (np.eye(3) + skew).T))
        hit = np.isfinite(true_range) & (cosine > 0.15)
        albedo = 0.4 * np.exp(0.35 * np.interp(az, azimuth, smooth_noise((len(azimuth), 2), 8.0, rng)[:, 0]))
        albedo = albedo * np.exp(0.3 * rng.standard_normal(len(az)))
        power = albedo * cosine * (100 / np.where(hit, true_range, 1e3)) ** 2
        scan = Scan(
            true_range + SIGMA * rng.standard_normal(len(az)), az, ze, cosine, power, line, np.arange(len(az)) / len(az), rng
        )
        recorded = scan.R if case.ranges is None else case.ranges(scan)
        keep = hit & (rng.uniform(size=len(az)) > 0.01)
        keep &= True if case.lost is None else ~case.lost(scan)
        columns = [*(unit(az, ze) * recorded[:, None]).T, power, 5e-5 * np.arange(len(az))]
        _points(
            folder / f"scan_{epoch}.ply",
            [column[keep] for column in columns],
            ["x", "y", "z", "intensity", "gps_time"],
            case.intensity,
        )
        if face == 2:
            az, ze = az - np.pi, 2 * np.pi - ze
    Field(nodes + 0.0004 * smooth_noise(shape, 3.0, rng)).write(folder / "wall.ply")
    _yaml(
        folder / "model.yaml", {"sensor": "tls", "noise": {"range_sigma_m": SIGMA, "angle_sigma_rad": ANGLE_SIGMA}, "effects": []}
    )
    _yaml(
        folder / "measurement.yaml",
        {
            "sensor": "tls",
            "reference": "wall.ply",
            "points": [f"scan_{epoch}.ply" for epoch in range(len(scans))] if len(scans) > 1 else "scan_0.ply",
            "stable_areas": case.stable_areas or [],
            "frame": "scanner",
            **(_of_several(case.scans, rotation) if case.scans else _of_one(position, rotation, azimuth, zenith, case.step_rad)),
            "model": "model.yaml",
        },
    )


def _of_one(position: Array, rotation: Array, azimuth: Array, zenith: Array, step_rad: float) -> dict[str, Any]:
    sweeps = {"azimuth_rad": azimuth, "zenith_rad": zenith}
    return {
        "scanner": {"position_m": position.tolist(), "rotation": rotation.tolist()},
        "pattern": {name: [float(each[0]), float(each[-1]) + 1e-9, step_rad] for name, each in sweeps.items()},
    }


def _of_several(scans: Sequence[Any], rotation: Array) -> dict[str, Any]:
    return {"scanners": [{"position_m": list(place), "rotation": rotation.tolist(), "face": face} for place, face in scans]}


def unit(azimuth: Array, zenith: Array) -> Array:
    """Return unit vectors of azimuth = atan2(y, x) and of the zenith angle from +z."""
    return np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=1)


def _turned(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])


def _yaml(path: Path, values: dict[str, Any]) -> None:
    path.write_text(yaml.safe_dump(values))


def _points(path: Path, columns: list[Array], names: list[str], intensity: bool) -> None:
    kept = [(name, column) for name, column in zip(names, columns, strict=True) if intensity or name != "intensity"]
    record = np.zeros(len(columns[0]), dtype=[(name, "<f8") for name, _ in kept])
    for name, column in kept:
        record[name] = column
    properties = "".join(f"property double {name}\n" for name, _ in kept)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(record)}\n{properties}end_header\n"
    path.write_bytes(head.encode() + record.tobytes())
