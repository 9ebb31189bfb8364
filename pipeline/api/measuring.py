"""Provide `measure` and `diagnose`: load a measurement, and find out what its sensor model does not explain."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipeline.api.configs import Show, plain
from pipeline.api.monitoring import Monitoring
from pipeline.api.pictures import Picture, html_table, pick
from pipeline.api.points import Points, scatter
from pipeline.api.runs import Run
from pipeline.api.tables import boxes, frame, spread_out
from pipeline.config.presets import model_file
from pipeline.formats.measurements.config import MeasurementConfig
from pipeline.formats.measurements.measurement import (
    Material,
    assembled,
    nominal_pair,
    read_measurement,
)
from pipeline.formats.measurements.measurement import Measurement as Measured
from pipeline.formats.measurements.model_file import read_model, sensor_model
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.points import read_points
from pipeline.gap.naming import workflow
from pipeline.gap.report import figures, report
from pipeline.monitoring.recorded import is_monitoring
from pipeline.monitoring.stable_measurement import build_from_monitoring
from pipeline.report.notebook_progress import python_progress
from pipeline.run.site import prepare_site
from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh
from scene.walls.imported import read_reference
from sensors.cameras.camera import CameraPair
from sensors.laser.tls import LaserScanner
from sensors.models.sensor_model import TlsModel
from sensors.stereo.exchanged import pair_of

if TYPE_CHECKING:
    import geopandas
    import pandas

_SCALE_SIGMAS = 6.0
"""Half range of the residual plots' colour scale, in robust standard deviations (1.4826 MAD)."""


def measure(
    given: Run | Monitoring | Path | str | None = None,
    *,
    sensor: Literal["tls", "stereo"] = "tls",
    reference: Any = None,
    points: Any = None,
    model: Any = None,
    cameras: Any = None,
    **keys: Any,
) -> Measurement:
    """Load a measurement, to compare it with its sensor model by `diagnose`.

    It is read from a folder, from its parts, from a run, or from a monitoring.

    Parameters
    ----------
    given : path, Run or Monitoring, optional
        A folder with measurement.yaml; or a simulated run, whose reference epoch is compared with its true wall; or a
        monitoring by laser scanner or its folder, whose later epochs are compared with the first where the rock is stable.
        Not needed if `reference` and `points` are given.
    sensor : "tls" or "stereo"
        What measured the points: laser scanner or stereo pair.
    reference : mesh or path, optional
        The known surface, world frame, m.
    points : (n, 3) array, Points, path, or a list of them, optional
        The measured points, m; one entry of a list per epoch.
    model : model, mapping, path or name, optional
        The sensor model to test. With a run it may differ from the model that made the run. Default: the model of the run
        or the monitoring, or else the default model of the sensor.
    cameras : CameraPair or path, optional
        The nominal camera pair (stereo only).
    **keys
        Further keys of measurement.yaml: frame ("world" or "scanner": the frame of the points), scanner={"position_m":
        ..., "rotation": ...} (its pose in the world frame), pattern (start, stop and step of the scanner's angles),
        stable_areas (where nothing moved).

    Returns
    -------
    Measurement
        The points, the reference and the sensor model, checked and in the wall frame.

    Raises
    ------
    InputError
        If the parts are incomplete or do not fit together.
    """
    if isinstance(given, Run):
        return _of_run(given, model)
    if isinstance(given, Monitoring):
        return _of_monitoring(given.folder, model)
    if given is not None:
        folder = Path(given)
        return _of_monitoring(folder, model) if is_monitoring(folder) else Measurement(read_measurement(folder))
    if reference is None or points is None:
        raise InputError(
            "neither a folder nor both reference and points are given",
            where="measure",
            remedy="give the folder of a measurement, or both reference= and points=",
        )
    values = {"sensor": sensor, "reference": "reference", "points": "points", "model": "model", **plain(keys)}
    config = parse(MeasurementConfig, values, "measure")
    pair = nominal_pair(Path(cameras)) if isinstance(cameras, str | os.PathLike) else cameras
    if sensor == "stereo" and not isinstance(pair, CameraPair | None):
        raise InputError(
            f"the argument is of the type {type(pair).__name__}",
            where="cameras",
            allowed="a CameraPair, a file, or None if unknown",
            remedy="give one of them as cameras=",
        )
    mesh, notes = (reference, ()) if isinstance(reference, TriangleMesh) else read_reference(Path(reference))
    material = Material(mesh, _clouds(points), _model(model, sensor), pair if sensor == "stereo" else None, notes)
    return Measurement(assembled(config, material, "reference", "measure"))


