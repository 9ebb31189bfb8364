"""Define the config of a simulation: the model of all its sections, and how files and overrides are combined."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, SerializerFunctionWrapHandler, Tag, field_validator, model_serializer, model_validator

from pipeline.change.annotate import AnnotationConfig
from pipeline.change.difference import DifferenceConfig
from pipeline.change.m3c2 import M3c2Config
from pipeline.change.tiles import TileConfig
from pipeline.config.bundled import bundled_config
from pipeline.config.calibration import CalibrationConfig
from pipeline.config.overrides import Override, apply_overrides, read_with_overrides
from pipeline.config.presets import expand_shorthand, is_path, model_file, with_preset, without_keys_of_preset
from pipeline.config.series import SeriesConfig
from pipeline.formats.cameras.camera_files import oriented_files, read_oriented, stereo_pair
from pipeline.formats.cameras.cameras import PairConfig, cameras_yaml_files, read_cameras_yaml
from pipeline.formats.measurements.model_file import sensor_model
from pipeline.precision.detectability import PlanningConfig
from pipeline.registration.register import IcpConfig
from pipeline.surface.mesh import SurfaceConfig
from pipeline.surface.reconstruct import FusionConfig, Reconstruction
from pipeline.surface.stations import StationsConfig
from scene.appearance.illumination import IlluminationConfig
from scene.appearance.texture import TextureConfig
from scene.appearance.wetness import WetnessConfig
from scene.blocks.block import RockfallConfig
from scene.common.config import Config, load_yaml, parse
from scene.common.errors import InputError
from scene.geometry.frame import FrameConfig
from scene.walls.imported import ImportedWall
from scene.walls.procedural import ProceduralWall
from scene.walls.wall import WallConfig
from sensors.cameras.camera import CameraPair
from sensors.laser.tls import ScannerConfig
from sensors.models.placement import RigConfig, StationConfig, Target
from sensors.models.sensor_model import StereoModel, TlsModel
from sensors.stereo.exposure import ExposureConfig
from sensors.stereo.matching import MatchingConfig
from sensors.stereo.stereo_pair import Quality

SensorName = Literal["stereo", "tls"]


class CamerasFile(Config):
    """Settings of a stereo pair whose cameras are read from a file.

    The file is the project's cameras.yaml, Metashape's camera XML or COLMAP's text model.
    """

    file: Path = Field(description="cameras.yaml, a Metashape camera XML or project (.psx), or the folder of a COLMAP text model")
    left: str | None = Field(None, description="label or image name of the left camera; none: the only pair, sorted by position")
    right: str | None = Field(None, description="label or image name of the right camera")

    def pair(self) -> CameraPair:
        """Read the pair of cameras (interior orientation and pose) from the configured file, world frame."""
        found = read_oriented(self.file)
        return read_cameras_yaml(self.file) if found is None else stereo_pair(found, self.left, self.right, str(self.file))

    def files(self) -> list[Path]:
        """Return the files that `pair` reads the cameras from."""
        return cameras_yaml_files(self.file) if read_oriented(self.file) is None else oriented_files(self.file)


def _camera_kind(values: Any) -> str:
    """Tell which kind of `cameras` section this is."""
    if isinstance(values, CamerasFile) or (isinstance(values, dict) and "file" in values):
        return "in a file"
    return "pair" if isinstance(values, PairConfig) or (isinstance(values, dict) and "left" in values) else "rig"


CamerasConfig = Annotated[
    Annotated[RigConfig, Tag("rig")] | Annotated[PairConfig, Tag("pair")] | Annotated[CamerasFile, Tag("in a file")],
    Discriminator(_camera_kind),
]


StationChoice = Annotated[
    Annotated[StationConfig, Tag("one")]
    | Annotated[Annotated[tuple[StationConfig, ...], Field(min_length=1, max_length=255)], Tag("several")],
    Discriminator(lambda values: "several" if isinstance(values, list | tuple) else "one"),
]


def _model_kind(values: Any) -> str:
    """Tell which sensor a model is of."""
    return str(values.get("sensor") if isinstance(values, dict) else getattr(values, "sensor", None))


SensorModel = Annotated[Annotated[StereoModel, Tag("stereo")] | Annotated[TlsModel, Tag("tls")], Discriminator(_model_kind)]


class ProductsConfig(Config):
    """What a simulation writes besides its rasters (difference maps and hillshades)."""

    truth_channels: bool = Field(True, description="the true range or depth of each point, as extra dimensions of points.laz")
    world: bool | None = Field(None, description="points and surface in world coordinates too; none: only for imported walls")
    surface: bool = Field(True, description="the reconstructed surface of each epoch, surface.ply (`view`, `icp-study` need it)")
    truth: bool = Field(True, description="the true wall, truth.ply (`view`, `icp-study` need it)")
    crs: str | None = Field(
        None, description="coordinate system of the world coordinates, such as EPSG:28356, for points_world.laz"
    )
    formats: tuple[Literal["copc", "ply", "xyz", "e57", "pcd"], ...] = Field(
        (), description="formats of the points in addition to points.laz"
    )
    block_meshes: bool = Field(
        False, description="four meshes of each block: wall difference, intersection, niche, removed block"
    )
    metashape: bool = Field(False, description="stereo: depth maps and cameras with a script that loads them into Metashape")


class SimulationConfig(Config):
    """A simulation of one wall, observed before and after rocks fall.

    Sections that have no description of their own: `rockfall` says which blocks fall, and `stations` how several
    positions of the scanner are joined. `surface` and `fusion` say how points become a surface, and `difference` how
    large the pixels of difference maps are. `annotation` says which blocks are labelled for training, and `products` what
    is written. `planning` has the settings of `scarpsim inspect`, and `calibration` those of `scarpsim calibrate`.
    """

    seed: int = Field(1, ge=0, lt=2**63, description="seed of all random numbers")
    epochs: int = Field(1, ge=1, le=9999, description="number of epochs after the reference, each with its own rockfalls")
    wall: WallConfig = Field(
        ProceduralWall(), description="generated in the style of a site, or a mesh of your own: `mesh: FILE` and no `style`"
    )
    frame: FrameConfig = Field(FrameConfig(), description="the wall frame, in which maps are made")
    rockfall: RockfallConfig = RockfallConfig()
    series: SeriesConfig | None = Field(
        None,
        description="a wall over time in place of `epochs`: times, rockfall, events, precursor, deposits, surfaces, conditions "
        "(howto/series.md); blocks then have the shapes of `rockfall`, not its number and size; none: epochs by themselves",
    )
    wetness: WetnessConfig | None = Field(None, description="wet patches of the rock, in every epoch; none: dry")
    sensor: tuple[SensorModel, ...] = Field((), description="sensor models (noise and effects), at most one of each sensor")
    cameras: CamerasConfig = Field(
        RigConfig(),
        description="two equal cameras in front of the wall's centre, or a pair of your own: `file: FILE`, `left`, `right`",
    )
    depth_map: Quality = Field("medium", description="depth map at 1/2 (high), 1/4 (medium), 1/8 (low) of the frame")
    matcher: Literal["simulated", "sgbm"] = Field(
        "simulated",
        description="stereo: disparities by ray tracing plus noise (simulated), or photographs rendered and matched (sgbm), "
        "which have their own errors: the model's parallax and regularization noise is then not used",
    )
    illumination: IlluminationConfig = Field(IlluminationConfig(), description="light on the rock (matcher: sgbm)")
    texture: TextureConfig = Field(TextureConfig(), description="texture of the rock (matcher: sgbm)")
    exposure: ExposureConfig = Field(ExposureConfig(), description="how light becomes grey values (matcher: sgbm)")
    matching: MatchingConfig = Field(MatchingConfig(), description="the real matcher (matcher: sgbm)")
    scanner: ScannerConfig = Field(
        ScannerConfig(),
        description="the laser scanner and what it scans; `preset: riegl_vz400i` gives a real one, with its noise",
    )
    station: StationChoice = Field(
        StationConfig(),
        description="where the laser scanner stands; for several stations a list, which are registered to the first",
    )
    stations: StationsConfig = StationsConfig()
    reconstruction: Reconstruction = Field(
        "direct",
        description="how the surface is made: from the sensor's own grid (direct); for stereo also from the wall's own vertices, "
        "measured by the pair (vertices), or by COLMAP from both depth maps (colmap)",
    )
    surface: SurfaceConfig = SurfaceConfig()
    fusion: FusionConfig = FusionConfig()
    icp: IcpConfig | None = Field(IcpConfig(), description="registration of each epoch to the reference; none: no registration")
    noisy_reference: bool = Field(
        True, description="whether the reference epoch has the sensor's noise too; it has the effects in any case"
    )
    icp_target: Literal["reference", "true_wall"] = Field(
        "reference",
        description="what ICP registers to: the reconstructed reference, or the true wall (thesis 3.6), to which the reference "
        "is then registered as well",
    )
    difference: DifferenceConfig = DifferenceConfig()
    m3c2: M3c2Config | None = Field(None, description="M3C2 distances in addition to the difference maps; none: not computed")
    annotation: AnnotationConfig = AnnotationConfig()
    tiles: TileConfig | None = Field(None, description="cut the difference maps into tiles; none: whole maps")
    products: ProductsConfig = ProductsConfig()
    planning: PlanningConfig = PlanningConfig()
    calibration: CalibrationConfig = CalibrationConfig()

    @model_validator(mode="before")
    @classmethod
    def _with_preset(cls, values: Any) -> Any:
        """Write out the preset that `scanner` names, and the wall of a series of surfaces."""
        return with_preset(_with_first_surface(values)) if isinstance(values, dict) else values

    @model_serializer(mode="wrap")
    def _without_series(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave `series` out where there is none, so that such runs stay the same to the byte."""
        values: dict[str, Any] = handler(self)
        if self.series is None:
            del values["series"]
        return values

    @model_validator(mode="after")
    def _one_schedule(self) -> SimulationConfig:
        """Refuse a series beside a contradicting number of epochs, or with surfaces of another wall."""
        if self.series is None:
            return self
        if self.epochs not in (1, self.series.count - 1):
            raise ValueError(f"`series.times` has {self.series.count - 1} epochs after the reference: leave `epochs` out")
        if self.products.block_meshes:
            raise ValueError("`products.block_meshes` are those of epochs by themselves: leave it out beside `series`")
        first = self.series.surfaces[:1]
        if first and not (isinstance(self.wall, ImportedWall) and tuple(self.wall.files) == first):
            raise ValueError("`wall.mesh` must be the first of `series.surfaces`, or left out")
        return self

    @field_validator("sensor", mode="before")
    @classmethod
    def _listed(cls, value: Any) -> Any:
        """Accept a single sensor model as a list of one."""
        models = [value] if isinstance(value, dict) else value
        for model in models if isinstance(models, list) else []:
            name = model.get("sensor") if isinstance(model, dict) else None
            if isinstance(model, dict) and name not in ("stereo", "tls"):
                raise ValueError("a sensor model needs `sensor: stereo` or `sensor: tls`")
        return models

    @field_validator("wall", mode="before")
    @classmethod
    def _of_one_kind(cls, value: Any) -> Any:
        """Refuse a path as the `wall` section, and a mesh beside the keys of a generated wall."""
        if isinstance(value, str):
            raise ValueError("a wall is a section of keys; for a mesh file write wall: {mesh: FILE}, or --set wall={mesh: FILE}")
        generated = (
            sorted(set(value) & (set(ProceduralWall.model_fields) - set(ImportedWall.model_fields)))
            if (isinstance(value, dict) and "mesh" in value)
            else []
        )
        if generated:
            raise ValueError(
                f"a wall is either a mesh or generated: `mesh` cannot be combined with {', '.join(generated)}; leave "
                "them out, or replace the section with --set wall={mesh: FILE}"
            )
        return value

    @field_validator("cameras", mode="before")
    @classmethod
    def _from_path(cls, value: Any) -> Any:
        """Accept a path as the `cameras` section."""
        return {"file": value} if isinstance(value, str) else value

    @field_validator("sensor")
    @classmethod
    def _one_of_each(cls, models: tuple[StereoModel | TlsModel, ...]) -> tuple[StereoModel | TlsModel, ...]:
        """Refuse two models of the same sensor."""
        if len({model.sensor for model in models}) < len(models):
            raise ValueError("holds two models of one sensor")
        return models

    @field_validator("station")
    @classmethod
    def _apart(cls, stations: StationConfig | tuple[StationConfig, ...]) -> StationConfig | tuple[StationConfig, ...]:
        """Refuse a station given twice.

        All stations use the config's one scanner, and repeating the same scan does not improve its maps (NMAD of 1, 2, 8 and
        32 scans from one place: 3.20, 3.24, 3.22, 3.20 mm), so this must be a mistake.
        """
        if isinstance(stations, tuple) and len(set(stations)) < len(stations):
            raise ValueError(
                "holds the same station twice, which changes no map; to repeat a set-up with its errors, move it by a "
                "millimetre; for another scanner, use another config (scarpsim compare)"
            )
        return stations

    @property
    def last_epoch(self) -> int:
        """Number of the last epoch; the reference is 0."""
        return self.epochs if self.series is None else self.series.count - 1

    def sensor_names(self) -> tuple[SensorName, ...]:
        """Return the sensors of which the config has a model; both if it has none, as both are then default."""
        return tuple(model.sensor for model in self.sensor) or ("stereo", "tls")

    def stereo_model(self) -> StereoModel:
        """Return the config's sensor model (noise and errors) of the stereo pair."""
        return next((model for model in self.sensor if isinstance(model, StereoModel)), StereoModel())

    def tls_model(self) -> TlsModel:
        """Return the config's sensor model (noise and errors) of the laser scanner."""
        return next((model for model in self.sensor if isinstance(model, TlsModel)), TlsModel())

    def station_configs(self) -> tuple[StationConfig, ...]:
        """Return the places where the laser scanner stands (its stations), one or several."""
        return (self.station,) if isinstance(self.station, StationConfig) else self.station

    def camera_pair(self, target: Target) -> CameraPair:
        """Return the nominal stereo pair, world frame.

        target: the wall's middle and orientation, in front of which a rig (two equal cameras) is placed; cameras from a file
        need it not.
        """
        return self.cameras.place(target) if isinstance(self.cameras, RigConfig) else self.cameras.pair()


