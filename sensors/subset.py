"""Observe only some cells or pulses of a sensor, with the same values as in a complete observation.

Effects that depend on neighbouring cells need the complete observation (`effects_needing_neighbours`).
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


def effects_needing_neighbours(model: StereoModel | TlsModel) -> list[str]:
    """Return the names of a sensor model's effects (errors) that depend on neighbouring cells or pulses.

    They cannot be simulated for some cells or pulses alone.
    """
    return sorted({effect.name for effect in model.effects if effect.looks_at != "element"})


@dataclass(frozen=True)
class ChosenCells(StereoPair):
    """A stereo pair that observes only some cells of the left depth map, to save time.

    chosen: (n,) numbers of the cells, counted row by row.
    """

    chosen: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(0, dtype=np.uint32))

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of an observation's arrays: (n, 1), a column of the n chosen cells."""
        return len(self.chosen), 1

    def cells(self) -> tuple[mi.UInt32, mi.Float64, mi.Float64]:
        """Return number and centre (u, v), px of the full-resolution frame, of the chosen cells of the depth map."""
        index = on_device(mi.UInt32, self.chosen)
        return index, *self.centres(index)


@dataclass(frozen=True)
class ChosenPulses(LaserScanner):
    """A laser scanner that emits only some pulses of its scan, to save time.

    chosen: (n,) numbers of the pulses, counted line by line.
    """

    chosen: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(0, dtype=np.uint32))

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of an observation's arrays: (n, 1), a column of the n chosen pulses."""
        return len(self.chosen), 1

    def emit(self) -> Pulses:
        """Return the chosen pulses with their nominal directions, before any error."""
        return self.pulses_at(on_device(mi.UInt32, self.chosen))


@overload
def restrict_to(sensor: StereoPair, cells: NDArray[np.uint32]) -> ChosenCells: ...
@overload
def restrict_to(sensor: LaserScanner, cells: NDArray[np.uint32]) -> ChosenPulses: ...
def restrict_to(sensor: StereoPair | LaserScanner, cells: NDArray[np.uint32]) -> ChosenCells | ChosenPulses:
    """Return the same sensor restricted to some cells or pulses, to simulate only these.

    cells: (n,) numbers of the cells of a stereo pair's depth map, row by row, or of a scanner's pulses, line by line.
    """
    own = {each.name: getattr(sensor, each.name) for each in fields(sensor)} | {"chosen": cells}
    return ChosenCells(**own) if isinstance(sensor, StereoPair) else ChosenPulses(**own)
