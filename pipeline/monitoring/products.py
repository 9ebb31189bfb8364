"""Write the results of `monitor`: monitor.json, tables and outlines of events, registered points, COCO, the report."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.change.annotate import BLOCK_CATEGORY, run_length_encoding
from pipeline.formats.files.atomic import write_json, write_text
from pipeline.formats.files.plain_json import without_nan
from pipeline.formats.points.laz import LazHeader
from pipeline.formats.points.laz_chunks import chunk_writer
from pipeline.formats.rasters.geotiff import read_geotiff, write_geotiff
from pipeline.formats.records.geopackage import write_geopackage
from pipeline.monitoring.events import ChangedRegion
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.outlines import in_survey
from pipeline.monitoring.reading import EpochData, EpochSource, in_pieces
from pipeline.monitoring.records import EpochRecord
from pipeline.monitoring.site import ReferenceSite, WallView
from pipeline.registration.rigid import RigidTransform
from pipeline.report.provenance import versions
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

SCHEMA = 1
COLUMNS: dict[str, type] = {
    "id": int, "epoch": int, "time": str, "first_seen_after": str, "first_seen_by": str, "kind": str,
    "x_m": float, "y_m": float, "world_x_m": float, "world_y_m": float, "world_z_m": float,
    "width_m": float, "height_m": float, "area_m2": float, "depth_median_m": float, "depth_largest_m": float,
    "volume_m3": float, "volume_std_m3": float, "significance": float, "score": float, "marks": str, "view": int,
}  # fmt: skip
"""Of events.csv and events.gpkg."""
_SCALE_M = 1e-4
"""Of coordinates in the registered clouds."""
_VALUE_STEP_M = np.float32(2.0**-16)
"""Of distances and levels of detection in the registered clouds: with a power of two, half of their bytes are zero, and LAZ
compresses them well.
"""
_WRITTEN = 400_000
"""Points that are written at a time: a multiple of the 50,000 of a LAZ chunk."""


@dataclass(frozen=True)
class Followed:
    """The result of one epoch of `monitor` after its events were numbered over all epochs.

    Attributes
    ----------
    source : EpochSource
        The epoch's files and time.
    record : EpochRecord
        Registration, level of detection and changed regions of the epoch.
    regions : list of ChangedRegion
        The changed regions with the numbers of their events, which regions of several epochs at one place share.
    """

    source: EpochSource
    record: EpochRecord
    regions: list[ChangedRegion]

    @property
    def number(self) -> int:
        """Number of the epoch; the reference is 0."""
        return self.record.number


@dataclass(frozen=True)
class Result:
    """Result of a finished `monitor`.

    Attributes
    ----------
    folder : Path
        Folder of the results.
    sources : tuple of EpochSource
        Files and times of all epochs, the reference first.
    site : ReferenceSite
        The reference epoch: its frames, rasters and heights.
    epochs : tuple of Followed
        Results of the epochs after the reference.
    options : MonitorOptions
        Options of the call.
    """

    folder: Path
    sources: tuple[EpochSource, ...]
    site: ReferenceSite
    epochs: tuple[Followed, ...]
    options: MonitorOptions

    def rows(self) -> list[dict[str, Any]]:
        """Return the table of events: a row for each changed region of each epoch, as events.csv has it.

        A row holds the number of the event, epoch, time, place, size, depths, volume and marks by column name; None: unknown.
        """
        first = self._first_seen()
        rows = []
        for epoch in self.epochs:
            for region in epoch.regions:
                frame = self.site.views[region.view - 1].frame
                world = frame.to_world(np.array([region.x_m, region.y_m, region.z_m])).tolist()
                after, by = first[region.identity]
                known = region.numbers() | dict(zip(("world_x_m", "world_y_m", "world_z_m"), world, strict=True))
                known |= {"epoch": epoch.number, "time": epoch.source.time.text, "first_seen_after": after, "first_seen_by": by}
                known["marks"] = " ".join(region.marks)
                rows.append({name: None if _is_nan(known[name]) else known[name] for name in COLUMNS})
        return rows

    def outlines(self) -> list[list[FloatArray]]:
        """Return the outlines of the changed regions, in the order of the table of events.

        Each has a ring (n, 3) for each connected part, survey coordinates, m.
        """
        found = []
        for epoch in self.epochs:
            for region in epoch.regions:
                view = self.site.views[region.view - 1]
                found.append(in_survey(region, view.grid, view.raster.height, view.frame))
        return found

    def _first_seen(self) -> dict[int, tuple[str, str]]:
        """The two epochs, by time or by name, between which each event began, by the event's number."""
        names = [source.time.text or source.name for source in self.sources]
        first: dict[int, tuple[str, str]] = {}
        for epoch in self.epochs:
            for region in epoch.regions:
                first.setdefault(region.identity, (names[epoch.number - 1], names[epoch.number]))
        return first


