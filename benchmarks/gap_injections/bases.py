"""Real measurements before an effect is injected: folders as `scarpsim measurement` builds them, and their raw values."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from benchmarks.gap_injections.formulas import IN_RASTER, Array, Matched, Optics, Scan, Values, in_raster, matched, scanned
from pipeline.formats.cameras.cameras import write_cameras_yaml
from pipeline.formats.meshes.ply import read_ply, write_ply, write_ply_points
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import read_laz, write_laz
from pipeline.measurement.build import Request, build
from scene.geometry.mesh import TriangleMesh
from sensors.cameras.camera import Camera, CameraPair
from sensors.stereo.matching import MatchingConfig, SearchRange, match, without_speckles
from sensors.stereo.refinement import refine

DATA = Path(__file__).resolve().parents[2].parent / "shared/data"
F_PX, BASE_M, OPTICS = 994.978, 0.193001, Optics(994.978, 311.193, 254.877, 31.086)
"""Middlebury's calibration of the motorcycle."""
_JUMP_PX = 1.0
"""Neighbouring disparities that differ by more, px, are of two surfaces."""
_BELIEVED = {"parallax_sigma_px": 0.05, "regularization_sigma_px": 0.0, "regularization_step_px": 32}
_ROCKS_POSITION = (547449.975, 149565.052, 724.844)
"""Position proposed by `scarpsim measurement`, as the file does not state where the scanner stood."""


@dataclass(frozen=True)
class Base:
    """A measurement into which effects are injected.

    Attributes
    ----------
    make : Writes the measurement's folder.
    put : Writes another folder with an effect, given its name, values and a seed.
    about : Description.
    """

    name: str
    about: str
    make: Callable[[Path], None]
    put: Callable[[Path, Path, str, Values, int], None]


def forest(azimuth_deg: tuple[float, float], zenith_deg: tuple[float, float], step: int = 1) -> Callable[[Path], None]:
    """Return a function that makes a measurement of a window of the forest scan: every second pulse against the others.

    step: takes every n-th pair of pulses.
    """

    def make(folder: Path) -> None:
        held = np.load(DATA / "tls_forest_vz400i/TLS_scan.npz")
        points = np.stack([held["X"], held["Y"], held["Z"]], axis=1).astype(np.float64)[held["Target_count"] == 1]
        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        zenith = np.degrees(np.arccos(points[:, 2] / np.linalg.norm(points, axis=1)))
        inside = (azimuth >= azimuth_deg[0]) & (azimuth < azimuth_deg[1])
        inside &= (zenith >= zenith_deg[0]) & (zenith < zenith_deg[1])
        scan = folder.with_suffix(".laz")
        write_laz(scan, PointCloud(points[inside]))
        build(Request([scan], "half", "riegl_vz400i"), folder)
        if step > 1:
            _thin(folder / "scan_0.laz", step)

    return make


def rocks(folder: Path) -> None:
    """Make a measurement of every second point of the file against the others."""
    values = np.loadtxt(DATA / "tls_rock_blocks/Blocs_EGU_avant.txt")
    scan = folder.with_suffix(".xyz")
    np.savetxt(scan, values, fmt="%.6f")
    request = Request([scan], "half", "riegl_vz400i", position=_ROCKS_POSITION, columns=("x", "y", "z", "intensity"))
    build(request, folder)


def _thin(path: Path, step: int) -> None:
    cloud = read_laz(path)
    write_laz(path, cloud.part(np.arange(0, len(cloud.points), step)))


def put_scanned(base: Path, out: Path, name: str, p: Values, seed: int) -> None:
    """Copy a scan's folder with an effect in its points."""
    _copied(base, out)
    about = yaml.safe_load((base / "measurement.yaml").read_text())
    position, rotation = (np.array(about["scanner"][key]) for key in ("position_m", "rotation"))
    cloud = read_laz(base / "scan_0.laz")
    local, surface = ((points - position) @ rotation for points in (cloud.points, read_ply(base / "reference.ply").vertices))
    line = np.asarray(cloud.extra.get("line", np.zeros(len(local))), dtype=np.float64)
    found = scanned(name, p, Scan.of(local, surface, line, cloud.intensity), np.random.default_rng(seed))
    write_laz(out / "scan_0.laz", replace(cloud, points=found.local @ rotation.T + position))


def structured_light(folder: Path) -> None:
    """Make a measurement of the measured disparities of odd rows against those of even rows."""
    true = _measured()
    rows = np.zeros(len(true), dtype=bool)
    rows[1::2] = True
    kept = true.copy()
    kept[~rows] = np.nan
    _write_pair(folder, true, kept)


def refined(folder: Path) -> None:
    """Make a measurement of disparities found by the refined semi-global matcher against the measured ones."""
    left, right = (
        np.asarray(cv2.imread(str(DATA / f"stereo_motorcycle/motorcycle_{side}.png"), cv2.IMREAD_GRAYSCALE), dtype=np.float32)
        for side in ("left", "right")
    )
    true, config = _measured(), MatchingConfig()
    assert config.refinement
    coarse = match(left, right, SearchRange.between(float(np.nanmin(true)), float(np.nanmax(true))), config)
    fine = refine(left, right, coarse, config.refinement)
    _write_pair(folder, true, np.asarray(without_speckles(fine, config.speckle_px), dtype=np.float64))


def _measured() -> Array:
    true = np.load(DATA / "stereo_motorcycle/motorcycle_disp.npz")["arr_0"].astype(float)
    return np.where(np.isfinite(true), true, np.nan)


