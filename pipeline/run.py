"""A whole run: the folder that `simulate` fills, epoch by epoch, and how an interrupted one goes on.

An epoch is done when its folder has its final name: everything of it is written before. What is in an interrupted run's folder is
therefore usable, and a later call with `resume` makes only what is missing; the bytes are those of an undisturbed run.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.annotate import merge
from pipeline.config import CamerasFile, SensorName, SimulationConfig
from pipeline.epoch import STAGES, observe_epoch, observe_reference
from pipeline.formats.atomic import write_json
from pipeline.products import EPOCH_RECORD, M3C2_ANNOTATIONS, epoch_folder, write_epoch, write_reference
from pipeline.progress import Progress
from pipeline.provenance import versions
from pipeline.report.assemble import write_run_report
from pipeline.site import Site, prepare_site
from scene.backend import VARIANT
from scene.errors import InputError
from scene.imported import ImportedWall
from scene.keyed_random import KeyedRandom

RUN_FILE = "run.json"
SCHEMA = 1


@dataclass(frozen=True)
class RunSummary:
    """What a run left behind. folder: of the run; report: its report.html; epochs: the records of the finished epochs."""

    folder: Path
    report: Path
    epochs: list[dict[str, Any]]


def simulate(
    config: SimulationConfig, sensor: SensorName, out: Path, *, resume: bool = False, progress: Progress | None = None
) -> RunSummary:
    """Observe a wall before and after rocks fall, and write a run folder.

    out: a folder that is new or empty, or with `resume` that of an interrupted run of the same config. Raises InputError for
    a folder in use, another config, and whatever is wrong with wall, sensor or blocks. On an interrupt the products of the
    finished epochs are completed before KeyboardInterrupt goes on.
    """
    progress = progress or Progress()
    progress.plan(_plan(config))
    identity = {"schema": SCHEMA, "sensor": sensor, "seed": config.seed, "config": config.model_dump(mode="json")}
    identity["inputs"] = _inputs(config)
    _claim(out, identity, resume)
    random = KeyedRandom(config.seed)
    try:
        with progress.stage("wall"):
            site = prepare_site(config, sensor, random)
        reference = observe_reference(config, site, random, progress)
        with progress.stage("epoch 0: write"):
            write_reference(out, config, site, reference)
        reference = replace(reference, seen=None)
        for number in range(1, config.epochs + 1):
            if not (epoch_folder(out, number) / EPOCH_RECORD).exists():
                epoch = observe_epoch(config, site, reference, number, random, progress)
                with progress.stage(f"epoch {number}: write"):
                    write_epoch(out, config, site, reference, epoch)
    except InputError:
        _leave_nothing_half_written(out, resume)
        raise
    except KeyboardInterrupt:
        _remove_unfinished(out)
        if epoch_folder(out, 0).exists():
            _finish(out, identity, site, progress, complete=False)
        raise
    with progress.stage("report"):
        return _finish(out, identity, site, progress, complete=True)


def _plan(config: SimulationConfig) -> dict[str, float]:
    stages = {f"epoch 0: {name}": STAGES[name] for name in ("observe", "mesh", "difference", "write")}
    stages |= {f"epoch {number}: {name}": weight for number in range(1, config.epochs + 1) for name, weight in STAGES.items()}
    return {"wall": 3.0, **stages, "report": 1.0}


def _inputs(config: SimulationConfig) -> dict[str, str]:
    """The config's input files and their SHA-256: a mesh replaced under the same name makes another run.

    A file that is not there is left out: whoever reads it says so.
    """
    named = [config.wall.mesh] if isinstance(config.wall, ImportedWall) else []
    named += [config.cameras.file] if isinstance(config.cameras, CamerasFile) else []
    files = [file for path in named for file in (sorted(path.glob("*.txt")) if path.is_dir() else [path]) if file.is_file()]
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _claim(out: Path, identity: dict[str, Any], resume: bool) -> None:
    """Make sure that `out` is ours to write to: new, empty, or an interrupted run of the same identity."""
    path = out / RUN_FILE
    if out.exists() and not out.is_dir():
        raise InputError("is a file", where=f"--out {out}", remedy="choose a folder")
    if not resume:
        if out.exists() and any(out.iterdir()):
            remedy = "go on with --resume, or choose another --out" if path.exists() else "choose another --out"
            raise InputError("the folder exists and is not empty", where=f"--out {out}", remedy=remedy)
        write_json(path, {**identity, "complete": False})
        return
    if not path.exists():
        raise InputError("holds no run to resume", where=f"--out {out}", remedy="start it without --resume")
    earlier = json.loads(path.read_text(encoding="utf-8"))
    changed = [key for key, value in identity.items() if earlier.get(key) != json.loads(json.dumps(value))]
    if changed == ["inputs"]:
        replaced = [
            Path(path).name for path, digest in identity["inputs"].items() if earlier.get("inputs", {}).get(path) != digest
        ]
        raise InputError(
            f"the run in the folder was begun with another {', '.join(replaced)}",
            where=f"--out {out}",
            remedy="put the file back as it was, or choose another --out",
        )
    if changed:
        raise InputError(
            f"the run in the folder has another {' and '.join(changed)}",
            where=f"--out {out}",
            remedy="resume with the same config, sensor and seed, or choose another --out",
        )
    _remove_unfinished(out)


def _remove_unfinished(out: Path) -> None:
    for left in out.glob(".epoch_*"):
        shutil.rmtree(left)


def _leave_nothing_half_written(out: Path, resumed: bool) -> None:
    """After wrong input: remove what this run has written, unless an epoch is finished that could be gone on from."""
    _remove_unfinished(out)
    if not resumed and not epoch_folder(out, 1).exists():
        shutil.rmtree(out)


def _finish(out: Path, identity: dict[str, Any], site: Site, progress: Progress, *, complete: bool) -> RunSummary:
    """Write what covers all epochs: annotations.json, report.html and run.json."""
    records = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(out.glob(f"epoch_*/{EPOCH_RECORD}"))]
    report = write_run_report(out, identity, site, records, complete=complete)
    annotations = [record.pop("annotations") for record in records]
    write_json(out / "annotations.json", merge(annotations))
    if any(M3C2_ANNOTATIONS in record for record in records):
        beside = [record.pop(M3C2_ANNOTATIONS) for record in records if M3C2_ANNOTATIONS in record]
        write_json(out / f"{M3C2_ANNOTATIONS}.json", merge(beside))
    run = {
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
        "seconds": progress.timings,
    }
    write_json(out / RUN_FILE, run)
    return RunSummary(out, report, records)
