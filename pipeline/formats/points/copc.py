"""Write COPC: LAZ whose chunks are the nodes of an octree, so that a viewer fetches only what it shows (copc.io, version 1.0)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import laspy
import lazrs  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

from pipeline.formats.files.atomic import writing
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import LazHeader, PulseChannels, StoredCloud
from scene.common.errors import InputError

SUFFIX = ".copc.laz"
_PLAIN, _USUAL = PulseChannels(), LazHeader()
_CELLS_LOG2 = 7
"""A node's cube has 128^3 cells; the node takes one point of each."""
_WHOLE = 4**_CELLS_LOG2
"""Number of points up to which a node takes all of its points: as many as a flat wall has cells, which avoids tiny chunks."""
_FINEST = 20
"""Level of the finest cells, whose three indices fit into 60 bits."""
_DEEPEST = _FINEST - _CELLS_LOG2
_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that spread the bits of a number to every third place (Morton 1966)."""
_BATCH = 1_000_000
"""Number of points compressed at a time."""
_USER, _INFO, _HIERARCHY = "copc", 1, 1000
_INFO_BYTES, _PAD = 160, 88
_NODE = np.dtype([("key", "<i4", 4), ("offset", "<u8"), ("bytes", "<i4"), ("points", "<i4")])
"""Entry of the hierarchy."""


@dataclass(frozen=True)
class Octree:
    """Points sorted into the cubes (nodes) of an octree, as COPC files store them.

    A point is stored in one node only. Coordinates are integers, in the steps in which LAZ stores them.

    Attributes
    ----------
    low, side : (3,) lowest corner of the root cube, and its side, steps.
    keys : (m, 4) level of each of the m nodes, 0 for the root, and its position x, y, z among the cubes of this level.
    counts : (m,) number of points in each node.
    order : (n,) indices of the points, node by node; within a node in their original order.
    """

    low: NDArray[np.int64]
    side: int
    keys: NDArray[np.int32]
    counts: NDArray[np.int64]
    order: NDArray[np.int64]


def write_copc(path: Path, cloud: PointCloud, pulses: PulseChannels = _PLAIN, header: LazHeader = _USUAL) -> None:
    """Write a point cloud as COPC, a LAZ file that viewers can load part by part; equal arguments give equal bytes.

    The file is an octree, each level of which adds points. Level k adds one point for each cube whose side is that of the whole
    cloud divided by 128 * 2^k. A node with at most 16,384 remaining points takes all of them.

    Parameters
    ----------
    path : File to write.
    cloud : The points, as for `write_laz`.
    pulses : Returns and scan angles of the points.
    header : Header values.

    Raises
    ------
    InputError
        For an empty cloud, or if the file cannot be written.
    """
    if not len(cloud.points):
        raise InputError(
            "there are no points to write, and a COPC file cannot be empty",
            where=str(path),
            remedy="write a LAZ file, which can be empty, or export a cloud that has points",
        )
    stored = StoredCloud.of(cloud, pulses, header)
    tree = octree(stored.steps())
    with writing(path) as temporary, temporary.open("w+b") as file:
        _write(file, stored, tree)


def octree(steps: NDArray[np.integer]) -> Octree:
    """Sort points into an octree, as COPC files store them.

    steps: (n, 3) integer coordinates, in the steps in which LAZ stores them.
    """
    low = steps.min(axis=0).astype(np.int64)
    from_low = steps - low
    side = max(int(from_low.max()), 1)
    finest = np.minimum((from_low << _FINEST) // side, 2**_FINEST - 1)
    curve = _morton(finest)
    left = np.argsort(curve, kind="stable")
    keys, sizes, order = [], [], []
    for level in range(_DEEPEST + 1):
        taken = _taken(curve[left], level)
        rows = left[taken]
        starts = _starts(_at_level(curve[rows], level))
        sizes.append(np.diff(starts, append=len(rows)))
        keys.append(np.column_stack([np.full(len(starts), level), finest[rows[starts]] >> (_FINEST - level)]))
        order += [np.sort(part) for part in np.split(rows, starts[1:])]
        left = left[~taken]
        if not len(left):
            break
    return Octree(low, side, np.concatenate(keys).astype(np.int32), np.concatenate(sizes), np.concatenate(order))


def _taken(curve: NDArray[np.int64], level: int) -> NDArray[np.bool_]:
    """Return the mask (n,) of points that a level takes, of those left in the curve's order.

    These are the first of each cell, or all of a node.
    """
    if level == _DEEPEST:
        return np.ones(len(curve), dtype=bool)
    starts = _starts(_at_level(curve, level))
    size = np.diff(starts, append=len(curve))
    taken = np.repeat(size <= _WHOLE, size)
    taken[_starts(_at_level(curve, level + _CELLS_LOG2))] = True
    return taken


def _starts(values: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return where runs of equal values begin."""
    return np.flatnonzero(np.diff(values, prepend=-1))


