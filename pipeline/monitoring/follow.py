"""Watch a folder into which a permanent scanner writes, and compare each new file once it is complete."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pipeline.formats.files.atomic import empty_folder
from pipeline.monitoring.detector import check_detector_name
from pipeline.monitoring.model import scanner_model
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.products import Result
from pipeline.monitoring.reading import epoch_files
from pipeline.monitoring.records import can_be_resumed
from pipeline.monitoring.run import monitor_paths
from pipeline.report.progress import Progress
from pipeline.report.words import counted
from scene.common.errors import InputError

_EVERY_S = 5.0
"""Time between two looks at the folder; a file is whole once its size and time are the same at two looks."""


def follow(
    paths: Sequence[Path],
    folder: Path,
    out: Path,
    options: MonitorOptions,
    *,
    times: Sequence[str] = (),
    workers: int = 1,
    resume: bool = False,
    every_s: float = _EVERY_S,
    ended: Callable[[], bool] = lambda: False,
    told: Callable[[str], None] = print,
) -> Result:
    """Compare the epochs in a folder with the reference, and go on waiting for further files, for example of a permanent scanner.

    Parameters
    ----------
    paths : sequence of Path
        Files of the reference, and of epochs that exist already.
    folder : Path
        Folder into which new files are written, one for each epoch; they are compared in the order of their names.
    out : Path
        Folder of the results: new, empty, or that of an earlier call, which is continued.
    options : MonitorOptions
        All other options of `scarpsim monitor`.
    times : sequence of str
        Accepted because `monitor_paths` has it, but must be empty: the time of each epoch comes from its file.
    workers : int
        Number of processes; the results do not depend on it.
    resume : bool
        Must be True to continue an earlier call that stopped before its results were complete. Complete results are continued
        in any case, and an empty folder is filled in any case.
    every_s : float
        Time between two looks at the folder, s.
    ended : callable
        Returns True when watching shall stop. The default never does, so that only an interruption (Ctrl-C) ends it.
    told : callable
        Receives a line of text for each epoch.

    Returns
    -------
    Result
        The result of all epochs, once `ended` returns True.

    Raises
    ------
    InputError
        If the folder does not exist, `out` holds anything else, the reference cannot be used, times are given, or no epoch
        arrived. A new file that cannot be used is reported to `told` and left out.
    """
    if not folder.is_dir():
        raise InputError(
            "the path is not a folder", where=f"--follow {folder}", remedy="name the folder into which new scans are written"
        )
    if times:
        raise InputError(
            "the option cannot be combined with --follow, which reads the time of each epoch from its file",
            where="--times",
            remedy="leave --times out",
        )
    keys: dict[str, Any] = {"workers": workers, "progress": Progress()}
    scanner_model(options)  # a wrong preset, file or detector is reported before waiting
    check_detector_name(options.detector)
    resume = (resume and can_be_resumed(out)) or (out / "monitor.json").exists()
    if not resume:
        empty_folder(out)
    result = monitor_paths(paths, out, options, resume=resume, **keys) if len(paths) > 1 else None
    used, bad, before = list(paths), set[Path](), dict[Path, tuple[int, int]]()
    while not ended():
        now = {file: (file.stat().st_size, file.stat().st_mtime_ns) for file in epoch_files(folder)}
        for file in sorted(file for file in now if before.get(file) == now[file] and file not in {*used, *bad}):
            try:
                result = monitor_paths([*used, file], out, options, resume=resume or result is not None, **keys)
            except InputError as error:
                bad.add(file)
                told(f"left out: {error}")
                continue
            used.append(file)
            told(f"{file.name}: {counted(len(result.epochs[-1].regions), 'event')}")
        before = now
        time.sleep(every_s)
    if result is None:
        raise InputError(
            "no epoch that could be used arrived in the folder before the command ended",
            where=f"--follow {folder}",
            remedy="copy scans into this folder, and let the command run longer",
        )
    return result