def load_config(path: Path, overrides: Sequence[str | Override], sensor: SensorName | None, seed: int | None) -> SimulationConfig:
    """Read a config file, apply the user's changes, and check it.

    Relative paths in the file start from its folder, those in overrides from the working folder; both become absolute.

    Parameters
    ----------
    path : Path
        A YAML config; the run.json of a finished run, which repeats that run to the byte; or a sensor model alone
        (model.yaml), with which everything else is as in the demo.
    overrides : sequence of str or Override
        Values to change, `key.path=value`. A scanner preset among them replaces all that the file says about the
        instrument.
    sensor : str or None
        The sensor that is used; None for any.
    seed : int or None
        Seed that replaces the config's.

    Raises
    ------
    InputError
        If anything is wrong, or if the config only has models of another sensor than `sensor`.
    """
    values = load_yaml(path)
    if values is None or values == {}:
        raise InputError(
            "the config contains no key",
            where=str(path),
            remedy="write at least one key, or begin with what `scarpsim init` writes",
        )
    return resolved(values, overrides, sensor, seed, path)


def resolved(
    values: Any, overrides: Sequence[str | Override], sensor: SensorName | None, seed: int | None, path: Path
) -> SimulationConfig:
    """Make and check a config of values that have already been read.

    Parameters
    ----------
    values : mapping
        Content of a config file.
    overrides : sequence of str or Override
        Values to change, `key.path=value`.
    sensor : str or None
        The sensor that is used; None for any.
    seed : int or None
        Seed that replaces the config's.
    path : Path
        File of the values, or what errors should call them; relative paths in the values start from its folder.

    Raises
    ------
    InputError
        If anything is wrong, or if the config only has models of another sensor than `sensor`.
    """
    return read_with_overrides(lambda changes: _resolved(values, changes, sensor, seed, path), overrides, str(path))


