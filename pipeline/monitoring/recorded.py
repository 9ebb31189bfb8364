"""Read back the folder of results of `monitor`: which files were compared, their registration, and which rock is stable."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.formats.records.coco_masks import run_lengths
from pipeline.formats.records.result_records import RUN_FILE, read_run
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.reading import EpochSource
from pipeline.monitoring.records import KEPT
from pipeline.monitoring.significance import NORMAL_95
from pipeline.monitoring.stable_areas import StableRock
from pipeline.monitoring.times import EpochTime
from pipeline.monitoring.unchanged import unchanged_pixels
from pipeline.registration.rigid import RigidTransform
from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.regular_file import read_json
from scene.geometry.frame import WallFrame
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

MONITOR_FILE, ANNOTATIONS_FILE = "monitor.json", "annotations.json"
_AGAIN = "run scarpsim monitor again with another --out"


class _StatedPart(BaseModel):
    """A part of monitor.json, which may have more keys."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)


class _StatedInput(_StatedPart):
    epoch: int
    path: Path
    sha256: dict[Path, str] = Field(min_length=1)


class _StatedMotion(_StatedPart):
    rotation: list[list[float]]
    translation_m: list[float]


class _StatedEpoch(_StatedPart):
    epoch: int
    registration: _StatedMotion


class _StatedFrame(_StatedPart):
    rotation: list[list[float]]
    origin_m: list[float]


class _StatedView(_StatedPart):
    suffix: str
    wall_frame: _StatedFrame


class _StatedMonitoring(_StatedPart):
    inputs: list[_StatedInput] = Field(min_length=2)
    options: dict[str, Any]
    views: list[_StatedView] = Field(min_length=1)
    epochs: list[_StatedEpoch] = Field(min_length=1)


