"""Make the folder of `scarpsim inspect`: maps as GeoTIFF, plan.json and report.html."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.config.simulation import SensorName, SimulationConfig
from pipeline.formats.files.atomic import filling, write_json
from pipeline.formats.rasters.geotiff import write_geotiff
from pipeline.planning.maps import Plan, plans
from pipeline.planning.report import write_plan_report
from pipeline.planning.series import SeriesPlan
from pipeline.planning.series_report import series_parts
from pipeline.report.map_styles import quantity_style
from pipeline.report.progress import Progress
from pipeline.report.provenance import versions
from pipeline.run.site import prepare_site
from scene.common.keyed_random import KeyedRandom

PLAN_FILE, REPORT_FILE = "plan.json", "report.html"
_WALL_S, _MAPS_S = 2.0, 4.0
"""Approximate duration of the stages, s, for the progress."""


def inspect(config: SimulationConfig, sensors: Sequence[SensorName], progress: Progress | None = None) -> list[Plan]:
    """Predict how well each sensor of a config would measure its wall, with equations instead of a simulation.

    It is what `scarpsim inspect` computes, to choose a set-up before anything is simulated or measured.

    Parameters
    ----------
    config : SimulationConfig
        The wall, the sensors and their positions, and the settings of the prediction (section `planning`).
    sensors : sequence of str
        Any of "stereo" and "tls".
    progress : Progress, optional
        Object that is told which stage is running, to show it to the user.

    Returns
    -------
    list of Plan
        One plan for each sensor. A scanner with several stations has one plan for all together and one for each.
    """
    progress = progress or Progress()
    progress.plan(
        {f"{sensor}: {stage}": seconds for sensor in sensors for stage, seconds in (("wall", _WALL_S), ("maps", _MAPS_S))}
    )
    found: list[Plan] = []
    for sensor in sensors:
        with progress.stage(f"{sensor}: wall"):
            site = prepare_site(config, sensor, KeyedRandom(config.seed))
        with progress.stage(f"{sensor}: maps"):
            found += plans(config, site)
    return found


def write_plans(out: Path, config: SimulationConfig, found: Sequence[Plan], series: Sequence[SeriesPlan] = ()) -> Path:
    """Write what `inspect` predicts into a folder: a GeoTIFF of each map, plan.json and report.html.

    The folder appears only when everything has been written. Maps are named <sensor>_<map>.tif, or
    <sensor>_station_<n>_<map>.tif for one of several stations. Their values are in SI units, on pixels of the wall frame.

    Parameters
    ----------
    out : Path
        Folder to write.
    config : SimulationConfig
        The config for which the plans were computed.
    found : sequence of Plan
        The plans that `inspect` returned.
    series : sequence of SeriesPlan
        Predictions for series of epochs, which are added to plan.json and the report.

    Returns
    -------
    Path
        Path of report.html.

    Raises
    ------
    InputError
        If the folder exists and is not empty, or cannot be written.
    """
    with filling(out) as folder:
        _write(folder, config, found, series)
    return out / REPORT_FILE


def _write(out: Path, config: SimulationConfig, found: Sequence[Plan], series: Sequence[SeriesPlan]) -> None:
    """Write everything into the folder."""
    for each in found:
        for plotted in each.maps:
            path = out / f"{each.prefix}_{plotted.name}.tif"
            values = each.raster.image(plotted.values)
            write_geotiff(path, values, each.raster.grid, description=plotted.title)
            quantity_style(path, values, plotted.unit, plotted.factor)
    record: dict[str, Any] = {
        "schema": 1,
        "seed": config.seed,
        "plans": [each.to_dict() for each in found],
        **({"series": [each.to_dict() for each in series]} if series else {}),
        "config": config.model_dump(mode="json"),
        "versions": versions(),
    }
    write_json(out / PLAN_FILE, record)
    write_plan_report(out / REPORT_FILE, found, config.model_dump(mode="json"), series_parts(series))
