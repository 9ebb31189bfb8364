"""Divide the wall into square cells, and into the larger wall blocks of the spatial cross-validation.

Cells gather points: the mean of a cell follows a correlated error of the reference, deviations within a cell are noise.
Wall blocks are 3 x 3 cells; a whole block is used for fitting or for validation, and a bootstrap draws whole blocks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray

_MOST_CELLS = 800
"""Most cells, so that a dense covariance of their means stays small."""
_FEWEST_POINTS = 3
"""Fewest points in a cell that is used."""
BLOCK_CELLS = 3
"""Side of a wall block in cells."""


@dataclass(frozen=True)
class WallCells:
    """Square cells into which the wall is divided, with the points in each.

    Attributes
    ----------
    side_m : Side of a cell, m.
    cell : (n,) number of each point's cell; -1 in a cell with fewer than three points.
    centre : (m, 2) mean position of each cell's points, wall frame, m.
    """

    side_m: float
    cell: NDArray[np.int64]
    centre: FloatArray

    @classmethod
    def over(cls, at: FloatArray) -> WallCells:
        """Divide the extent of points (n, 2), wall frame, m, into at most about 800 cells."""
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
    """Return the number of the wall block that holds each point.

    A wall block is a square of BLOCK_CELLS by BLOCK_CELLS cells, within which residuals may be correlated.

    Parameters
    ----------
    at : (n, 2) points, wall frame, m.
    side_m : Side of a cell, m.

    Returns
    -------
    (n,) numbers.
    """
    column, row = (np.floor((at[:, axis] - at[:, axis].min()) / (BLOCK_CELLS * side_m)).astype(np.int64) for axis in (0, 1))
    return column + 100_000 * row


def wall_blocks_by_points(at: FloatArray, points: float) -> NDArray[np.int64]:
    """Divide the wall into square wall blocks of about the same number of points.

    Parameters
    ----------
    at : (n, 2) points, wall frame, m.
    points : Mean number of points in a block.

    Returns
    -------
    (n,) number of each point's block, counted from 0.
    """
    side = float(np.sqrt(np.prod(np.ptp(at, axis=0)) / max(len(at) / points, 1.0))) or 1.0
    column, row = (np.floor((at[:, axis] - at[:, axis].min()) / side).astype(np.int64) for axis in (0, 1))
    return np.asarray(np.unique(column + 100_000 * row, return_inverse=True)[1])


def in_validation_blocks(at: FloatArray, side_m: float) -> NDArray[np.bool_]:
    """Tell which points are kept for validation: those in every fifth wall block, in a knight's-move pattern. No fit uses them.

    Parameters
    ----------
    at : (n, 2) points, wall frame, m.
    side_m : Side of a cell, m.

    Returns
    -------
    (n,) true for validation points.
    """
    block = wall_block_numbers(at, side_m)
    return np.asarray((block % 100_000 + 2 * (block // 100_000)) % 5 == 0)
