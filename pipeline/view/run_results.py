"""Show a run folder."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.change.difference import SurfaceRaster, surface_raster
from pipeline.detection.products.events import Event, read_events
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.formats.records.result_files import read_own_points, read_surface
from pipeline.formats.records.result_records import RUN_FILE, read_run
from pipeline.formats.records.run_files import epoch_folder
from pipeline.report.figures import SCALE_SIGMAS, mean_pooled
from pipeline.view.results import INSTRUMENTS, Item, Layer, Patch, PointLayer, ViewWindow, centres, cut, inside
from scene.common.errors import InputError
from scene.geometry.grid import Grid

_MM = 1e3
_ROCK, _HEIGHT = Layer("rock", "rock (shaded)", ""), Layer("height", "relief", "m")


class RunResults:
    """Result of `scarpsim simulate` (a simulated run), as `scarpsim view` shows it in the browser.

    The user moves between epochs and selects fallen blocks, as well as the detections of a folder of `scarpsim detect` if
    there is one. For the class `Results`, the interface of the viewer, each epoch is a `step`, and each block or
    detection an `item`.
    """

    step_name = "epoch"

    def __init__(self, folder: Path, detections: Path | None = None) -> None:
        """Read the folder.

        Raises InputError if run.json is damaged, no epoch is finished, or the detections belong to other maps.
        """
        self.folder = folder
        record = read_run(folder / RUN_FILE, "continue the run with scarpsim simulate --resume")
        self._epochs = {str(each["epoch"]): each for each in record.get("epochs", []) if each["epoch"] > 0}
        if not self._epochs or "wall" not in record or any("statistics" not in each for each in self._epochs.values()):
            raise InputError(
                "the run contains no finished epoch", where=str(folder), remedy="continue the run with scarpsim simulate --resume"
            )
        self.world_to_wall = np.array(record["wall_frame"]["matrix_world_to_wall"]) if "wall_frame" in record else np.eye(4)
        self.title = f"{folder.name}: {INSTRUMENTS[record['sensor']]}, {record['wall']['name']}"
        self.steps = {key: _step_name(each) for key, each in self._epochs.items()}
        self.surfaces = {"surface": "as measured", "reference": "reference, as measured", "truth": "as it really is"}
        self._found = _detections(detections) if detections else {}
        if detections and not set(self._found) & set(self.steps):
            maps = ", ".join(f"difference_{int(key):03d}.tif" for key in self.steps)
            raise InputError(
                "the folder contains no detections of this run's maps",
                where=str(detections),
                allowed=f"detections in {maps}",
                remedy="give the folder that scarpsim detect filled for this run",
            )
        self._map = lru_cache(4)(read_geotiff)
        self._heights = lru_cache(3)(self._raster_of)
        self._cloud = lru_cache(1)(read_own_points)

    @property
    def extent_m(self) -> float:
        """Longer side of the run's difference maps, m."""
        grid = self._map(self._map_path("difference", next(iter(self.steps))))[1]
        return max(grid.width, grid.height) * grid.gsd

    def layers(self, step: str) -> list[Layer]:
        """Return the quantities that can colour an epoch (`step`).

        They are the difference to the reference; in a time series the change since the epoch before; the M3C2 distance if it was
        computed; shaded rock and relief.
        """
        limit = SCALE_SIGMAS * self._epochs[step]["statistics"]["sigma_m"] * _MM
        maps = [Layer("difference", "reference minus epoch (missing rock positive)", "mm", _MM, diverging=True, limit=limit)]
        if self._map_path("change", step).exists():
            maps.append(Layer("change", "epoch before minus epoch", "mm", _MM, diverging=True, limit=limit))
        if self._map_path("m3c2", step).exists():
            maps.append(Layer("m3c2", "M3C2 distance", "mm", _MM, diverging=True, limit=limit))
        return [*maps, _ROCK, _HEIGHT]

    def patch(self, step: str, surface: str, layer: Layer, window: ViewWindow | None, budget: int) -> Patch:
        """Return a surface of an epoch in a part of the wall, coloured by a quantity.

        Parameters
        ----------
        step : str
            Key of the epoch.
        surface : str
            "surface" (as measured), "reference" (the first epoch, as measured) or "truth".
        layer : Layer
            The quantity that gives the colours.
        window : ViewWindow or None
            Part of the wall; None: all of it.
        budget : int
            Approximate upper limit on the number of cells.
        """
        grid = self._map(self._map_path("difference", step))[1]
        raster = self._heights(self._surface_path(step, surface), grid)
        rows, columns, factor = cut(grid, window, budget)
        height = mean_pooled(raster.heights[rows, columns], factor)
        value = self._values(step, layer, rows, columns, factor, height)
        label = self._heights(self._surface_path(step, "surface"), grid).block[rows, columns]
        middle = label[factor // 2 :: factor, factor // 2 :: factor][: height.shape[0], : height.shape[1]]
        return Patch(*centres(grid, rows, columns, factor), height, value, middle, factor)

    def points(self, step: str, layer: Layer, window: ViewWindow | None, budget: int) -> PointLayer | None:
        """Return at most about `budget` measured points of an epoch; None if the run has no points.laz of it.

        step: key of the epoch. window: part of the wall; None: all of it. `layer` has no effect: the points are shown in grey.
        """
        path = epoch_folder(self.folder, int(step)) / "points.laz"
        if not path.exists():
            return None
        cloud = self._cloud(path)
        shown = _thinned(np.flatnonzero(inside(cloud.points, window)), budget)
        facts = {name: channel[shown] for name, channel in _channels(cloud).items()}
        return PointLayer(cloud.points[shown], None, facts, len(shown) / max(len(cloud.points), 1))

    def items(self, step: str) -> list[Item]:
        """Return the blocks that are missing in an epoch, and the detections in its map; `step` is the key of the epoch."""
        blocks = [_block(each) for each in self._epochs[step]["blocks"]]
        return blocks + self._found.get(step, [])

    def _values(
        self, step: str, layer: Layer, rows: slice, columns: slice, factor: int, height: NDArray[np.floating]
    ) -> NDArray[np.floating]:
        """Return the values of a layer."""
        if layer.key in ("rock", "height"):
            return height
        return mean_pooled(self._map(self._map_path(layer.key, step))[0][rows, columns], factor) * layer.factor

    def _map_path(self, name: str, step: str) -> Path:
        """Return the path of a map."""
        return self.folder / f"{name}_{int(step):03d}.tif"

    def _surface_path(self, step: str, surface: str) -> Path:
        """Return the path of a surface."""
        number = 0 if surface == "reference" else int(step)
        return epoch_folder(self.folder, number) / ("truth.ply" if surface == "truth" else "surface.ply")

    def _raster_of(self, path: Path, grid: Grid) -> SurfaceRaster:
        """Rasterise a surface."""
        return surface_raster(read_surface(path), grid)


def _step_name(epoch: dict[str, Any]) -> str:
    """Name an epoch, with its time in a series."""
    time = str(epoch.get("time", ""))[:16].replace("T", " ")
    return f"epoch {epoch['epoch']}, {time}" if time else f"epoch {epoch['epoch']}"


def _channels(cloud: PointCloud) -> dict[str, NDArray[Any]]:
    """Return the channels of a point cloud."""
    known = {} if cloud.intensity is None else {"intensity": cloud.intensity}
    return known | dict(cloud.extra)


def _thinned(index: NDArray[np.integer], budget: int) -> NDArray[np.integer]:
    """Return every k-th index, so that at most `budget` remain."""
    return index[:: max(1, int(np.ceil(len(index) / budget)))]


def _block(block: dict[str, Any]) -> Item:
    """Convert a block's record to an item."""
    x0, y0, z0, x1, y1, z1 = block["bbox_m"]
    depth = block["measured_mean_depth_m"]
    facts = {
        "shape": block["shape"],
        "size": " x ".join(f"{side:.2f}" for side in block["size_m"]) + " m",
        "volume": f"{block['volume_m3']:.4g} m³",
        "measured volume": f"{block['measured_volume_m3']:.4g} m³" if block["measured_area_m2"] else "not seen",
        "measured depth": "not seen" if depth is None else f"{depth * _MM:.0f} mm",
        "position": ", ".join(f"{value:.2f}" for value in block["position_m"]) + " m",
    }
    return Item("block", f"block {block['label']}", (x0, x1, y0, y1, z0, z1), facts)


def _detections(folder: Path) -> dict[str, list[Item]]:
    """Read the events of `scarpsim detect` at its lowest confidence, by epoch."""
    tables = sorted((_confidence(path), path) for path in folder.glob("events_*.csv"))
    if not tables:
        raise InputError(
            "the folder contains no table of events (events_*.csv)",
            where=str(folder),
            remedy="give the folder that scarpsim detect filled",
        )
    found: dict[str, list[Item]] = {}
    for event in read_events(tables[0][1]):
        number = re.search(r"difference_(\d{1,9})", event.image)
        if number:
            found.setdefault(str(int(number[1])), []).append(_detection(event))
    return found


def _confidence(path: Path) -> float:
    """Return the confidence in the name of a table of events."""
    try:
        value = float(path.stem.removeprefix("events_"))
    except ValueError:
        value = np.nan
    if not 0 <= value <= 1:
        raise InputError(
            "the file name is not that of a table of events",
            where=str(path),
            allowed="such as events_0.9.csv",
            remedy="give the file the name that scarpsim detect gave it",
        )
    return value


def _detection(event: Event) -> Item:
    """Convert an event to an item."""
    facts = {
        "score": f"{event.score:.3f}",
        "volume": f"{event.volume_m3:.4g} m³",
        "largest depth": f"{event.depth_m * _MM:.0f} mm",
    }
    half_width, half_height = event.width_m / 2, event.height_m / 2
    box = (event.x_m - half_width, event.x_m + half_width, event.y_m - half_height, event.y_m + half_height, np.nan, np.nan)
    return Item("detection", f"detection {event.number}", box, facts)
