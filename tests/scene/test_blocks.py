"""Blocks: their shape, and their placement compared with slow, simple loops."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull
from walls import grid_wall, plane_wall, rough_wall

from scene.blocks.block import Blocks, RockfallConfig, place_blocks
from scene.blocks.carve import carve
from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh
from scene.geometry.under_boxes import faces_under_boxes
from scene.ray_casting.raycast import RayCaster
from scene.walls.contour import highest_under

RANDOM = KeyedRandom(5).child("rockfall")


def config(**values: Any) -> RockfallConfig:
    return parse(RockfallConfig, values, where="test")


@pytest.fixture(scope="module")
def wall() -> TriangleMesh:
    return rough_wall(12.0, 8.0, 0.08, seed=3)


def solid(mesh: TriangleMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def test_the_primitives_have_their_size_and_volume() -> None:
    smooth: dict[str, Any] = {"size_m": [0.4, 0.6, 0.5], "rotation_rad": 0, "irregularity": 0, "count": 1}
    cube = place_blocks(config(shape="cube", **smooth), plane_wall(4, 4), RANDOM)
    assert solid(cube.mesh(0)).volume == pytest.approx(0.12, rel=1e-12)
    assert np.ptp(cube.bbox[0], axis=0) == pytest.approx([0.4, 0.6, 0.5])
    sphere = place_blocks(config(shape="sphere", **smooth), plane_wall(4, 4), RANDOM)
    assert len(sphere.faces) == 320
    assert solid(sphere.mesh(0)).volume == pytest.approx(np.pi / 6 * 0.12, rel=0.05)  # inscribed: 3.5 % short
    assert np.ptp(sphere.bbox[0], axis=0) == pytest.approx([0.4, 0.6, 0.5], rel=0.02)


def test_irregular_blocks_are_closed_solids_that_do_not_cut_themselves(wall: TriangleMesh) -> None:
    rough = config(count=30, irregularity={"kind": "gaussian", "mean": 0, "sigma": 0.3}, size_m=[0.3, 0.5, 0.2])
    blocks = place_blocks(rough, wall, RANDOM)
    assert set(blocks.shape) == {"cube", "sphere"}
    for index in range(len(blocks)):
        mesh = solid(blocks.mesh(index))
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        # Star-shaped: the centre sees the outside of no face, so the signed cones from it do not overlap.
        low_high = mesh.triangles_center - centre_of_rays(blocks, index)
        assert np.all(np.einsum("ni,ni->n", mesh.face_normals, low_high) > 0)


def centre_of_rays(blocks: Any, index: int) -> np.ndarray:
    """Return the point that a block's vertices were moved away from; placement shifts it along z only."""
    x, y, _ = blocks.position_m[index]
    mesh = blocks.mesh(index)
    a = mesh.vertices[mesh.faces[:, 0]]
    normal = np.cross(mesh.vertices[mesh.faces[:, 1]] - a, mesh.vertices[mesh.faces[:, 2]] - a)
    heights = np.linspace(*blocks.bbox[index, :, 2], 4001)[:, None]
    worst = (np.einsum("ni,ni->n", normal, a) - normal[:, 0] * x - normal[:, 1] * y - heights * normal[:, 2]).min(axis=1)
    return np.array([x, y, heights[worst.argmax(), 0]])


def test_placement_rules_hold(wall: TriangleMesh) -> None:
    settings = config(count=60, safe_zone_offset_m=0.4, minimum_distance_m=0.15)
    blocks = place_blocks(settings, wall, RANDOM)
    box = blocks.bbox
    low, high = wall.bounds[:, :2]
    assert np.all(box[:, 0, :2] >= low + 0.39)
    assert np.all(box[:, 1, :2] <= high - 0.39)
    for first in range(60):
        for second in range(first):
            apart = np.maximum(box[first, 0, :2] - box[second, 1, :2], box[second, 0, :2] - box[first, 1, :2])
            assert apart.max() >= 0.15
    middle = box[:, :, 2].mean(axis=1)
    assert middle == pytest.approx(blocks.position_m[:, 2])
    assert middle == pytest.approx(highest_under(RayCaster(wall), outlines(blocks)), abs=1e-12)


def outlines(blocks: Blocks) -> list[np.ndarray]:
    return [blocks.mesh(index).vertices[:, :2] for index in range(len(blocks))]


