"""Divide the wall into square cells, and into the larger wall blocks of the spatial cross-validation.

Cells gather points: the mean of a cell follows a correlated error of the reference, deviations within a cell are noise.
Wall blocks are 3 x 3 cells; a whole block is used for fitting or for validation, and a bootstrap draws whole blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray

_MOST_CELLS = 800
"""Most cells, so that a dense covariance of their means stays small."""
_FEWEST_POINTS = 3
"""Fewest points in a cell that is used."""
_BLOCK_CELLS = 3
"""Side of a wall block in cells."""
_ROWS_APART = 100_000
"""Difference of the numbers of a wall block and of the one above it; no wall has as many in a row."""


@dataclass(frozen=True)
class BlockGrid:
    """Grid of large squares of the wall (wall blocks), for spatial cross-validation and for resampling.

    Errors may be correlated within a wall block, so all its points are used together, either for fitting or for validation.

    Attributes
    ----------
    origin : (2,) lower left corner of the squares, x along the wall and y up, wall frame, m.
    side_m : side of a square, m.
    """

    origin: FloatArray
    side_m: float

    def numbers(self, at: FloatArray) -> NDArray[np.int64]:
        """Return the number of the wall block in which each point lies; the numbers are not consecutive.

        at: (n, 2) positions of the points, x along the wall and y up, wall frame, m. A point has the same number (n,) whichever
        other points are given with it.
        """
        column, row = np.floor((at - self.origin) / self.side_m).astype(np.int64).T
        return np.asarray(column + _ROWS_APART * row)

    def for_validation(self, at: FloatArray) -> NDArray[np.bool_]:
        """Tell which points (n,) are kept for validation and must not be used in any fit: those in every fifth wall block.

        The blocks kept are spread over the wall like knight's moves in chess.

        at: (n, 2) positions of the points, x along the wall and y up, wall frame, m.
        """
        block = self.numbers(at)
        return np.asarray((block % _ROWS_APART + 2 * (block // _ROWS_APART)) % 5 == 0)


@dataclass(frozen=True)
class WallCells:
    """Squares of equal size into which the wall is divided, to average residuals over neighbouring points.

    Attributes
    ----------
    side_m : Side of a square (cell), m.
    cell : (n,) number of the cell in which each point lies; -1 for cells with fewer than three points, which are not used.
    centre : (m, 2) mean position of the points in each of the m used cells, x along the wall and y up, wall frame, m.
    origin : (2,) lower left corner of the squares, wall frame, m.
    """

    side_m: float
    cell: NDArray[np.int64]
    centre: FloatArray
    origin: FloatArray

    @classmethod
    def over(cls, at: FloatArray) -> WallCells:
        """Divide the wall into at most about 800 squares of equal size, to average residuals over the points in each.

        at: (n, 2) positions of the points to be covered, x along the wall and y up, wall frame, m.
        """
        side = float(np.sqrt(np.prod(np.ptp(at, axis=0)) / _MOST_CELLS)) or 1.0
        origin = at.min(axis=0)
        _, number, counts = np.unique(BlockGrid(origin, side).numbers(at), return_inverse=True, return_counts=True)
        kept = counts >= _FEWEST_POINTS
        renumbered = np.where(kept, np.cumsum(kept) - 1, -1)[number]
        inside, size = renumbered >= 0, counts[kept]
        sums = [np.bincount(renumbered[inside], at[inside, axis], len(size)) for axis in (0, 1)]
        centre = np.stack(sums, axis=1) / size[:, None]
        return cls(side, renumbered, centre, origin)

    def __len__(self) -> int:
        return len(self.centre)

    @property
    def blocks(self) -> BlockGrid:
        """The wall blocks: squares of 3 by 3 cells, each of which is used as a whole, for fits or for validation."""
        return BlockGrid(self.origin, _BLOCK_CELLS * self.side_m)


def wall_blocks_by_points(at: FloatArray, points: float) -> NDArray[np.int64]:
    """Divide the wall into squares (wall blocks) with a wanted mean number of points, for resampling whole blocks.

    at: (n, 2) positions of the points, x along the wall and y up, wall frame, m. Returns the number (n,) of the wall block in
    which each point lies, counted from 0.
    """
    side = float(np.sqrt(np.prod(np.ptp(at, axis=0)) / max(len(at) / points, 1.0))) or 1.0
    return np.asarray(np.unique(BlockGrid(at.min(axis=0), side).numbers(at), return_inverse=True)[1])


def agreement(sums: NDArray[Any]) -> float:
    """Return how far wall blocks agree that one model fits better than another, like a number of standard deviations.

    It is the sum of the blocks' log-likelihood ratios over the root of the sum of their squares: sqrt(b) if b blocks gain
    alike, and 1 if a single block gains everything. sums: (b,) log-likelihood ratio of each block, or its sign.
    """
    return float(sums.sum()) / max(float(np.linalg.norm(sums)), 1e-300)
