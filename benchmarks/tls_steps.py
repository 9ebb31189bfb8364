"""Measure where the time between a bare ray cast and a laser scan goes, step by step and kernel by kernel.

    python benchmarks/tls_steps.py [--avx2]     (as on a processor without AVX-512)

The scene is that of tls.py: 5 M pulses on 1.3 M triangles. Each row does what the row above does and one thing more. Processor
time of all threads is counted, as it depends little on other work on the machine. Shares are of the whole scan. The second table
lists the kernels of one scan, from Dr.Jit's kernel history.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

from measure import bare_cast, narrow_vectors
from tls import prepared

from scene.common.backend import VARIANT, dr, mi
from sensors.numerics.device import rotated, vector
from sensors.signal_chain.beam import Beam
from sensors.signal_chain.pulses import direction

PULSES, ROUNDS = 5_000_000, 5


def processor_seconds(works: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Return the median processor time of each work, s, taken in turns after one round that compiles kernels."""
    taken: dict[str, list[float]] = {name: [] for name in works}
    for number in range(ROUNDS + 1):
        for name, work in works.items():
            begin = time.process_time()
            work()
            dr.sync_thread()
            taken[name] += [time.process_time() - begin] * (number > 0)
    return {name: statistics.median(each) for name, each in taken.items()}


def main() -> None:
    lanes = ", 8 lanes" if narrow_vectors() else ""
    scanner, caster, random = prepared(PULSES)
    pulses, origin = scanner.emit(), vector(scanner.position)
    dr.eval(pulses.aim_azimuth, pulses.aim_zenith)
    aim = rotated(scanner.rotation, direction(pulses.aim_azimuth, pulses.aim_zenith))

    def from_angles(evaluate: Callable[[mi.Array3f64], object]) -> Callable[[], None]:
        return lambda: dr.eval(evaluate(rotated(scanner.rotation, direction(pulses.aim_azimuth, pulses.aim_zenith))))

    def cast(ray: mi.Array3f64) -> tuple[mi.Float, mi.UInt32]:
        found = caster.bare.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(ray)), coherent=True)
        return found.t, found.prim_index

    works = {
        "bare cast of rays that are ready in memory": bare_cast(caster, origin, aim),
        "rays computed from angles, in float64": from_angles(cast),
        "distance, normal, albedo and block from the triangle's record, in float64": from_angles(
            lambda ray: caster.intersect(origin, ray)
        ),
        "rays near edges decided again in float64": from_angles(lambda ray: caster.intersect(origin, ray, exact=True)),
        "power, limits of range: the echoes, written to memory": lambda: scanner.echo(
            caster, pulses, Beam(), Beam().combine_echoes
        ),
        "noise, points, offsets, as NumPy arrays: the scan": lambda: scanner.observe(caster, random),
    }
    found = processor_seconds(works)
    whole, count = list(found.values())[-1], scanner.pattern.lines * scanner.pattern.pulses
    print(f"{VARIANT}{lanes}, {dr.thread_count()} threads, {len(caster.mesh.faces):,} triangles, {count:,} pulses")
    print("| step | processor ns a pulse | share of the scan |\n|---|---|---|")
    for name, seconds in found.items():
        print(f"| {name} | {1e9 * seconds / count:.0f} | {seconds / whole:.2f} |")
    print("\n| kernel of one scan | rays | operations | share of the kernels' time |\n|---|---|---|---|")
    kernels = history(lambda: scanner.observe(caster, random))
    total = sum(each["execution_time"] for each in kernels)
    for number, each in enumerate(kernels, start=1):
        share = each["execution_time"] / total
        print(f"| {number} | {each['size']:,} | {each.get('operation_count', 0):,} | {share:.2f} |")


def history(work: Callable[[], object]) -> list[dict[str, float]]:
    """Return Dr.Jit's records of the compiled kernels that a work runs, the longest first."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        work()
        dr.sync_thread()
        found = dr.kernel_history([dr.KernelType.JIT])
    return sorted(found, key=lambda each: -each["execution_time"])


if __name__ == "__main__":
    main()
