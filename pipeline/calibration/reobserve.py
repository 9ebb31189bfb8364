"""Noise maps in windows of a wall, fast: the sensor's own code traces only the cells that the windows and the registration need.

A whole epoch of the Glendale site traces two million cells, meshes them and looks at five million pixels, to compare a hundred
thousand of them. Here the wall is seen once without noise, which tells the cells that surround each window; an observation then
is the sensor's own (`sensors.stereo.stereo_pair`, `sensors.laser.tls`: all noise, effects, rectification, occlusion) of these
cells and of a sparse lattice over the whole view, by which it is registered; meshing and rasters are the pipeline's own.

Against the whole simulation (`pipeline.calibration.maps`) one thing differs: both epochs are registered to the wall as it is
instead of the later to the noisy earlier one, from some thousand points instead of all. tests/pipeline/test_calibrate.py
compares the two.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.calibration.parameters import Model
from pipeline.calibration.reference_error import ReferenceError
from pipeline.calibration.windows import Windows
from pipeline.config.simulation import SimulationConfig
from pipeline.noise.measured import point_differences
from pipeline.registration.closest_points import ReferenceSurface
from pipeline.registration.register import IcpConfig, register_to
from pipeline.registration.rigid import RigidTransform
from pipeline.run.site import SensorSite
from pipeline.surface.mesh import mesh_observation
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.laser.tls import LaserScanner
from sensors.models.sensor_model import StereoModel, TlsModel
from sensors.signal_chain.observation import Observation
from sensors.stereo.stereo_pair import StereoPair
from sensors.subset import effects_needing_neighbours, restrict_to

_LATTICE_POINTS = 4000
"""Points by which an observation is registered: more of them would not bring it nearer to a registration by all."""
_MARGIN_CELLS = 3
_MARGIN_M = 0.05
"""Around a window, so that it stays covered when noise moves the cells."""


@dataclass(frozen=True)
class _Patch:
    """The block of cells around a window: where it begins in the flat list of cells, and its rows and columns."""

    start: int
    shape: tuple[int, int]


class Reobserver:
    """Simulates difference maps of noise alone in windows.

    config, site: as a simulation takes them; windows: on the grid of the measured maps; of_points: these are of points;
    reference_error: of the surface that the points are compared with. Raises InputError for what cannot be simulated cell by
    cell.
    """

    def __init__(
        self,
        config: SimulationConfig,
        site: SensorSite,
        windows: Windows,
        *,
        of_points: bool = False,
        reference_error: ReferenceError | None = None,
    ) -> None:
        self.sensor = _checked(config, site)
        self.config, self.site, self.windows, self.of_points = config, site, windows, of_points
        self.reference_error = reference_error
        self.caster = RayCaster(site.mesh)
        self.silent = _silent(self.sensor.model)
        self.observations = 0
        whole = _asked(self.sensor, self.silent).observe(self.caster, KeyedRandom(0))
        self._viewpoint = whole.viewpoint
        self._patches, patch_cells = self._surround(whole)
        lattice = _lattice(whole)
        self._lattice_start = len(patch_cells)
        self._lattice_points = whole.points.reshape(-1, 3)[lattice]
        self.cells = np.concatenate([patch_cells, lattice]).astype(np.uint32)

    @cached_property
    def target(self) -> ReferenceSurface:
        """The wall as it is, to register to."""
        return ReferenceSurface.build(self.site.mesh.vertices, self.site.mesh.vertex_normals())

    def maps(self, model: Model, epochs: int, random: KeyedRandom) -> FloatArray:
        """(epochs, k, n, n) differences, m, in the windows; NaN where not stable: of a noisy reference and later epochs, or of
        points, to the wall as it is known: with the same error in all epochs."""
        sources = [random.child("epoch", number) for number in range(1, epochs + 1)]
        if self.of_points:
            return np.stack([self._of_points(model, source, random.child("reference")) for source in sources])
        reference = self.heights(model, random.child("epoch", 0))
        later = [self.heights(model, source) for source in sources]
        return np.where(self.windows.stable, reference - np.stack(later), np.nan)

    def _of_points(self, model: Model, random: KeyedRandom, reference: KeyedRandom) -> FloatArray:
        """(k, n, n) mean differences of the points of each pixel to the wall as it is known, m."""
        points = self._registered(model, random)[: self._lattice_start]
        if self.reference_error is not None:
            points = self.reference_error.moved(points, self.caster, reference)
        values = point_differences(self.caster, points[~np.isnan(points[:, 0])], self.windows.grid)
        return self.windows.cut(values)

    def heights(self, model: Model, random: KeyedRandom) -> FloatArray:
        """(k, n, n) heights, m, of one noisy observation's surface after registration, NaN where it has none."""
        return self._raster(self._surface(self._registered(model, random)))

    def _registered(self, model: Model, random: KeyedRandom) -> FloatArray:
        """(cells, 3) points of one observation, m, registered where the config has ICP."""
        self.observations += 1
        points = self._observe(model, random)
        if self.config.icp is None:
            return points
        return self._registration(points, self.config.icp, random.child("register")).apply(points)

    @cached_property
    def silent_heights(self) -> FloatArray:
        """(k, n, n) heights, m, of the surface that the sensor would give without noise."""
        return self._raster(self._surface(self._observe(self.silent, KeyedRandom(0))))

    def _observe(self, model: Model, random: KeyedRandom) -> FloatArray:
        """(cells, 3) points, m."""
        return _asked(self.sensor, model, self.cells).observe(self.caster, random).points.reshape(-1, 3)

    def _registration(self, points: FloatArray, icp: IcpConfig, random: KeyedRandom) -> RigidTransform:
        """ICP to the wall as it is, from where the lattice's own points, which are known without noise, bring it."""
        lattice = points[self._lattice_start :]
        known = ~np.isnan(lattice[:, 0])
        first = _best_rigid(lattice[known], self._lattice_points[known])
        config = icp.model_copy(update={"subsample_points": False, "outlier_threshold_decay_iteration": 1})
        return register_to(self.target, first.apply(lattice[known]), config, random, threads=1).transform.after(first)

    def _surface(self, points: FloatArray) -> TriangleMesh:
        """The patches as one mesh."""
        vertices, faces, count = [], [], 0
        for patch in self._patches:
            rows, columns = patch.shape
            block = points[patch.start : patch.start + rows * columns].reshape(rows, columns, 3)
            depth = block[..., 2]
            seen = Observation("patch", block, depth, np.zeros(depth.shape, dtype=np.int32), self._viewpoint)
            mesh = mesh_observation(seen, self.config.surface)
            vertices.append(mesh.vertices)
            faces.append(mesh.faces + count)
            count += len(mesh.vertices)
        return TriangleMesh(np.concatenate(vertices), np.concatenate(faces))

    def _raster(self, mesh: TriangleMesh) -> FloatArray:
        """(k, n, n) heights of a mesh at the pixels' centres, m."""
        x, y = self.windows.places()
        top = float(mesh.bounds[1, 2]) + 1.0
        origin = np.stack([x.ravel(), y.ravel(), np.full(x.size, top)], axis=1)
        distance, _ = RayCaster(mesh).cast(origin, np.broadcast_to([0.0, 0.0, -1.0], origin.shape))
        return (top - distance).reshape(x.shape)

    def _surround(self, whole: Observation) -> tuple[list[_Patch], NDArray[np.int64]]:
        """The cells around each window, as the noiseless observation shows them."""
        grid, side = self.windows.grid, self.windows.side * self.windows.grid.gsd
        x, y = whole.points[..., 0], whole.points[..., 1]
        patches, numbers, start = [], [], 0
        for row, column in self.windows.corner:
            left, up = grid.x_min + column * grid.gsd - _MARGIN_M, grid.y_max - row * grid.gsd + _MARGIN_M
            inside = (x >= left) & (x <= left + side + 2 * _MARGIN_M) & (y <= up) & (y >= up - side - 2 * _MARGIN_M)
            rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
            if len(rows) == 0:
                raise InputError(
                    "a window of the measured maps is not seen by the sensor", where="cameras, station", remedy="check the site"
                )
            span = [
                slice(max(int(place[0]) - _MARGIN_CELLS, 0), min(int(place[-1]) + _MARGIN_CELLS + 1, size))
                for place, size in zip((rows, columns), whole.depth.shape, strict=True)
            ]
            block = np.arange(whole.depth.size).reshape(whole.depth.shape)[span[0], span[1]]
            patches.append(_Patch(start, block.shape))
            numbers.append(block.ravel())
            start += block.size
        return patches, np.concatenate(numbers)


