"""What every family of explanations gains where there is nothing to explain: the null distribution of the largest gain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.gap.mean.design import DRAWS, Design
from pipeline.gap.mean.mean_model import Covariance
from scene.common.keyed_random import KeyedRandom
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray

_NEAR_NULL = 8
"""Covariances, the most likely ones, at which the draws are fitted."""


@dataclass(frozen=True)
class NullGains:
    """Gains of every family in draws of pose, the reference's correlated error and noise alone, (DRAWS,) each."""

    gains: Mapping[str, FloatArray]

    @classmethod
    def of(cls, design: Design, random: KeyedRandom) -> NullGains:
        """By the most likely covariances, each family at its best value."""
        near = design.equations.some(design.likely[:_NEAR_NULL])
        draws = design.model.null_draws(design.null, DRAWS, random.child("between"))

        def values(at: Covariance) -> tuple[FloatArray, FloatArray, FloatArray]:
            weighted = draws[at.length] * at.weight[:, None]
            constant = 0.5 * (np.log(at.weight).sum() - np.sum(draws[at.length] * weighted, axis=0))
            right = design.drawn + design.fixed.between[at.length].T @ weighted
            return right, constant, design.waves.noise + design.waves.between[at.length].T @ weighted

        right, constant, waves = (np.stack(part) for part in zip(*map_in_threads(values, near.at), strict=True))
        drawn = near.of_values(right, constant, waves)
        plain, fixed, searched = drawn.profile(design.base, design.plain_columns)
        return cls(
            {
                name: np.maximum(np.concatenate([fixed[rows], searched[numbers]]).max(axis=0) - plain, 0.0)
                for name, (rows, numbers) in design.families.members.items()
            }
        )

    def penalty(self, family: str) -> float:
        """Twice what a family gains on average where there is nothing."""
        return 2 * float(self.gains[family].mean())

    def p_value(self, score: float, larger: Mapping[str, float] | None = None) -> float:
        """Of the largest score over all families where there is nothing: (1 + b) / (1 + N).

        larger: those families alone, which gain so many times as much.
        """
        times = dict.fromkeys(self.gains, 1.0) if larger is None else larger
        scores = np.stack([each * self.gains[name] - self.penalty(name) for name, each in times.items()])
        return float((1 + np.sum(scores.max(axis=0) >= score)) / (1 + DRAWS))
