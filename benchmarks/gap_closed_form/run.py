"""Evaluate `scarpsim gap` on closed-form measurements with hidden truth, as GAP.md specifies.

The measurements are made, diagnosed by the command, and scored.

    python benchmarks/gap_closed_form/run.py --cases 60 --seed 1 --jobs 1 --out /tmp/closed_form

An interrupted run continues. Under --out are cases/ (what the diagnosis gets), truth/ (which a diagnosing process must not open),
answers/ (gap.json of each), results.json and table.md.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from importlib.metadata import entry_points
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import psutil

from benchmarks.gap_closed_form.cases import SENSORS, STRATA, Case, make, plan
from benchmarks.gap_closed_form.score import score
from benchmarks.gap_closed_form.table import markdown

TIME_LIMIT_S = 480.0  # of processor time, so that other work on the machine makes no difference
_CONTEXT = multiprocessing.get_context("spawn")


def run(
    count: int,
    seed: int,
    jobs: int,
    out: Path,
    *,
    small: bool = False,
    keep: bool = False,
    limit_s: float = TIME_LIMIT_S,
    stratum: str | None = None,
    sensor: str | None = None,
) -> dict[str, Any]:
    """Make missing cases, diagnose those without an answer, and score.

    keep: keep the measurements and everything that the command writes; stratum, sensor: only these cases.
    """
    out.mkdir(parents=True, exist_ok=True)
    every = plan(count, seed, small)
    cases = [case for case in every if case.stratum == (stratum or case.stratum) and case.sensor == (sensor or case.sensor)]
    chosen = {key: value for key, value in {"stratum": stratum, "sensor": sensor}.items() if value}
    _check_same(out / "settings.json", {"cases": count, "seed": seed, "small": small, **chosen})
    open_cases = [case for case in cases if not _answer(out, case).exists()]
    missing = [
        case for case in open_cases if not _truth(out, case).exists() or not (_folder(out, case) / "measurement.yaml").exists()
    ]
    print(f"{len(cases)} cases, {len(missing)} to make, {len(open_cases)} to diagnose", flush=True)
    if missing:
        with ProcessPoolExecutor(jobs, mp_context=_CONTEXT) as pool:
            list(pool.map(_make, [(case, _folder(out, case), _truth(out, case)) for case in missing]))
    _diagnose_all(open_cases, out, jobs, limit_s, keep)
    settings = {"cases": count, "seed": seed, "small": small, **chosen, "commit": _commit()}
    found = {"settings": settings, **score([_pair(out, case) for case in cases])}
    (out / "results.json").write_text(json.dumps(found, indent=1))
    (out / "table.md").write_text(markdown(found))
    return found


def _commit() -> str:
    """Return the commit of the program; "" outside of a checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def _folder(out: Path, case: Case) -> Path:
    return out / "cases" / case.name


def _truth(out: Path, case: Case) -> Path:
    return out / "truth" / f"{case.name}.json"


def _answer(out: Path, case: Case) -> Path:
    return out / "answers" / f"{case.name}.json"


def _pair(out: Path, case: Case) -> tuple[dict[str, Any], dict[str, Any]]:
    return json.loads(_truth(out, case).read_text()), json.loads(_answer(out, case).read_text())


def _check_same(path: Path, settings: dict[str, Any]) -> None:
    if path.exists() and json.loads(path.read_text()) != settings:
        sys.exit(f"error: {path} belongs to a run with other settings: {path.read_text()}; choose another --out")
    path.write_text(json.dumps(settings))


def _make(job: tuple[Case, Path, Path]) -> None:
    make(*job)


class _Worker:
    """A process that diagnoses one folder after another, so that imports are paid once.

    cores: its own cores, since threads that wait for each other on shared ones take several times as long.
    """

    def __init__(self, hidden: Path, cores: set[int]) -> None:
        self.here, there = _CONTEXT.Pipe()
        self._process = _CONTEXT.Process(target=_serve, args=(there, str(hidden)), daemon=True)
        every = os.sched_getaffinity(0)
        os.sched_setaffinity(0, cores)  # a child begins with what its parent has
        self._process.start()
        os.sched_setaffinity(0, every)
        self.case: Case | None = None
        self._before_s = 0.0

    def give(self, case: Case, folder: Path, result: Path) -> None:
        self.case, self._before_s = case, self._processor_s()
        self.here.send((str(folder), str(result)))

    def spent_s(self) -> float:
        """Processor time since the case was given, s."""
        return self._processor_s() - self._before_s

    def _processor_s(self) -> float:
        try:
            times = psutil.Process(self._process.pid).cpu_times()
        except psutil.NoSuchProcess:
            return 0.0
        return float(times.user + times.system)

    def stop(self) -> None:
        self._process.kill()
        self._process.join()