def brute_force_top(wall: TriangleMesh, outline: np.ndarray) -> float:
    """Return the largest z over the convex hull of an outline, clipping every nearby triangle with the hull's half-planes."""
    hull = ConvexHull(outline)
    low, high = outline.min(axis=0), outline.max(axis=0)
    triangles = wall.vertices[wall.faces]
    near = np.all((triangles[:, :, :2].max(axis=1) >= low) & (triangles[:, :, :2].min(axis=1) <= high), axis=1)
    top = -np.inf
    for triangle in triangles[near]:
        points = list(triangle)
        for a, b, c in hull.equations:
            result = []
            for p, q in zip(points, points[1:] + points[:1], strict=True):
                dp, dq = -(a * p[0] + b * p[1] + c), -(a * q[0] + b * q[1] + c)
                if dp >= 0:
                    result.append(p)
                if dp * dq < 0:
                    result.append(p + (q - p) * dp / (dp - dq))
            points = result
        top = max([top, *(point[2] for point in points)])
    return top


@pytest.mark.parametrize("size", [0.08, 0.4, 1.5])
def test_the_relief_is_that_within_the_contour(wall: TriangleMesh, size: float) -> None:
    """Besides vertices the wall is sampled at places, so an edge that crosses the contour may be 8 mm higher."""
    found = outlines(place_blocks(config(count=6, size_m=size), wall, RANDOM))
    tops = highest_under(RayCaster(wall), found)
    exact = np.array([brute_force_top(wall, outline) for outline in found])
    assert np.all(tops <= exact + 1e-9)
    assert np.all(tops >= exact - 8e-3)


def test_a_block_at_the_highest_vertex_lies_there_or_where_there_is_none_at_the_highest_relief(wall: TriangleMesh) -> None:
    """Vertices are 0.08 m apart, so a contour of 0.04 m contains one or none."""
    holding = set()
    for size in (0.04, 0.4):
        blocks = place_blocks(config(count=30, size_m=size, placement="highest_vertex"), wall, RANDOM)
        tops = highest_under(RayCaster(wall), outlines(blocks))
        for outline, height, top in zip(outlines(blocks), blocks.position_m[:, 2], tops, strict=True):
            lines = ConvexHull(outline).equations
            inside = np.all(wall.vertices[:, :2] @ lines[:, :2].T + lines[:, 2] <= 0, axis=1)
            holding.add(bool(inside.any()))
            assert height == pytest.approx(wall.vertices[inside, 2].max() if inside.any() else top, abs=1e-12)
    assert holding == {True, False}


def test_a_block_on_the_mean_surface_lies_at_the_median_height_and_takes_more_rock(wall: TriangleMesh) -> None:
    caster = RayCaster(wall)
    volumes = {}
    for placement in ("relief", "mean_surface"):
        blocks = place_blocks(config(count=30, size_m=0.3, placement=placement), wall, RANDOM, caster)
        volumes[placement] = carve(wall, blocks).removed_volume_m3.sum()
    assert volumes["mean_surface"] > 1.2 * volumes["relief"]
    ramp = place_blocks(
        config(count=8, size_m=0.3, placement="mean_surface", irregularity=0), plane_wall(4, 4, slope=0.3), RANDOM
    )
    assert ramp.position_m[:, 2] == pytest.approx(0.3 * ramp.position_m[:, 0], abs=2e-3)