def write_points(epoch: Followed, data: EpochData, site: ReferenceSite, out: Path) -> None:
    """Write an epoch's registered points as LAZ, with the difference, level of detection and event at each point.

    Parameters
    ----------
    epoch : Followed
        Result of the epoch.
    data : EpochData
        Its points as they were read, survey coordinates, m.
    site : ReferenceSite
        The reference epoch.
    out : Path
        Folder of the results, which has the epoch's maps already.
    """
    maps = [_PointMaps.of(epoch, view, out) for view in site.views]
    frame, motion = site.frame, epoch.record.transform
    to_registered = RigidTransform(motion.rotation @ frame.rotation, motion.translation)
    to_survey = RigidTransform(frame.rotation.T, frame.origin)
    types = {"distance_m": np.float32, "lod_m": np.float32, "event": maps[0].event.dtype}
    header = LazHeader(scale_m=_SCALE_M, wkt=data.crs)
    with chunk_writer(out / f"epoch_{epoch.number:03d}.laz", data.bounds, types, header) as file:
        to_steps = to_survey.rotation / file.scales[:, None], (to_survey.translation - file.offsets) / file.scales
        for piece in in_pieces(data.chunks(), _WRITTEN):

            def fill(records: NDArray[np.void], part: slice, piece: FloatArray = piece) -> None:
                wall = to_registered.apply_to_columns((piece[part] - frame.origin).T)
                for axis, rotation, shift in zip("XYZ", *to_steps, strict=True):
                    steps = rotation[0] * wall[0]
                    steps += rotation[1] * wall[1]
                    steps += rotation[2] * wall[2]
                    steps += shift
                    records[axis] = np.rint(steps, out=steps)
                if site.reference.partition is None:
                    maps[0].fill(records, wall)
                    return
                belongs, survey = site.reference.partition.of(wall.T), to_survey.apply(wall.T)
                for view, each in zip(site.views, maps, strict=True):
                    inside = np.flatnonzero(belongs == view.number - 1)
                    some = records[inside]
                    each.fill(some, view.frame.to_wall(survey[inside]).T)
                    records[inside] = some

            file.write(len(piece), fill)


_LEAST_LARGEST = 2**8
"""Least number for which the type of the events' numbers is chosen: one of two bytes."""


@dataclass(frozen=True)
class _PointMaps:
    """Maps of an epoch in one view, from which the points of the epoch get their values.

    They have a margin of one pixel, for points beside the maps.

    grid: of h x w pixels. values (h + 2, w + 2, 2): difference and level of detection of each pixel, m; NaN in the margin. event
    (h + 2, w + 2): number of the event, 0 for none, in two bytes where these suffice, so that LAZ takes less time. any_event:
    whether there is one.
    """

    grid: Grid
    values: NDArray[np.float32]
    event: NDArray[np.uint16] | NDArray[np.uint32]
    any_event: bool

    @classmethod
    def of(cls, epoch: Followed, view: WallView, out: Path) -> _PointMaps:
        """Read the maps of an epoch that are in the folder of results."""
        names = [out / f"{kind}_{epoch.number:03d}{view.suffix}.tif" for kind in ("difference", "lod")]
        values = np.stack([np.pad(read_geotiff(name)[0], 1, constant_values=np.nan) for name in names], axis=2)
        largest = max((region.identity for region in epoch.regions), default=0)
        event = np.pad(event_raster(epoch.regions, view), 1).astype(np.min_scalar_type(max(largest, _LEAST_LARGEST)))
        return cls(view.grid, np.rint(values / _VALUE_STEP_M) * _VALUE_STEP_M, event, bool(event.any()))

    def fill(self, records: NDArray[np.void], points: FloatArray) -> None:
        """Fill difference, level of detection and event of records (n,) from the maps at points (3, n), frame of the view."""
        column = (points[0] - (self.grid.x_min - self.grid.gsd)) / self.grid.gsd
        row = ((self.grid.y_max + self.grid.gsd) - points[1]) / self.grid.gsd
        pixel = np.clip(row, 0, self.grid.height + 1, out=row).astype(np.int64)
        pixel *= self.grid.width + 2
        pixel += np.clip(column, 0, self.grid.width + 1, out=column).astype(np.int64)
        _pairs_of(records)[:] = self.values.view(np.int64).ravel().take(pixel)
        records["event"] = self.event.ravel().take(pixel) if self.any_event else 0


def _pairs_of(records: NDArray[np.void]) -> NDArray[np.int64]:
    """Return a view (n,) of the pairs of difference and level of detection in records, eight bytes each, as one number."""
    place = records.dtype.fields["distance_m"][1] if records.dtype.fields else 0
    pair = np.dtype({"names": ["pair"], "formats": [np.int64], "offsets": [place], "itemsize": records.dtype.itemsize})
    return np.asarray(records.view(pair)["pair"])


def write_results(result: Result) -> None:
    """Write the results of `monitor` into its folder, once all epochs have been compared.

    These are the reference's heights, tables and outlines of events, COCO annotations and the report. monitor.json comes last and
    marks the folder as complete.
    """
    from pipeline.monitoring.report import write_report

    rows = result.rows()
    for view in result.site.views:
        write_geotiff(result.folder / f"reference{view.suffix}.tif", view.raster.height, view.grid)
    _write_table(result.folder / "events.csv", rows)
    write_geopackage(result.folder / "events.gpkg", "events", COLUMNS, rows, result.outlines(), result.site.crs)
    write_json(result.folder / "annotations.json", _coco(result.epochs, result.site.views))
    write_report(result)
    write_json(result.folder / "monitor.json", without_nan(_document(result, rows)))


