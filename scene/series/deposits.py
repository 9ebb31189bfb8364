"""Lay the fragments of a fallen rock at rest: on the ground at the wall's foot, or on a ledge on the way.

There is no dynamics. A fragment drops straight down until it touches. Where the rock there is steeper than the angle of repose,
it moves outward by its own radius and drops again. The ground is the horizontal plane through the lowest point of the wall. On
the ground, fragments that would touch an earlier one move aside. Contact is decided by rays from the fragment's vertices, so
fragments may sink into the rock by its roughness between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.blocks.block import BlockShape, RockfallConfig, draw_shape
from scene.blocks.distributions import Constant, Gaussian, Lognormal
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, TriangleMesh, signed_volumes
from scene.geometry.under_boxes import faces_under_boxes
from scene.ray_casting.raycast import RayCaster
from scene.series.config import DepositsConfig

_REPOSE = float(np.cos(np.radians(35.0)))
"""Cosine of the steepest slope on which a fragment stays."""
_MOST_STEPS = 200
_SHAPES = RockfallConfig(
    shape="mixed",
    subdivisions=1,
    size_m=Lognormal(median=1.0, sigma_log=0.25),
    rotation_rad=Gaussian(mean=0.0, sigma=1.0),
    irregularity=Constant(value=0.0),
)
"""Shapes of the fragments."""


@dataclass(frozen=True)
class Ground:
    """Level ground at the foot of a wall, on which fallen rocks come to rest: directions and height, wall frame.

    Attributes
    ----------
    up, outward, aside : (3,) arrays
        Unit vectors: against gravity, horizontally away from the wall, along the wall.
    level_m : float
        Height of the ground along `up`, m.
    """

    up: FloatArray
    outward: FloatArray
    aside: FloatArray
    level_m: float

    @classmethod
    def below(cls, wall: TriangleMesh, up: FloatArray) -> Ground:
        """Return the ground at the foot of a wall, on which fallen rocks come to rest: level, at the height of its lowest point.

        wall: its mesh, wall frame. up: (3,) direction against gravity, wall frame.
        """
        outward = np.array([0.0, 0.0, 1.0]) - up[2] * up
        if np.linalg.norm(outward) < 1e-3:  # terrain seen from above: any horizontal direction
            outward = np.array([1.0, 0.0, 0.0]) - up[0] * up
        outward /= np.linalg.norm(outward)
        return cls(up, outward, np.cross(outward, up), float((wall.vertices @ up).min()))


@dataclass(frozen=True)
class Deposit:
    """The fragments of one fallen rock, which lie at the foot of the wall.

    Attributes
    ----------
    number : int
        Number of the rockfall, from 1.
    mesh : TriangleMesh
        Closed fragments at rest, wall frame.
    circles : (k, 3) array
        Circle that each fragment covers on the ground, m: centre along the wall, centre away from the wall, and radius.
    """

    number: int
    mesh: TriangleMesh
    circles: FloatArray


def lay_fragments(
    rock: tuple[int, float, FloatArray],
    wall: TriangleMesh,
    ground: Ground,
    earlier: Sequence[Deposit],
    config: DepositsConfig,
    random: KeyedRandom,
) -> Deposit:
    """Break a fallen rock into fragments and let each come to rest at the foot of the wall.

    Parameters
    ----------
    rock : (int, float, (2, 3) array)
        Number of the rockfall, volume (m3) and bounding box (smallest and largest coordinates, wall frame, m) of the rock in
        the wall.
    wall : TriangleMesh
        The wall without the rock.
    ground : Ground
        The ground at the wall's foot, and the direction of gravity.
    earlier : sequence of Deposit
        Fragments that lie there already.
    config : DepositsConfig
        Number and sizes of the fragments.
    random : KeyedRandom
        Source of random numbers.

    Returns
    -------
    Deposit
        Fragments whose volumes add up to that of the rock.
    """
    number, volume_m3, box = rock
    shapes = _fragments(volume_m3, config, random)
    height = float(box.mean(axis=0) @ ground.up) - ground.level_m
    generator = random.child("places").generator()
    start = box.mean(axis=0) + ground.aside * generator.normal(0.0, config.spread * max(height, 0.0), (len(shapes), 1))
    start = start + ground.outward * (np.ptp(box, axis=0).max() * (0.6 + 0.4 * generator.random((len(shapes), 1))))
    low, high = np.concatenate([start, box]).min(axis=0)[:2] - 2.0, np.concatenate([start, box]).max(axis=0)[:2] + 2.0
    low[1] = wall.vertices[:, 1].min()
    rows = faces_under_boxes(wall, np.stack([low, high])[None])
    caster = RayCaster(wall.submesh(rows)) if len(rows) else None
    circles = np.concatenate([np.empty((0, 3)), *(each.circles for each in earlier)])
    vertices, faces, count = [], [], 0
    for place, shape in zip(_fallen(shapes, start, caster, ground), shapes, strict=True):
        place, circle = _aside_of_others(shape, place, caster, ground, circles, generator)
        circles = np.concatenate([circles, circle[None]])
        vertices.append(shape.vertices + place)
        faces.append(shape.faces + count)
        count += len(shape.vertices)
    mesh = TriangleMesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int32))
    return Deposit(number, mesh, circles[len(circles) - len(shapes) :])


def _fragments(volume_m3: float, config: DepositsConfig, random: KeyedRandom) -> list[BlockShape]:
    """Draw fragments around the origin whose volumes add up to `volume_m3`."""
    shares = np.exp(config.volume_sigma_log * random.child("volumes").generator().standard_normal(config.fragments))
    shares /= shares.sum()
    found = []
    for index, share in enumerate(shares):
        shape = draw_shape(_SHAPES, random.child("fragment", index))
        scale = (share * volume_m3 / (signed_volumes(shape.vertices[shape.faces]).sum() / 6)) ** (1 / 3)
        found.append(BlockShape(shape.shape, shape.size_m * scale, shape.vertices * scale, shape.faces))
    return found


def _fallen(shapes: Sequence[BlockShape], start: FloatArray, caster: RayCaster | None, ground: Ground) -> FloatArray:
    """Return where the centres (k, 3) of fragments come to rest that drop from `start` (k, 3)."""
    place, moving = start.copy(), np.ones(len(shapes), dtype=bool)
    radius = np.array([_radius(shape) for shape in shapes])
    for _ in range(_MOST_STEPS):
        rows = np.flatnonzero(moving)
        if not len(rows):
            return place
        drop, steep = _contacts([shapes[row] for row in rows.tolist()], place[rows], caster, ground)
        place[rows] -= drop[:, None] * ground.up
        moving[rows] = steep
        place[rows[steep]] += radius[rows[steep], None] * ground.outward
    return place


def _contacts(
    shapes: Sequence[BlockShape], place: FloatArray, caster: RayCaster | None, ground: Ground
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return how far each fragment (k,) can drop, m, and whether it then lies on rock on which it does not stay."""
    count = [len(shape.vertices) for shape in shapes]
    points = np.concatenate([shape.vertices + centre for shape, centre in zip(shapes, place, strict=True)])
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    to_ground = np.minimum.reduceat(points @ ground.up, first) - ground.level_m
    if caster is None:
        return to_ground, np.zeros(len(shapes), dtype=bool)
    distance, face = caster.cast(points, np.broadcast_to(-ground.up, points.shape))
    distance = np.where(np.isfinite(distance), distance, np.inf)
    drop = np.minimum.reduceat(distance, first)
    at = np.array([start + int(distance[start : start + size].argmin()) for start, size in zip(first, count, strict=True)])
    normals = caster.mesh.face_normals(np.maximum(face[at], 0).astype(np.int32))
    on_rock = drop < to_ground
    return np.where(on_rock, drop, to_ground), on_rock & (normals @ ground.up < _REPOSE)


def _aside_of_others(
    shape: BlockShape,
    place: FloatArray,
    caster: RayCaster | None,
    ground: Ground,
    circles: FloatArray,
    generator: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Return the place (3,) of a fragment moved outward and aside until it touches no earlier one, and its circle (3,)."""
    radius = _radius(shape)
    for _ in range(_MOST_STEPS):
        circle = np.array([place @ ground.aside, place @ ground.outward, radius])
        apart = np.hypot(*(circles[:, :2] - circle[:2]).T) - circles[:, 2] - radius
        if not (apart < 0).any():
            return place, circle
        step = -float(apart.min())
        moved = place + step * (ground.outward * generator.random() + ground.aside * generator.uniform(-1, 1))
        place = _fallen([shape], moved[None], caster, ground)[0]
    return place, circle


def _radius(shape: BlockShape) -> float:
    """Return the largest distance of a fragment's vertices from its centre, m."""
    return float(np.linalg.norm(shape.vertices, axis=1).max())
