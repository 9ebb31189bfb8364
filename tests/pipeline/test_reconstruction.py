"""Depth maps in other programs' conventions, and COLMAP's surface made from them, against planes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.config.simulation import SimulationConfig
from pipeline.formats.cameras.colmap import read_map
from pipeline.run.simulation import simulate
from pipeline.surface.depth_maps import DepthMap, normals, pinhole
from pipeline.surface.mesh import SurfaceConfig
from pipeline.surface.reconstruct import FusionConfig, colmap_surface, write_workspace
from scene.common.config import parse
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh
from sensors.cameras.camera import Camera

pytestmark = pytest.mark.usefixtures("undrawn")

LENS = {"b1": 1.0, "b2": -0.5, "k1": -0.05, "k2": 0.03, "k3": 0.0, "k4": 0.01, "p1": 1e-3, "p2": -7e-4}
NORMAL = np.array([0.2, -0.15, 1.0]) / np.linalg.norm([0.2, -0.15, 1.0])


def camera(x: float, lens: dict[str, float] | None = None) -> Camera:
    interior = lens or dict.fromkeys(LENS, 0.0)
    return Camera(160, 120, 200.0, 2.0, -1.0, **interior, position=np.array([x, 0.0, 50.0]), rotation=np.diag([1.0, -1.0, -1.0]))


def plane_map(x: float = 0.0, lens: dict[str, float] | None = None, noise_m: float = 0.0) -> DepthMap:
    """Return the depth map of the plane NORMAL . P = 0."""
    of = camera(x, lens)
    u, v = np.meshgrid(np.arange(of.width) + 0.5, np.arange(of.height) + 0.5)
    rays = np.stack([*of.tangents(u, v), np.ones_like(u)], axis=-1) @ of.rotation.T
    depth: FloatArray = -(of.position @ NORMAL) / (rays @ NORMAL)
    return DepthMap(of, depth + noise_m * np.random.default_rng(int(x) + 50).standard_normal(depth.shape))


def with_hole(source: DepthMap) -> DepthMap:
    depth = source.depth.copy()
    depth[40:50, 60:75] = np.nan
    return DepthMap(source.camera, depth)


# ------------------------------------------------------------------ depth maps


def test_a_plane_through_a_distorted_lens_is_resampled_exactly() -> None:
    plain = pinhole(with_hole(plane_map(lens=LENS)), 0.3)
    known = np.isfinite(plain.depth)
    assert 0.9 < known.mean() < 1
    assert np.abs(plain.points()[known] @ NORMAL).max() < 1e-4  # inverse depth is linear in the ideal, not the distorted image
    assert not known[43:47, 64:71].any()


def test_without_distortion_depths_and_holes_stay_as_they_are() -> None:
    source = with_hole(plane_map())
    np.testing.assert_allclose(pinhole(source, 0.3).depth, source.depth, rtol=1e-12)


def test_a_step_is_not_bridged() -> None:
    source = plane_map(lens=LENS)
    depth = np.where(np.arange(160) < 80, 48.0, 50.0) * np.ones((120, 1))
    found = pinhole(DepthMap(source.camera, depth), 0.3).depth
    assert set(np.round(found[np.isfinite(found)], 9)) == {48.0, 50.0}


@pytest.mark.parametrize("radius", [1, 2, 5])
def test_normals_of_a_plane_are_exact_beside_a_hole_and_at_the_border(radius: int) -> None:
    source = with_hole(plane_map())
    found = normals(source, radius) @ source.camera.rotation.T
    known = np.isfinite(found[..., 0])
    assert (known[1:-1, 1:-1] == np.isfinite(source.depth[1:-1, 1:-1])).mean() > 0.99
    np.testing.assert_allclose(found[known], np.broadcast_to(NORMAL, (known.sum(), 3)), atol=1e-9)


def test_normals_average_noise_as_least_squares_does() -> None:
    """The slope over n x n points at spacing s has sigma / (s sqrt(n^2 (n^2 - 1) / 12)); 19,000 windows, tolerance 5 %."""
    radius, sigma = 2, 0.01
    source = plane_map(noise_m=sigma)
    found = normals(source, radius) @ source.camera.rotation.T
    inside = found[radius:-radius, radius:-radius]
    slope = inside[..., 1] / inside[..., 2] - NORMAL[1] / NORMAL[2]
    flat = DepthMap(source.camera, np.full(source.depth.shape, 50.0))
    spacing, n = 50.0 / 200.0, 2 * radius + 1
    noise = flat.depth + sigma * np.random.default_rng(1).standard_normal(flat.depth.shape)
    level = normals(DepthMap(source.camera, noise), radius)[radius:-radius, radius:-radius]
    expected = sigma / spacing / np.sqrt(n**2 * (n**2 - 1) / 12)
    assert np.std(level[..., 1] / level[..., 2]) == pytest.approx(expected, rel=0.05)
    assert abs(slope.mean()) < 0.1 * np.std(slope)


# ------------------------------------------------------------------ COLMAP


@pytest.fixture(scope="module")
def pycolmap() -> Any:
    return pytest.importorskip("pycolmap", reason="the extra `colmap` is not installed")


def maps(lens: dict[str, float] | None = None) -> tuple[DepthMap, DepthMap]:
    return plane_map(-4.0, lens), plane_map(4.0, lens)


def labels(source: DepthMap) -> tuple[FloatArray, Any]:
    points = source.points().reshape(-1, 3)
    return points, np.where(points[:, 0] > 0, 7, 0).astype(np.int32)


def test_colmap_reads_the_workspace(pycolmap: Any, tmp_path: Path) -> None:
    left, right = maps(LENS)
    write_workspace(tmp_path, left, right, labels(left)[0][::500], SurfaceConfig(), 1)
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    assert (model.num_images(), model.num_cameras()) == (2, 2)
    assert model.compute_mean_reprojection_error() < 1e-6 or all(point.track.length() == 2 for point in model.points3D.values())
    path = tmp_path / "stereo/depth_maps/left.png.geometric.bin"
    theirs = pycolmap.DepthMap()
    theirs.read(path)
    np.testing.assert_array_equal(np.squeeze(theirs.to_array()), read_map(path))


def fused(lens: dict[str, float] | None = None) -> TriangleMesh:
    left, right = maps(lens)
    return colmap_surface(left, right, *labels(left), SurfaceConfig(), FusionConfig())


@pytest.fixture(scope="module")
def plain(pycolmap: Any) -> TriangleMesh:
    """COLMAP's surface of the plane, of cameras without distortion."""
    return fused()