def _at_level(curve: NDArray[np.int64], level: int) -> NDArray[np.int64]:
    """Return the number of each point's cube at a level."""
    return curve >> 3 * (_FINEST - level)


def _morton(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the (n,) places of cells (n, 3) on the Z-order curve, which interleaves the bits of x, y and z."""
    curve = np.zeros(len(cells), dtype=np.int64)
    for axis in range(3):
        spread = cells[:, axis]
        for shift, mask in _SPREAD:
            spread = (spread | spread << shift) & mask
        curve |= spread << (2 - axis)
    return curve


def _write(file: BinaryIO, stored: StoredCloud, tree: Octree) -> None:
    """Write header, chunks and hierarchy."""
    las = stored.header
    packer = lazrs.LazVlr.new_for_compression(las.point_format.id, las.point_format.num_extra_bytes, True)
    las.vlrs.insert(0, laspy.VLR(_USER, _INFO, "COPC info VLR", bytes(_INFO_BYTES)))
    las.vlrs.insert(1, laspy.vlrs.known.LasZipVlr(packer.record_data()))
    las.are_points_compressed = True
    las.partial_reset()
    las.write_to(file)
    compressor = lazrs.ParLasZipCompressor(file, packer)
    for records, sizes in _batches(stored, tree):
        las.grow(records)
        compressor.compress_chunks(_chunks(records.array, sizes))
    compressor.done()
    las.start_of_first_evlr, las.number_of_evlrs = file.seek(0, 2), 1
    nodes = _nodes(file, las, packer, tree)
    file.seek(las.start_of_first_evlr)
    file.write(struct.pack("<H16sHQ32s", 0, _USER.encode(), _HIERARCHY, nodes.nbytes, b"COPC hierarchy"))
    las.vlrs[0].record_data = _info(las, tree, file.tell(), nodes.nbytes, stored.cloud.gps_time)
    file.write(nodes.tobytes())
    file.seek(0)
    las.write_to(file, ensure_same_size=True)


def _batches(stored: StoredCloud, tree: Octree) -> Iterator[tuple[laspy.ScaleAwarePointRecord, NDArray[np.int64]]]:
    """Yield the points of complete nodes, about a million at a time, with the number of points of each node."""
    ends = np.cumsum(tree.counts)
    start = 0
    while start < len(ends):
        before = ends[start] - tree.counts[start]
        stop = max(int(np.searchsorted(ends, before + _BATCH, side="right")), start + 1)
        yield stored.records(tree.order[before : ends[stop - 1]]), tree.counts[start:stop]
        start = stop


def _chunks(array: NDArray[Any], sizes: NDArray[np.int64]) -> list[NDArray[np.uint8]]:
    """Split rows into the bytes of consecutive chunks."""
    return [np.frombuffer(part, np.uint8) for part in np.split(array, np.cumsum(sizes)[:-1])]


def _nodes(file: BinaryIO, las: laspy.LasHeader, packer: Any, tree: Octree) -> NDArray[np.void]:
    """Return the hierarchy's entries, with the places of the nodes' chunks from the file's chunk table."""
    file.seek(las.offset_to_point_data)
    table = np.array(lazrs.read_chunk_table(file, packer))[: len(tree.counts)]
    nodes = np.empty(len(tree.counts), dtype=_NODE)
    nodes["key"], nodes["points"], nodes["bytes"] = tree.keys, tree.counts, table[:, 1]
    nodes["offset"] = las.offset_to_point_data + 8 + np.cumsum(table[:, 1]) - table[:, 1]
    return nodes


def _info(las: laspy.LasHeader, tree: Octree, place: int, size: int, time: NDArray[np.floating] | None) -> bytes:
    """Return the info record: root cube, spacing of its points, place of the hierarchy, first and last time."""
    scale = float(las.scales[0])
    half = 0.5 * tree.side * scale
    centre = tree.low * scale + las.offsets + half
    first, last = (0.0, 0.0) if time is None else (float(np.min(time)), float(np.max(time)))
    spacing = 2 * half / 2**_CELLS_LOG2
    return struct.pack("<5d2Q2d", *centre, half, spacing, place, size, first, last) + bytes(_PAD)
