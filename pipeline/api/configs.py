"""Turn the `config` argument of a call (config object, file, bundled name, keywords) into one resolved config."""

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
"""A config object, a mapping of its keys, a file, the name of a bundled site, or the folder of a run. None means the demo."""


def configure(
    config: ConfigLike = None,
    sensor: SensorName | None = None,
    *,
    seed: int | None = None,
    model: Any = None,
    **overrides: Any,
) -> SimulationConfig:
    """Return the resolved config that a call describes.

    `simulate`, `plan`, `compare` and `calibrate` treat their arguments in this way.

    Parameters
    ----------
    config : optional
        A SimulationConfig, a mapping of its keys, a YAML file, a bundled site such as "glendale", or a run's folder. Default:
        the demo.
    sensor : "tls" or "stereo", optional
        The sensor that the config is for.
    seed : int, optional
        Seed of all random numbers. Default: the config's.
    model : optional
        A sensor model, its file or its bundled name ("glendale_high"), instead of the config's.
    **overrides
        Changed keys, as with `--set` on the command line but with two underscores for the dot: rockfall__count=5,
        wall={"mesh": "wall.ply"}.

    Returns
    -------
    SimulationConfig
        The complete, checked config.

    Raises
    ------
    InputError
        If anything in it is wrong.
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
    """Raise InputError if `sensor` is neither None nor the name of a kind of sensor."""
    if sensor not in (None, "stereo", "tls"):
        raise InputError(
            f"the sensor is {sensor!r:.80}", where="sensor", allowed="'stereo', 'tls'", remedy="give 'stereo' or 'tls'"
        )


def one_sensor(config: SimulationConfig, sensor: SensorName | None) -> SensorName:
    """Return the sensor that was asked for or, if that is None, the only one that the config has a model of.

    Raises InputError if none was asked for and the config has both.
    """
    if sensor is not None:
        return sensor
    names = config.sensor_names()
    if len(names) > 1:
        raise InputError(
            "the config contains both sensors, and none was chosen", where="sensor", remedy="give sensor='tls' or sensor='stereo'"
        )
    return names[0]


def keywords(values: Mapping[str, Any]) -> list[Override]:
    """Return keyword arguments as overrides of config keys, for calls from Python.

    values: new values by keyword; two underscores in a keyword stand for the dot, as in rockfall__count=5.
    """
    return [Override(tuple(name.split("__")), plain(value), f"{name}={value!r:.80}") for name, value in values.items()]


def plain(value: Any) -> Any:
    """Convert a value from Python to the types of a YAML file, so that it is read like a config file.

    value: anything that a config can contain. Models become mappings, paths become text, arrays become lists.
    """
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
    """Return a caller's input as a list of paths.

    values: one path, an object with a `folder` (such as a run, which stands for its folder), or a list of these.
    """
    several: Sequence[Any] = values if isinstance(values, list | tuple) else [values]
    return [Path(getattr(each, "folder", each)) for each in several]


Show = Literal["auto"] | bool
"""Whether progress is shown; "auto": in notebooks and on terminals."""
