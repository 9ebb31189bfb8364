"""From what a call names, a config object, a file, a bundled name, keywords, to one resolved config."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel

from pipeline.config.bundled import bundled_config, config_path
from pipeline.config.overrides import Override
from pipeline.config.simulation import SensorName, SimulationConfig, load_config, resolved
from scene.common.errors import InputError

ConfigLike = SimulationConfig | Mapping[str, Any] | str | os.PathLike[str] | None
"""A config, its values, a file, a bundled site's name, or a run's folder; None: the demo."""


def configure(
    config: ConfigLike = None,
    sensor: SensorName | None = None,
    *,
    seed: int | None = None,
    model: Any = None,
    **overrides: Any,
) -> SimulationConfig:
    """The config that a call names, resolved; what `simulate`, `plan`, `compare` and `calibrate` do with their first argument.

    config: a SimulationConfig, a mapping of its keys, a YAML file, a bundled site such as "glendale", a run's folder; None: the
    demo's. model: a sensor model, its file or bundled name ("glendale_high"), in place of the config's. overrides: as `--set`
    of the command line, with two underscores for the dot: rockfall__count=5, wall={"mesh": "wall.ply"}. Raises InputError for
    whatever is wrong.
    """
    check_sensor(sensor)
    changes = keywords({**({} if model is None else {"sensor": model}), **overrides})
    if isinstance(config, SimulationConfig):
        return resolved(config.model_dump(mode="json"), changes, sensor, seed, Path("config"))
    if isinstance(config, Mapping):
        return resolved(plain(config), changes, sensor, seed, Path("config"))
    path = bundled_config("", "demo") if config is None else config_path("sites", Path(config))
    return load_config(path / "run.json" if path.is_dir() else path, changes, sensor, seed)


def check_sensor(sensor: str | None) -> None:
    """Raise InputError for a word that names no sensor."""
    if sensor not in (None, "stereo", "tls"):
        raise InputError(f"got {sensor!r:.80}", where="sensor", allowed="'stereo', 'tls'")


def one_sensor(config: SimulationConfig, sensor: SensorName | None) -> SensorName:
    """The sensor that is meant: the one named, or the only one that the config has a model of."""
    if sensor is not None:
        return sensor
    names = config.sensor_names()
    if len(names) > 1:
        raise InputError("the config has both", where="sensor", remedy="give sensor='tls' or sensor='stereo'")
    return names[0]


def keywords(values: Mapping[str, Any]) -> list[Override]:
    """Keywords as overrides: two underscores stand for the dot."""
    return [Override(tuple(name.split("__")), plain(value), f"{name}={value!r:.80}") for name, value in values.items()]


def plain(value: Any) -> Any:
    """The value in the types that a YAML file has: of models their fields, of paths their text, of arrays lists."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [plain(each) for each in value] if isinstance(value, list | tuple) else value


def paths(values: Any) -> list[Path]:
    """One path or several as a list; objects with a `folder`, such as a run, stand for it."""
    several: Sequence[Any] = values if isinstance(values, list | tuple) else [values]
    return [Path(getattr(each, "folder", each)) for each in several]


Show = Literal["auto"] | bool
"""Whether progress is shown: "auto" in notebooks and on terminals."""
