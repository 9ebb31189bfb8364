"""Simulate difference maps of noise in windows of the wall only, so that one takes a fraction of a second.

A whole epoch of the Glendale site traces two million cells of the sensor, although the comparison needs only a hundred thousand
pixels. Here the wall is first observed without noise to find the cells that surround each window. Each noisy observation then
traces only these cells, and a sparse lattice of cells over the whole view for the registration. It uses the sensor's own code
(`sensors.stereo.stereo_pair`, `sensors.laser.tls`), so noise, effects, rectification and occlusion are complete; meshing and
rasters are those of the pipeline.

It differs from the whole simulation (`pipeline.calibration.noise_map`) in one way: both epochs are registered to the noiseless
wall from a few thousand points, instead of the later to the noisy earlier one from all points.
tests/pipeline/test_calibrate.py compares the two.
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
"""Points used to register an observation; with more, the result is no nearer to a registration by all points."""
_MARGIN_CELLS = 3
_MARGIN_M = 0.05
"""Margin around a window, in cells and in m, so that the window stays covered when noise moves the points."""


@dataclass(frozen=True)
class _Patch:
    """The block of sensor cells around one window.

    start is its place in the flat list of cells; shape gives its rows and columns.
    """

    start: int
    shape: tuple[int, int]


class WindowSimulator:
    """Simulates difference maps that contain only noise, in a few square windows of the wall, much faster than whole maps.

    A calibration needs hundreds of such maps. Only the sensor's samples (depth-map pixels or laser pulses) around the
    windows are traced, and some over the whole view for the registration.

    Parameters
    ----------
    config, site : Config, and wall with its sensor, as for a whole simulation.
    windows : The k windows of n x n pixels, on the grid of the measured maps, in which measured and simulated maps are
        compared.
    of_points : True if a pixel's value is the mean distance of the points in it from the wall; false if it is the
        difference between two surfaces.
    reference_error : Error of the surface that the points are compared with; None for none.

    Attributes
    ----------
    observations : Number of observations (measurements of the wall) simulated so far.
    cells : Indices of the traced samples, counted row by row over the sensor's whole view.
    caster : The wall, for ray casting.
    noiseless_model : The sensor model with its effects but without noise.

    Raises
    ------
    InputError
        If the sensor cannot be simulated in parts of its view, or does not see one of the windows.
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
        self.sensor = _supported_sensor(config, site)
        self.config, self.site, self.windows, self.of_points = config, site, windows, of_points
        self.reference_error = reference_error
        self.caster = site.caster_of(site.mesh)
        self.noiseless_model = _without_noise(self.sensor.model)
        self.observations = 0
        whole = _sensor_for_cells(self.sensor, self.noiseless_model).observe(self.caster, KeyedRandom(0))
        self._viewpoint = whole.viewpoint
        self._patches, patch_cells = self._surround(whole)
        lattice = _lattice(whole)
        self._lattice_start = len(patch_cells)
        self._lattice_points = whole.points.reshape(-1, 3)[lattice]
        self.cells = np.concatenate([patch_cells, lattice]).astype(np.uint32)

    @cached_property
    def target(self) -> ReferenceSurface:
        """The wall's surface without noise, with its normals, to which simulated observations are registered by ICP."""
        return ReferenceSurface.build(self.site.mesh.vertices, self.site.mesh.vertex_normals())

    def maps(self, model: Model, epochs: int, random: KeyedRandom) -> FloatArray:
        """Simulate difference maps of an unchanged wall in the k windows (square parts) in which a calibration compares maps.

        Each map subtracts a later epoch from the same noisy reference epoch. If the measured maps are distances of points from
        a known wall, so are the simulated ones; the simulated error of that wall is then the same in all epochs.

        Parameters
        ----------
        model : Sensor model to simulate.
        epochs : Number of maps.
        random : Source of the random numbers.

        Returns
        -------
        (epochs, k, n, n) differences in windows of n x n pixels, m; NaN outside stable ground.
        """
        sources = [random.child("epoch", number) for number in range(1, epochs + 1)]
        if self.of_points:
            return np.stack([self._of_points(model, source, random.child("reference")) for source in sources])
        reference = self.heights(model, random.child("epoch", 0))
        later = [self.heights(model, source) for source in sources]
        return np.where(self.windows.stable, reference - np.stack(later), np.nan)

    def _of_points(self, model: Model, random: KeyedRandom, reference: KeyedRandom) -> FloatArray:
        """Return the (k, n, n) mean distances, m, of each pixel's points from the known wall."""
        points = self._registered(model, random)[: self._lattice_start]
        if self.reference_error is not None:
            points = self.reference_error.moved(points, self.caster, reference)
        values = point_differences(self.caster, points[~np.isnan(points[:, 0])], self.windows.grid)
        return self.windows.cut(values)

    def heights(self, model: Model, random: KeyedRandom) -> FloatArray:
        """Simulate one noisy measurement of the wall, and return its surface in k windows, square parts of the wall.

        Parameters
        ----------
        model : Sensor model with the noise to simulate.
        random : Source of the random numbers.

        Returns
        -------
        (k, n, n) heights (z) in windows of n x n pixels, wall frame, m; NaN without data.
        """
        return self._raster(self._surface(self._registered(model, random)))

    def _registered(self, model: Model, random: KeyedRandom) -> FloatArray:
        """Return the (cells, 3) points of one observation, m, registered if the config has ICP."""
        self.observations += 1
        points = self._observe(model, random)
        if self.config.icp is None:
            return points
        return self._registration(points, self.config.icp, random.child("register")).apply(points)

    @cached_property
    def noiseless_heights(self) -> FloatArray:
        """(k, n, n) heights of the surface that the sensor would measure without noise, in k windows of n x n pixels.

        They are z in the wall frame, m.
        """
        return self._raster(self._surface(self._observe(self.noiseless_model, KeyedRandom(0))))

    def _observe(self, model: Model, random: KeyedRandom) -> FloatArray:
        """Return the (cells, 3) points of one observation, wall frame, m."""
        return _sensor_for_cells(self.sensor, model, self.cells).observe(self.caster, random).points.reshape(-1, 3)

    def _registration(self, points: FloatArray, icp: IcpConfig, random: KeyedRandom) -> RigidTransform:
        """Register the points to the noiseless wall by ICP.

        The start is the rigid motion that brings the lattice's points to their known noiseless positions.
        """
        lattice = points[self._lattice_start :]
        known = ~np.isnan(lattice[:, 0])
        first = _best_rigid(lattice[known], self._lattice_points[known])
        config = icp.model_copy(update={"subsample_points": False, "outlier_threshold_decay_iteration": 1})
        return register_to(self.target, first.apply(lattice[known]), config, random, threads=1).transform.after(first)

    def _surface(self, points: FloatArray) -> TriangleMesh:
        """Mesh all patches and join them."""
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
        """Return the (k, n, n) heights of a mesh at the centres of the windows' pixels, m."""
        x, y = self.windows.places()
        top = float(mesh.bounds[1, 2]) + 1.0
        origin = np.stack([x.ravel(), y.ravel(), np.full(x.size, top)], axis=1)
        distance, _ = RayCaster(mesh).cast(origin, np.broadcast_to([0.0, 0.0, -1.0], origin.shape))
        return (top - distance).reshape(x.shape)

    def _surround(self, whole: Observation) -> tuple[list[_Patch], NDArray[np.int64]]:
        """Find the cells around each window in the noiseless observation."""
        grid, side = self.windows.grid, self.windows.side * self.windows.grid.gsd
        x, y = whole.points[..., 0], whole.points[..., 1]
        patches, numbers, start = [], [], 0
        for row, column in self.windows.corner:
            left, up = grid.x_min + column * grid.gsd - _MARGIN_M, grid.y_max - row * grid.gsd + _MARGIN_M
            inside = (x >= left) & (x <= left + side + 2 * _MARGIN_M) & (y <= up) & (y >= up - side - 2 * _MARGIN_M)
            rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
            if len(rows) == 0:
                raise InputError(
                    "the simulated sensor does not see a part of the wall that the measured maps show",
                    where="cameras, station",
                    remedy="set position_m and rotation of the sensor to those of the measurement",
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
    """Return the rigid motion of (n, 3) points that fits them to their (n, 3) goals by least squares (Kabsch 1976)."""
    middle, goal = points.mean(axis=0), goals.mean(axis=0)
    u, _, v = np.linalg.svd((points - middle).T @ (goals - goal))
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    rotation = (u @ turn @ v).T
    return RigidTransform(rotation, goal - rotation @ middle)


def _lattice(whole: Observation) -> NDArray[np.int64]:
    """Return the flat indices of cells at equal steps over the view, where they have a point."""
    step = max(int(np.sqrt(np.count_nonzero(whole.valid) / _LATTICE_POINTS)), 1)
    number = np.arange(whole.depth.size).reshape(whole.depth.shape)[::step, ::step]
    return number[whole.valid[::step, ::step]]


def _without_noise(model: Model) -> Model:
    """Return the model with its effects but without its noise."""
    zero = {name: 0.0 for name in type(model.noise).model_fields if "sigma" in name or "ppm" in name}
    if isinstance(model, StereoModel):
        return StereoModel(noise=type(model.noise)(**zero), effects=model.effects)
    return TlsModel(noise=type(model.noise)(**zero), effects=model.effects)


def _sensor_for_cells(sensor: StereoPair | LaserScanner, model: Model, cells: NDArray[np.uint32] | None = None) -> Any:
    """Return the sensor with another model, restricted to some cells if `cells` is given."""
    asked = replace(sensor, model=model, truth=False)  # type: ignore[arg-type]
    return asked if cells is None else restrict_to(asked, cells)


def _supported_sensor(config: SimulationConfig, site: SensorSite) -> StereoPair | LaserScanner:
    """Return the sensor, or raise InputError if it cannot be simulated cell by cell."""
    if not isinstance(site.sensor, StereoPair | LaserScanner):
        raise InputError(
            "a calibration cannot fit the noise of a real image matcher",
            where="matcher",
            allowed="simulated",
            remedy="set matcher: simulated",
        )
    if site.further_stations:
        raise InputError(
            "a calibration needs a single scanner station, but the config has several",
            where="station",
            remedy="keep only the station that measured the maps",
        )
    if config.reconstruction != "direct" or config.surface.method != "grid" or config.surface.holes != "keep":
        raise InputError(
            "a calibration needs a surface that is made directly from the sensor's own grid",
            where="reconstruction, surface",
            allowed="reconstruction: direct, surface: {method: grid, holes: keep}",
            remedy="set these keys in the config",
        )
    if names := effects_needing_neighbours(site.sensor.model):
        raise InputError(
            f"calibration simulates only parts of a picture or scan, and these effects need all of it: {', '.join(names)}",
            where="sensor.effects",
            remedy="remove these effects from the sensor model",
        )
    return site.sensor
