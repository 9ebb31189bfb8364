"""From an observation to a surface: `direct`, the sensor's own grid; `vertices`, the wall's own, each measured by the pair
(sensors/stereo/stereo_vertices.py); or `colmap`, an outside reconstruction of the depth maps.

`colmap` is the analogue of handing depth maps to Metashape. Both depth maps, freed of the lens distortion, go into a COLMAP
workspace; its stereo fusion joins what agrees in both (Schoenberger et al. 2016, "Pixelwise View Selection for Unstructured
Multi-View Stereo", section 4.4), its Poisson reconstruction (Kazhdan and Hoppe 2013) makes the surface. COLMAP's dense Delaunay
meshing is not in PyPI's pycolmap, which is built without CGAL.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.formats.cameras.colmap import write_colmap, write_map
from pipeline.formats.meshes.ply import read_ply, read_ply_points
from pipeline.surface.depth_maps import DepthMap, normals, pinhole
from pipeline.surface.mesh import SurfaceConfig, labelled_surface, octree_depth
from scene.common.config import Config
from scene.common.errors import InputError
from scene.common.extras import how_to_install
from scene.geometry.mesh import FloatArray, IntArray, TriangleMesh

Reconstruction = Literal["direct", "vertices", "colmap"]
NAMES = ("left.png", "right.png")
"""The images of the workspace; they are grey, for fusion only copies their colours."""
_LANDMARKS = 200
"""Points of the sparse model: fusion takes images as neighbours that share some."""


class FusionConfig(Config):
    """COLMAP's stereo fusion and Poisson reconstruction (`colmap stereo_fusion`, `colmap poisson_mesher`)."""

    minimum_pixels: int = Field(2, ge=1, description="depth pixels that a fused point needs (COLMAP: 5; two images give two)")
    maximum_reprojection_px: float = Field(2.0, gt=0, description="between the depth maps, in their pixels [px]")
    maximum_depth_ratio: float = Field(0.01, gt=0, description="difference of depths over depth")
    maximum_normal_angle_rad: float = Field(0.35, gt=0, le=np.pi, description="between normals (COLMAP: 10 degrees) [rad]")
    normal_radius_px: int = Field(1, ge=1, le=20, description="radius of the window that normals are fitted in, depth map pixels")
    point_weight: float = Field(
        4.0, ge=0, description="Poisson: weight of the points against the gradient field (COLMAP: 1; Kazhdan and Hoppe: 4)"
    )


def write_workspace(
    folder: Path, left: DepthMap, right: DepthMap, landmarks: FloatArray, surface: SurfaceConfig, radius: int
) -> None:
    """Write the depth maps as a COLMAP workspace that its `stereo_fusion` reads, in the wall frame.

    landmarks: (n, 3) points of the sparse model. The folder then holds images/, sparse/ and stereo/. COLMAP's fusion puts the
    centre of the top-left pixel at (0, 0) (colmap/mvs/fusion.cc), unlike its camera models: the principal points are so.
    """
    cameras = {}
    for name, source in zip(NAMES, (left, right), strict=True):
        plain = pinhole(source, surface.depth_step_m)
        direction = normals(plain, radius)
        known = np.isfinite(direction[..., 0])
        write_map(folder / f"stereo/depth_maps/{name}.geometric.bin", np.where(known, plain.depth, 0.0))
        write_map(folder / f"stereo/normal_maps/{name}.geometric.bin", np.where(known[..., None], direction, 0.0))
        _write_grey(folder / "images" / name, plain.depth.shape)
        cameras[name] = plain.camera.reduced(1.0, plain.camera.width, plain.camera.height, (0.5, 0.5))
    write_colmap(folder / "sparse", cameras, landmarks)
    (folder / "stereo/fusion.cfg").write_text("".join(f"{name}\n" for name in NAMES), encoding="utf-8")


def colmap_surface(
    left: DepthMap, right: DepthMap, points: FloatArray, block: IntArray, surface: SurfaceConfig, fusion: FusionConfig
) -> TriangleMesh:
    """The surface that COLMAP makes of two depth maps, wall frame.

    points: (n, 3), m, and block: (n,), the observation that labels come from. Single-threaded, so that equal maps give equal
    bytes. Raises InputError where pycolmap is missing and where nothing is fused.
    """
    pycolmap = _pycolmap()
    with tempfile.TemporaryDirectory(prefix="scarpsim_colmap_") as name:
        folder = Path(name)
        landmarks = points[:: max(len(points) // _LANDMARKS, 1)]
        write_workspace(folder, left, right, landmarks, surface, fusion.normal_radius_px)
        pycolmap.stereo_fusion(folder / "fused.ply", folder, options=_fusion_options(pycolmap, fusion), output_type="ply")
        fused = read_ply_points(folder / "fused.ply").points
        if len(fused) < 100:
            raise InputError(
                f"COLMAP fused {len(fused)} points of {len(points):,} per depth map",
                where="reconstruction: colmap",
                remedy="raise fusion.maximum_depth_ratio, maximum_reprojection_px or maximum_normal_angle_rad",
            )
        depth = surface.poisson_depth or octree_depth(fused)
        options = pycolmap.PoissonMeshingOptions(
            depth=depth, trim=0, point_weight=fusion.point_weight, color=False, num_threads=1
        )
        pycolmap.poisson_meshing(folder / "fused.ply", folder / "mesh.ply", options)
        mesh = read_ply(folder / "mesh.ply")
    return labelled_surface(mesh.vertices, mesh.faces, fused, (points, block), surface)


def _fusion_options(pycolmap: Any, fusion: FusionConfig) -> Any:
    return pycolmap.StereoFusionOptions(
        min_num_pixels=fusion.minimum_pixels,
        max_reproj_error=fusion.maximum_reprojection_px,
        max_depth_error=fusion.maximum_depth_ratio,
        max_normal_error=float(np.degrees(fusion.maximum_normal_angle_rad)),
        num_threads=1,
    )


def _pycolmap() -> Any:
    try:
        import pycolmap  # an extra, and needed here only
    except ImportError:
        problem, where = "needs the package pycolmap", "reconstruction: colmap"
        raise InputError(problem, where=where, remedy=how_to_install("colmap")) from None
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    return pycolmap


def _write_grey(path: Path, shape: tuple[int, ...]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    grey: NDArray[np.uint8] = np.full(shape, 128, dtype=np.uint8)
    cv2.imwrite(str(path), grey)
