"""Test measurements that `gap` cannot use.

Each is refused in one line that says what is wrong and where, and no files are left behind.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from gap_cases import write_scan
from surfaces import plane

from pipeline.cli.main import main
from pipeline.formats.measurements.checks import PointFit, check_different
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from pipeline.formats.points.points import read_points
from pipeline.formats.points.xyz import read_xyz
from scene.common.errors import InputError
from scene.ray_casting.raycast import RayCaster
from sensors.effects.base import Sensor

SCALE_AT, OFFSET_AT = 131, 155
"""Places of the first scale factor and the first offset in the header of a LAS file."""


@pytest.fixture
def case(tmp_path: Path) -> Path:
    folder = tmp_path / "case"
    folder.mkdir()
    write_scan(folder, 1, step_rad=0.012)
    return folder


def changed(**keys: Any) -> Callable[[Path], None]:
    """Return a function that changes keys of measurement.yaml."""

    def change(folder: Path) -> None:
        path = folder / "measurement.yaml"
        path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | keys))

    return change


def scanned(folder: Path) -> Any:
    """Return the scan's points (n, 3), scanner frame."""
    return read_points(folder / "scan_0.ply").points


def put(move: Callable[[Any], Any], *, pattern: bool = True) -> Callable[[Path], None]:
    """Return a function that replaces the points (n, 3) of a measurement by `move` of them (m, 3), as an XYZ file."""

    def change(folder: Path) -> None:
        np.savetxt(folder / "scan.xyz", move(scanned(folder)), fmt="%.17g")
        changed(points="scan.xyz", **({} if pattern else {"pattern": None}))(folder)

    return change


def in_world(folder: Path) -> None:
    scanner = yaml.safe_load((folder / "measurement.yaml").read_text())["scanner"]
    put(lambda points: points @ np.array(scanner["rotation"]).T + np.array(scanner["position_m"]))(folder)


def silent(folder: Path) -> None:
    path = folder / "model.yaml"
    path.write_text(yaml.safe_dump({"sensor": "tls", "noise": {"range_sigma_m": 0.0, "angle_sigma_rad": 0.0}}))


def one_line(folder: Path) -> None:
    (folder / "scan.xyz").write_bytes(b"1.0 2.0 3.0 " * 4_200_000)
    changed(points="scan.xyz")(folder)


def header(place: int, value: float) -> Callable[[Path], None]:
    """Return a function that writes another number into the header of the LAZ file."""

    def change(folder: Path) -> None:
        path = folder / "scan.laz"
        write_laz(path, PointCloud(scanned(folder)))
        data = bytearray(path.read_bytes())
        struct.pack_into("<d", data, place, value)
        path.write_bytes(data)
        changed(points="scan.laz")(folder)

    return change


def sweeps(azimuth: list[float], zenith: list[float]) -> Callable[[Path], None]:
    return changed(pattern={"azimuth_rad": azimuth, "zenith_rad": zenith})


