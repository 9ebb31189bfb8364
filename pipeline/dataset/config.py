"""The config of a data set: combinations of walls, sensors, noise levels and block sizes, and how many epochs of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, StringConstraints, ValidationError, field_validator, model_validator

from pipeline.change.annotate import AnnotationConfig
from pipeline.change.tiles import TileConfig
from pipeline.config.bundled import bundled_config
from pipeline.config.overrides import Override, apply_overrides, read_override, read_with_overrides
from pipeline.config.presets import is_path, model_file
from pipeline.config.simulation import SensorModel, SensorName, SimulationConfig, load_config
from scene.blocks.block import RockfallConfig
from scene.common.config import Config, load_yaml, parse
from scene.common.errors import InputError, nearest
from sensors.models.sensor_model import StereoModel, TlsModel

DATASET_FILE = "dataset.json"
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9.-]*$", max_length=40)]
"""A word that can be part of a file name, between underscores."""


_Factor = Annotated[float, Field(ge=0)]


class ScaledModel(Config):
    """A sensor model whose noise is multiplied by a factor, for one noise level of a data set.

    In a file, `model` may be a bundled name or a path.
    """

    model: SensorModel
    scale: _Factor | dict[str, _Factor] = Field(1.0, description="factor of every sigma and mean of the noise, one or by wall")
    scaled: Literal["all", "orientation"] = Field(
        "all", description="what the factor is of: all noise, or a stereo pair's orientation alone, its matching left as it is"
    )

    @model_validator(mode="after")
    def _has_an_orientation(self) -> Self:
        if self.scaled == "orientation" and self.model.sensor != "stereo":
            raise ValueError("a laser scanner has no orientation noise to scale; use scaled: all")
        return self

    def on(self, wall: str) -> StereoModel | TlsModel:
        """Return the sensor model for maps of the given wall: its noise times the factor of that wall."""
        factor = self.scale[wall] if isinstance(self.scale, dict) else self.scale
        sigmas = {key: value for key, value in self.model.noise.model_dump().items() if key not in _NO_SIGMA}
        values = {key: _scaled(value, factor) for key, value in sigmas.items() if self.scaled in ("all", key)}
        noise = self.model.noise.model_validate(self.model.noise.model_dump() | values)
        return self.model.model_copy(update={"noise": noise})


_NO_SIGMA = {"regularization_step_px", "orientation_drawn"}
"""Noise keys that are no sizes and stay unscaled."""


def _scaled(value: Any, factor: float) -> Any:
    """Multiply all numbers of a nested mapping."""
    if isinstance(value, Mapping):
        return {key: _scaled(inner, factor) for key, inner in value.items()}
    return value * factor


class NoiseLevel(Config):
    """The sensor models of a data set's epochs at one of its levels of noise."""

    stereo: ScaledModel | None = Field(None, description="model of the stereo pair")
    tls: ScaledModel | None = Field(None, description="model of the laser scanner")

    def of(self, sensor: SensorName) -> ScaledModel | None:
        """Return the model of a sensor at this level, with the factor of its noise; None if the level has none."""
        return self.stereo if sensor == "stereo" else self.tls


class SizeClass(Config):
    """Size and density of the fallen blocks in one size class of a data set.

    `rockfall` has the sizes and shapes of the blocks, and where they break out.
    """

    blocks_per_m2: float = Field(gt=0, le=1e6, description="blocks per area of the wall; replaces rockfall.count")
    rockfall: RockfallConfig = RockfallConfig()


class Part(Config):
    """A part of a data set: epochs of all combinations of the listed walls, noise levels and size classes with all sensors.

    Each combination has equally many epochs.
    """

    walls: tuple[Name, ...] = Field(min_length=1, description="names of walls")
    noise: tuple[Name, ...] = Field(min_length=1, description="names of noise levels")
    sizes: tuple[Name, ...] = Field(min_length=1, description="names of size classes")
    train: int = Field(0, ge=0, le=9999, description="training epochs of each combination")
    val: int = Field(0, ge=0, le=9999, description="validation epochs of each combination")
    test: int = Field(0, ge=0, le=9999, description="test epochs of each combination")


MOST_EPOCHS = 100_000
"""Largest number of epochs in a data set; it keeps a damaged file from causing minutes of work."""


