"""Read which sensors to compare: from configs, runs, bundled presets and sensor model files.

All are placed in front of the first one's wall.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeGuard

from pipeline.config.bundled import bundled_config, named_configs
from pipeline.config.overrides import Override
from pipeline.config.presets import is_path
from pipeline.config.simulation import SensorName, SimulationConfig, load_config
from pipeline.formats.records.result_records import RUN_FILE, read_run
from scene.common.config import load_yaml, parse
from scene.common.errors import InputError, nearest

Given = str | tuple[str, SimulationConfig]
"""Something to compare: the name of a file or preset, or a config with the name to call it by."""
Overrides = Sequence[str | Override]
_SCENE = ("seed", "wall", "rockfall", "wetness", "texture", "illumination", "difference")
"""Config sections that all sensors take from the first."""
_LONGEST_NAME = 60
"""Longest name taken from a file name, characters."""
_KINDS = ("", "sites", "scanners", "noise")
"""Subfolders of configs/ whose files can be named."""


@dataclass(frozen=True)
class SensorSetup:
    """One sensor to compare: a stereo pair or a laser scanner with the config that describes it.

    Attributes
    ----------
    name : Name in the comparison.
    sensor : "stereo" or "tls" (laser scanner).
    config : Its config. The sections that describe wall and blocks are the same for all sensors of the comparison.
    """

    name: str
    sensor: SensorName
    config: SimulationConfig

    @property
    def angular_step_rad(self) -> tuple[float, float] | None:
        """Angular steps of a laser scanner in azimuth and in zenith angle, rad; None for cameras."""
        scanner = self.config.scanner
        return (scanner.azimuth_step_rad, scanner.zenith_step_rad) if self.sensor == "tls" else None


def sensor_setups(
    names: Sequence[Given], overrides: Overrides = (), seed: int | None = None, *, own_step: bool = False
) -> list[SensorSetup]:
    """Read which sensors to compare, and put all of them in front of the first config's wall.

    Parameters
    ----------
    names : What to compare, in any mix. A config file, a bundled site, a run's folder or its run.json gives its sensor,
        or two if it has both kinds. A scanner preset (such as riegl_vz400i) or a noise model (such as glendale_high), by
        name or file, describes only a sensor; it is put into the first config, or into the demo's if there is none. A
        pair of a name and a config is used as it is, with overrides and seed already applied.
    overrides : Settings "key=value" that replace those of every config (the `--set` options).
    seed : Seed of the random numbers, which replaces those of the configs; None: theirs.
    own_step : Whether scanner presets use their own angular step. By default they use the first config's, so that
        instruments are compared and not scan times.

    Returns
    -------
    The sensors, in the order of the names.

    Raises
    ------
    InputError
        If a name is unknown or given twice, or a file is wrong.
    """
    _check_given_once(names)
    first = next((name for name in names if not _is_part(name)), str(bundled_config("", "demo")))
    base = _whole(first, overrides, seed)[0].config
    shared = {key: getattr(base, key) for key in _SCENE}
    found = [
        each
        for name in names
        for each in (_part(name, base, own_step=own_step) if _is_part(name) else _whole(name, overrides, seed))
    ]
    placed = [replace(each, config=each.config.model_copy(update=shared)) for each in found]
    return list(_with_own_names(placed))


def _check_given_once(names: Sequence[Given]) -> None:
    """Raise InputError for a sensor that is given twice: it would give the same epochs."""
    given: dict[str, str] = {}
    for name in names:
        if not isinstance(name, str):
            continue
        path = Path(name) / "run.json" if Path(name).is_dir() else Path(name)
        file = os.path.realpath(
            path if path.exists() or is_path(name) else _bundled(name)
        )  # Path.resolve raises at a loop of links
        if file in given:
            raise InputError(
                f"the sensor is given twice: it was already given as '{given[file]}'",
                where=name,
                remedy="name each sensor once; to compare two settings of one sensor, give a copy of its config file",
            )
        given[file] = name


def _is_part(name: Given) -> TypeGuard[str]:
    """Whether a name stands for a scanner or a sensor model only, which needs a config around it."""
    if not isinstance(name, str):
        return False
    if Path(name).is_dir():
        return False
    if Path(name).is_file():
        values = load_yaml(Path(name))
        return isinstance(values, dict) and values.get("sensor") in ("stereo", "tls")
    return not is_path(name) and _kind(name) in ("scanners", "noise")


def _bundled(name: str) -> Path:
    """Return the path of a bundled config."""
    return bundled_config(_kind(name), name)


def _kind(name: str) -> str:
    """Return the kind of bundled config that has this name; raise InputError with the nearest name if none has."""
    named = {kind: named_configs(kind) for kind in _KINDS}
    kind = next((kind for kind, found in named.items() if name in found), None)
    if kind is None:
        known = sorted(each for found in named.values() for each in found)
        hint = nearest(name, known)
        raise InputError(
            f"no file or preset is called '{name}'",
            where="CONFIG",
            allowed=", ".join(known),
            remedy=hint or "give the path of an existing config, or one of these names",
        )
    return kind


def _whole(name: Given, overrides: Overrides, seed: int | None) -> list[SensorSetup]:
    """Return the sensors of a config, a config file, a run or a bundled config."""
    if not isinstance(name, str):
        return _each_sensor(*name, name[1].sensor_names())
    path = Path(name)
    if path.is_dir():
        path = path / RUN_FILE
        if not path.exists():
            raise InputError("the folder contains no run.json", where=name, remedy="name a run's folder or a config file")
        read_run(path, "name a config file")
    elif not path.is_file() and not is_path(name):
        path = _bundled(name)
    config = load_config(path, overrides, None, seed)
    sensors = config.sensor_names()
    if path.suffix == ".json":
        recorded = load_yaml(path)
        sensors = (read_run(path, "name a config file")["sensor"],) if "config" in recorded else sensors[:1]
    stem = (path.parent.name if path.name == RUN_FILE else path.stem)[:_LONGEST_NAME]
    return _each_sensor(stem, config, sensors)


def _each_sensor(name: str, config: SimulationConfig, sensors: Sequence[SensorName]) -> list[SensorSetup]:
    """Return one entry for each sensor of a config."""
    return [SensorSetup(f"{name}_{sensor}" if len(sensors) > 1 else name, sensor, config) for sensor in sensors]


def _part(name: str, base: SimulationConfig, *, own_step: bool) -> list[SensorSetup]:
    """Put a scanner preset, with or without its own angular step, or a sensor model into the config `base`."""
    is_file = Path(name).is_file()
    path = Path(name) if is_file else _bundled(name)
    values: dict[str, Any] = base.model_dump(mode="json")
    if not is_file and _kind(name) == "scanners":
        step = {} if own_step else {key: values["scanner"][key] for key in ("azimuth_step_rad", "zenith_step_rad")}
        config = parse(SimulationConfig, values | {"scanner": {"preset": str(path), **step}, "sensor": []}, name)
    else:
        config = parse(SimulationConfig, values | {"sensor": [load_yaml(path)]}, name)
    return [SensorSetup(path.stem if is_file else name, config.sensor[0].sensor, config)]


def _with_own_names(found: Sequence[SensorSetup]) -> Iterator[SensorSetup]:
    """Make the names unique, so that each sensor has its own files."""
    used: set[str] = set()
    for each in found:
        kind = [] if each.name.endswith(each.sensor) else [f"{each.name}_{each.sensor}"]
        names = [each.name, *kind, *(f"{each.name}_{number}" for number in range(2, len(found) + 2))]
        name = next(name for name in names if name not in used)
        used.add(name)
        yield replace(each, name=name)
