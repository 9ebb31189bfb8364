"""Go on with each new file of a permanent scanner, once it is whole."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.products import Result
from pipeline.monitoring.reading import epoch_files
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
    """Compare the files of a folder with the reference, and go on as more come.

    Parameters
    ----------
    paths : sequence of Path
        The reference, and epochs that are there already.
    folder : Path
        Where new files come, in the order of their names.
    out, options, times, workers, resume
        As `monitor_paths` has them. What is finished in `out` is taken over after every interruption.
    every_s : float
        Time between two looks at the folder, s.
    ended : callable
        Says when to stop; the default never does, and an interruption ends the command.
    told : callable
        Gets a line for each epoch.

    Returns
    -------
    Result
        Of all epochs, when `ended` says so.

    Raises
    ------
    InputError
        For a folder that is not there, and for a reference that cannot be used. A new file that cannot be used is told and left
        out.
    """
    if not folder.is_dir():
        raise InputError("is not a folder", where=f"--follow {folder}", remedy="name the folder in which new scans come")
    if times:
        raise InputError("cannot be combined with --follow, which reads the time of each epoch from its file", where="--times")
    keys: dict[str, Any] = {"workers": workers, "progress": Progress()}
    resume = resume or (out / "monitor.json").exists()
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
        raise InputError("no complete epoch has arrived in it yet", where=f"--follow {folder}")
    return result
