"""Building blocks: a wall, blocks, a sensor of one's own, and what becomes of an observation; each one call on arrays.

Everything after `stage` is in the wall frame: x along the wall, y up the wall, z towards the sensor, m.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from pipeline.api.configs import ConfigLike, configure, one_sensor
from pipeline.api.maps import DIFFERENCE, data_array
from pipeline.api.meshes import Mesh
from pipeline.change import difference as rasters
from pipeline.config.simulation import SensorName
from pipeline.formats.point_cloud import PointCloud
from pipeline.registration import register as icp
from pipeline.run.site import SensorSite, prepare_site
from pipeline.surface.from_cloud import CloudConfig, surface_of_cloud
from pipeline.surface.mesh import SurfaceConfig, median_spacing, mesh_observation
from scene.blocks import block as solids
from scene.blocks import carve as carving
from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.geometry.point_planes import estimate_normals
from scene.meshes.rounding import check_steps, rounded_axes
from scene.ray_casting.raycast import RayCaster
from scene.walls.imported import ImportedWall
from scene.walls.procedural import ProceduralWall
from scene.walls.wall import Wall
from sensors.signal_chain.observation import Observation, Sensor

if TYPE_CHECKING:
    import xarray


_FEWEST_FOR_NORMALS = 3


def make_wall(seed: int = 1, **keys: Any) -> Mesh:
    """A wall made by rule, world frame. keys: a config's of `wall`: style="glendale", width_m, height_m, resolution_m, ..."""
    return Mesh.of(parse(ProceduralWall, keys, "make_wall").mesh(KeyedRandom(seed)))


def open_wall(path: Path | str | Sequence[Path | str], **keys: Any) -> Mesh:
    """Read a wall from a mesh file, or from several that make up the scene, mended as a simulation mends it.

    keys: unit, flipped, albedo, as in a config's `wall`. The mesh is in the files' coordinates, m.
    """
    mesh = str(path) if isinstance(path, Path | str) else [str(each) for each in path]
    return Mesh.of(parse(ImportedWall, {"mesh": mesh, **keys}, "open_wall").load()[0])


def stage(
    wall: TriangleMesh | None = None,
    sensor: SensorName | None = None,
    config: ConfigLike = None,
    *,
    seed: int | None = None,
    model: Any = None,
    **overrides: Any,
) -> SensorSite:
    """A wall (world frame; none: the config's) in its frame with a sensor before it: `.mesh`, `.frame`, `.sensor`, `.viewpoints`.

    The wall frame's z axis points to the sensor, which the config places; config, model, overrides: as `configure` takes them.
    """
    resolved = configure(config, sensor, seed=seed, model=model, **overrides)
    given = None if wall is None else Wall(wall, (), "wall")
    return prepare_site(resolved, one_sensor(resolved, sensor), KeyedRandom(resolved.seed), given)


def make_blocks(
    centres: ArrayLike,
    sizes: ArrayLike,
    *,
    rotations_rad: ArrayLike | None = None,
    shape: Literal["cube", "sphere"] = "cube",
    subdivisions: int = 2,
) -> solids.Blocks:
    """Blocks where and as large as they are wanted, wall frame, m; their labels count from 1.

    centres: (k, 3); sizes: (k, 3) lengths of the axes, or (k,) of all three; rotations_rad: (k, 3) about x, then y, then z.
    """
    place = _table(centres, "centres")
    size = np.asarray(sizes, dtype=np.float64)
    size = _table(np.repeat(size[:, None], 3, axis=1) if size.ndim == 1 else size, "sizes", len(place))
    turn = np.zeros_like(place) if rotations_rad is None else _table(rotations_rad, "rotations_rad", len(place))
    if not (size > 0).all():
        raise InputError(f"holds {size.min():g} m", where="sizes", allowed="above 0")
    return solids.make_regular_blocks(place, size, turn, shape, subdivisions)


def place_blocks(mesh: TriangleMesh, seed: int = 1, **keys: Any) -> solids.Blocks:
    """Blocks drawn at random on a wall, wall frame. keys: those of a config's `rockfall`: count, shape, size_m, ..."""
    config = parse(solids.RockfallConfig, keys, "place_blocks")
    return solids.place_blocks(config, mesh, KeyedRandom(seed).child("blocks"))


