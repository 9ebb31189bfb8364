"""From raw files to a measurement folder: every format, the scanner's position from its scan lines, references, and bad input.

The scans come from `gap_cases`: closed form, without our own code. Real scans lie beside the checkout (`shared/`); their tests
are skipped where that folder is missing.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from gap_cases import write_scan

from pipeline.cli.main import main
from pipeline.formats.cameras.cameras import write_cameras_yaml
from pipeline.formats.cameras.colmap import write_colmap
from pipeline.formats.cameras.metashape import write_metashape
from pipeline.formats.measurements.measurement import StereoMeasurement, TlsMeasurement, read_measurement
from pipeline.formats.meshes.ply import read_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.e57 import E57Scan, write_e57
from pipeline.formats.points.laz import PulseChannels, write_laz
from pipeline.formats.points.points import read_points
from pipeline.formats.points.ptx import orthonormal, read_ptx
from pipeline.formats.rasters.geotiff import write_geotiff
from pipeline.gap.residuals.stereo_residuals import stereo_residuals
from pipeline.measurement.build import build
from pipeline.measurement.origin import origin_from_point_order
from pipeline.measurement.request import Request
from pipeline.measurement.scans import read_scans
from pipeline.surface.triangulation import triangulate_seen_points
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from sensors.cameras.camera import Camera, CameraPair

pytestmark = pytest.mark.usefixtures("undrawn")

SHARED = Path(__file__).parents[3] / "shared" / "data"
FOREST = SHARED / "tls_forest_vz400i" / "TLS_scan.npz"
ROCKS = SHARED / "tls_rock_blocks" / "Blocs_EGU_avant.txt"
POSITION = np.array([42.0 * 0.42, -34.0, 2.5])
STEP = 0.018
UTM = np.array([547_000.0, 5_149_000.0, 700.0])
Case = tuple[Path, PointCloud, np.ndarray]


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """A folder with wall.ply, the cloud in the scanner's frame, and the rotation to the world."""
    folder = tmp_path_factory.mktemp("raw")
    write_scan(folder, 1, step_rad=STEP)
    rotation = np.array(yaml.safe_load((folder / "measurement.yaml").read_text())["scanner"]["rotation"])
    return folder, read_points(folder / "scan_0.ply"), rotation


def in_world(case: Case) -> np.ndarray:
    _, cloud, rotation = case
    return cloud.points @ rotation.T + POSITION


def as_text(name: str, header: str = "", separator: str = " ", last: str = "") -> Callable[[Case, Path], Path]:
    def write(case: Case, folder: Path) -> Path:
        rows = np.column_stack([in_world(case), case[1].intensity])
        lines = [separator.join(["%.6f"] * 4) % tuple(row) + last for row in rows]
        (folder / name).write_text("\n".join([*([header] if header else []), *lines]) + "\n")
        return folder / name

    return write


def as_pts(case: Case, folder: Path) -> Path:
    return as_text("a.pts", str(len(case[1].points)), last=" 128 0 255")(case, folder)


def as_e57(case: Case, folder: Path) -> Path:
    _, cloud, rotation = case
    write_e57(folder / "a.e57", [E57Scan("one", PointCloud(cloud.points, cloud.intensity), POSITION, rotation)])
    return folder / "a.e57"


def as_ptx(case: Case, folder: Path) -> Path:
    """Write a PTX grid of one row with a missing return, and a rotation of four digits."""
    _, cloud, rotation = case
    matrix = np.vstack([np.hstack([np.round(rotation.T, 4), np.zeros((3, 1))]), [*POSITION, 1.0]])
    vectors = [POSITION, *np.round(rotation.T, 4), *matrix]
    head = [str(len(cloud.points) + 1), "1", *(" ".join(f"{value:.4f}" for value in vector) for vector in vectors)]
    power = cloud.intensity / cloud.intensity.max()
    rows = [f"{x:.6f} {y:.6f} {z:.6f} {i:.4f}" for (x, y, z), i in zip(cloud.points, power, strict=True)]
    (folder / "a.ptx").write_text("\n".join([*head, "0 0 0 0.5", *rows]) + "\n")
    return folder / "a.ptx"


