"""`simulate` and `open_run`: a run as an object."""

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
from scene.common.errors import InputError
from scene.geometry.frame import WallFrame

if TYPE_CHECKING:
    import geopandas
    import pandas
    import xarray

PICTURES = ("difference", "blocks", "hillshade", "histogram", "icp", "m3c2")
_COLUMNS = (
    "epoch", "block", "shape", "size_x_m", "size_y_m", "size_z_m", "volume_m3", "measured_volume_m3", "measured_area_m2",
    "measured_mean_depth_m", "position_x_m", "position_y_m", "position_z_m", "world_x_m", "world_y_m", "world_z_m", "annotated",
)  # fmt: skip


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
    """Observe a wall before and after rocks fall; the same as the command `simulate`.

    config, model, overrides: as `configure` takes them; sensor: "tls" or "stereo", may be left out where the config has a model
    of one only; out: folder of the run, none: a new one under runs/; resume: go on with an interrupted run in `out`.
    """
    from pipeline.run import simulation

    resolved = configure(config, sensor, seed=seed, model=model, **overrides)
    which = one_sensor(resolved, sensor or (getattr(model, "sensor", None)))
    folder = Path(out) if out is not None else new_folder(Path("runs"), which)
    with python_progress(progress) as shown:
        return Run(simulation.simulate(resolved, which, folder, resume=resume, progress=shown).folder)


def open_run(folder: Path | str) -> Run:
    """A finished or interrupted run by its folder. Raises InputError where it is none."""
    run = Run(Path(folder))
    if "wall_frame" not in run.record:
        raise InputError("the run has not finished an epoch", where=str(folder), remedy="go on with simulate(..., resume=True)")
    return run


@dataclass(frozen=True, repr=False)
class Run:
    """A run's folder, read when it is asked for. `run[0]` is the reference, `run[1]` the first epoch after rocks fell."""

    folder: Path

    @cached_property
    def _files(self) -> RunFiles:
        if not (self.folder / RUN_FILE).exists():
            raise InputError(f"holds no {RUN_FILE}", where=str(self.folder), remedy="name a run's folder")
        return RunFiles(self.folder)

    @property
    def record(self) -> dict[str, Any]:
        """run.json, checked."""
        return self._files.record

    @cached_property
    def config(self) -> SimulationConfig:
        """The resolved config."""
        return load_config(self.folder / RUN_FILE, [], None, None)

    @property
    def sensor(self) -> SensorName:
        """stereo or tls."""
        return "stereo" if self.record["sensor"] == "stereo" else "tls"

    @property
    def report(self) -> Path:
        """report.html."""
        return self.folder / "report.html"

    @cached_property
    def frame(self) -> WallFrame:
        """The wall frame: `run.frame.to_world(points)`, (..., 3), m, and `to_wall`."""
        held = self.record["wall_frame"]
        return WallFrame(np.array(held["rotation"]), np.array(held["origin_m"]))

    @property
    def annotations(self) -> dict[str, Any]:
        """annotations.json, COCO."""
        return read_annotations(self.folder / "annotations.json")

    @property
    def epochs(self) -> list[Epoch]:
        """The epochs after the reference."""
        return [Epoch(self, int(record["epoch"])) for record in self.record["epochs"][1:]]

    def __len__(self) -> int:
        """How many epochs there are, the reference included."""
        return len(self.record["epochs"])

    def __getitem__(self, number: int) -> Epoch:
        if not 0 <= number < len(self):
            raise IndexError(f"epoch {number}: the run has 0, the reference, to {len(self) - 1}")
        return Epoch(self, number)

    @property
    def differences(self) -> xarray.DataArray:
        """(epoch, y, x) float32, m, the difference maps of all epochs; NaN without data."""
        maps, grids = zip(*(read_geotiff(each.file("difference", ".tif")) for each in self.epochs), strict=True)
        return data_array(np.stack(maps), grids[0], "difference", DIFFERENCE, frame=self.frame)

    @property
    def blocks(self) -> geopandas.GeoDataFrame:
        """What fell in all epochs: see `Epoch.blocks`."""
        return _blocks(self.epochs)

    @property
    def statistics(self) -> pandas.DataFrame:
        """A row for each epoch: the differences outside the blocks (count, median_m, nmad_m, ...), and how it was registered."""
        return frame(each.statistics for each in self.epochs)

    def plot(self, kind: str = "difference", epoch: int = 1) -> Picture:
        """A picture of the report, of an epoch: difference, blocks, hillshade, histogram, icp or m3c2."""
        return self[epoch].plot(kind)

    def __repr__(self) -> str:
        return f"<Run {self.folder}: {self.sensor}, {len(self.epochs)} epochs>"

    def _repr_html_(self) -> str:
        rows: dict[str, Any] = {"sensor": self.sensor, "seed": self.record.get("seed"), "epochs": len(self.epochs)}
        rows |= {f"epoch {each.number}": each.summary() for each in self.epochs[:5]}
        picture = self.plot() if len(self) > 1 else None
        return html_table(f"Run {self.folder}", {**rows, "report": self.report}, picture)


