"""Reconstruct a surface from two depth maps with COLMAP, and define the names of all methods of reconstruction.

The methods are `direct`, which triangulates the sensor's own grid; `vertices`, in which the pair measures the wall's own
vertices (sensors/stereo/stereo_vertices.py); and `colmap`, which is the analogue of handing depth maps to Metashape. For
`colmap`, both depth maps, with lens distortion removed, are written to a COLMAP workspace. COLMAP's stereo fusion joins what
agrees in both (Schoenberger et al. 2016, "Pixelwise View Selection for Unstructured Multi-View Stereo", section 4.4), and its
Poisson reconstruction (Kazhdan and Hoppe 2013) makes the surface. COLMAP's dense Delaunay meshing is missing in PyPI's
pycolmap, which is built without CGAL.
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
"""The images of the workspace. They are grey, because fusion only copies their colours."""
_LANDMARKS = 200
"""Number of points of the sparse model. Fusion considers images as neighbours if they share some."""


class FusionConfig(Config):
    """Settings of COLMAP's stereo fusion, which joins depth maps to a point cloud, and of its Poisson reconstruction.

    The commands of COLMAP are `colmap stereo_fusion` and `colmap poisson_mesher`.
    """

    minimum_pixels: int = Field(2, ge=1, description="depth pixels that a fused point needs (COLMAP: 5; two images give two)")
    maximum_reprojection_px: float = Field(
        2.0, gt=0, description="largest reprojection error between the depth maps, in their pixels [px]"
    )
    maximum_depth_ratio: float = Field(0.01, gt=0, description="largest difference of depths, as a share of the depth")
    maximum_normal_angle_rad: float = Field(
        0.35, gt=0, le=np.pi, description="largest angle between normals (COLMAP: 10 degrees) [rad]"
    )
    normal_radius_px: int = Field(
        1, ge=1, le=20, description="radius of the window in which normals are fitted, depth map pixels"
    )
    point_weight: float = Field(
        4.0, ge=0, description="Poisson: weight of the points against the gradient field (COLMAP: 1; Kazhdan and Hoppe: 4)"
    )


def write_workspace(
    folder: Path, left: DepthMap, right: DepthMap, landmarks: FloatArray, surface: SurfaceConfig, radius: int
) -> None:
    """Write the depth maps of a stereo pair as a COLMAP workspace, from which `colmap stereo_fusion` makes a point cloud.

    The folder then contains images/, sparse/ and stereo/, in the wall frame. Lens distortion is removed from the maps. COLMAP's
    fusion puts the centre of the top-left pixel at (0, 0) (colmap/mvs/fusion.cc), unlike its camera models; the principal points
    are written accordingly.

    Parameters
    ----------
    folder : Path
        Folder to write to.
    left, right : DepthMap
        Depth maps of both cameras.
    landmarks : (n, 3) array
        Points on the surface for COLMAP's sparse model, wall frame, m.
    surface : SurfaceConfig
        Its `depth_step_m` says at which steps in depth the maps are not interpolated.
    radius : int
        The surface normals are fitted in windows of 2 radius + 1 pixels a side.
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
    """Make the triangle mesh that COLMAP reconstructs from the depth maps of a stereo pair, wall frame, m.

    It runs in one thread, so that equal maps give equal bytes.

    Parameters
    ----------
    left, right : DepthMap
        Depth maps of both cameras.
    points, block : (n, 3) and (n,) arrays
        Observed points, wall frame, m, and the number of the fallen block at each, 0 for the wall. A vertex of the mesh takes the
        number of the nearest point.
    surface : SurfaceConfig
        Its settings of the Poisson reconstruction (octree depth, trimming).
    fusion : FusionConfig
        Settings of COLMAP's fusion of the depth maps.

    Raises
    ------
    InputError
        If pycolmap is missing, or if fusion leaves fewer than 100 points.
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
                f"COLMAP kept {len(fused)} points when it fused two depth maps of about {len(points):,} points each",
                where="reconstruction: colmap",
                allowed="100 points or more",
                remedy="raise fusion.maximum_depth_ratio, fusion.maximum_reprojection_px or fusion.maximum_normal_angle_rad",
            )
        depth = surface.poisson_depth or octree_depth(fused)
        options = pycolmap.PoissonMeshingOptions(
            depth=depth, trim=0, point_weight=fusion.point_weight, color=False, num_threads=1
        )
        pycolmap.poisson_meshing(folder / "fused.ply", folder / "mesh.ply", options)
        mesh = read_ply(folder / "mesh.ply")
    return labelled_surface(mesh.vertices, mesh.faces, fused, (points, block), surface)


def _fusion_options(pycolmap: Any, fusion: FusionConfig) -> Any:
    """Convert the config to pycolmap's options."""
    return pycolmap.StereoFusionOptions(
        min_num_pixels=fusion.minimum_pixels,
        max_reproj_error=fusion.maximum_reprojection_px,
        max_depth_error=fusion.maximum_depth_ratio,
        max_normal_error=float(np.degrees(fusion.maximum_normal_angle_rad)),
        num_threads=1,
    )


def _pycolmap() -> Any:
    """Import pycolmap. Raises InputError if it is not installed."""
    try:
        import pycolmap  # an extra, and needed here only
    except ImportError:
        raise InputError(
            "the reconstruction needs the package pycolmap", where="reconstruction: colmap", remedy=how_to_install("colmap")
        ) from None
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    return pycolmap


def _write_grey(path: Path, shape: tuple[int, ...]) -> None:
    """Write a uniform grey image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    grey: NDArray[np.uint8] = np.full(shape, 128, dtype=np.uint8)
    cv2.imwrite(str(path), grey)