def as_laz(case: Case, folder: Path) -> Path:
    """Write points in the order of a tile's index instead of that of the scan, with GPS times."""
    mixed = np.random.default_rng(1).permutation(len(case[1].points))
    cloud = case[1]
    write_laz(folder / "a.laz", PointCloud(in_world(case)[mixed], cloud.intensity[mixed], cloud.gps_time[mixed]))
    return folder / "a.laz"


FORMATS: dict[str, Callable[[Case, Path], Path]] = {
    "xyz": as_text("a.xyz"),
    "csv of another head": as_text("a.csv", "Easting;Northing;H;Reflectance", ";"),
    "pts": as_pts,
    "e57": as_e57,
    "ptx": as_ptx,
    "laz": as_laz,
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_measurement(name: str, case: Case, tmp_path: Path) -> None:
    """Position and pattern come from the header or the scan lines; the points keep their places."""
    path = FORMATS[name](case, tmp_path)
    found = build(Request([path], str(case[0] / "wall.ply"), "riegl_vz400i"), tmp_path / "out")
    measurement = read_measurement(tmp_path / "out")
    stated = yaml.safe_load((tmp_path / "out" / "measurement.yaml").read_text())
    np.testing.assert_allclose(stated["scanner"]["position_m"], POSITION, atol=0.004)
    np.testing.assert_allclose(np.sort(measurement.frame.to_world(measurement.cloud.points)[:, 0]), np.sort(in_world(case)[:, 0]),
                               atol=0.003 if name == "ptx" else 2e-6)  # fmt: skip
    assert measurement.cloud.intensity is not None
    assert stated["pattern"]["azimuth_rad"][2] == pytest.approx(STEP, rel=1e-4)
    assert stated["pattern"]["zenith_rad"][2] == pytest.approx(STEP, rel=1e-4)
    assert measurement.fit.near > 0.99
    assert json.loads((tmp_path / "out" / "understood.json").read_text())["next"] == found.next_command
    assert any("taken as exact" in line for line in found.about["reference"])


def test_what_was_guessed_is_said(case: Case, tmp_path: Path) -> None:
    scan = read_scans(as_pts(case, tmp_path))[0]
    assert "x, y, z, intensity, red, green, blue" in scan.words[0]
    scan = read_scans(as_ptx(case, tmp_path))[0]
    assert any("was corrected" in words for words in scan.words)
    assert len(scan.cloud.points) == len(case[1].points)
    assert len(read_points(tmp_path / "a.ptx").points) == len(case[1].points)
    cells = read_ptx(tmp_path / "a.ptx")[0].cloud.extra
    assert (cells["column"].min(), cells["row"].max()) == (1, 0)


def test_columns_are_taken_as_named(case: Case, tmp_path: Path) -> None:
    path = as_pts(case, tmp_path)
    cloud = read_scans(path, columns=["y", "x", "z", "-", "-", "-", "intensity"])[0].cloud
    np.testing.assert_allclose(cloud.points[:, [1, 0, 2]], in_world(case), atol=1e-6)
    assert cloud.intensity is None, "constant"
    with pytest.raises(InputError, match="has 7 columns, but --columns names x, y"):
        read_scans(path, columns=["x", "y"])


@pytest.mark.parametrize(("decimals", "atol"), [(6, 1e-4), (4, 0.005), (3, 0.05)])
def test_the_lines_of_a_scan_meet_in_its_scanner(decimals: int, atol: float, case: Case) -> None:
    """Rounding to 1 mm at 35 m is 8 urad in an angle; the error is within 3 sigma of the fit's own estimate."""
    found = origin_from_point_order(np.round(in_world(case), decimals))
    assert found is not None
    np.testing.assert_allclose(found.position, POSITION, atol=atol)
    assert np.all(np.abs(found.position - POSITION) < 5 * found.sigma_m + 1e-6)


def test_points_in_no_order_tell_no_scanner(case: Case) -> None:
    assert origin_from_point_order(np.random.default_rng(2).permutation(in_world(case))) is None


def test_a_stated_position_gives_way_to_the_scan_lines(case: Case, tmp_path: Path) -> None:
    path = as_text("a.xyz")(case, tmp_path)
    position = tuple(POSITION + np.array([0.2, -0.1, 0.1]))
    found = build(Request([path], str(case[0] / "wall.ply"), "riegl_vz400i", position=position), tmp_path / "out")
    assert "0.245 m from the one as given by --position" in found.about["scanner"][0]
    stated = yaml.safe_load((tmp_path / "out" / "measurement.yaml").read_text())["scanner"]
    np.testing.assert_allclose(stated["position_m"], POSITION, atol=0.002)


def test_large_coordinates_keep_their_millimetres(case: Case, tmp_path: Path) -> None:
    np.savetxt(tmp_path / "a.xyz", in_world(case) + UTM, fmt="%.4f")
    build(Request([tmp_path / "a.xyz"], "half", "riegl_vz400i"), tmp_path / "out")
    stated = yaml.safe_load((tmp_path / "out" / "measurement.yaml").read_text())
    np.testing.assert_allclose(stated["scanner"]["position_m"], POSITION + UTM, atol=0.01)


@pytest.mark.usefixtures("drawn")
def test_half_of_a_scan_is_compared_with_the_other(case: Case, tmp_path: Path) -> None:
    """Every second line becomes the surface; the measurement itself says what this comparison cannot show."""
    found = build(Request([as_e57(case, tmp_path)], "half", "riegl_vz400i"), tmp_path / "out")
    measurement = read_measurement(tmp_path / "out")
    assert len(measurement.cloud.points) == pytest.approx(len(case[1].points) / 2, rel=0.02)
    assert (tmp_path / "out" / "understood.png").stat().st_size > 10_000
    lines = np.unique(measurement.cloud.extra["line"])
    assert set(lines % 2) == {1}
    assert "every second line" in found.about["reference"][0]
    assert "errors that vary slowly" in measurement.notes[0]
    assert isinstance(measurement, TlsMeasurement)
    assert measurement.pattern is None
    assert measurement.model.noise.range_sigma_m == 0.003, "of the instrument alone"
    assert measurement.reference_error_m > 0.003


def test_another_epoch_is_meshed_as_the_scanner_sees_it(case: Case, tmp_path: Path) -> None:
    path = as_laz(case, tmp_path)
    np.savetxt(tmp_path / "before.xyz", in_world(case), fmt="%.6f")
    np.savetxt(tmp_path / "later.xyz", in_world(case), fmt="%.6f")
    found = build(Request([path, tmp_path / "later.xyz"], str(tmp_path / "before.xyz"), "riegl_vz400i"), tmp_path / "out")
    measurement = read_measurement(tmp_path / "out")
    assert set(measurement.epochs) == {0, 1}
    assert "errors that both share" in found.about["cannot show"][0]
    assert abs(measurement.fit.off_m) < 0.001


def test_the_noise_of_a_surface_is_that_of_its_points() -> None:
    """A plane at 30 m with 4 mm of range noise: roughness 4 mm, no triangle lost, all facing the scanner."""
    rng = np.random.default_rng(4)
    azimuth, zenith = (grid.ravel() for grid in np.meshgrid(np.arange(-0.3, 0.3, 0.01), np.arange(1.3, 1.8, 0.01)))
    ray = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=1)
    points = ray * (30 / ray[:, :1] + 0.004 * rng.standard_normal((len(ray), 1)))
    seen = triangulate_seen_points(points, np.zeros(3), np.eye(3), "a")
    assert seen.roughness_m == pytest.approx(0.004, rel=0.1)
    assert len(seen.mesh.faces) == pytest.approx(2 * 59 * 49, rel=0.02)
    assert np.all(seen.mesh.face_normals()[:, 0] < 0)