@dataclass(frozen=True)
class StableMap:
    """Where one view (separately mapped part) of the wall shows stable rock in one epoch, and where events.

    Attributes
    ----------
    frame : WallFrame
        Frame of the view.
    grid : Grid
        Raster of h x w pixels, frame of the view.
    stable, event : (h, w) bool arrays
        Pixels that did not change, and pixels in an event. A pixel without data is neither.
    """

    frame: WallFrame
    grid: Grid
    stable: NDArray[np.bool_]
    event: NDArray[np.bool_]

    def at(self, points: FloatArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which of the registered points (n, 3), survey coordinates, m, lie on stable pixels, and which in events."""
        local = self.frame.to_wall(points)
        column, row = (np.floor(each) for each in (self.grid.columns(local[:, 0]), self.grid.rows(local[:, 1])))
        inside = (column >= 0) & (column < self.grid.width) & (row >= 0) & (row < self.grid.height)
        pixel = np.where(inside, row * self.grid.width + column, 0).astype(np.int64)
        return inside & self.stable.ravel()[pixel], inside & self.event.ravel()[pixel]


@dataclass(frozen=True)
class RecordedEpoch:
    """A later epoch of a finished monitoring.

    Attributes
    ----------
    number : int
        Number of the epoch; the reference is 0.
    source : EpochSource
        Its files.
    to_reference : RigidTransform
        Moves its points, as they were read, onto the reference, wall frame.
    """

    number: int
    source: EpochSource
    to_reference: RigidTransform


@dataclass(frozen=True)
class RecordedMonitoring:
    """A finished monitoring, read back from its folder.

    Attributes
    ----------
    folder : Path
        The folder of the results.
    options : MonitorOptions
        Options of the call.
    reference : EpochSource
        Files of the reference epoch.
    epochs : tuple of RecordedEpoch
        The later epochs.
    views : tuple of (str, WallFrame)
        For each view (separately mapped part) of the wall, the ending of its files' names and its frame; the first frame is the
        wall frame.
    """

    folder: Path
    options: MonitorOptions
    reference: EpochSource
    epochs: tuple[RecordedEpoch, ...]
    views: tuple[tuple[str, WallFrame], ...]

    @property
    def frame(self) -> WallFrame:
        """The wall frame."""
        return self.views[0][1]

    def registered(self, epoch: RecordedEpoch, points: FloatArray) -> FloatArray:
        """Move points (n, 3) of an epoch, as they were read, onto the reference, survey coordinates, m."""
        return self.frame.to_world(epoch.to_reference.apply(self.frame.to_wall(points)))

    def stable_rock(self, epoch: RecordedEpoch, points: FloatArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which registered points of an epoch lie on stable rock, and which in events.

        Stable rock is what did not change, in the areas that the user gave with `--stable`, if any, and outside the events. On
        a wall with several views, a point is stable if one view has it on stable rock and none in a changed place.

        Parameters
        ----------
        epoch : RecordedEpoch
            The epoch.
        points : (n, 3) array
            Its points after registration, survey coordinates, m.

        Returns
        -------
        (n,) bool, (n,) bool
            Whether each point lies on stable rock, and whether it lies in an event.
        """
        found = [each.at(points) for each in self._maps(epoch)]
        event = np.any([each for _, each in found], axis=0)
        stable = np.any([each for each, _ in found], axis=0) & ~event
        areas = StableRock(self.options.stable, self.frame)
        return stable & areas.contains(self.frame.to_wall(points)) if areas else stable, event

    def _maps(self, epoch: RecordedEpoch) -> list[StableMap]:
        """Read the maps of an epoch, and find again the pixels that did not change."""
        events = _event_masks(self.folder / ANNOTATIONS_FILE)
        found = []
        for suffix, frame in self.views:
            name = f"difference_{epoch.number:03d}{suffix}.tif"
            difference, grid = read_geotiff(self.folder / name)
            level, _ = read_geotiff(self.folder / name.replace("difference", "lod"))
            event = events.get(name, np.zeros(grid.shape, dtype=bool))
            if not difference.shape == level.shape == event.shape:
                raise InputError("the maps of this epoch do not have the same size", where=str(self.folder / name), remedy=_AGAIN)
            known = np.isfinite(difference) & np.isfinite(level)
            standard = np.where(known, difference / np.where(known, level / NORMAL_95, 1.0), np.nan)
            found.append(StableMap(frame, grid, unchanged_pixels(standard, known), event))
        return found


def is_monitoring(path: Path) -> bool:
    """Return whether a path is a folder that `scarpsim monitor` wrote, finished or not."""
    return path.is_dir() and ((path / MONITOR_FILE).is_file() or (path / KEPT).is_dir())


def read_monitoring(folder: Path) -> RecordedMonitoring:
    """Read back a finished monitoring from its folder, and check that its epochs' files are still as they were.

    Raises InputError if the monitoring is not finished, or if a file is missing or was changed.
    """
    where = folder / MONITOR_FILE
    if not where.is_file():
        raise InputError(
            "the monitoring in this folder is not finished",
            where=str(folder),
            remedy="repeat the command scarpsim monitor with --resume, which finishes it",
        )
    values = read_json(where, remedy=_AGAIN)
    record = parse(_StatedMonitoring, values, str(where))
    try:
        options = MonitorOptions.from_dict(record.options)
        views = tuple((each.suffix, _frame(each.wall_frame)) for each in record.views)
        motions = {each.epoch: _transform(each.registration) for each in record.epochs}
        sources = {each.epoch: each for each in record.inputs}
        epochs = [(number, sources[number], motions[number]) for number in sorted(motions)]
        reference = sources[0]
    except (KeyError, TypeError, ValueError, ValidationError):
        raise InputError("the file is damaged or is not a record of scarpsim monitor", where=str(where), remedy=_AGAIN) from None
    return RecordedMonitoring(
        folder,
        options,
        _source(reference, folder),
        tuple(RecordedEpoch(number, _source(given, folder), motion) for number, given, motion in epochs),
        views,
    )


def _source(given: _StatedInput, folder: Path) -> EpochSource:
    """Return the files of an epoch, and the record of the run of `simulate` that it is from."""
    for file in given.sha256:
        if not file.is_file():
            raise InputError(
                f"the file of epoch {given.epoch} is not there any more",
                where=str(file),
                remedy=f"run the command in the folder where scarpsim monitor wrote {folder.name}, or move the file back",
            )
    source = EpochSource(given.path, tuple(given.sha256), EpochTime(None, ""), _run_of(given.path))
    for path, checksum in source.checksums().items():
        if checksum != given.sha256[Path(path)]:
            raise InputError(
                f"the file was changed after scarpsim monitor had read it as epoch {given.epoch}", where=path, remedy=_AGAIN
            )
    return source


def _run_of(path: Path) -> dict[str, Any] | None:
    record = path.parent / RUN_FILE
    return read_run(record, "make the run again with scarpsim simulate") if path.is_dir() and record.is_file() else None


def _event_masks(path: Path) -> dict[str, NDArray[np.bool_]]:
    """Return the pixels in an event, (h, w), by the name of the difference map, from the annotations that `monitor` wrote."""
    record = read_json(path, remedy=_AGAIN)
    found: dict[str, NDArray[np.bool_]] = {}
    try:
        images = {each["id"]: (str(each["file_name"]), int(each["height"]), int(each["width"])) for each in record["images"]}
        outlines = [(*images[each["image_id"]], each["segmentation"]) for each in record["annotations"]]
    except (KeyError, TypeError, ValueError):
        raise InputError("the file is damaged or was not written by scarpsim monitor", where=str(path), remedy=_AGAIN) from None
    for name, height, width, outline in outlines:
        mask = coco_mask.decode(run_lengths(outline, height, width, str(path))) > 0
        found[name] = mask | found[name] if name in found else mask
    return found


def _frame(stated: _StatedFrame) -> WallFrame:
    return WallFrame(_matrix(stated.rotation), np.array(stated.origin_m, dtype=np.float64).reshape(3))


def _transform(stated: _StatedMotion) -> RigidTransform:
    return RigidTransform(_matrix(stated.rotation), np.array(stated.translation_m, dtype=np.float64).reshape(3))


def _matrix(rows: list[list[float]]) -> FloatArray:
    return np.array(rows, dtype=np.float64).reshape(3, 3)
