"""Points gathered in square cells of the wall: what is between cells may be correlated, what is within them is white."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray

_MOST_CELLS = 800
_FEWEST_POINTS = 3
BLOCK_CELLS = 3
"""Side of a block in cells: blocks are held out, and drawn in a bootstrap, as a whole."""


@dataclass(frozen=True)
class WallCells:
    """Square cells. side_m; cell: (n,) number of each point's cell, -1 in a cell of too few points; centre: (m, 2), m."""

    side_m: float
    cell: NDArray[np.int64]
    centre: FloatArray

    @classmethod
    def over(cls, at: FloatArray) -> WallCells:
        """Cells over points at (n, 2), as many as a dense covariance can serve."""
        side = float(np.sqrt(np.prod(np.ptp(at, axis=0)) / _MOST_CELLS)) or 1.0
        column, row = (np.floor((at[:, axis] - at[:, axis].min()) / side).astype(np.int64) for axis in (0, 1))
        _, number, counts = np.unique(column + 100_000 * row, return_inverse=True, return_counts=True)
        kept = counts >= _FEWEST_POINTS
        renumbered = np.where(kept, np.cumsum(kept) - 1, -1)[number]
        inside = renumbered >= 0
        total = int(kept.sum())
        size = np.maximum(np.bincount(renumbered[inside], minlength=total), 1)
        centre = np.stack([np.bincount(renumbered[inside], at[inside, axis], total) / size for axis in (0, 1)], axis=1)
        return cls(side, renumbered, centre)

    def __len__(self) -> int:
        return len(self.centre)


def wall_block_numbers(at: FloatArray, side_m: float) -> NDArray[np.int64]:
    """(n,) number of the block, BLOCK_CELLS cells of `side_m` wide, in which each point lies."""
    column, row = (np.floor((at[:, axis] - at[:, axis].min()) / (BLOCK_CELLS * side_m)).astype(np.int64) for axis in (0, 1))
    return column + 100_000 * row


def wall_blocks_by_points(at: FloatArray, points: float) -> NDArray[np.int64]:
    """(n,) number of the square patch, of about so many points, in which each point lies."""
    side = float(np.sqrt(np.prod(np.ptp(at, axis=0)) / max(len(at) / points, 1.0))) or 1.0
    column, row = (np.floor((at[:, axis] - at[:, axis].min()) / side).astype(np.int64) for axis in (0, 1))
    return np.asarray(np.unique(column + 100_000 * row, return_inverse=True)[1])


def in_validation_blocks(at: FloatArray, side_m: float) -> NDArray[np.bool_]:
    """(n,) points of every fifth block, in a knight's-move pattern, which no step before the last one may look at."""
    block = wall_block_numbers(at, side_m)
    return np.asarray((block % 100_000 + 2 * (block // 100_000)) % 5 == 0)
