"""`plan`: what a set-up promises before anything is simulated."""

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
    """Map precision, spacing, blind spots and the smallest block of a set-up; the same as `scarpsim inspect`.

    config, model, overrides: as `configure` takes them; sensor: none: all of the config; out: a folder for report and maps, none:
    nothing is written.
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
    """What one sensor promises. promise: everything, as `pipeline.planning` has it."""

    promise: Promise

    @property
    def maps(self) -> xarray.Dataset:
        """All maps by name (smallest_block_m, normal_sigma_m, incidence_rad, ...), SI, NaN where nothing is seen."""
        raster = self.promise.raster
        return dataset({
            each.name: data_array(raster.image(each.values), raster.grid, each.name, each.title, units=each.si_unit)
            for each in self.promise.maps
        })  # fmt: skip

    @property
    def figures(self) -> dict[str, float]:
        """Single numbers by name: share of the wall seen, pulses, seconds_to_scan, base_m, ...; SI."""
        return dict(self.promise.figures)

    @property
    def table(self) -> pandas.DataFrame:
        """A row for each map: its value in the middle of the wall, median, 5 and 95 % quantile; SI."""
        middle = self.promise.in_middle
        return frame({"map": each.name, **each.summary(middle)} for each in self.promise.maps).set_index("map")

    def summary(self) -> str:
        """The figures as lines of text."""
        return summary(self.promise)

    def plot(self, kind: str = "smallest_block_m") -> Picture:
        """A picture of a map, by its name."""
        chosen = pick({each.name: each for each in self.promise.maps}, kind, "plot")
        return Picture(map_picture(self.promise, chosen))

    def __repr__(self) -> str:
        return f"<SensorPlan: {answer(self.promise)}>"

    def _repr_html_(self) -> str:
        return html_table(answer(self.promise), self.figures, self.plot())


@dataclass(frozen=True, repr=False)
class Plans:
    """The plans of a config's sensors; of several stations first all together, then each."""

    config: SimulationConfig
    plans: tuple[SensorPlan, ...]

    def __len__(self) -> int:
        return len(self.plans)

    def __getitem__(self, number: int) -> SensorPlan:
        return self.plans[number]

    def __iter__(self) -> Iterator[SensorPlan]:
        return iter(self.plans)

    def summary(self) -> str:
        """The figures as lines of text."""
        return "\n\n".join(each.summary() for each in self.plans)

    def plot(self, kind: str = "smallest_block_m") -> Picture:
        """A picture of the first plan."""
        return self[0].plot(kind)

    def write(self, out: Path | str) -> Path:
        """Write the folder that `scarpsim inspect` fills; returns its report.html. InputError where it is in use."""
        return write_plans(Path(out), self.config, [each.promise for each in self.plans])

    def __repr__(self) -> str:
        return f"<Plans: {', '.join(each.promise.instrument for each in self)}>"

    def _repr_html_(self) -> str:
        return "".join(each._repr_html_() for each in self.plans)
