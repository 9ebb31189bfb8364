"""`scarpsim gap` on one million points of each sensor, all steps; to reach: about 60 s on two cores, under 4 GB.

    python benchmarks/gap.py [tls] [stereo] [--points 1000000]

The measurements are made by the challenge's generator, in a process of their own. Each is diagnosed with an empty kernel cache,
as a new user's, and again with the kernels of that. To reach: 60 bare casts of the same rays, or 60 s. The other ratio is to
taking the residuals once: a cast of all points and of the four probes beside each that tell edges.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from measure import bare_cast, empty_kernel_cache, medians, peak_memory_gb, seconds

from pipeline.formats.measurement import Measurement, TlsMeasurement, read_measurement
from pipeline.gap.naming.workflow import diagnose
from pipeline.gap.residuals.registration import residuals_of
from scene.upload import vectors_on_device
from sensors.device import vector

KINDS = {"tls": "vertical_index", "stereo": "focal_length"}


def report(folder: Path) -> None:
    """Diagnose a measurement and print where the time goes."""
    measurement, busy = read_measurement(folder), time.process_time()
    found = diagnose(measurement)
    busy = time.process_time() - busy
    residuals = min(seconds(lambda: residuals_of(measurement)) for _ in range(2))
    (cast,) = medians(bare(measurement), rounds=3)
    for step, lap in found.timings.items():
        print(f"  {step:<28}{lap:>7.1f} s")
    print(f"  all steps, {len(measurement.cloud.points):,} points{found.seconds:>12.1f} s   (target: {max(60, 60 * cast):.0f})")
    print(f"  CPU time of all threads     {busy:>7.1f} s")
    print(f"  over the residuals alone    {found.seconds / residuals:>7.1f}")
    print(f"  over the bare cast          {found.seconds / cast:>7.0f}")
    print(f"  peak memory                 {peak_memory_gb():>7.2f} GB  (target: at most 4)")
    print(f"  {found.verdict}: {', '.join(each.name for each in found.effects)}", flush=True)


def bare(measurement: Measurement) -> Callable[[], None]:
    """The bare cast of one ray to every point."""
    if isinstance(measurement, TlsMeasurement):
        origin = measurement.station[0]
    else:
        origin = measurement.cameras.in_wall_frame(measurement.frame).left.position
    return bare_cast(measurement.scene, vector(origin), vectors_on_device(measurement.cloud.points - origin))


def made(sensor: str, points: int, folder: Path) -> Path:
    """A measurement in a folder, by a process of its own, whose memory does not count."""
    code = "import sys; from pathlib import Path; from benchmarks.gap_challenge.cases import Case, make; " + (
        f"make(Case(0, (1, 1), 'one', {sensor!r}, ({KINDS[sensor]!r},), {points}, 200_000), Path(sys.argv[1]), Path(sys.argv[2]))"
    )
    case, root = folder / "case", Path(__file__).parents[1]
    subprocess.run([sys.executable, "-c", code, str(case), str(folder / "truth.json")], check=True, cwd=root)
    return case


def main() -> None:
    """One sensor after another, each diagnosed in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sensors", nargs="*", default=list(KINDS), help="tls, stereo")
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--measurement", type=Path, help="diagnose this folder instead")
    arguments = parser.parse_args()
    if arguments.measurement:
        report(arguments.measurement)
        return
    for sensor in arguments.sensors:
        with tempfile.TemporaryDirectory() as folder:
            case = made(sensor, arguments.points, Path(folder))
            with empty_kernel_cache() as environment:
                for cache in ("an empty", "a filled"):
                    print(f"{sensor}, with {cache} kernel cache", flush=True)
                    subprocess.run([sys.executable, __file__, "--measurement", str(case)], check=True, env=environment)


if __name__ == "__main__":
    main()