class DatasetConfig(Config):
    """Config of a data set of annotated difference map tiles, on which detectors of rockfall are trained and tested.

    `tiles` says how difference maps are cut into tiles, and `annotation` which fallen blocks are annotated in them.
    """

    name: str = Field("rockfall", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", description="name of the data set")
    seed: int = Field(1, ge=0, lt=2**63, description="seed of all random numbers")
    sensors: tuple[SensorName, ...] = Field(("stereo", "tls"), min_length=1, description="sensors that observe every epoch")
    walls: dict[Name, SimulationConfig] = Field(
        min_length=1,
        description="walls and the sensors in front of them, by name; in a file `{site: name or file, set: [key=value, ...]}`",
    )
    noise: dict[Name, NoiseLevel] = Field(min_length=1, description="noise levels, by name")
    sizes: dict[Name, SizeClass] = Field(min_length=1, description="size classes, by name")
    parts: tuple[Part, ...] = Field(min_length=1, description="combinations in the set")
    tiles: TileConfig = TileConfig()
    annotation: AnnotationConfig = AnnotationConfig()
    validation_region: float = Field(
        0.43,
        ge=0,
        lt=1,
        description="share of a wall's columns of tiles, at its right end, that is for validation only; training tiles come from "
        "the rest and from other epochs; 0: separated by epoch only",
    )
    references: int = Field(
        1, ge=1, le=999, description="reference epochs of each wall, sensor and noise level; the epochs use them in turn"
    )
    truth: bool = Field(False, description="also write the true difference of each tile, in a folder `truth`")

    @field_validator("sensors")
    @classmethod
    def _each_once(cls, sensors: tuple[SensorName, ...]) -> tuple[SensorName, ...]:
        if len(set(sensors)) < len(sensors):
            raise ValueError("a sensor is listed twice")
        return sensors

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        known: dict[str, Mapping[str, Any]] = {"walls": self.walls, "noise": self.noise, "sizes": self.sizes}
        cells: set[tuple[str, str, str]] = set()
        for number, part in enumerate(self.parts):
            for kind, names in known.items():
                unknown = [name for name in getattr(part, kind) if name not in names]
                if unknown:
                    hint = nearest(unknown[0], names) or f"defined: {', '.join(names)}"
                    raise ValueError(f"parts.{number}.{kind}: '{unknown[0]}' is not defined under {kind}; {hint}")
            if not part.train + part.val + part.test:
                raise ValueError(f"parts.{number} has no epochs; set train, val or test")
            found = {(wall, noise, size) for wall in part.walls for noise in part.noise for size in part.sizes}
            if cells & found:
                raise ValueError(f"parts.{number} repeats the combination {' '.join(min(cells & found))}")
            cells |= found
            self._models_are_there(number, part)
        return self

    @model_validator(mode="after")
    def _series_fit(self) -> Self:
        series = {name: wall.series for name, wall in self.walls.items() if wall.series is not None}
        for name, each in series.items():
            if each.surfaces:
                raise ValueError(f"walls.{name}.series.surfaces have no blocks to annotate; use rockfall or events instead")
        different = [name for name, each in series.items() if each.kinds != next(iter(series.values())).kinds]
        if different:
            first = next(iter(series))
            raise ValueError(f"walls.{first} and walls.{different[0]} differ in series.kinds; set it alike on all walls")
        epochs = sum(
            (part.train + part.val + part.test) * len(self.sensors) * len(part.noise) * len(part.sizes) * len(self.steps(wall))
            for part in self.parts
            for wall in part.walls
        )
        if epochs > MOST_EPOCHS:
            raise ValueError(f"these are {epochs:,} epochs; allowed: up to {MOST_EPOCHS:,}")
        return self

    def steps(self, wall: str) -> Sequence[int]:
        """Return the numbers of the epochs of a wall's time series, without the reference; (0,) for a wall without a time series.

        wall: name of the wall.
        """
        series = self.walls[wall].series
        return (0,) if series is None else range(1, series.count)

    def _models_are_there(self, number: int, part: Part) -> None:
        for sensor in self.sensors:
            for noise in part.noise:
                model = self.noise[noise].of(sensor)
                if model is None or model.model.sensor != sensor:
                    raise ValueError(f"parts.{number} needs noise.{noise}.{sensor}, a model with `sensor: {sensor}`")
                missing = [wall for wall in part.walls if isinstance(model.scale, dict) and wall not in model.scale]
                if missing:
                    raise ValueError(f"noise.{noise}.{sensor}.scale has no factor for wall {missing[0]}")
                _scales(model, part.walls, f"noise.{noise}.{sensor}.scale")


def _scales(model: ScaledModel, walls: Sequence[str], key: str) -> None:
    """Raise ValueError if a scale puts a noise parameter outside its bounds."""
    for wall in walls:
        try:
            model.on(wall)
        except ValidationError as error:
            wrong = error.errors()[0]
            name = ".".join(map(str, wrong["loc"]))
            raise ValueError(f"{key} puts {name} outside its bounds on wall {wall}: {wrong['msg']}") from None


def load_dataset_config(path: Path, overrides: Sequence[str | Override] = (), seed: int | None = None) -> DatasetConfig:
    """Read a data set's config and resolve the sites and sensor models that it names.

    The dataset.json of a finished set is a config too; it makes the same bytes again.

    Parameters
    ----------
    path : Config file. Paths in it are relative to its folder.
    overrides : Values to change, `key.path=value`, as the option `--set` gives them.
    seed : Replaces the seed of the config; None: its own.

    Raises
    ------
    InputError
        If anything in the config is wrong.
    """
    return dataset_config(load_yaml(path), overrides, seed, path)


def dataset_config(values: Any, overrides: Sequence[str | Override], seed: int | None, path: Path) -> DatasetConfig:
    """Make and check a data set's config from values already read; the sites and sensor models that it names are read.

    Parameters
    ----------
    values : Content of a config file.
    overrides : Values to change, `key.path=value`.
    seed : Replaces the seed of the config; None: its own.
    path : The config file, for errors; paths in the config are relative to its folder.

    Raises
    ------
    InputError
        If anything in the config is wrong.
    """
    return read_with_overrides(lambda changes: _dataset_config(values, changes, seed, path), overrides, str(path))


def _dataset_config(values: Any, overrides: Sequence[str | Override], seed: int | None, path: Path) -> DatasetConfig:
    """Make and check a data set's config; see `dataset_config`."""
    if not isinstance(values, dict):
        raise InputError("the file is not a mapping of keys", where=str(path), remedy="start from configs/datasets/small.yaml")
    if "sources" in values and "fingerprint" in values:
        values = _only_source(values, path)
    values = apply_overrides(values, overrides)
    if seed is not None:
        values["seed"] = seed
    walls, noise = values.get("walls"), values.get("noise")
    if isinstance(walls, dict):
        values["walls"] = {name: _wall(wall, f"{path}: walls.{name}", path.parent) for name, wall in walls.items()}
    if isinstance(noise, dict):
        values["noise"] = {name: _with_models(level, path.parent) for name, level in noise.items()}
    return parse(DatasetConfig, values, str(path))


def _only_source(values: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the config in the dataset.json of a set that was not merged."""
    sources = values["sources"]
    configs = [each.get("config") for each in sources.values() if isinstance(each, dict)] if isinstance(sources, dict) else []
    if len(configs) > 1:
        raise InputError(
            f"the set was merged from {len(configs)} sets, so it has no single config",
            where=str(path),
            remedy="make each of these sets from its own config",
        )
    if not configs or not isinstance(configs[0], dict):
        raise InputError(
            "the record of the data set is damaged: it has no config",
            where=str(path),
            remedy="give the YAML file that the set was made with instead of this record",
        )
    return dict(configs[0])


def _wall(values: Any, where: str, folder: Path) -> Any:
    """Return the simulation config that a wall's entry `{site, set}` stands for; other entries are such configs already."""
    if not (isinstance(values, dict) and "site" in values):
        return values
    wrong = sorted(set(values) - {"site", "set"})
    if wrong:
        raise InputError(f"unknown key '{wrong[0]}'", where=where, allowed="site, set", remedy="put simulation keys under `set`")
    site, overrides = values["site"], values.get("set", [])
    if not isinstance(site, str) or not isinstance(overrides, list):
        raise InputError(
            "a wall needs `site` (a name or a YAML file) and may have `set` (a list of key=value)",
            where=where,
            remedy="see configs/datasets/small.yaml for an example",
        )
    path = folder / site if is_path(site) else bundled_config("sites", site)
    try:
        return load_config(path, [read_override(str(item)) for item in overrides], None, None).model_dump(mode="json")
    except InputError as error:
        raise InputError(error.what, where=f"{where}: {error.where}", allowed=error.allowed, remedy=error.remedy) from None


def _with_models(level: Any, folder: Path) -> Any:
    """Replace names and files of sensor models in a noise level by their content."""
    if not isinstance(level, dict):
        return level
    result = dict(level)
    for sensor, entry in level.items():
        if isinstance(entry, dict) and isinstance(entry.get("model"), str):
            name = entry["model"]
            file = folder / name if is_path(name) else model_file(name)
            result[sensor] = {**entry, "model": load_yaml(file)}
    return result
