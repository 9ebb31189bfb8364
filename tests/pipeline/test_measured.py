"""Measured epochs converted to difference maps: planes with known offsets, areas with known shapes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from surfaces import heightfield

from pipeline.change.difference import DifferenceConfig
from pipeline.config.calibration import CalibrationConfig
from pipeline.formats.meshes.ply import write_ply, write_ply_points
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.rasters.geotiff import write_geotiff
from pipeline.noise.measured import area_mask, point_differences, read_measured
from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from scene.ray_casting.raycast import RayCaster


def test_differences_are_reference_minus_point_per_pixel() -> None:
    wall = heightfield(4.0, 3.0, 0.1)
    corner = wall.bounds[0]
    grid = Grid(float(corner[0]), float(corner[1]) + 3.0, 0.5, 8, 6)
    vertices = wall.vertices[::7]
    found = point_differences(RayCaster(wall), vertices - [0.0, 0.0, 0.02], grid)
    assert np.nanmax(np.abs(found - 0.02)) < 1e-5  # float32 of the ray's distance
    column, row = np.floor(grid.columns(vertices[:, 0])), np.floor(grid.rows(vertices[:, 1]))
    inside = (column >= 0) & (column < 8) & (row >= 0) & (row < 6)
    assert np.isfinite(found).sum() == len(set(zip(row[inside], column[inside], strict=True)))


def test_areas_are_boxes_and_polygons() -> None:
    grid = Grid(0.0, 10.0, 1.0, 10, 10)
    assert area_mask([(2, 3, 5, 7)], grid).sum() == 12
    triangle = area_mask([((0, 0), (10, 0), (0, 10))], grid)
    assert triangle.sum() in range(45, 56)  # half of the pixels, those on the diagonal either way
    assert triangle[9, 0]
    assert not triangle[0, 9]


@pytest.mark.parametrize("area", [[1, 2, 3], [[0, 0], [1, 1]], "everywhere"])
def test_an_area_that_is_neither_is_named(area: object) -> None:
    with pytest.raises(InputError, match=r"'stable_areas\.0': .*is neither a box .* nor a polygon"):
        parse(CalibrationConfig, {"stable_areas": [area]}, "config")


def test_a_folder_of_maps_and_a_folder_of_points(tmp_path: Path) -> None:
    grid = Grid(0.0, 2.0, 0.1, 30, 20)
    for number in (1, 2):
        write_geotiff(tmp_path / f"maps/difference_{number:03d}.tif", np.full(grid.shape, number / 100), grid)
    found = read_measured(tmp_path / "maps", DifferenceConfig(), None, KeyedRandom(1))
    assert found.maps[:, 3, 3] == pytest.approx([0.01, 0.02])
    assert found.grid == grid
    with pytest.raises(InputError, match="contains no measured epochs"):
        read_measured(tmp_path, DifferenceConfig(), None, KeyedRandom(1))

    folder = tmp_path / "scan"
    wall = heightfield(4.0, 3.0, 0.05)
    folder.mkdir()
    write_ply(folder / "wall.ply", wall)
    for number, shift in enumerate((0.0, 0.01)):
        write_ply_points(folder / f"scan_{number}.ply", PointCloud(wall.vertices - [0.0, 0.0, shift]))
    (folder / "model.yaml").write_text("sensor: tls\nnoise: {range_sigma_m: 0.001, angle_sigma_rad: 0}\n")
    rotation = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    values = {
        "sensor": "tls",
        "reference": "wall.ply",
        "points": ["scan_0.ply", "scan_1.ply"],
        "scanner": {"position_m": [0.0, 0.0, 20.0], "rotation": rotation},
        "stable_areas": [[2, 2, 3, 3]],
        "model": "model.yaml",
    }
    (folder / "measurement.yaml").write_text(yaml.safe_dump(values))
    scanned = read_measured(folder, DifferenceConfig(gsd_m=0.1), None, KeyedRandom(1))
    assert scanned.points == (len(wall.vertices),) * 2
    assert np.nanmedian(scanned.maps, axis=(1, 2)) == pytest.approx([0.0, 0.01], abs=2e-3)
    assert scanned.stable is not None
    assert 60 < scanned.stable.sum() < 150
