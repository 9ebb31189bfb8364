"""Surfaces from synthetic observations of planes, a sphere and a step, whose points are known in closed form."""

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.surface.mesh import SurfaceConfig, mesh_cloud, mesh_observation
from scene.common.errors import InputError
from scene.geometry.mesh import TriangleMesh
from sensors.signal_chain.observation import Observation

VIEWPOINT = np.array([1.0, -2.0, 50.0])
SHAPE = (31, 41)


def rays(shape=SHAPE, half_width=0.1):
    """Return directions (h, w, 3) of a camera that looks along -z, rows down, columns to the right."""
    x, y = np.meshgrid(np.linspace(-half_width, half_width, shape[1]), np.linspace(half_width, -half_width, shape[0]))
    return np.stack([x, y, -np.ones(shape)], axis=-1)


def observation(points, block=None, viewpoint=VIEWPOINT):
    depth = np.linalg.norm(points - viewpoint, axis=-1)
    block = np.zeros(depth.shape, dtype=np.int32) if block is None else block
    return Observation("synthetic", points, depth, block, viewpoint)


def plane_points(normal, shape=SHAPE, half_width=0.1, viewpoint=VIEWPOINT):
    """Return points of the plane through the origin with this normal."""
    direction = rays(shape, half_width)
    scale = -np.dot(normal, viewpoint) / (direction @ np.asarray(normal))
    return viewpoint + scale[..., None] * direction


def corners(mesh: TriangleMesh):
    return mesh.vertices[mesh.faces]


def normals(mesh: TriangleMesh):
    """Return face normals (m, 3), as long as twice the area."""
    points = corners(mesh)
    return np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])


def towards_viewpoint(mesh: TriangleMesh):
    return np.einsum("ij,ij->i", normals(mesh), VIEWPOINT - corners(mesh)[:, 0])


def test_plane_is_covered_once():
    points = plane_points([0.3, -0.2, 1.0])
    mesh = mesh_observation(observation(points), SurfaceConfig())
    assert len(mesh.faces) == 2 * (SHAPE[0] - 1) * (SHAPE[1] - 1)
    np.testing.assert_array_equal(mesh.vertices, points.reshape(-1, 3))
    a, b, c, d = points[0, 0], points[0, -1], points[-1, -1], points[-1, 0]
    quadrilateral = np.linalg.norm(np.cross(c - a, d - b)) / 2  # half the cross product of the diagonals
    assert np.linalg.norm(normals(mesh), axis=1).sum() / 2 == pytest.approx(quadrilateral, rel=1e-12)


@pytest.mark.parametrize("flip", ["none", "rows", "columns", "transposed"])
def test_winding_is_counter_clockwise_from_the_viewpoint(flip):
    points = plane_points([0.3, -0.2, 1.0])
    points = {"none": points, "rows": points[::-1], "columns": points[:, ::-1], "transposed": points.swapaxes(0, 1)}[flip]
    mesh = mesh_observation(observation(np.ascontiguousarray(points)), SurfaceConfig())
    assert (towards_viewpoint(mesh) > 0).all()


def test_sphere():
    radius, direction = 10.0, rays((401, 401), 0.17)
    half = np.einsum("ijk,k->ij", direction, VIEWPOINT)
    squared = np.einsum("ijk,ijk->ij", direction, direction)
    root = half**2 - squared * (VIEWPOINT @ VIEWPOINT - radius**2)
    with np.errstate(invalid="ignore"):
        points = VIEWPOINT + ((-half - np.sqrt(root)) / squared)[..., None] * direction
    seen = np.linalg.norm(points[..., :2], axis=-1) < 4.0  # a cap well inside the outline
    points[~seen] = np.nan
    mesh = mesh_observation(observation(points), SurfaceConfig())
    area = np.linalg.norm(normals(mesh), axis=1).sum() / 2
    cap = 2 * np.pi * radius * (radius - np.sqrt(radius**2 - 4.0**2))
    assert area == pytest.approx(cap, rel=0.02)  # the rim of 25 m lacks about half a cell of 0.036 m
    assert (np.einsum("ij,ij->i", normals(mesh), corners(mesh).mean(axis=1)) > 0).all()


def step_points(edge, depth):
    """Return points with z = 0 left of column `edge`, z = -depth from it on."""
    direction = rays()
    z = np.where(np.arange(SHAPE[1]) < edge, 0.0, -depth)
    return VIEWPOINT + (VIEWPOINT[2] - z)[None, :, None] * direction


