"""Count the Dr.Jit kernels that a call compiles or runs, independent of what the machine's kernel cache already holds."""

from __future__ import annotations

from collections.abc import Callable

from scene.common.backend import dr


def kernels(work: Callable[[], object]) -> dict[str, int]:
    """Run `work` and return the number of operations of each kernel, keyed by its hash: what an empty cache would have to
    compile.
    """
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        work()
        return {each["hash"]: each["operation_count"] for each in dr.kernel_history() if each["type"] == dr.KernelType.JIT}
