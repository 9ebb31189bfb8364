"""Who is compared: sensors out of configs, runs, bundled presets and model files, all in front of the first one's wall."""

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
"""What is compared: a name, or a config with the word that it goes by."""
Overrides = Sequence[str | Override]
_SCENE = ("seed", "wall", "rockfall", "wetness", "texture", "illumination", "difference")
"""What all share: taken from the first."""
_LONGEST_NAME = 60
_KINDS = ("", "sites", "scanners", "noise")
"""Subfolders of configs/ whose files can be named."""


@dataclass(frozen=True)
class Contestant:
    """A sensor with all that goes with it: its config's wall and blocks are everybody's."""

    name: str
    sensor: SensorName
    config: SimulationConfig

    @property
    def angular_step_rad(self) -> tuple[float, float] | None:
        """Of a laser scanner, in azimuth and in zenith; None for cameras."""
        scanner = self.config.scanner
        return (scanner.azimuth_step_rad, scanner.zenith_step_rad) if self.sensor == "tls" else None


def contestants(
    names: Sequence[Given], overrides: Overrides = (), seed: int | None = None, *, own_step: bool = False
) -> list[Contestant]:
    """The sensors that `names` stand for, in their order; a config with both sensors gives two.

    A name is a config with the word that it goes by, to which overrides and seed are applied already, a config file,
    a run's folder or its run.json, a sensor model's file (sensor: tls ...), or a bundled name: a site, a scanner preset
    (riegl_vz400i) or a noise model (glendale_high). Presets and models go into the first config's set-up, into the demo's
    where they are first themselves. Scanner presets scan with that config's angular step, so that the instruments are
    compared and not the time that they are given; own_step: with the preset's own, or the default's where it has none.
    overrides: `--set` of every config. Raises InputError for an unknown name, with the nearest one, for one that is given twice,
    and for whatever is wrong in a file.
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
    """A sensor beside itself says nothing: the same epochs, to the byte."""
    given: dict[str, str] = {}
    for name in names:
        if not isinstance(name, str):
            continue
        path = Path(name) / "run.json" if Path(name).is_dir() else Path(name)
        file = os.path.realpath(path if path.exists() or is_path(name) else _bundled(name))  # Path.resolve raises at a loop
        if file in given:
            as_what = "" if given[file] == name else f", as {given[file]} and as {name}"
            remedy = "name each sensor once; a copy of the file under another name can have other settings"
            raise InputError(f"is given twice{as_what}", where=name, remedy=remedy)
        given[file] = name


def _is_part(name: Given) -> TypeGuard[str]:
    """Whether a name stands for a scanner or a model alone, that needs a config around it."""
    if not isinstance(name, str):
        return False
    if Path(name).is_dir():
        return False
    if Path(name).is_file():
        values = load_yaml(Path(name))
        return isinstance(values, dict) and values.get("sensor") in ("stereo", "tls")
    return not is_path(name) and _kind(name) in ("scanners", "noise")


def _bundled(name: str) -> Path:
    return bundled_config(_kind(name), name)


def _kind(name: str) -> str:
    """The kind of bundled config that has this name; raises InputError with the nearest one where none has."""
    named = {kind: named_configs(kind) for kind in _KINDS}
    kind = next((kind for kind, found in named.items() if name in found), None)
    if kind is None:
        known = sorted(each for found in named.values() for each in found)
        hint = nearest(name, known)
        raise InputError(f"there is no file and no preset '{name}'", where="CONFIG", allowed=", ".join(known), remedy=hint)
    return kind


def _whole(name: Given, overrides: Overrides, seed: int | None) -> list[Contestant]:
    """The sensors of a config, a config file, a run or a bundled config."""
    if not isinstance(name, str):
        return _each_sensor(*name, name[1].sensor_names())
    path = Path(name)
    if path.is_dir():
        path = path / RUN_FILE
        if not path.exists():
            raise InputError(f"holds no {RUN_FILE}", where=name, remedy="name a run's folder or a config file")
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


def _each_sensor(name: str, config: SimulationConfig, sensors: Sequence[SensorName]) -> list[Contestant]:
    return [Contestant(f"{name}_{sensor}" if len(sensors) > 1 else name, sensor, config) for sensor in sensors]


def _part(name: str, base: SimulationConfig, *, own_step: bool) -> list[Contestant]:
    """A scanner preset, with or without its own angular step, or a sensor model in the set-up of `base`."""
    is_file = Path(name).is_file()
    path = Path(name) if is_file else _bundled(name)
    values: dict[str, Any] = base.model_dump(mode="json")
    if not is_file and _kind(name) == "scanners":
        step = {} if own_step else {key: values["scanner"][key] for key in ("azimuth_step_rad", "zenith_step_rad")}
        config = parse(SimulationConfig, values | {"scanner": {"preset": str(path), **step}, "sensor": []}, name)
    else:
        config = parse(SimulationConfig, values | {"sensor": [load_yaml(path)]}, name)
    return [Contestant(path.stem if is_file else name, config.sensor[0].sensor, config)]


def _with_own_names(found: Sequence[Contestant]) -> Iterator[Contestant]:
    """The same with names that differ, so that each has files of its own."""
    used: set[str] = set()
    for each in found:
        kind = [] if each.name.endswith(each.sensor) else [f"{each.name}_{each.sensor}"]
        names = [each.name, *kind, *(f"{each.name}_{number}" for number in range(2, len(found) + 2))]
        name = next(name for name in names if name not in used)
        used.add(name)
        yield replace(each, name=name)
