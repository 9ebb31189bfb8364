"""Metashape's poses in a chunk with a projected coordinate system, against closed forms on the ellipsoid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from pipeline.formats.cameras.metashape import read_metashape, write_metashape
from scene.common.errors import InputError
from sensors.cameras.camera import Camera

A, F = 6_378_137.0, 1 / 298.257223563  # WGS 84
E2 = F * (2 - F)
UTM = """PROJCS["WGS 84 / UTM zone 32N",GEOGCS["WGS 84",DATUM["World Geodetic System 1984",
SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328]],
PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],
PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],PARAMETER["false_northing",0],
UNIT["metre",1]]"""
WGS84 = UTM[UTM.index("GEOGCS") : UTM.index(",\nPROJECTION")]
FEET = UTM.replace('UNIT["metre",1]', 'UNIT["US survey foot",0.3048006096012192]')
GEOID = f'COMPD_CS["UTM 32N + EGM96",{UTM},VERT_CS["EGM96 height",VERT_DATUM["EGM96 geoid",2005],UNIT["metre",1]]]'
LATITUDE, HEIGHT = np.radians(46.0), 812.5
CAMERA = Rotation.from_euler("xyz", [-80.0, 5.0, 20.0], degrees=True).as_matrix()
"""Camera to east, north, up."""


def local_axes(longitude: float) -> np.ndarray:
    """(3, 3) geocentric directions of east, north and up, as columns."""
    sin, cos, s, c = np.sin(longitude), np.cos(longitude), np.sin(LATITUDE), np.cos(LATITUDE)
    return np.array([[-sin, cos, 0], [-s * cos, -s * sin, c], [c * cos, c * sin, s]]).T


def geocentric(longitude: float) -> np.ndarray:
    normal = A / np.sqrt(1 - E2 * np.sin(LATITUDE) ** 2)
    up = local_axes(longitude)[:, 2]
    return (normal + HEIGHT) * up - np.array([0.0, 0.0, E2 * normal * np.sin(LATITUDE)])


def written(path: Path, longitude: float, reference: str) -> Path:
    """A camera XML as Metashape has it: a chunk of its own scale and axes, and the transform to geocentric axes."""
    pose = local_axes(longitude) @ CAMERA
    camera = Camera(400, 300, 500.0, position=geocentric(longitude), rotation=pose, **dict.fromkeys(ZERO, 0.0))
    write_metashape(path, {"one": camera})
    scale, turn = 7.25, Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
    origin = geocentric(longitude) + np.array([30.0, -20.0, 15.0])
    in_chunk = np.eye(4)
    in_chunk[:3, :3], in_chunk[:3, 3] = turn.T @ pose, turn.T @ (camera.position - origin) / scale
    text = path.read_text()
    identity = "<rotation>1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0</rotation>"
    assert identity in text
    text = text.replace(identity, f"<rotation>{row(turn)}</rotation>").replace("<scale>1.0", f"<scale>{scale}")
    text = text.replace("<translation>0.0 0.0 0.0", f"<translation>{row(origin)}")
    start = text.index("<transform>", text.index("<cameras")) + len("<transform>")
    text = text[:start] + row(in_chunk) + text[text.index("</transform>", start) :]
    tag = f"<reference>{reference.replace(chr(10), '')}</reference>" if reference else ""
    path.write_text(text.replace("</chunk>", f"{tag}</chunk>"))
    return path


ZERO = ("cx_px", "cy_px", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")


def row(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values.ravel())


def test_on_the_central_meridian_the_northing_is_the_scaled_arc_and_north_is_north(tmp_path: Path) -> None:
    """Transverse Mercator: E = 500 km, N = 0.9996 times the arc of the meridian, no convergence (Snyder 1987, eq. 3-21)."""
    arc = quad(lambda latitude: A * (1 - E2) / (1 - E2 * np.sin(latitude) ** 2) ** 1.5, 0, LATITUDE, epsabs=1e-6, epsrel=1e-13)[0]
    found = read_metashape(written(tmp_path / "cameras.xml", np.radians(9.0), UTM)).cameras["one"]
    np.testing.assert_allclose(found.position, [500_000.0, 0.9996 * arc, HEIGHT], atol=1e-5)
    np.testing.assert_allclose(found.rotation, CAMERA, atol=1e-7)


def test_beside_it_attitudes_turn_by_the_convergence_of_the_meridians(tmp_path: Path) -> None:
    """Attitudes are rotated by the meridian convergence gamma.

    On the sphere tan gamma = tan(difference of longitude) sin(latitude); the ellipsoid's is the same to 1e-5 at 1 degree.
    """
    found = read_metashape(written(tmp_path / "cameras.xml", np.radians(10.0), UTM)).cameras["one"]
    gamma = np.arctan(np.tan(np.radians(1.0)) * np.sin(LATITUDE))
    turn = Rotation.from_euler("z", gamma).as_matrix()  # true north lies west of the grid's north, east of the meridian
    assert found.position[0] > 570_000
    np.testing.assert_allclose(np.abs(Rotation.from_matrix(found.rotation @ CAMERA.T).magnitude()), gamma, atol=1e-5)
    np.testing.assert_allclose(found.rotation, turn @ CAMERA, atol=2e-5)
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("reference", ["", 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]'])
def test_poses_in_a_local_system_stay(tmp_path: Path, reference: str) -> None:
    found = read_metashape(written(tmp_path / "cameras.xml", np.radians(9.0), reference)).cameras["one"]
    np.testing.assert_allclose(found.position, geocentric(np.radians(9.0)), atol=1e-6)


@pytest.mark.parametrize(
    ("reference", "words"),
    [
        (WGS84, r"its coordinate system 'WGS 84' is not projected; allowed: a projected coordinate system"),
        (FEET, "whose unit is US survey foot"),
        (GEOID, "heights above a geoid"),
        ("PROJCS[nonsense", "names an unknown coordinate system"),
    ],
)
def test_what_cannot_be_converted_is_named_in_one_line(tmp_path: Path, reference: str, words: str) -> None:
    path = written(tmp_path / "cameras.xml", np.radians(9.0), reference)
    with pytest.raises(InputError, match=words) as caught:
        read_metashape(path)
    assert str(caught.value).startswith(str(path))
    assert "convert the chunk's reference" in str(caught.value)
    assert "\n" not in str(caught.value)
