"""Functions that benchmarks share: interleaved timing, peak memory, and the bare casts for comparison."""

from __future__ import annotations

import ctypes
import os
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import drjit

from scene.common.backend import dr, mi
from scene.ray_casting.raycast import RayCaster

ROUNDS = 7
_SET_TARGET = "_Z19jit_llvm_set_targetPKcS0_j"
"""Of libdrjit-core: jit_llvm_set_target(processor, features, lanes), which Python has no word for."""


def narrow_vectors() -> bool:
    """Whether `--avx2` asks for vectors of 8 lanes and no AVX-512, as most desktops have them; compiled so from here on.

    Embree may still use its own instructions of the processor for them.
    """
    asked = "--avx2" in sys.argv
    if asked:
        library = ctypes.CDLL(str(Path(drjit.__file__).with_name("libdrjit-core.so")))
        set_target = getattr(library, _SET_TARGET)
        set_target.argtypes = [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint32]
        set_target(b"haswell", None, 8)
    return asked


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one call, s, device work included."""
    start = time.perf_counter()
    work()
    dr.sync_thread()
    return time.perf_counter() - start


def medians(*works: Callable[[], object], rounds: int = ROUNDS) -> list[float]:
    """Median wall time of each work, s, taken in turns after one round that compiles kernels and fills caches."""
    for work in works:
        seconds(work)
    timed: Sequence[Sequence[float]] = [[seconds(work) for work in works] for _ in range(rounds)]
    return [statistics.median(column) for column in zip(*timed, strict=True)]


@contextmanager
def empty_kernel_cache() -> Iterator[dict[str, str]]:
    """Yield the environment of a process that finds no compiled kernel, as a new user's, and keeps its own for the next one."""
    with tempfile.TemporaryDirectory() as folder:
        yield {**os.environ, "DRJIT_CACHE_DIR": folder}


def peak_memory_gb() -> float:
    """Return the largest memory that this process has taken so far, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def bare_cast(caster: RayCaster, origin: Any, *directions: Any) -> Callable[[], None]:
    """`ray_intersect_preliminary` alone on rays that are ready in memory (3 x (n,) float64), coherent, as fast as it goes.

    One set of rays per entry of `directions`, cast one after the other.
    """
    rays = [mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction)) for direction in directions]
    dr.eval(rays)

    def work() -> None:
        for ray in rays:
            found = caster.bare.ray_intersect_preliminary(ray, coherent=True)
            dr.eval(found.t, found.prim_index)

    return work


def bare_test(caster: RayCaster, origin: Any, direction: Any, reach: float) -> Callable[[], None]:
    """`ray_test` alone on rays that are ready in memory."""
    ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
    ray.maxt = mi.Float(reach)
    dr.eval(ray)
    return lambda: dr.eval(caster.bare.ray_test(ray, coherent=True))
