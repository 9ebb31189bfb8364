"""Draw the blocks that fall from a wall (primitives, scaled, rotated and roughened) and place them on its relief."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Discriminator, Field, Tag, field_validator

from scene.blocks.distributions import Distribution, Gaussian, highest
from scene.common.config import Config
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, IntArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from scene.walls.contour import highest_under, highest_vertex_under, median_under
from scene.walls.safe_zone import SafeZone, safe_zone

_BATCH = 16
"""Number of positions tried at a time."""

_LEAST_DEPTH = 0.1
"""Depth that a block must reach into the rock, as a share of its height along z. A block that does not is placed again."""

_RADIAL_LIMITS = (0.3, 3.0)
"""Bounds of a vertex's radial factor. It stays positive, so that the block is star-shaped and never intersects itself."""


def _per_axis(value: Any) -> str:
    """Tell one distribution for all axes from a list of three."""
    return "per axis" if isinstance(value, list | tuple) else "all axes"


AxisDistributions = Annotated[
    Annotated[Distribution, Tag("all axes")] | Annotated[tuple[Distribution, Distribution, Distribution], Tag("per axis")],
    Discriminator(_per_axis),
]
"""One distribution from which each axis draws its own value, or a list of three, one per axis (x, y, z)."""


MOST_BLOCKS = 20_000
"""Most blocks per epoch. Placing that many takes about twenty seconds, carving them minutes."""


class RockfallConfig(Config):
    """How many blocks fall, what they look like and where they may lie.

    A block is a random solid; where it overlaps the wall, rock is removed, which leaves a niche. Distributions draw a value for
    each block (sizes, rotations) or for each vertex (irregularity).
    """

    count: int = Field(40, ge=1, le=MOST_BLOCKS, description="number of blocks")
    shape: Literal["cube", "sphere", "mixed"] = Field("mixed", description="primitive; mixed draws one for each block")
    size_m: AxisDistributions = Field(
        Gaussian(mean=0.4, sigma=0.1, minimum=0.15), description="lengths of a block's three axes; a list gives each axis its own"
    )
    rotation_rad: AxisDistributions = Field(
        Gaussian(mean=0.0, sigma=0.5), description="rotations about x, then y, then z; a list gives each axis its own"
    )
    irregularity: Distribution = Field(
        Gaussian(mean=0.0, sigma=0.04), description="radial offset of each vertex, as a fraction of its distance from the centre"
    )
    subdivisions: int = Field(
        2, ge=0, le=4, description="fineness: a sphere has 20 * 4^n triangles (2: 320), a cube about as many"
    )
    placement: Literal["relief", "highest_vertex", "mean_surface"] = Field(
        "relief",
        description="height of a block's centre: the highest relief within its contour; the highest of the wall's vertices "
        "there, which is lower on a coarser mesh; or the median surface, which makes niches about twice as deep",
    )
    safe_zone_offset_m: float = Field(0.5, ge=0, description="distance of blocks from the wall's border and its holes")
    minimum_distance_m: float = Field(0.1, ge=0, description="distance between the bounding boxes of two blocks, in x or in y")
    maximum_attempts: int = Field(2000, ge=1, description="positions tried for a block before giving up")

    @field_validator("size_m")
    @classmethod
    def _above_zero(cls, sizes: AxisDistributions) -> AxisDistributions:
        """Refuse lengths that are never above 0; a single length of 0 or less is refused where it is drawn."""
        for axis in sizes if isinstance(sizes, tuple) else (sizes,):
            if highest(axis) <= 0:
                raise ValueError(f"lengths must be above 0 m, but are {highest(axis):g} m at most")
        return sizes


HEIGHTS = {"relief": highest_under, "highest_vertex": highest_vertex_under, "mean_surface": median_under}
"""Function that returns the wall's height within contours, for each kind of placement."""