BAD: dict[str, tuple[Callable[[Path], None], str]] = {
    "no files": (changed(points=[]), "names no file"),
    "step of the pattern": (sweeps([0.9, 2.3, 1e-12], [0.8, 1.7, 0.01]), "too many for"),
    "pattern in degrees": (sweeps([50.0, 130.0, 0.7], [45.0, 95.0, 0.7]), "angles are in radians"),
    "zenith beyond nadir": (sweeps([0.9, 2.3, 0.012], [0.8, 5.0, 0.012]), "straight down"),
    "elevation for zenith": (sweeps([0.9, 2.3, 0.012], [0.0, 0.7, 0.012]), "'pattern' contains only"),
    "world taken for scanner": (in_world, "`frame: world`"),
    "scanner taken for world": (changed(frame="world"), "`frame: scanner`"),
    "no noise": (silent, "range_sigma_m"),
    "scale NaN": (header(SCALE_AT, float("nan")), "scale factors"),
    "scale 0": (header(SCALE_AT, 0.0), "scale factors"),
    "scale infinite": (header(SCALE_AT, float("inf")), "scale factors"),
    "offset 1e9": (header(OFFSET_AT, 1e9), "states a box from"),
    "one point 5000 times": (put(lambda points: np.repeat(points[:1], 5000, axis=0)), "are at the same place"),
    "one point 3 times": (put(lambda points: np.repeat(points[:1], 3, axis=0)), "are at the same place"),
    "on one line": (put(lambda points: points[0] + np.linspace(0, 1, 500)[:, None] * (points[900] - points[0])), "on one line"),
    "negative intensity": (put(lambda points: np.column_stack([points, -np.ones(len(points))])), "intensities from -1 to -1"),
    "huge intensity": (put(lambda points: np.column_stack([points, np.full(len(points), 1e300)])), "relative received power"),
    "infinite": (put(lambda points: points + np.inf), "no point with finite values"),
    "NaN": (put(lambda points: points * np.nan), "no point with finite values"),
    "one of 1e300": (put(lambda points: np.concatenate([points, [[1e300, 0.0, 0.0]]])), "1 of "),
    "1e9 away": (put(lambda points: points + 1e9), "export the points in metres"),
    "1e7 away": (put(lambda points: points + 1e7), "of the points lie in directions"),
    "10 m behind": (put(lambda points: points * (1 + 10 / np.linalg.norm(points, axis=1, keepdims=True))), "10 m behind the"),
    "in millimetres": (put(lambda points: 1000 * points), "correct the sensor's position"),
    "one long line": (one_line, "a line of more than 65,536 bytes"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_measurement_is_answered_by_one_line(
    name: str, case: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    spoil, words = BAD[name]
    spoil(case)
    code = main(["gap", str(case), "--out", str(tmp_path / "out"), "--quiet"])
    told = capfd.readouterr()
    assert (code, told.out) == (2, "")
    assert told.err.startswith("error: ")
    assert told.err.count("\n") == 1
    assert words in told.err
    assert len(told.err) < 1000
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("value", ["nan", "inf", "1e300", "-1", "much"])
def test_an_error_of_the_reference_is_a_length(value: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["gap", "--identifiability", "configs/demo.yaml", f"--reference-error={value}", "--out", str(tmp_path / "out")]
    assert main(words) == 2
    assert f"got '{value}'; allowed: a number from 0 to 100" in capfd.readouterr().err
    assert not (tmp_path / "out").exists()


def test_points_that_did_not_return_are_left_out(case: Path) -> None:
    count = len(scanned(case))
    put(lambda points: np.concatenate([points, np.full((7, 3), np.nan), np.full((5, 3), np.inf)]))(case)
    assert len(read_measurement(case).cloud.points) == count


def test_fit_tells_how_far_points_lie_behind_the_reference(case: Path) -> None:
    good = read_measurement(case)
    origin = good.viewpoint
    away = good.cloud.points - origin
    behind = origin + away * (1 + 3.0 / np.linalg.norm(away, axis=1, keepdims=True))
    assert good.fit.good
    fit = PointFit.of(behind, origin, good.scene, "tls")
    assert not fit.good
    assert fit.off_m == pytest.approx(3.0, abs=0.01)  # noise of 3 mm, pose off by some millimetres


def test_a_line_is_bounded_wherever_it_stands(tmp_path: Path) -> None:
    path = tmp_path / "late.xyz"
    path.write_bytes(b"1 2 3\n" * 50_000 + b"4 5 6 " * 50_000 + b"\n")
    with pytest.raises(InputError, match="a line of more than"):
        read_xyz(path)
    path.write_bytes(b"1 2 3\n" * 50_000)
    assert len(read_xyz(path).points) == 50_000


@pytest.mark.parametrize(("sensor", "off_m", "good"), [("tls", 4.0, False), ("stereo", 4.0, True), ("stereo", 8.0, False)])
def test_a_pair_may_be_off_by_what_a_turned_camera_does(sensor: Sensor, off_m: float, good: bool) -> None:
    """Points that a rotated camera moves by 3.5 m and more are accepted.

    The camera is rotated by 3.5 mrad (up to 4 in the catalogue), and the points are at 100 m, ten base lengths away.
    """
    x, y = np.meshgrid(np.linspace(-10, 10, 21), np.linspace(-10, 10, 21))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, -100.0)], axis=1)
    wall = RayCaster(plane(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -100.0]), half_side=50.0))
    away = points * (1 + off_m / np.linalg.norm(points, axis=1, keepdims=True))
    assert PointFit.of(away, np.zeros(3), wall, sensor).good == good


def test_one_epoch_under_two_names_is_named() -> None:
    points = np.random.default_rng(1).normal(size=(50, 3))
    check_different({"a.laz": PointCloud(points), "b.laz": PointCloud(points + 1e-9)})
    with pytest.raises(InputError, match=r"c\.laz: the cloud has the same points as a\.laz"):
        check_different({"a.laz": PointCloud(points), "b.laz": PointCloud(points[1:]), "c.laz": PointCloud(points.copy())})
