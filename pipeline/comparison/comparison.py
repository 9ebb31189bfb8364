"""Run `scarpsim compare`: simulate all sensors, compute their results, and add those of measured epochs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.comparison.assess import MapNoise, SensorAssessment, assess, assess_measured
from pipeline.comparison.sensor_setups import SensorSetup
from pipeline.comparison.trial import Trial, compare
from pipeline.noise.measured import MeasuredMaps, read_measured
from pipeline.report.progress import Progress
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom

_FIGURES_S = 3.0
"""Expected time for the results of one sensor, s, for the progress display."""


@dataclass(frozen=True)
class ComparisonResult:
    """Result of comparing several sensors on one simulated wall.

    Attributes
    ----------
    trial : The simulation: wall, true changes and what each sensor observed.
    found : Noise, detected blocks and other results of each sensor, in the order in which the sensors were given.
    measured : Difference maps of really measured epochs with their noise, beside the simulated sensors.
    config : The first sensor's config, as JSON types.
    """

    trial: Trial
    found: list[SensorAssessment]
    measured: list[tuple[MeasuredMaps, MapNoise]]
    config: dict[str, Any]

    def noises(self) -> dict[str, MapNoise]:
        """Return the noise of each simulated sensor and then of each folder of measured epochs, by its name."""
        return {each.name: each.noise for each in self.found} | {
            f"{maps.name} (measured)": noise for maps, noise in self.measured
        }


def compare_sensors(
    sensors: Sequence[SensorSetup],
    measured: Sequence[Path] = (),
    epochs: int = 6,
    sizes_m: tuple[float, float] | None = (0.05, 0.8),
    progress: Progress | None = None,
) -> ComparisonResult:
    """Simulate several sensors in front of one wall from which the same blocks fall, and compare their results.

    Parameters
    ----------
    sensors : The sensors; the wall, blocks and random numbers are those of the first one's config.
    measured : Folders of really measured epochs whose noise is shown beside that of the sensors: measurement.yaml with points,
        or difference maps as GeoTIFFs. The first config gives their pixel size and ICP settings.
    epochs : Number of epochs with rockfall.
    sizes_m : Block sizes in the first and the last epoch, m; None: the blocks of the config.
    progress : Display of the progress; None: nothing is shown.

    Returns
    -------
    The results of all sensors.

    Raises
    ------
    InputError
        If the sizes, a measured folder or a sensor cannot be used.
    """
    if sizes_m is not None and not 0 < sizes_m[0] <= sizes_m[1]:
        raise InputError(
            f"{sizes_m[0]:g} m is no smallest block size above 0 for a largest size of {sizes_m[1]:g} m",
            where="--sizes-m",
            allowed="0 < smallest <= largest",
            remedy="give the smallest size first, both in metres",
        )
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
    return ComparisonResult(trial, found, beside, config.model_dump(mode="json"))


def _check_given_once(folders: Sequence[Path]) -> None:
    """Raise InputError for a folder that is given twice."""
    seen: set[str] = set()
    for folder in folders:
        place = os.path.realpath(folder)  # Path.resolve raises at a loop of links
        if place in seen:
            raise InputError("the folder is given twice", where=f"--measured {folder}", remedy="name each folder once")
        seen.add(place)


def _own_names(names: Sequence[str]) -> list[str]:
    """Return the names, numbered where several folders have the same."""
    return [name if names.count(name) == 1 else f"{name} {names[: at + 1].count(name)}" for at, name in enumerate(names)]