def test_a_step_of_depth_cuts_the_surface() -> None:
    azimuth, zenith = (grid.ravel() for grid in np.meshgrid(np.arange(-0.3, 0.3, 0.01), np.arange(1.3, 1.8, 0.01)))
    ray = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=1)
    points = ray * np.where(azimuth < 0, 20.0, 30.0)[:, None]
    mesh = triangulate_seen_points(points, np.zeros(3), np.eye(3), "a").mesh
    ranges = np.linalg.norm(mesh.vertices[mesh.faces], axis=2)
    assert np.ptp(ranges, axis=1).max() < 0.1


def test_a_rotation_of_few_digits_is_made_orthonormal() -> None:
    turn = np.array([[0.3365, -0.9417, 0.0028], [0.9417, 0.3364, -0.0086], [0.0071, 0.0056, 1.0]])
    mended, words = orthonormal(turn, "a")
    np.testing.assert_allclose(mended @ mended.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(mended, turn, atol=1e-3)
    assert "deviated from orthonormal" in words[0]
    assert orthonormal(np.eye(3), "a")[1] == ()
    for wrong in (np.diag([1.0, 1.0, -1.0]), 2 * np.eye(3), np.full((3, 3), np.nan)):
        with pytest.raises(InputError, match="not a rotation matrix"):
            orthonormal(wrong, "a")


def rewritten(case: Case, folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """Copy the measurement of gap_cases with changed keys."""
    values = yaml.safe_load((case[0] / "measurement.yaml").read_text())
    values |= {key: str(case[0] / values[key]) for key in ("reference", "points", "model")}
    change(values)
    (folder / "measurement.yaml").write_text(yaml.safe_dump(values))
    return folder


def test_a_pattern_may_be_in_degrees_and_run_the_other_way(case: Case, tmp_path: Path) -> None:
    stated = read_measurement(case[0]).pattern
    assert stated is not None

    def change(values: dict[str, Any]) -> None:
        start, stop, step = np.degrees(values["pattern"].pop("azimuth_rad")).tolist()
        last = start + step * float(np.floor((stop - start) / step))
        low, high, zenith_step = values["pattern"]["zenith_rad"]
        values["pattern"] = {"azimuth_deg": [last, start - 1e-9, -step], "zenith_rad": [high, low - 1e-9, -zenith_step]}

    found = read_measurement(rewritten(case, tmp_path, change)).pattern
    assert found is not None
    np.testing.assert_allclose(found.azimuth_rad[::2], stated.azimuth_rad[::2], atol=1e-8)
    np.testing.assert_allclose(found.zenith_rad[::2], stated.zenith_rad[::2], atol=1e-8)


def test_degrees_stand_beside_no_radians(case: Case, tmp_path: Path) -> None:
    folder = rewritten(case, tmp_path, lambda values: values["pattern"].update(zenith_deg=[40, 90, 0.7]))
    with pytest.raises(InputError, match="'zenith_deg' and 'zenith_rad' are both given"):
        read_measurement(folder)


def test_a_pose_of_few_digits_is_taken_with_a_word(case: Case, tmp_path: Path) -> None:
    def change(values: dict[str, Any]) -> None:
        values["scanner"]["rotation"] = np.round(values["scanner"]["rotation"], 4).tolist()

    found = read_measurement(rewritten(case, tmp_path, change))
    assert any("few digits" in note for note in found.notes)
    assert isinstance(found, TlsMeasurement)
    np.testing.assert_allclose(found.station[1] @ found.station[1].T, np.eye(3), atol=1e-12)
    assert not any("few digits" in note for note in read_measurement(case[0]).notes)


def nadir_pair() -> CameraPair:
    """Return two cameras 40 m above the ground, 6 m apart, looking down."""
    lens = {
        "width": 1200,
        "height": 900,
        "f_px": 1500.0,
        **dict.fromkeys(("cx_px", "cy_px", "b1", "b2", "k2", "k3", "k4", "p1", "p2"), 0.0),
    }
    down = np.diag([1.0, -1.0, -1.0])
    return CameraPair(*(Camera(**lens, k1=-0.05, position=UTM + np.array([x, 0.0, 40.0]), rotation=down) for x in (0.0, 6.0)))


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.05 * x + 0.8 * np.sin(x / 3) * np.cos(y / 4)


def write_dem(path: Path) -> None:
    """Write heights every 0.25 m, with a corner without data."""
    grid = Grid(float(UTM[0]) - 20, float(UTM[1]) + 20, 0.25, 180, 160)
    x, y = np.meshgrid(-20 + 0.25 * (np.arange(180) + 0.5), 20 - 0.25 * (np.arange(160) + 0.5))
    heights = UTM[2] + ground(x, y)
    heights[:20, :20] = np.nan
    write_geotiff(path, heights, grid)


@pytest.mark.parametrize("kind", ["cameras.yaml", "cameras.xml", "model"])
def test_a_cloud_from_photographs_with_a_dem(kind: str, tmp_path: Path) -> None:
    """Cameras come in the three forms that users have; every point lies on the surface to a pixel's chord error, s^2 / 8 c."""
    cameras = nadir_pair()
    by_label = {"left.jpg": cameras.left, "right.jpg": cameras.right}
    if kind == "cameras.yaml":
        write_cameras_yaml(tmp_path / kind, cameras)
    elif kind == "cameras.xml":
        write_metashape(tmp_path / kind, by_label)
    else:
        write_colmap(tmp_path / kind, by_label)
    x, y = np.random.default_rng(1).uniform([-8, -8], [12, 8], size=(4000, 2)).T
    np.savetxt(tmp_path / "cloud.xyz", np.stack([x, y, ground(x, y)], axis=1) + UTM, fmt="%.4f")
    write_dem(tmp_path / "dem.tif")
    words = [
        "measurement",
        str(tmp_path / "cloud.xyz"),
        "--cameras",
        str(tmp_path / kind),
        "--reference",
        str(tmp_path / "dem.tif"),
    ]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    measurement = read_measurement(tmp_path / "out")
    assert isinstance(measurement, StereoMeasurement)
    np.testing.assert_allclose(measurement.cameras.right.position, cameras.right.position, atol=1e-6)
    assert measurement.fit.near == 1.0
    assert abs(measurement.fit.off_m) < 0.003
    residuals = stereo_residuals(measurement)
    depth, base = 40.0, 6.0
    assert np.median(np.abs(residuals.value)) < 1500 * base / depth**2 * 0.003
    assert any("one height at each place" in note for note in measurement.notes)


PHOTOGRAPHS: dict[str, tuple[list[str], str]] = {
    "half": (["--reference", "half"], "neighbouring points of a photogrammetric cloud share their errors"),
    "behind": (["--reference", "dem.tif"], "lie behind a camera"),
    "elsewhere": (["--reference", "dem.tif"], "both cameras see"),
    "no cameras": (["--reference", "dem.tif", "--cameras", "no.xml"], "there is no such file"),
    "one label": (["--reference", "dem.tif", "--pair", "a"], "the labels of two cameras"),
}


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_bad_photographs_are_answered_by_one_line(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    write_cameras_yaml(tmp_path / "cameras.yaml", nadir_pair())
    write_dem(tmp_path / "dem.tif")
    x, y = np.random.default_rng(1).uniform([-8, -8], [12, 8], size=(400, 2)).T
    points = (
        np.stack([x, y, ground(x, y)], axis=1) + UTM + {"behind": [0, 0, 90.0], "elsewhere": [300.0, 0, 0]}.get(name, [0, 0, 0])
    )
    np.savetxt(tmp_path / "cloud.xyz", points, fmt="%.4f")
    words, problem = PHOTOGRAPHS[name]
    assert problem in said(["measurement", "cloud.xyz", "--cameras", "cameras.yaml", *words, "--out", "out"], capfd)


def said(words: list[str], capfd: pytest.CaptureFixture[str]) -> str:
    """Return the one line of a command's error."""
    assert main(words) == 2
    told = capfd.readouterr()
    assert (told.out, told.err.count("\n")) == ("", 1)
    assert len(told.err) < 700
    return told.err


def move(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Case, Path], list[str]]:
    def write(case: Case, folder: Path) -> list[str]:
        np.savetxt(folder / "a.xyz", change(in_world(case)), fmt="%.6f")
        return [str(folder / "a.xyz"), "--reference", str(case[0] / "wall.ply"), "--scanner", "riegl_vz400i"]

    return write


def asked(*more: str, reference: str = "wall.ply", scanner: str = "riegl_vz400i") -> Callable[[Case, Path], list[str]]:
    def write(case: Case, folder: Path) -> list[str]:
        path = as_text("a.xyz")(case, folder)
        return [str(path), "--reference", str(case[0] / reference), "--scanner", scanner, *more]

    return write


BAD: dict[str, tuple[Callable[[Case, Path], list[str]], str]] = {
    "no reference": (lambda case, folder: [str(as_laz(case, folder)), "--scanner", "x"], "a mesh, a cloud or another epoch"),
    "no such reference": (asked(reference="no.ply"), "no.ply: there is no such file"),
    "no such scanner": (asked(scanner="riegl_vz400j"), "riegl_vz400i"),
    "millimetres": (move(lambda points: 1000 * points), "add --unit mm"),
    "few in millimetres": (move(lambda points: 1000 * points[::20]), "add --unit mm"),
    "one point": (move(lambda points: points[:1]), "has only 1 points"),
    "identical points": (move(lambda points: np.repeat(points[:1], 500, axis=0)), "at the same place"),
    "NaN": (move(lambda points: points * np.nan), "no point with finite values"),
    "no order": (move(lambda points: np.random.default_rng(1).permutation(points)), "give --position X,Y,Z"),
    "another place": (move(lambda points: points + UTM), "export points and reference in one coordinate system"),
    "behind the scanner": (move(lambda points: 2 * POSITION - points), "export both|in directions in which"),
    "position of two numbers": (asked("--position", "1,2"), "3 numbers separated by commas"),
    "no such unit": (asked("--unit", "inch"), "allowed: m, cm, mm, ft, us-ft"),
    "columns": (asked("--columns", "x,y"), "has 4 columns, but --columns names x, y"),
    "second scan of one": (asked("--scan", "2"), "allowed: 1 to 1"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_answered_by_one_line(name: str, case: Case, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write, words = BAD[name]
    told = said(["measurement", *write(case, tmp_path), "--out", str(tmp_path / "out")], capfd)
    assert any(word in told for word in words.split("|")), told
    assert not (tmp_path / "out").exists()


def test_a_unit_that_is_said_is_converted(case: Case, tmp_path: Path) -> None:
    np.savetxt(tmp_path / "a.xyz", 1000 * in_world(case), fmt="%.3f")
    build(Request([tmp_path / "a.xyz"], str(case[0] / "wall.ply"), "riegl_vz400i", unit="mm"), tmp_path / "out")
    stated = yaml.safe_load((tmp_path / "out" / "measurement.yaml").read_text())
    np.testing.assert_allclose(stated["scanner"]["position_m"], POSITION, atol=1e-3)


def test_a_raw_scan_alone_is_no_measurement(case: Case, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    told = said(["gap", str(as_laz(case, tmp_path)), "--out", str(tmp_path / "out")], capfd)
    assert "add --reference" in told


@pytest.mark.slow
def test_gap_takes_raw_scans(case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The measurement folder is made below the folder of results, which holds the verdict."""
    wall, out = str(case[0] / "wall.ply"), tmp_path / "out"
    words = ["gap", str(as_laz(case, tmp_path)), "--reference", wall, "--scanner", "riegl_vz400i", "--out", str(out), "--quiet"]
    assert main(words) == 0
    assert json.loads((out / "gap.json").read_text())["verdict"] in capsys.readouterr().out
    assert (out / "measurement" / "measurement.yaml").is_file()


@pytest.mark.skipif(not FOREST.exists(), reason=f"the real scan is not there: {FOREST}")
def test_a_real_scan_in_its_own_frame(tmp_path: Path) -> None:
    """A seventh of a RIEGL VZ-400i scan in a forest: scanner at the origin, steps as documented, second echoes left out."""
    data: Any = np.load(FOREST)
    points = np.stack([data[axis] for axis in "XYZ"], axis=1)
    rows = points[:, 1] > 2 * np.abs(points[:, 0] + 0.5)
    echo = {
        "return_number": data["Target_index"][rows].astype(np.uint8),
        "number_of_returns": data["Target_count"][rows].astype(np.uint8),
    }
    write_laz(tmp_path / "forest.laz", PointCloud(points[rows]), PulseChannels(**echo))
    found = build(Request([tmp_path / "forest.laz"], "half", "riegl_vz400i"), tmp_path / "out")
    stated = yaml.safe_load((tmp_path / "out" / "measurement.yaml").read_text())
    assert stated["scanner"]["position_m"] == [0.0, 0.0, 0.0]
    assert "0.62" in found.about["scanner"][1]
    assert "every second pulse" in found.about["reference"][0]
    assert "several echoes" in found.about["scan"][1]


@pytest.mark.skipif(not ROCKS.exists(), reason=f"the real scan is not there: {ROCKS}")
def test_a_real_scan_of_rounded_coordinates(tmp_path: Path) -> None:
    """A scan with rounded coordinates and an unknown scanner position can be measured.

    The coordinates have steps of 6 cm east and 1.6 cm north. The command asks for the position, and then treats the rounding as
    an error.
    """
    with pytest.raises(InputError, match="in front of the points"):
        build(Request([ROCKS], "half", "riegl_vz400i"), tmp_path / "out")
    found = build(Request([ROCKS], "half", "riegl_vz400i", position=(547450.0, 149565.0, 725.0)), tmp_path / "out")
    assert "from rounded coordinates" in found.about["model"][1]
    assert read_measurement(tmp_path / "out").fit.near > 0.9
    assert len(read_ply(tmp_path / "out" / "reference.ply").faces) > 10_000