def clipped(polygon: np.ndarray, low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """Return the part of a polygon inside a box (Sutherland and Hodgman); empty if there is none."""
    points = list(polygon)
    for axis, sign, limit in [(0, 1, low[0]), (1, 1, low[1]), (0, -1, high[0]), (1, -1, high[1])]:
        result = []
        for p, q in zip(points, points[1:] + points[:1], strict=True):
            dp, dq = sign * (p[axis] - limit), sign * (q[axis] - limit)
            if dp >= 0:
                result.append(p)
            if dp * dq < 0:
                result.append(p + (q - p) * dp / (dp - dq))
        points = result
    return points


def test_faces_under_boxes_are_all_found_however_large() -> None:
    random = np.random.default_rng(2)
    corners = random.uniform(0, 10, (400, 1, 3)) + random.normal(size=(400, 3, 3)) * random.lognormal(-1, 1.5, (400, 1, 1))
    mesh = TriangleMesh(corners.reshape(-1, 3), np.arange(1200, dtype=np.int32).reshape(-1, 3))
    low = random.uniform(0, 9.5, (12, 3))
    boxes = np.stack([low, low + random.uniform(0.1, 0.5, (12, 3))], axis=1)
    under = [any(clipped(t[:, :2], *box[:, :2]) for box in boxes) for t in corners]
    assert 20 < sum(under) < 380
    assert set(np.flatnonzero(under)) <= set(faces_under_boxes(mesh, boxes).tolist())


def test_holes_are_outside_the_safe_zone() -> None:
    wall = plane_wall(6, 6, cell_m=0.1)
    centre = wall.vertices[wall.faces].mean(axis=1)[:, :2]
    hole = np.all(np.abs(centre - 3.0) < 0.5, axis=1)
    holed = TriangleMesh(wall.vertices, wall.faces[~hole])
    box = place_blocks(config(count=40, size_m=0.3, safe_zone_offset_m=0.2), holed, RANDOM).bbox[:, :, :2]
    gap = np.maximum(2.5 - box[:, 1], box[:, 0] - 3.5).max(axis=1)
    assert gap.min() > 0.1  # 0.2 in the plane, less what a corner of a box and a cell may take


def steep(slope: float) -> TriangleMesh:
    return plane_wall(4, 4, slope=slope, cell_m=0.02)


def test_blocks_on_a_steep_wall_reach_the_rock() -> None:
    ball = config(count=6, shape="sphere", irregularity=0, size_m=0.5)
    blocks = place_blocks(ball, steep(2.0), RANDOM)
    depth = np.maximum.reduceat(2.0 * blocks.vertices[:, 0] - blocks.vertices[:, 2], blocks.vertex_start[:-1])
    assert np.all(depth > 0.1 * 0.5 * 0.95)
    with pytest.raises(InputError, match="times it would have hung in front of a steep wall"):
        place_blocks(ball.model_copy(update={"maximum_attempts": 100}), steep(4.0), RANDOM)


def test_the_same_seed_gives_the_same_blocks(wall: TriangleMesh) -> None:
    first, second = (place_blocks(config(count=15), wall, KeyedRandom(1)) for _ in range(2))
    other = place_blocks(config(count=15), wall, KeyedRandom(2))
    assert first.vertices.tobytes() == second.vertices.tobytes()
    assert first.shape == second.shape
    assert not np.array_equal(first.position_m, other.position_m)


def test_sizes_follow_their_distribution_whatever_their_room(wall: TriangleMesh) -> None:
    uniform = {"kind": "uniform", "low": 0.1, "high": 0.6}
    sizes = place_blocks(config(count=100, size_m=uniform, minimum_distance_m=0.0), wall, RANDOM).size_m
    assert sizes.mean() == pytest.approx(0.35, abs=4 * 0.5 / np.sqrt(12 * 300))  # false failures: 6e-5


def test_a_coarse_wall_of_two_triangles() -> None:
    x, y = np.meshgrid([0.0, 5.0], [0.0, 5.0])
    blocks = place_blocks(config(count=5), grid_wall(x, y, x * 0), RANDOM)
    assert blocks.position_m[:, 2] == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"count": 500}, "500 blocks take [0-9,]+ m2, but the safe zone of the wall has only [0-9,]+ m2.*lower count"),
        ({"count": 100, "maximum_attempts": 8}, "no room was found for a block of .* blocks have a place.*lower count"),
        ({"size_m": 30.0}, "40 of 40 blocks are larger than the wall.*allowed: below 11.9"),
        ({"safe_zone_offset_m": 5.0}, "leaves no room on a wall"),
        ({"size_m": {"kind": "gaussian", "mean": -0.1, "sigma": 1e-6}}, "a length of -0.1 m was drawn"),
        ({"count": 0}, "count"),
        ({"maximum_attempt": 3}, "did you mean 'maximum_attempts'"),
        ({"size_m": [0.1, 0.2]}, "size_m"),
        ({"size_m": {"kind": "gaussian", "mean": 1}}, "size_m.*sigma"),
        ({"shape": "prism"}, "shape"),
    ],
)
def test_mistakes_are_named(wall: TriangleMesh, values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        place_blocks(config(**values), wall, RANDOM)
    assert "\n" not in str(caught.value)


def test_one_of_several_blocks_keeps_what_is_known_of_it(wall: TriangleMesh) -> None:
    blocks = place_blocks(config(count=4), wall, RANDOM)
    alone = blocks.only(2)
    assert len(alone) == 1
    np.testing.assert_array_equal(alone.mesh(0).vertices, blocks.mesh(2).vertices)
    for name in ("shape", "size_m", "position_m"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(blocks, name)[2:3])
