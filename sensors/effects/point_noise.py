"""Noise of a cloud's points in metres, for a cloud whose cameras are unknown."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage, parameter
from sensors.signal_chain.node_grid import MEAN_VARIANCE
from sensors.signal_chain.surface_places import RecordedPoints


class PointNoise(Effect):
    """Points of a cloud without cameras lie above or below the surface, along its normal, by white and grid-correlated noise.

    It stands for the matching noise of a stereo pair whose cameras, and so disparities, are unknown. The white part is
    independent for each point. Its standard deviation is sqrt(sigma_m^2 + (steep_sigma_m b)^2), with the slope b against the
    wall's plane in radians. The correlated part is interpolated bilinearly between the nodes of a grid on the wall's plane,
    which are `shared_step_m` apart and have independent normal values of standard deviation `shared_sigma_m`. Empirical:
    `scarpsim gap` and `scarpsim measurement` estimate it; no publication gives its values.
    """

    name: Literal["point_noise"] = "point_noise"
    sensor = "stereo"
    stage = Stage.POINT
    shows_in = ShowsIn.SPREAD
    catalogue = False
    empirical = True
    sigma_m: float = parameter("standard deviation of each point", unit="m", source="empirical", typical=0.003, ge=0, le=10)
    steep_sigma_m: float = parameter(
        "further standard deviation, in proportion to the slope, at 1 rad",
        unit="m",
        source="empirical",
        typical=0.003,
        ge=0,
        le=10,
    )
    shared_sigma_m: float = parameter("standard deviation at the nodes", unit="m", source="empirical", ge=0, le=10)
    shared_step_m: float = parameter(
        "distance between nodes", unit="m", source="empirical", null=None, default=0.1, gt=0, le=1000
    )

    @property
    def shared_variance(self) -> float:
        """Variance of the part of the noise that neighbouring points share (grid-correlated), averaged over the surface, m2."""
        return MEAN_VARIANCE * self.shared_sigma_m**2

    def variance(self, at: Any) -> FloatArray:
        """Return the variance (n,) of a point's height over the surface, m2: white and grid-correlated parts.

        at: n places on the surface.
        """
        return self._own_variance(at) + self.shared_variance

    def _own_variance(self, at: Any) -> FloatArray:
        """Return the variance (n,) of the white part, m2."""
        own = np.full(len(at), self.sigma_m**2)
        return own + (self.steep_sigma_m * np.nan_to_num(at.covariates["slope"])) ** 2 if self.steep_sigma_m else own

    def evaluate(self, state: RecordedPoints, random: KeyedRandom) -> RecordedPoints:
        """Return the points moved along the surface's normal by white and by grid-correlated noise, m.

        state: the recorded points before this effect. random: source of random numbers.
        """
        white = np.sqrt(self._own_variance(state.places)) * random.child("point").generator().standard_normal(len(state.above))
        return state.with_height_error(
            white + self.shared_sigma_m * self._field(state.places.point[:, :2], random.child("nodes"))
        )

    def _field(self, at: FloatArray, random: KeyedRandom) -> FloatArray:
        """Return the correlated field (n,), with variance 1 at the nodes, at positions (n, 2), m; 0 where a position is NaN."""
        known = np.isfinite(at).all(axis=1)
        field = np.zeros(len(at))
        if not self.shared_sigma_m or not known.any():
            return field
        place = at[known] / self.shared_step_m
        low = np.floor(place.min(axis=0))
        corner = np.floor(place).astype(np.int64) - low.astype(np.int64)
        share = place - low - corner
        nodes = random.generator().standard_normal(tuple(corner.max(axis=0) + 2))
        for right, up in ((0, 0), (1, 0), (0, 1), (1, 1)):
            weight = np.abs(1 - right - share[:, 0]) * np.abs(1 - up - share[:, 1])
            field[known] += weight * nodes[corner[:, 0] + right, corner[:, 1] + up]
        return field
