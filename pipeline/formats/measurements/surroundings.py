"""The reference surface around the places that the pixels of a stereo pair see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray


@dataclass(frozen=True)
class Surroundings:
    """What the cameras see of the reference around n pixels.

    Attributes
    ----------
    point : (n, 3) place that each pixel sees, wall frame, m; NaN if unknown.
    edge_px : (n,) how much the reference departs from a plane around each pixel. It is compared with its tangent plane at the
        four pixels a few px to the left, right, above and below; the largest difference of the two disparities counts, px.
    hidden : (n,) true where the right camera does not see the place.
    """

    point: FloatArray
    edge_px: FloatArray
    hidden: NDArray[np.bool_]

    @classmethod
    def nowhere(cls, count: int) -> Surroundings:
        """Return the surroundings of pixels that are not known to see anything."""
        return cls(np.full((count, 3), np.nan), np.zeros(count), np.zeros(count, dtype=bool))

    def part(self, rows: Any) -> Surroundings:
        """Return those of some of the pixels, by a mask or indices."""
        return Surroundings(self.point[rows], self.edge_px[rows], self.hidden[rows])

    def changed(self, rows: NDArray[np.int64], other: Surroundings) -> Surroundings:
        """Return a copy with other surroundings at some of the pixels."""
        found = Surroundings(self.point.copy(), self.edge_px.copy(), self.hidden.copy())
        found.point[rows], found.edge_px[rows], found.hidden[rows] = other.point, other.edge_px, other.hidden
        return found
