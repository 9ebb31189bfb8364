"""The report's key values of the sensor, on a plane whose distances are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from pipeline.config.simulation import SensorName, SimulationConfig
from pipeline.run.instrument import instrument_figures
from pipeline.run.site import prepare_site
from scene.common.config import parse
from scene.common.keyed_random import KeyedRandom

OFFSET = np.array([1000.0, 2000.0, 100.0])


@pytest.fixture
def plane(tmp_path: Path) -> Path:
    """A vertical plane of 4 m x 4 m in survey coordinates, 21 x 21 vertices, its outside towards smaller y."""
    x, z = np.meshgrid(np.linspace(-2, 2, 21), np.linspace(-2, 2, 21))
    vertices = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1) + OFFSET
    index = np.arange(x.size).reshape(x.shape)
    corners = (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
    a, b, c, d = (corner.ravel() for corner in corners)
    path = tmp_path / "plane.ply"
    trimesh.Trimesh(vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])).export(path)
    return path


def figures(plane: Path, kind: SensorName, **values: Any) -> dict[str, str]:
    config = parse(SimulationConfig, {"wall": {"mesh": str(plane)}, **values}, "test")
    return instrument_figures(prepare_site(config, kind, KeyedRandom(1)))


def distances(eye: np.ndarray) -> tuple[float, float, float]:
    """Return the least, median and largest distance of the plane's vertices from a point relative to its middle, m."""
    x, z = np.meshgrid(np.linspace(-2, 2, 21), np.linspace(-2, 2, 21))
    found = np.sqrt((x - eye[0]) ** 2 + eye[1] ** 2 + (z - eye[2]) ** 2)
    return found.min(), float(np.median(found)), found.max()


def test_a_scanner_is_named_placed_and_described(plane: Path) -> None:
    eye = np.array([1.0, -20.0, -1.0])
    scanner = {"preset": "riegl_vz400i", "azimuth_step_rad": 0.002, "zenith_step_rad": 0.001}
    found = figures(plane, "tls", scanner=scanner, station={"position_m": list(OFFSET + eye)})
    least, median, largest = distances(eye)
    assert found["Sensor"] == "terrestrial laser scanner, RIEGL VZ-400i; 1200 kHz"
    assert found["Noise"] == "range 3 mm, angles 10.3″ (1 \N{GREEK SMALL LETTER SIGMA})"  # 5e-5 rad
    assert found["Effects"] == "beam_divergence (divergence_rad 0.00035)"
    assert found["Position (station)"] == "1001.00, 1980.00, 99.00 m (x, y, z, world)"
    assert found["Distance to the wall (station)"] == f"{median:.1f} m (median; {least:.1f} m to {largest:.1f} m)"
    assert found["Angular step"] == f"2 x 1 mrad, azimuth x zenith; {2 * median:.3g} x {median:.3g} mm at the median distance"


def test_every_station_and_a_scanner_of_no_preset(plane: Path) -> None:
    places = [[0.0, -10.0, 0.0], [3.0, -15.0, 1.0]]
    noise = {"range_sigma_m": 0.002, "range_ppm": 20, "angle_sigma_rad": 1e-5}
    model = {"sensor": "tls", "noise": noise, "effects": [{"name": "range_offset", "offset_m": 0.0}]}
    stations = [{"position_m": list(OFFSET + place)} for place in places]
    found = figures(plane, "tls", station=stations, sensor=model)
    assert "of no preset" in found["Sensor"]
    assert found["Noise"] == "range 2 mm and 20 ppm of it, angles 2.06″ (1 \N{GREEK SMALL LETTER SIGMA})"
    assert found["Effects"] == "none beyond the noise", "an effect at its null value is none"
    for number, place in enumerate(places, start=1):
        assert found[f"Distance to the wall (station, number {number})"].startswith(f"{distances(np.array(place))[1]:.1f} m")


def test_a_pair_is_described_by_frame_base_and_pixel(plane: Path) -> None:
    noise = {"parallax_sigma_px": 0.4, "regularization_sigma_px": 0.1, "regularization_step_px": 32}
    cameras = {"distance_m": 20.0, "base_m": 6.0, "width": 1000, "height": 800, "sensor_width_m": 0.02, "focal_length_m": 0.04}
    model = {"sensor": "stereo", "noise": noise}
    found = figures(plane, "stereo", cameras=cameras, sensor=model, depth_map="low")
    median = distances(np.array([-3.0, -20.0, 0.0]))[1]
    assert found["Sensor"] == "stereo pair, 1000 x 800 px, principal distance 2,000 px, base 6.00 m"
    assert found["Noise"] == "0.4 px (parallax) and 0.1 px every 32 px (regularization) (1 \N{GREEK SMALL LETTER SIGMA})"
    assert found["Position (cameras, left)"] == "997.00, 1980.00, 100.00 m (x, y, z, world)"
    pixel_mm = median / 2000 * 1e3
    assert found["Pixel on the wall"] == f"{pixel_mm:.3g} mm at the median distance; depth map {8 * pixel_mm:.3g} mm"
    assert "rendered and matched" in figures(plane, "stereo", cameras=cameras, sensor=model, matcher="sgbm")["Noise"]
