"""Rasters and differences of surfaces given in closed form."""

import json
import types

import numpy as np
import pytest

from pipeline.change import difference as module
from pipeline.change.difference import (
    DifferenceConfig,
    block_statistics,
    difference,
    raster_grid,
    statistics,
    surface_raster,
)
from pipeline.change.robust import nmad
from pipeline.surface.mesh import SurfaceConfig, mesh_observation
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh
from sensors.signal_chain.observation import Observation

STEP = 0.1
WIDTH, HEIGHT = 8.0, 6.0


def surface(z, block=None, x_range=(0.0, WIDTH)):
    """The mesh of z(x, y) over samples every 0.1 m; block(x, y) labels them."""
    columns, rows = (round(length / STEP) + 1 for length in (x_range[1] - x_range[0], HEIGHT))
    x, y = np.meshgrid(np.linspace(*x_range, columns), np.linspace(HEIGHT, 0.0, rows))
    points = np.stack([x, y, z(x, y)], axis=-1)
    labels = np.zeros(x.shape, dtype=np.int32) if block is None else block(x, y).astype(np.int32)
    seen = Observation("synthetic", points, 100.0 - points[..., 2], labels, np.array([WIDTH / 2, HEIGHT / 2, 100.0]))
    return mesh_observation(seen, SurfaceConfig(grazing_angle_rad=0))


def centres(grid: Grid):
    """Return x and y (h, w) of the pixels' centres, m."""
    column, row = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    return grid.x_min + (column + 0.5) * grid.gsd, grid.y_max - (row + 0.5) * grid.gsd


def test_difference_of_two_planes_is_the_closed_form():
    reference, epoch = surface(lambda x, y: 0.3 * x - 0.2 * y + 5), surface(lambda x, y: -0.1 * x + 0.4 * y + 3)
    grid = raster_grid(reference.bounds, DifferenceConfig(gsd_m=0.023))
    assert grid.shape == (260, 347)
    x, y = centres(grid)
    values = difference(surface_raster(reference, grid), surface_raster(epoch, grid))
    assert values.dtype == np.float32
    closed = (0.3 * x - 0.2 * y + 5) - (-0.1 * x + 0.4 * y + 3)
    rounding = 3 * np.spacing(np.float32(7.4)) / 2  # two heights and their difference, each rounded once
    normals = 2 * 2e-8  # the caster's float32 normals, over the size of a triangle
    assert np.abs(values - closed).max() <= rounding + normals


def test_missing_rock_is_positive():
    wall = surface(lambda x, y: 0.1 * np.sin(x))
    niche = surface(lambda x, y: 0.1 * np.sin(x) - np.where((np.abs(x - 3) < 1) & (np.abs(y - 2) < 1), 0.5, 0.0))
    grid = raster_grid(wall.bounds, DifferenceConfig(gsd_m=0.05))
    values = difference(surface_raster(wall, grid), surface_raster(niche, grid))
    x, y = centres(grid)
    away = np.maximum(np.abs(x - 3), np.abs(y - 2))
    np.testing.assert_allclose(values[away < 0.9], 0.5, atol=1e-6)
    np.testing.assert_allclose(values[away > 1.0], 0.0, atol=1e-6)
    added = difference(surface_raster(niche, grid), surface_raster(wall, grid))
    np.testing.assert_array_equal(added, -values)


def test_no_data_where_either_surface_is_missing():
    grid = Grid(-1.0, HEIGHT + 1, 0.05, 200, 160)
    reference = surface_raster(surface(lambda x, y: 0 * x), grid)
    epoch = surface_raster(surface(lambda x, y: 0 * x - 1, lambda x, y: 0 * x + 4, x_range=(0.0, 5.0)), grid)
    x, y = centres(grid)
    both = (x > 0) & (x < 5) & (y > 0) & (y < HEIGHT)
    np.testing.assert_array_equal(np.isfinite(difference(reference, epoch)), both)
    np.testing.assert_array_equal(epoch.block == 4, both)
    assert (reference.block == 0).all()


@pytest.mark.parametrize("angle_rad", [0.0, 0.1])
def test_labels_follow_the_epoch_through_a_rigid_shift(angle_rad):
    def numbered(x, y):
        return 100 * np.rint(x / STEP) + np.rint(y / STEP)  # each sample its own label

    mesh = surface(lambda x, y: 0 * x, numbered)
    turn = np.array([[np.cos(angle_rad), -np.sin(angle_rad), 0], [np.sin(angle_rad), np.cos(angle_rad), 0], [0, 0, 1]])
    shift = np.array([0.517, -0.311, 0.05])
    moved = mesh.with_vertices(np.einsum("ij,nj->ni", turn, mesh.vertices) + shift)
    grid = raster_grid(mesh.bounds, DifferenceConfig(gsd_m=0.0314))
    raster = surface_raster(moved, grid)
    there = np.stack([*centres(grid), np.zeros(grid.shape)], axis=-1)
    x, y, _ = np.einsum("ji,hwj->ihw", turn, there - shift)  # back on the unmoved wall, where the nearest sample is known
    fraction = np.stack([x, y]) / STEP % 1
    clear = (np.abs(fraction - 0.5) > 1e-3).all(axis=0)
    clear &= (x > 0) & (x < WIDTH) & (y > 0) & (y < HEIGHT)
    assert clear.mean() > 0.8
    np.testing.assert_array_equal(raster.block[clear], numbered(x, y)[clear])


