"""NumPy arrays on the device.

Dr.Jit's LLVM backend takes the memory of a NumPy array as it is, and its kernels read whole packets of 16 elements (Embree, 16
bytes): past the array's end, where now and then the process owns no memory. So every array is copied into one with room to spare.
A kernel is compiled anew for every pattern of arrays that start at a multiple of a packet or do not: here all of them do.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene.common.backend import mi
from scene.geometry.mesh import FloatArray

_SPARE = 16
"""Elements behind the last one that a kernel may read: the widest packet."""
_DTYPES: dict[Any, type] = {
    mi.Float32: np.float32,
    mi.Float64: np.float64,
    mi.Int32: np.int32,
    mi.UInt32: np.uint32,
    mi.Bool: np.bool_,
}


def on_device(kind: Any, values: NDArray[Any]) -> Any:
    """A copy of `values` of any shape as a device array (n,) in C order, of the Dr.Jit type `kind`: mi.Float64, mi.Bool ..."""
    buffer: NDArray[Any] = np.empty(values.size + 2 * _SPARE, _DTYPES[kind])
    start = -(buffer.ctypes.data // buffer.itemsize) % _SPARE
    array = buffer[start : start + values.size]
    array.reshape(values.shape)[...] = values
    return kind(array)


def vectors_on_device(vectors: FloatArray) -> mi.Array3f64:
    """(n, 3) vectors as a device vector of 3 x (n,)."""
    return mi.Array3f64(*(on_device(mi.Float64, component) for component in vectors.T))
