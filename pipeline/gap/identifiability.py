"""What a geometry can tell apart, before any residual is looked at."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.gap.measurement import Measurement
from pipeline.gap.selection import POSE
from pipeline.gap.workflow import candidates_of, residuals_of

_MOST_POINTS = 20_000


def identifiability(measurement: Measurement) -> dict[str, Any]:
    """Names, cosines of the signatures after the pose fit, and the share of each that survives it; the values are not used."""
    whole = residuals_of(measurement)
    rows = np.flatnonzero(whole.smooth)
    part = whole.part(rows[:: max(len(rows) // _MOST_POINTS, 1)])
    first = {
        candidate.name: candidate.columns[:, 0]
        for candidate in reversed(candidates_of(measurement, part))
        if not candidate.empirical
    }
    names = sorted(first)
    columns = np.stack([first[name] for name in names], axis=1) / part.sigma[:, None]
    pose = np.linalg.qr(part.pose[:, POSE] / part.sigma[:, None])[0]
    left = columns - pose @ (pose.T @ columns)
    size, whole_size = np.linalg.norm(left, axis=0), np.linalg.norm(columns, axis=0)
    unit = left / np.maximum(size, 1e-12 * whole_size)
    return {
        "names": [f"{measurement.sensor}.{name}" for name in names],
        "cosines": np.clip(unit.T @ unit, -1, 1).tolist(),
        "survival": (size / np.maximum(whole_size, 1e-300)).tolist(),
    }


def table(found: dict[str, Any]) -> str:
    """Name, share that survives the pose fit, and the signature that is most alike."""
    cosines = np.abs(np.array(found["cosines"]))
    np.fill_diagonal(cosines, 0.0)
    lines = [f"{'effect':<32}{'survives pose':>14}  most alike (cosine)"]
    for row, (name, share) in enumerate(zip(found["names"], found["survival"], strict=True)):
        other = int(np.argmax(cosines[row]))
        lines.append(f"{name:<32}{share:>14.1%}  {found['names'][other]} ({cosines[row, other]:.2f})")
    return "\n".join(lines)
