"""How each kind of config is read, for tests that go over all of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.config.presets import read_preset
from pipeline.config.simulation import load_config
from pipeline.dataset.config import load_dataset_config
from pipeline.detection.network.config import load_train_config
from pipeline.formats.measurements.config import MeasurementConfig
from scene.common.config import load_yaml, parse

LOADERS: dict[str, Callable[[Path], Any]] = {
    "simulation": lambda path: load_config(path, [], None, None),
    "model": lambda path: load_config(path, [], None, None),
    "dataset": load_dataset_config,
    "detector": load_train_config,
    "scanner": lambda path: read_preset(str(path)),
    "measurement": lambda path: parse(MeasurementConfig, load_yaml(path), str(path)),
}
