"""Compare the noise of simulated difference maps of the Glendale site with the thesis (tables 5-1 to 5-3).

The maps are made after ICP and without blocks.

    python benchmarks/noise_table.py [--maps 45] [--levels high medium low] [--parameters | --readings]
        [--write]

Each map is the difference of two observations of one wall with independent noise. Finished maps are kept under --out, so that an
interrupted run continues. --parameters: only the noise of each parameter; --readings: the printed noise drawn in other ways;
--faithful: glendale_high, medium and low by vertices against a reference without noise, as in the data sets. --write puts the
table into docs/validation/noise.md.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from measure import peak_memory_gb

from pipeline.calibration.noise_map import noise_map, with_model
from pipeline.change.difference import statistics
from pipeline.config.bundled import bundled_config
from pipeline.config.simulation import SimulationConfig, load_config
from pipeline.run.site import SensorSite, prepare_site
from scene.common.config import load_yaml, parse
from scene.common.keyed_random import KeyedRandom
from scene.ray_casting.raycast import RayCaster
from sensors.models.sensor_model import StereoModel, StereoNoise

DOCUMENT = Path(__file__).parents[1] / "docs" / "validation" / "noise.md"
LEVELS = ("high", "medium", "low")
THESIS_MM = {"high": (23.8, 24.4), "medium": (14.0, 14.6), "low": (7.8, 8.5)}
"""Mean StD and mean RMSE over 45 maps."""
SETTINGS = [
    "wall.resolution_m=0.1",
    "difference.gsd_m=0.1",
    "icp.subsample_points=true",
    "icp.subsample_ratio=0.9",
]
FAITHFUL = ["reconstruction=vertices", "wall.resolution_m=0.2", "difference.gsd_m=0.2", "icp.subsample_ratio=0.8"]
"""Vertices are as noisy at any spacing; coarse ones are soon measured."""
FIRST_SEED = 1000
Figures = dict[str, Any]


@dataclass(frozen=True)
class Reading:
    """A way to read the thesis: noise in both epochs or in the later one only, drawn for each camera or for both at once."""

    name: str
    noisy_reference: bool = True
    each_camera: bool = True

    def models(self, model: StereoModel) -> tuple[StereoModel, StereoModel]:
        """Return the models of the two observations of one map."""
        drawn = "each_camera" if self.each_camera else "both_alike"
        after = model.model_copy(update={"noise": model.noise.model_copy(update={"orientation_drawn": drawn})})
        return after if self.noisy_reference else SILENT, after


SILENT = StereoModel(noise=StereoNoise(parallax_sigma_px=0.0, regularization_sigma_px=0.0))
AS_SIMULATED = Reading("")
READINGS = (
    Reading("each camera, both epochs"),
    Reading("each camera, later epoch only", noisy_reference=False),
    Reading("both cameras alike, both epochs", each_camera=False),
    Reading("both cameras alike, later epoch only", noisy_reference=False, each_camera=False),
)


class Maps:
    """Statistics of noise maps of one site, each kept in a file of its own."""

    def __init__(self, config: SimulationConfig, site: SensorSite, folder: Path) -> None:
        self.config, self.site, self.folder, self.caster = config, site, folder, RayCaster(site.mesh)
        folder.mkdir(parents=True, exist_ok=True)

    def of(self, model: StereoModel, maps: int, reading: Reading = AS_SIMULATED) -> list[Figures]:
        """Statistics, m, of maps 1 to `maps` of a sensor model."""
        return [self._one(model, number, reading) for number in range(1, maps + 1)]

    def _one(self, model: StereoModel, number: int, reading: Reading) -> Figures:
        identity = self.config.model_dump_json() + model.model_dump_json() + reading.name
        path = self.folder / f"{hashlib.sha256(identity.encode()).hexdigest()[:16]}_{number:03}.json"
        if not path.exists():
            random = KeyedRandom(FIRST_SEED + number)
            before, after = (with_model(self.site, epoch) for epoch in reading.models(model))
            path.write_text(json.dumps(statistics(noise_map(self.config, before, after, self.caster, random)).to_dict()))
        return dict(json.loads(path.read_text()))


def bundled_model(name: str) -> StereoModel:
    """Return a noise model of Glendale by its name after `glendale_`."""
    path = bundled_config("noise", f"glendale_{name}")
    return parse(StereoModel, load_yaml(path), str(path))


def level_table(measured: Maps, levels: list[str], maps: int, reading: Reading = AS_SIMULATED) -> list[str]:
    """Means over the maps, ranges, and the ratio to the thesis's figures; lengths in mm."""
    prefix = "independent_" if reading is AS_SIMULATED else ""
    rows = [
        f"| level ({maps} maps) | StD | StD, thesis | StD, ratio "
        "| RMSE | RMSE, thesis | RMSE, ratio | RMSE, range | median | NMAD |",
        "|" + "---|" * 10,
    ]
    for level in levels:
        found = measured.of(bundled_model(level if level == "printed" else prefix + level), maps, reading)
        std, rmse, median, nmad = (
            1e3 * np.array([one[f"{name}_m"] for one in found]) for name in ("standard_deviation", "rmse", "median", "nmad")
        )
        targets = THESIS_MM.get(level)
        compared = [_compared(value.mean(), targets and targets[place]) for place, value in enumerate((std, rmse))]
        spread = f"{rmse.min():.1f} - {rmse.max():.1f}"
        rows.append(f"| {level} | {compared[0]} | {compared[1]} | {spread} | {median.mean():.2f} | {nmad.mean():.1f} |")
    return rows


