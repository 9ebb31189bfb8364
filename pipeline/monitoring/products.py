"""Write what a monitoring found: monitor.json, tables and outlines of events, registered points, COCO, the report."""

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
from pipeline.formats.points.laz_chunks import write_chunks
from pipeline.formats.rasters.geotiff import read_geotiff, write_geotiff
from pipeline.formats.records.geopackage import write_geopackage
from pipeline.monitoring.events import ChangedRegion
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.outlines import in_survey
from pipeline.monitoring.reading import EpochData, EpochSource
from pipeline.monitoring.records import EpochRecord
from pipeline.monitoring.site import ReferenceSite
from pipeline.report.provenance import versions
from scene.geometry.mesh import FloatArray

SCHEMA = 1
COLUMNS: dict[str, type] = {
    "id": int, "epoch": int, "time": str, "first_seen_after": str, "first_seen_by": str, "kind": str,
    "x_m": float, "y_m": float, "world_x_m": float, "world_y_m": float, "world_z_m": float,
    "width_m": float, "height_m": float, "area_m2": float, "depth_median_m": float, "depth_largest_m": float,
    "volume_m3": float, "volume_std_m3": float, "significance": float, "score": float, "marks": str,
}  # fmt: skip
"""Of events.csv and events.gpkg."""
_SCALE_M = 1e-4
"""Of coordinates in the registered clouds."""


@dataclass(frozen=True)
class Followed:
    """One epoch with its events numbered. regions: the same as those of the record, with their events' numbers."""

    source: EpochSource
    record: EpochRecord
    regions: list[ChangedRegion]

    @property
    def number(self) -> int:
        """Of the epoch."""
        return self.record.number


@dataclass(frozen=True)
class Result:
    """A finished monitoring. folder: of the products; sources: the reference first; epochs: all others."""

    folder: Path
    sources: tuple[EpochSource, ...]
    site: ReferenceSite
    epochs: tuple[Followed, ...]
    options: MonitorOptions

    def rows(self) -> list[dict[str, Any]]:
        """A row for each event and epoch, as `COLUMNS` has them; None for what is not known."""
        first = self._first_seen()
        rows = []
        for epoch in self.epochs:
            for region in epoch.regions:
                world = self.site.frame.to_world(np.array([region.x_m, region.y_m, region.z_m])).tolist()
                after, by = first[region.identity]
                known = region.numbers() | dict(zip(("world_x_m", "world_y_m", "world_z_m"), world, strict=True))
                known |= {"epoch": epoch.number, "time": epoch.source.time.text, "first_seen_after": after, "first_seen_by": by}
                known["marks"] = " ".join(region.marks)
                rows.append({name: None if _is_nan(known[name]) else known[name] for name in COLUMNS})
        return rows

    def _first_seen(self) -> dict[int, tuple[str, str]]:
        """Between which two epochs, by time or by name, each event began."""
        names = [source.time.text or source.name for source in self.sources]
        first: dict[int, tuple[str, str]] = {}
        for epoch in self.epochs:
            for region in epoch.regions:
                first.setdefault(region.identity, (names[epoch.number - 1], names[epoch.number]))
        return first


def write_points(epoch: Followed, data: EpochData, site: ReferenceSite, out: Path) -> None:
    """Write an epoch's points, registered, in survey coordinates, with what the maps say at each."""
    maps = [read_geotiff(out / f"{kind}_{epoch.number:03d}.tif")[0] for kind in ("difference", "lod")]
    maps.append(event_raster(epoch.regions, site.grid.shape).astype(np.float32))

    def registered(points: FloatArray) -> tuple[FloatArray, dict[str, NDArray[Any]]]:
        wall = epoch.record.transform.apply(site.frame.to_wall(points))
        distance, level, event = _at(maps, wall, site)
        extra = {"distance_m": distance, "lod_m": level, "event": np.nan_to_num(event).astype(np.uint32)}
        return site.frame.to_world(wall), extra

    header = LazHeader(scale_m=_SCALE_M, wkt=data.crs)
    write_chunks(out / f"epoch_{epoch.number:03d}.laz", data.bounds, map(registered, data.chunks()), header)


