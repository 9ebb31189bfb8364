"""Compare LAZ with laspy: 3 M points of a scan with intensity, GPS time and three extra dimensions, written and read.

Target: writing not slower than laspy's own, reading at least a million points per second on two cores.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import laspy
import numpy as np
from measure import medians, peak_memory_gb

from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import read_laz, write_laz
from pipeline.formats.points.xyz import read_xyz, write_xyz

LINES, PULSES = 2000, 1500
ROUNDS = 3


def scan() -> PointCloud:
    """Return a rough wall at 100 m in the order of a scan."""
    random = np.random.default_rng(1)
    azimuth, zenith = np.meshgrid(np.linspace(-0.5, 0.5, LINES), np.linspace(1.2, 1.9, PULSES), indexing="ij")
    distance = 100 + 0.5 * np.sin(40 * azimuth) * np.sin(30 * zenith) + random.normal(0, 0.003, azimuth.shape)
    level = distance * np.sin(zenith)
    points = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.cos(zenith)], axis=-1).reshape(-1, 3)
    count = len(points)
    extra = {
        "true_range_m": distance.ravel().astype(np.float32),
        "cos_incidence": random.uniform(0.5, 1, count).astype(np.float32),
        "block": np.zeros(count, dtype=np.int32),
    }
    return PointCloud(points, random.uniform(0, 1, count).astype(np.float32), np.arange(count) * 1e-5, extra)


def write_with_laspy(path: Path, cloud: PointCloud) -> None:
    """Write the same file by laspy's high-level interface."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.add_extra_dims([laspy.ExtraBytesParams(name, channel.dtype) for name, channel in cloud.extra.items()])
    header.scales, header.offsets = np.full(3, 1e-6), np.rint(cloud.points.mean(axis=0))
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.points.T
    las.intensity = np.rint(cloud.intensity * 65535).astype(np.uint16)
    las.gps_time = cloud.gps_time
    las.return_number[:] = las.number_of_returns[:] = 1
    for name, channel in cloud.extra.items():
        las[name] = channel
    las.write(path)


def read_with_laspy(path: Path) -> None:
    """Everything that `read_laz` gives, by laspy."""
    las = laspy.read(path)
    _ = (
        las.xyz,
        np.array(las.intensity),
        np.array(las.gps_time),
        [np.array(las[name]) for name in las.point_format.dimension_names],
    )


def main() -> None:
    cloud = scan()
    million = len(cloud.points) / 1e6
    with tempfile.TemporaryDirectory() as folder:
        ours, peers, text = (Path(folder) / name for name in ("ours.laz", "laspy.laz", "a.xyz"))
        writing, writing_laspy, writing_text = medians(
            lambda: write_laz(ours, cloud),
            lambda: write_with_laspy(peers, cloud),
            lambda: write_xyz(text, PointCloud(cloud.points, cloud.intensity)),
            rounds=ROUNDS,
        )
        reading, reading_laspy, reading_text = medians(
            lambda: read_laz(ours), lambda: read_with_laspy(ours), lambda: read_xyz(text), rounds=ROUNDS
        )
        sizes = [path.stat().st_size / len(cloud.points) for path in (ours, peers, text)]
    print(f"{len(cloud.points):,} points, intensity, GPS time, 3 extra dimensions")
    rows = (
        ("LAZ, ours", writing, reading, sizes[0]),
        ("LAZ, laspy", writing_laspy, reading_laspy, sizes[1]),
        ("XYZ text", writing_text, reading_text, sizes[2]),
    )
    print("              write s      M/s    read s      M/s   bytes/point")
    for name, write_s, read_s, size in rows:
        print(f"{name:12s} {write_s:8.2f} {million / write_s:8.2f} {read_s:9.2f} {million / read_s:8.2f} {size:12.1f}")
    print(f"writing rate over laspy's {writing_laspy / writing:6.2f}   (target: at least 1)")
    print(f"reading rate              {million / reading:6.2f} M/s   (target: at least 1)")
    print(f"peak memory               {peak_memory_gb():6.2f} GB")


if __name__ == "__main__":
    main()
