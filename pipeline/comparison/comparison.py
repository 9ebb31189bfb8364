"""`scarpsim compare` as one call: the trial, its figures, and measured epochs beside it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.comparison.assess import MapNoise, SensorAssessment, assess, assess_measured
from pipeline.comparison.sensors_compared import Contestant
from pipeline.comparison.trial import Trial, compare
from pipeline.noise.measured import MeasuredMaps, read_measured
from pipeline.report.progress import Progress
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom

_FIGURES_S = 3.0
"""What the plan of the progress takes for the figures of a sensor."""


@dataclass(frozen=True)
class ComparedSensors:
    """A trial with its figures, and measured epochs with theirs. config: the first sensor's, as JSON types."""

    trial: Trial
    found: list[SensorAssessment]
    measured: list[tuple[MeasuredMaps, MapNoise]]
    config: dict[str, Any]

    def noises(self) -> dict[str, MapNoise]:
        """Noise by name, the measured epochs' last."""
        return {each.name: each.noise for each in self.found} | {
            f"{maps.name} (measured)": noise for maps, noise in self.measured
        }


def compare_sensors(
    sensors: Sequence[Contestant],
    measured: Sequence[Path] = (),
    epochs: int = 6,
    sizes_m: tuple[float, float] | None = (0.05, 0.8),
    progress: Progress | None = None,
) -> ComparedSensors:
    """Compare sensors as `pipeline.comparison.trial.compare` does, and put measured epochs beside them.

    measured: folders as `read_measured` takes them, at the first config's GSD and registered by its ICP. They are read first, as
    a mistake there should not cost a simulation.
    """
    if sizes_m is not None and not 0 < sizes_m[0] <= sizes_m[1]:
        raise InputError(f"got {sizes_m[0]:g} and {sizes_m[1]:g} m", where="--sizes-m", allowed="0 < smallest <= largest")
    progress = progress or Progress()
    progress.plan({"figures": _FIGURES_S * len(sensors)})
    config = sensors[0].config
    random = KeyedRandom(config.seed)
    _check_given_once(measured)
    maps = [read_measured(folder, config.difference, config.icp, random.child("measured", folder.name)) for folder in measured]
    maps = [replace(each, name=name) for each, name in zip(maps, _own_names([each.name for each in maps]), strict=True)]
    trial = compare(sensors, epochs, sizes_m, progress)
    found = []
    with progress.stage("figures"):
        for number, seen in enumerate(trial.seen):
            progress.advance(number / len(trial.seen))
            found.append(assess(trial, seen, random))
        beside = [(each, assess_measured(each, random)) for each in maps]
    return ComparedSensors(trial, found, beside, config.model_dump(mode="json"))


def _check_given_once(folders: Sequence[Path]) -> None:
    seen: set[str] = set()
    for folder in folders:
        place = os.path.realpath(folder)  # Path.resolve raises at a loop
        if place in seen:
            raise InputError("is given twice", where=f"--measured {folder}", remedy="name each folder once")
        seen.add(place)


def _own_names(names: Sequence[str]) -> list[str]:
    """The names, numbered where several folders have one."""
    return [name if names.count(name) == 1 else f"{name} {names[: at + 1].count(name)}" for at, name in enumerate(names)]