@pytest.mark.parametrize("lens", [None, LENS])
def test_colmap_gives_a_plane_back(plain: TriangleMesh, lens: dict[str, float] | None) -> None:
    """A cell is 0.25 m wide; an error of half a pixel would move the plane by 25 mm.

    The border, where Poisson ends, is excluded.
    """
    mesh = plain if lens is None else fused(lens)
    inside = (np.abs(mesh.vertices[:, 0]) < 12) & (np.abs(mesh.vertices[:, 1]) < 10)
    assert inside.sum() > 5000
    error = mesh.vertices[inside] @ NORMAL
    assert abs(error.mean()) < 0.001
    assert np.sqrt(np.mean(error**2)) < 0.004
    assert mesh.vertex_block is not None
    sure = np.abs(mesh.vertices[:, 0]) > 0.3
    np.testing.assert_array_equal(mesh.vertex_block[sure], np.where(mesh.vertices[sure, 0] > 0, 7, 0))
    faces = mesh.vertices[mesh.faces]
    area = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    assert (area @ NORMAL > 0).mean() > 0.99  # counter-clockwise seen from the sensors


def test_equal_maps_give_equal_surfaces(plain: TriangleMesh) -> None:
    again = fused()
    np.testing.assert_array_equal(plain.vertices, again.vertices)
    np.testing.assert_array_equal(plain.faces, again.faces)


def test_maps_that_disagree_are_an_error(pycolmap: Any) -> None:
    left, right = maps()
    with pytest.raises(InputError, match="kept 0 points when it fused"):
        colmap_surface(left, DepthMap(right.camera, right.depth * 1.05), *labels(left), SurfaceConfig(), FusionConfig())


def test_without_pycolmap_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    left, right = maps()
    with pytest.raises(InputError, match="make setup EXTRAS=colmap"):
        colmap_surface(left, right, *labels(left), SurfaceConfig(), FusionConfig())


# ------------------------------------------------------------------ a run

RUN = {
    "seed": 3,
    "wall": {"style": "glendale", "width_m": 8.0, "height_m": 5.0, "resolution_m": 0.1, "seed": 1},
    "rockfall": {"count": 3, "size_m": {"kind": "gaussian", "mean": 0.8, "sigma": 0.05, "minimum": 0.5}},
    "cameras": {"distance_m": 40.0, "base_m": 10.0, "width": 3680, "height": 2456},
    "depth_map": "low",
    "difference": {"gsd_m": 0.05},
    "reconstruction": "colmap",
    "products": {"metashape": True},
}


def test_a_run_by_colmap_shows_the_blocks(pycolmap: Any, tmp_path: Path) -> None:

    summary = simulate(parse(SimulationConfig, RUN, "test"), "stereo", tmp_path / "run")
    statistics = summary.epochs[1]["statistics"]
    assert abs(statistics["outside_blocks"]["median_m"]) < 0.02
    assert statistics["inside_blocks"]["median_m"] > 0.05
    for number in (0, 1):
        folder = tmp_path / f"run/epoch_{number:03d}/metashape"
        assert {path.name for path in folder.iterdir()} == {"cameras.xml", "depth", "images", "load_depth_maps.py"}


def test_a_scan_has_no_depth_maps_to_fuse(tmp_path: Path) -> None:

    with pytest.raises(InputError, match="colmap needs the depth maps of a stereo pair; allowed: direct"):
        simulate(parse(SimulationConfig, RUN, "test"), "tls", tmp_path / "run")
