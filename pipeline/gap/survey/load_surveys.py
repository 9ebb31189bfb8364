"""Load the surveys to analyse: that of a measurement, or those of a simulation config."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.config.simulation import SensorName, load_config
from pipeline.formats.measurements.measurement import FILE, read_measurement
from pipeline.gap.survey.survey_views import Survey, measured_survey, planned_survey
from scene.common.errors import InputError


def load_surveys(path: Path, overrides: Sequence[str] = (), sensor: SensorName | None = None) -> list[Survey]:
    """Load the survey (stations or cameras, and points) of a measurement, or simulate one for each sensor of a config.

    Parameters
    ----------
    path : Folder with measurement.yaml, that file itself, or a simulation config.
    overrides : Settings of the config, each as `key=value`.
    sensor : The sensor of the config to use; None for all.

    Raises
    ------
    InputError
        If the file cannot be read, or `overrides` or another sensor are given for a measurement.
    """
    if path.is_dir() or path.name == FILE:
        measurement = read_measurement(path)
        if overrides or sensor not in (None, measurement.sensor):
            raise InputError(
                "a measurement takes neither --set nor another --sensor",
                where=str(path),
                remedy="leave these options out, or give a config instead of the measurement",
            )
        return [measured_survey(measurement)]
    config = load_config(path, overrides, sensor, None)
    return [planned_survey(config, name) for name in ([sensor] if sensor else config.sensor_names())]