def _resolved(
    values: Any, overrides: Sequence[str | Override], sensor: SensorName | None, seed: int | None, path: Path
) -> SimulationConfig:
    """Make and check a config; see `resolved`."""
    own: dict[str, Any] = {}
    values = {} if values is None else values
    if not isinstance(values, dict):
        raise InputError(
            "the config is not a mapping of keys", where=str(path), remedy="write `key: value` lines; see `scarpsim init`"
        )
    if isinstance(values.get("config"), dict) and "schema" in values:
        values = values["config"]
    if isinstance(values.get("sensor"), str) and values["sensor"] in ("stereo", "tls"):
        values, own = load_yaml(bundled_config("", "demo")), {"sensor": [values]}
    later = expand_shorthand(overrides)
    values = without_keys_of_preset(_with_paths(values, path.parent), later) | own
    values = _with_paths(apply_overrides(values, later), Path.cwd())
    if isinstance(values.get("sensor"), str):
        values["sensor"] = _checked_models(model_file(values["sensor"]))
    if seed is not None:
        values["seed"] = seed
    config = parse(SimulationConfig, values, str(path))
    if values.get("sensor") and sensor is not None and sensor not in {model.sensor for model in config.sensor}:
        raise InputError(
            f"the only sensor model is of '{config.sensor[0].sensor}', and --sensor is {sensor}",
            where=f"{path}: sensor",
            remedy=f"add a model with `sensor: {sensor}`, or give the other sensor with --sensor",
        )
    return config


