"""Measure the noise outside blocks of a data set's difference maps, by wall and noise level.

The config's scales are chosen by it.

    python benchmarks/dataset_noise.py [CONFIG] [--maps 4] [--sensor stereo|tls] [--unit]

The maps have no blocks, half the walls' resolution and a GSD of 10 cm, as in noise_table.py (docs/explanation/noise.md). Printed
are the mean StD, mm, and the smallest and largest. --unit: use scale 1 instead of the config's.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.calibration.noise_map import noise_map
from pipeline.change.difference import statistics
from pipeline.config.bundled import bundled_config
from pipeline.config.simulation import SensorName
from pipeline.dataset.config import DatasetConfig, load_dataset_config
from pipeline.dataset.plan import PlannedEpoch, planned_epochs, simulation_of
from pipeline.run.site import SensorSite, prepare_site
from scene.common.keyed_random import KeyedRandom
from scene.ray_casting.raycast import RayCaster


def stds_mm(config: DatasetConfig, epochs: list[PlannedEpoch], maps: int) -> dict[str, list[float]]:
    """StD of each map by level; `epochs` of one wall and sensor, one for each level."""
    first = simulation_of(config, epochs[0])
    coarse = {
        "wall": first.wall.model_copy(update={"resolution_m": 2 * first.wall.resolution_m}),
        "difference": first.difference.model_copy(update={"gsd_m": first.wall.resolution_m * 2}),
    }
    random = KeyedRandom(config.seed).child("noise of", epochs[0].wall)
    site = prepare_site(first.model_copy(update=coarse), epochs[0].sensor, random)
    caster = RayCaster(site.mesh)
    found = {}
    for epoch in epochs:
        simulation = simulation_of(config, epoch).model_copy(update=coarse)
        there = _with_model(site, simulation.sensor[0])
        found[epoch.noise] = [
            1e3 * statistics(noise_map(simulation, there, there, caster, random.child(number))).standard_deviation
            for number in range(maps)
        ]
    return found


def _with_model(site: SensorSite, model: object) -> SensorSite:
    return replace(site, sensor=replace(site.sensor, model=model))  # type: ignore[type-var]


def unscaled(config: DatasetConfig) -> DatasetConfig:
    """Return the config with every scale at 1."""
    values = config.model_dump(mode="json")
    for level in values["noise"].values():
        for model in level.values():
            if model is not None:
                model["scale"] = 1.0
    return DatasetConfig.model_validate(values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", nargs="?", type=Path, default=bundled_config("datasets", "rockfall_9"))
    parser.add_argument("--maps", type=int, default=4)
    parser.add_argument("--sensor", choices=["stereo", "tls"])
    parser.add_argument("--unit", action="store_true")
    asked = parser.parse_args()
    config = load_dataset_config(asked.config)
    config = unscaled(config) if asked.unit else config
    sensors: tuple[SensorName, ...] = (asked.sensor,) if asked.sensor else config.sensors
    print("| sensor | wall | noise | StD, mm | range |\n|---|---|---|---|---|")
    for sensor in sensors:
        for wall in config.walls:
            one = {epoch.noise: epoch for epoch in planned_epochs(config) if (epoch.sensor, epoch.wall) == (sensor, wall)}
            for noise, values in stds_mm(config, list(one.values()), asked.maps).items():
                told = f"{np.mean(values):.1f} | {min(values):.1f} - {max(values):.1f}"
                print(f"| {sensor} | {wall} | {noise} | {told} |", flush=True)


if __name__ == "__main__":
    main()
