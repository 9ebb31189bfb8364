"""Run commands as processes forked from one that has already imported what they need, which saves seconds for each.

Dr.Jit's threads do not survive a fork: it then computes in one thread and cannot end its own threads, so that a forked command
ends immediately after its last line. TensorFlow is never imported before the fork. Run as a program, this module takes orders as
lines of JSON and answers each with a line.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import psutil

ROOT = Path(__file__).parents[2]
MOST_WALL_S, MOST_OWN_S, MOST_GB = 180.0, 60.0, 4.0
"""Limits of wall time, s, processor time, s, and memory, GB, at which a command is killed."""
_LOOKS_AFTER_S = 0.5
LIBRARIES = (
    *("cv2", "dash", "flask", "jinja2", "laspy", "manifold3d", "matplotlib.backends.backend_agg", "matplotlib.figure", "numpy"),
    *("plotly.graph_objects", "pycocotools.mask", "pydantic.main", "pye57", "scipy.ndimage", "scipy.optimize", "scipy.spatial"),
    *("scipy.stats", "tifffile", "trimesh", "xml.etree.ElementTree", "yaml"),
)
ROOMS = (
    *("pipeline.run.simulation", "pipeline.run.report", "pipeline.gap.naming.workflow", "pipeline.gap.report.report"),
    *("pipeline.measurement.build", "pipeline.comparison.report", "pipeline.calibration.calibrate", "pipeline.icp_study.report"),
    *("pipeline.planning.report", "pipeline.dataset.run", "pipeline.detection.products.score_files"),
)


@dataclass(frozen=True)
class Order:
    """A command's words, its working folder and the files for its output."""

    words: tuple[str, ...]
    folder: str
    out: str
    error: str


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Attributes
    ----------
    code : Exit status.
    wall_s : Wall time, s.
    own_s : Processor time of all its processes, s.
    gigabytes : Peak memory of the largest process, GB.
    """

    code: int
    wall_s: float
    own_s: float
    gigabytes: float


class Preloaded:
    """The process that commands are forked from; it must be closed.

    rooms: whether the program's own modules and Dr.Jit are imported too; bytecode: folder for the modules' bytecode, as in an
    installation.
    """

    def __init__(self, bytecode: Path, *, rooms: bool) -> None:
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONPYCACHEPREFIX": str(bytecode)}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        self._process = subprocess.Popen(
            [sys.executable, __file__, *LIBRARIES, *(ROOMS if rooms else ())],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(self, order: Order) -> Ended:
        """Run a command in a process that is forked from the preloaded one, and wait for its end."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(asdict(order)), file=self._process.stdin, flush=True)
        return Ended(**json.loads(self._process.stdout.readline()))

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def serve(modules: list[str]) -> int:
    """Fork a process for each order; only these processes return before the orders end, with the exit status of their command."""
    for name in modules:
        importlib.import_module(name)
    ends_at_once = "drjit" in sys.modules
    for line in sys.stdin:
        order = Order(**json.loads(line))
        began = time.monotonic()
        process = os.fork()
        if process == 0:
            code = _command(order)
            if ends_at_once:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
            return code
        ended = _waited(process, began)
        print(json.dumps(asdict(ended)), flush=True)
    return 0


def _command(order: Order) -> int:
    os.setsid()
    os.chdir(order.folder)
    os.environ["TMPDIR"] = str(Path(order.folder).parent)
    wanted = ((os.devnull, os.O_RDONLY), (order.out, os.O_WRONLY | os.O_CREAT), (order.error, os.O_WRONLY | os.O_CREAT))
    for number, (name, flags) in enumerate(wanted):
        os.dup2(os.open(name, flags), number)
    from pipeline.cli.main import main

    return main(list(order.words))


def _waited(process: int, began: float) -> Ended:
    """Wait until a process ends, and kill it at a limit."""
    tree, looked, forced = _Tree(process), began, False
    while True:
        ended, status, usage = os.wait4(process, 0 if forced else os.WNOHANG)
        now = time.monotonic()
        if ended:
            own_s = max(usage.ru_utime + usage.ru_stime, tree.own_s)
            gigabytes = max(usage.ru_maxrss / 1e6, tree.gigabytes)
            return Ended(os.waitstatus_to_exitcode(status), now - began, own_s, gigabytes)
        if now - looked > _LOOKS_AFTER_S:
            tree.look()
            looked = now
        if now - began > MOST_WALL_S or tree.own_s > MOST_OWN_S or max(_resident_gb(process), tree.gigabytes) > MOST_GB:
            os.killpg(process, signal.SIGKILL)
            forced = True
        time.sleep(0.02)


class _Tree:
    """A process and all its descendants. own_s: their processor time, user and system, including those that have ended."""

    def __init__(self, process: int) -> None:
        self._process = process
        self._own_s: dict[int, float] = {}
        self.gigabytes = 0.0

    @property
    def own_s(self) -> float:
        return sum(self._own_s.values())

    def look(self) -> None:
        """Update the list of processes; one that ends keeps its last values."""
        with suppress(psutil.Error):
            first = psutil.Process(self._process)
            for each in [first, *first.children(recursive=True)]:
                with suppress(psutil.Error):
                    times = each.cpu_times()
                    self._own_s[each.pid] = times.user + times.system
                    self.gigabytes = max(self.gigabytes, each.memory_info().rss / 1e9)


def _resident_gb(process: int) -> float:
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e9


if __name__ == "__main__":
    raise SystemExit(serve(sys.argv[1:]))
