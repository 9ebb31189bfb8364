"""Import the modules of a command faster."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def fast_imports() -> Iterator[None]:
    """Import modules in a `with` block without garbage collection, which would check the many objects that modules keep.

    This saves about a tenth of the time. Later collections skip these objects too. Nothing is changed in a process that has
    imported modules of scarpsim before, because it may hold garbage.
    """
    if "pydantic" in sys.modules or not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
