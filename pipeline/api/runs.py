"""Provide `simulate` and `open_run`, which give a run's results as a `Run`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.api.configs import ConfigLike, Show, configure, one_sensor
from pipeline.api.maps import DIFFERENCE, data_array
from pipeline.api.meshes import Mesh
from pipeline.api.pictures import Picture, html_table, pick
from pipeline.api.points import Points
from pipeline.api.tables import boxes, frame, spread_out
from pipeline.config.simulation import SensorName, SimulationConfig, load_config
from pipeline.formats.files.atomic import new_folder
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.formats.records.result_records import RUN_FILE, read_annotations
from pipeline.formats.records.run_files import RunFiles, epoch_folder
from pipeline.report.notebook_progress import python_progress
from pipeline.report.page import millimetres
from pipeline.report.words import counted
from scene.common.errors import InputError
from scene.geometry.frame import WallFrame

if TYPE_CHECKING:
    import geopandas
    import pandas
    import xarray

PICTURES = ("difference", "blocks", "hillshade", "histogram", "icp", "m3c2")
"""Names of an epoch's figures in the report."""
_COLUMNS = (
    "epoch", "block", "shape", "size_x_m", "size_y_m", "size_z_m", "volume_m3", "measured_volume_m3", "measured_area_m2",
    "measured_mean_depth_m", "position_x_m", "position_y_m", "position_z_m", "world_x_m", "world_y_m", "world_z_m", "annotated",
)  # fmt: skip
"""Columns of `Run.blocks`, in order."""


def simulate(
    config: ConfigLike = None,
    sensor: SensorName | None = None,
    *,
    out: Path | str | None = None,
    seed: int | None = None,
    model: Any = None,
    resume: bool = False,
    progress: Show = "auto",
    **overrides: Any,
) -> Run:
    """Simulate how a sensor observes a wall before and after rockfall, as the command `simulate` does.

    Parameters
    ----------
    config, seed, model, **overrides
        The site's config (file, name or values), a seed and a sensor model in place of the config's, and changed keys; see
        `configure`.
    sensor : "tls" or "stereo", optional
        The sensor. May be omitted if the config has a model of only one.
    out : path, optional
        Folder of the run. Default: a new one under runs/.
    resume : bool
        Continue the interrupted run in `out`.
    progress : "auto" or bool
        Whether progress is shown; "auto": in notebooks and on terminals.

    Returns
    -------
    Run
        The finished run.
    """
    from pipeline.run import simulation

    resolved = configure(config, sensor, seed=seed, model=model, **overrides)
    which = one_sensor(resolved, sensor or (getattr(model, "sensor", None)))
    folder = Path(out) if out is not None else new_folder(Path("runs"), which)
    with python_progress(progress) as shown:
        return Run(simulation.simulate(resolved, which, folder, resume=resume, progress=shown).folder)


def open_run(folder: Path | str) -> Run:
    """Open a finished or interrupted run by its folder. Raises InputError if the folder has no run."""
    run = Run(Path(folder))
    if "wall_frame" not in run.record:
        raise InputError(
            "the run has not finished an epoch", where=str(folder), remedy="continue with simulate(..., resume=True)"
        )
    return run


