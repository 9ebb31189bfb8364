"""Measure how fast data sets are made: tiles per minute, share of the steps, memory, and the projected time of the nine sets.

    python benchmarks/dataset.py                      workers: a small set by one and by two workers, in turns
    python benchmarks/dataset.py epochs [--epochs 6]  epochs of rockfall_9 in this process, projection of the whole plan
    python benchmarks/dataset.py memory [--epochs 100] [--sensor tls] [--small]    peak memory of one worker over many epochs

Rates are given per wall time and per processor time; on a shared machine, only the latter is meaningful. The projection simulates
the plan: a free worker takes the next run of epochs, and sets up a stage (wall, frame, scene, reference) if it is not its present
one. It is checked on the epochs that were just timed, and on the small set's two workers.
"""

from __future__ import annotations

import argparse
import heapq
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.bundled import bundled_config
from pipeline.dataset.cluster import runs
from pipeline.dataset.config import DatasetConfig, load_dataset_config
from pipeline.dataset.plan import PlannedEpoch, planned_epochs
from pipeline.dataset.run import DatasetSummary, Workers, make_dataset
from pipeline.dataset.worker import EpochOrder

WORKERS = (2, 16, 256)
SIZES = ("small", "medium", "large")


def timed(config: DatasetConfig, workers: int) -> tuple[float, DatasetSummary]:
    """Return the wall time, s, of making a whole set by some workers with one core each, and its summary.

    The time includes the start of processes and the card.
    """
    cores = os.sched_getaffinity(0)
    if workers:
        os.sched_setaffinity(0, sorted(cores)[:workers])
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        summary = make_dataset(config, Path(folder) / "set", Workers(workers))
        os.sched_setaffinity(0, cores)
        return time.perf_counter() - start, summary


def stage_seconds(made: Sequence[dict[str, Any]]) -> dict[str, float]:
    found: dict[str, float] = defaultdict(float)
    for taken in made:
        for name, seconds in taken["seconds"].items():
            found[name] += seconds
    return dict(found)


def of_glendale(epochs: int, sensors: Sequence[str], *others: dict[str, Any]) -> DatasetConfig:
    """Return rockfall_9 reduced to few epochs on Glendale at high noise, and to other parts.

    Parameters
    ----------
    epochs : int
        Number of training epochs of each sensor and size.
    sensors : sequence of str
        Sensors to keep.
    *others : dict
        Other parts.
    """
    values = load_dataset_config(bundled_config("datasets", "rockfall_9")).model_dump(mode="json")
    part = {"walls": ["glendale"], "noise": ["high"], "sizes": SIZES, "train": epochs}
    return DatasetConfig.model_validate({**values, "sensors": sensors, "parts": [part, *others]})


@dataclass(frozen=True)
class Costs:
    """Processor time, s, of a stage's set-up by wall and sensor, and of an epoch by wall, sensor and size."""

    set_up: dict[tuple[str, str], float]
    epoch: dict[tuple[str, str, str], float]

    def of_set_up(self, planned: PlannedEpoch) -> float:
        """Return the cost of the planned epoch's stage; a test wall costs as much as the training wall of its style."""
        return self.set_up[planned.wall.removesuffix("-b"), planned.sensor]

    def of(self, planned: PlannedEpoch) -> float:
        """Return the cost of the epoch; for an untimed size, that of the medium size is scaled as on Glendale."""
        wall, sensor = planned.wall.removesuffix("-b"), planned.sensor
        if (wall, sensor, planned.size) in self.epoch:
            return self.epoch[wall, sensor, planned.size]
        of_size = self.epoch["glendale", sensor, planned.size] / self.epoch["glendale", sensor, "medium"]
        return of_size * self.epoch[wall, sensor, "medium"]


def costs(config: DatasetConfig, made: Sequence[dict[str, Any]]) -> Costs:
    """Return the mean costs of epochs that were made; the set-up's share of processor time is that of its wall time."""
    plan = planned_epochs(config)
    set_up: dict[tuple[str, str], list[float]] = defaultdict(list)
    epoch: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    for taken in made:
        planned = plan[taken["index"]]
        before = sum(value for name, value in taken["seconds"].items() if name.startswith("set up"))
        share = before / sum(taken["seconds"].values())
        if share:
            set_up[planned.wall, planned.sensor].append(share * taken["cpu_seconds"])
        epoch[planned.wall, planned.sensor, planned.size].append((1 - share) * taken["cpu_seconds"])
    return Costs(
        {key: float(np.mean(each)) for key, each in set_up.items()}, {key: float(np.mean(each)) for key, each in epoch.items()}
    )


def makespan(plan: Sequence[PlannedEpoch], workers: int, cost: Costs) -> float:
    """Return the time until the last epoch of the plan is done, s, by the rule of the module."""
    free: list[tuple[float, int]] = [(0.0, number) for number in range(workers)]
    has: dict[int, object] = {}
    for run in runs([EpochOrder("", "", "", planned.index, planned.stage) for planned in plan], workers):
        now, worker = heapq.heappop(free)
        first = plan[run[0].index]
        now += 0.0 if has.get(worker) == first.stage else cost.of_set_up(first)
        now += sum(cost.of(plan[order.index]) for order in run)
        has[worker] = first.stage
        heapq.heappush(free, (now, worker))
    return max(now for now, _ in free)


