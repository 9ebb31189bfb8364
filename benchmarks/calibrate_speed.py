"""Measure the observations per second of a Glendale calibration.

They are compared with casting as many rays and with simulating whole maps.

    python benchmarks/calibrate_speed.py [--site glendale]

The windows are those of a calibration on a map of the whole wall; noise is glendale_independent_high, depth maps are medium.
"""

from __future__ import annotations

import argparse

import numpy as np
from measure import bare_cast, medians

from pipeline.calibration.noise_map import noise_map
from pipeline.calibration.window_simulator import WindowSimulator
from pipeline.calibration.windows import choose_windows
from pipeline.change.difference import raster_grid
from pipeline.config.bundled import bundled_config
from pipeline.config.simulation import load_config
from pipeline.run.site import prepare_site
from scene.common.backend import mi
from scene.common.keyed_random import KeyedRandom
from scene.ray_casting.upload import on_device, vectors_on_device


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--site", default="glendale")
    arguments = parser.parse_args()
    config = load_config(bundled_config("sites", arguments.site), ["sensor=glendale_independent_high"], "stereo", None)
    site = prepare_site(config, "stereo", KeyedRandom(config.seed))
    grid = raster_grid(site.mesh.bounds, config.difference)
    model = config.stereo_model()
    border = np.ones(grid.shape, dtype=bool)
    border[:100], border[-100:], border[:, :100], border[:, -100:] = False, False, False, False
    windows = choose_windows(border, grid, config.calibration)
    simulator = WindowSimulator(config, site, windows)
    simulator.heights(model, KeyedRandom(0))
    eye = next(iter(site.viewpoints.values()))
    targets = site.mesh.vertices[KeyedRandom(1).generator().integers(0, len(site.mesh.vertices), len(simulator.cells))]
    targets = targets[np.lexsort((targets[:, 0], np.round(targets[:, 1], 1)))]
    origin = mi.Array3f64(*(on_device(mi.Float64, np.full(len(targets), value)) for value in eye))
    cast = bare_cast(simulator.caster, origin, vectors_on_device(targets - eye))
    one, bare = medians(lambda: simulator.heights(model, KeyedRandom(0)), cast)
    whole = medians(lambda: noise_map(config, site, site, simulator.caster, KeyedRandom(0)), rounds=1)[0]
    print(f"{len(simulator.cells):,} cells, {windows.stable.sum():,} pixels: {1 / one:.1f} observations/s")
    print(f"bare cast of as many rays {1e3 * bare:.1f} ms: {100 * (bare / one):.1f} % of an observation")
    print(f"a whole map takes {whole:.1f} s, {whole / (2 * one):.0f} times two observations in windows")


if __name__ == "__main__":
    main()
