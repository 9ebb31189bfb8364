"""Run a whole simulation: fill the folder of `simulate`, epoch by epoch, and continue an interrupted run.

An epoch is done when its folder has its final name and run.json its checksums; everything in it has been written before. The
contents of an interrupted run's folder are therefore usable. A later call with `resume` makes only what is missing or damaged,
and the result is byte for byte that of an undisturbed run. Only one process at a time works in a folder.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.change.annotate import merge
from pipeline.config.simulation import CamerasFile, SensorName, SimulationConfig
from pipeline.formats.cameras.crs import wkt_of
from pipeline.formats.files.atomic import noting, remove_written, write_json
from pipeline.formats.files.checksum import sha256
from pipeline.formats.files.lock import is_free, locked
from pipeline.formats.files.own_folders import require_own_folder
from pipeline.formats.records.result_records import RUN_FILE, read_run
from pipeline.formats.records.run_files import epoch_folder
from pipeline.report.progress import Progress
from pipeline.report.provenance import versions
from pipeline.run.epoch import STAGES, ReferenceEpoch, observe_epoch, observe_reference
from pipeline.run.products import (
    CHANGE_ANNOTATIONS,
    EPOCH_RECORD,
    M3C2_ANNOTATIONS,
    Checksums,
    is_whole,
    write_epoch,
    write_reference,
)
from pipeline.run.series import SERIES_FILE, Series, SeriesScene, SeriesTruth, observe_series_epoch
from pipeline.run.site import SensorSite, prepare_site
from scene.common.backend import VARIANT
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.meshes.winding import CHECK_SIDE
from scene.walls.imported import ImportedWall

SCHEMA = 1
"""Version of run.json's structure."""


@dataclass(frozen=True)
class RunSummary:
    """What a simulation has written.

    Attributes
    ----------
    folder, report : Path
        Folder of the run, and its report.html.
    epochs : list of dict
        Record of each finished epoch, as in run.json: number of points, registration, statistics of the difference map, blocks.
    notes : tuple of str
        What the user should check, in words.
    """

    folder: Path
    report: Path
    epochs: list[dict[str, Any]]
    notes: tuple[str, ...] = ()


@dataclass
class _Run:
    """A run in progress.

    Attributes
    ----------
    out : Path
        Its folder.
    identity : dict
        Sensor, seed, config and inputs, which distinguish it from other runs.
    progress : Progress
        Receives the progress.
    products : dict
        Checksums by epoch folder, as in run.json.
    site : SensorSite, optional
        Wall and sensor, once they are set up.
    truth : SeriesTruth, optional
        Truth of a series, as far as it has been followed.
    """

    out: Path
    identity: dict[str, Any]
    progress: Progress
    products: dict[str, Checksums] = field(default_factory=dict)
    site: SensorSite | None = None
    truth: SeriesTruth | None = None

    def has(self, number: int) -> bool:
        """Return whether an epoch is finished."""
        return epoch_folder(self.out, number).name in self.products

    def note(self, number: int, checksums: Checksums) -> None:
        """Record in run.json that an epoch is finished."""
        found = {**self.products, epoch_folder(self.out, number).name: checksums}
        self.products = {name: found[name] for name in sorted(found, key=lambda name: (len(name), name))}
        write_json(self.out / RUN_FILE, {**self.identity, "complete": False, "products": self.products})