def print_stages(made: Sequence[dict[str, Any]]) -> None:
    seconds = stage_seconds(made)
    print("| stage | share of the time |\n|---|---|")
    for name, value in sorted(seconds.items(), key=lambda item: -item[1]):
        print(f"| {name} | {100 * (value / sum(seconds.values())):.0f} % |")


def compare_workers(rounds: int) -> None:
    """Make the small set by one and by two workers, in turns."""
    config = load_dataset_config(bundled_config("datasets", "small"))
    plan = planned_epochs(config)
    print("| workers | wall, s | tiles a minute | processor s a tile | made by set-ups |\n|---|---|---|---|---|")
    rates: dict[int, list[float]] = defaultdict(list)
    cpu: dict[int, list[float]] = defaultdict(list)
    for _ in range(rounds):
        for workers in (1, 2):
            wall, summary = timed(config, workers)
            tiles = sum(taken["tiles"] for taken in summary.made)
            rates[workers].append(60 * tiles / wall)
            cpu[workers].append(sum(taken["cpu_seconds"] for taken in summary.made) / tiles)
            set_ups = sum(any(name.startswith("set up") for name in taken["seconds"]) for taken in summary.made)
            print(f"| {workers} | {wall:.0f} | {rates[workers][-1]:.0f} | {cpu[workers][-1]:.2f} | {set_ups} |", flush=True)
    print(f"scaling efficiency by wall time {np.median(rates[2]) / np.median(rates[1]) / 2:.2f}, ", end="")
    print(f"by processor time {np.median(cpu[1]) / np.median(cpu[2]):.2f}")
    played = [makespan(plan, workers, costs(config, summary.made)) for workers in (1, 2)]
    print(f"the projection's efficiency for this set, from the last round's costs: {played[0] / played[1] / 2:.2f}")
    print_stages(summary.made)


def project(epochs: int) -> None:
    """Time epochs of Glendale, and one of each other wall, in this process; project the whole plan of rockfall_9."""
    bulga = {"walls": ["bulga"], "noise": ["high"], "sizes": ["medium"], "train": 1}
    tests = {"walls": ["bismantova", "pilkington"], "noise": ["7.5cm"], "sizes": ["medium"], "test": 1}
    config = of_glendale(epochs, ("stereo", "tls"), bulga, tests)
    wall, summary = timed(config, 0)
    cost = costs(config, summary.made)
    whole = planned_epochs(load_dataset_config(bundled_config("datasets", "rockfall_9")))
    print_stages(summary.made)
    print("| wall, sensor, size | processor s |\n|---|---|")
    for name, seconds in [*cost.epoch.items(), *((("set-up", *key), value) for key, value in cost.set_up.items())]:
        print(f"| {', '.join(name)} | {seconds:.1f} |")
    shown = {(taken["tiles"], planned_epochs(config)[taken["index"]].name) for taken in summary.made}
    print("tiles:", ", ".join(f"{name} {count}" for count, name in sorted(shown)))
    tiles = sum(taken["tiles"] for taken in summary.made)
    cpu = sum(taken["cpu_seconds"] for taken in summary.made)
    print(f"{tiles} tiles in {wall:.0f} s, {cpu:.0f} s of processor time: {60 * tiles / cpu:.1f} tiles a core minute")
    print(f"played through, the epochs just timed take one worker {makespan(planned_epochs(config), 1, cost):.0f} s")
    print("| cores | nine sets and tests, both sensors | of the ideal |\n|---|---|---|")
    ideal = makespan(whole, 1, cost)
    for workers in WORKERS:
        time_taken = makespan(whole, workers, cost)
        print(f"| {workers} | {time_taken / 3600:.1f} h | {ideal / workers / time_taken:.2f} |")


def of_the_small_wall(epochs: int, sensor: str) -> DatasetConfig:
    """Return the small set's wall with this number of epochs."""
    values = load_dataset_config(bundled_config("datasets", "small")).model_dump(mode="json")
    part = {"walls": ["glendale"], "noise": ["high"], "sizes": ["medium"], "train": epochs}
    return DatasetConfig.model_validate({**values, "sensors": [sensor], "parts": [part]})


def print_memory(epochs: int, sensor: str, small: bool) -> None:
    """Print the peak memory after each tenth of the epochs."""
    config = of_the_small_wall(epochs, sensor) if small else of_glendale(-(-epochs // len(SIZES)), (sensor,))
    _, summary = timed(config, 0)
    for number in range(0, len(summary.made), max(1, len(summary.made) // 10)):
        print(f"{sensor}, after {number + 1:3} epochs: {summary.made[number]['peak_memory_gb']:.2f} GB at the peak")
    print(f"{sensor}, after {len(summary.made):3} epochs: {summary.made[-1]['peak_memory_gb']:.2f} GB at the peak (limit 2.5)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", default="workers", choices=["workers", "epochs", "memory"])
    parser.add_argument("--epochs", type=int, help="of each sensor and size (epochs: 2), or of all (memory: 100)")
    parser.add_argument("--rounds", type=int, default=3, help="workers: of both numbers of workers")
    parser.add_argument("--sensor", default="stereo", choices=["stereo", "tls"], help="memory")
    parser.add_argument("--small", action="store_true", help="memory: on the small set's wall instead of Glendale")
    asked = parser.parse_args()
    if asked.what == "workers":
        compare_workers(asked.rounds)
    elif asked.what == "epochs":
        project(asked.epochs or 2)
    else:
        print_memory(asked.epochs or 100, asked.sensor, asked.small)


if __name__ == "__main__":
    main()
