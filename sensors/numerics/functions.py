"""Provide elementary functions for NumPy and for Dr.Jit arrays under the same names, so that each equation is written once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from scene.common.backend import dr, mi


@dataclass(frozen=True)
class Functions:
    """Elementary functions for one kind of array: those of the ray-tracing device or NumPy's.

    The equations of the sensors' errors take it as argument `m`, so that one equation serves the simulation (`DEVICE`) and the
    diagnosis of measurements (`HOST`). select(condition, a, b) is a where the condition holds, else b.
    """

    sin: Callable[[Any], Any]
    cos: Callable[[Any], Any]
    log: Callable[[Any], Any]
    exp: Callable[[Any], Any]
    floor: Callable[[Any], Any]
    select: Callable[[Any, Any, Any], Any]


HOST = Functions(np.sin, np.cos, np.log, np.exp, np.floor, np.where)
"""Functions of NumPy arrays."""
DEVICE = Functions(dr.sin, dr.cos, dr.log, dr.exp, dr.floor, dr.select)
"""Functions of Dr.Jit arrays."""


class DeviceParameters:
    """Presents the numeric parameters of an effect as scalars of the ray-tracing device, for use in the effect's equation.

    They are arguments of the compiled kernel, not constants in it, so that other values need no new compilation.
    """

    def __init__(self, model: Any) -> None:
        self._model = model

    def __getattr__(self, name: str) -> mi.Float64:
        return dr.opaque(mi.Float64, float(getattr(self._model, name)))