def write_results(result: Result) -> None:
    """Write the tables, the outlines, COCO, the report, and monitor.json at the end."""
    from pipeline.monitoring.report import write_report

    rows = result.rows()
    write_geotiff(result.folder / "reference.tif", result.site.reference.raster.height, result.site.grid)
    _write_table(result.folder / "events.csv", rows)
    grid, heights = result.site.grid, result.site.reference.raster.height
    outlines = [in_survey(region, grid, heights, result.site.frame) for epoch in result.epochs for region in epoch.regions]
    write_geopackage(result.folder / "events.gpkg", "events", COLUMNS, rows, outlines, result.site.crs)
    write_json(result.folder / "annotations.json", _coco(result.epochs, grid.shape))
    write_report(result)
    write_json(result.folder / "monitor.json", without_nan(_document(result, rows)))


def event_raster(regions: Sequence[ChangedRegion], shape: tuple[int, ...]) -> NDArray[np.int32]:
    """(h, w) the number of the event at each pixel, 0 where there is none; smaller events lie over larger ones."""
    raster = np.zeros(shape, dtype=np.int32)
    for region in sorted(regions, key=lambda each: -each.area_m2):
        raster[region.window][region.mask] = region.identity
    return raster


def _at(rasters: Sequence[NDArray[np.float32]], wall: FloatArray, site: ReferenceSite) -> list[NDArray[np.float32]]:
    """(n,) each raster's values at points (n, 3) of the wall frame, NaN beside the map."""
    grid = site.grid
    column = np.floor((wall[:, 0] - grid.x_min) / grid.gsd)
    row = np.floor((grid.y_max - wall[:, 1]) / grid.gsd)
    inside = (column >= 0) & (column < grid.width) & (row >= 0) & (row < grid.height)
    pixel = (row[inside] * grid.width + column[inside]).astype(np.int64)
    found = np.full((len(rasters), len(wall)), np.nan, dtype=np.float32)
    for values, raster in zip(found, rasters, strict=True):
        values[inside] = raster.ravel()[pixel]
    return list(found)


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


def _coco(epochs: Sequence[Followed], shape: tuple[int, ...]) -> dict[str, Any]:
    """The events as COCO annotations of the difference maps; `event` is the event's number."""
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for epoch in epochs:
        name = f"difference_{epoch.number:03d}.tif"
        images.append({"id": epoch.number, "file_name": name, "height": shape[0], "width": shape[1], "epoch": epoch.number})
        for region in epoch.regions:
            height, width = region.mask.shape
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": epoch.number,
                    "category_id": BLOCK_CATEGORY["id"],
                    "bbox": [region.column, region.row, width, height],
                    "area": int(region.mask.sum()),
                    "iscrowd": 0,
                    "segmentation": run_length_encoding(region.mask, region.row, region.column, shape),
                    "event": region.identity,
                    "kind": region.kind,
                }
            )
    return {"images": images, "annotations": annotations, "categories": [BLOCK_CATEGORY]}


def _document(result: Result, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """monitor.json."""
    site, frame = result.site, result.site.frame
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
                "unit": result.options.unit or "m (stated by the file or taken)",
                "crs": site.crs or None,
                "notes": list(site.notes if record is None else record.notes),
            }
        )
    return {
        "schema": SCHEMA,
        "complete": True,
        "inputs": inputs,
        "options": result.options.to_dict(),
        "wall_frame": {
            "matrix_world_to_wall": frame.matrix.tolist(),
            "rotation": frame.rotation.tolist(),
            "origin_m": frame.origin.tolist(),
        },
        "grid": {
            "x_min_m": site.grid.x_min,
            "y_max_m": site.grid.y_max,
            "gsd_m": site.grid.gsd,
            "width": site.grid.width,
            "height": site.grid.height,
        },
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


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and bool(np.isnan(value))
