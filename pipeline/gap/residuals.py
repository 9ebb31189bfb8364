"""The disagreement at the level of the raw observable, common to both sensors."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene.mesh import FloatArray

BoolArray = NDArray[np.bool_]
OUTLIER = 5.0
"""Predicted sigmas, times what residuals spread of them, beyond which a point has no say."""


@dataclass(frozen=True)
class Residuals:
    """Measured minus predicted observable of n points, with what it may depend on.

    value, sigma: (n,), m of range (TLS) or px of disparity (stereo), sigma being what the model predicts; unit_m: (n,) metres of
    range or depth per unit of the observable; smooth: (n,) where the surface around the point is smooth enough for a mean to make
    sense, and of stable ground; even: the same of any ground; pose: (n, 6) derivatives by translation (m) and rotation (rad) of
    the sensor in the wall frame; at: (n, 2) wall frame x, y of the reference's point, which unlike the measured one does not move
    with the noise, m; covariates: named (n,) arrays; index: (n,) rows of the measurement's points; missing: of the pulses that
    were sent and should have met the wall, None where the pattern is not known; shared_noise: variance, and width on the wall
    (m), of predicted noise that neighbours share.
    """

    sensor: str
    value: FloatArray
    sigma: FloatArray
    unit_m: FloatArray
    smooth: BoolArray
    even: BoolArray
    pose: FloatArray
    at: FloatArray
    covariates: dict[str, FloatArray]
    index: NDArray[np.int64]
    geometry: Any = None
    notes: tuple[str, ...] = ()
    missing: Missing | None = None
    shared_noise: tuple[float, float] = (0.0, 1.0)

    def __len__(self) -> int:
        return len(self.value)

    def part(self, rows: Any) -> Residuals:
        """The residuals of `rows` (a mask or indices)."""
        return replace(
            self,
            value=self.value[rows],
            sigma=self.sigma[rows],
            unit_m=self.unit_m[rows],
            smooth=self.smooth[rows],
            even=self.even[rows],
            pose=self.pose[rows],
            at=self.at[rows],
            covariates={name: values[rows] for name, values in self.covariates.items()},
            index=self.index[rows],
            geometry=None if self.geometry is None else self.geometry.part(rows),
        )


@dataclass(frozen=True)
class Missing:
    """Pulses of the pattern that should have met the wall. lost: (m,) whether no point stands in that direction."""

    lost: BoolArray
    covariates: dict[str, FloatArray] = field(default_factory=dict)
    at: FloatArray = field(default_factory=lambda: np.empty((0, 2)))


def plane_slopes(normal: FloatArray, direction: FloatArray, moved: FloatArray, distance: FloatArray) -> FloatArray:
    """(n,) change of the distance to a plane along a ray whose unit direction changes by `moved`, m per unit.

    From t = (p - o).n / (u.n): dt = -t (du.n) / (u.n).
    """
    return -distance * np.einsum("ni,ni->n", moved, normal) / np.einsum("ni,ni->n", direction, normal)