@dataclass(frozen=True, repr=False)
class Measurement:
    """Measured points with the reference surface and the sensor model that predict them.

    Attributes
    ----------
    held : pipeline.formats.measurements.measurement.Measurement
        All parts, as the diagnosis uses them.
    """

    held: Measured

    @property
    def sensor(self) -> str:
        """The kind of sensor: "stereo" or "tls"."""
        return self.held.sensor

    @property
    def model(self) -> Any:
        """The sensor model (expected noise and errors) that the measurement is to test."""
        return self.held.model

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks about the measurement's files, such as what was left out or converted when they were read, as sentences."""
        return self.held.notes

    @property
    def points(self) -> Points:
        """The measured points, wall frame, m."""
        return Points.of(self.held.cloud)

    def plot(self) -> Picture:
        """Return a plot of the points, coloured by their z coordinate in the wall frame."""
        return self.points.plot("z")

    def __repr__(self) -> str:
        return f"<Measurement: {self.sensor}, {len(self.held.cloud.points):,} points>"

    def _repr_html_(self) -> str:
        held = self.held
        rows = {"sensor": held.sensor, "points": f"{len(held.cloud.points):,}", "epochs": int(held.epochs.max(initial=0)) + 1}
        return html_table("Measurement", rows | {"notes": "; ".join(held.notes) or "none"}, self.plot())


def diagnose(
    measurement: Measurement | Monitoring | Path | str,
    *,
    seed: int = 1,
    out: Path | str | None = None,
    progress: Show = "auto",
) -> Diagnosis:
    """Find where a measurement and its sensor model disagree and name the effects that explain it, as `scarpsim gap` does.

    Parameters
    ----------
    measurement : Measurement, Monitoring or path
        Result of `measure` or `monitor`, or the folder of a measurement or a monitoring.
    seed : int
        Seed of the simulated null distributions.
    out : path, optional
        Folder for the report and files. Default: nothing is written.
    progress : "auto" or bool
        Whether progress is shown; "auto": in notebooks and on terminals.

    Returns
    -------
    Diagnosis
        The verdict, the named effects, and the gap before and after they are added to the model.
    """
    measured = measurement if isinstance(measurement, Measurement) else measure(measurement)
    steps = iter(workflow.STEPS)
    with python_progress(progress) as shown, ExitStack() as stage:

        def begin_next(_done: str = "") -> None:
            stage.close()
            step = next(steps, None)
            if step is not None:
                stage.enter_context(shown.stage(step))

        shown.plan(workflow.STEPS)
        begin_next()
        result = Diagnosis(workflow.diagnose(measured.held, seed, begin_next), measured)
    if out is not None:
        result.write(out)
    return result


