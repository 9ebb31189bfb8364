"""Try the program on a machine with an NVIDIA card, in less than eight minutes, and write what came of it into a folder.

    python tools/try_gpu.py --out gpu                        with the packages of this Python
    python tools/try_gpu.py --out gpu --wheels wheels        first installs from a folder of wheels, without a network

It runs the sensors' tests on the card, simulates the demo with both sensors on the card and on the processor and compares ranges,
random numbers and maps, and runs the benchmarks of both sensors, whose ratio is to the bare casts on the same card. Each step has
a time limit and is recorded even if another one fails: gpu.json has the figures, the logs are beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
CARD, PROCESSOR = "cuda_ad_mono", "llvm_ad_mono"
SENSORS = ("tls", "stereo")
NEAR_M, REGISTERED_M, NORMAL = 1e-5, 1e-4, 5e-5
"""Largest difference of a range or a depth, m, of a difference map, m, and of a standard normal number.

CUDA's sine and logarithm of float32 differ from the processor's by some units of the last place. One point more or fewer
changes the sample on which a registration begins, and so where it stops.
"""
ASKED = "name,driver_version,memory.total"


class Trial:
    """The steps, their results in `found`, and the interpreter that carries them out."""

    def __init__(self, out: Path, card: str, limit_s: float) -> None:
        self.out, self.card, self.python, self.found = out, card, sys.executable, dict[str, Any]()
        self.end = time.monotonic() + limit_s
        self.out.mkdir(parents=True, exist_ok=True)

    def step(self, name: str, words: list[str], limit_s: float, variant: str = "") -> str:
        """Run a command with a time limit; keep its log, its seconds and whether it worked; return what it printed."""
        start, left = time.monotonic(), max(self.end - time.monotonic(), 1.0)
        places = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        environment = os.environ | {"PYTHONPATH": places, "SCARPSIM_VARIANT": variant or self.card}
        text, said = "", "works"
        try:
            how: dict[str, Any] = {"cwd": ROOT, "env": environment, "text": True, "start_new_session": True}
            with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **how) as process:
                try:
                    text = process.communicate(timeout=min(limit_s, left))[0]
                except subprocess.TimeoutExpired:
                    os.killpg(process.pid, signal.SIGKILL)  # with the processes that it started
                    text, said = process.communicate()[0], "failed: time limit"
            if process.returncode > 0:
                said = f"failed, status {process.returncode}"
        except OSError as error:
            said = f"failed: {error}"
        (self.out / f"{name}.log").write_text(text, encoding="utf-8")
        self.keep(name, {"said": said, "seconds": round(time.monotonic() - start, 1), "last": text.strip().splitlines()[-1:]})
        return text

    def keep(self, name: str, value: Any) -> None:
        """Put a result into the record, which is written at once."""
        self.found[name] = value
        (self.out / "gpu.json").write_text(json.dumps(self.found, indent=1) + "\n", encoding="utf-8")


def card_memory_mib() -> int | None:
    """Return the memory that the card has in use now, MiB; None where there is no card."""
    words = ["nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits"]
    try:
        return int(subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()[0])
    except (OSError, subprocess.CalledProcessError, ValueError, IndexError):
        return None


class MemoryWatch(threading.Thread):
    """Ask for the card's memory twice a second; `peak_mib` is the largest answer."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.peak_mib, self._done = card_memory_mib(), threading.Event()

    def run(self) -> None:
        """Ask until stopped."""
        while self.peak_mib is not None and not self._done.wait(0.5):
            self.peak_mib = max(self.peak_mib, card_memory_mib() or 0)

    def stop(self) -> int | None:
        """Stop, and return the largest memory that was in use, MiB."""
        self._done.set()
        return self.peak_mib


def install(trial: Trial, wheels: Path) -> None:
    """Make an environment from a folder of wheels, without a network, and use it from here on."""
    place = trial.out.absolute() / "venv"
    trial.step("environment", [sys.executable, "-m", "venv", str(place)], 60)
    trial.python = str(place / "bin" / "python")
    words = ["-m", "pip", "install", "-q", "--no-index", "--find-links", str(wheels.absolute())]
    trial.step("installation", [trial.python, *words, "scarpsim", "pytest", "pytest-xdist", "hypothesis"], 240)


