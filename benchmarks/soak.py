"""Check whether the memory of a process grows over two hundred epochs of a small wall.

    python benchmarks/soak.py [stereo|tls] [EPOCHS]

Prints the resident memory after epochs evenly spread over the run, and its slope over the second half, MB per epoch.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self

import numpy as np

from pipeline.config.bundled import bundled_config
from pipeline.config.simulation import SensorName, load_config
from pipeline.report.progress import Progress
from pipeline.run.simulation import simulate

SMALL = (
    "wall={style: glendale, width_m: 6, height_m: 4, resolution_m: 0.1}",
    "rockfall={count: 3, size_m: 0.4}",
    "depth_map=low",
    "scanner={azimuth_step_rad: 0.004, zenith_step_rad: 0.004}",
    "difference={gsd_m: 0.05}",
)
SHOWN = 10


def resident_mb() -> float:
    """Return the memory that this process occupies now, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


class Memory(Progress):
    """Notes the memory after each epoch that is written."""

    def __init__(self) -> None:
        super().__init__()
        self.after: list[float] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[Self]:
        with super().stage(name):
            yield self
        if name.endswith("write"):
            self.after.append(resident_mb())


def main(sensor: SensorName, epochs: int) -> None:
    config = load_config(bundled_config("", "demo"), [*SMALL, f"epochs={epochs}"], sensor, 1)
    memory = Memory()
    with tempfile.TemporaryDirectory() as folder:
        simulate(config, sensor, Path(folder) / "run", progress=memory)
    for number in np.unique(np.linspace(0, len(memory.after) - 1, SHOWN + 1).astype(int)):
        print(f"epoch {number:4d}: {memory.after[number]:6.0f} MB")
    half = memory.after[len(memory.after) // 2 :]
    slope = np.polyfit(np.arange(len(half)), half, 1)[0]
    print(f"{sensor}, {epochs} epochs in {memory.elapsed_s:.0f} s: {slope:+.3f} MB per epoch over the second half")


if __name__ == "__main__":
    main("stereo" if "stereo" in sys.argv[1:] else "tls", int(sys.argv[-1]) if sys.argv[-1].isdecimal() else 200)
