"""The kernels that a piece of work runs, however many of them the machine's cache holds already."""

from __future__ import annotations

from collections.abc import Callable

from scene.common.backend import dr


def kernels(work: Callable[[], object]) -> dict[str, int]:
    """Operations of each kernel that `work` runs, by what the cache knows it as: what an empty cache would have to compile."""
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        work()
        return {each["hash"]: each["operation_count"] for each in dr.kernel_history() if each["type"] == dr.KernelType.JIT}
