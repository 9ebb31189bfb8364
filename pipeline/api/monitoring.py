"""Provide `monitor`, which finds what fell between real epochs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.api.configs import Show
from pipeline.api.extras import library
from pipeline.api.maps import DIFFERENCE, data_array
from pipeline.api.pictures import Picture, html_table
from pipeline.api.tables import frame
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.products import COLUMNS, Result
from pipeline.monitoring.reading import with_reference
from pipeline.monitoring.report import headline
from pipeline.monitoring.run import monitor_paths
from pipeline.monitoring.site import WallView
from pipeline.report.notebook_progress import python_progress
from pipeline.report.words import counted
from scene.common.errors import InputError

if TYPE_CHECKING:
    import geopandas
    import xarray

_VECTORS = ("position", "direction")


def monitor(
    epochs: Sequence[Path | str],
    out: Path | str,
    *,
    times: Sequence[str] = (),
    workers: int = 1,
    resume: bool = False,
    progress: Show = "auto",
    **options: Any,
) -> Monitoring:
    """Compare real epochs of a wall with the first one and list what fell, as `scarpsim monitor` does.

    Parameters
    ----------
    epochs : sequence of paths
        Scans, clouds, meshes, elevation models, folders of scans, or a run of `simulate`.
    out : path
        New folder for the products.
    times : sequence of str
        Time of each epoch, ISO 8601. Default: as the files say.
    workers : int
        Number of processes.
    resume : bool
        Continue an interrupted monitoring in `out`.
    progress : "auto" or bool
        Whether progress is shown; "auto": in notebooks and on terminals.
    **options
        Fields of `MonitorOptions`, which are otherwise found from the files. The main ones:

        - position, direction: where the sensor stood, m, and the direction along which change is measured, survey coordinates
        - views: number of parts of the wall that are mapped along directions of their own, for a wall that turns or overhangs
        - gsd_m: side of a pixel, m
        - stable: areas of stable rock, m
        - targets: file of measured targets, which replace ICP
        - unit, columns: unit of the coordinates, and columns of text files
        - scanner, model or photographs: what measured the epochs
        - detector: name or folder of a trained detector that finds the events, in place of the level of detection

    Returns
    -------
    Monitoring
        Difference maps, events and registrations of all epochs.

    Raises
    ------
    InputError
        If a file is wrong, epochs do not overlap, or an option is unknown.
    """
    unknown = sorted(set(options) - set(MonitorOptions.__dataclass_fields__))
    if unknown:
        allowed = ", ".join(MonitorOptions.__dataclass_fields__)
        raise InputError(
            f"unknown option '{unknown[0]}'", where="monitor", allowed=allowed, remedy="correct the name, or leave it out"
        )
    values: dict[str, Any] = dict(options)
    for name in _VECTORS:
        if values.get(name) is not None:
            values[name] = np.asarray(values[name], dtype=np.float64)
    paths = [Path(each) for each in epochs]
    if values.get("reference") is not None:
        values["reference"] = Path(values["reference"])
        paths = with_reference(values["reference"], paths)
    with python_progress(progress) as shown:
        found = monitor_paths(
            paths,
            Path(out),
            MonitorOptions(**values),
            times=times,
            workers=workers,
            resume=resume,
            progress=shown,
        )
    return Monitoring(found)


@dataclass(frozen=True, repr=False)
class Monitoring:
    """Result of `monitor`: what changed on a wall, with access to its maps and events as arrays and tables.

    Attributes
    ----------
    result : pipeline.monitoring.products.Result
        All results as `pipeline.monitoring` computes them: the folder, the files and times of the epochs (sources), the
        reference epoch with its frames and rasters (site), and the results of each later epoch (epochs).
    """

    result: Result

    @property
    def folder(self) -> Path:
        """Folder with the maps, tables and the report that the monitoring wrote."""
        return self.result.folder

    @property
    def differences(self) -> xarray.DataArray:
        """Difference maps of all epochs, (epoch, y, x), m: reference minus epoch along the wall's normal.

        Missing rock is positive; pixels without data are NaN. A wall that turns or overhangs is mapped in several parts
        (views), each along a direction of its own. This is the first view; see `differences_in` for the others.
        """
        return self.differences_in(1)

    def differences_in(self, view: int) -> xarray.DataArray:
        """Return the difference maps of one view of the wall, (epoch, y, x), m: reference minus epoch, NaN without data.

        view: number of the view, from 1. A view is a part of the wall that is mapped along a direction of its own; a wall
        that neither turns nor overhangs has one. Raises InputError if there is no such view.
        """
        xarray = library("xarray")
        suffix = self._view(view).suffix
        maps = [self._map("difference", f"{epoch.number:03d}{suffix}") for epoch in self.result.epochs]
        return xarray.concat(maps, dim=xarray.IndexVariable("epoch", [epoch.number for epoch in self.result.epochs]))

    @property
    def events(self) -> geopandas.GeoDataFrame:
        """Detected rockfalls and other changes, one row per event and epoch, with the columns of events.csv; SI units.

        The columns include id (one event has the same in all epochs), epoch, kind ("missing" or "added" rock), area_m2,
        depth_median_m, volume_m3 with its standard deviation volume_std_m3, first_seen_after and first_seen_by (the epochs
        between which it began), and the position in the wall frame (x_m, y_m) and in survey coordinates (world_x_m, ...). The
        geometry of a row is its outline in survey coordinates, m.
        """
        geopandas, shapely = library("geopandas"), library("shapely")
        outlines = [shapely.MultiPolygon([shapely.Polygon(ring) for ring in each]) for each in self.result.outlines()]
        crs = self.result.site.crs or None
        return geopandas.GeoDataFrame(frame(self.result.rows(), list(COLUMNS)), geometry=outlines, crs=crs)

    @property
    def registration(self) -> dict[int, dict[str, Any]]:
        """Registration of each epoch on the reference, by the epoch's number, as in monitor.json.

        The keys of each include rotation (3, 3) and translation_m (3,) in the wall frame, x_reference = rotation x_epoch +
        translation, their standard deviations, and rms_m, the RMS of the residuals on stable rock.
        """
        return {epoch.number: epoch.record.registration for epoch in self.result.epochs}

    def plot(self, epoch: int | None = None, view: int = 1) -> Picture:
        """Return the difference map of an epoch with the outlines of its events.

        epoch: its number, from 1; by default the last. view: number, from 1, of the part of the wall, if the wall turns or
        overhangs and is mapped in several parts. Raises InputError if there is no such epoch or view.
        """
        number = self.result.epochs[-1].number if epoch is None else epoch
        path = self.folder / f"map_{number:03d}{self._view(view).suffix}.png"
        if not path.is_file():
            raise InputError(
                f"there is no epoch {number}",
                where="plot",
                allowed=f"1 to {len(self.result.epochs)}",
                remedy="choose one of these epochs",
            )
        return Picture(path.read_bytes())

    def summary(self) -> str:
        """Return the result of the monitoring as text, one line per epoch."""
        return "\n".join(headline(self.result))

    def __repr__(self) -> str:
        return f"<Monitoring: {self.summary()}>"

    def _repr_html_(self) -> str:
        rows = {f"epoch {epoch.number}": counted(len(epoch.regions), "event") for epoch in self.result.epochs}
        return html_table(self.summary(), rows, self.plot())

    def _view(self, number: int) -> WallView:
        """Return the view with this number."""
        views = self.result.site.views
        if not 1 <= number <= len(views):
            allowed = f"1 to {len(views)}" if len(views) > 1 else "1: the wall has one view"
            raise InputError(
                f"there is no view {number} (a view is a direction from which the wall is mapped)",
                where="view",
                allowed=allowed,
                remedy="choose one of these views",
            )
        return views[number - 1]

    def _map(self, kind: str, place: str) -> xarray.DataArray:
        """Return a GeoTIFF of an epoch in a view as a DataArray; place: their numbers as in the file's name."""
        values, grid = read_geotiff(self.folder / f"{kind}_{place}.tif")
        return data_array(values, grid, kind, DIFFERENCE)
