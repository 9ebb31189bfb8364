"""Show the folder of `scarpsim gap`: the measured points with their residuals, before and after."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import read_laz
from pipeline.formats.points.points import check_reach
from pipeline.formats.records.result_records import GAP_FILE, read_gap
from pipeline.view.results import INSTRUMENTS, Item, Layer, Patch, PointLayer, ViewWindow, inside
from scene.common.errors import InputError
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray

_MM = 1e3
_POINTS_PER_CELL = 4
"""Mean number of points per cell of the surface."""
_CHANNELS = ("residual_m", "held_out")
"""Channels that the files must have."""
_FEWEST = 3
"""Fewest points from which a plane can be fitted."""
_FAR_M = 1e6
"""Height of the viewpoint from which the wall is assumed to be seen."""
_MOST_TOGETHER = 4
"""Up to this number of effects, all their combinations can be shown; of more effects only single ones."""
_QUANTILE = 0.98
"""Quantile of the residuals at which the colour scale ends."""


class GapResults:
    """Result of `scarpsim gap` (the diagnosis of a measurement), as `scarpsim view` shows it in the browser.

    It shows the residuals: how much deeper the measured surface is than the sensor model predicts, positive where rock is
    missing. The user switches between the model before the diagnosis and the one after it, which includes the systematic
    effects that were found. Each is a `step`, as the class `Results` calls the states that the viewer can show.

    The folder does not state the sensor's position, so the wall is shown from the side on which its normal points
    upwards.
    """

    step_name = "model"
    surfaces = {"surface": "mean of the points"}  # noqa: RUF012

    def __init__(self, folder: Path) -> None:
        """Read the folder. Raises InputError if a file of the diagnosis is missing or damaged."""
        self._record = read_gap(folder / GAP_FILE)
        self.title = f"{folder.name}: {INSTRUMENTS[self._record['sensor']]}, verdict: {self._record['verdict'].replace('_', ' ')}"
        self._clouds = {step: _cloud(folder / f"{step}.laz") for step in ("before", "after")}
        names = [each["name"] for each in self._record.get("effects", [])]
        self._clouds |= _in_part(self._clouds["before"], names)
        self.steps = {step: _in_words(step, names) for step in ("before", *list(self._clouds)[2:], "after")}
        before = self._clouds["before"].points
        self._frame = _frame(before)
        self._local = {step: self._frame.to_wall(cloud.points) for step, cloud in self._clouds.items()}
        self._limit = float(np.quantile(np.abs(_residual(self._clouds["before"])), _QUANTILE)) or 1.0
        self._cells = lru_cache(8)(self._binned)

    def layers(self, step: str) -> list[Layer]:
        """Return the only quantity that can give the colours, the residual; `step` has no effect."""
        return [Layer("residual", "deeper than predicted (missing rock positive)", "mm", _MM, diverging=True, limit=self._limit)]

    def patch(self, step: str, surface: str, layer: Layer, window: ViewWindow | None, budget: int) -> Patch:
        """Return the measured surface in a part of the wall, coloured by the residuals.

        Heights and residuals are means over cells of about four points.

        step: key of the model, such as "before" or "after" the diagnosis. window: part of the wall; None: all of it.
        budget: upper limit on the number of cells. `surface` and `layer` have no effect, as there is one of each.
        """
        return self._cells(step, window, budget)

    def points(self, step: str, layer: Layer, window: ViewWindow | None, budget: int) -> PointLayer | None:
        """Return at most about `budget` of the measured points in a part of the wall, with their residuals, mm; never None.

        step: key of the model, such as "before" or "after" the diagnosis. window: part of the wall; None: all of it.
        `layer` has no effect, as there is only one.
        """
        shown = np.flatnonzero(inside(self._local[step], window))
        shown = shown[:: max(1, int(np.ceil(len(shown) / budget)))]
        cloud = self._clouds[step]
        held_out = np.where(cloud.extra["held_out"][shown] > 0, "yes", "no")
        world = {f"world {axis}": column for axis, column in zip("xyz", cloud.points[shown].T, strict=True)}
        return PointLayer(
            self._local[step][shown], _residual(cloud)[shown], {"held out": held_out, **world}, len(shown) / len(cloud.points)
        )

    def items(self, step: str) -> list[Item]:
        """Return the regions where the scene itself changed, according to the diagnosis; `step` has no effect."""
        return [self._change(number, each) for number, each in enumerate(self._record.get("scene_changes", []), start=1)]

    def _change(self, number: int, change: dict[str, Any]) -> Item:
        """Convert a change of the scene to an item."""
        low, high = np.array(change["bbox_m"]).reshape(2, 3)
        corners = np.stack(np.meshgrid(*np.stack([low, high]).T), axis=-1).reshape(-1, 3)
        local = self._frame.to_wall(corners)
        (x0, y0, z0), (x1, y1, z1) = local.min(axis=0), local.max(axis=0)
        facts = {"volume": f"{change['volume_m3']:.4g} m³"}
        return Item("scene change", f"scene change {number}", (x0, x1, y0, y1, z0, z1), facts)

    def _binned(self, step: str, window: ViewWindow | None, budget: int) -> Patch:
        """Average residual and height over cells of about four points."""
        chosen = inside(self._local[step], window)
        points, residual = self._local[step][chosen], _residual(self._clouds[step])[chosen]
        if not len(points):
            empty = np.full((1, 1), np.nan)
            at = window or ViewWindow(0, 1, 0, 1)
            return Patch(np.array([(at.x0 + at.x1) / 2]), np.array([(at.y0 + at.y1) / 2]), empty, empty, np.zeros((1, 1), int), 1)
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        cells = min(budget, max(len(points) / _POINTS_PER_CELL, 1))
        side = float(np.sqrt(max(np.prod(high - low), 1e-12) / cells))
        width, height = (int(np.ceil(extent / side)) or 1 for extent in high - low)
        column = np.clip(((points[:, 0] - low[0]) / side).astype(int), 0, width - 1)
        row = np.clip(((high[1] - points[:, 1]) / side).astype(int), 0, height - 1)
        place, size = row * width + column, width * height
        count = np.bincount(place, minlength=size)
        with np.errstate(invalid="ignore"):
            z, mean = (np.bincount(place, each, size) / count for each in (points[:, 2], residual))
        x, y = low[0] + (np.arange(width) + 0.5) * side, high[1] - (np.arange(height) + 0.5) * side
        shape = height, width
        return Patch(x, y, z.reshape(shape), mean.reshape(shape), np.zeros(shape, int), 1)


def _in_part(before: PointCloud, names: list[str]) -> dict[str, PointCloud]:
    """Return the points with the residuals that remain when only some of several effects are in the model.

    Keys are the effects' numbers: "1", "1 3". The result is empty if before.laz does not state what each effect explains.
    """
    parts = [before.extra.get(f"effect_{number}_m") for number in range(1, len(names) + 1)]
    if len(parts) < 2 or any(part is None for part in parts):
        return {}
    numbers = range(1, len(names) + 1)
    sizes = range(1, len(names)) if len(names) <= _MOST_TOGETHER else (1,)
    some = [chosen for size in sizes for chosen in combinations(numbers, size)]
    clouds = {}
    for chosen in some:
        left = before.extra["residual_m"] - sum(np.asarray(parts[number - 1]) for number in chosen)
        clouds[" ".join(map(str, chosen))] = replace(before, extra={**before.extra, "residual_m": left})
    return clouds


def _in_words(step: str, names: list[str]) -> str:
    """Describe a step."""
    if step == "before":
        return "before: model as it was"
    return (
        "after: with what was named"
        if step == "after"
        else f"with {' and '.join(names[int(each) - 1] for each in step.split())} alone"
    )


def _cloud(path: Path) -> PointCloud:
    """Read a file of a diagnosis. Raises InputError if it is another point cloud."""
    cloud = read_laz(path)
    missing = [name for name in _CHANNELS if name not in cloud.extra]
    if missing:
        raise InputError(
            f"the point cloud has no channel {missing[0]}",
            where=str(path),
            allowed="before.laz and after.laz as scarpsim gap writes them",
            remedy="run scarpsim gap again on the measurement",
        )
    if not all(np.isfinite(cloud.extra[name]).all() and cloud.extra[name].ndim == 1 for name in _CHANNELS):
        raise InputError(
            f"the point cloud has values of {' or '.join(_CHANNELS)} that are not finite numbers",
            where=str(path),
            remedy="run scarpsim gap again on the measurement",
        )
    if len(cloud.points) < _FEWEST:
        raise InputError(
            f"the point cloud contains only {len(cloud.points)} points",
            where=str(path),
            allowed=f"at least {_FEWEST}",
            remedy="run scarpsim gap again on the measurement",
        )
    check_reach(cloud.points, str(path))
    return cloud


def _residual(cloud: PointCloud) -> FloatArray:
    """Return the residuals in mm."""
    return cloud.extra["residual_m"].astype(np.float64) * _MM


def _frame(points: FloatArray) -> WallFrame:
    """Return the wall frame as seen from above."""
    above = points.mean(axis=0) + np.array([0.0, 0.0, _FAR_M])
    return WallFrame.fit(points, above)
