"""How often `scarpsim gap` is right on walls that were monitored: each epoch is a scan, and so is the reference.

    python benchmarks/gap_monitored.py --walls 5 --seed 40 --out /tmp/monitored [--write]

Each wall is simulated in four epochs, from which rock falls; the epochs are given to `scarpsim monitor`, and its folder to
`scarpsim gap`. Each wall is diagnosed twice: without an effect, and with a bias by the incidence angle in the later epochs. An
interrupted run continues. With --write, the table goes into docs/validation/gap.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from documents import printed, write_between

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pipeline.formats.points.laz import read_laz, write_laz  # noqa: E402
from scene.geometry.frame import WallFrame  # noqa: E402

DOCUMENT = ROOT / "docs" / "validation" / "gap.md"
MARKS = ("<!-- monitored -->", "<!-- end of monitored -->")
STYLES = ("glendale", "bulga", "pilkington", "bismantova")
NOISE = {"range_sigma_m": 0.003, "angle_sigma_rad": 5e-5}
BIAS_M = 0.008
BIAS = {"name": "range_incidence_bias", "coefficient_m": BIAS_M}
EPOCHS = 3
POSITION = "8,-50,1.6"
"""Approximate place of the simulated scanner, m: in front of the middle of the wall, at the height of the instrument."""


def config(seed: int, effects: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the config of a wall of 16 m x 10 m at 50 m, with points every 6 cm."""
    return {
        "seed": seed,
        "epochs": EPOCHS,
        "wall": {"style": STYLES[seed % len(STYLES)], "width_m": 16.0, "height_m": 10.0, "resolution_m": 0.03, "seed": seed},
        "rockfall": {"count": 3, "size_m": {"kind": "gaussian", "mean": 0.4, "sigma": 0.1, "minimum": 0.15}},
        "station": {"distance_m": 50.0, "height_m": 1.6},
        "scanner": {"azimuth_step_rad": 0.0012, "zenith_step_rad": 0.0012},
        "sensor": [{"sensor": "tls", "noise": NOISE, "effects": effects}],
    }


def scarpsim(*words: object) -> None:
    """Run the program; raises CalledProcessError if it fails."""
    subprocess.run([Path(sys.executable).parent / "scarpsim", *map(str, words), "--quiet"], check=True, capture_output=True)


def surveyed(epoch: Path, out: Path) -> Path:
    """Write the points of a run's epoch in the coordinates of the survey, with all that the file says of them."""
    record = json.loads((epoch.parent / "run.json").read_text())["wall_frame"]
    cloud = read_laz(epoch / "points.laz")
    points = WallFrame(np.array(record["rotation"]), np.array(record["origin_m"])).to_world(cloud.points)
    write_laz(out, replace(cloud, points=points))
    return out


def simulated(seed: int, effects: list[dict[str, Any]], out: Path) -> list[Path]:
    """Simulate the epochs of a wall, and return their folders."""
    path = out.with_suffix(".yaml")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(config(seed, effects)))
    scarpsim("simulate", "--sensor", "tls", "--config", path, "--out", out, *(["--resume"] if out.exists() else []))
    return sorted(out.glob("epoch_*"))


def diagnosed(seed: int, biased: bool, folder: Path) -> dict[str, Any]:
    """Simulate, monitor and diagnose a wall in a folder, and return gap.json."""
    kind = "biased" if biased else "clean"
    found, answer = folder / f"monitor_{kind}", folder / f"gap_{kind}"
    if not (answer / "gap.json").exists():
        clean = simulated(seed, [], folder / "clean")
        epochs = [clean[0], *(simulated(seed, [BIAS], folder / "biased") if biased else clean)[1:]]
        clouds = [surveyed(each, folder / f"{kind}_{each.name}.laz") for each in epochs]
        model = folder / "model.yaml"
        model.write_text(yaml.safe_dump({"sensor": "tls", "noise": NOISE}))
        scarpsim("monitor", *clouds, "--position", POSITION, "--model", model, "--out", found)
        scarpsim("gap", found, "--out", answer)
    return dict(json.loads((answer / "gap.json").read_text()))


def rows(walls: int, seed: int, out: Path) -> Iterator[str]:
    """Rows of the table, one for each kind of walls."""
    yield "| later epochs | walls | answers | estimates of the 8 mm bias |"
    yield "|---|---|---|---|"
    for biased in (False, True):
        found = [diagnosed(number, biased, out / str(number)) for number in range(seed, seed + walls)]
        said = [_answer(each) for each in found]
        counted = ", ".join(f"{said.count(each)} {each}" for each in sorted(set(said), key=lambda each: -said.count(each)))
        sizes = [each["parameters"]["coefficient_m"] for one in found for each in one["effects"] if _is_bias(each)]
        told = ", ".join(f"{1e3 * size['value']:.1f} ± {1e3 * size['std']:.1f} mm" for size in sizes)
        yield f"| {'a bias by the incidence angle' if biased else 'no effect'} | {walls} | {counted} | {told} |"


def _is_bias(effect: dict[str, Any]) -> bool:
    return str(effect["name"]) == "tls.range_incidence_bias"


def _answer(found: dict[str, Any]) -> str:
    names = ", ".join(f"`{effect['name'].removeprefix('tls.')}`" for effect in found["effects"])
    return f"`{found['verdict']}`" + (f" ({names})" if names else "")


def main() -> None:
    """Diagnose all walls, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--walls", type=int, default=10, help="of each kind")
    parser.add_argument("--seed", type=int, default=40)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    table = printed(rows(given.walls, given.seed, given.out))
    if given.write:
        write_between(DOCUMENT, MARKS, table)


if __name__ == "__main__":
    main()
