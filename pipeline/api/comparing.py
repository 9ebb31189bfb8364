"""Provide `compare`, which simulates several sensors in front of one wall."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.api.configs import Show, configure, keywords, paths
from pipeline.api.maps import DIFFERENCE, data_array, dataset
from pipeline.api.pictures import Picture, html_table, pick
from pipeline.api.tables import frame
from pipeline.comparison.assess import SensorAssessment
from pipeline.comparison.comparison import ComparisonResult as Figures
from pipeline.comparison.comparison import compare_sensors
from pipeline.comparison.report import answer, pictures, summary, write_comparison
from pipeline.comparison.sensor_setups import Given, sensor_setups
from pipeline.config.simulation import SimulationConfig
from pipeline.report.notebook_progress import python_progress
from scene.common.errors import InputError, nearest

if TYPE_CHECKING:
    import pandas
    import xarray


def compare(
    *sensors: Any,
    epochs: int = 6,
    sizes_m: tuple[float, float] | None = (0.05, 0.8),
    measured: Sequence[Path | str] = (),
    own_step: bool = False,
    out: Path | str | None = None,
    seed: int | None = None,
    progress: Show = "auto",
    **overrides: Any,
) -> Comparison:
    """Compare sensors on the first one's wall with the same blocks, as `scarpsim compare` does.

    Parameters
    ----------
    *sensors : config, path, name, Run, or one mapping of names to these
        The sensors. Each is a config (its values, its file or a bundled site's name), a run, the name of a scanner
        ("riegl_vz400i"), or a noise model (file or name). A config with both kinds of sensor counts as two.
    epochs : int
        Number of epochs with rockfall.
    sizes_m : (float, float) or None
        Block size in the first and in the last epoch, m. None: the blocks of the config.
    measured : sequence of paths
        Folders of measured epochs to show next to the simulated ones.
    own_step : bool
        Let scanner presets use their own angular step. Otherwise all use the step of the first config.
    out : path, optional
        Folder for the report and files. Default: nothing is written.
    seed : int, optional
        Seed of all random numbers. Default: the first config's.
    progress : "auto" or bool
        Whether progress is shown; "auto": in notebooks and on terminals.
    **overrides
        Changes to every config; see `configure`.

    Returns
    -------
    Comparison
        Noise, level of detection and detected blocks of each sensor.
    """
    given = _given(sensors, seed, overrides)
    found = sensor_setups(given, keywords(overrides), seed, own_step=own_step)
    with python_progress(progress) as shown:
        result = Comparison(compare_sensors(found, paths(list(measured)), epochs, sizes_m, shown))
        if out is not None:
            result.write(out)
    return result


@dataclass(frozen=True, repr=False)
class Comparison:
    """Result of `compare`: several sensors, each observing the same wall with the same blocks.

    Attributes
    ----------
    figures : ComparedSensors
        All results, as `pipeline.comparison` computes them.
    """

    figures: Figures

    @property
    def names(self) -> list[str]:
        """Names of the compared sensors, in the order in which they were given."""
        return [each.name for each in self.figures.found]

    @property
    def table(self) -> pandas.DataFrame:
        """Main results of the compared sensors, one row per sensor, indexed by name; SI units.

        The columns include nmad_m (noise over stable ground), level_of_detection_m (median of the wall), smallest_block_m
        (size from which 95 % of the blocks are detected), blocks_in_view and blocks_seen (numbers of blocks in the sensor's
        view, and of those detected), visible (share of the wall that the sensor can see) and complete (share of the map with
        data).
        """
        return frame(map(_row, self.figures.found)).set_index("name")

    @property
    def blocks(self) -> pandas.DataFrame:
        """All fallen blocks, one row per block and sensor; SI units.

        The columns include size_m, in_view (whether the sensor saw at least half of its place before it fell), seen (whether
        it was detected), volume_m3 (true) and measured_volume_m3.
        """
        found = self.figures.found
        return frame({"sensor": each.name, **block.to_dict()} for each in found for block in each.detection.blocks)

    def differences(self, sensor: str) -> xarray.DataArray:
        """Return the difference maps of one of the sensors, (epoch, y, x), m; NaN without data.

        They are reference minus epoch. sensor: its name, as in `names`.
        """
        trial = self.figures.trial
        if sensor not in self.names:
            raise InputError(
                f"the comparison has no sensor '{sensor}'",
                where="compare",
                allowed=", ".join(self.names),
                remedy=nearest(sensor, self.names) or "choose one of these names",
            )
        changes = trial.seen[self.names.index(sensor)].changes
        return data_array(changes, trial.grid, "difference", DIFFERENCE)

    @property
    def level_of_detection(self) -> xarray.Dataset:
        """Level of detection at each pixel of the wall: the change that noise alone exceeds in 5 % of cases, m.

        One variable per sensor, by its name: a map (y, x).
        """
        grid = self.figures.trial.grid
        return dataset({
            each.name: data_array(each.noise.level, grid, each.name, "95 % level of detection") for each in self.figures.found
        })  # fmt: skip

    def summary(self) -> str:
        """Return the main results of the comparison of sensors as lines of text."""
        return summary(self.figures)

    def plot(self, kind: str = "maps") -> Picture:
        """Return a figure of the report by its name.

        kind: maps (difference maps), level_of_detection, noise, by_covariate (noise over incidence angle, range and the like),
        detection (share of blocks detected over size and depth, and errors of their volumes) or size_and_depth (that share as a
        table).
        """
        drawn = pictures(self.figures)
        return Picture(pick({name.removesuffix(".png"): png for name, png in drawn.items()}, kind, "plot"))

    def write(self, out: Path | str) -> Path:
        """Write the report and files that `scarpsim compare` writes to the folder `out`; return the path of its report.html.

        Raises InputError if the folder is in use.
        """
        return write_comparison(Path(out), self.figures)

    def __repr__(self) -> str:
        return f"<Comparison of {', '.join(self.names)}>"

    def _repr_html_(self) -> str:
        return html_table("Sensors compared", {each.name: answer(each) for each in self.figures.found}, self.plot())


def _given(sensors: Sequence[Any], seed: int | None, overrides: Mapping[str, Any]) -> list[Given]:
    """Turn the arguments of `compare` into what `sensor_setups` takes.

    They become names of files and presets, or pairs of a name and a config.
    """
    if not sensors:
        raise InputError("no sensor is given", where="compare", remedy='write for example compare("glendale", "riegl_vz400i")')
    only = sensors[0]
    if len(sensors) == 1 and isinstance(only, Mapping) and not set(only) & set(SimulationConfig.model_fields):
        named = [(str(name), each) for name, each in only.items()]
    else:
        named = [("site", each) for each in sensors]
    return [
        (name, configure(each, seed=seed, **overrides)) if isinstance(each, SimulationConfig | Mapping) else str(paths(each)[0])
        for name, each in named
    ]


def _row(found: SensorAssessment) -> dict[str, Any]:
    """Return one sensor's row of `Comparison.table`."""
    curve, blocks = found.detection.by_size, found.detection.blocks
    return {
        "name": found.name,
        "sensor": found.sensor,
        "points": found.points,
        "nmad_m": found.noise.stable.nmad,
        "median_m": found.noise.stable.median,
        "rmse_m": found.noise.stable.rmse,
        "level_of_detection_m": found.noise.median_level_m,
        "smallest_block_m": None if curve is None else curve.smallest_95_m,
        "blocks_in_view": sum(block.in_view for block in blocks),
        "blocks_seen": sum(block.seen for block in blocks),
        "visible": found.visible,
        "complete": found.complete,
        "scan_s": found.scan_seconds,
        "registration_rms_m": found.registration_rms_m,
    }
