"""Define a bad input: what is damaged, the command that gets it, and whether the command's response is good.

A good response has exit status 0 or 2, no traceback, and one line of error after a 2. It leaves or changes no file. It uses less
than 2 GB, and less than 20 s of processor time (user and system) of the process and all its children, so that other work on the
machine does not matter. It also ends within three minutes of wall time, since a process that waits forever uses no processor
time.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from benchmarks.bad_inputs.preloaded import MOST_WALL_S, Ended, Order, Preloaded

MOST_SECONDS, MOST_GB = 20.0, 2.0
_LONGEST_LINE = 1500
PORT_IN_USE = 18_937
"""Port that is in use, so that `view` ends after reading its input instead of serving it."""


@dataclass(frozen=True)
class Case:
    """A bad input.

    Attributes
    ----------
    name : Name of the case, as in the list of found ones if it is from there.
    needs : Materials that are copied into the folder.
    spoil : Damages files in the folder.
    words : Words of the command.
    codes : Exit statuses that are right.
    """

    name: str
    words: tuple[str, ...]
    needs: tuple[str, ...] = ()
    spoil: Callable[[Path], object] = lambda folder: None
    codes: tuple[int, ...] = (0, 2)

    @property
    def command(self) -> str:
        return self.words[0]


@dataclass(frozen=True)
class Outcome:
    """Response of a command.

    Attributes
    ----------
    seconds : Processor time, s.
    wall_s : Wall time until it ended, s.
    problems : What is wrong with the response; empty for a good one.
    line : The last line that it printed.
    """

    case: Case
    code: int
    seconds: float
    wall_s: float
    gigabytes: float
    line: str
    problems: tuple[str, ...]


def tried(case: Case, materials: Path, folder: Path, forked_from: Preloaded | None = None) -> Outcome:
    """Damage copies of the materials in a new `folder` and run the command there as its own process.

    forked_from: process to fork from; None: run in this process, which is faster, without a check of memory and with an alarm as
    the time limit.
    """
    folder.mkdir(parents=True)
    for name in case.needs:
        source = materials / name
        shutil.copytree(source, folder / name, symlinks=True) if source.is_dir() else shutil.copy(source, folder / name)
    case.spoil(folder)
    before = _files(folder)
    run = partial(_run, forked_from=forked_from) if forked_from else _run_here
    with _port_in_use():
        ended, out, error = run(case.words, folder)
    lines = [line for line in error.splitlines() if line.strip()]
    last = (lines or out.splitlines() or [""])[-1]
    problems = _problems(case, ended, out, lines)
    if ended.code != 0 and _files(folder) != before:
        changed = sorted(set(_files(folder).items()) ^ set(before.items()))
        problems.append(f"files were left or changed: {', '.join(dict.fromkeys(name for name, _ in changed))[:200]}")
    return Outcome(case, ended.code, ended.own_s, ended.wall_s, ended.gigabytes, last[:400], tuple(problems))


@contextmanager
def _port_in_use() -> Iterator[None]:
    with socket.socket() as held:
        held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)  # other cases hold it too, and let go earlier
        with suppress(OSError):
            held.bind(("127.0.0.1", PORT_IN_USE))
            held.listen()
        yield


def _problems(case: Case, ended: Ended, out: str, lines: list[str]) -> list[str]:
    problems, code = [], ended.code
    if code not in case.codes:
        problems.append(f"exit status {code}")
    if any("Traceback" in line or "Warning:" in line for line in lines):
        problems.append("a traceback or a warning")
    if code == 2 and (len(lines) != 1 or not lines[0].startswith("error: ") or len(lines[0]) > _LONGEST_LINE):
        problems.append(f"{len(lines)} lines of error")
    if code == 2 and "--json" in case.words:
        problems += [] if _is_error_document(out) else ["no JSON document of the error"]
    elif code == 2 and out.strip():
        problems.append("output beside an error")
    if ended.own_s > MOST_SECONDS:
        problems.append(f"{ended.own_s:.0f} s")
    if ended.wall_s > MOST_WALL_S:
        problems.append(f"no end within {MOST_WALL_S:g} s")
    if ended.gigabytes > MOST_GB:
        problems.append(f"{ended.gigabytes:.1f} GB")
    return problems


def _is_error_document(out: str) -> bool:
    try:
        return set(json.loads(out)) == {"error", "exit_status"}
    except ValueError:
        return False


def _files(folder: Path) -> dict[str, tuple[int, int, int]]:
    """Return size, time of change and kind of everything in a folder, by name, without following links."""
    found = {}
    for base, folders, files in os.walk(folder):
        for name in [*folders, *files]:
            path = Path(base, name)
            state = path.lstat()
            is_folder = path.is_dir() and not path.is_symlink()
            found[str(path.relative_to(folder))] = (0, 0, 0) if is_folder else (state.st_size, state.st_mtime_ns, state.st_mode)
    return found


def _run(words: tuple[str, ...], folder: Path, forked_from: Preloaded) -> tuple[Ended, str, str]:
    """Run a command in a forked process; return how it ended, stdout and stderr."""
    out, error = folder.with_suffix(".out"), folder.with_suffix(".err")
    ended = forked_from.run(Order(words, str(folder), str(out), str(error)))
    texts = [path.read_text(encoding="utf-8", errors="replace") for path in (out, error)]
    return ended, texts[0], texts[1]


def _run_here(words: tuple[str, ...], folder: Path) -> tuple[Ended, str, str]:
    """As `_run`, in this process."""
    from pipeline.cli.main import main

    def too_long(*_: object) -> None:
        raise TimeoutError(f"no end within {MOST_WALL_S:g} s")

    began = time.monotonic(), time.process_time()
    before = signal.signal(signal.SIGALRM, too_long)
    signal.alarm(int(MOST_WALL_S))
    try:
        with chdir(folder), redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as error:
            code = main(list(words))
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    return Ended(code, time.monotonic() - began[0], time.process_time() - began[1], 0.0), out.getvalue(), error.getvalue()