def _diagnose_all(cases: list[Case], out: Path, jobs: int, limit_s: float, keep: bool) -> None:
    todo, done = list(reversed(cases)), 0
    cores, count = sorted(os.sched_getaffinity(0)), min(jobs, len(todo))
    shares = [set(cores[number % len(cores) :: count]) for number in range(count)]
    workers = [_Worker(out / "truth", share) for share in shares]
    while any(worker.case for worker in workers) or todo:
        for number, worker in enumerate(workers):
            reply: dict[str, Any] | None = None
            if worker.case and worker.here.poll():
                reply = _received(worker)
            elif worker.case and worker.spent_s() > limit_s:
                reply = {"error": f"no answer within {limit_s:.0f} s of processor time"}
            if reply is not None and worker.case is not None:
                done += 1
                _keep_answer(out, worker.case, reply, keep)
                print(f"{done}/{len(cases)} case {worker.case.name}: {reply.get('verdict', reply.get('error'))}", flush=True)
                worker.case = None
                if "error" in reply:
                    worker.stop()
                    workers[number] = worker = _Worker(out / "truth", shares[number])
            if worker.case is None and todo:
                case = todo.pop()
                worker.give(case, _folder(out, case), out / "work" / case.name)
        wait([worker.here for worker in workers if worker.case], timeout=1.0)
    for worker in workers:
        worker.stop()


def _received(worker: _Worker) -> dict[str, Any]:
    try:
        reply: dict[str, Any] = worker.here.recv()
        return reply
    except EOFError:
        return {"error": "the process died"}


def _keep_answer(out: Path, case: Case, reply: dict[str, Any], keep: bool) -> None:
    path = _answer(out, case)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(reply, indent=1))
    if not keep:
        for folder in (_folder(out, case), out / "work" / case.name):
            shutil.rmtree(folder, ignore_errors=True)


def _serve(pipe: Connection, hidden: str) -> None:
    """Diagnose until the parent ends; an attempt to open anything in `hidden` is an error."""
    sys.addaudithook(_guard(Path(hidden).resolve()))
    (command,) = entry_points(group="console_scripts", name="scarpsim")
    main = command.load()
    while True:
        folder, result = pipe.recv()
        pipe.send(_diagnosed(main, folder, Path(result)))


def _guard(hidden: Path) -> Callable[[str, tuple[Any, ...]], None]:
    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event in ("open", "os.listdir", "os.scandir") and arguments and isinstance(arguments[0], str | bytes):
            path = arguments[0] if isinstance(arguments[0], str) else arguments[0].decode(errors="replace")
            if hidden.name in path and Path(path).resolve().is_relative_to(hidden):
                raise PermissionError(f"the diagnosis may not look at {path}")

    return hook


def _diagnosed(main: Callable[[list[str]], int], folder: str, result: Path) -> dict[str, Any]:
    """Return gap.json with the wall time, or the error."""
    said, start = io.StringIO(), time.perf_counter()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            code = main(["gap", folder, "--out", str(result), "--debug"])
    except Exception:
        return {"error": traceback.format_exc()[-2000:]}
    if code != 0:
        return {"error": said.getvalue()[-2000:]}
    return {**json.loads((result / "gap.json").read_text()), "wall_s": time.perf_counter() - start}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--small", action="store_true", help="small cases, as in the test")
    parser.add_argument("--keep", action="store_true", help="keep the measurements and everything the command wrote")
    parser.add_argument("--stratum", choices=STRATA, help="cases of this kind alone, such as none: without any effect")
    parser.add_argument("--sensor", choices=SENSORS, help="cases of this sensor alone")
    parser.add_argument(
        "--table", type=Path, help="write the table there too (docs/validation/gap_closed_form.md), and its figures beside it"
    )
    arguments = parser.parse_args()
    found = run(
        arguments.cases,
        arguments.seed,
        arguments.jobs,
        arguments.out,
        small=arguments.small,
        keep=arguments.keep,
        stratum=arguments.stratum,
        sensor=arguments.sensor,
    )
    if arguments.table:
        arguments.table.write_text(markdown(found))
        figures = {key: value for key, value in found.items() if key != "rows"}
        arguments.table.with_suffix(".json").write_text(json.dumps(figures, indent=1) + "\n")
    print(markdown(found))


if __name__ == "__main__":
    main()