def _write_pair(folder: Path, true: Array, found: Array) -> None:
    """Write a pair's folder.

    true: disparities of the surface; found: (rows, columns) disparities of the points, which are also kept.
    """
    folder.mkdir(parents=True)
    even = true.copy()
    if np.isnan(found[::2]).all():
        even[1::2] = np.nan
    write_ply(folder / "reference.ply", _surface(even[::2], 2) if np.isnan(found[::2]).all() else _surface(true, 1))
    np.save(folder / "disparity.npy", found)
    write_cameras_yaml(folder / "cameras.yaml", _cameras(true.shape))
    files = {"reference": "reference.ply", "points": "surface.ply", "cameras": "cameras.yaml", "model": "model.yaml"}
    (folder / "measurement.yaml").write_text(yaml.safe_dump({"sensor": "stereo", "frame": "world", **files}))
    (folder / "model.yaml").write_text(yaml.safe_dump({"sensor": "stereo", "noise": _BELIEVED, "effects": []}))
    put_matched(folder, folder, "none", {}, 0)


def put_matched(base: Path, out: Path, name: str, p: Values, seed: int, most: int = 16_000) -> None:
    """Copy a pair's folder with an effect in its disparities; most: number of points, on a raster."""
    if out != base:
        _copied(base, out)
    rng = np.random.default_rng(seed)
    raster = np.load(base / "disparity.npy")
    raster = in_raster(name, p, raster, rng) if name in IN_RASTER else raster
    step = max(int(np.ceil(np.sqrt(np.isfinite(raster).sum() / most))), 1)
    used = np.flatnonzero(np.isfinite(raster).any(axis=1))[::step]
    rows, columns = np.nonzero(np.isfinite(raster[used][:, ::step]))
    rows, columns = used[rows], columns * step
    seen = Matched(columns + 0.5, rows + 0.5, raster[rows, columns])
    seen = seen if name in IN_RASTER else matched(name, p, seen, OPTICS, rng)
    pixels = {"pixel_x": seen.u, "pixel_y": seen.v}
    write_ply_points(out / "surface.ply", PointCloud(_point(seen.u - 0.5, seen.v - 0.5, seen.d), extra=pixels))


def _copied(base: Path, out: Path) -> None:
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    for file in base.iterdir():
        if file.suffix in (".yaml", ".ply"):
            shutil.copy(file, out / file.name)


def _point(column: Any, row: Any, disparity: Array) -> Array:
    """(n, 3) world points (x right, y forward, z up), m."""
    depth = F_PX * BASE_M / (disparity + OPTICS.offset)
    return np.stack([(column - OPTICS.cx) / F_PX * depth, depth, -(row - OPTICS.cy) / F_PX * depth], axis=1)


def _cameras(shape: tuple[int, ...]) -> CameraPair:
    height, width = shape[:2]
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # columns: camera x, y, z in the world

    def camera(offset_px: float, x_m: float) -> Camera:
        cx, cy = OPTICS.cx + offset_px + 0.5 - width / 2, OPTICS.cy + 0.5 - height / 2
        lens = dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0.0)
        return Camera(width, height, F_PX, cx, cy, 0.0, 0.0, **lens, position=np.array([x_m, 0.0, 0.0]), rotation=rotation)

    return CameraPair(camera(0.0, 0.0), camera(OPTICS.offset, BASE_M))


def _surface(true: Array, row_px: int) -> TriangleMesh:
    """Mesh the disparities of every `row_px`-th row, cut at jumps."""
    rows, columns = np.indices(true.shape)
    vertices = _point(columns.ravel(), row_px * rows.ravel(), true.ravel())
    number = np.arange(true.size).reshape(true.shape)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.concatenate([np.stack([a, d, b], axis=1), np.stack([b, d, c], axis=1)])
    corners = true.ravel()[faces]
    faces = faces[np.isfinite(corners).all(axis=1) & (np.ptp(corners, axis=1) < _JUMP_PX)]
    used, index = np.unique(faces, return_inverse=True)
    return TriangleMesh(vertices[used], index.reshape(-1, 3).astype(np.int32))


_GROUND = "ground of the forest (RIEGL VZ-400i), 40 degrees of azimuth, 2 to 5 m away, one half against the other"
_TREES = "trunks, twigs and ground of the same forest, all zenith angles"
_ROCKS = "34 patches of a scanned rock face, coordinates rounded to 6 cm, one half of the points against the other"
_LIGHT = (
    "photographs of the scene Motorcycle (Middlebury 2014): disparities measured with structured "
    "light, odd rows against even ones"
)
_MATCHER = "the same scene: disparities of OpenCV's refined matcher against those of structured light"
BASES = {
    base.name: base
    for base in (
        Base("ground_1", _GROUND, forest((-170, -130), (104, 131)), put_scanned),
        Base("ground_2", _GROUND, forest((-80, -40), (104, 131)), put_scanned),
        Base("ground_3", _GROUND, forest((100, 140), (104, 131)), put_scanned),
        Base("ground_4", _GROUND, forest((-30, 10), (104, 131)), put_scanned),
        Base("trees", _TREES, forest((140, 170), (40, 131)), put_scanned),
        Base("rocks", _ROCKS, rocks, put_scanned),
        Base("light", _LIGHT, structured_light, put_matched),
        Base("matcher", _MATCHER, refined, put_matched),
    )
}