def _checked_models(path: Path) -> Any:
    """Read a file of a sensor model or a list of models, and check each, so that an error names this file."""
    found = load_yaml(path)
    for model in found if isinstance(found, list) else [found]:
        sensor_model(model, str(path))
    return found


def _with_first_surface(values: dict[str, Any]) -> dict[str, Any]:
    """Take the first surface of a series as the wall if the config names none."""
    series = values.get("series")
    surfaces = series.get("surfaces") if isinstance(series, dict) else None
    if not isinstance(surfaces, list | tuple) or not surfaces:
        return values
    wall = values.get("wall") or {}
    return {**values, "wall": {"mesh": surfaces[0], **wall}} if isinstance(wall, dict) and "style" not in wall else values


def _with_paths(values: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the values with all paths made absolute, relative to `folder`."""

    def absolute(path: Any) -> Any:
        if isinstance(path, list):
            return [absolute(each) for each in path]
        is_one = isinstance(path, str) and "\0" not in path  # other values are refused when they are read
        return os.path.realpath(folder / path) if is_one else path  # Path.resolve raises for a loop of links

    result = dict(values)
    for section, key in (("wall", "mesh"), ("cameras", "file")):
        if isinstance(result.get(section), dict) and key in result[section]:
            result[section] = {**result[section], key: absolute(result[section][key])}
    if isinstance(result.get("cameras"), str):
        result["cameras"] = absolute(result["cameras"])
    if isinstance(result.get("series"), dict) and "surfaces" in result["series"]:
        result["series"] = {**result["series"], "surfaces": absolute(result["series"]["surfaces"])}
    for key in ("scanner", "sensor"):
        if isinstance(result.get(key), str) and is_path(result[key]):
            result[key] = absolute(result[key])
    scanner = result.get("scanner")
    if isinstance(scanner, dict) and isinstance(scanner.get("preset"), str) and is_path(scanner["preset"]):
        result["scanner"] = {**scanner, "preset": absolute(scanner["preset"])}
    return result