@dataclass(frozen=True, repr=False)
class Run:
    """A run on disk, whose files are read when they are needed.

    `run[0]` is the reference epoch, `run[1]` the first after rockfall.

    Attributes
    ----------
    folder : Path
        Folder of the run.
    """

    folder: Path

    @cached_property
    def _files(self) -> RunFiles:
        if not (self.folder / RUN_FILE).exists():
            raise InputError(
                f"this is not the folder of a run, because it contains no {RUN_FILE}",
                where=str(self.folder),
                remedy="give the folder that scarpsim simulate wrote",
            )
        return RunFiles(self.folder)

    @property
    def record(self) -> dict[str, Any]:
        """Content of run.json, which describes the run: its config, versions and results."""
        return self._files.record

    @cached_property
    def config(self) -> SimulationConfig:
        """The complete config with which the run was simulated."""
        return load_config(self.folder / RUN_FILE, [], None, None)

    @property
    def sensor(self) -> SensorName:
        """The kind of sensor that the run simulated: "stereo" or "tls" (laser scanner)."""
        return "stereo" if self.record["sensor"] == "stereo" else "tls"

    @property
    def report(self) -> Path:
        """Path of the run's report.html."""
        return self.folder / "report.html"

    @cached_property
    def frame(self) -> WallFrame:
        """The run's wall frame, which converts points (..., 3), m, with `to_world(points)` and `to_wall(points)`."""
        held = self.record["wall_frame"]
        return WallFrame(np.array(held["rotation"]), np.array(held["origin_m"]))

    @property
    def annotations(self) -> dict[str, Any]:
        """The fallen blocks in the run's difference maps, in COCO format: content of annotations.json."""
        return read_annotations(self.folder / "annotations.json")

    @property
    def epochs(self) -> list[Epoch]:
        """The epochs of the run after the reference."""
        return [Epoch(self, int(record["epoch"])) for record in self.record["epochs"][1:]]

    def __len__(self) -> int:
        """Return the number of epochs, including the reference."""
        return len(self.record["epochs"])

    def __getitem__(self, number: int) -> Epoch:
        if not 0 <= number < len(self):
            raise IndexError(f"epoch {number}: the run has 0, the reference, to {len(self) - 1}")
        return Epoch(self, number)

    @property
    def differences(self) -> xarray.DataArray:
        """Difference maps of all epochs of the run, (epoch, y, x) float32, m: reference minus epoch, NaN without data."""
        maps, grids = zip(*(read_geotiff(each.file("difference", ".tif")) for each in self.epochs), strict=True)
        return data_array(np.stack(maps), grids[0], "difference", DIFFERENCE, frame=self.frame)

    @property
    def blocks(self) -> geopandas.GeoDataFrame:
        """The fallen blocks of all epochs of the run, one row each, with their true and measured sizes; see `Epoch.blocks`."""
        return _blocks(self.epochs)

    @property
    def statistics(self) -> pandas.DataFrame:
        """Noise of the run, one row per epoch.

        The columns are statistics of the difference map outside the fallen blocks (count, median_m, nmad_m, ...) and
        registration_rms_m (RMS of the residuals of the epoch's registration).
        """
        return frame(each.statistics for each in self.epochs)

    def plot(self, kind: str = "difference", epoch: int = 1) -> Picture:
        """Return a figure of one epoch of the run, as in the report.

        kind: difference (map), blocks (the map enlarged around each block), hillshade (shaded relief), histogram (of the
        differences), icp (convergence of the registration) or m3c2 (M3C2 distances). epoch: its number; 0 is the reference,
        which has only its hillshade.
        """
        return self[epoch].plot(kind)

    def __repr__(self) -> str:
        return f"<Run {self.folder}: {self.sensor}, {counted(len(self.epochs), 'epoch')}>"

    def _repr_html_(self) -> str:
        rows: dict[str, Any] = {"sensor": self.sensor, "seed": self.record.get("seed"), "epochs": len(self.epochs)}
        rows |= {f"epoch {each.number}": each.summary() for each in self.epochs[:5]}
        pictured = [each for each in self.epochs if each.pictured]
        picture = pictured[0].plot() if pictured else None
        return html_table(f"Run {self.folder}", {**rows, "report": self.report}, picture)


