"""Combine two pictures of the same wall with a movable border between them: before and after, two epochs, two sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.view.results import Layer, Patch, Results, ViewWindow
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

OWN, OTHER = "own ", "other "
"""Prefixes of a choice: a step of the same folder, or of the other one."""
_APART_M = 0.02
"""Largest difference of the frames of two runs, anywhere on the wall, m."""


@dataclass(frozen=True)
class Pair:
    """What the viewer can show right of a border for comparison: other epochs of the same folder, or those of a second run.

    Attributes
    ----------
    results
        The folder that is shown.
    other
        A second run of the same wall, or None.
    """

    results: Results
    other: Results | None = None

    @property
    def choices(self) -> dict[str, str]:
        """Labels of what can be shown right of the border, by key: epochs (or other states) of the folder and of a second run."""
        own = {f"{OWN}{key}": label for key, label in self.results.steps.items()}
        if self.other is None:
            return own
        return own | {f"{OTHER}{key}": f"{self.other.title}, {label}" for key, label in self.other.steps.items()}

    def patch(self, choice: str, surface: str, layer: Layer, window: ViewWindow | None, budget: int) -> Patch:
        """Return the surface to draw right of the border.

        Parameters
        ----------
        choice : str
            Key of an epoch (or other state) of either folder, from `choices`.
        surface : str
            Key of the surface that is shown left of the border; if the other folder lacks it, its first one is drawn.
        layer : Layer
            The quantity that gives the colours on the left; if the choice lacks it, its first one is drawn.
        window : ViewWindow, optional
            Part of the wall; None: all of it.
        budget : int
            Approximate upper limit on the number of cells.
        """
        results = self.other if choice.startswith(OTHER) and self.other is not None else self.results
        step = choice.removeprefix(OTHER).removeprefix(OWN)
        layers = {each.key: each for each in results.layers(step)}
        chosen = layers.get(layer.key) or next(iter(layers.values()))
        return results.patch(
            step, surface if surface in results.surfaces else next(iter(results.surfaces)), chosen, window, budget
        )


def border(patch: Patch, share: float) -> float:
    """Return x of the border between two pictures of the wall, wall frame, m.

    patch: the part of the wall that is shown. share: of its width left of the border, 0 to 1.
    """
    return float(patch.x[0] + share * (patch.x[-1] - patch.x[0]))


def split_patch(left: Patch, right: Patch, share: float) -> Patch:
    """Combine two pictures of the same wall, such as two epochs, into one with a vertical border.

    The right one is resampled to the cells of the left one (nearest neighbour; no data where it has none).

    left, right: what is shown left and right of the border. share: of the width left of the border, 0 to 1.
    """
    beyond = left.x > border(left, share)
    columns, outside_x = _nearest(left.x, right.x)
    rows, outside_y = _nearest(left.y, right.y)
    outside = outside_y[:, None] | outside_x[None]
    place = np.ix_(rows, columns)

    def joined(own: NDArray[Any], other: NDArray[Any], nothing: float) -> NDArray[Any]:
        return np.where(beyond[None], np.where(outside, nothing, other[place]), own)

    return replace(
        left,
        height=joined(left.height, right.height, np.nan),
        value=joined(left.value, right.value, np.nan),
        label=joined(left.label, right.label, 0).astype(left.label.dtype),
    )


def _nearest(wanted: FloatArray, there: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the nearest of evenly spaced positions for each wanted one, (n,), and which wanted ones lie beyond their cells."""
    if len(there) < 2:
        return np.zeros(len(wanted), dtype=np.intp), np.abs(wanted - there[0]) > _APART_M
    step = (there[-1] - there[0]) / (len(there) - 1)
    place = np.round((wanted - there[0]) / step)
    return np.clip(place, 0, len(there) - 1).astype(np.intp), (place < 0) | (place > len(there) - 1)


def check_same_wall(first: FloatArray, second: FloatArray, extent_m: float, where: str) -> None:
    """Check that two runs have the same wall frame, so that they can be shown side by side; raise InputError if not.

    Parameters
    ----------
    first, second : (4, 4) arrays
        Transforms from world coordinates to the wall frames of the two runs.
    extent_m : float
        Size of the wall, m; nowhere on it may the frames differ by more than 2 cm.
    where : str
        Folder of the second run, for the error message.
    """
    difference = np.abs(first - second)
    if float(difference[:3, :3].max()) * extent_m > _APART_M or float(difference[:3, 3].max()) > _APART_M:
        raise InputError(
            "the run shows another wall or uses another wall frame than the first run",
            where=where,
            remedy="compare runs of one wall, as `scarpsim compare` makes them",
        )