def test_step_edge_is_cut_exactly_there():
    mesh = mesh_observation(observation(step_points(17, 3.0)), SurfaceConfig())
    assert len(mesh.faces) == 2 * (SHAPE[0] - 1) * (SHAPE[1] - 2)
    z = np.round(corners(mesh)[..., 2], 9)
    assert (z == z[:, :1]).all()
    assert len(mesh.vertices) == SHAPE[0] * SHAPE[1]


@pytest.mark.parametrize("config", [SurfaceConfig(depth_step_m=3.1), SurfaceConfig(grazing_angle_rad=0)])
def test_step_edge_within_the_limits_is_bridged(config):
    mesh = mesh_observation(observation(step_points(17, 3.0)), config)
    assert len(mesh.faces) == 2 * (SHAPE[0] - 1) * (SHAPE[1] - 1)


def test_steep_slope_is_cut_by_its_grazing_angle_only():
    viewpoint = np.array([0.0, 0.0, 1000.0])  # a narrow view: one grazing angle for all edges down the slope
    grazing = 0.2
    points = plane_points([0.0, np.cos(grazing), np.sin(grazing)], half_width=1e-3, viewpoint=viewpoint)
    seen = observation(points, viewpoint=viewpoint)
    assert np.abs(np.diff(seen.depth, axis=0)).min() > 0.3
    mesh = mesh_observation(seen, SurfaceConfig(depth_step_m=0.0, grazing_angle_rad=0.19))
    assert len(mesh.faces) == 2 * (SHAPE[0] - 1) * (SHAPE[1] - 1)
    with pytest.raises(InputError, match="no triangle"):
        mesh_observation(seen, SurfaceConfig(depth_step_m=0.0, grazing_angle_rad=0.21))


def cell(**z):
    """Return one cell with corners a, b above c, d; NaN removes a corner."""
    corner = {"a": (0, 1), "b": (1, 1), "c": (0, 0), "d": (1, 0)}
    return np.array([(*corner[name], z.get(name, 0.0)) for name in "abcd"]).reshape(2, 2, 3)


@pytest.mark.parametrize(("raised", "diagonal"), [("a", {1, 2}), ("b", {0, 3}), ("c", {0, 3}), ("d", {1, 2})])
def test_cell_is_split_along_the_shorter_diagonal(raised, diagonal):
    mesh = mesh_observation(observation(cell(**{raised: 0.2})), SurfaceConfig())  # a raised corner lengthens its own diagonal
    assert set(mesh.faces[0]) & set(mesh.faces[1]) == diagonal


@pytest.mark.parametrize("missing", "abcd")
def test_cell_with_a_missing_corner_is_one_triangle(missing):
    points = cell()
    points.reshape(4, 3)["abcd".index(missing)] = np.nan
    mesh = mesh_observation(observation(points), SurfaceConfig())
    assert mesh.faces.shape == (1, 3)
    np.testing.assert_array_equal(mesh.vertices, points[~np.isnan(points[..., 0])])
    assert (towards_viewpoint(mesh) > 0).all()


@pytest.mark.parametrize("deep", "abcd")
def test_cell_with_one_corner_beyond_a_discontinuity_keeps_the_other_three(deep):
    mesh = mesh_observation(observation(cell(**{deep: -20.0})), SurfaceConfig())
    assert mesh.faces.shape == (1, 3)
    assert (mesh.vertices[:, 2] == 0).all()


def test_labels_travel_and_unused_samples_are_dropped():
    points = plane_points([0.0, 0.0, 1.0])
    block = (np.arange(SHAPE[0] * SHAPE[1], dtype=np.int32) + 7).reshape(SHAPE)
    points[8:13, 8:13] = np.nan
    points[10, 10] = plane_points([0.0, 0.0, 1.0])[10, 10]  # alone in a hole
    mesh = mesh_observation(observation(points, block), SurfaceConfig())
    kept = ~np.isnan(points[..., 0])
    kept[10, 10] = False
    np.testing.assert_array_equal(mesh.vertices, points[kept])
    np.testing.assert_array_equal(mesh.vertex_block, block[kept])
    assert mesh.vertex_block.dtype == mesh.faces.dtype == np.int32
    np.testing.assert_array_equal(np.unique(mesh.faces), np.arange(kept.sum()))


