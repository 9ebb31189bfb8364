"""Select the ray-tracing backend once per process: Mitsuba's CUDA variant if there is a GPU, else its LLVM variant.

Import `mi` and `dr` from here and nowhere else, so that the variant is set before any Mitsuba type is used.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from scene.common.errors import InputError

if "tensorflow" in sys.modules and "drjit" not in sys.modules:
    raise InputError(
        "TensorFlow was imported first; its LLVM symbols would crash the ray tracer",
        where="scarpsim",
        remedy="import scarpsim's scene, sensors or pipeline before tensorflow, or use two processes",
    )

import drjit as dr
import mitsuba as mi

CUDA, LLVM = "cuda_ad_mono", "llvm_ad_mono"
_VARIANT_VARIABLE = "SCARPSIM_VARIANT"
"""Environment variable that selects the variant."""


def _choose() -> str:
    """Return the variant that the environment variable names, or the best one that this machine supports."""
    wanted = os.environ.get(_VARIANT_VARIABLE)
    if wanted:
        if wanted not in (CUDA, LLVM):
            raise InputError(
                f"the variable has the unknown value '{wanted}'",
                where=_VARIANT_VARIABLE,
                allowed=f"{CUDA}, {LLVM}",
                remedy="set the variable to one of them, or unset it",
            )
        return wanted
    return CUDA if dr.has_backend(dr.JitBackend.CUDA) else LLVM


def _activate() -> str:
    """Set Mitsuba's variant and return its name. Raises InputError if the device or the library that it needs is missing."""
    variant = _choose()
    backend = dr.JitBackend.CUDA if variant == CUDA else dr.JitBackend.LLVM
    if not dr.has_backend(backend):
        raise InputError(
            "no CUDA device was found" if variant == CUDA else "the system library libLLVM is missing",
            where=f"Mitsuba variant {variant}",
            remedy="run `scarpsim doctor` to see why, or unset SCARPSIM_VARIANT to compute on the CPU"
            if variant == CUDA
            else "install libLLVM (Debian, Ubuntu: apt-get install libllvm15)",
        )
    mi.set_variant(variant)
    return variant


VARIANT = _activate()


@contextmanager
def limited_threads(most: int | None) -> Iterator[None]:
    """Let the ray tracer use at most `most` threads on the CPU inside a `with` block; None: no limit.

    A thread of the ray tracer that waits for the next task keeps a processor core busy, so that many short tasks cost less time
    of the processors with one thread, and take as long. Results do not depend on the number of threads.
    """
    before = dr.thread_count()
    dr.set_thread_count(before if most is None else min(most, before))
    try:
        yield
    finally:
        dr.set_thread_count(before)


__all__ = ["CUDA", "LLVM", "VARIANT", "dr", "limited_threads", "mi"]
