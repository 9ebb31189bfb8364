"""Run `monitor` from files to events: read, register, compute differences and levels of detection, find events, write results.

The reference is read once. Each further epoch is compared with it by itself, in this process or in several, and its record is
kept, so that an interrupted monitoring goes on. Events get their numbers at the end, in the order of the epochs.
"""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from pipeline.dataset.cluster import BackgroundWorkers, map_on_workers, workers_in_background
from pipeline.formats.files.atomic import empty_folder, write_bytes
from pipeline.formats.files.checksum import sha256
from pipeline.formats.rasters.geotiff import write_geotiff
from pipeline.monitoring.comparison import EpochChange, compare_epoch
from pipeline.monitoring.detector import check_detector_name, regions_of_detector
from pipeline.monitoring.events import Catalogue
from pipeline.monitoring.model import predicted_level, scanner_model
from pipeline.monitoring.options import NO_DETECTOR, MonitorOptions
from pipeline.monitoring.plausibility import check_motion, compared_area, remarks
from pipeline.monitoring.point_writing import PointsInOrder, write_points_once
from pipeline.monitoring.products import Followed, Result, write_results
from pipeline.monitoring.reading import EpochData, EpochSource, find_epochs, read_epoch
from pipeline.monitoring.records import KEPT, EpochRecord, can_be_resumed, discard, kept
from pipeline.monitoring.site import ReferenceSite, prepared
from pipeline.monitoring.stable_areas import StableRock
from pipeline.monitoring.targets import TargetFit, fit_targets, read_targets
from pipeline.report.progress import Progress
from scene.common.errors import InputError

_MODULES = ("pipeline.monitoring.run", "pipeline.monitoring.report")
"""Modules that workers need, and import while the reference is prepared."""
_TENTH = 0.1
_UNLIKE_UNITS = 3.0
"""Ratio of the extents of two epochs from which their units are taken to differ."""


def monitor_paths(
    paths: Sequence[Path],
    out: Path,
    options: MonitorOptions,
    *,
    times: Sequence[str] = (),
    workers: int = 1,
    resume: bool = False,
    progress: Progress | None = None,
) -> Result:
    """Compare the epochs that the user's paths name with the first one, and write the folder of results.

    Parameters
    ----------
    paths : sequence of Path
        Files, folders of scans or runs of `simulate`; the first epoch is the reference.
    out : Path
        New or empty folder, or with `resume` the folder of an interrupted run.
    options : MonitorOptions
        All other options.
    times : sequence of str
        Time of each epoch, ISO 8601; empty: as the files state.
    workers : int
        Number of processes; the results do not depend on it.
    resume : bool
        Whether to keep the epochs that are finished in `out`.
    progress : Progress, optional
        Receives the progress.

    Returns
    -------
    Result
        The result of all epochs, as it was written.

    Raises
    ------
    InputError
        If a path or file cannot be used, or if an epoch does not overlap the reference.
    """
    return monitor(find_epochs(paths, times), out, options, workers=workers, resume=resume, progress=progress)


def monitor(
    sources: Sequence[EpochSource],
    out: Path,
    options: MonitorOptions,
    *,
    workers: int = 1,
    resume: bool = False,
    progress: Progress | None = None,
) -> Result:
    """Compare the epochs of a wall with the first one, and write the folder of results.

    Parameters
    ----------
    sources : sequence of EpochSource
        Files and times of all epochs, the reference first.
    out : Path
        New or empty folder, or with `resume` the folder of an interrupted run.
    options : MonitorOptions
        All other options.
    workers : int
        Number of processes; the results do not depend on it.
    resume : bool
        Whether to keep the epochs that are finished in `out`.
    progress : Progress, optional
        Receives the progress.

    Returns
    -------
    Result
        The result of all epochs, as it was written.

    Raises
    ------
    InputError
        If a file cannot be used, or if an epoch does not overlap the reference.
    """
    progress = progress or Progress()
    scanner_model(options)  # a wrong preset, file or detector is reported before any work
    check_detector_name(options.detector)
    if not resume:
        empty_folder(out)
    elif not can_be_resumed(out):
        raise InputError(
            "there is no monitoring to resume in the folder",
            where=f"--resume, --out {out}",
            allowed="the folder of an interrupted monitoring",
            remedy="start without --resume, or correct --out",
        )
    count = min(workers, len(sources) - 1)
    with ExitStack() as stack:
        # An earlier call may have left nothing to do, so workers of a resumed one are started where they are needed.
        early = count > 1 and not resume
        started = stack.enter_context(workers_in_background(count, _MODULES)) if early else None
        return _monitored(sources, out, options, count, resume, progress, started)


