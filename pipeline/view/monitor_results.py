"""The folder of `scarpsim monitor` as something to look at: the wall at each epoch, what changed, and the events."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from pipeline.formats.points.laz import read_laz
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.report.figures import SCALE_SIGMAS, mean_pooled
from pipeline.view.results import Item, Layer, Patch, PointLayer, ViewWindow, centres, cut, inside
from scene.common.errors import InputError
from scene.common.regular_file import read_json
from scene.geometry.frame import WallFrame

MONITOR_FILE, REFERENCE_FILE = "monitor.json", "reference.tif"
_MM, _NORMAL_95 = 1e3, 1.96
_REMEDY = "run scarpsim monitor again with another --out"


class MonitorResults:
    """Result of `scarpsim monitor` (what changed on a wall from epoch to epoch), as `scarpsim view` shows it in the browser.

    The user moves between the epochs and selects events, the changes that `monitor` lists. If the wall is mapped in
    several parts (views), the user moves between the views of each epoch. For the class `Results`, the interface of the
    viewer, each epoch or view is a `step`, and each event an `item`.
    """

    step_name = "epoch"
    surfaces = {"epoch": "as measured", "reference": "reference"}  # noqa: RUF012

    def __init__(self, folder: Path) -> None:
        """Raises InputError where monitor.json is damaged or a map is absent."""
        self.folder = folder
        self._record = read_json(folder / MONITOR_FILE, remedy=_REMEDY)
        try:
            epochs = self._record["epochs"]
            names = {str(each["epoch"]): each["time"] or Path(each["path"]).name for each in self._record["inputs"]}
            views = self._record.get("views") or [{"suffix": "", "view": 1, "wall_frame": self._record["wall_frame"]}]
            self._views = {_key(each["epoch"], view["view"]): view for each in epochs for view in views}
            self._frames = {key: _frame(view["wall_frame"]) for key, view in self._views.items()}
            self._levels = {
                _key(each["epoch"], view["view"]): float(each["level_of_detection_median_m"]) for each in epochs for view in views
            }
            self._events = [dict(each) for each in self._record["events"]]
        except (KeyError, TypeError, ValueError):
            raise InputError(
                "the file is damaged or is not a record of scarpsim monitor", where=str(folder / MONITOR_FILE), remedy=_REMEDY
            ) from None
        self.title = (
            f"{folder.name}: {len(epochs)} {'epoch' if len(epochs) == 1 else 'epochs'} against {names.get('0', 'the reference')}"
        )
        self.steps = {
            key: f"epoch {key.split()[0]}, {names.get(key.split()[0], '')}" + (f", view {view['view']}" if len(views) > 1 else "")
            for key, view in self._views.items()
        }
        if not self.steps:
            raise InputError(
                "the folder contains no epoch that was compared with the reference", where=str(folder), remedy=_REMEDY
            )
        self._map = lru_cache(6)(read_geotiff)
        self._cloud = lru_cache(1)(read_laz)
        self._numbers = lru_cache(2)(self._event_raster)

    def layers(self, step: str) -> list[Layer]:
        """Return the quantities that can colour an epoch (`step`): change, level of detection, shaded rock and relief."""
        limit = SCALE_SIGMAS * self._levels[step] / _NORMAL_95 * _MM
        return [
            Layer("difference", "reference minus epoch (missing rock positive)", "mm", _MM, diverging=True, limit=limit),
            Layer("lod", "level of detection, 95 %", "mm", _MM),
            Layer("rock", "rock (shaded)", ""),
            Layer("height", "relief", "m"),
        ]

    def patch(self, step: str, surface: str, layer: Layer, window: ViewWindow | None, budget: int) -> Patch:
        """Return a surface of an epoch in a part of the wall, coloured by a quantity.

        Parameters
        ----------
        step : str
            Key of the epoch.
        surface : str
            "reference" for the reference's heights, "epoch" for those of the epoch (reference minus change).
        layer : Layer
            The quantity that gives the colours.
        window : ViewWindow or None
            Part of the wall; None: all of it.
        budget : int
            Approximate upper limit on the number of cells.
        """
        reference, grid = self._map(self._reference(step))
        rows, columns, factor = cut(grid, window, budget)
        part = reference[rows, columns]
        if surface == "epoch":
            change = self._map(self._path("difference", step))[0][rows, columns]
            part = part - np.where(np.isfinite(change), change, 0.0)
        height = mean_pooled(part, factor)
        value = height
        if layer.key in ("difference", "lod"):
            value = mean_pooled(self._map(self._path(layer.key, step))[0][rows, columns], factor) * layer.factor
        label = self._numbers(step)[rows, columns]
        middle = label[factor // 2 :: factor, factor // 2 :: factor][: height.shape[0], : height.shape[1]]
        return Patch(*centres(grid, rows, columns, factor), height, value, middle, factor)

    def points(self, step: str, layer: Layer, window: ViewWindow | None, budget: int) -> PointLayer | None:
        """Return at most about `budget` registered points of an epoch, with their change and level of detection, m.

        step: key of the epoch. window: part of the wall; None: all of it. `layer` has no effect. Returns None if the folder has
        no points of the epoch.
        """
        path = self.folder / f"epoch_{_epoch(step):03d}.laz"
        if not path.is_file():
            return None
        cloud = self._cloud(path)
        local = self._frames[step].to_wall(cloud.points)
        shown = np.flatnonzero(inside(local, window))
        shown = shown[:: max(1, int(np.ceil(len(shown) / budget)))]
        facts = {name: channel[shown] for name, channel in cloud.extra.items()}
        return PointLayer(local[shown], None, facts, len(shown) / max(len(local), 1))

    def items(self, step: str) -> list[Item]:
        """Return the events (changes that monitor lists) of an epoch; `step` is its key."""
        return [_item(each) for each in self._events if _key(each["epoch"], each.get("view", 1)) == step]

    def _path(self, name: str, step: str) -> Path:
        return self.folder / f"{name}_{_epoch(step):03d}{self._views[step]['suffix']}.tif"

    def _reference(self, step: str) -> Path:
        return self.folder / f"reference{self._views[step]['suffix']}.tif"

    def _event_raster(self, step: str) -> NDArray[np.int32]:
        """(h, w) the number of the event at each pixel, 0 where there is none."""
        shape = self._map(self._reference(step))[0].shape
        raster = np.zeros(shape, dtype=np.int32)
        content = json.loads((self.folder / "annotations.json").read_text(encoding="utf-8"))
        (image,) = (each["id"] for each in content["images"] if each["file_name"] == self._path("difference", step).name)
        for each in sorted(content["annotations"], key=lambda annotation: -annotation["area"]):
            if each["image_id"] == image:
                raster[coco_mask.decode(each["segmentation"]) > 0] = each["event"]
        return raster


def _key(epoch: int, view: int) -> str:
    """Name of a step: the epoch, and the view from the second one on."""
    return str(epoch) if view == 1 else f"{epoch} {view}"


def _epoch(step: str) -> int:
    return int(step.split()[0])


def _frame(stated: dict[str, Any]) -> WallFrame:
    return WallFrame(np.array(stated["rotation"], dtype=float), np.array(stated["origin_m"], dtype=float))


def _item(event: dict[str, Any]) -> Item:
    x, y, half_x, half_y = (event["x_m"], event["y_m"], event["width_m"] / 2, event["height_m"] / 2)
    facts = {
        "kind": "missing rock" if event["kind"] == "missing" else "added material",
        "volume": f"{event['volume_m3']:.3g} ± {_NORMAL_95 * event['volume_std_m3']:.2g} m³",
        "depth": f"{event['depth_median_m'] * _MM:.0f} mm, at most {event['depth_largest_m'] * _MM:.0f} mm",
        "area": f"{event['area_m2']:.3g} m²",
        "first seen": f"between {event['first_seen_after']} and {event['first_seen_by']}",
        "marks": event["marks"] or "none",
    }
    return Item("event", f"event {event['id']}", (x - half_x, x + half_x, y - half_y, y + half_y, np.nan, np.nan), facts)