def carve(mesh: TriangleMesh, blocks: solids.Blocks) -> carving.Carved:
    """The wall without its blocks: `.mesh`, whose faces know their block, and `.removed_volume_m3`, (k,)."""
    return carving.carve(mesh, blocks)


def observe(mesh: TriangleMesh, sensor: Sensor, seed: int = 1) -> Observation:
    """One look of a sensor, `stage(...).sensor` or one's own, at a mesh in its frame; the same seed gives the same bytes."""
    return sensor.observe(RayCaster(mesh), KeyedRandom(seed))


def reconstruct(observation: Observation, **keys: Any) -> Mesh:
    """The surface through the points of an observation's grid. keys: those of a config's `surface`: method, depth_step_m, ..."""
    return Mesh.of(mesh_observation(observation, parse(SurfaceConfig, keys, "reconstruct")))


def mesh_points(points: ArrayLike, viewpoint: ArrayLike, **keys: Any) -> Mesh:
    """Make the surface through unorganised points (n, 3), m, in their frame, as it is seen from `viewpoint` (3,), m.

    keys: method ("triangulation" between the points, or "poisson", which needs the extra `poisson`), poisson_depth,
    poisson_trim_spacings.
    """
    config = parse(CloudConfig, keys, "mesh_points")
    eye = _table(np.reshape(np.asarray(viewpoint), (1, -1)), "viewpoint", 1)[0]
    return Mesh.of(surface_of_cloud(PointCloud(_table(points, "points")), eye, config, "points").mesh)


def register(moving: Any, reference: Any, seed: int = 1, **keys: Any) -> icp.Registration:
    """Register one surface on another with ICP.

    Parameters
    ----------
    moving, reference : mesh or (n, 3) array
        In one frame, m. Vertices of a mesh that no triangle with an area uses are left out. Where the reference is an array and
        the distance is measured along normals, they are estimated from the 24 nearest points of each.
    seed : int
        Of the random subsets that ICP begins with.
    **keys
        Those of a config's `icp`, such as method="point_to_point".

    Returns
    -------
    Registration
        `.rotation` (3, 3), `.translation` (3,) m, `.apply(points)`, `.rms_m`; x_reference = rotation x_moving + translation.

    Raises
    ------
    InputError
        For points that are too few, not finite or on a line, and for wrong keys.
    """
    config = parse(icp.IcpConfig, keys, "register")
    points, normals = _surface_points(reference, "reference")
    if normals is None and config.method == "point_to_plane" and len(points) >= _FEWEST_FOR_NORMALS:
        normals = estimate_normals(points)
    return icp.register(_surface_points(moving, "moving")[0], points, normals, config, KeyedRandom(seed))


def difference(reference: TriangleMesh, epoch: TriangleMesh, gsd_m: float = 0.02) -> xarray.DataArray:
    """(y, x) reference minus epoch along z, m, missing rock positive, NaN without data; coordinate `block`: epoch's labels."""
    grid = rasters.raster_grid(reference.bounds, parse(rasters.DifferenceConfig, {"gsd_m": gsd_m}, "difference"))
    before, after = rasters.surface_raster(reference, grid), rasters.surface_raster(epoch, grid)
    change = data_array(rasters.difference(before, after), grid, "difference", DIFFERENCE)
    return change.assign_coords(block=(("y", "x"), after.block))


def _surface_points(given: Any, name: str) -> tuple[FloatArray, FloatArray | None]:
    """Points (n, 3) of a mesh or an array, and a mesh's vertex normals; vertices without a normal belong to no surface."""
    if not isinstance(given, TriangleMesh):
        points = _table(given, name)
        rounded = rounded_axes(points)
        if rounded:
            check_steps(rounded, median_spacing(points - points[0]), name, "the points' spacing is")
        return points, None
    normals = given.vertex_normals()
    length = np.linalg.norm(normals, axis=1)
    used = np.isfinite(length) & (length > 0)
    return given.vertices[used], normals[used]


def _table(values: ArrayLike, name: str, rows: int | None = None) -> Any:
    """(n, 3) float64, finite."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3 or not len(array) or (rows is not None and len(array) != rows):
        raise InputError(f"have the shape {array.shape}", where=name, allowed=f"({'n' if rows is None else rows}, 3)")
    if not np.isfinite(array).all():
        raise InputError("are not all finite", where=name)
    return array
