"""Check whether calibrations recover the noise of simulated maps, and whether their intervals have the stated coverage.

    python benchmarks/calibrate_recovery.py [--sensor stereo|tls] [--trials 50] [--out DIR] [--write]

Each trial has its own wall and seed and draws its true noise at random. Its maps come from the whole simulation (`noise_map`:
every cell, meshing, ICP between two noisy epochs, rasters), not from the fast one that the calibration searches with. Finished
trials are kept under --out, so that an interrupted benchmark continues. --write puts the table into
docs/validation/calibration.md.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from pipeline.calibration.calibrate import calibrate_inputs
from pipeline.calibration.inputs import CalibrationInputs
from pipeline.calibration.noise_map import noise_map
from pipeline.calibration.parameters import noise_parameters
from pipeline.change.difference import raster_grid
from pipeline.config.bundled import bundled_config
from pipeline.config.simulation import load_config
from pipeline.report.progress import Progress
from pipeline.run.acquisition import acquire, reconstruct
from pipeline.run.site import prepare_site
from scene.common.backend import dr
from scene.common.keyed_random import KeyedRandom
from scene.ray_casting.raycast import RayCaster

DOCUMENT = Path(__file__).parents[1] / "docs" / "validation" / "calibration.md"
EPOCHS = 2
SETTINGS = [
    "wall.width_m=9",
    "wall.height_m=6",
    "wall.resolution_m=0.06",
    "depth_map=low",
    "difference.gsd_m=0.04",
    "scanner.azimuth_step_rad=0.001",
    "scanner.zenith_step_rad=0.001",
    "calibration.windows=10",
    "calibration.window_px=24",
    "calibration.simulations=80",
]
TRUTH = {
    "parallax_sigma_px": (0.2, 0.8),
    "regularization_sigma_px": (0.15, 0.6),
    "regularization_step_px": (24.0, 64.0),
    "orientation": (0.5, 3.0),
    "range_sigma_m": (0.0015, 0.01),
    "angle_sigma_rad": (3e-5, 3e-4),
}
"""Bounds of the true value, whose logarithm is uniform."""


def trial(sensor: Any, number: int) -> dict[str, Any]:
    """Run one calibration and return true values, estimates and intervals."""
    config = load_config(bundled_config("", "demo"), [*SETTINGS, f"wall.seed={100 + number}"], sensor, 1000 + number)
    random = KeyedRandom(50_000 + number)
    site = prepare_site(config, sensor, KeyedRandom(config.seed))
    instrument: Any = site.sensor
    fitted = noise_parameters(instrument.model, ())
    low, high = np.log([TRUTH[name] for name in fitted.names]).T
    true = np.exp(random.child("truth").generator().uniform(low, high))
    real = replace(site, sensor=replace(instrument, model=fitted.model(true)))
    caster = RayCaster(site.mesh)
    grid = raster_grid(reconstruct(config, acquire(config, real, caster, random.child("grid"))).bounds, config.difference)
    maps = np.stack([noise_map(config, real, real, caster, random.child("map", epoch), grid) for epoch in range(EPOCHS)])
    names = tuple(f"epoch {epoch}" for epoch in range(EPOCHS))
    inputs = CalibrationInputs(names, grid, maps, ~np.isnan(maps).any(axis=0), False, site, False)
    begun = time.process_time()
    found = calibrate_inputs(config, sensor, inputs, Progress(), with_greedy=False).found
    values = zip(fitted.names, true, *(np.exp(each) for each in (found.x, found.low, found.high)), strict=True)
    return {
        "parameters": {name: {"true": t, "value": v, "low": a, "high": b} for name, t, v, a, b in values},
        "p": found.misfit_p,
        "cpu_s": time.process_time() - begun,
    }


def table(found: list[dict[str, Any]]) -> list[str]:
    """Return the rows of the table: how well the calibrations recover each parameter.

    They state the coverage of the intervals with its 95 % binomial interval (Clopper and Pearson 1934), the median width, and the
    RMS error of the logarithm.
    """
    rows = [f"| {len(found)} trials | in the interval of 95 % (bounds of the share) | RMS error | median half width |"]
    rows.append("|" + "---|" * 4)
    for name in found[0]["parameters"]:
        each = [one["parameters"][name] for one in found]
        true, value, low, high = (np.array([one[key] for one in each]) for key in ("true", "value", "low", "high"))
        held = int(np.count_nonzero((low <= true) & (true <= high)))
        error, half = np.sqrt(np.mean(np.log(value / true) ** 2)), np.median(np.log(high / low)) / 2
        share = binomtest(held, len(found)).proportion_ci()
        holds = f"{held}, {100 * (held / len(found)):.0f} % ({100 * share.low:.0f} % to {100 * share.high:.0f} %)"
        rows.append(f"| {name} | {holds} | {100 * error:.1f} % | {100 * half:.1f} % |")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", choices=("stereo", "tls"), default="tls")
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--out", type=Path, default=Path("runs/calibrate_recovery"))
    parser.add_argument("--write", action="store_true", help="put the table into docs/validation/calibration.md")
    arguments = parser.parse_args()
    dr.set_thread_count(1)  # kernels are small; run both sensors side by side
    arguments.out.mkdir(parents=True, exist_ok=True)
    found = []
    for number in range(arguments.trials):
        path = arguments.out / f"{arguments.sensor}_{number:03}.json"
        if not path.exists():
            path.write_text(json.dumps(trial(arguments.sensor, number)))
        found.append(json.loads(path.read_text()))
        print(
            number, {name: tuple(f"{v:.3g}" for v in one.values()) for name, one in found[-1]["parameters"].items()}, flush=True
        )
    rows = table(found)
    print("\n".join(rows), f"\nCPU of a calibration: {np.median([one['cpu_s'] for one in found]):.0f} s")
    if arguments.write:
        _into_document(arguments.sensor, rows)


def _into_document(sensor: str, rows: list[str]) -> None:
    """Put a sensor's table between its two marks in docs/validation/calibration.md."""
    begin, end = f"<!-- recovery {sensor} -->\n", "\n<!-- end -->"
    text = DOCUMENT.read_text()
    replacement = begin + "\n".join(rows) + end
    DOCUMENT.write_text(re.sub(re.escape(begin) + ".*?" + re.escape(end), lambda _: replacement, text, flags=re.DOTALL))


if __name__ == "__main__":
    main()
