"""Measure one TLS observation of 1 M pulses with 19 sub-rays each on 1.3 M triangles against casting the same 19 M rays.

    python benchmarks/tls_beam.py [--avx2]      (as on a processor without AVX-512)

The bare cast has the rays of a pulse one after another, the fastest order; the order by sub-ray is timed too. Target: at least
0.5 of the bare ray rate, and a bias of the footprint below 0.1 mm on a rough wall.

The unbiased mean range needs a definition. If all echoes were equally strong, the mean over a scan would be that of the axes, as
a mean over all directions does not depend on the beam's width. But the power of an echo is proportional to albedo times the
cosine of the incidence angle, so that a beam that meets two surfaces is drawn to the one hit more squarely. On a rough wall, the
near rim of an edge is round and hit obliquely, the rock behind it squarely: on average, edges are some 0.2 mm too far, as for a
real scanner. The sub-rays are therefore compared with the axis at equal echoes, and, with true echoes, with a beam of 61
sub-rays.
"""

from __future__ import annotations

import numpy as np
from measure import bare_cast, medians, narrow_vectors, peak_memory_gb, seconds

from scene.common.backend import VARIANT, dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.ray_casting.raycast import RayCaster
from scene.walls.procedural import ProceduralWall
from sensors.laser.tls import LaserScanner, ScannerConfig
from sensors.models.placement import StationConfig, Target
from sensors.models.sensor_model import TlsModel
from sensors.numerics.device import rotated, vector
from sensors.signal_chain.beam import Beam
from sensors.signal_chain.pulses import direction, tangents

PULSES, SUB_RAYS, DIVERGENCE_RAD, EDGE_MM, AT_ONCE = 1_000_000, 19, 3.5e-4, 20, 1 << 18


def main() -> None:
    lanes = ", 8 lanes" if narrow_vectors() else ""
    random = KeyedRandom(1)
    world = ProceduralWall(style="glendale", resolution_m=0.0697).mesh(random)
    station = StationConfig().place(Target(world))
    frame = WallFrame.fit(world.vertices, station[0])
    mesh = world.with_vertices(frame.to_wall(world.vertices))

    def scanner(step: float, **model: object) -> LaserScanner:
        config = ScannerConfig(azimuth_step_rad=step, zenith_step_rad=step)
        return LaserScanner.aimed(station, frame, mesh.vertices, config, TlsModel(**model))

    coarse = scanner(ScannerConfig().azimuth_step_rad)
    step = ScannerConfig().azimuth_step_rad * np.sqrt(coarse.pattern.lines * coarse.pattern.pulses / PULSES)
    beam = {"name": "beam_divergence", "divergence_rad": DIVERGENCE_RAD, "sub_rays": SUB_RAYS}
    pencil, wide = scanner(step), scanner(step, effects=[beam])
    count, caster = pencil.pattern.lines * pencil.pattern.pulses, RayCaster(mesh)

    first = seconds(lambda: wide.observe(caster, random))
    memory = peak_memory_gb()  # of the observation: before the bare cast's rays are evaluated
    bare = bare_cast(caster, vector(wide.position), *pulse_by_pulse(wide))
    apart = bare_cast(caster, vector(wide.position), *sub_rays(wide))
    beams, pulses, cast, slow = medians(lambda: wide.observe(caster, random), lambda: pencil.observe(caster, random), bare, apart)
    print(f"{VARIANT}{lanes}, {dr.thread_count()} threads, {len(mesh.faces):,} triangles, {count:,} pulses, {SUB_RAYS} sub-rays")
    print(f"first call, compilation included      {first:6.3f} s")
    print(f"bare ray_intersect_preliminary        {cast:6.3f} s   {SUB_RAYS * count / cast / 1e6:6.1f} M rays/s")
    print(f"the same, set by set                  {slow:6.3f} s   {SUB_RAYS * count / slow / 1e6:6.1f} M rays/s")
    print(f"observation with the beam             {beams:6.3f} s   {count / beams / 1e6:6.2f} M pulses/s")
    print(f"observation with one ray              {pulses:6.3f} s   {count / pulses / 1e6:6.2f} M pulses/s")
    print(f"share of the bare rate, beam          {cast / beams:6.2f}     (target: at least 0.5)")
    print(f"over the bare rate, set by set        {slow / beams:6.2f}     (target: at least 0.75)")
    print("mean range with the beam less mean range")
    axis, dense = (differences(scanner, step, beam, other, caster, random) for other in ([], [{**beam, "sub_rays": 61}]))
    for name, values in (
        ("of the axis, echoes equally strong", equal_echoes(wide, caster)),
        ("of a beam of 61 sub-rays", dense),
        ("of the axis, off edges", axis[np.abs(axis) < EDGE_MM]),
        ("of the axis, edges included: the lean", axis),
    ):
        error = values.std() / np.sqrt(values.size)
        print(f"  {name:40s}{values.mean():6.3f} mm  (standard error {error:.3f})")
    print(f"peak memory                           {memory:6.2f} GB")


def pulse_by_pulse(scanner: LaserScanner) -> list[mi.Array3f64]:
    """Directions of the beam's sub-rays, those of a pulse one after another, in parts; not yet evaluated."""
    beam, count, found = Beam(divergence_rad=DIVERGENCE_RAD, sub_rays=SUB_RAYS), scanner.shape[0] * scanner.shape[1], []
    for start in range(0, count, AT_ONCE):
        ray = dr.arange(mi.UInt32, SUB_RAYS * min(AT_ONCE, count - start))
        pulses = scanner.pulses_at(start + ray // SUB_RAYS)
        axis, *across = (
            rotated(scanner.rotation, vectors)
            for vectors in (direction(pulses.azimuth, pulses.zenith), *tangents(pulses.azimuth, pulses.zenith))
        )
        found.append(beam.sub_ray(axis, across, ray % SUB_RAYS))
    return found


def sub_rays(scanner: LaserScanner) -> list[mi.Array3f64]:
    """Directions of the beam's sub-rays, one set of all pulses per sub-ray, not yet evaluated."""
    pulses = scanner.emit()
    axis, *across = (
        rotated(scanner.rotation, vectors)
        for vectors in (direction(pulses.azimuth, pulses.zenith), *tangents(pulses.azimuth, pulses.zenith))
    )
    beam = Beam(divergence_rad=DIVERGENCE_RAD, sub_rays=SUB_RAYS)
    return [beam.sub_ray(axis, across, mi.UInt32(number)) for number in range(SUB_RAYS)]


def equal_echoes(scanner: LaserScanner, caster: RayCaster) -> np.ndarray:
    """Mean range of all sub-rays less that of the axis, mm, of the pulses whose sub-rays all return."""
    mean, axis = mi.Float64(0), None
    for ray in sub_rays(scanner):  # the first is the axis
        hits = caster.intersect(vector(scanner.position), ray, exact=True)
        found = dr.select(hits.valid, hits.distance, np.nan)
        axis = found if axis is None else axis
        mean += found / SUB_RAYS
    difference = (1e3 * (mean - axis)).numpy()
    return difference[np.isfinite(difference)]


def differences(scanner, step: float, beam: dict, other: list[dict], caster: RayCaster, random: KeyedRandom) -> np.ndarray:
    """Range of the beam less that with the `other` effects, mm, without noise, of the pulses that return in both."""
    noise = {"range_sigma_m": 0.0, "angle_sigma_rad": 0.0}
    wide, reference = (scanner(step, noise=noise, effects=effects).observe(caster, random).depth for effects in ([beam], other))
    difference = 1e3 * (wide - reference)
    return difference[np.isfinite(difference)]


if __name__ == "__main__":
    main()