def _monitored(
    sources: Sequence[EpochSource],
    out: Path,
    options: MonitorOptions,
    workers: int,
    resume: bool,
    progress: Progress,
    started: BackgroundWorkers | None,
) -> Result:
    """Do the work of `monitor`, on workers that were started before if there are any."""
    with progress.stage(f"reference {sources[0].name}"):
        site = prepared(sources[0], options)
    fingerprint = _fingerprint(site, options)
    further = list(enumerate(sources[1:], start=1))
    progress.plan({f"epoch {number}": 1.0 for number, _ in further} | {"report": 0.3})
    records = {number: kept(out, number, source.checksums(), fingerprint) for number, source in further} if resume else {}
    left = [(number, source) for number, source in further if records.get(number) is None]
    for number, _ in left:
        discard(out, number)
    if workers > 1 and len(left) > 1:
        records |= _compared_in_processes(left, site, out, options, fingerprint, workers, progress, started)
    followed = []
    catalogue = Catalogue()
    for number, source in further:
        with progress.stage(f"epoch {number}"):
            record, data = records.get(number), None
            if record is None:
                record, data = processed(number, source, site, out, options, fingerprint)
            epoch = Followed(source, record, catalogue.identified(record.regions))
            write_points_once(epoch, data, site, out, fingerprint, options)
            followed.append(epoch)
    with progress.stage("report"):
        result = Result(out, tuple(sources), site, tuple(followed), options)
        write_results(result)
    return result


def _fingerprint(site: ReferenceSite, options: MonitorOptions) -> str:
    """Of all that a record depends on beside its epoch."""
    told = {
        "reference": site.source.checksums(),
        "options": options.to_dict(),
        "grids": [view.grid.__dict__ for view in site.views],
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()


def _checksum(path: Path | None) -> str:
    return "" if path is None else sha256(path)


def _compared_in_processes(
    left: Sequence[tuple[int, EpochSource]],
    site: ReferenceSite,
    out: Path,
    options: MonitorOptions,
    fingerprint: str,
    workers: int,
    progress: Progress,
    started: BackgroundWorkers | None,
) -> dict[int, EpochRecord | None]:
    """The records of epochs, compared on local workers of Dask, by number."""
    found: dict[int, EpochRecord | None] = {}
    shared = out / KEPT / "reference.pickle"
    tasks = [(number, source, shared, out, options, fingerprint) for number, source in left]
    with progress.stage("comparisons"):
        write_bytes(shared, pickle.dumps(site, pickle.HIGHEST_PROTOCOL))
        try:
            for record in map_on_workers(_in_worker, tasks, workers, started):
                if not found:
                    import pipeline.monitoring.report  # noqa: F401  loads Matplotlib while the workers are busy
                found[record.number] = record
                progress.advance(len(found) / len(left))
        finally:
            shared.unlink()
    return found


def _in_worker(
    number: int, source: EpochSource, reference: Path, out: Path, options: MonitorOptions, fingerprint: str
) -> EpochRecord:
    points = _points_of_worker(reference, _Frozen(options), out, fingerprint)
    record, data = processed(number, source, points.site, out, options, fingerprint)
    points.add(source, record, data)
    return record


class _Frozen:
    """Options as a key of a cache."""

    def __init__(self, options: MonitorOptions) -> None:
        self.options = options
        self._key = json.dumps(options.to_dict(), sort_keys=True, default=str)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Frozen) and self._key == other._key


@lru_cache(1)
def _points_of_worker(reference: Path, frozen: _Frozen, out: Path, fingerprint: str) -> PointsInOrder:
    """Return what writes the points of this process's epochs. reference: file with the prepared ReferenceSite, read once."""
    return PointsInOrder(pickle.loads(reference.read_bytes()), out, fingerprint, frozen.options)