def _compared(value: float, target: float | None) -> str:
    return f"{value:.1f} | {target} | {value / target:.2f}" if target else f"{value:.1f} | - | -"


def parameter_table(measured: Maps, maps: int) -> list[str]:
    """Root mean square over the maps of the StD (and NMAD), mm, of each parameter's noise alone, as printed and as calibrated."""
    rows = [f"| alone ({maps} maps) | printed, StD | printed, NMAD | calibrated, StD | calibrated, NMAD |", "|" + "---|" * 5]
    models = [single_parameters(bundled_model(name)) for name in ("printed", "independent_high")]
    for name in models[0]:
        cells = [_root_mean_square(measured.of(model[name], maps)) for model in models]
        rows.append(f"| {name} | " + " | ".join(cells) + " |")
        print(rows[-1], flush=True)
    return rows


def reading_table(measured: Maps, maps: int) -> list[str]:
    """Mean StD, mm, and its range of the printed noise and of its orientation part alone, under each reading of the thesis."""
    rows = [
        f"| noise drawn for ({maps} maps) | all noise, mean | all noise, range | orientation alone, mean "
        "| orientation alone, range |",
        "|" + "---|" * 5,
    ]
    models = single_parameters(bundled_model("printed"))
    for reading in READINGS:
        found = (measured.of(models[name], maps, reading) for name in ("all", "orientation"))
        cells = (1e3 * np.array([one["standard_deviation_m"] for one in each]) for each in found)
        rows.append(f"| {reading.name} | " + " | ".join(f"{v.mean():.1f} | {v.min():.1f} - {v.max():.1f}" for v in cells) + " |")
        print(rows[-1], flush=True)
    return rows


def _root_mean_square(found: list[Figures]) -> str:
    values = (np.array([one[f"{name}_m"] for one in found]) for name in ("standard_deviation", "nmad"))
    return " | ".join(f"{1e3 * np.sqrt(np.mean(value**2)):.1f}" for value in values)


def single_parameters(model: StereoModel) -> dict[str, StereoModel]:
    """Return a model for each parameter of the noise that is not null, then all orientation, all matching and all of it."""
    noise = model.noise.model_dump()
    matching = {key: noise[key] for key in ("parallax_sigma_px", "regularization_sigma_px")}
    orientation = {key: spread for key, spread in noise["orientation"].items() if spread["sigma"] > 0}
    silent = {**dict.fromkeys(matching, 0.0), "regularization_step_px": noise["regularization_step_px"]}
    groups = {key: silent | {"orientation": {key: spread}} for key, spread in orientation.items()}
    groups |= {key: silent | {key: sigma} for key, sigma in matching.items()}
    groups |= {"orientation": silent | {"orientation": orientation}, "matching": silent | matching, "all": noise}
    return {key: StereoModel.model_validate({"noise": group}) for key, group in groups.items()}


def into_document(name: str, rows: list[str]) -> None:
    """Put a table between its two marks in docs/validation/noise.md."""
    text = DOCUMENT.read_text(encoding="utf-8")
    table = "\n".join(rows)
    marked = re.sub(rf"(<!-- {name} -->\n).*?(<!-- end -->)", lambda found: f"{found[1]}{table}\n{found[2]}", text, flags=re.S)
    DOCUMENT.write_text(marked, encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--maps", type=int, default=45)
    parser.add_argument("--levels", nargs="+", default=list(LEVELS), choices=[*LEVELS, "worst", "printed"])
    parser.add_argument("--quality", default="medium", choices=["high", "medium", "low"], help="of the depth maps")
    parser.add_argument("--parameters", action="store_true", help="the noise of each parameter alone")
    parser.add_argument("--readings", action="store_true", help="the printed noise, read in four ways")
    parser.add_argument("--faithful", action="store_true", help="the levels as the data sets have them")
    parser.add_argument("--out", type=Path, default=Path("runs/noise_table"))
    parser.add_argument("--write", action="store_true", help="put the table into docs/validation/noise.md")
    asked = parser.parse_args()
    settings = [*SETTINGS, f"depth_map={asked.quality}", *(FAITHFUL if asked.faithful else [])]
    config = load_config(bundled_config("sites", "glendale"), settings, "stereo", None)
    measured = Maps(config, prepare_site(config, "stereo", KeyedRandom(config.seed)), asked.out)
    start = time.perf_counter()
    if asked.faithful:
        name, rows = "faithful", level_table(measured, asked.levels, asked.maps, READINGS[-1])
    elif asked.parameters:
        name, rows = "parameters", parameter_table(measured, asked.maps)
    elif asked.readings:
        name, rows = "readings", reading_table(measured, asked.maps)
    else:
        name, rows = "levels", level_table(measured, asked.levels, asked.maps)
    if asked.write:
        into_document(name, rows)
    print("\n".join(rows))
    print(f"{time.perf_counter() - start:.0f} s, peak memory {peak_memory_gb():.2f} GB")


if __name__ == "__main__":
    main()
