"""How a cloud whose cameras are not known lies against the reference: by the nearest places, since there are no rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh
from sensors.effects.base import Stage
from sensors.models.sensor_model import StereoModel

_SAMPLE = 20_000
_FEWEST_NEAR = 0.25
"""Share of the points that must lie near the reference."""
NEAR_SHARE = 0.05
"""Of the reference's extent, within which a point is near it."""


@dataclass(frozen=True)
class SurfaceFit:
    """near: share of a sample of points that lie near the reference; off_m: median distance from it; reach_m: within which a
    point is near."""

    near: float
    off_m: float
    reach_m: float

    @classmethod
    def of(cls, points: FloatArray, reference: TriangleMesh) -> SurfaceFit:
        """points: (n, 3), m, in the reference's frame."""
        from scipy.spatial import cKDTree

        reach = near_m(reference)
        some = points[:: max(len(points) // _SAMPLE, 1)]
        off = cKDTree(reference.vertices).query(some, workers=-1)[0]
        return cls(float(np.mean(off <= reach)), float(np.median(off)), reach)

    @property
    def good(self) -> bool:
        """Whether the points are of this surface."""
        return self.near >= _FEWEST_NEAR

    def check(self, where: str) -> None:
        """Raise InputError where they are not."""
        if self.good:
            return
        raise InputError(
            f"{100 * self.near:.2g} % of the points lie near the reference; half lie {self.off_m:.3g} m and more from it",
            where=where, allowed=f"{100 * _FEWEST_NEAR:g} % and more within {self.reach_m:.3g} m",
            remedy="export both in one coordinate system and unit, and check that they are of one wall",
        )  # fmt: skip


def near_m(reference: TriangleMesh) -> float:
    """Distance from a vertex of the reference up to which a point is one of its surface, m."""
    extent = float(np.linalg.norm(np.ptp(reference.bounds, axis=0)))
    corners = reference.corners()
    return NEAR_SHARE * extent + float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))


def air_side(mesh: TriangleMesh) -> FloatArray:
    """(3,) a place before the middle of a surface, on the side to which its triangles are wound, in its frame, m."""
    local = mesh.vertices - mesh.vertices.mean(axis=0)
    normal = np.linalg.eigh(np.einsum("ni,nj->ij", local, local))[1][:, 0]
    corners = mesh.corners()
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
    side = normal if normal @ outwards >= 0 else -normal
    extent = float(np.linalg.norm(np.ptp(mesh.bounds, axis=0)))
    return np.asarray(mesh.vertices.mean(axis=0) + 2 * extent * side)


def check_in_metres(model: StereoModel, where: str) -> None:
    """Raise InputError for a model of a pair that says nothing of points in metres, or holds effects of cameras."""
    of_cameras = [effect.name for effect in model.effects if effect.stage != Stage.POINT]
    if of_cameras:
        raise InputError(
            f"the model holds {', '.join(of_cameras)}, and the measurement no `cameras`", where=where,
            remedy="name cameras.yaml or a Metashape XML, or take them out of the model",
        )  # fmt: skip
    if not model.noise.of_points.sigma_m and not model.noise.of_points.shared_sigma_m:
        raise InputError(
            "a stereo measurement needs `cameras`, or a model whose noise is in metres", where=where,
            remedy="name cameras.yaml or a Metashape XML, or state noise: point_sigma_m in the model; "
            "scarpsim measurement --photographs finds it",
        )  # fmt: skip
