"""Order and number the returns of pulses that have several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray, IntArray
from sensors.signal_chain.observation import FurtherReturns, Observation

MOST_RETURNS = 15
"""Most returns of one pulse, as LAS 1.4 can number them. Farther ones are dropped."""


@dataclass(frozen=True)
class RecordedReturns:
    """The recorded returns of n pulses of a scan, wall frame; NaN and WALL (0) where there is none.

    Attributes
    ----------
    points : (n, 3) array
        Recorded points, m.
    offset : (n, 2) array
        x and y of the recorded minus the true points, m.
    depth, intensity, block : (n,) arrays
        Range (m), relative received power, and label of the fallen block whose niche was hit (0: the wall).
    truth : dict of (n,) arrays
        Error-free quantities by name, such as `true_range_m`.
    """

    points: FloatArray
    offset: NDArray[np.float32]
    depth: FloatArray
    intensity: NDArray[np.float32]
    block: IntArray
    truth: dict[str, NDArray[np.floating]]


def further_returns(
    found: Sequence[tuple[NDArray[np.int64], NDArray[np.bool_], RecordedReturns]], seen: Observation
) -> FurtherReturns:
    """Collect the returns that a scan's grid does not hold, for pulses with several returns, in order of cell and range.

    Effects may have lost returns; the return numbers and counts of the result refer to the remaining ones.

    Parameters
    ----------
    found : sequence of (cells, in_grid, returns)
        For each return number, increasing, the n pulses with several returns that have one of this number: the number (n,) of
        their cell of the grid, row by row; a mask (n,), True where the grid holds this return; and what was recorded of it.
    seen : Observation
        The scan's grid, h x w cells.

    Returns
    -------
    FurtherReturns
        The returns beside those in the grid.
    """
    shape = seen.depth.shape
    cell, in_grid, depth = (np.concatenate(part) for part in zip(*[(c, g, r.depth) for c, g, r in found], strict=True))
    order = np.argsort(cell, kind="stable")
    alive = np.where(in_grid, seen.valid.ravel()[cell], ~np.isnan(depth))[order]
    sums = np.cumsum(alive)
    start = np.searchsorted(cell[order], cell[order], side="left")
    number = sums - np.where(start > 0, sums[start - 1], 0)
    count = np.ones(seen.depth.size, dtype=np.uint8)
    count[cell] = np.bincount(cell[order], alive, minlength=seen.depth.size)[cell]
    grid_number = np.ones(seen.depth.size, dtype=np.uint8)
    grid_number[cell[order][in_grid[order]]] = number[in_grid[order]]
    kept = alive & ~in_grid[order]

    def column(*parts: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate(parts)[order][kept]

    recorded = [each for _, _, each in found]
    return FurtherReturns(
        cell=cell[order][kept],
        number=number[kept].astype(np.uint8),
        points=column(*(each.points for each in recorded)),
        depth=depth[order][kept],
        block=column(*(each.block for each in recorded)),
        intensity=column(*(each.intensity for each in recorded)),
        truth={name: column(*(each.truth[name] for each in recorded)) for name in seen.truth},
        grid_number=np.maximum(grid_number, 1).reshape(shape),
        grid_count=np.maximum(count, 1).reshape(shape),
    )
