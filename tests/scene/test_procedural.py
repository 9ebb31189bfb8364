"""Procedural walls: size, slope, the same rock at every resolution, determinism, albedo, manifoldness."""

from functools import cache
from typing import get_args

import cv2
import numpy as np
import pytest

from scene.common.config import Config, parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.meshes.cleaning import clean, triangle_areas
from scene.walls.imported import ImportedWall
from scene.walls.procedural import SITES, ProceduralWall
from scene.walls.rock import SplineNoise, Table
from scene.walls.wall import WallConfig, build_wall

STYLES = get_args(ProceduralWall.model_fields["style"].annotation)
SENSORS = np.array([35.0, -100.0, 10.0])


class Run(Config):
    wall: WallConfig = ProceduralWall()


def wall_grid(style, resolution_m, width_m=12.0, height_m=8.0, seed=1):
    """Return vertices (rows, columns, 3) and albedo (rows, columns)."""
    config = ProceduralWall(style=style, width_m=width_m, height_m=height_m, resolution_m=resolution_m)
    mesh = config.mesh(KeyedRandom(seed))
    columns = round(width_m / resolution_m) + 1
    return mesh.vertices.reshape(-1, columns, 3), mesh.vertex_albedo.reshape(-1, columns)


def normal_relief(mesh):
    """Return heights over the mean plane, m, and the plane's slope, rad."""
    frame = WallFrame.fit(mesh.vertices, SENSORS)
    return frame.to_wall(mesh.vertices), np.arccos(frame.rotation[2, 2])


@cache
def site_wall(style):
    """Return a wall in the size of its site, which tests only read."""
    return ProceduralWall(style=style, resolution_m=0.1).mesh(KeyedRandom(2))


def test_every_style_of_the_config_has_a_site():
    assert set(STYLES) == set(SITES)


@pytest.mark.parametrize("style", STYLES)
def test_size_slope_and_relief_are_the_sites(style):
    config = ProceduralWall(style=style, resolution_m=0.1)
    points, slope = normal_relief(site_wall(style))
    extent = points.max(axis=0) - points.min(axis=0)
    # 0.3 degrees: the relief's plane is taken off on a 0.5 m lattice, blocks between its points remain
    assert slope == pytest.approx(SITES[style].slope_rad, abs=np.radians(0.3))
    # the fitted frame may be tilted by that much, which moves the relief of +-5 m by 3 cm
    np.testing.assert_allclose(extent[:2], config.size, atol=0.1)
    assert 0.1 < points[:, 2].std() < 1.5
    assert extent[2] < 12.0


def test_slope_size_and_resolution_can_be_chosen():
    mesh = ProceduralWall(width_m=20.0, height_m=10.0, resolution_m=0.2, slope_rad=1.0).mesh(KeyedRandom(0))
    assert len(mesh.vertices) == 101 * 51
    assert len(mesh.faces) == 2 * 100 * 50
    assert normal_relief(mesh)[1] == pytest.approx(1.0, abs=np.radians(1.0))


@pytest.mark.parametrize("style", STYLES)
def test_the_same_rock_at_every_resolution(style):
    coarse, coarse_albedo = wall_grid(style, 0.1)
    fine, fine_albedo = wall_grid(style, 0.05)
    # float32 evaluation of 12 m coordinates (1e-6 m) on steps of up to 12:1, summed over four layers
    np.testing.assert_allclose(fine[::2, ::2], coarse, atol=1e-4, rtol=0)
    np.testing.assert_allclose(fine_albedo[::2, ::2], coarse_albedo, atol=1e-3, rtol=0)
    assert np.abs(fine[1::2, 1::2] - coarse[:-1, :-1]).max() > 0.01


def test_faces_look_towards_the_sensors():
    mesh = ProceduralWall(width_m=10.0, height_m=10.0, resolution_m=0.1).mesh(KeyedRandom(0))
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    towards_sensors = np.array([0.0, -np.sin(np.radians(70)), np.cos(np.radians(70))])
    assert (np.einsum("ni,i->n", normals, towards_sensors) > 0).all()
    np.testing.assert_allclose(np.sum(triangle_areas(mesh)), np.linalg.norm(normals, axis=1).sum() / 2)