def test_a_mesh_without_labels_is_wall():
    mesh = surface(lambda x, y: 0 * x + 2)
    bare = TriangleMesh(mesh.vertices, mesh.faces)
    raster = surface_raster(bare, raster_grid(bare.bounds, DifferenceConfig(gsd_m=0.5)))
    assert raster.block.dtype == np.int32
    assert not raster.block.any()
    assert (raster.heights == 2).all()


def test_gsd_finer_than_memory_allows(monkeypatch):
    bounds = np.array([[0.0, 0, 0], [70, 45, 2]])
    monkeypatch.setattr(module.psutil, "virtual_memory", lambda: types.SimpleNamespace(available=64 * 10_000_000))
    with pytest.raises(InputError, match=r"3\.15e\+09 pixels and 202 GB of memory, but only 0\.6 GB are free") as caught:
        raster_grid(bounds, DifferenceConfig(gsd_m=0.001))
    finest = float(caught.value.allowed.split()[0])
    assert finest == pytest.approx(np.sqrt(70 * 45 / 1e7), rel=0.1)
    assert raster_grid(bounds, DifferenceConfig(gsd_m=finest)).width == int(70 / finest)
    with pytest.raises(InputError, match="larger than the surface"):
        raster_grid(bounds, DifferenceConfig(gsd_m=46))
    monkeypatch.setattr(module.psutil, "virtual_memory", lambda: types.SimpleNamespace(available=1e15))
    with pytest.raises(InputError, match="pixels"):  # more than 32 bits can number
        raster_grid(bounds, DifferenceConfig(gsd_m=0.0005))


def test_different_grids_are_refused():
    mesh = surface(lambda x, y: 0 * x)
    rasters = [surface_raster(mesh, raster_grid(mesh.bounds, DifferenceConfig(gsd_m=gsd))) for gsd in (0.5, 0.6)]
    with pytest.raises(InputError, match="the reference's has"):
        difference(*rasters)


def test_statistics_of_known_values():
    found = statistics(np.array([[1.0, 2.0, np.nan], [3.0, 4.0, 15.0]], dtype=np.float32))
    assert (found.count, found.median, found.mean) == (5, 3.0, 5.0)
    assert found.standard_deviation == pytest.approx(np.sqrt(26))
    assert found.rmse == pytest.approx(np.sqrt(51))
    assert found.nmad == pytest.approx(1.4826)
    assert found.summary() == "median 3000.0 mm, StD 5099.0 mm, RMSE 7141.4 mm, NMAD 1482.6 mm (5 pixels)"


def test_nmad_about_a_centre_of_nothing():
    assert nmad(np.array([-1.0, 2.0, 4.0, np.nan]), 0.0) == pytest.approx(2 * 1.4826)
    assert np.isnan(nmad(np.array([np.nan])))


def test_nmad_is_the_deviation_of_normal_errors():
    sigma, count = 0.02, 200_000
    found = statistics(np.random.default_rng(8).normal(0.004, sigma, count).astype(np.float32))
    # 5 standard errors of each (the NMAD's is 1.17 sigma / sqrt(n)): false failure below 1e-6, and the seed is fixed
    assert found.nmad == pytest.approx(sigma, abs=5 * 1.17 * sigma / np.sqrt(count))
    assert found.standard_deviation == pytest.approx(sigma, abs=5 * sigma / np.sqrt(2 * count))
    assert found.mean == pytest.approx(0.004, abs=5 * sigma / np.sqrt(count))


def test_statistics_inside_and_outside_the_blocks():
    values = np.array([[0.5, 0.6, 0.0], [np.nan, 0.1, -0.1]], dtype=np.float32)
    found = block_statistics(values, np.array([[3, 7, 0], [7, 0, 0]], dtype=np.int32))
    assert (found.inside.count, found.outside.count) == (2, 3)
    assert found.inside.mean == pytest.approx(0.55)
    assert found.outside.median == 0.0


def test_statistics_of_nothing_are_null_in_json():
    found = statistics(np.full((2, 2), np.nan, dtype=np.float32))
    assert found.count == 0
    again = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert again == {"count": 0} | dict.fromkeys(["median_m", "mean_m", "standard_deviation_m", "rmse_m", "nmad_m"])