def simulate(
    config: SimulationConfig, sensor: SensorName, out: Path, *, resume: bool = False, progress: Progress | None = None
) -> RunSummary:
    """Simulate a rock wall before and after rockfalls as a sensor measures it, and write everything to a folder (a run).

    If the user interrupts it, the report and the other files about all finished epochs are written before KeyboardInterrupt is
    raised again.

    Parameters
    ----------
    config : SimulationConfig
        Wall, rockfalls, sensor and products.
    sensor : str
        "stereo" (stereo pair) or "tls" (laser scanner).
    out : Path
        A new or empty folder; with `resume`, that of an interrupted run with the same config.
    resume : bool
        Whether to continue an interrupted run.
    progress : Progress, optional
        Receives the progress.

    Returns
    -------
    RunSummary
        The folder, the report and the records of the epochs.

    Raises
    ------
    InputError
        If the folder is in use or belongs to another run, or if wall, sensor or blocks cannot be used.
    """
    progress = progress or Progress()
    if config.products.crs is not None:
        wkt_of(config.products.crs, "products.crs")  # report a mistake there before simulating
    progress.plan(_plan(config))
    identity = {"schema": SCHEMA, "sensor": sensor, "seed": config.seed, "config": config.model_dump(mode="json")}
    identity["inputs"] = _inputs(config)
    run = _Run(out, identity, progress)
    if resume and not (out / RUN_FILE).exists():
        raise InputError("the folder contains no run to resume", where=f"--out {out}", remedy="start the run without --resume")
    with locked(out), noting() as written:
        _claim(run, resume)
        try:
            site = _make_epochs(run, config, sensor)
        except InputError:
            _clean_up_after_error(run, resume, written)
            raise
        except KeyboardInterrupt:
            _remove_unfinished(out)
            if run.site is not None and run.has(0):
                _finish(run, run.site, complete=False)
            raise
        with progress.stage("report"):
            return _finish(run, site, complete=True)


def _make_epochs(run: _Run, config: SimulationConfig, sensor: SensorName) -> SensorSite:
    """Make the epochs that are missing, and return the site."""
    out, progress, random = run.out, run.progress, KeyedRandom(config.seed)
    with progress.stage("wall"):
        site = run.site = prepare_site(config, sensor, random)
        series = None if config.series is None else Series.of(config, config.series, site, random)
    reference = observe_reference(config, site if series is None else series.site_at(0), random, progress)
    if reference.seen is not None and not run.has(0):
        with progress.stage("epoch 0: write"):
            run.note(0, write_reference(out, config, site, reference, reference.seen))
    reference = replace(reference, seen=None)
    if series is not None:
        _make_series(run, series, reference)
        return site
    for number in range(1, config.epochs + 1):
        if not run.has(number):
            epoch = observe_epoch(config, site, reference, number, random, progress)
            with progress.stage(f"epoch {number}: write"):
                run.note(number, write_epoch(out, config, site, reference, epoch))
    return site


def _make_series(run: _Run, series: Series, reference: ReferenceEpoch) -> None:
    """Make the missing epochs of a series.

    The wall is followed through all epochs. Of a finished epoch only the registered heights may be needed again, for the change
    to the next one.
    """
    progress = run.progress
    truth = run.truth = SeriesTruth(series)
    last: SeriesScene | None = None
    before: NDArray[np.float32] | None = reference.raster.heights
    scenes = series.scenes()
    for number in range(1, series.series.count):
        with progress.stage(f"epoch {number}: carve"):
            scene = next(scenes)
        truth.add(scene)
        if run.has(number):
            last, before = scene, None
            continue
        if before is None and last is not None:
            before = observe_series_epoch(series, reference, last, None, progress).raster.heights
        epoch = observe_series_epoch(series, reference, scene, before, progress)
        with progress.stage(f"epoch {number}: write"):
            run.note(number, write_epoch(run.out, series.config, series.site, reference, epoch))
        last, before = scene, epoch.raster.heights


def _plan(config: SimulationConfig) -> dict[str, float]:
    """Return the stages of the run and their weights."""
    stages = {f"epoch 0: {name}": STAGES[name] for name in ("observe", "mesh", "difference", "write")}
    stages |= {f"epoch {number}: {name}": weight for number in range(1, config.last_epoch + 1) for name, weight in STAGES.items()}
    return {"wall": 3.0, **stages, "report": 1.0}


def _inputs(config: SimulationConfig) -> dict[str, str]:
    """Return the SHA-256 of the config's input files: a file replaced under the same name makes it another run.

    Missing files are left out; reading them raises the error.
    """
    named = [*config.wall.files] if isinstance(config.wall, ImportedWall) else []
    named += [] if config.series is None else [*config.series.surfaces]
    named += [config.cameras.file] if isinstance(config.cameras, CamerasFile) else []
    files = [file for path in named for file in (sorted(path.glob("*.txt")) if path.is_dir() else [path]) if file.is_file()]
    return {str(path): sha256(path) for path in files}


