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
    """Squares of equal size into which the wall is divided, to average residuals over neighbouring points.

    Attributes
    ----------
    side_m : Side of a square (cell), m.
    cell : (n,) number of the cell in which each point lies; -1 for cells with fewer than three points, which are not used.
    centre : (m, 2) mean position of the points in each of the m used cells, x along the wall and y up, wall frame, m.
    """

    side_m: float
    cell: NDArray[np.int64]
    centre: FloatArray

    @classmethod
    def over(cls, at: FloatArray) -> WallCells:
        """Divide the wall into at most about 800 squares of equal size, to average residuals over the points in each.

        at: (n, 2) positions of the points to be covered, x along the wall and y up, wall frame, m.
        """
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
    """Return the number of the wall block in which each point lies, for spatial cross-validation.

    A wall block is a large square of the wall: 3 by 3 of the cells over which residuals are averaged. Errors may be correlated
    within it, so all its points are used together, either for fitting or for validation.

    Parameters
    ----------
    at : (n, 2) positions of the points, x along the wall and y up, wall frame, m.
    side_m : Side of a cell, m: a third of the side of a wall block.

    Returns
    -------
    (n,) numbers; they are not consecutive.
    """
    column, row = (np.floor((at[:, axis] - at[:, axis].min()) / (BLOCK_CELLS * side_m)).astype(np.int64) for axis in (0, 1))
    return column + 100_000 * row


def wall_blocks_by_points(at: FloatArray, points: float) -> NDArray[np.int64]:
    """Divide the wall into squares (wall blocks) with a wanted mean number of points, for resampling whole blocks.

    Parameters
    ----------
    at : (n, 2) positions of the points, x along the wall and y up, wall frame, m.
    points : Mean number of points in a wall block.

    Returns
    -------
    (n,) number of the wall block in which each point lies, counted from 0.
    """
    side = float(np.sqrt(np.prod(np.ptp(at, axis=0)) / max(len(at) / points, 1.0))) or 1.0
    column, row = (np.floor((at[:, axis] - at[:, axis].min()) / side).astype(np.int64) for axis in (0, 1))
    return np.asarray(np.unique(column + 100_000 * row, return_inverse=True)[1])


def in_validation_blocks(at: FloatArray, side_m: float) -> NDArray[np.bool_]:
    """Tell which points are kept for validation and must not be used in any fit: those in every fifth wall block.

    A wall block is a large square of the wall. The blocks kept are spread over the wall like knight's moves in chess.

    Parameters
    ----------
    at : (n, 2) positions of the points, x along the wall and y up, wall frame, m.
    side_m : A third of the side of a wall block, m.

    Returns
    -------
    (n,) true for validation points.
    """
    block = wall_block_numbers(at, side_m)
    return np.asarray((block % 100_000 + 2 * (block // 100_000)) % 5 == 0)