def carry_out(trial: Trial, demo: list[str]) -> None:
    """Tests, demo on both, comparison, benchmarks. demo: further words of `simulate`."""
    watch = MemoryWatch()
    watch.start()
    workers = str(min(os.cpu_count() or 1, 4))
    tests = ["-m", "pytest", "-q", "-n", workers, "-p", "no:cacheprovider", "-m", "not validation", "tests/sensors"]
    for sensor in SENSORS:
        for variant in dict.fromkeys((trial.card, PROCESSOR)):
            words = ["-c", "from pipeline.cli.main import main; raise SystemExit(main())", "simulate", "--sensor", sensor]
            words += ["--out", str(trial.out / variant / sensor), *demo]
            trial.step(f"demo_{sensor}_{variant}", [trial.python, *words], 90, variant)
    for variant in dict.fromkeys((trial.card, PROCESSOR)):
        words = [__file__, "--draw", "--out", str(trial.out / variant)]
        trial.step(f"random_{variant}", [trial.python, *words], 60, variant)
    said = trial.step("comparison", [trial.python, __file__, "--compare", trial.card, "--out", str(trial.out)], 60, PROCESSOR)
    trial.keep("compared", json.loads(said.strip().splitlines()[-1]) if said.strip().endswith("}") else None)
    for name in SENSORS:
        text = trial.step(f"benchmark_{name}", [trial.python, f"benchmarks/{name}.py"], 90)
        trial.keep(f"figures_{name}", text.strip().splitlines())
    trial.step("tests", [trial.python, *tests], 240)
    trial.keep("peak_memory_mib", watch.stop())


def draw(out: Path) -> None:
    """Write numbers of the program's random generator, drawn on the device."""
    import numpy as np

    from scene.common.backend import dr, mi
    from scene.common.keyed_random import KeyedRandom

    index = dr.arange(mi.UInt32, 100_000)
    random = KeyedRandom(50).child("trial")
    np.savez(out / "random.npz", uniforms=np.array(random.uniforms(index)), normals=np.array(random.normals(index)))


def compare(card: str, out: Path) -> dict[str, Any]:
    """Return the differences between the card's demo and the processor's, with what is allowed."""
    import numpy as np
    import tifffile

    from pipeline.formats.points.laz import read_laz

    first, second = out / card, out / PROCESSOR
    mine, other = (np.load(folder / "random.npz") for folder in (first, second))
    found: dict[str, Any] = {
        "uniform numbers are the same": bool(np.array_equal(mine["uniforms"], other["uniforms"])),
        "normal numbers, largest difference": [float(np.abs(mine["normals"] - other["normals"]).max()), NORMAL],
    }
    scans = [read_laz(folder / "tls" / "epoch_000" / "points.laz") for folder in (first, second)]
    times = [scan.gps_time for scan in scans]
    _, rows, others = np.intersect1d(*times, return_indices=True)
    ranges = [scan.extra["true_range_m"][at] for scan, at in zip(scans, (rows, others), strict=True)]
    found["pulses that one of both misses, share"] = [1 - len(rows) / max(map(len, times)), 1e-4]
    found["true ranges, 99.9 %, m"] = [float(np.quantile(np.abs(ranges[0] - ranges[1]), 0.999)), NEAR_M]
    rasters = {"stereo depth map": ("stereo/epoch_000/depth_left.tif", NEAR_M)}
    rasters |= {f"{sensor} difference map": (f"{sensor}/difference_001.tif", REGISTERED_M) for sensor in SENSORS}
    for name, (file, near_m) in rasters.items():
        maps = [tifffile.imread(folder / file).astype(float) for folder in (first, second)]
        both = np.isfinite(maps[0]) & np.isfinite(maps[1])
        found[f"{name}, 99 % of pixels, m"] = [float(np.quantile(np.abs(maps[0] - maps[1])[both], 0.99)), near_m]
        found[f"{name}, pixels that one of both lacks, share"] = [1 - both.sum() / np.isfinite(maps[0]).sum(), 1e-3]
    return found | {"as it should be": all(each if isinstance(each, bool) else each[0] <= each[1] for each in found.values())}


def main() -> int:
    """Carry everything out; return 0 if all of it works."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--wheels", type=Path, help="folder of wheels, for a machine without a network")
    parser.add_argument("--card", default=CARD, choices=(CARD, PROCESSOR), help="Mitsuba variant to be tried")
    parser.add_argument("--limit-s", type=float, default=470, help="time for everything, s")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="changes of the demo's config")
    parser.add_argument("--draw", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--compare", metavar="VARIANT", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.draw:
        draw(given.out)
        return 0
    if given.compare:
        sys.stdout.write(json.dumps(compare(given.compare, given.out)) + "\n")
        return 0
    trial = Trial(given.out.absolute(), given.card, given.limit_s)
    trial.step("card", ["nvidia-smi", f"--query-gpu={ASKED}", "--format=csv,noheader"], 20)
    if given.wheels:
        install(trial, given.wheels)
    carry_out(trial, [word for change in given.set for word in ("--set", change)])
    steps = [value for value in trial.found.values() if isinstance(value, dict) and "said" in value]
    return 0 if all(each["said"] == "works" for each in steps) and (trial.found["compared"] or {}).get("as it should be") else 1


if __name__ == "__main__":
    raise SystemExit(main())
