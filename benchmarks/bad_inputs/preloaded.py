"""Commands as processes of their own, forked from one that has imported what they need: seconds less for each.

Dr.Jit's threads do not survive a fork: it computes in one thread then, and cannot end its own, so that a command that is forked
from a process with it ends at once after its last line. TensorFlow is never imported before. Run as a program, this takes orders
as lines of JSON and answers each with a line.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
MOST_S, MOST_GB = 75.0, 4.0
"""A command that goes on for longer, or takes more memory, is killed."""
LIBRARIES = (
    *("cv2", "jinja2", "laspy", "manifold3d", "matplotlib.backends.backend_agg", "matplotlib.figure", "numpy"),
    *("pycocotools.mask", "pydantic", "scipy.ndimage", "scipy.optimize", "scipy.spatial", "scipy.stats", "tifffile", "trimesh"),
)
ROOMS = (
    *("pipeline.run.simulation", "pipeline.run.report", "pipeline.gap.naming.workflow", "pipeline.gap.report.report"),
    *("pipeline.measurement.build", "pipeline.comparison.report", "pipeline.calibration.calibrate", "pipeline.icp_study.report"),
    *("pipeline.planning.report", "pipeline.dataset.run", "pipeline.detection.score_files"),
)


@dataclass(frozen=True)
class Order:
    """A command's words, the folder that it runs in and the files of its output."""

    words: tuple[str, ...]
    folder: str
    out: str
    error: str


@dataclass(frozen=True)
class Ended:
    """Exit status, seconds on the wall's clock and the processor's, peak memory of the largest process."""

    code: int
    wall_s: float
    own_s: float
    gigabytes: float


class Preloaded:
    """The process that commands are forked from; close it. rooms: the program's own modules are imported too, and Dr.Jit."""

    def __init__(self, *, rooms: bool) -> None:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        self._process = subprocess.Popen(
            [sys.executable, __file__, *LIBRARIES, *(ROOMS if rooms else ())],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(self, order: Order) -> Ended:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(asdict(order)), file=self._process.stdin, flush=True)
        return Ended(**json.loads(self._process.stdout.readline()))

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def serve(modules: list[str]) -> int:
    """Fork a process for each order; only such a process returns before the orders end, with its command's exit status."""
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
        status, usage = _waited(process, began)
        ended = Ended(
            os.waitstatus_to_exitcode(status), time.monotonic() - began, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e6
        )
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


def _waited(process: int, began: float) -> tuple[int, resource.struct_rusage]:
    """Status and use of resources of a process at its end, which comes by force where it takes too much."""
    while True:
        ended, status, usage = os.wait4(process, os.WNOHANG)
        if ended:
            return status, usage
        if time.monotonic() - began > MOST_S or _resident_gb(process) > MOST_GB:
            os.killpg(process, signal.SIGKILL)
            _, status, usage = os.wait4(process, 0)
            return status, usage
        time.sleep(0.02)


def _resident_gb(process: int) -> float:
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e9


if __name__ == "__main__":
    raise SystemExit(serve(sys.argv[1:]))
