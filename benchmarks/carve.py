"""Measure the time for carving 1,500 blocks of 320 triangles, compared with one bare Manifold boolean of the same solids.

    python benchmarks/carve.py            2.5 M triangles; target: at most 2 times the bare boolean, 3 GB
    python benchmarks/carve.py --large    16 M triangles; target: 6 GB (the bare boolean is left out, as it would need 17 GB)

Our time includes everything: finding the patches, closing them, the boolean, repairing the rims, labels, volumes and the whole
carved wall. The bare boolean builds the closed wall and the blocks and computes the difference's triangles only. Each part runs
in its own process, so that its peak memory (with Python, the libraries and the wall) is its own.
"""

from __future__ import annotations

import argparse
import json
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from manifold3d import Manifold, Mesh64

from scene.blocks.block import Blocks, RockfallConfig, place_blocks
from scene.blocks.carve import carve
from scene.blocks.distributions import Gaussian
from scene.blocks.solid import close_patch
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh

WIDTH_M, HEIGHT_M = 70.0, 45.0
CELLS_M = {False: 0.05, True: 0.02}
MEMORY_GB = {False: 3.0, True: 6.0}


def rough_wall(cell_m: float) -> TriangleMesh:
    """Return a heightfield with relief from metres down to the cell, as a sum of waves; the same relief for every cell size."""
    random = np.random.default_rng(1)
    x, y = np.arange(0, WIDTH_M, cell_m), np.arange(0, HEIGHT_M, cell_m)
    z = np.zeros((len(y), len(x)))
    for wavelength in np.geomspace(0.15, 20.0, 24):
        angle, phase = random.uniform(0, 2 * np.pi, 2)
        wave = 2 * np.pi / wavelength
        z += 0.02 * wavelength * np.sin(wave * (np.cos(angle) * x + np.sin(angle) * y[:, None]) + phase)
    vertices = np.empty((z.size, 3))
    vertices[:, 0], vertices[:, 1], vertices[:, 2] = np.tile(x, len(y)), np.repeat(y, len(x)), z.ravel()
    number = np.arange(z.size, dtype=np.int32).reshape(z.shape)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.empty((2 * len(a), 3), dtype=np.int32)
    faces[: len(a)], faces[len(a) :] = np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)
    return TriangleMesh(vertices, faces, np.full(len(vertices), 0.5, dtype=np.float32))


def time_ours(wall: TriangleMesh, blocks: Blocks) -> dict[str, float]:
    start = time.perf_counter()
    carved = carve(wall, blocks)
    seconds = time.perf_counter() - start
    return {"seconds": seconds, "balance": carved.balance_m3 / carved.wall_volume_m3, "faces": len(carved.mesh.faces)}


def time_bare(wall: TriangleMesh, blocks: Blocks) -> dict[str, float]:
    whole, _ = close_patch(wall, np.arange(len(wall.faces), dtype=np.int32), float(blocks.bbox[:, 0, 2].min()))
    closed = whole.manifold.to_mesh64()
    arrays = [(np.array(closed.vert_properties), np.array(closed.tri_verts)), (blocks.vertices, blocks.faces.astype(np.uint64))]
    del whole, closed
    start = time.perf_counter()
    solids = [Manifold(Mesh64(vertices, faces)) for vertices, faces in arrays]
    count = (solids[0] - solids[1]).num_tri()
    return {"seconds": time.perf_counter() - start, "faces": count}


def measured(part: str, cell_m: float, folder: Path) -> dict[str, float]:
    """Run one part in a process of its own."""
    command = [sys.executable, __file__, "--part", part, "--cell", str(cell_m), "--blocks", str(folder / "blocks.pickle")]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def run_part(part: str, cell_m: float, file: Path) -> None:
    wall, blocks = rough_wall(cell_m), pickle.loads(file.read_bytes())
    result = (time_ours if part == "ours" else time_bare)(wall, blocks)
    print(json.dumps(result | {"gigabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--large", action="store_true", help="16 M triangles")
    parser.add_argument("--part", choices=["ours", "bare"], help=argparse.SUPPRESS)
    parser.add_argument("--cell", type=float, help=argparse.SUPPRESS)
    parser.add_argument("--blocks", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part:
        run_part(options.part, options.cell, options.blocks)
        return
    start = time.perf_counter()
    config = RockfallConfig(count=1500, shape="sphere", size_m=Gaussian(mean=0.4, sigma=0.15, minimum=0.1))
    blocks = place_blocks(config, rough_wall(0.1), KeyedRandom(1).child("benchmark"))
    print(f"{len(blocks)} blocks of {len(blocks.faces) // len(blocks)} triangles placed in {time.perf_counter() - start:.1f} s")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "blocks.pickle").write_bytes(pickle.dumps(blocks))
        ours = measured("ours", CELLS_M[options.large], Path(folder))
        bare = None if options.large else measured("bare", CELLS_M[options.large], Path(folder))
    print(f"{'':14}{'s':>8}{'GB':>8}")
    print(f"{'carve':14}{ours['seconds']:8.2f}{ours['gigabytes']:8.2f}   {ours['faces'] / 1e6:.2f} M triangles left,", end=" ")
    print(f"balance {ours['balance']:.1e} of the wall's volume; target {MEMORY_GB[options.large]:g} GB")
    if bare:
        print(f"{'bare boolean':14}{bare['seconds']:8.2f}{bare['gigabytes']:8.2f}")
        print(f"ratio {ours['seconds'] / bare['seconds']:.2f} (target: 2 at most)")


if __name__ == "__main__":
    main()