def event_raster(regions: Sequence[ChangedRegion], view: WallView) -> NDArray[np.int32]:
    """Return the number of the event at each pixel (h, w) of a map, 0 for none; smaller events are drawn over larger ones.

    regions: changed regions of an epoch, numbered. view: the part of the wall that the map shows.
    """
    raster = np.zeros(view.grid.shape, dtype=np.int32)
    inside = (region for region in regions if region.view == view.number)
    for region in sorted(inside, key=lambda each: -each.area_m2):
        raster[region.window][region.mask] = region.identity
    return raster


def _write_table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for row in rows:
        table.writerow(["" if value is None else f"{value:.6g}" if isinstance(value, float) else value for value in _wide(row)])
    write_text(path, text.getvalue())


def _wide(row: dict[str, Any]) -> list[Any]:
    """The row's values, coordinates as text with millimetres."""
    return [f"{value:.3f}" if name.startswith("world_") and value is not None else value for name, value in row.items()]


def _coco(epochs: Sequence[Followed], views: Sequence[WallView]) -> dict[str, Any]:
    """The events as COCO annotations of the difference maps; `event` is the event's number."""
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    last = max((epoch.number for epoch in epochs), default=0)
    for view in views:
        height, width = view.grid.shape
        for epoch in epochs:
            image = epoch.number + (view.number - 1) * last
            name = f"difference_{epoch.number:03d}{view.suffix}.tif"
            images.append({"id": image, "file_name": name, "height": height, "width": width, "epoch": epoch.number})
            inside = [region for region in epoch.regions if region.view == view.number]
            annotations += [_annotation(region, image, view, len(annotations) + 1 + place) for place, region in enumerate(inside)]
    return {"images": images, "annotations": annotations, "categories": [BLOCK_CATEGORY]}


def _annotation(region: ChangedRegion, image: int, view: WallView, number: int) -> dict[str, Any]:
    """A region as COCO holds it."""
    height, width = region.mask.shape
    return {
        "id": number,
        "image_id": image,
        "category_id": BLOCK_CATEGORY["id"],
        "bbox": [region.column, region.row, width, height],
        "area": int(region.mask.sum()),
        "iscrowd": 0,
        "segmentation": run_length_encoding(region.mask, region.row, region.column, view.grid.shape),
        "event": region.identity,
        "kind": region.kind,
    }


def _document(result: Result, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """monitor.json."""
    site = result.site
    inputs = []
    by_number = {epoch.number: epoch.record for epoch in result.epochs}
    for number, source in enumerate(result.sources):
        record = by_number.get(number)
        inputs.append(
            {
                "epoch": number,
                "path": str(source.path),
                "sha256": source.checksums() if record is None else dict(record.inputs),
                "time": source.time.text or None,
                "time_source": source.time.source,
                "points": site.points if record is None else record.points,
                "unit": result.options.unit or _unit_of(site.notes if record is None else record.notes),
                "crs": site.crs or None,
                "notes": list(site.notes if record is None else record.notes),
            }
        )
    return {
        "schema": SCHEMA,
        "complete": True,
        "inputs": inputs,
        "options": result.options.to_dict(),
        **_place_of(site.views[0]),
        "views": [{"view": view.number, "suffix": view.suffix, **_place_of(view)} for view in site.views],
        "epochs": [
            {
                "epoch": epoch.number,
                "registration": epoch.record.registration,
                "level_of_detection_median_m": epoch.record.level_m,
                "predicted_level_m": epoch.record.predicted_level_m,
                "compared_area_m2": epoch.record.area_m2,
                "events": len(epoch.regions),
                "missing_m3": sum(each.volume_m3 for each in epoch.regions if each.kind == "missing"),
                "added_m3": sum(each.volume_m3 for each in epoch.regions if each.kind == "added"),
            }
            for epoch in result.epochs
        ],
        "events": list(rows),
        "versions": versions(),
    }


def _unit_of(notes: Sequence[str]) -> str:
    """Return the unit of an epoch's coordinates, as its reader noted it."""
    stated = next((note for note in notes if note.startswith(("the coordinates were converted from ", "the file states "))), None)
    return f"m ({stated})" if stated else "m (stated by the file or taken)"


def _place_of(view: WallView) -> dict[str, Any]:
    """Frame and grid of a view's maps."""
    frame, grid = view.frame, view.grid
    return {
        "wall_frame": {
            "matrix_world_to_wall": frame.matrix.tolist(),
            "rotation": frame.rotation.tolist(),
            "origin_m": frame.origin.tolist(),
        },
        "grid": {
            "x_min_m": grid.x_min,
            "y_max_m": grid.y_max,
            "gsd_m": grid.gsd,
            "width": grid.width,
            "height": grid.height,
        },
    }


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and bool(np.isnan(value))
