"""Provide `calibrate`, which fits a sensor's noise parameters to measured epochs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.api.configs import ConfigLike, Show, configure, paths
from pipeline.api.maps import data_array
from pipeline.api.pictures import Picture, html_table, pick
from pipeline.api.tables import frame_of
from pipeline.calibration import calibrate as fitting
from pipeline.calibration.inputs import config_of, sensor_of
from pipeline.calibration.report import pictures, summary, warnings
from pipeline.calibration.write import write
from pipeline.config.simulation import SensorName
from pipeline.report.notebook_progress import python_progress

if TYPE_CHECKING:
    import pandas
    import xarray


def calibrate(
    measured: Any,
    config: ConfigLike = None,
    sensor: SensorName | None = None,
    *,
    greedy: bool = False,
    out: Path | str | None = None,
    seed: int | None = None,
    model: Any = None,
    progress: Show = "auto",
    **overrides: Any,
) -> Calibration:
    """Fit the noise of a sensor model to measured epochs, as `scarpsim calibrate` does.

    Parameters
    ----------
    measured : path, Run, or a list of them
        The measured epochs: a folder with measurement.yaml, a folder with difference maps, difference maps
        (GeoTIFF), or a run.
    config : optional
        The config of the site to simulate (file, name or values); see `configure`. Default: the config of a run among
        `measured`, or else the demo.
    sensor : "tls" or "stereo", optional
        The sensor that measured. Default: as the inputs say.
    greedy : bool
        Also run a simple search, which lowers one parameter at a time, for comparison.
    out : path, optional
        Folder for the report and files. Default: nothing is written.
    seed, model, **overrides
        A seed and a sensor model in place of the config's, and changed keys; see `configure`.
    progress : "auto" or bool
        Whether progress is shown; "auto": in notebooks and on terminals.

    Returns
    -------
    Calibration
        The fitted parameters with their confidence intervals.
    """
    inputs = paths(measured)
    given = config_of(inputs) if config is None else config
    resolved = configure(given, sensor, seed=seed, model=model, **overrides)
    which = sensor_of(inputs, resolved, sensor)
    with python_progress(progress) as shown:
        result = Calibration(fitting.calibrate(resolved, which, inputs, shown, with_greedy=greedy), tuple(inputs))
        if out is not None:
            result.write(out)
    return result


@dataclass(frozen=True, repr=False)
class Calibration:
    """Result of `calibrate`: the fitted noise of a sensor.

    Attributes
    ----------
    figures : CalibrationResult
        All results, as `pipeline.calibration` computes them.
    inputs : tuple of Path
        The files and folders that the noise was fitted to.
    """

    figures: fitting.CalibrationResult
    inputs: tuple[Path, ...]

    @property
    def model(self) -> Any:
        """The sensor model with the fitted noise, for `simulate(config, model=calibration.model)`."""
        return self.figures.model

    @property
    def parameters(self) -> pandas.DataFrame:
        """The fitted noise of the sensor, one row per parameter, such as range_sigma_m.

        The columns are value, and low and high, the ends of its confidence interval (95 % unless the config says otherwise),
        in the unit with which the parameter's name ends.
        """
        found = self.figures.found
        values = {name: np.exp(each) for name, each in (("value", found.x), ("low", found.low), ("high", found.high))}
        return frame_of(values, self.figures.parameters.names, "parameter")

    @property
    def systematic(self) -> xarray.DataArray:
        """Mean of the measured difference maps, (y, x), m.

        It contains what all epochs share: systematic errors of the sensor, and errors of the reference.
        """
        return data_array(self.figures.systematic, self.figures.inputs.grid, "systematic", "mean of the measured maps")

    @property
    def warnings(self) -> list[str]:
        """Limitations of the calibration to know before its values are used, as sentences."""
        return warnings(self.figures)

    def summary(self) -> str:
        """Return the fitted noise of the sensor as a few lines of text."""
        return summary(self.figures)

    def plot(self, kind: str = "windows") -> Picture:
        """Return a figure of the report by its name.

        kind: windows (the last measured and a simulated map in the square parts that were compared), measured (the last
        measured map), systematic (the mean of all), distribution (of the differences), statistics (measured over expected
        ones) or epochs (median and noise of each). Raises InputError for another name.
        """
        return Picture(pick({name: png for name, _, png in pictures(self.figures, None)}, kind, "plot"))

    def write(self, out: Path | str) -> Path:
        """Write the report and files that `scarpsim calibrate` writes to the folder `out`; return the path of its report.html.

        Raises InputError if the folder is in use.
        """
        return write(Path(out), self.figures.config, self.figures, self.inputs)

    def __repr__(self) -> str:
        return f"<Calibration of a {self.figures.sensor} sensor: {', '.join(self.figures.parameters.names)}>"

    def _repr_html_(self) -> str:
        table = self.parameters
        rows = {name: f"{row.value:.4g} ({row.low:.4g} to {row.high:.4g})" for name, row in table.iterrows()}
        notes = {"note": " ".join(self.warnings)} if self.warnings else {}
        return html_table("Calibrated noise", rows | notes, self.plot())
