"""Sensors that are asked for some of their cells or pulses only: the same values there as in a whole observation.

Effects that look at neighbours need the whole observation (`looking_around`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import overload

import numpy as np
from numpy.typing import NDArray

from scene.common.backend import mi
from scene.ray_casting.upload import on_device
from sensors.laser.tls import LaserScanner
from sensors.models.sensor_model import StereoModel, TlsModel
from sensors.signal_chain.pulses import Pulses
from sensors.stereo.stereo_pair import StereoPair


def looking_around(model: StereoModel | TlsModel) -> list[str]:
    """Names of its effects that look at more than their own cell or pulse."""
    return sorted({effect.name for effect in model.effects if effect.looks_at != "element"})


@dataclass(frozen=True)
class ChosenCells(StereoPair):
    """A stereo pair that is asked for some cells of the left depth map only. chosen: (n,) their numbers, counted by row."""

    chosen: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(0, dtype=np.uint32))

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.chosen), 1

    def cells(self) -> tuple[mi.UInt32, mi.Float64, mi.Float64]:
        index = on_device(mi.UInt32, self.chosen)
        return index, *self.centres(index)


@dataclass(frozen=True)
class ChosenPulses(LaserScanner):
    """A laser scanner that sends some pulses of its pattern only. chosen: (n,) their numbers, counted along the lines."""

    chosen: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(0, dtype=np.uint32))

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.chosen), 1

    def emit(self) -> Pulses:
        return self.pulses_at(on_device(mi.UInt32, self.chosen))


@overload
def asked_for(sensor: StereoPair, cells: NDArray[np.uint32]) -> ChosenCells: ...
@overload
def asked_for(sensor: LaserScanner, cells: NDArray[np.uint32]) -> ChosenPulses: ...
def asked_for(sensor: StereoPair | LaserScanner, cells: NDArray[np.uint32]) -> ChosenCells | ChosenPulses:
    """The sensor, asked for some cells or pulses (n,)."""
    own = {each.name: getattr(sensor, each.name) for each in fields(sensor)} | {"chosen": cells}
    return ChosenCells(**own) if isinstance(sensor, StereoPair) else ChosenPulses(**own)
