"""Measure time and memory of all steps of `scarpsim gap` by the number of points.

Targets: a million points of each sensor in 60 s on two cores and 4 GB, and 20 million ranges in 6 GB.

    python benchmarks/gap.py [tls] [stereo] [--points 1000000 ...] [--avx2] [--write]

The measurements are made by the closed-form generator, in its own process. Each is read and diagnosed with an empty kernel cache,
as for a new user, and again with the kernels of that. Further target: 60 bare casts of the same rays, or 60 s. `--write` puts the
table into docs/validation/gap.md. `--avx2` measures as on a processor without AVX-512: the ray tracer, NumPy and its linear
algebra do not use it then.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from documents import write_between
from measure import bare_cast, empty_kernel_cache, medians, narrow_vectors, peak_memory_gb

from pipeline.formats.measurements.measurement import Measurement, TlsMeasurement, read_measurement
from pipeline.gap.naming.workflow import diagnose
from scene.ray_casting.upload import vectors_on_device
from sensors.numerics.device import vector

CASES = {"tls": ("vertical_index", (1, 1)), "stereo": ("focal_length", (1, 6))}
"""The effect and the seed, by sensor; every second pixel of the pair that this seed makes is a million."""
_WITHOUT_AVX512 = {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"}
_ROOT = Path(__file__).parents[1]
_TABLE = ("<!-- times -->", "<!-- end of times -->")


def report(folder: Path) -> dict[str, Any]:
    """Read and diagnose a measurement, print where the time goes, and return it (s, GB)."""
    start = time.perf_counter()
    measurement = read_measurement(folder)
    reading, busy = time.perf_counter() - start, time.process_time()
    found = diagnose(measurement)
    busy, memory = time.process_time() - busy, peak_memory_gb()
    (cast,) = medians(bare(measurement), rounds=3)
    count = len(measurement.cloud.points)
    print(f"  reading                     {reading:>7.1f} s")
    for step, lap in found.timings.items():
        print(f"  {step:<28}{lap:>7.1f} s")
    print(f"  all steps, {count:,} points{found.seconds:>12.1f} s   (target: {max(60, 60 * cast):.0f})")
    print(f"  CPU time of all threads     {busy:>7.1f} s")
    print(f"  over the bare cast          {found.seconds / cast:>7.0f}")
    print(f"  peak memory                 {memory:>7.2f} GB  (target: at most 4; of 20 million points 6)")
    print(f"  {found.verdict}: {', '.join(each.name for each in found.effects)}", flush=True)
    return {"points": count, "reading": reading, "seconds": found.seconds, "cast": cast, "memory": memory}


def bare(measurement: Measurement) -> Callable[[], None]:
    """Return the bare cast of one ray to every point, to be timed."""
    if isinstance(measurement, TlsMeasurement):
        origin = measurement.station[0]
    else:
        origin = measurement.cameras.in_wall_frame(measurement.frame).left.position
    return bare_cast(measurement.scene, vector(origin), vectors_on_device(measurement.cloud.points - origin))


def made(sensor: str, points: int, folder: Path) -> Path:
    """Make a measurement in a folder, in a process of its own, so that its memory does not count."""
    kind, seed = CASES[sensor]
    code = "import sys; from pathlib import Path; from benchmarks.gap_closed_form.cases import Case, make; " + (
        f"make(Case(0, {seed}, 'one', {sensor!r}, ({kind!r},), {points}, 200_000), Path(sys.argv[1]), Path(sys.argv[2]))"
    )
    case = folder / "case"
    subprocess.run([sys.executable, "-c", code, str(case), str(folder / "truth.json")], check=True, cwd=_ROOT)
    return case


def timed(case: Path, avx2: bool) -> list[dict[str, Any]]:
    """Time the diagnosis with an empty kernel cache and with a filled one, in processes of their own. avx2: without AVX-512."""
    rows, answer = [], case.with_name("times.json")
    with empty_kernel_cache() as environment:
        for cache in ("an empty", "a filled"):
            print(f"with {cache} kernel cache", flush=True)
            command = [sys.executable, __file__, "--measurement", str(case), "--to", str(answer), *(["--avx2"] if avx2 else [])]
            subprocess.run(command, check=True, env=environment | (_WITHOUT_AVX512 if avx2 else {}))
            rows.append(json.loads(answer.read_text()))
    return rows


def table(found: dict[str, list[list[dict[str, Any]]]]) -> str:
    """One row per measurement. found: of each sensor's, with the empty cache and with the filled one."""
    lines = [
        "| sensor | points | reading | all steps, empty cache | filled cache | 60 bare casts | memory |",
        "|---|---|---|---|---|---|---|",
    ]
    for sensor, cases in found.items():
        for empty, filled in cases:
            lines.append(
                f"| {sensor} | {empty['points']:,} | {empty['reading']:.0f} s | {empty['seconds']:.0f} s "
                f"| {filled['seconds']:.0f} s | {60 * filled['cast']:.0f} s | {max(empty['memory'], filled['memory']):.1f} GB |"
            )
    return "\n".join(lines)


def main() -> None:
    """One measurement after another, each diagnosed in processes of their own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sensors", nargs="*", default=list(CASES), help="tls, stereo")
    parser.add_argument("--points", type=int, nargs="+", default=[1_000_000])
    parser.add_argument("--avx2", action="store_true", help="without AVX-512")
    parser.add_argument("--write", action="store_true", help="put the table into docs/validation/gap.md")
    parser.add_argument("--measurement", type=Path, help="diagnose this folder instead")
    parser.add_argument("--to", type=Path, help="file for its times")
    arguments = parser.parse_args()
    if arguments.measurement:
        narrow_vectors()  # if --avx2
        times = report(arguments.measurement)
        if arguments.to:
            arguments.to.write_text(json.dumps(times))
        return
    found: dict[str, list[list[dict[str, Any]]]] = {}
    for sensor in arguments.sensors:
        for points in arguments.points:
            with tempfile.TemporaryDirectory() as folder:
                print(f"{sensor}, about {points:,} points", flush=True)
                found.setdefault(sensor, []).append(timed(made(sensor, points, Path(folder)), arguments.avx2))
    print(table(found))
    if arguments.write:
        write_between(_ROOT / "docs/validation/gap.md", _TABLE, table(found))


if __name__ == "__main__":
    main()
