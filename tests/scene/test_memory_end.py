"""Dr.Jit uses NumPy's memory directly, and its kernels read packets of 16: nothing may be read past an array's end.

Memory seldom ends there, and then the process dies. Here it always does: the page after the array is protected.
"""

import subprocess
import sys

import pytest

from scene.common.backend import LLVM, VARIANT

FORBIDDEN_PAGE = """
import ctypes, mmap
import numpy as np

def at_the_end_of_a_page(values):
    pages = -(-values.nbytes // mmap.PAGESIZE)
    memory = mmap.mmap(-1, (pages + 1) * mmap.PAGESIZE)
    start = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    forbidden = ctypes.c_void_p(start + pages * mmap.PAGESIZE)
    assert ctypes.CDLL(None).mprotect(forbidden, ctypes.c_size_t(mmap.PAGESIZE), 0) == 0
    array = np.frombuffer(memory, values.dtype, values.size, pages * mmap.PAGESIZE - values.nbytes)
    array[:] = values.ravel()
    return array.reshape(values.shape)

"""
RAY_CASTER = """
from scene.geometry.mesh import TriangleMesh
from scene.ray_casting.raycast import RayCaster

fan = np.array([[0.0, 0, 0]] + [[np.cos(a), np.sin(a), 0] for a in np.linspace(0, 6, 602)])
faces = np.stack([np.zeros(601, int), np.arange(1, 602), np.arange(2, 603)], axis=1)
caster = RayCaster(TriangleMesh(at_the_end_of_a_page(fan), faces))
distance, _ = caster.cast(np.array([0.3, 0.2, 5.0]), np.array([[0.0, 0.0, -1.0]]))
print(distance[0])
"""
UPLOAD = """
from types import SimpleNamespace
import scene.ray_casting.upload
from scene.common.backend import dr, mi

scene.ray_casting.upload.np = SimpleNamespace(empty=lambda size, dtype: at_the_end_of_a_page(np.zeros(size, dtype)))
for kind in (mi.Float32, mi.Float64, mi.Int32, mi.UInt32, mi.Bool):
    for size in (1, 7, 1001, 4096):
        values = scene.ray_casting.upload.on_device(kind, np.arange(size) % 2)
        assert dr.sum(mi.Float64(dr.select(values == kind(1), 1, 0)))[0] == size // 2
print("read")
"""


pytestmark = pytest.mark.skipif(VARIANT != LLVM or sys.platform != "linux", reason="of the LLVM backend's packets")


def printed(script: str) -> str:
    done = subprocess.run([sys.executable, "-c", FORBIDDEN_PAGE + script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.returncode, done.stderr)
    return done.stdout.strip()


def test_a_ray_caster_reads_no_further_than_the_vertices() -> None:
    assert printed(RAY_CASTER) == "5.0"


def test_kernels_stay_within_the_memory_of_an_uploaded_array() -> None:
    assert printed(UPLOAD) == "read"