@dataclass(frozen=True)
class Blocks:
    """k closed blocks of rock in the wall frame, which are cut out of the wall as simulated rockfalls.

    The meshes are stored one after the other. The block with index i has the label i + 1.

    Attributes
    ----------
    vertices : (n, 3) array
        Vertices of all blocks, m.
    faces : (m, 3) int32 array
        Vertex indices, counter-clockwise seen from outside.
    vertex_start, face_start : (k + 1,) int32 arrays
        Row of each block's first vertex and face; the last entry is the number of all vertices or faces.
    shape : tuple of k str
        Name of each block's primitive, "cube" or "sphere".
    size_m : (k, 3) array
        Lengths of the axes before rotation, m.
    position_m : (k, 3) array
        Centres, m.
    """

    vertices: FloatArray
    faces: IntArray
    vertex_start: IntArray
    face_start: IntArray
    shape: tuple[str, ...]
    size_m: FloatArray
    position_m: FloatArray

    def __len__(self) -> int:
        return len(self.shape)

    @cached_property
    def bbox(self) -> FloatArray:
        """(k, 2, 3) smallest and largest coordinates of each of the k blocks, wall frame, m."""
        low = np.minimum.reduceat(self.vertices, self.vertex_start[:-1], axis=0)
        return np.stack([low, np.maximum.reduceat(self.vertices, self.vertex_start[:-1], axis=0)], axis=1)

    @cached_property
    def face_label(self) -> IntArray:
        """(m,) label, 1 to k, of the block to which each of the m faces belongs."""
        return np.repeat(np.arange(1, len(self) + 1, dtype=np.int32), np.diff(self.face_start))

    def mesh(self, index: int) -> TriangleMesh:
        """Return one block as a mesh of its own, wall frame. `index` counts the blocks from 0."""
        vertices = slice(self.vertex_start[index], self.vertex_start[index + 1])
        faces = self.faces[self.face_start[index] : self.face_start[index + 1]] - self.vertex_start[index]
        return TriangleMesh(self.vertices[vertices], faces)

    def only(self, index: int) -> Blocks:
        """Return a collection that holds one of the blocks alone. `index` counts the blocks from 0."""
        mesh, one = self.mesh(index), slice(index, index + 1)
        vertex_start, face_start = (np.array([0, len(array)], dtype=np.int32) for array in (mesh.vertices, mesh.faces))
        placed = self.shape[one], self.size_m[one], self.position_m[one]
        return Blocks(mesh.vertices, mesh.faces, vertex_start, face_start, *placed)


