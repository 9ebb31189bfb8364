"""Compare a cloud with unknown cameras with the reference, by nearest points, since it has no rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh
from sensors.effects.base import Stage
from sensors.models.sensor_model import StereoModel

_SAMPLE = 20_000
"""Number of points in the sample."""
_FEWEST_NEAR = 0.25
"""Smallest share of the points that are near the reference."""
NEAR_SHARE = 0.05
"""Distance up to which a point is near the reference, as a share of the reference's extent."""


@dataclass(frozen=True)
class SurfaceFit:
    """How well measured points fit a reference surface, to see whether both show the same wall in the same coordinate system.

    Distances are those from a subsample of the points, evenly spaced in their order, to the nearest vertex of the reference.

    Attributes
    ----------
    near : Share of the subsample whose distance is at most `reach_m`.
    off_m : Median distance, m.
    reach_m : Largest distance at which a point counts as near, m.
    """

    near: float
    off_m: float
    reach_m: float

    @classmethod
    def of(cls, points: FloatArray, reference: TriangleMesh) -> SurfaceFit:
        """Measure how well points fit a reference surface, by their distances from its nearest vertices.

        Of more than 40,000 points, only some 20,000 to 30,000 are used, evenly spaced in their order.

        Parameters
        ----------
        points : (n, 3) measured points, in the frame of the reference, m.
        reference : Mesh of the reference surface.
        """
        from scipy.spatial import cKDTree

        reach = near_m(reference)
        some = points[:: max(len(points) // _SAMPLE, 1)]
        off = cKDTree(reference.vertices).query(some, workers=-1)[0]
        return cls(float(np.mean(off <= reach)), float(np.median(off)), reach)

    @property
    def good(self) -> bool:
        """Whether measured points can belong to a reference surface: 25 % or more of a subsample are near a vertex of it."""
        return self.near >= _FEWEST_NEAR

    def check(self, where: str) -> None:
        """Raise InputError unless measured points can belong to a reference surface: 25 % or more are near a vertex of it.

        If they do not, points and reference show different walls, or have different coordinate systems or units. where: name of
        the points' file, for the error.
        """
        if self.good:
            return
        raise InputError(
            f"{100 * self.near:.2g} % of the points lie near the reference; half lie {self.off_m:.3g} m or more from it",
            where=where, allowed=f"{100 * _FEWEST_NEAR:g} % or more within {self.reach_m:.3g} m",
            remedy="export points and reference of the same wall in one coordinate system and unit",
        )  # fmt: skip


def near_m(reference: TriangleMesh) -> float:
    """Return the largest distance from a reference surface's nearest vertex at which a point still belongs to it, m.

    It is 5 % of the diagonal of the mesh's bounding box, plus the median length of an edge.
    """
    extent = float(np.linalg.norm(np.ptp(reference.bounds, axis=0)))
    corners = reference.corners()
    return NEAR_SHARE * extent + float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))


def air_side(mesh: TriangleMesh) -> FloatArray:
    """Return a place in front of the middle of a rock surface, to know which side of the mesh is air and which is rock.

    mesh: the surface; its triangles face the air. Returns (3,) coordinates in the frame of the mesh, m, two diagonals of its
    bounding box away.
    """
    local = mesh.vertices - mesh.vertices.mean(axis=0)
    normal = np.linalg.eigh(np.einsum("ni,nj->ij", local, local))[1][:, 0]
    corners = mesh.corners()
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
    side = normal if normal @ outwards >= 0 else -normal
    extent = float(np.linalg.norm(np.ptp(mesh.bounds, axis=0)))
    return np.asarray(mesh.vertices.mean(axis=0) + 2 * extent * side)


def check_in_metres(model: StereoModel, where: str) -> None:
    """Raise InputError if a stereo model cannot be used for a surface whose cameras are unknown.

    Such a model must state noise in metres, and no errors of cameras. where: name of the file, for the error.
    """
    effects_of_cameras = [effect.name for effect in model.effects if effect.stage != Stage.POINT]
    if effects_of_cameras:
        raise InputError(
            f"the model has effects of cameras ({', '.join(effects_of_cameras)}), but the measurement has no `cameras`",
            where=where, remedy="add `cameras` (cameras.yaml or a Metashape XML), or remove these effects from the model",
        )  # fmt: skip
    if not model.noise.of_points.sigma_m and not model.noise.of_points.shared_sigma_m:
        raise InputError(
            "a stereo measurement needs `cameras`, or a model whose noise is in metres", where=where,
            remedy="add `cameras` (cameras.yaml or a Metashape XML) to the measurement, or set noise: point_sigma_m in the "
            "model; `scarpsim measurement --photographs` estimates that value",
        )  # fmt: skip
