"""Provide `Mesh`, a triangle mesh that plots itself, reads and writes files, and converts to other libraries."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from pipeline.api.extras import library
from pipeline.api.pictures import Picture, html_table
from pipeline.formats.meshes.ply import read_ply, write_ply
from scene.common.errors import InputError
from scene.geometry.mesh import TriangleMesh


class Mesh(TriangleMesh):
    """Triangles with shared vertices, counter-clockwise as seen from the sensor's side.

    The vertices are (n, 3) and the faces (m, 3).

    Attributes
    ----------
    vertices : (n, 3) float64
        Coordinates, m, in the frame that the function which made the mesh states.
    faces : (m, 3) int32
        Indices of the vertices.
    vertex_albedo : (n,) float32 or None
        Reflectance in [0, 1].
    vertex_block, face_block : (n,) and (m,) int32, or None
        Label of the block whose removal exposed the vertex or face; 0 elsewhere.
    """

    @classmethod
    def of(cls, mesh: TriangleMesh) -> Self:
        """Return any triangle mesh of the simulator as a `Mesh`, which can be saved, plotted and converted.

        The arrays are not copied.
        """
        return cls(mesh.vertices, mesh.faces, mesh.vertex_albedo, mesh.vertex_block, mesh.face_block)

    @classmethod
    def from_arrays(cls, vertices: ArrayLike, faces: ArrayLike) -> Self:
        """Return a mesh of vertices (n, 3), m, and faces (m, 3) of vertex indices.

        Raises InputError for other shapes or indices.
        """
        corners, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(faces)
        for name, array in (("vertices", corners), ("faces", triangles)):
            if array.ndim != 2 or array.shape[1] != 3 or not len(array):
                raise InputError(
                    f"the array has the shape {array.shape}",
                    where=name,
                    allowed="(n, 3)",
                    remedy="give an array with the three columns x, y and z, in m",
                )
        if triangles.dtype.kind not in "iu" or triangles.min() < 0 or triangles.max() >= len(corners):
            raise InputError(
                "the faces contain numbers that are not indices of vertices",
                where="faces",
                allowed=f"whole numbers from 0 to {len(corners) - 1}",
                remedy="correct the faces; vertices are counted from 0",
            )
        if not np.isfinite(corners).all():
            raise InputError(
                "the vertices contain values that are NaN or infinite",
                where="vertices",
                remedy="remove these vertices and the faces that use them",
            )
        return cls(corners, triangles.astype(np.int32))

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a mesh from a PLY file that `save` wrote.

        path: the file. Nothing is repaired; `open_wall` reads and repairs meshes of other programs.
        """
        return cls.of(read_ply(Path(path)))

    def save(self, path: Path | str) -> Path:
        """Write the mesh to a PLY file; return its path."""
        write_ply(Path(path), self)
        return Path(path)

    def to_trimesh(self) -> Any:
        """Convert the mesh to a trimesh.Trimesh, for the library trimesh."""
        return library("trimesh").Trimesh(self.vertices, self.faces, process=False)

    def to_open3d(self) -> Any:
        """Convert the mesh to an open3d.geometry.TriangleMesh, for the library Open3D."""
        open3d = library("open3d")
        vertices = open3d.utility.Vector3dVector(self.vertices)
        return open3d.geometry.TriangleMesh(vertices, open3d.utility.Vector3iVector(self.faces))

    def to_pyvista(self) -> Any:
        """Convert the mesh to a pyvista.PolyData, for the library PyVista.

        Block labels and reflectances (albedo) go with it if it has them.
        """
        faces = np.concatenate([np.full((len(self.faces), 1), 3, self.faces.dtype), self.faces], axis=1)
        made = library("pyvista").PolyData(self.vertices, faces.ravel())
        if self.vertex_albedo is not None:
            made.point_data["albedo"] = self.vertex_albedo
        if self.face_block is not None:
            made.cell_data["block"] = self.face_block
        return made

    def plot(self, gsd_m: float | None = None) -> Picture:
        """Return a shaded picture (hillshade) of the mesh, viewed along the normal of its mean plane.

        gsd_m: side of a pixel, m; by default the picture has about 100,000 pixels.
        """
        from pipeline.precision.surface import wall_raster
        from pipeline.report.figures import hillshade_figure
        from scene.geometry.frame import WallFrame
        from scene.geometry.mesh import area_normals
        from scene.ray_casting.raycast import RayCaster

        outward = area_normals(self.corners()).sum(axis=0)
        frame = WallFrame.fit(self.vertices, self.vertices.mean(axis=0) + outward)
        raster = wall_raster(RayCaster(self.with_vertices(frame.to_wall(self.vertices))), gsd_m)
        return Picture(hillshade_figure(raster.image(raster.places.points[:, 2]), raster.grid))

    def __repr__(self) -> str:
        return f"<Mesh: {len(self.vertices):,} vertices, {len(self.faces):,} triangles>"

    def _repr_html_(self) -> str:
        extent = " x ".join(f"{length:.2f}" for length in self.bounds[1] - self.bounds[0])
        return html_table(
            "Mesh", {"vertices": f"{len(self.vertices):,}", "triangles": f"{len(self.faces):,}", "extent, m": extent}
        )
