"""A config of a data set that is made in seconds."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from pipeline.dataset.config import DatasetConfig
from pipeline.dataset.run import make_dataset
from scene.common.config import parse

COMMAND = "scarpsim dataset tiny.yaml --out DIR"
ROOT = Path(__file__).parents[1]
TINY: dict[str, Any] = {
    "name": "tiny",
    "seed": 3,
    "sensors": ["stereo", "tls"],
    "walls": {
        "ledge": {
            "wall": {"style": "glendale", "width_m": 9.0, "height_m": 5.0, "resolution_m": 0.1, "seed": 1},
            "cameras": {"distance_m": 20.0, "base_m": 5.0},
            "depth_map": "low",
            "station": {"distance_m": 20.0},
            "scanner": {"azimuth_step_rad": 0.004, "zenith_step_rad": 0.004},
            "difference": {"gsd_m": 0.05},
            "icp": {"max_iteration": 5},
        }
    },
    "noise": {
        "low": {
            "stereo": {"model": {"sensor": "stereo", "noise": {"parallax_sigma_px": 0.2}}},
            "tls": {"model": {"sensor": "tls"}, "scale": {"ledge": 2.0}},
        }
    },
    "sizes": {"large": {"blocks_per_m2": 0.35, "rockfall": {"size_m": {"kind": "uniform", "low": 0.4, "high": 0.6}}}},
    "tiles": {"size_px": 48, "minimum_valid_share": 0.3},
    "parts": [{"walls": ["ledge"], "noise": ["low"], "sizes": ["large"], "train": 2, "val": 1, "test": 1}],
    "truth": True,
}
EPOCHS = 8


def tiny(**changes: Any) -> DatasetConfig:
    return parse(DatasetConfig, {**TINY, **changes}, "test")


def digests(folder: Path) -> dict[str, str]:
    """Return the checksums of all files that belong to a data set; hidden files belong to the job that makes it."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.startswith("."))
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def tiny_set(folder: Path) -> Path:
    make_dataset(tiny(), folder, command=COMMAND)
    return folder
