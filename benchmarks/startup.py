"""Measure how long commands take before they do anything, compared with starting a bare interpreter.

    python benchmarks/startup.py

For `--help` the limit is 0.5 s, for `simulate` until it begins to build the wall 0.8 s, of wall time. Processor time is printed
beside it, because it depends less on other work on the machine. The table lists the packages that `simulate` imports until then,
with the time of their own modules (`python -X importtime`).
"""

from __future__ import annotations

import re
import resource
import statistics
import subprocess
import sys
import time
from collections import Counter

_REPEATS = 7
_LIMIT_S, _SIMULATE_LIMIT_S = 0.5, 0.8
_ROWS = 12
"""Packages in the table."""
_SIMULATE = """
from pipeline.config.bundled import bundled_config
from pipeline.config.simulation import load_config
from pipeline.run import simulation
load_config(bundled_config("", "demo"), [], "tls", None)
"""
"""What `scarpsim simulate` does before it builds the wall."""
_BARE = """
import cv2, drjit, manifold3d, mitsuba, numpy, pydantic, tifffile, yaml
mitsuba.set_variant("llvm_ad_mono")
pydantic.BaseModel
"""
"""The packages that it imports until then, and the variant that it sets, without anything of scarpsim."""
_IMPORT = re.compile(r"import time:\s*(\d+) \|\s*\d+ \|\s*([\w]+)")


def seconds(*words: str) -> tuple[float, float]:
    """Return the median wall time and processor time of a process, s."""
    walls, processors = [], []
    for _ in range(_REPEATS):
        begin, used = time.perf_counter(), _children_s()
        subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)
        walls.append(time.perf_counter() - begin)
        processors.append(_children_s() - used)
    return statistics.median(walls), statistics.median(processors)


def _children_s() -> float:
    """Return the processor time of all processes that this one has started and that have ended, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def packages(program: str) -> dict[str, float]:
    """Return the seconds that the modules of each package take while a program imports them, the longest first."""
    done = subprocess.run([sys.executable, "-X", "importtime", "-c", program], check=True, capture_output=True, text=True)
    found: Counter[str] = Counter()
    for own, package in _IMPORT.findall(done.stderr):
        found[package] += int(own)
    return {package: own / 1e6 for package, own in found.most_common()}


def main() -> None:
    bare, _ = seconds("-c", "pass")
    for command in ("--help", "simulate --help", "view --help"):
        program = f"import sys; from pipeline.cli.main import main; sys.exit(main({command.split()}))"
        report(f"scarpsim {command}", program, bare, _LIMIT_S)
    report("scarpsim simulate, until it builds the wall", _SIMULATE, bare, _SIMULATE_LIMIT_S)
    report("the packages that it imports, alone", _BARE, bare, _SIMULATE_LIMIT_S)
    found = packages(_SIMULATE)
    print("\n| package | own modules, s |\n|---|---|")
    for package, own in list(found.items())[:_ROWS]:
        print(f"| {package} | {own:.3f} |")
    print(f"| all {len(found)} | {sum(found.values()):.3f} |")


def report(what: str, program: str, bare: float, limit: float) -> None:
    """Print the time of a program, as a multiple of a bare interpreter's start and as a share of its limit."""
    wall, processor = seconds("-c", program)
    print(
        f"{what}: {wall:.2f} s ({processor:.2f} s of processor time), {wall / bare:.1f} x a bare interpreter's start; "
        f"{wall / limit:.2f} of the limit"
    )


if __name__ == "__main__":
    main()
