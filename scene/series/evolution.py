"""Follow a wall through time: niches appear where rocks begin to move or fall, blocks move out, fragments lie below.

The wall at one time is a `WallState`. `advanced` makes the next one of it, so that the wall at any epoch follows from the
rockfalls alone and can be made again in another process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene.blocks.block import Blocks, RockfallConfig
from scene.blocks.carve import carve, removed_rocks
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import DEFAULT_ALBEDO, WALL, TriangleMesh
from scene.series.config import DepositsConfig
from scene.series.deposits import Deposit, Ground, lay_fragments
from scene.series.events import Rockfall
from scene.series.placement import BlockRequest, join_blocks, place_block
from scene.walls.safe_zone import SafeZone

KINDS = ("missing", "moved", "deposit")
"""What a rockfall shows as. With n rockfalls, rockfall e has the block labels e, n + e and 2 n + e."""


@dataclass(frozen=True)
class Rules:
    """What stays the same in a time series of one wall: all rockfalls, and how their blocks are shaped and placed.

    Attributes
    ----------
    zone : SafeZone
        Part of the wall, away from its border and holes, where blocks may lie.
    shapes : RockfallConfig
        Shapes and placement of the blocks.
    deposits : DepositsConfig, optional
        Number and sizes of the fragments of fallen rocks; None: fallen rocks disappear.
    ground : Ground
        The ground at the foot of the wall, on which fragments come to rest.
    rockfalls : tuple of Rockfall
        All rockfalls.
    random : KeyedRandom
        Source of random numbers.
    """

    zone: SafeZone
    shapes: RockfallConfig
    deposits: DepositsConfig | None
    ground: Ground
    rockfalls: tuple[Rockfall, ...]
    random: KeyedRandom

    def label(self, number: int, kind: str) -> int:
        """Return the label by which the faces of the wall's mesh show what a rockfall left there.

        number: number of the rockfall, from 1. kind: "missing" (its niche), "moved" (its block, moved but not fallen) or
        "deposit" (its fragments at the foot of the wall).
        """
        return KINDS.index(kind) * len(self.rockfalls) + number

    def rockfall_of(self, label: int) -> tuple[Rockfall, str]:
        """Return the rockfall to which a face's label (above 0) belongs, and whether the face is its niche, block or fragments.

        The latter is "missing", "moved" or "deposit".
        """
        kind, index = divmod(label - 1, len(self.rockfalls))
        return self.rockfalls[index], KINDS[kind]


@dataclass(frozen=True)
class Loose:
    """A rock of a simulated time series that has been cut out of the wall, as it has begun to move or has fallen.

    Attributes
    ----------
    rockfall : Rockfall
        Time, volume and motion of the rockfall.
    block : Blocks
        The closed block with which it was cut out.
    volume_m3 : float
        Volume of the rock, m3.
    rock : TriangleMesh, optional
        The rock as a closed mesh in its original place, for one that moves before it falls; None for one that does not.
    """

    rockfall: Rockfall
    block: Blocks
    volume_m3: float
    rock: TriangleMesh | None


@dataclass(frozen=True)
class WallState:
    """The true wall at one time of a simulated time series of rockfalls.

    Attributes
    ----------
    time_h : float
        Hours since the first epoch.
    base : TriangleMesh
        The wall with the niches of all rocks cut out so far, wall frame.
    loose : tuple of Loose
        All rocks cut out so far, fallen or not, in the order of the rockfalls' numbers.
    deposits : tuple of Deposit
        Fragments of fallen rocks at the foot of the wall.
    balance_m3 : float
        Volume of the first wall minus that of `base` minus the rocks' volumes, m3: 0 except for rounding.
    wall_volume_m3 : float
        Volume of the wall at the first epoch, m3.
    """

    time_h: float
    base: TriangleMesh
    loose: tuple[Loose, ...] = ()
    deposits: tuple[Deposit, ...] = ()
    balance_m3: float = 0.0
    wall_volume_m3: float = 0.0

    @property
    def fallen(self) -> tuple[Loose, ...]:
        """The rocks that have fallen off the wall by the time of this state."""
        return tuple(each for each in self.loose if each.rockfall.falls_h <= self.time_h)

    @property
    def hanging(self) -> tuple[Loose, ...]:
        """The rocks that have begun to move out of the wall by the time of this state but have not fallen."""
        return tuple(each for each in self.loose if each.rockfall.falls_h > self.time_h)

    def mesh(self, rules: Rules) -> TriangleMesh:
        """Return the wall with its moving blocks and fallen fragments as one mesh, as a sensor meets it.

        The label of a face (`face_block`) tells what it is: 0 for rock in its place, else what `rules.label` gives. rules: the
        rockfalls of the time series.
        """
        parts = [self.base]
        for each in self.hanging:
            moved = each.rockfall.displacement_m(self.time_h) or 0.0
            if each.rock is not None and moved > 0:
                shifted = each.rock.with_vertices(each.rock.vertices + np.array([0.0, 0.0, moved]))
                parts.append(_labelled(shifted, rules.label(each.rockfall.number, "moved")))
        parts += [_labelled(each.mesh, rules.label(each.number, "deposit")) for each in self.deposits]
        return parts[0] if len(parts) == 1 else joined_meshes(parts)


def advanced(state: WallState, time_h: float, rules: Rules) -> WallState:
    """Follow the wall from one time of a simulated time series to a later one: rocks begin to move, others fall.

    If no rock has been cut out of `state` yet, it is the untouched wall, and rocks that fell before its time are still in it.

    Parameters
    ----------
    state : WallState
        The wall at the earlier time.
    time_h : float
        The later time, h since the first epoch.
    rules : Rules
        All rockfalls of the series, and how their blocks are shaped and placed.

    Returns
    -------
    WallState
        The wall at the later time.

    Raises
    ------
    InputError
        If the block of a rockfall finds no room on the wall.
    """
    known = {each.rockfall.number for each in state.loose}
    begun = [
        each for each in rules.rockfalls if each.number not in known and each.starts_h <= time_h and each.falls_h > state.time_h
    ]
    now = replace(state, time_h=time_h)
    batch: list[tuple[Rockfall, Blocks]] = []
    for rockfall in begun:
        taken = [block.bbox[0] for _, block in batch]
        hanging = [each.block.bbox[0] for each in now.loose if each.rockfall.falls_h > rockfall.starts_h]
        request = BlockRequest(
            rockfall.volume_m3, rockfall.position_m, rules.random.child(rockfall.key), f"series, rockfall {rockfall.number}"
        )
        if rockfall.position_m is not None and batch:
            now, batch, taken = _cut(now, batch), [], []
        block = place_block(request, now.base, rules.zone, [*taken, *hanging], rules.shapes)
        batch.append((rockfall, block))
    now = _cut(now, batch)
    if rules.deposits is None:
        return now
    for each in now.loose:
        if state.time_h < each.rockfall.falls_h <= time_h:
            rock = each.rockfall.number, each.volume_m3, each.block.bbox[0]
            random = rules.random.child(each.rockfall.key, "deposit")
            laid = lay_fragments(rock, now.base, rules.ground, now.deposits, rules.deposits, random)
            now = replace(now, deposits=(*now.deposits, laid))
    return now


def joined_meshes(parts: Sequence[TriangleMesh]) -> TriangleMesh:
    """Join meshes, such as the wall and fallen fragments, into one, which keeps their block labels and albedo."""
    at = np.concatenate([[0], np.cumsum([len(each.vertices) for each in parts])[:-1]]).astype(np.int32)

    def column(name: str, size: str, default: float, kind: type) -> NDArray[Any]:
        held = [getattr(each, name) for each in parts]
        return np.concatenate([
            np.full(len(getattr(part, size)), default, dtype=kind) if values is None else values
            for part, values in zip(parts, held, strict=True)
        ])  # fmt: skip

    albedo = None
    if any(each.vertex_albedo is not None for each in parts):
        albedo = column("vertex_albedo", "vertices", DEFAULT_ALBEDO, np.float32)
    return TriangleMesh(
        np.concatenate([each.vertices for each in parts]),
        np.concatenate([each.faces + offset for each, offset in zip(parts, at, strict=True)]),
        albedo,
        column("vertex_block", "vertices", WALL, np.int32),
        column("face_block", "faces", WALL, np.int32),
    )


def _cut(state: WallState, batch: Sequence[tuple[Rockfall, Blocks]]) -> WallState:
    """Return the wall without the rock of some disjoint blocks. Labels of one carving follow one another."""
    runs: list[list[tuple[Rockfall, Blocks]]] = []
    for each in batch:
        if not runs or runs[-1][-1][0].number + 1 != each[0].number:
            runs.append([])
        runs[-1].append(each)
    for run in runs:
        state = _carved(state, run)
    return state


def _carved(state: WallState, batch: Sequence[tuple[Rockfall, Blocks]]) -> WallState:
    """Return the wall without the rock of some disjoint blocks, whose rockfalls follow one another in number."""
    blocks = join_blocks([block for _, block in batch])
    carved = carve(state.base, blocks, first_label=batch[0][0].number)
    loose = [
        Loose(
            rockfall,
            block,
            float(volume),
            removed_rocks(state.base, block) if rockfall.motion is not None else None,
        )
        for (rockfall, block), volume in zip(batch, carved.removed_volume_m3, strict=True)
    ]
    return replace(
        state,
        base=carved.mesh,
        loose=(*state.loose, *loose),
        balance_m3=state.balance_m3 + carved.balance_m3,
        wall_volume_m3=state.wall_volume_m3 or carved.wall_volume_m3,
    )


def _labelled(mesh: TriangleMesh, label: int) -> TriangleMesh:
    """Return a mesh whose vertices and faces all have a block label."""
    vertex, face = (np.full(len(array), label, dtype=np.int32) for array in (mesh.vertices, mesh.faces))
    return replace(mesh, vertex_block=vertex, face_block=face)
