"""Provide `plan_series`, which predicts what a time series of epochs will show."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.api.configs import ConfigLike, Show, configure, one_sensor
from pipeline.api.pictures import Picture, html_table, pick
from pipeline.api.tables import frame
from pipeline.config.simulation import SensorName, SimulationConfig
from pipeline.planning import series as planning
from pipeline.planning.series_report import series_part, series_summary
from pipeline.report.notebook_progress import python_progress
from scene.common.errors import InputError

if TYPE_CHECKING:
    import pandas


def plan_series(
    config: ConfigLike = None,
    sensor: SensorName | None = None,
    *,
    seed: int | None = None,
    model: Any = None,
    progress: Show = "auto",
    **overrides: Any,
) -> SeriesPlans:
    """Predict the smallest rockfall and the lead times that a series of epochs will show, as `scarpsim inspect --series` does.

    Trial epochs are simulated for this, which takes minutes.

    Parameters
    ----------
    config, seed, model, **overrides
        The config (file, name or values), with a section `series`, a seed and a sensor model in place of the config's, and
        changed keys; see `configure`.
    sensor : "tls" or "stereo", optional
        The sensor. Default: all sensors of the config.
    progress : "auto" or bool
        Whether progress is shown; "auto": in notebooks and on terminals.

    Returns
    -------
    SeriesPlans
        One prediction per sensor.

    Raises
    ------
    InputError
        If the config has no series of rockfalls, or if the sensor sees too little of the wall.
    """
    resolved = configure(config, sensor, seed=seed, model=model, **overrides)
    sensors = [one_sensor(resolved, sensor)] if sensor else resolved.sensor_names()
    with python_progress(progress) as shown:
        found = tuple(SeriesForecast(planning.plan_series(resolved, each, shown)) for each in sensors)
    return SeriesPlans(resolved, found)


@dataclass(frozen=True, repr=False)
class SeriesForecast:
    """What `monitor` is predicted to find in a time series that one sensor measures.

    Attributes
    ----------
    promise : pipeline.planning.series.SeriesPlan
        All results, as `pipeline.planning` computes them.
    """

    promise: planning.SeriesPlan

    @property
    def smallest(self) -> pandas.DataFrame:
        """Smallest rockfall that `monitor` lists in 95 % of cases, to judge a planned time series.

        One row per number of scans that are joined to one epoch. Columns are volume_m3, the ends low_m3 and high_m3 of its 95
        % confidence interval, and level_of_detection_m.
        """
        rows = []
        for each in self.promise.promises:
            value, low, high = each.missing.volume_m3()
            rows.append({
                "scans": each.scans,
                "volume_m3": value,
                "low_m3": low,
                "high_m3": high,
                "level_of_detection_m": each.level_m,
            })  # fmt: skip
        return frame(rows).set_index("scans")

    @property
    def leads(self) -> pandas.DataFrame:
        """How early `monitor` notices a moving block before it falls, to choose the interval of epochs.

        One row for each combination of scans (joined to one epoch), volume_m3 (of the block) and every_h (interval of
        epochs). Further columns are shows_from_m (the displacement that is listed in 95 % of cases), lead_h_95 (the lead time
        that is reached in 95 % of cases) and lead_h_median; a lead of 0 means that the block is not noticed before its fall.
        """
        return frame(
            {
                "scans": each.scans,
                "volume_m3": volume,
                "every_h": every,
                "shows_from_m": each.moved.displacement_m(volume)[0],
                **dict(zip(("lead_h_95", "lead_h_median"), self.promise.lead_h(volume, every, each), strict=True)),
            }
            for each in self.promise.promises
            for volume in self.promise.volumes_m3
            for every in self.promise.schedules_h
        )

    def probability(self, volume_m3: float, moved_m: float | None = None, *, scans: int = 1) -> float:
        """Return the probability that `monitor` lists a change: of rock that fell, or of a block that has moved.

        volume_m3: volume of the rock, m3. moved_m: how far the block has moved, m; None: it fell. scans: number of scans that
        are joined to one epoch, 1 or 4. Raises InputError for another number.
        """
        promises = {each.scans: each for each in self.promise.promises}
        if scans not in promises:
            raise InputError(
                f"the number of scans in an epoch is {scans}",
                where="scans",
                allowed=", ".join(map(str, promises)),
                remedy="choose one of these numbers of scans",
            )
        law = promises[scans].missing if moved_m is None else promises[scans].moved
        return float(law.probability(np.array([volume_m3]), 1.0 if moved_m is None else moved_m)[0])

    def summary(self) -> str:
        """Return the main predictions as lines of text."""
        return series_summary(self.promise)

    def plot(self, kind: str = "curves") -> Picture:
        """Return the figure of the probability of detection by volume and by displacement.

        kind: "curves", the only one. Raises InputError for another name.
        """
        return Picture(pick({"curves": series_part(self.promise)}, kind, "plot").curves)

    def __repr__(self) -> str:
        volume = self.promise.promises[0].missing.volume_m3()[0]
        return f"<SeriesForecast: {self.promise.sensor}, rockfalls from {volume:.3g} m3 on>"

    def _repr_html_(self) -> str:
        part = series_part(self.promise)
        rows = {str(number): sentence for number, sentence in enumerate(part.sentences, start=1)}
        return html_table(part.title, rows, Picture(part.curves))


@dataclass(frozen=True, repr=False)
class SeriesPlans:
    """Result of `plan_series`: the prediction for each sensor of a config.

    Attributes
    ----------
    config : SimulationConfig
        The config that was planned.
    plans : tuple of SeriesForecast
        The predictions, also available by index and iteration.
    """

    config: SimulationConfig
    plans: tuple[SeriesForecast, ...]

    def __len__(self) -> int:
        return len(self.plans)

    def __getitem__(self, number: int) -> SeriesForecast:
        return self.plans[number]

    def __iter__(self) -> Iterator[SeriesForecast]:
        return iter(self.plans)

    def summary(self) -> str:
        """Return what the series would show with each sensor, as lines of text.

        They state from which volume on a rockfall is listed in 95 % of cases, and how long before its fall a moving block is.
        """
        return "\n\n".join(each.summary() for each in self.plans)

    def plot(self, kind: str = "curves") -> Picture:
        """Return the figure of the probability of detection of the first sensor.

        kind: "curves", the only one. Raises InputError for another name.
        """
        return self[0].plot(kind)

    def __repr__(self) -> str:
        return f"<SeriesPlans: {', '.join(each.promise.sensor for each in self)}>"

    def _repr_html_(self) -> str:
        return "".join(each._repr_html_() for each in self.plans)
