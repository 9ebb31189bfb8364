"""Copy NumPy arrays to the device.

Dr.Jit's LLVM backend uses the memory of a NumPy array directly, and its kernels read whole packets of 16 elements (Embree: 16
bytes). They may so read past the array's end, into memory that the process does not own. Every array is therefore copied into
a larger one. A kernel is also compiled anew for each combination of arrays that do or do not start at a multiple of a packet;
here all of them do.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene.common.backend import mi
from scene.geometry.mesh import FloatArray

_SPARE = 16
"""Number of elements behind the last one that a kernel may read: the widest packet."""
_DTYPES: dict[Any, type] = {
    mi.Float32: np.float32,
    mi.Float64: np.float64,
    mi.Int32: np.int32,
    mi.UInt32: np.uint32,
    mi.Bool: np.bool_,
}
"""NumPy type of each device type."""


def on_device(kind: Any, values: NDArray[Any]) -> Any:
    """Copy a NumPy array of any shape to an array (n,) of the ray-tracing device, in C order.

    kind: Dr.Jit type of the result, such as mi.Float64 or mi.Bool.
    """
    buffer: NDArray[Any] = np.empty(values.size + 2 * _SPARE, _DTYPES[kind])
    start = -(buffer.ctypes.data // buffer.itemsize) % _SPARE
    array = buffer[start : start + values.size]
    array.reshape(values.shape)[...] = values
    return kind(array)


def vectors_on_device(vectors: FloatArray) -> mi.Array3f64:
    """Copy a NumPy array of vectors (n, 3) to the ray-tracing device, as a vector of three arrays (n,)."""
    return mi.Array3f64(*(on_device(mi.Float64, component) for component in vectors.T))