def _claim(run: _Run, resume: bool) -> None:
    """Make sure that the folder may be written to: it is new, empty, or that of an interrupted run with the same identity.

    The complete epochs of an interrupted run are kept.
    """
    out, identity, path = run.out, run.identity, run.out / RUN_FILE
    if not resume:
        if not is_free(out):
            remedy = "continue with --resume, or choose another --out" if path.exists() else "choose another --out"
            raise InputError("the folder exists and is not empty", where=f"--out {out}", remedy=remedy)
        write_json(path, {**identity, "complete": False})
        return
    earlier = read_run(path, "the run cannot be continued; choose another --out")
    _require_same(earlier, identity, out)
    _remove_unfinished(out)
    known: dict[str, Checksums] = earlier.get("products", {})
    run.products = {
        name: checksums
        for name, checksums in known.items()
        if f"{name}/{EPOCH_RECORD}" in checksums and is_whole(out, checksums, path)
    }


def _require_same(earlier: dict[str, Any], identity: dict[str, Any], out: Path) -> None:
    """Raise InputError if the folder belongs to another run."""
    changed = [key for key, value in identity.items() if earlier.get(key) != json.loads(json.dumps(value))]
    if changed == ["inputs"]:
        replaced = [
            Path(path).name for path, digest in identity["inputs"].items() if earlier.get("inputs", {}).get(path) != digest
        ]
        raise InputError(
            f"these input files have changed since the run in the folder was started: {', '.join(replaced)}",
            where=f"--out {out}",
            remedy="put them back as they were, or choose another --out",
        )
    if changed:
        raise InputError(
            f"the run in the folder was started with another {' and '.join(changed)}",
            where=f"--out {out}",
            remedy="resume with the same config, sensor and seed, or choose another --out",
        )


def _remove_unfinished(out: Path) -> None:
    """Remove the temporary folders of unfinished epochs."""
    for left in out.glob(".epoch_*"):
        require_own_folder(left)
        shutil.rmtree(left)


def _clean_up_after_error(run: _Run, resumed: bool, written: list[Path]) -> None:
    """After wrong input, remove what this run has written, unless a finished epoch makes it possible to continue.

    Files that others put into the folder meanwhile stay, and the folder with them.
    """
    _remove_unfinished(run.out)
    if resumed or run.has(1):
        return
    remove_written(run.out, written)


def _finish(run: _Run, site: SensorSite, *, complete: bool) -> RunSummary:
    """Write what covers all epochs: annotations.json, report.html and run.json."""
    from pipeline.run.report import write_run_report  # loads slowly, so not before it is needed

    out, identity = run.out, run.identity
    records = [json.loads((out / name / EPOCH_RECORD).read_text(encoding="utf-8")) for name in run.products]
    report = write_run_report(out, identity, site, records, complete=complete)
    annotations = [record.pop("annotations") for record in records]
    write_json(out / "annotations.json", merge(annotations))
    for name in (M3C2_ANNOTATIONS, CHANGE_ANNOTATIONS):
        beside = [record.pop(name) for record in records if name in record]
        if beside:
            write_json(out / f"{name}.json", merge(beside))
    if run.truth is not None:
        write_json(out / SERIES_FILE, run.truth.to_dict())
    record = {
        **identity,
        "complete": complete,
        "versions": versions(),
        "backend": VARIANT,
        "wall": {"name": site.name, "repairs": list(site.repairs), "triangles": len(site.mesh.faces)},
        "wall_frame": {
            "matrix_world_to_wall": site.frame.matrix.tolist(),
            "rotation": site.frame.rotation.tolist(),
            "origin_m": site.frame.origin.tolist(),
        },
        "epochs": records,
        "products": run.products,
        "seconds": run.progress.timings,
    }
    write_json(out / RUN_FILE, record)
    return RunSummary(out, report, records, tuple(f"{site.name}: {each}" for each in site.repairs if CHECK_SIDE in each))