def _best_rigid(points: FloatArray, goals: FloatArray) -> RigidTransform:
    """The rotation and shift of (n, 3) points that bring them nearest to their (n, 3) goals (Kabsch 1976)."""
    middle, goal = points.mean(axis=0), goals.mean(axis=0)
    u, _, v = np.linalg.svd((points - middle).T @ (goals - goal))
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    rotation = (u @ turn @ v).T
    return RigidTransform(rotation, goal - rotation @ middle)


def _lattice(whole: Observation) -> NDArray[np.int64]:
    """Numbers of cells in equal steps over the view that have a point."""
    step = max(int(np.sqrt(np.count_nonzero(whole.valid) / _LATTICE_POINTS)), 1)
    number = np.arange(whole.depth.size).reshape(whole.depth.shape)[::step, ::step]
    return number[whole.valid[::step, ::step]]


def _silent(model: Model) -> Model:
    """The model's effects without its noise."""
    zero = {name: 0.0 for name in type(model.noise).model_fields if "sigma" in name or "ppm" in name}
    if isinstance(model, StereoModel):
        return StereoModel(noise=type(model.noise)(**zero), effects=model.effects)
    return TlsModel(noise=type(model.noise)(**zero), effects=model.effects)


def _asked(sensor: StereoPair | LaserScanner, model: Model, cells: NDArray[np.uint32] | None = None) -> Any:
    """The sensor with another model, asked for all its cells or for some."""
    asked = replace(sensor, model=model, truth=False)  # type: ignore[arg-type]
    return asked if cells is None else restrict_to(asked, cells)


def _checked(config: SimulationConfig, site: SensorSite) -> StereoPair | LaserScanner:
    """The sensor, if it can be asked for single cells."""
    if not isinstance(site.sensor, StereoPair | LaserScanner):
        raise InputError("the noise of real matching is its own", where="matcher", allowed="simulated")
    if site.further_stations:
        raise InputError(
            "maps of several stations are not calibrated", where="station", remedy="give the station of the maps alone"
        )
    if config.reconstruction != "direct" or config.surface.method != "grid" or config.surface.holes != "keep":
        raise InputError(
            "windows are reconstructed from the sensor's own grid",
            where="reconstruction, surface",
            allowed="reconstruction: direct, surface: {method: grid, holes: keep}",
        )
    if names := effects_needing_neighbours(site.sensor.model):
        raise InputError(
            f"{', '.join(names)}: looks at the whole picture or scan, and only windows of it are simulated",
            where="sensor.effects",
            remedy="leave it out of the model to be calibrated",
        )
    return site.sensor
