"""Provide `plan`, which predicts what a set-up achieves without simulating it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.api.configs import ConfigLike, Show, configure, one_sensor
from pipeline.api.maps import data_array, dataset
from pipeline.api.pictures import Picture, html_table, pick
from pipeline.api.tables import frame
from pipeline.config.simulation import SensorName, SimulationConfig
from pipeline.planning.inspect import inspect, write_plans
from pipeline.planning.maps import Plan as Promise
from pipeline.planning.report import answer, map_picture, summary
from pipeline.report.notebook_progress import python_progress

if TYPE_CHECKING:
    import pandas
    import xarray


def plan(
    config: ConfigLike = None,
    sensor: SensorName | None = None,
    *,
    out: Path | str | None = None,
    seed: int | None = None,
    model: Any = None,
    progress: Show = "auto",
    **overrides: Any,
) -> Plans:
    """Map the precision, point spacing, blind spots and smallest detectable block of a set-up, as `scarpsim inspect` does.

    Parameters
    ----------
    config, seed, model, **overrides
        The set-up's config (file, name or values), a seed and a sensor model in place of the config's, and changed keys; see
        `configure`.
    sensor : "tls" or "stereo", optional
        The sensor to plan. Default: all sensors of the config.
    out : path, optional
        Folder for the report and maps. Default: nothing is written.
    progress : "auto" or bool
        Whether progress is shown; "auto": in notebooks and on terminals.

    Returns
    -------
    Plans
        One plan per sensor.
    """
    resolved = configure(config, sensor, seed=seed, model=model, **overrides)
    sensors = [one_sensor(resolved, sensor)] if sensor else resolved.sensor_names()
    with python_progress(progress) as shown:
        result = Plans(resolved, tuple(SensorPlan(each) for each in inspect(resolved, sensors, shown)))
        if out is not None:
            result.write(out)
    return result


@dataclass(frozen=True, repr=False)
class SensorPlan:
    """Predicted performance of one sensor in front of a wall, before anything is measured.

    Attributes
    ----------
    promise : pipeline.planning.maps.Plan
        All results, as `pipeline.planning` computes them.
    """

    promise: Promise

    @property
    def maps(self) -> xarray.Dataset:
        """Maps of the predicted performance over the wall, by name, in SI units.

        Among them are smallest_block_m (side of the smallest block whose fall is detected), normal_sigma_m (standard
        deviation of a point along the surface's normal), incidence_rad (angle of incidence) and, for a scanner, range_m and
        the point spacing; `table` lists all names. Values are NaN where the sensor sees nothing; probabilities and counts are
        0 there.
        """
        raster = self.promise.raster
        return dataset({
            each.name: data_array(raster.image(each.values), raster.grid, each.name, each.title, units=each.si_unit)
            for each in self.promise.maps
        })  # fmt: skip

    @property
    def figures(self) -> dict[str, float]:
        """Single predicted numbers by name, in SI units, to compare set-ups.

        For a scanner they include seen (share of the wall that is visible), pulses (their number) and seconds_to_scan. For a
        stereo pair they include seen_by_both (share that both cameras see), overlap, and base_m (distance of the cameras).
        """
        return dict(self.promise.figures)

    @property
    def table(self) -> pandas.DataFrame:
        """Summary of the maps, one row per map: value in the middle of the wall, median, 5 % and 95 % quantile; SI units."""
        middle = self.promise.in_middle
        return frame({"map": each.name, **each.summary(middle)} for each in self.promise.maps).set_index("map")

    def summary(self) -> str:
        """Return the main predicted numbers of the sensor as lines of text."""
        return summary(self.promise)

    def plot(self, kind: str = "smallest_block_m") -> Picture:
        """Return a picture of one map of the predicted performance over the wall.

        kind: name of the map, as in `maps`: smallest_block_m, normal_sigma_m, ... Raises InputError for another name.
        """
        chosen = pick({each.name: each for each in self.promise.maps}, kind, "plot")
        return Picture(map_picture(self.promise, chosen))

    def __repr__(self) -> str:
        return f"<SensorPlan: {answer(self.promise)}>"

    def _repr_html_(self) -> str:
        return html_table(answer(self.promise), self.figures, self.plot())


@dataclass(frozen=True, repr=False)
class Plans:
    """Result of `plan`: the predicted performance of each sensor of a config.

    If a laser scanner has several stations (places where it stands), the first plan is of all together, and one of each
    follows.

    Attributes
    ----------
    config : SimulationConfig
        The config that was planned.
    plans : tuple of SensorPlan
        The plans, also available by index and iteration.
    """

    config: SimulationConfig
    plans: tuple[SensorPlan, ...]

    def __len__(self) -> int:
        return len(self.plans)

    def __getitem__(self, number: int) -> SensorPlan:
        return self.plans[number]

    def __iter__(self) -> Iterator[SensorPlan]:
        return iter(self.plans)

    def summary(self) -> str:
        """Return the main numbers of all plans as lines of text."""
        return "\n\n".join(each.summary() for each in self.plans)

    def plot(self, kind: str = "smallest_block_m") -> Picture:
        """Return a figure of one map of the first plan.

        kind: name of the map: smallest_block_m, normal_sigma_m, ... Raises InputError for another name.
        """
        return self[0].plot(kind)

    def write(self, out: Path | str) -> Path:
        """Write the report and maps that `scarpsim inspect` writes to the folder `out`; return the path of its report.html.

        Raises InputError if the folder is in use.
        """
        return write_plans(Path(out), self.config, [each.promise for each in self.plans])

    def __repr__(self) -> str:
        return f"<Plans: {', '.join(each.promise.instrument for each in self)}>"

    def _repr_html_(self) -> str:
        return "".join(each._repr_html_() for each in self.plans)
