"""The reference surface around the places that the pixels of a stereo pair see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray


@dataclass(frozen=True)
class Surroundings:
    """What a stereo pair sees of the reference surface around n pixels of the left camera.

    Errors at depth edges, such as smoothing, depend on it.

    Attributes
    ----------
    point : (n, 3) place that each pixel sees, wall frame, m; NaN if unknown.
    edge_px : (n,) step of the surface near each pixel, px of disparity; 0 on a plane, at most 10. It is the largest difference
        between the disparity of the reference and that of its tangent plane, at the pixels 3 px to the left, right, above and
        below.
    hidden : (n,) true where the right camera does not see the place.
    gradient : (n, 2) change of the reference's disparity along the row and along the column, px per px, as a stereo matcher sees
        it: between the two neighbouring cells of its raster.
    """

    point: FloatArray
    edge_px: FloatArray
    hidden: NDArray[np.bool_]
    gradient: FloatArray

    @classmethod
    def nowhere(cls, count: int) -> Surroundings:
        """Return the surroundings of `count` pixels of which it is not known what they see: their places are NaN."""
        return cls(np.full((count, 3), np.nan), np.zeros(count), np.zeros(count, dtype=bool), np.zeros((count, 2)))

    def part(self, rows: Any) -> Surroundings:
        """Return the surroundings of some of the pixels. rows: a mask or indices."""
        return Surroundings(self.point[rows], self.edge_px[rows], self.hidden[rows], self.gradient[rows])

    def changed(self, rows: NDArray[np.int64], other: Surroundings) -> Surroundings:
        """Return a copy in which some of the pixels have other surroundings.

        rows: indices of these pixels. other: their new surroundings.
        """
        found = Surroundings(self.point.copy(), self.edge_px.copy(), self.hidden.copy(), self.gradient.copy())
        found.point[rows], found.edge_px[rows], found.hidden[rows] = other.point, other.edge_px, other.hidden
        found.gradient[rows] = other.gradient
        return found