def processed(
    number: int, source: EpochSource, site: ReferenceSite, out: Path, options: MonitorOptions, fingerprint: str
) -> tuple[EpochRecord, EpochData]:
    """Read one epoch, compare it with the reference, and write its maps and its stored result.

    Parameters
    ----------
    number : int
        Number of the epoch.
    source : EpochSource
        Its files.
    site : ReferenceSite
        The reference epoch: its frames, rasters and heights.
    out : Path
        Folder of the results.
    options : MonitorOptions
        All other options.
    fingerprint : str
        Checksum of the reference and the options, which is stored with the result.

    Returns
    -------
    (EpochRecord, EpochData)
        The result, and the content of the epoch's files.
    """
    data = read_epoch(source, options)
    notes = [*data.notes, *_check_same_site(data, site, source)]
    points = data.wall_points(site.frame, site.grid.gsd, several=len(site.views) > 1)
    by_targets = _by_targets(options, site, source)
    start = None if by_targets is None else by_targets.transform
    found = compare_epoch(site.reference, points, StableRock(options.stable, site.frame), options.seed, start)
    if by_targets is None:
        check_motion(found.first, points.sample, site, source.name)
    else:
        notes.append(f"{by_targets.count} targets brought it near the reference, with an RMS of {1e3 * by_targets.rms_m:.1f} mm")
    notes += remarks(found, site, source.name)
    regions = found.regions if options.detector == NO_DETECTOR else []
    for view, change in zip(site.views, found.changes, strict=True):
        difference = out / f"difference_{number:03d}{view.suffix}.tif"
        write_geotiff(difference, change.difference, view.grid)
        write_geotiff(out / f"lod_{number:03d}{view.suffix}.tif", change.significance.level, view.grid)
        if options.detector != NO_DETECTOR:
            detected = regions_of_detector(options.detector, difference, change)
            regions += [replace(region, view=view.number) for region in detected]
    levels = np.concatenate([change.significance.level[np.isfinite(change.significance.level)] for change in found.changes])
    record = EpochRecord(
        number=number,
        inputs=source.checksums(),
        points=data.count,
        notes=(*notes, *found.alignment.notes),
        transform=found.transform,
        registration={**found.alignment.to_dict(), **found.transform.to_dict()},
        level_m=float(np.median(levels)),
        predicted_level_m=_predicted(options, site, found),
        area_m2=compared_area(found, site),
        regions=tuple(regions),
    )
    record.write(out, fingerprint, [view.grid.shape for view in site.views])
    return record, data


def _by_targets(options: MonitorOptions, site: ReferenceSite, source: EpochSource) -> TargetFit | None:
    if options.targets is None:
        return None
    return fit_targets(read_targets(options.targets), site.source.name, source.name, site.frame)


def _predicted(options: MonitorOptions, site: ReferenceSite, found: EpochChange) -> float:
    model = None if options.photographs else scanner_model(options)
    if model is None:
        return float("nan")
    return predicted_level(model, site.views[0].raster, found.changes[0].epoch, site.station)


def _check_same_site(data: EpochData, site: ReferenceSite, source: EpochSource) -> list[str]:
    """Return remarks on an epoch's coordinates and density. Raises InputError if it lies elsewhere or is in another unit."""
    wall = site.frame.to_wall(data.points[:: max(len(data.points) // 100_000, 1)])
    if site.reference.partition is not None:
        wall = wall[site.reference.partition.of(wall) == 0]
    grid = site.grid
    extent = np.ptp(np.quantile(wall[:, :2], [0.02, 0.98], axis=0), axis=0)
    ratio = float(np.min(extent / np.array([grid.width * grid.gsd, grid.height * grid.gsd])))
    inside = (np.abs(wall[:, 0] - grid.x_min - grid.width * grid.gsd / 2) < grid.width * grid.gsd) & (
        np.abs(wall[:, 1] - grid.y_max + grid.height * grid.gsd / 2) < grid.height * grid.gsd
    )
    if not inside.mean() > _TENTH:
        unit = " or units" if ratio > _UNLIKE_UNITS or ratio < 1 / _UNLIKE_UNITS else ""
        raise InputError(
            f"the epoch lies elsewhere than the reference {site.source.name}: its middle is "
            f"{np.linalg.norm(np.median(wall, axis=0)):,.0f} m from the wall's corner; their coordinate systems{unit} differ",
            where=source.name,
            allowed="epochs of one coordinate system",
            remedy="export all epochs in one coordinate system, or give the unit of their coordinates with --unit",
        )
    if data.crs and site.crs and data.crs != site.crs and not _same_system(data.crs, site.crs):
        raise InputError(
            "the epoch is in another coordinate system than the reference",
            where=source.name,
            remedy="transform one of the two into the coordinate system of the other",
        )
    if data.count < _TENTH * site.points:
        return [f"has {data.count:,} points where the reference has {site.points:,}: small changes do not show"]
    return []


def _same_system(one: str, other: str) -> bool:
    from pyproj import CRS

    return bool(CRS.from_wkt(one).equals(CRS.from_wkt(other), ignore_axis_order=True))