@dataclass(frozen=True, repr=False)
class Diagnosis:
    """Result of `diagnose`.

    Attributes
    ----------
    found : GapDiagnosis
        All results, as `pipeline.gap` computes them.
    measurement : Measurement
        The measurement that was diagnosed.
    """

    found: workflow.GapDiagnosis
    measurement: Measurement

    @property
    def verdict(self) -> str:
        """The result in a word.

        One of named (one effect explains the disagreement), several (more than one does), ambiguous (one of some effects that
        the data cannot tell apart), unknown (no known effect explains it), no_gap (sensor model and measurement agree) and
        insufficient_data.
        """
        return self.found.verdict

    @property
    def effects(self) -> pandas.DataFrame:
        """Effects that explain why measurement and sensor model disagree.

        One row per parameter of each effect, SI units. The columns are effect and parameter (names), value (fitted), std (its
        standard deviation), kind ("physical", or "empirical" if its cause is unknown), cannot_be_told_from (effects that
        explain the data as well), split_by (a further measurement that would tell them apart) and p_value (of the effect).
        """
        rows = []
        for each in self.found.effects:
            held = each.to_dict()
            shared = {name: held[name] for name in ("kind", "cannot_be_told_from", "split_by", "p_value")}
            rows += [{"effect": each.name, "parameter": name, **value, **shared} for name, value in held["parameters"].items()]
        columns = ("effect", "parameter", "value", "std", "kind", "cannot_be_told_from", "split_by", "p_value")
        return frame(rows, columns)

    @property
    def changes(self) -> geopandas.GeoDataFrame:
        """Regions where the rock itself changed between reference and measurement, one row each.

        The columns are volume_m3, volume_std_m3 (its standard deviation), offset_m (median change of range, positive where rock
        is missing) and the position in the world (world_x_m, ...). The geometry is the bounding rectangle, wall frame, m.
        """
        rows, bounds = [], []
        for each in self.found.changes:
            world = self.measurement.held.frame.to_world(each.corners.mean(axis=0))
            size = {"volume_m3": each.volume_m3, "volume_std_m3": each.volume_std_m3, "offset_m": each.offset_m}
            rows.append({**size, **spread_out("world", world.tolist())})
            bounds.append([*each.bounds[0, :2], *each.bounds[1, :2]])
        return boxes(rows, bounds, ("volume_m3", "volume_std_m3", "offset_m", "world_x_m", "world_y_m", "world_z_m"))

    @property
    def residuals(self) -> Points:
        """The compared points, wall frame, with their residuals: measured minus predicted depth.

        The channels are before_m and after_m (without and with the named effects in the prediction) and held_out (whether the
        point was kept from the fit, for validation).
        """
        found, cloud = self.found, self.measurement.held.cloud
        depth, index = found.residuals.depth_m, found.residuals.index
        channels = {"before_m": found.before * depth, "after_m": found.after * depth, "held_out": found.held_out}
        return Points.of(PointCloud(cloud.points[index], extra=channels))

    @property
    def model_after(self) -> Any:
        """The sensor model with the named effects, for `simulate(config, model=diagnosis.model_after)`."""
        return self.found.model_after

    @property
    def gap(self) -> dict[str, Any] | None:
        """How much worse the measurement fits the sensor model than it should, on points that the fit did not use.

        The keys include before and after (the misfit without and with the named effects in the model), floor (the misfit that
        data simulated from the model itself have), unit (of these numbers), and closed (share of the gap that the effects
        explain). None if it was not measured.
        """
        return self.found.gap.to_dict() if self.found.gap else None

    def to_dict(self) -> dict[str, Any]:
        """Return all results of the diagnosis as in gap.json, in JSON types."""
        return report.to_dict(self.found, self.measurement.held)

    def summary(self) -> str:
        """Return the result of the diagnosis, with the named effects, as a few lines of text."""
        return report.summarise(self.found)

    def plot(self, kind: str = "maps") -> Picture:
        """Return a figure of the report by its name, or a map of the residuals over the wall.

        kind: a figure of the report, which is maps (mean and standard deviation of the residuals over the wall), profiles
        (both over range and other quantities), gap (how much of the gap the named effects close) or identifiability (which
        effects the measurement can tell apart); or before or after, for the residuals without or with the named effects in
        the prediction.
        """
        if kind in ("before", "after"):
            points = self.residuals
            scale = 1.4826 * float(np.median(np.abs(points["after_m"] - np.median(points["after_m"]))))
            return scatter(points.xyz[:, :2], points[f"{kind}_m"], f"residual {kind}, m", max(_SCALE_SIGMAS * scale, 1e-6))
        return Picture(pick(self._drawn(), kind, "plot")())

    def _drawn(self) -> dict[str, Callable[[], bytes]]:
        """Return the functions that draw the report's figures, by name, without those that this diagnosis has no data for."""
        found, table = self.found, self.found.identifiability
        drawn: dict[str, Callable[[], bytes]] = {}
        if len(found.residuals):
            drawn |= {"maps": lambda: figures.maps_figure(found), "profiles": lambda: figures.profiles_figure(found)}
        if found.gap is not None:
            drawn["gap"] = partial(figures.gap_figure, found.gap)
        if table["names"]:
            cosines, survival = (np.array(table[name], dtype=np.float64) for name in ("cosines", "survival"))
            drawn["identifiability"] = lambda: figures.matrix_figure(table["names"], np.abs(cosines), survival)
        return drawn

    def write(self, out: Path | str) -> Path:
        """Write the report and files that `scarpsim gap` writes to the folder `out`; return the path of its report.html."""
        return report.write_report(Path(out), self.found, self.measurement.held)

    def __repr__(self) -> str:
        return f"<Diagnosis: {self.verdict}, {len(self.found.effects)} effects>"

    def _repr_html_(self) -> str:
        rows = {str(number): line for number, line in enumerate(self.summary().splitlines(), start=1)}
        return html_table(f"Diagnosis: {self.verdict}", rows, self.plot() if len(self.found.residuals) else None)