@pytest.mark.parametrize("style", STYLES)
def test_nothing_to_mend_in_a_procedural_wall(style):
    mesh = ProceduralWall(style=style, width_m=10.0, height_m=6.0).mesh(KeyedRandom(4))
    assert clean(mesh, "wall")[1] == ()


@pytest.mark.parametrize("style", STYLES)
def test_albedo_has_bounds_and_texture(style):
    albedo = site_wall(style).vertex_albedo
    assert albedo.dtype == np.float32
    assert albedo.min() >= np.float32(0.05)
    assert albedo.max() <= np.float32(0.9)
    assert 0.3 < albedo.mean() < 0.65
    assert albedo.std() > 0.04


def test_the_coal_of_glendale_is_dark_and_of_its_thickness():
    albedo = site_wall("glendale").vertex_albedo.reshape(451, 701)
    dark = albedo < 0.2
    assert np.median(0.1 * dark.sum(axis=0)) == pytest.approx(2.3, abs=0.3)
    rows = np.nonzero(dark)[0]
    assert np.mean(np.abs(rows - np.median(rows)) < 40) > 0.95  # one seam that bends by metres, not dark spots all over


def test_the_run_seed_or_the_walls_own_decides():
    def heights(run_seed, wall_seed=None):
        config = ProceduralWall(width_m=5.0, height_m=5.0, resolution_m=0.1, seed=wall_seed)
        return build_wall(config, KeyedRandom(run_seed)).mesh.vertices

    np.testing.assert_array_equal(heights(1), heights(1))
    np.testing.assert_array_equal(heights(1, wall_seed=7), heights(2, wall_seed=7))
    assert np.abs(heights(1) - heights(2)).max() > 0.05
    assert np.abs(heights(1, wall_seed=7) - heights(1, wall_seed=8)).max() > 0.05


def test_the_number_of_threads_changes_no_bit():
    config = ProceduralWall(style="bismantova", width_m=20.0, height_m=20.0, resolution_m=0.1)
    threads = cv2.getNumThreads()
    walls = []
    for count in (1, 2):
        cv2.setNumThreads(count)
        walls.append(config.mesh(KeyedRandom(1)))
    cv2.setNumThreads(threads)
    np.testing.assert_array_equal(walls[0].vertices, walls[1].vertices)
    np.testing.assert_array_equal(walls[0].vertex_albedo, walls[1].vertex_albedo)


def test_noise_has_unit_deviation():
    # 200 x 200 lattice: the deviation of a B-spline surface scatters by about 0.5 %; 3 % fails falsely below 1e-6
    noise = SplineNoise.make(KeyedRandom(5), (200.0, 200.0), 1.0)
    axis = np.arange(0.0, 200.0, 0.25)
    assert noise.at(axis, axis).std() == pytest.approx(1.0, abs=0.03)


def test_the_key_mesh_chooses_an_imported_wall():
    assert isinstance(parse(Run, {"wall": {"mesh": "a.ply"}}, "c").wall, ImportedWall)
    assert isinstance(parse(Run, {"wall": {"style": "bulga"}}, "c").wall, ProceduralWall)
    assert isinstance(parse(Run, {"wall": {}}, "c").wall, ProceduralWall)


def test_wrong_keys_are_answered_with_the_right_ones():
    with pytest.raises(InputError, match="did you mean 'style'"):
        parse(Run, {"wall": {"stile": "bulga"}}, "c")
    with pytest.raises(InputError, match=r"greater than or equal to 0\.005"):
        parse(Run, {"wall": {"resolution_m": -1.0}}, "c")
    with pytest.raises(InputError, match="did you mean 'unit'"):
        parse(Run, {"wall": {"mesh": "a.ply", "units": "m"}}, "c")


def test_a_table_is_the_linear_interpolation_between_its_knots_and_constant_beyond() -> None:
    knots, values = np.array([-1.5, 0.25, 2.0]), np.array([0.3, -0.8, 1.1])
    x = np.linspace(-3.0, 4.0, 1001, dtype=np.float32)[None]
    assert Table.through(knots, values).at(x) == pytest.approx(np.interp(x, knots, values), abs=0.01)  # kinks within a sample