@dataclass(frozen=True, repr=False)
class Epoch:
    """One epoch of a run, wall frame. Epoch 0 is the reference and has no difference map.

    Attributes
    ----------
    run : Run
        The run that the epoch belongs to.
    number : int
        Number of the epoch; 0 is the reference.
    """

    run: Run
    number: int

    @property
    def folder(self) -> Path:
        """Folder of the epoch's own files (points, surfaces) within the run's folder."""
        return epoch_folder(self.run.folder, self.number)

    def file(self, kind: str, suffix: str) -> Path:
        """Return the path of one of the epoch's files in the run's folder, such as difference_002.tif.

        kind: first part of the file name, such as "difference". suffix: its end, such as ".tif". Raises InputError if there is
        no such file.
        """
        path = self.run.folder / f"{kind}_{self.number:03d}{suffix}"
        if not path.is_file():
            kinds = [name for name in PICTURES if (self.run.folder / f"{name}_{self.number:03d}{suffix}").is_file()]
            raise InputError(
                f"epoch {self.number} has no file of the kind '{kind}'",
                where=str(self.run.folder),
                allowed=", ".join(kinds) or "none",
                remedy="choose one of these products, or simulate with it (`products` in the config)",
            )
        return path

    @property
    def pictured(self) -> bool:
        """Whether the epoch has figures. In a series of many epochs only those have figures in which rocks fell."""
        return (self.run.folder / f"difference_{self.number:03d}.png").is_file()

    @property
    def record(self) -> dict[str, Any]:
        """The part of run.json that describes this epoch."""
        return dict(self.run.record["epochs"][self.number])

    @property
    def difference(self) -> xarray.DataArray:
        """Difference map of the epoch, (y, x) float32, m: reference minus epoch, missing rock positive, NaN without data."""
        values, grid = read_geotiff(self.file("difference", ".tif"))
        return data_array(values, grid, "difference", DIFFERENCE, frame=self.run.frame)

    @property
    def m3c2(self) -> xarray.DataArray:
        """Map of M3C2 distances (changes along the surface's normal), (y, x), m; NaN without data.

        Raises InputError if the run's config did not ask for them (key `m3c2`).
        """
        values, grid = read_geotiff(self.file("m3c2", ".tif"))
        return data_array(values, grid, "m3c2", "M3C2 distance; missing rock positive", frame=self.run.frame)

    @property
    def points(self) -> Points:
        """The points that the sensor measured in this epoch, wall frame, m."""
        return Points.of(self.run._files.points(self.number))

    @property
    def surface(self) -> Mesh:
        """The mesh that was reconstructed from the measured points of this epoch, wall frame, m."""
        return Mesh.of(self.run._files.surface(self.number))

    @property
    def truth(self) -> Mesh:
        """The true mesh of the wall in this epoch, without errors of the sensor, wall frame, m."""
        return Mesh.of(self.run._files.surface(self.number, "truth"))

    @property
    def blocks(self) -> geopandas.GeoDataFrame:
        """The blocks that fell in this epoch, one row each, to compare the measured sizes with the true ones.

        The columns include volume_m3 and size_x_m, ... (true), measured_volume_m3 (in the difference map), position_x_m, ...
        (wall frame) and annotated (whether it is labelled for training). The geometry of a row is the bounding rectangle of
        the block's niche, wall frame, m.
        """
        return _blocks([self])

    @property
    def statistics(self) -> dict[str, Any]:
        """Noise of the epoch by name, SI units.

        The names are statistics of the difference map outside the fallen blocks (count, median_m, nmad_m, ...) and
        registration_rms_m (RMS of the residuals of the epoch's registration).
        """
        outside = self.record.get("statistics", {}).get("outside_blocks")
        if outside is None:
            raise InputError(
                f"epoch {self.number} has no statistics",
                where=str(self.run.folder / RUN_FILE),
                remedy="continue the run with simulate(..., resume=True)",
            )
        registration = self.record.get("registration")
        return {"epoch": self.number, **outside, "registration_rms_m": registration and registration.get("rms_m")}

    def summary(self) -> str:
        """Return the number of blocks that fell in the epoch, and its noise, as one line of text."""
        blocks, found = len(self.record["blocks"]), self.statistics
        return (
            f"{blocks} blocks fell; outside of them NMAD {millimetres(found['nmad_m'])}, median {millimetres(found['median_m'])}"
        )

    def plot(self, kind: str = "difference") -> Picture:
        """Return a figure of the epoch as in the report.

        kind: difference (map), blocks (the map enlarged around each block), hillshade (shaded relief), histogram (of the
        differences), icp (convergence of the registration) or m3c2 (M3C2 distances). The reference has only its hillshade.
        """
        if self.number == 0:
            return Picture((self.run.folder / "reference.png").read_bytes())
        return Picture(self.file(pick(dict(zip(PICTURES, PICTURES, strict=True)), kind, "plot"), ".png").read_bytes())

    def save_gltf(self, path: Path | str) -> Path:
        """Write the measured surface of the epoch as .glb (glTF), for viewers of 3D models; return the path.

        It is coloured by the difference, and each niche is a separate part.
        """
        from pipeline.export.exported_run import ExportedRun
        from pipeline.export.gltf import save_gltf

        save_gltf(ExportedRun(self.run.folder), self.number, Path(path))
        return Path(path)

    def __repr__(self) -> str:
        return f"<Epoch {self.number} of {self.run!r}>"

    def _repr_html_(self) -> str:
        title = f"Epoch {self.number} of {self.run.folder}"
        rows = {"points": f"{self.record.get('points', 0):,}"} | ({"": self.summary()} if self.number else {})
        return html_table(title, rows, self.plot() if self.number == 0 or self.pictured else None)


def _blocks(epochs: list[Epoch]) -> geopandas.GeoDataFrame:
    """Return the table of the blocks that fell in some epochs."""
    rows, bounds = [], []
    for epoch in epochs:
        annotations = epoch.run.annotations
        images = {image["id"] for image in annotations["images"] if image["epoch"] == epoch.number}
        annotated = {each["block"] for each in annotations["annotations"] if each["image_id"] in images}
        for block in epoch.record["blocks"]:
            world = block.get("world_position_m") or epoch.run.frame.to_world(np.array(block["position_m"])).tolist()
            measured = {name: block[name] for name in ("measured_volume_m3", "measured_area_m2", "measured_mean_depth_m")}
            rows.append({
                "epoch": epoch.number, "block": block["label"], "shape": block["shape"], "volume_m3": block["volume_m3"],
                **spread_out("size", block["size_m"]), **measured, **spread_out("position", block["position_m"]),
                **spread_out("world", world), "annotated": block["label"] in annotated,
            })  # fmt: skip
            bounds.append([block["bbox_m"][place] for place in (0, 1, 3, 4)])
    return boxes(rows, bounds, _COLUMNS)
