"""Describe how the sensor saw the points: their directions, their neighbours there, and the solid angle of each."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree

from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement, SurfaceMeasurement, TlsMeasurement
from pipeline.gap.residuals.nominal_pair import NominalPair
from pipeline.gap.residuals.residuals import Residuals, Rows, select_rows
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.residuals.surface_residuals import SurfaceResiduals
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray, area_normals

NEIGHBOURS = 8
"""Neighbours of a point: the ring around it in a raster."""
_FARTHEST = 3.0
"""Point spacings above which two points are no neighbours."""
_SAMPLE, _NEAR, _ROUNDS = 2000, 48, 6
"""To scale the axes: points and neighbours of each that are sampled, and most rounds."""
_AT_ONCE = 100_000
"""Points processed together (7 MB of values), whatever the number of threads."""
_AROUND = 24
"""Neighbours from which the solid angle of a point is computed: two rings."""
_LARGEST_CELL = 4.0
"""Largest area of a Delaunay triangle, in median ones."""
_FROM_AFAR, _STEEPEST = 1000.0, 0.2
"""A surface without cameras is viewed along its plane's normal from this many times as far; and the smallest cosine of its
    slope.
    """


@dataclass(frozen=True)
class SensorView:
    """The rays of n points, their neighbours in the sensor's field of view, and how a residual moves a point.

    It is used to find regions where the rock changed, and to measure their volumes.

    Attributes
    ----------
    coordinates : (n, 2) position in the field of view, as `Geometry.sensor_coordinates`. Each of several scans is shifted by a
        constant, so that points of different scans are not neighbours.
    epoch : (n,) number of the epoch (the repetition of the measurement) of each point.
    origin : (n, 3) origin of the rays, wall frame, m.
    ray : (n, 3) unit directions of the rays, wall frame.
    reference_m : (n,) range to the reference surface along the rays, m.
    disparity : (n,) disparity of the reference minus that of a point at infinity, px; None if ranges were measured.
    slant : (n,) change of range per metre of residual, for a cloud without cameras, whose rays are assumed to come from a
        distant place in front of the wall; None for other measurements, where it is 1.
    """

    coordinates: FloatArray
    epoch: NDArray[np.int64]
    origin: FloatArray
    ray: FloatArray
    reference_m: FloatArray
    disparity: FloatArray | None = None
    slant: FloatArray | None = None

    @classmethod
    def of(cls, measurement: Measurement, residuals: Residuals) -> SensorView:
        """Collect rays, ranges and field-of-view positions of n points of a measurement, given by their residuals.

        The rays of a stereo pair start at its left camera. Raises TypeError if the residuals are of another kind of sensor than
        the measurement.
        """
        origin, reference, disparity, slant = measurement.viewpoint, None, None, None
        match measurement, residuals:
            case StereoMeasurement(), StereoResiduals(geometry=pixels):
                towards = pixels.point - origin
                disparity = pixels.disparity - NominalPair.of(measurement).geometry.offset
            case TlsMeasurement(), TlsResiduals(geometry=rays):
                if measurement.scans:
                    origin = np.stack([scan.pose[0] for scan in measurement.scans])[measurement.scan_of[residuals.index]]
                towards, reference = measurement.cloud.points[residuals.index] - origin, rays.range_m
            case SurfaceMeasurement(), SurfaceResiduals(geometry=places):
                origin = measurement.centre + _FROM_AFAR * (origin - measurement.centre)
                towards, slant = places.point - origin, -1 / np.maximum(places.normal[:, 2], _STEEPEST)
            case _:
                raise TypeError("measurement and residuals are of different sensors")
        length = np.linalg.norm(towards, axis=1)
        epoch, plane = measurement.epochs[residuals.index], residuals.geometry.sensor_coordinates
        if isinstance(measurement, TlsMeasurement) and measurement.scans:
            plane = _side_by_side(plane, measurement.scan_of[residuals.index])
        reference = length if reference is None else reference
        origin = np.broadcast_to(origin, towards.shape)
        return cls(plane, epoch, origin, towards / length[:, None], reference, disparity, slant)

    def part(self, rows: Rows) -> SensorView:
        """Return the view of a subset of the n points, given as row numbers, a mask (n,) or a slice."""
        return select_rows(self, rows)

    def range_at_residual(self, rows: NDArray[np.int64], residual: FloatArray) -> FloatArray:
        """Convert residuals (m,) of points with row numbers `rows` (m,) to ranges from the sensor (m,), m.

        They locate a surface that differs from the reference. A disparity residual r changes the range R of the reference to
        R d / (d + r), where d is the reference's disparity minus that at infinity.
        """
        reference = self.reference_m[rows]
        if self.disparity is not None:
            return np.asarray(reference * self.disparity[rows] / (self.disparity[rows] + residual))
        return np.asarray(reference + (residual if self.slant is None else residual * self.slant[rows]))

    def points_at(self, rows: NDArray[np.int64], range_m: FloatArray) -> FloatArray:
        """Convert ranges (m,), m, on the rays of points with row numbers `rows` (m,) to positions (m, 3), wall frame, m."""
        return np.asarray(self.origin[rows] + range_m[:, None] * self.ray[rows])

    @cached_property
    def scaled_coordinates(self) -> FloatArray:
        """(n, 2) positions in the field of view, scaled so that neighbouring points are 1 apart along both axes.

        Distances between them tell which points are neighbours.
        """
        plane = (self.coordinates - self.coordinates.min(axis=0)) / np.maximum(np.ptp(self.coordinates, axis=0), 1e-300)
        rows = np.flatnonzero(self.epoch == self.epoch.min())
        apart = _axis_spacings(plane[rows])
        for _ in range(_ROUNDS):
            if abs(np.log(apart[0] / apart[1])) < 0.02:
                break
            plane = plane / apart
            apart = _axis_spacings(plane[rows])
        return np.asarray(plane / apart)

    @cached_property
    def _trees(self) -> list[tuple[NDArray[np.int64], cKDTree]]:
        """For each epoch the rows of its points and a search tree of their scaled coordinates."""
        groups = [np.flatnonzero(self.epoch == number) for number in np.unique(self.epoch)]
        return [(rows, _search_tree(self.scaled_coordinates[rows])) for rows in groups]

    def neighbour_pairs(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Pair points with their neighbours in the sensor's field of view, to find connected groups of points.

        Neighbours are the eight nearest points of the same epoch (repetition of the measurement) within three point spacings, and
        the point at the same place in the next epoch.

        rows: row numbers of the points whose neighbours are wanted. Returns the row numbers of both points of k pairs, (2, k).
        """
        found = [np.empty((2, 0), dtype=np.int64)]
        wanted = np.zeros(len(self.coordinates), dtype=bool)
        wanted[rows] = True
        for number, (group, _) in enumerate(self._trees):
            own = group[wanted[group]]
            searches = ((_FARTHEST, list(range(1, NEIGHBOURS + 2))), (1.0, [1]))  # in the same epoch, and in the next one
            for (others, tree), (farthest, nearest) in zip(self._trees[number : number + 2], searches, strict=False):
                distance, position = tree.query(self.scaled_coordinates[own], nearest, distance_upper_bound=farthest)
                hit = np.isfinite(distance)
                found.append(np.stack([np.repeat(own, hit.sum(axis=1)), others[position[hit]]]))
        pairs = np.concatenate(found, axis=1)
        return pairs[:, pairs[0] != pairs[1]]

    def neighbour_median(self, z: FloatArray) -> FloatArray:
        """Return the median (n,) of values z (n,) over each point and its eight nearest neighbours in the field of view.

        It shows changes that neighbours share, and single outliers hardly influence it.
        """
        found = np.empty(len(z))
        for group, near in self._rings:
            own = z[group]
            parts = [near[start : start + _AT_ONCE] for start in range(0, len(near), _AT_ONCE)]
            found[group] = np.concatenate(map_in_threads(partial(_medians_of, own), parts))
        return found

    @cached_property
    def _rings(self) -> list[tuple[NDArray[np.int64], NDArray[np.int32]]]:
        """For each epoch the rows of its points, and for each point itself and its neighbours, numbered among those rows."""
        return [
            (group, tree.query(self.scaled_coordinates[group], min(NEIGHBOURS + 1, len(group)), workers=-1)[1].astype(np.int32))
            for group, tree in self._trees
        ]

    def near(self, rows: NDArray[np.int64], spacings: float) -> NDArray[np.bool_]:
        """Tell which points lie near chosen ones in the sensor's field of view, to set aside the surroundings of a change.

        rows: row numbers of the chosen points. spacings: largest distance, in spacings of neighbouring points. Returns true (n,)
        for points of any epoch within this distance of a chosen one, and for these themselves.
        """
        tree = _search_tree(self.scaled_coordinates[rows])
        return np.isfinite(tree.query(self.scaled_coordinates, distance_upper_bound=spacings, workers=-1)[0])

    def solid_angles(self, rows: NDArray[np.int64]) -> FloatArray:
        """Compute the solid angle (m,), sr, that each of some points represents, to turn changes of range into volumes.

        The points of each epoch are joined to Delaunay triangles in the sensor's field of view, and a third of the solid angle of
        a triangle goes to each corner. Points beside lost returns thus represent these too. A triangle across a gap counts at
        most four times the median triangle. rows: (m,) row numbers of the points.
        """
        total = np.zeros(len(self.coordinates))
        wanted = np.zeros(len(self.coordinates), dtype=bool)
        wanted[rows] = True
        for group, tree in self._trees:
            own = group[wanted[group]]
            if not len(own):
                continue
            near = np.unique(tree.query(self.scaled_coordinates[own], min(_AROUND, len(group)))[1])
            chosen = group[near.ravel()]
            corners = chosen[Delaunay(self.scaled_coordinates[chosen], qhull_options="Qbb QJ").simplices]
            area = 0.5 * np.linalg.norm(area_normals(self.ray[corners]), axis=1)
            touching = wanted[corners].any(axis=1)
            area = np.minimum(area, _LARGEST_CELL * np.median(area[touching]))
            total += np.bincount(corners.ravel(), np.repeat(area / 3, 3), len(total))
        return total[rows]


