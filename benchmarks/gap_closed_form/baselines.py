"""Baselines for the diagnosis: the largest |z|, and plain BIC, both of which take residuals as independent.

It also computes the control: the share of the gap that wrong effects close on validation blocks, which their fit has not seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.gap_closed_form.casting import Array
from benchmarks.gap_closed_form.strength import Families, basis

Z_LIMIT, BIC_LIMIT = 3.0, 10.0
_CLIP, _ROUNDS, _MOST_POINTS, _BLOCKS = 5.0, 2, 20_000, 12


@dataclass(frozen=True)
class Data:
    """Inputs of the baselines.

    Attributes
    ----------
    value : (n,) residuals against reference and survey.
    sigma : (n,) their predicted standard deviation.
    pose : (n, 6) effect of the pose on them.
    at : (n, 2) place on the wall, m.
    """

    value: Array
    sigma: Array
    pose: Array
    at: Array


def rivals(data: Data, families: Families, forms: Mapping[str, Sequence[Array]], truth: list[Array]) -> dict[str, Any]:
    """Return the baselines' answers, and the control of each effect on the mean.

    The control is the share of the gap that an effect closes, where `truth` closes all: on the blocks of its fit, by which the
    best effect is chosen, and on validation blocks, by which it is scored.
    """
    sound = _sound(data)
    rows = sound[:: max(len(sound) // _MOST_POINTS, 1)]
    weight = 1 / data.sigma[rows, None]
    pose, value = data.pose[rows] * weight, data.value[rows] * weight[:, 0]
    designs = {name: [variant[rows] * weight for variant in variants] for name, variants in families.items()}
    side = np.sqrt(np.prod(np.ptp(data.at, axis=0)) / _BLOCKS**2)
    corner = np.floor((data.at[rows] - data.at.min(axis=0)) / side).astype(int)
    held_out = (corner[:, 0] + 2 * corner[:, 1]) % 5 == 0
    shares = {}
    if len(truth) == 1:
        full = _gains(pose, truth[0][rows, None] * weight, value, held_out)
        for name, variants in designs.items():
            best = max((_gains(pose, design, value, held_out) for design in variants), key=lambda gains: gains[0])
            shares[name] = {"fitted": best[0] / full[0], "held_out": best[1] / full[1]}
    relative = {name: [form[rows] / data.sigma[rows] ** 2 for form in several] for name, several in forms.items()}
    return {"baselines": _answers(pose, designs, value, relative), "closed_by": shares}


def _sound(data: Data) -> Array:
    """Return the rows within some sigmas of a robust registration."""
    kept = np.arange(len(data.value))
    for _ in range(_ROUNDS):
        pose = np.linalg.lstsq(data.pose[kept] / data.sigma[kept, None], data.value[kept] / data.sigma[kept], rcond=None)[0]
        z = np.abs(data.value - data.pose @ pose) / data.sigma
        kept = np.flatnonzero(z < _CLIP * max(1.0, 1.4826 * float(np.median(z))))
    return kept


def _gains(pose: Array, design: Array, value: Array, held_out: Array) -> tuple[float, float]:
    """Return by how much the weighted squares decrease when `design` is fitted beside the pose.

    The first number is that of the blocks of the fit, the second that of the validation blocks.
    """
    left = []
    for columns in (pose, np.concatenate([pose, design], axis=1)):
        size = np.linalg.norm(columns, axis=0)
        fit = np.linalg.lstsq(columns[~held_out] / size, value[~held_out], rcond=1e-10)[0]
        squared = (value - columns / size @ fit) ** 2
        left.append((float(squared[~held_out].sum()), float(squared[held_out].sum())))
    return left[0][0] - left[1][0], left[0][1] - left[1][1]


def _spread(value: Array, relative: Mapping[str, list[Array]]) -> dict[str, float]:
    """Return the score statistic of each variance effect, in standard deviations."""
    return {
        name: max(float((value**2 - 1) @ form / np.sqrt(2 * np.sum(form**2))) for form in several)
        for name, several in relative.items()
    }


def _answers(
    pose: Array, designs: Mapping[str, list[Array]], value: Array, relative: Mapping[str, list[Array]]
) -> dict[str, str]:
    """Return the names that the two baselines give; "" for none.

    Variance effects are tried on the residuals of the best mean effect.
    """
    fixed = basis(pose)
    value = value - fixed @ (fixed.T @ value)
    z, bic, best = {}, {}, (-np.inf, value)
    for name, variants in designs.items():
        bases = [basis(design - fixed @ (fixed.T @ design)) for design in variants]
        gains = [float(np.sum((base.T @ value) ** 2)) for base in bases]
        base = bases[int(np.argmax(gains))]
        z[name] = max(float(np.max(np.abs(each.T @ value), initial=0.0)) for each in bases)
        bic[name] = max(gains) - (base.shape[1] + (len(variants) > 1)) * np.log(len(value))
        best = max(best, (bic[name], value - base @ (base.T @ value)), key=lambda item: item[0])
    for name, score in _spread(best[1], relative).items():
        z[name], bic[name] = max(score, 0.0), max(score, 0.0) ** 2 - np.log(len(value))
    top_z, top_bic = max(z, key=lambda name: z[name]), max(bic, key=lambda name: bic[name])
    return {"largest_z": top_z if z[top_z] > Z_LIMIT else "", "plain_bic": top_bic if bic[top_bic] > BIC_LIMIT else ""}
