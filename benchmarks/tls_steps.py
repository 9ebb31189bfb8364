"""Measure where the time between a bare ray cast and a laser scan goes, step by step and kernel by kernel.

    python benchmarks/tls_steps.py [--avx2]     (as on a processor without AVX-512)

The scene is that of tls.py: 5 M pulses on 1.3 M triangles. Each row does what the row above does and one thing more. Processor
time of all threads is counted, as it depends little on other work on the machine. Shares are of the whole scan. The second table
does the same for a wide beam, the scene of tls_beam.py: 1 M pulses of 19 sub-rays. The third lists the kernels of one scan of the
first kind, from Dr.Jit's kernel history.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import replace

from measure import bare_cast, narrow_vectors
from tls import prepared
from tls_beam import DIVERGENCE_RAD, SUB_RAYS, pulse_by_pulse

from scene.common.backend import VARIANT, dr, mi
from scene.common.config import parse
from scene.common.keyed_random import KeyedRandom
from scene.ray_casting.raycast import RayCaster
from sensors.laser.tls import LaserScanner
from sensors.models.sensor_model import TlsModel
from sensors.numerics.device import rotated, vector
from sensors.signal_chain.beam import Beam
from sensors.signal_chain.pulses import direction

PULSES, WIDE_PULSES, ROUNDS = 5_000_000, 1_000_000, 5


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
    count = scanner.pattern.lines * scanner.pattern.pulses
    print(f"{VARIANT}{lanes}, {dr.thread_count()} threads, {len(caster.mesh.faces):,} triangles, {count:,} pulses")
    print_steps(works, count)
    print_unavoidable(scanner, random)
    wide_beam(scanner, caster, random)
    print("\n| kernel of one scan | rays | operations | share of the kernels' time |\n|---|---|---|---|")
    kernels = history(lambda: scanner.observe(caster, random))
    total = sum(each["execution_time"] for each in kernels)
    for number, each in enumerate(kernels, start=1):
        share = each["execution_time"] / total
        print(f"| {number} | {each['size']:,} | {each.get('operation_count', 0):,} | {share:.2f} |")


def print_steps(works: dict[str, Callable[[], object]], rays: int) -> None:
    """Print the table of processor times of works, the last of which is a whole scan of so many rays."""
    found = processor_seconds(works)
    bare, *_, whole = found.values()
    print("| step | processor ns a ray | share of the scan | bare cast over this |\n|---|---|---|---|")
    for name, seconds in found.items():
        print(f"| {name} | {1e9 * seconds / rays:.1f} | {seconds / whole:.2f} | {bare / seconds:.2f} |")


def print_unavoidable(scanner: LaserScanner, random: KeyedRandom) -> None:
    """Print the processor time of what a noisy scan must do besides its casts: draw random numbers, and write its arrays."""
    pulses, count = scanner.emit(), scanner.pattern.lines * scanner.pattern.pulses
    dr.eval(pulses.pulse_key, pulses.line_key)
    sizes = {mi.Float64: (3, 1), mi.Float32: (2, 1), mi.Int32: (1,)}  # points, depth; offset, intensity; block

    def drawn() -> None:
        angles, ranges = (pulses.normals(random.child(name)) for name in ("angles", "ranges"))
        dr.eval(angles.x + angles.y + ranges.x)

    def written() -> None:
        arrays = [dr.arange(kind, size * count) for kind, each in sizes.items() for size in each]
        dr.eval(arrays)
        for array in arrays:
            array.numpy()

    for name, seconds in processor_seconds({"three normal random numbers": drawn, "writing the arrays": written}).items():
        print(f"{name} of each pulse: {1e9 * seconds / count:.1f} ns of processor time")


def wide_beam(pencil: LaserScanner, caster: RayCaster, random: KeyedRandom) -> None:
    """Print the steps from the bare cast of all sub-rays of a wide beam to a scan with it, with coarser angular steps."""
    effect = {"name": "beam_divergence", "divergence_rad": DIVERGENCE_RAD, "sub_rays": SUB_RAYS}
    grid, coarser = pencil.pattern, (PULSES / WIDE_PULSES) ** 0.5
    pattern = replace(
        grid,
        azimuth_step=coarser * grid.azimuth_step,
        zenith_step=coarser * grid.zenith_step,
        lines=int(grid.lines / coarser),
        pulses=int(grid.pulses / coarser),
    )
    scanner = replace(pencil, pattern=pattern, model=parse(TlsModel, {"effects": [effect]}, "benchmark"))
    origin, rays = vector(scanner.position), pulse_by_pulse(scanner)
    dr.eval(rays)
    pulses, beam = scanner.emitted(scanner.emit(), random)
    first = dr.arange(mi.UInt32, 1)
    count = SUB_RAYS * scanner.pattern.lines * scanner.pattern.pulses
    print(f"\n{count:,} rays of {SUB_RAYS} sub-rays a pulse")
    print_steps(
        {
            "bare cast of rays that are ready in memory, the sub-rays of a pulse side by side": bare_cast(caster, origin, *rays),
            "distance, normal, albedo and block of the triangle, in float64": lambda: [
                dr.eval(caster.intersect(origin, ray, exact=True)) for ray in rays
            ],
            "sub-rays made from the beam, limits of range and power: their echoes, in memory": lambda: scanner.echo(
                caster, pulses, beam, lambda echoes: echoes.echoes.at(first)
            ),
            "echoes of a pulse combined to one": lambda: scanner.echo(caster, pulses, beam, beam.combine_echoes),
            "noise, points and offsets as arrays: the scan": lambda: scanner.observe(caster, random),
        },
        count,
    )


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
