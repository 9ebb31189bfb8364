"""Provide the single steps of a simulation as functions on arrays: make a wall, place blocks, observe, mesh, register, compare.

Use them to build an experiment that `simulate` does not cover. After `stage` everything is in the wall frame: x along the
wall, y up the wall, z towards the sensor, m.
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
    """Generate an artificial rock wall as a mesh, to simulate on.

    Parameters
    ----------
    seed : int
        Seed of the random shape. The same seed gives the same wall.
    **keys
        Keys of a config's `wall` section, such as style="glendale" (whose rock it resembles), width_m, height_m, and
        resolution_m (distance of its vertices).

    Returns
    -------
    Mesh
        The wall in the world frame, m.
    """
    return Mesh.of(parse(ProceduralWall, keys, "make_wall").mesh(KeyedRandom(seed)))


def open_wall(path: Path | str | Sequence[Path | str], **keys: Any) -> Mesh:
    """Read a wall of your own from mesh files, to simulate on.

    Duplicate vertices and triangles and wrong winding are repaired, as the command `simulate` does.

    Parameters
    ----------
    path : path, or list of paths
        A mesh file, or the several files that make up the scene.
    **keys
        Keys of a config's `wall` section: unit (of the coordinates, such as "ft"; default "m"), flipped (True if the
        triangles are clockwise seen from the sensor's side), albedo (share of light reflected, 0 to 1; default: the
        file's own).

    Returns
    -------
    Mesh
        The wall in the files' coordinate system, m.
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
    """Place a sensor in front of a wall and transform the wall into the wall frame, ready for `observe`.

    Parameters
    ----------
    wall : TriangleMesh, optional
        The wall in the world frame, m. Default: the config's wall.
    sensor : "tls" or "stereo", optional
        The sensor: laser scanner or stereo pair. May be omitted if the config has only one.
    config, seed, model, **overrides
        The config (file, name or values), a seed and a sensor model in place of the config's, and changed keys; they are
        treated as by `configure`. The config also says where the sensor stands.

    Returns
    -------
    SensorSite
        `.mesh` is the wall, wall frame, and `.sensor` the sensor: the arguments of `observe`. `.frame` converts between
        world and wall frame, whose z axis points to the sensor. `.viewpoints` has the positions (3,) of scanner or
        cameras by name, wall frame, m.
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
    """Make blocks of given positions and sizes, to be removed from a wall by `carve`; they are labelled 1 to k.

    Parameters
    ----------
    centres : (k, 3) array
        Centres of the blocks, wall frame, m.
    sizes : (k, 3) or (k,) array
        Lengths of the three axes, or one length for all three, m.
    rotations_rad : (k, 3) array, optional
        Rotation angles about x, then y, then z, rad. Default: no rotation.
    shape : "cube" or "sphere"
        Shape of all blocks.
    subdivisions : int
        How often each triangle of the basic shape is divided into smaller ones: the more often, the finer the blocks.

    Returns
    -------
    Blocks
        The blocks as closed meshes, wall frame, m.

    Raises
    ------
    InputError
        If the arrays have other shapes, are not finite, or a size is not positive.
    """
    place = _table(centres, "centres")
    size = np.asarray(sizes, dtype=np.float64)
    size = _table(np.repeat(size[:, None], 3, axis=1) if size.ndim == 1 else size, "sizes", len(place))
    turn = np.zeros_like(place) if rotations_rad is None else _table(rotations_rad, "rotations_rad", len(place))
    if not (size > 0).all():
        raise InputError(
            f"a block has the size {size.min():g} m", where="sizes", allowed="above 0", remedy="give sizes in metres, above 0"
        )
    return solids.make_regular_blocks(place, size, turn, shape, subdivisions)


def place_blocks(mesh: TriangleMesh, seed: int = 1, **keys: Any) -> solids.Blocks:
    """Draw blocks at random positions on a wall, to be removed from it by `carve`.

    Parameters
    ----------
    mesh : TriangleMesh
        The wall, wall frame, m.
    seed : int
        Seed of positions, sizes and shapes.
    **keys
        Keys of a config's `rockfall` section: count, shape, size_m, ...

    Returns
    -------
    Blocks
        The blocks as closed meshes, wall frame, m.
    """
    config = parse(solids.RockfallConfig, keys, "place_blocks")
    return solids.place_blocks(config, mesh, KeyedRandom(seed).child("blocks"))


def carve(mesh: TriangleMesh, blocks: solids.Blocks) -> carving.Carved:
    """Remove blocks from a wall, as rockfall does, so that each leaves a niche.

    mesh: the wall, m. blocks: closed meshes in the wall's frame, as `make_blocks` or `place_blocks` returns them.

    Returns
    -------
    Carved
        `.mesh`, whose `face_block` labels the faces of each niche, and `.removed_volume_m3` (k,), the volume that each of the k
        blocks took from the wall.
    """
    return carving.carve(mesh, blocks)


def observe(mesh: TriangleMesh, sensor: Sensor, seed: int = 1) -> Observation:
    """Simulate one measurement of a mesh by a sensor, with noise.

    Parameters
    ----------
    mesh : TriangleMesh
        The scene in the sensor's frame, usually the wall frame, m.
    sensor : Sensor
        `stage(...).sensor`, or an object of your own with the same method `observe`.
    seed : int
        Seed of the noise. The same seed gives identical bytes.

    Returns
    -------
    Observation
        The measured points in the frame of the mesh, m, one for each pulse of the scanner or pixel of the depth map.
    """
    return sensor.observe(RayCaster(mesh), KeyedRandom(seed))


def reconstruct(observation: Observation, **keys: Any) -> Mesh:
    """Make a surface of what a sensor observed, by joining points that are neighbours in its grid of pulses or pixels.

    Parameters
    ----------
    observation : Observation
        Result of `observe`.
    **keys
        Keys of a config's `surface` section, such as method ("grid" or "poisson") and depth_step_m (m; edges with a
        smaller difference of range are never cut).

    Returns
    -------
    Mesh
        The surface in the frame of the observation, m.
    """
    return Mesh.of(mesh_observation(observation, parse(SurfaceConfig, keys, "reconstruct")))


def mesh_points(points: ArrayLike, viewpoint: ArrayLike, **keys: Any) -> Mesh:
    """Make a surface of points that are in no order, as they are seen from one place.

    Parameters
    ----------
    points : (n, 3) array
        Points in any frame, m.
    viewpoint : (3,) array
        Where the sensor stood, in the same frame, m.
    **keys
        method: "triangulation" between the points, or "poisson" (reconstruction by Open3D, which the extra `poisson`
        installs). poisson_depth: depth of its octree. poisson_trim_spacings: how far its surface reaches beyond the
        points, in median point spacings.

    Returns
    -------
    Mesh
        The surface in the frame of the points, m.
    """
    config = parse(CloudConfig, keys, "mesh_points")
    eye = _table(np.reshape(np.asarray(viewpoint), (1, -1)), "viewpoint", 1)[0]
    return Mesh.of(surface_of_cloud(PointCloud(_table(points, "points")), eye, config, "points").mesh)


def register(moving: Any, reference: Any, seed: int = 1, **keys: Any) -> icp.Registration:
    """Register one surface on another with ICP.

    Parameters
    ----------
    moving, reference : mesh or (n, 3) array
        Both in one frame, m. Vertices that no triangle of positive area uses are ignored. If the reference is an array and
        distances are measured along normals, the normals are estimated from the 24 nearest points of each point.
    seed : int
        Seed of the random subsets that ICP starts with.
    **keys
        Keys of a config's `icp` section, such as method="point_to_point".

    Returns
    -------
    Registration
        `.rotation` (3, 3), `.translation` (3,) m, `.apply(points)`, `.rms_m`; x_reference = rotation x_moving + translation.

    Raises
    ------
    InputError
        If the points are too few, not finite or collinear, or a key is wrong.
    """
    config = parse(icp.IcpConfig, keys, "register")
    points, normals = _surface_points(reference, "reference")
    if normals is None and config.method == "point_to_plane" and len(points) >= _FEWEST_FOR_NORMALS:
        normals = estimate_normals(points)
    return icp.register(_surface_points(moving, "moving")[0], points, normals, config, KeyedRandom(seed))


def difference(reference: TriangleMesh, epoch: TriangleMesh, gsd_m: float = 0.02) -> xarray.DataArray:
    """Map the change between two surfaces along z.

    Parameters
    ----------
    reference, epoch : TriangleMesh
        The surfaces before and after, wall frame, m.
    gsd_m : float
        Side of a pixel, m.

    Returns
    -------
    xarray.DataArray
        (y, x) reference minus epoch, m. Missing rock is positive, NaN means no data. The coordinate `block` has the epoch's
        block labels.
    """
    grid = rasters.raster_grid(reference.bounds, parse(rasters.DifferenceConfig, {"gsd_m": gsd_m}, "difference"))
    before, after = rasters.surface_raster(reference, grid), rasters.surface_raster(epoch, grid)
    change = data_array(rasters.difference(before, after), grid, "difference", DIFFERENCE)
    return change.assign_coords(block=(("y", "x"), after.block))


def _surface_points(given: Any, name: str) -> tuple[FloatArray, FloatArray | None]:
    """Return the points (n, 3) of a mesh or an array, and the vertex normals of a mesh (None for an array).

    Vertices without a normal are dropped, because they belong to no surface.
    """
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
    """Return the values as a finite (n, 3) float64 array; raise InputError for other shapes."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3 or not len(array) or (rows is not None and len(array) != rows):
        raise InputError(
            f"the array has the shape {array.shape}",
            where=name,
            allowed=f"({'n' if rows is None else rows}, 3)",
            remedy="give an array of rows x, y, z",
        )
    if not np.isfinite(array).all():
        raise InputError("the array contains values that are NaN or infinite", where=name, remedy="remove these rows")
    return array
