"""Place a block so that the rock that it cuts out of the wall has a given volume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from scene.blocks.block import HEIGHTS, Blocks, BlockShape, RockfallConfig, draw_shape, pack_blocks
from scene.blocks.solid import close_patch, solid_of
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, IntArray, TriangleMesh, signed_volumes
from scene.geometry.under_boxes import faces_under_boxes
from scene.ray_casting.raycast import RayCaster
from scene.walls.safe_zone import SafeZone

_WITHIN = 0.01
"""Relative deviation of the rock's volume from the one that is asked for, at which the search of the block's size ends."""
_ROUNDS = 12
_BATCH = 16
"""Number of positions tried at a time."""
_PATCH = 2.0
"""Side of the patch of the wall that is examined, in sides of the first guess of the block."""


@dataclass(frozen=True)
class BlockRequest:
    """A block that is to be placed on the wall.

    Attributes
    ----------
    volume_m3 : float
        Volume of the rock that it is to remove, m3.
    position_m : (x, y), optional
        Where its centre is to lie, wall frame, m; None: at random.
    random : KeyedRandom
        Source of random numbers for its shape and place.
    name : str
        What error messages call it.
    """

    volume_m3: float
    position_m: tuple[float, float] | None
    random: KeyedRandom
    name: str


def place_block(
    request: BlockRequest, wall: TriangleMesh, zone: SafeZone, taken: Sequence[FloatArray], config: RockfallConfig
) -> Blocks:
    """Place one block, which is to fall, on the wall as it is now.

    Its shape is drawn from `config`, its size follows from the volume.

    Parameters
    ----------
    request : BlockRequest
        Volume and place.
    wall : TriangleMesh
        The wall with the niches of earlier rockfalls, wall frame.
    zone : SafeZone
        Part of the wall in which a random place is drawn, for a block without a given place.
    taken : sequence of (2, 3) arrays
        Bounding boxes (smallest and largest coordinates, wall frame, m) of blocks that it may not touch.
    config : RockfallConfig
        Shapes and placement.

    Returns
    -------
    Blocks
        A collection with this one block, wall frame.

    Raises
    ------
    InputError
        If it finds no room, or if there is no rock at the given place.
    """
    shape = draw_shape(config, request.random)
    guess = float((2 * request.volume_m3 / _volume(shape)) ** (1 / 3))
    tried = 0
    generator = request.random.child("position").generator()
    while tried < config.maximum_attempts:
        if request.position_m is None:
            places = zone.sample(generator, _BATCH)
            boxes = places[:, None] + _scaled(shape, guess).bbox[:, :2]
            places = places[zone.holds(boxes)]
        else:
            places = np.array([request.position_m])
        for place in places:
            found = _sized(shape, guess, place, wall, request.volume_m3, config)
            if found is not None and not any(_touch(found.bbox[0], box, config.minimum_distance_m) for box in taken):
                return found
        if request.position_m is not None:
            raise InputError(
                f"no block of {request.volume_m3:g} m3 can be cut out at ({place[0]:g}, {place[1]:g}) m",
                where=request.name,
                remedy="choose a place on the wall (x, y in the wall frame) that no moving block takes, or a smaller volume",
            )
        tried += _BATCH
    raise InputError(
        f"no room was found for a block of {request.volume_m3:g} m3 in {config.maximum_attempts} attempts",
        where=request.name,
        remedy="lower the volumes or rockfall.safe_zone_offset_m",
    )


def join_blocks(parts: Sequence[Blocks]) -> Blocks:
    """Join several collections of blocks into one, in order; each block's label is its new position plus 1."""
    vertices, faces = ([len(getattr(each, name)) for each in parts] for name in ("vertices", "faces"))
    at = np.concatenate([[0], np.cumsum(vertices)[:-1]]).astype(np.int32)
    face_at = np.concatenate([[0], np.cumsum(faces)[:-1]]).astype(np.int32)

    def starts(name: str, offsets: IntArray, total: int) -> IntArray:
        own = [getattr(each, name)[:-1] + offset for each, offset in zip(parts, offsets, strict=True)]
        return np.concatenate([*own, [total]]).astype(np.int32)

    return Blocks(
        np.concatenate([each.vertices for each in parts]),
        np.concatenate([each.faces + offset for each, offset in zip(parts, at, strict=True)]).astype(np.int32),
        starts("vertex_start", at, sum(vertices)),
        starts("face_start", face_at, sum(faces)),
        tuple(name for each in parts for name in each.shape),
        np.concatenate([each.size_m for each in parts]),
        np.concatenate([each.position_m for each in parts]),
    )


def _sized(
    shape: BlockShape, guess: float, place: FloatArray, wall: TriangleMesh, volume_m3: float, config: RockfallConfig
) -> Blocks | None:
    """Return the block at a place (2,), m, scaled so that it cuts out the volume; None where it cannot.

    In an old niche, where the highest relief is that of the rim and may be too far above the rock, the block lies at the median
    height instead. Volumes grow about as the cube of the scale, so each round multiplies it by the cube root of the ratio.
    """
    box = place + _PATCH * _scaled(shape, guess).bbox[:, :2]
    rows = faces_under_boxes(wall, box[None])
    if not len(rows):
        return None
    patch = wall.submesh(rows)
    caster = RayCaster(patch)
    for heights in dict.fromkeys((HEIGHTS[config.placement], HEIGHTS["mean_surface"])):
        scale = guess
        for _ in range(_ROUNDS):
            scaled = _scaled(shape, scale)
            height = heights(caster, [scaled.vertices[:, :2] + place])[0]
            if not np.isfinite(height) or not _within(scaled.bbox[:, :2] + place, box):
                break
            block = pack_blocks([scaled], np.append(place, height)[None])
            cut = _cut_volume(patch, block)
            if abs(cut / volume_m3 - 1) < _WITHIN:
                return block
            scale *= float(np.clip((volume_m3 / max(cut, 1e-12)) ** (1 / 3), 0.7, 1.4))
    return None


def _cut_volume(patch: TriangleMesh, block: Blocks) -> float:
    """Return the volume of rock, m3, that a block would remove from a patch of the wall."""
    rows = np.arange(len(patch.faces), dtype=np.int32)
    rock, _ = close_patch(patch, rows, float(block.bbox[0, 0, 2]))
    return float((rock.manifold ^ solid_of(block.vertices, block.faces, "blocks").manifold).volume())


def _scaled(shape: BlockShape, scale: float) -> BlockShape:
    """Return a shape of another size."""
    return replace(shape, size_m=shape.size_m * scale, vertices=shape.vertices * scale)


def _volume(shape: BlockShape) -> float:
    """Return the volume of a shape, m3."""
    return float(signed_volumes(shape.vertices[shape.faces]).sum() / 6)


def _within(inner: FloatArray, outer: FloatArray) -> bool:
    """Return whether a box (2, 2) lies inside another."""
    return bool((inner[0] >= outer[0]).all() and (inner[1] <= outer[1]).all())


def _touch(box: FloatArray, other: FloatArray, distance_m: float) -> bool:
    """Return whether two boxes (2, 3) are nearer in x and in y than a distance, m."""
    gap = np.maximum(box[0, :2] - other[1, :2], other[0, :2] - box[1, :2])
    return bool(gap.max() < max(distance_m, 1e-9))


def no_blocks() -> Blocks:
    """Return a collection of blocks without any block, for an epoch in which nothing falls."""
    start = np.zeros(1, dtype=np.int32)
    return Blocks(np.empty((0, 3)), np.empty((0, 3), dtype=np.int32), start, start, (), np.empty((0, 3)), np.empty((0, 3)))
