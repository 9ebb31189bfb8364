"""The surveys that a path names: a measurement's, or those of a simulation config."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.config.simulation import SensorName, load_config
from pipeline.formats.measurements.measurement import FILE, read_measurement
from pipeline.gap.survey.survey_views import Survey, measured_survey, planned_survey
from scene.common.errors import InputError


def load_surveys(path: Path, overrides: Sequence[str] = (), sensor: SensorName | None = None) -> list[Survey]:
    """A measurement's survey, or one for each sensor of a config (or for `sensor` alone).

    path: a folder with measurement.yaml, that file, or a config. Raises InputError for what cannot be read or does not fit.
    """
    if path.is_dir() or path.name == FILE:
        measurement = read_measurement(path)
        if overrides or sensor not in (None, measurement.sensor):
            raise InputError(
                "--set and another --sensor belong to a config", where=str(path), remedy="leave them out for a measurement"
            )
        return [measured_survey(measurement)]
    config = load_config(path, overrides, sensor, None)
    return [planned_survey(config, name) for name in ([sensor] if sensor else config.sensor_names())]