def _of_run(run: Run, model: Any) -> Measurement:
    """Return the reference epoch of a run as a measurement of the run's own wall."""
    site = prepare_site(run.config, run.sensor, KeyedRandom(run.config.seed))
    if site.further_stations:
        raise InputError(
            "the run has several scanner stations, but a measurement has one",
            where=str(run.folder),
            remedy="give reference, points and scanner of one station",
        )
    world = site.mesh.with_vertices(site.frame.to_world(site.mesh.vertices))
    cloud = run[0].points.cloud()
    points = replace(cloud, points=site.frame.to_world(cloud.points), extra={})
    if not isinstance(site.sensor, LaserScanner):
        believed, cameras = model or run.config.stereo_model(), pair_of(site.sensor).cameras
        return measure(sensor="stereo", reference=world, points=points, model=believed, cameras=cameras)
    position, rotation = site.frame.to_world(site.sensor.position), site.frame.rotation.T @ site.sensor.rotation
    scanner, believed = {"position_m": position, "rotation": rotation}, model or run.config.tls_model()
    return measure(sensor="tls", reference=world, points=points, model=believed, scanner=scanner)


def _of_monitoring(folder: Path, model: Any) -> Measurement:
    """Return the points of a monitoring's later epochs on stable rock as a measurement of its first epoch's surface."""
    believed = None if model is None else _model(model, "tls")
    if not isinstance(believed, TlsModel | None):
        raise InputError(
            "the model is of a stereo pair, but the points come from a laser scanner",
            where="model",
            allowed="the model of a laser scanner",
            remedy='give one as model=, such as {"sensor": "tls", ...}, or None for that of the monitoring',
        )
    with tempfile.TemporaryDirectory(prefix="scarpsim_stable_") as written:
        build_from_monitoring(folder, Path(written), model=believed)
        return Measurement(read_measurement(Path(written)))


def _clouds(points: Any) -> dict[str, PointCloud]:
    """Return the point clouds, keyed by the name that error messages use."""
    several = points if isinstance(points, list | tuple) else [points]
    if not several:
        raise InputError("no points are given", where="measure", remedy="give an array, Points or a file")
    found = {}
    for number, each in enumerate(several, start=1):
        if isinstance(each, str | os.PathLike):
            found[str(each)] = read_points(Path(each))
            continue
        name = f"points {number}" if len(several) > 1 else "points"
        if isinstance(each, PointCloud):
            found[name] = each
            continue
        if isinstance(each, Points):
            found[name] = each.cloud()
            continue
        array = np.asarray(each, dtype=np.float64)
        if array.ndim != 2 or array.shape[1] != 3 or not len(array):
            raise InputError(
                f"the array has the shape {array.shape}", where=name, allowed="(n, 3)", remedy="give an array of rows x, y, z"
            )
        found[name] = PointCloud(array)
    return found


def _model(model: Any, sensor: str) -> Any:
    """Return a sensor model from a file, a bundled name, a mapping or a model."""
    if isinstance(model, str | os.PathLike):
        return read_model(model_file(os.fspath(model)))
    values = plain(model) if model is not None else {}
    return sensor_model({"sensor": sensor, **values} if isinstance(values, Mapping) else values, "model")