@dataclass(frozen=True)
class BlockShape:
    """A block of rock around the origin, before it is placed on the wall. The middle of its z range is 0.

    Attributes
    ----------
    shape : str
        Primitive that it was made from, "cube" or "sphere".
    size_m : (3,) array
        Lengths of the axes before rotation, m.
    vertices : (n, 3) array
        Vertices, rotated and roughened, m.
    faces : (m, 3) int32 array
        Vertex indices, counter-clockwise seen from outside.
    """

    shape: str
    size_m: FloatArray
    vertices: FloatArray
    faces: IntArray

    @cached_property
    def bbox(self) -> FloatArray:
        """(2, 3) smallest and largest coordinates of the block's vertices, m."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def place_blocks(config: RockfallConfig, mesh: TriangleMesh, random: KeyedRandom, caster: RayCaster | None = None) -> Blocks:
    """Draw `config.count` blocks and place them on the wall.

    A block keeps its shape and is tried at positions drawn uniformly from the safe zone (the wall without a strip along its
    border and its holes), until its bounding box lies inside the zone and far enough from those of the other blocks. Large
    blocks are placed first, so that small ones do not take their room.

    `config.placement` says at which height the middle of the block's z range then lies. It is the largest z of the wall's surface
    within the block's contour (`relief`), the largest z of its vertices there (`highest_vertex`), or its median z there
    (`mean_surface`). A block that does not reach into the rock at this height is placed again.

    Parameters
    ----------
    config : RockfallConfig
        Number, shape and placement of the blocks.
    mesh : TriangleMesh
        The wall, wall frame.
    random : KeyedRandom
        Source of random numbers. Each block draws from its own child, so that it does not depend on the others' draws.
    caster : RayCaster, optional
        A ray caster of `mesh`, if one exists already.

    Raises
    ------
    InputError
        If blocks are larger than the wall or find no room.
    """
    caster = caster or RayCaster(mesh)
    with np.errstate(over="ignore", invalid="ignore"):  # implausible sizes are reported by _require_fit
        solids = [draw_shape(config, random.child("block", index)) for index in range(config.count)]
    _require_fit(solids, mesh)
    zone = safe_zone(caster, config.safe_zone_offset_m)
    search = _PositionSearch(config, zone, solids, random)
    surface_under = HEIGHTS[config.placement]
    position = np.zeros((len(solids), 3))
    area = np.array([np.ptp(solid.bbox[:, :2], axis=0).prod() for solid in solids])
    _require_room(area, zone)
    pending = np.argsort(-area, kind="stable")
    while len(pending):
        for index in pending:
            position[index, :2] = search.place(int(index))
        outlines = [solids[index].vertices[:, :2] + position[index, :2] for index in pending]
        position[pending, 2] = surface_under(caster, outlines)
        pending = pending[~reach_rock([solids[index] for index in pending], position[pending], caster)]
        search.release(pending)
    return pack_blocks(solids, position)


def make_regular_blocks(
    position_m: FloatArray, size_m: FloatArray, rotation_rad: FloatArray, shape: str, subdivisions: int
) -> Blocks:
    """Make regular cubes or spheres at given positions, wall frame, for walls with blocks of known place and size.

    Parameters
    ----------
    position_m, size_m : (k, 3) arrays
        Centres and lengths of the axes before rotation, m.
    rotation_rad : (k, 3) array
        Rotations about x, then y, then z, rad.
    shape : str
        "cube" or "sphere", for all blocks.
    subdivisions : int
        Fineness n of the mesh: a sphere has 20 * 4^n triangles, a cube about as many.
    """
    from scipy.spatial.transform import Rotation

    unit, faces = _primitive(shape, subdivisions)
    found = [
        BlockShape(shape, size, Rotation.from_euler("xyz", turn).apply(unit * size), faces)
        for size, turn in zip(size_m, rotation_rad, strict=True)
    ]
    return pack_blocks(found, position_m)


class _PositionSearch:
    """Find positions of blocks by rejection sampling.

    Attributes
    ----------
    boxes : (k, 2, 2) array
        Range in x and y, m, of the blocks that are placed so far; NaN for the others.
    """

    def __init__(self, config: RockfallConfig, zone: SafeZone, solids: Sequence[BlockShape], random: KeyedRandom) -> None:
        self._config, self._zone, self._solids = config, zone, solids
        self._generators = [random.child("block", index, "position").generator() for index in range(len(solids))]
        self._attempts = np.zeros(len(solids), dtype=int)
        self._hung = np.zeros(len(solids), dtype=int)
        self.boxes = np.full((len(solids), 2, 2), np.nan)

    def place(self, index: int) -> FloatArray:
        """Return the next admissible position (2,) of a block, m."""
        shape = self._solids[index].bbox[:, :2]
        while self._attempts[index] < self._config.maximum_attempts:
            self._attempts[index] += _BATCH
            positions = self._zone.sample(self._generators[index], _BATCH)
            boxes = positions[:, None] + shape
            for good in np.flatnonzero(self._zone.holds(boxes)):
                if self._is_apart(boxes[good]):
                    self.boxes[index] = boxes[good]
                    return positions[good]
        raise self._no_room(index)

    def _is_apart(self, box: FloatArray) -> bool:
        """Return whether a box is far enough from all placed ones."""
        gap = np.maximum(box[0] - self.boxes[:, 1], self.boxes[:, 0] - box[1])  # in x and in y
        apart = np.maximum(gap[:, 0], gap[:, 1])
        return not np.any((apart < self._config.minimum_distance_m) | (apart <= 0))

    def release(self, indices: NDArray[np.intp]) -> None:
        """Remove blocks that do not reach into the rock where they were placed, so that their room is free again."""
        self.boxes[indices] = np.nan
        self._hung[indices] += 1

    def _no_room(self, index: int) -> InputError:
        """Make the error for a block that finds no position."""
        placed, (width, height) = int(np.isfinite(self.boxes[:, 0, 0]).sum()), np.ptp(self._solids[index].bbox[:, :2], axis=0)
        times_hung = f" ({self._hung[index]} times it would have hung in front of a steep wall)" if self._hung[index] else ""
        return InputError(
            f"no room was found for a block of {width:.2f} x {height:.2f} m in "
            f"{self._config.maximum_attempts} attempts{times_hung}; "
            f"{placed} of {len(self._solids)} blocks have a place",
            where="rockfall",
            remedy="lower count, size_m, minimum_distance_m or safe_zone_offset_m, or raise maximum_attempts",
        )


def _require_room(area: FloatArray, zone: SafeZone) -> None:
    """Raise InputError if the bounding boxes, which may not overlap, have a larger total area than the safe zone."""
    room = zone.free.sum() * zone.grid.gsd**2
    if area.sum() > room:
        raise InputError(
            f"{len(area)} blocks take {area.sum():,.0f} m2, but the safe zone of the wall has only {room:,.0f} m2",
            where="rockfall",
            remedy="lower count, size_m or safe_zone_offset_m",
        )


def draw_shape(config: RockfallConfig, random: KeyedRandom) -> BlockShape:
    """Draw the shape of a block at random: scale a cube or sphere along its axes, rotate it and roughen its surface.

    Sizes, rotations and roughness come from the distributions in `config`. Roughness is a radial offset of each vertex. Raises
    InputError if a length of zero or less is drawn.
    """
    from scipy.spatial.transform import Rotation

    generator = random.child("shape").generator()
    shape = ("cube", "sphere")[generator.integers(2)] if config.shape == "mixed" else config.shape
    size = _draw_per_axis(config.size_m, generator)
    if not size.min() > 0:
        raise InputError(
            f"a block with a length of {size.min():.3g} m was drawn",
            where="size_m",
            allowed="above 0",
            remedy="give size_m a minimum above 0",
        )
    unit, faces = _primitive(shape, config.subdivisions)
    vertices = Rotation.from_euler("xyz", _draw_per_axis(config.rotation_rad, generator)).apply(unit * size)
    factor = np.clip(1 + config.irregularity.sample(generator, len(vertices)), *_RADIAL_LIMITS)
    vertices = vertices * factor[:, None]
    vertices[:, 2] -= (vertices[:, 2].max() + vertices[:, 2].min()) / 2
    return BlockShape(shape, size, vertices, faces)


def _draw_per_axis(distributions: AxisDistributions, generator: np.random.Generator) -> FloatArray:
    """Draw one value per axis (3,)."""
    axes = distributions if isinstance(distributions, tuple) else (distributions,) * 3
    return np.concatenate([axis.sample(generator, 1) for axis in axes])


@lru_cache
def _primitive(shape: str, subdivisions: int) -> tuple[FloatArray, IntArray]:
    """Return vertices and faces of a sphere or cube with diameter or side 1 around the origin."""
    import trimesh

    if shape == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.5)
        return np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int32)
    return _cube(round(np.sqrt(20 / 12 * 4**subdivisions)))


def _cube(segments: int) -> tuple[FloatArray, IntArray]:
    """Make a cube with side 1 around the origin; each side has segments x segments squares of two triangles."""
    steps = np.arange(segments + 1)
    quads = []
    for axis in range(3):
        for side in (0, segments):
            first, second = np.meshgrid(steps, steps, indexing="ij")
            grid = np.empty((segments + 1, segments + 1, 3), dtype=int)
            grid[..., axis], grid[..., (axis + 1) % 3], grid[..., (axis + 2) % 3] = side, first, second
            squares = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2).reshape(-1, 4, 3)
            quads.append(squares if side else squares[:, ::-1])
    corners, number = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    quad = number.reshape(-1, 4)
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]).astype(np.int32)
    return corners / segments - 0.5, faces


def _require_fit(solids: Sequence[BlockShape], mesh: TriangleMesh) -> None:
    """Raise InputError if a block's bounding box is larger than the wall's."""
    wall = np.ptp(mesh.bounds[:, :2], axis=0)
    extents = np.array([np.ptp(solid.bbox[:, :2], axis=0) for solid in solids])
    too_large = np.any(extents >= wall, axis=1)
    if too_large.any():
        width, height = extents[too_large].max(axis=0)
        raise InputError(
            f"{too_large.sum()} of {len(solids)} blocks are larger than the wall (up to {width:.3g} x {height:.3g} m)",
            where="size_m",
            allowed=f"below {wall[0]:.3g} x {wall[1]:.3g} m",
            remedy="give smaller sizes, in metres",
        )


def reach_rock(solids: Sequence[BlockShape], position: FloatArray, caster: RayCaster) -> NDArray[np.bool_]:
    """Return whether each of k blocks reaches far enough into the rock to remove something: a bool array (k,).

    A block does if a vertex lies below the surface, along z, by at least a tenth of the block's height.

    Parameters
    ----------
    solids : sequence of k BlockShape
        The blocks, around the origin.
    position : (k, 3) array
        Where they are to be placed, wall frame, m.
    caster : RayCaster
        The wall, wall frame.
    """
    counts = np.array([len(solid.vertices) for solid in solids])
    points = np.concatenate([solid.vertices for solid in solids]) + np.repeat(position, counts, axis=0)
    start = points.copy()
    start[:, 2] = caster.mesh.bounds[1, 2] + 1.0
    distance, _ = caster.cast(start, np.tile([0.0, 0.0, -1.0], (len(points), 1)))
    depth = start[:, 2] - distance - points[:, 2]  # below the surface; NaN where there is none
    deepest = np.fmax.reduceat(depth, np.concatenate([[0], np.cumsum(counts)[:-1]]))
    height = np.array([np.ptp(solid.bbox[:, 2]) for solid in solids])
    return deepest >= _LEAST_DEPTH * height


def pack_blocks(solids: Sequence[BlockShape], position: FloatArray) -> Blocks:
    """Move block shapes to their places on the wall, and join them into one collection.

    solids: the k shapes, around the origin. position: (k, 3) places of their origins, wall frame, m.
    """
    vertex_start = _starts([len(solid.vertices) for solid in solids])
    face_start = _starts([len(solid.faces) for solid in solids])
    vertices = np.concatenate([solid.vertices + place for solid, place in zip(solids, position, strict=True)])
    faces = np.concatenate([solid.faces + start for solid, start in zip(solids, vertex_start[:-1], strict=True)])
    shapes, sizes = tuple(solid.shape for solid in solids), np.stack([solid.size_m for solid in solids])
    return Blocks(vertices, faces, vertex_start, face_start, shapes, sizes, position)


def _starts(counts: Sequence[int]) -> IntArray:
    """Return where each of several consecutive ranges begins, and where the last one ends."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