@dataclass(frozen=True, repr=False)
class Epoch:
    """One epoch of a run, wall frame; of number 0, the reference, there is no difference."""

    run: Run
    number: int

    @property
    def folder(self) -> Path:
        """Of the epoch's own files."""
        return epoch_folder(self.run.folder, self.number)

    def file(self, kind: str, suffix: str) -> Path:
        """A file of the epoch in the run's folder; raises InputError where the run has none."""
        path = self.run.folder / f"{kind}_{self.number:03d}{suffix}"
        if not path.is_file():
            kinds = [name for name in PICTURES if (self.run.folder / f"{name}_{self.number:03d}{suffix}").is_file()]
            raise InputError(
                f"epoch {self.number} has no '{kind}'", where=str(self.run.folder), allowed=", ".join(kinds) or "none"
            )
        return path

    @property
    def record(self) -> dict[str, Any]:
        """The epoch's part of run.json."""
        return dict(self.run.record["epochs"][self.number])

    @property
    def difference(self) -> xarray.DataArray:
        """(y, x) float32, m, reference minus epoch, missing rock positive, NaN without data."""
        values, grid = read_geotiff(self.file("difference", ".tif"))
        return data_array(values, grid, "difference", DIFFERENCE, frame=self.run.frame)

    @property
    def m3c2(self) -> xarray.DataArray:
        """(y, x) M3C2 distances, m, of a run whose config asks for them."""
        values, grid = read_geotiff(self.file("m3c2", ".tif"))
        return data_array(values, grid, "m3c2", "M3C2 distance; missing rock positive", frame=self.run.frame)

    @property
    def points(self) -> Points:
        """The sensor's points."""
        return Points.of(self.run._files.points(self.number))

    @property
    def surface(self) -> Mesh:
        """The reconstructed mesh."""
        return Mesh.of(self.run._files.surface(self.number))

    @property
    def truth(self) -> Mesh:
        """The wall as it really is."""
        return Mesh.of(self.run._files.surface(self.number, "truth"))

    @property
    def blocks(self) -> geopandas.GeoDataFrame:
        """What fell: a row for each block, its truth and what the map shows of it; geometry: its bounding rectangle."""
        return _blocks([self])

    @property
    def statistics(self) -> dict[str, Any]:
        """The differences outside the blocks, SI, and the RMS of the registration."""
        outside = self.record.get("statistics", {}).get("outside_blocks")
        if outside is None:
            raise InputError(f"epoch {self.number} has no statistics", where=str(self.run.folder / RUN_FILE))
        registration = self.record.get("registration")
        return {"epoch": self.number, **outside, "registration_rms_m": registration and registration.get("rms_m")}

    def summary(self) -> str:
        """One line."""
        blocks, found = len(self.record["blocks"]), self.statistics
        return (
            f"{blocks} blocks fell; outside of them NMAD {millimetres(found['nmad_m'])}, median {millimetres(found['median_m'])}"
        )

    def plot(self, kind: str = "difference") -> Picture:
        """A picture of the report: difference, blocks, hillshade, histogram, icp or m3c2; of the reference its hillshade."""
        if self.number == 0:
            return Picture((self.run.folder / "reference.png").read_bytes())
        return Picture(self.file(pick(dict(zip(PICTURES, PICTURES, strict=True)), kind, "plot"), ".png").read_bytes())

    def save_gltf(self, path: Path | str) -> Path:
        """Write the surface as .glb, coloured by the difference, each niche a part of its own; returns the path."""
        from pipeline.export.exported_run import ExportedRun
        from pipeline.export.gltf import save_gltf

        save_gltf(ExportedRun(self.run.folder), self.number, Path(path))
        return Path(path)

    def __repr__(self) -> str:
        return f"<Epoch {self.number} of {self.run!r}>"

    def _repr_html_(self) -> str:
        title = f"Epoch {self.number} of {self.run.folder}"
        rows = {"points": f"{self.record.get('points', 0):,}"} | ({"": self.summary()} if self.number else {})
        return html_table(title, rows, self.plot())


def _blocks(epochs: list[Epoch]) -> geopandas.GeoDataFrame:
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