def holed():
    """Return a plane with a hole of 3 x 4 samples, one of 6 x 6, and one at the border."""
    whole = plane_points([0.4, 0.5, 1.0])
    points = whole.copy()
    for window in (np.s_[5:8, 5:9], np.s_[15:21, 20:26], np.s_[0:2, 30:33]):
        points[window] = np.nan
    block = np.ones(SHAPE, dtype=np.int32)
    block[:, 7:] = 2
    block[np.isnan(points[..., 0])] = 0
    return whole, points, block


def test_holes_are_kept():
    _, points, block = holed()
    mesh = mesh_observation(observation(points, block), SurfaceConfig())
    assert len(mesh.vertices) == np.isfinite(points[..., 0]).sum()


def test_small_holes_in_a_plane_are_filled_exactly():
    whole, points, block = holed()
    mesh = mesh_observation(observation(points, block), SurfaceConfig(holes="fill", maximum_hole_px=12))
    assert len(mesh.vertices) == np.isfinite(points[..., 0]).sum() + 12
    np.testing.assert_allclose(mesh.vertices @ [0.4, 0.5, 1.0], 0.0, atol=1e-12)  # on the plane
    numbers = np.isfinite(points[..., 0])
    numbers[5:8, 5:9] = True
    filled = mesh.vertices[(np.cumsum(numbers) - 1).reshape(SHAPE)[5:8, 5:9]]
    assert np.abs(filled - whole[5:8, 5:9]).max() < 0.02  # in the plane the perspective spacing is not quite even (cells: 0.25 m)
    labels = mesh.vertex_block[(np.cumsum(numbers) - 1).reshape(SHAPE)[5:8, 5:9]]
    assert labels[1].tolist() == [1, 1, 2, 2]


def test_noise_below_the_step_does_not_tear():
    noise = np.random.default_rng(3).normal(0, 0.03, SHAPE)
    direction = rays(half_width=0.01)  # spacing 25 mm, as dense as the noise is large
    points = VIEWPOINT + (50 + noise)[..., None] * direction
    mesh = mesh_observation(observation(points), SurfaceConfig())
    assert len(mesh.faces) == 2 * (SHAPE[0] - 1) * (SHAPE[1] - 1)


def cloud():
    """Return 5,000 points of a dome z = 2 - (x2 + y2) / 10 over 8 x 6 m, labelled 3 where x > 0."""
    random = np.random.default_rng(5)
    x, y = random.uniform(-4, 4, 5000), random.uniform(-3, 3, 5000)
    return np.stack([x, y, 2 - (x**2 + y**2) / 10], axis=1), np.where(x > 0, 3, 0).astype(np.int32)


def test_poisson_surface_of_a_dome():
    points, block = cloud()
    mesh = mesh_cloud(points, block, VIEWPOINT, SurfaceConfig(method="poisson"))
    x, y, z = mesh.vertices.T
    assert np.sqrt(np.mean(np.square(z - (2 - (x**2 + y**2) / 10)))) < 0.01  # a tenth of the spacing
    assert np.abs(x).max() < 4.3  # trimmed
    assert np.abs(y).max() < 3.3
    covered = np.abs(normals(mesh)[:, 2]).sum() / 2
    assert covered == pytest.approx(48.0, rel=0.07)
    assert np.mean(towards_viewpoint(mesh) > 0) > 0.999
    assert (mesh.vertex_block[x > 0.3] == 3).all()
    assert (mesh.vertex_block[x < -0.3] == 0).all()


def test_poisson_of_an_observation_is_repeatable():
    points = plane_points([0.1, 0.1, 1.0])
    points[3, 4] = np.nan
    first, second = (mesh_observation(observation(points), SurfaceConfig(method="poisson")) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.faces, second.faces)


def test_errors_name_the_remedy():
    with pytest.raises(InputError, match="no triangle was made between the 0 points of the synthetic observation"):
        mesh_observation(observation(np.full((*SHAPE, 3), np.nan)), SurfaceConfig())
    with pytest.raises(InputError, match="30 points are too few"):
        mesh_cloud(np.zeros((30, 3)), np.zeros(30, dtype=np.int32), VIEWPOINT, SurfaceConfig())
    with pytest.raises(InputError, match="same place"):
        mesh_cloud(np.ones((40, 3)), np.zeros(40, dtype=np.int32), VIEWPOINT, SurfaceConfig())
    with pytest.raises(ValidationError):
        SurfaceConfig(depth_step_m=-1)