def _medians_of(values: FloatArray, rows: NDArray[np.int32]) -> FloatArray:
    """(m,) medians of the values at some rows (m, k)."""
    return np.asarray(np.median(values[rows], axis=1))


def _side_by_side(plane: FloatArray, scan: NDArray[np.int64]) -> FloatArray:
    """(n, 2) coordinates with the scans side by side, so that points of different scans are never neighbours."""
    found, start = plane.copy(), 0.0
    for number in np.unique(scan):
        rows = scan == number
        width = float(np.ptp(plane[rows, 0]))
        found[rows, 0] += start - plane[rows, 0].min()
        found[rows, 1] -= plane[rows, 1].min()
        start += 1.25 * width + 1e-6
    return found


def _search_tree(plane: FloatArray) -> cKDTree:
    """Search tree of positions (n, 2); they fill the field of view evenly, so that balancing it would only take time."""
    return cKDTree(plane, balanced_tree=False, compact_nodes=False)


def _axis_spacings(plane: FloatArray) -> FloatArray:
    """(2,) median distance to the nearest point along each axis, among neighbours that lie mostly along that axis."""
    some = plane[:: max(len(plane) // _SAMPLE, 1)]
    rows = _search_tree(plane).query(some, min(_NEAR, len(plane)))[1]
    offset = np.abs(plane[rows[:, 1:]] - some[:, None])
    along = [np.where(offset[..., axis] >= offset[..., 1 - axis], offset[..., axis], np.inf).min(axis=1) for axis in (0, 1)]
    found = np.median(along, axis=1)
    return np.where(np.isfinite(found), np.maximum(found, 1e-12), offset.max())
