"""Measure how long commands take before they do anything, compared with starting a bare interpreter.

    python benchmarks/startup.py

For `--help` the limit is 0.5 s, for `simulate` until it begins to build the wall 0.8 s, of wall time. Processor time is printed
beside it, because it depends less on other work on the machine. The same is measured for the packages that `simulate` and
`surface` import, without anything of scarpsim: no start can be faster than they are. The programs run in turn, and the median
counts.

One table lists what scarpsim adds to the packages: the classes of the config, which Pydantic builds, and dataclasses. The other
lists the packages that `simulate` imports, with the time of their own modules (`python -X importtime`).
"""

from __future__ import annotations

import re
import resource
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping

_REPEATS = 7
_LIMIT_S, _SIMULATE_LIMIT_S = 0.5, 0.8
_BARE, _START = "bare interpreter", "scarpsim simulate, until it builds the wall"
_ROWS = 12
"""Packages in the table."""
_SIMULATE = """
from pipeline.cli.imports import fast_imports
with fast_imports():
    from pipeline.config.bundled import bundled_config
    from pipeline.config.simulation import load_config
    from pipeline.run import simulation
load_config(bundled_config("", "demo"), [], "tls", None)
"""
"""What `scarpsim simulate` does before it builds the wall."""
_SURFACE = """
from pipeline.cli.imports import fast_imports
with fast_imports():
    from pipeline.formats.meshes.ply import write_ply
    from pipeline.formats.points.points import joined, read_placed_scans
    from pipeline.surface.from_cloud import CloudConfig, surface_of_cloud
import pipeline.formats.points.laz, scipy.spatial
"""
"""What `scarpsim surface` imports."""
_SIMULATE_PACKAGES = """
import cv2, drjit, manifold3d, mitsuba, numpy, pydantic, tifffile, yaml
mitsuba.set_variant("llvm_ad_mono")
pydantic.BaseModel
"""
"""What `simulate` imports from other projects, and the variant of Mitsuba that it sets."""
_SURFACE_PACKAGES = "import laspy, lazrs, numpy, pydantic, scipy.spatial, yaml; pydantic.BaseModel"
"""The packages that `surface` imports for a LAZ file."""
_MITSUBA = 'import mitsuba; mitsuba.set_variant("llvm_ad_mono")'
_CLASSES = """
import builtins, dataclasses, gc, time
from pydantic import BaseModel
gc.disable()
took, build, dataclass = {"config classes": [], "dataclasses": []}, builtins.__build_class__, dataclasses.dataclass

def timed(kind, work, *given, **named):
    start = time.process_time()
    made = work(*given, **named)
    took[kind].append(time.process_time() - start)
    return made

def build_class(body, name, *bases, **named):
    if any(isinstance(base, type) and issubclass(base, BaseModel) for base in bases):
        return timed("config classes", build, body, name, *bases, **named)
    return build(body, name, *bases, **named)

def make_dataclass(cls=None, /, **options):
    if cls is None:
        return lambda kind: timed("dataclasses", dataclass, kind, **options)
    return timed("dataclasses", dataclass, cls, **options)

builtins.__build_class__, dataclasses.dataclass = build_class, make_dataclass
"""
"""Before a program, makes Python time how long classes take to be built."""
_PRINT_CLASSES = """
for kind, seconds in took.items():
    print(f"| {len(seconds)} {kind} | {sum(seconds):.3f} |")
"""
_IMPORT = re.compile(r"import time:\s*(\d+) \|\s*\d+ \|\s*([\w]+)")


def measure(programs: Mapping[str, str]) -> dict[str, tuple[float, float]]:
    """Run programs in turn, several times, and return the median wall time and processor time of each, s."""
    walls: dict[str, list[float]] = {name: [] for name in programs}
    processors: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(_REPEATS):
        for name, program in programs.items():
            begin, used = time.perf_counter(), _children_s()
            subprocess.run([sys.executable, "-c", program], check=True, stdout=subprocess.DEVNULL)
            walls[name].append(time.perf_counter() - begin)
            processors[name].append(_children_s() - used)
    return {name: (statistics.median(walls[name]), statistics.median(processors[name])) for name in programs}


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
    helps = {
        f"scarpsim {command}": f"import sys; from pipeline.cli.main import main; sys.exit(main({command.split()}))"
        for command in ("--help", "simulate --help", "view --help")
    }
    starts = {
        _START: _SIMULATE,
        "the packages that it imports, alone": _SIMULATE_PACKAGES,
        "Mitsuba and its variant, alone": _MITSUBA,
        "scarpsim surface, until it reads the points": _SURFACE,
        "the packages that surface imports, alone": _SURFACE_PACKAGES,
    }
    found = measure({_BARE: "pass"} | helps | starts)
    for name, (wall, processor) in found.items():
        ratio = f"{wall / found[_BARE][0]:.1f} x a bare interpreter's start"
        limit = _LIMIT_S if name in helps else _SIMULATE_LIMIT_S
        share = f"; {wall / limit:.2f} of the limit" if name in helps or name == _START else ""
        print(f"{name}: {wall:.2f} s ({processor:.2f} s of processor time), {ratio}{share}")
    print("\n| what scarpsim adds | processor time, s |\n|---|---|", flush=True)
    subprocess.run([sys.executable, "-c", _CLASSES + _SIMULATE + _PRINT_CLASSES], check=True)
    print()
    own_times = packages(_SIMULATE)
    print("| package | own modules, s |\n|---|---|")
    for package, own in list(own_times.items())[:_ROWS]:
        print(f"| {package} | {own:.3f} |")
    print(f"| all {len(own_times)} | {sum(own_times.values()):.3f} |")


if __name__ == "__main__":
    main()
