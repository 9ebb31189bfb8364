"""Read the file of a sensor model (model.yaml), which a measurement names."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Discriminator, Tag

from scene.common.config import Config, load_yaml, parse
from scene.common.errors import InputError
from sensors.models.sensor_model import StereoModel, TlsModel


def _kind(values: Any) -> str:
    """Return the sensor of a model."""
    return str(values.get("sensor") if isinstance(values, dict) else getattr(values, "sensor", None))


class _ModelFile(Config):
    """Content of model.yaml."""

    sensor: Annotated[Annotated[StereoModel, Tag("stereo")] | Annotated[TlsModel, Tag("tls")], Discriminator(_kind)]


def read_model(path: Path) -> TlsModel | StereoModel:
    """Read a sensor model (its noise and errors) from a YAML file. Raises InputError, which names the wrong key."""
    return sensor_model(load_yaml(path), str(path))


def sensor_model(values: Any, where: str) -> TlsModel | StereoModel:
    """Make a sensor model (its noise and errors) from the content of a YAML file.

    values: keys and values. where: name of the file, for errors. Raises InputError, which names the wrong key.
    """
    if not isinstance(values, dict) or values.get("sensor") not in ("tls", "stereo"):
        raise InputError(
            "the model names no sensor", where=where, allowed="sensor: tls, sensor: stereo", remedy="add one of these lines"
        )
    return parse(_ModelFile, {"sensor": values}, where).sensor
