"""Compare ICP on a million points with Open3D's: time from arrays to transform, and remaining RMS distance.

Both register the same noisy cloud to the same reference with the same normals, offset and correspondence distance; building the
tree is part of the time; the RMS of both transforms is measured on all points by one function. The best of `REPEATS` alternating
runs counts. The last line has the bound: the time to build the search tree and to search the nearest point of every point once,
which every registration to this reference has to do.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable

import numpy as np
import open3d as o3d

from pipeline.registration.closest_points import ReferenceSurface
from pipeline.registration.pairs import parts_of
from pipeline.registration.register import IcpConfig, Registration, measure_fit, register
from pipeline.registration.rigid import RigidTransform
from pipeline.registration.search_tree import SearchTree
from scene.common.keyed_random import KeyedRandom
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray

COLUMNS, ROWS, WIDTH, HEIGHT = 1250, 800, 70.0, 45.0
SIGMA, DISTANCE = 0.02, 0.1
REPEATS = 3
RANDOM = KeyedRandom(1, ("benchmark", "icp"))
OFFSET = RigidTransform.about(np.array([35.0, 22.0, 0.0]), np.array([4e-4, -5e-4, 5e-4]), np.array([0.05, -0.04, 0.03]))


def wall(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 3) points and normals of a wall whose roughness falls with its wavelength, 0.5 to 20 m."""
    z, slope = np.zeros_like(x), np.zeros((2, *x.shape))
    generator = RANDOM.child("wall").generator()
    for length in np.geomspace(0.5, 20, 24):
        direction, phase = generator.uniform(0, 2 * np.pi, 2)
        wave = 2 * np.pi / length * np.array([np.cos(direction), np.sin(direction)])
        amplitude, angle = 0.03 * length**0.8, wave[0] * x + wave[1] * y + phase
        z += amplitude * np.sin(angle)
        slope += amplitude * np.cos(angle) * wave[:, None]
    normals = np.stack([-slope[0], -slope[1], np.ones_like(x)], axis=1)
    return np.stack([x, y, z], axis=1), normals / np.linalg.norm(normals, axis=1)[:, None]


def cloud(purpose: str) -> tuple[FloatArray, FloatArray]:
    """Return a million points of the wall, row by row, shaken off their grid; and their normals."""
    generator = RANDOM.child(purpose).generator()
    x, y = np.meshgrid((np.arange(COLUMNS) + 0.5) * WIDTH / COLUMNS, (np.arange(ROWS) + 0.5) * HEIGHT / ROWS)
    shake = generator.uniform(-0.02, 0.02, (2, x.size))
    return wall(x.ravel() + shake[0], y.ravel() + shake[1])


def open3d_legacy(moving: FloatArray, points: FloatArray, normals: FloatArray) -> RigidTransform:
    pipelines = o3d.pipelines.registration
    source, target = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(array)) for array in (moving, points))
    target.normals = o3d.utility.Vector3dVector(normals)
    found = pipelines.registration_icp(
        source, target, DISTANCE, np.eye(4), pipelines.TransformationEstimationPointToPlane(), pipelines.ICPConvergenceCriteria()
    )
    return RigidTransform(found.transformation[:3, :3], found.transformation[:3, 3])


def open3d_tensor(moving: FloatArray, points: FloatArray, normals: FloatArray) -> RigidTransform:
    pipelines = o3d.t.pipelines.registration
    source, target = (o3d.t.geometry.PointCloud(o3d.core.Tensor(array)) for array in (moving, points))
    target.point.normals = o3d.core.Tensor(normals)
    found = pipelines.icp(
        source,
        target,
        DISTANCE,
        o3d.core.Tensor(np.eye(4)),
        pipelines.TransformationEstimationPointToPlane(),
        pipelines.ICPConvergenceCriteria(),
    )
    matrix = found.transformation.numpy()
    return RigidTransform(matrix[:3, :3], matrix[:3, 3])


def ours(config: IcpConfig) -> Callable[[FloatArray, FloatArray, FloatArray], Registration]:
    return lambda moving, points, normals: register(moving, points, normals, config, RANDOM)


def bound_s(surface: ReferenceSurface, aligned: FloatArray) -> float:
    """Return the shortest time to build the search tree and to search each point's nearest neighbour once, s."""
    blocks = [aligned[part] for part in parts_of(len(aligned))]
    found = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        tree = SearchTree(surface.points)
        map_in_threads(lambda block, tree=tree: tree.query(block, 1, DISTANCE), blocks)
        found.append(time.perf_counter() - start)
    return min(found)


def main() -> None:
    points, normals = cloud("reference")
    truth, _ = cloud("moving")
    moving = OFFSET.apply(truth + SIGMA * RANDOM.child("noise").generator().normal(size=truth.shape))
    shuffled = RANDOM.child("shuffle").generator().permutation(len(moving))
    config = IcpConfig(outlier_distance_threshold=DISTANCE)
    tenth = IcpConfig(outlier_distance_threshold=DISTANCE, subsample_points=True, subsample_ratio=0.9)
    rivals: dict[str, tuple[Callable[..., Registration | RigidTransform], FloatArray]] = {
        "Open3D registration_icp": (open3d_legacy, moving),
        "Open3D t.icp (float64)": (open3d_tensor, moving),
        "ours, default": (ours(config), moving),
        "ours, one tenth": (ours(tenth), moving),
        "ours, points shuffled": (ours(config), moving[shuffled]),
        "Open3D, points shuffled": (open3d_legacy, moving[shuffled]),
    }
    seconds, processor, results = dict.fromkeys(rivals, np.inf), dict.fromkeys(rivals, np.inf), {}
    for _ in range(REPEATS):
        for name, (run, source) in rivals.items():
            start, used = time.perf_counter(), time.process_time()
            results[name] = run(source, points, normals)
            seconds[name] = min(seconds[name], time.perf_counter() - start)
            processor[name] = min(processor[name], time.process_time() - used)
    peer = min(seconds["Open3D registration_icp"], seconds["Open3D t.icp (float64)"])
    surface = ReferenceSurface.build(points, normals)
    bound = bound_s(surface, results["ours, default"].apply(moving) - surface.origin)
    print(f"{len(moving):,} points to {len(points):,}, noise {SIGMA * 1e3:g} mm, offset 0.07 m and 0.8 mrad, within {DISTANCE} m")
    print(f"{'':26}{'s':>7}{'processor s':>13}{'to the faster Open3D':>22}{'RMS mm':>12}{'inliers':>11}{'off the truth mm':>18}")
    for name, result in results.items():
        moved = result.apply(moving)
        left = measure_fit(surface, moved, config)
        off = np.sqrt(np.mean(np.sum((result.apply(OFFSET.apply(truth)) - truth) ** 2, axis=1)))
        ratio, rms = seconds[name] / peer, left.rms_m * 1e3
        print(f"{name:26}{seconds[name]:7.2f}{processor[name]:13.2f}{ratio:22.2f}{rms:12.4f}{left.inliers:11,}{off * 1e3:18.3f}")
    print(f"search tree and one search of all points: {bound:.2f} s, {bound / peer:.2f} of the faster Open3D")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB (both)")


if __name__ == "__main__":
    main()
