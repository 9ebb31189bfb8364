"""Carving against closed forms and independent calculations: volumes, labels, topology, rims without cracks or slivers."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull, HalfspaceIntersection
from walls import closed, grid_wall, plane_wall, rough_wall

from scene.blocks.block import Blocks, RockfallConfig, place_blocks
from scene.blocks.carve import FRESH_ALBEDO, Carved, block_meshes, block_records, carve
from scene.blocks.slivers import SLIVER_M, MendedSurface, smallest_height
from scene.blocks.solid import boundary
from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh

RANDOM = KeyedRandom(11).child("rockfall")


def blocks_on(wall: TriangleMesh, **values: Any) -> Blocks:
    return place_blocks(parse(RockfallConfig, values, where="test"), wall, RANDOM)


def edge_counts(faces: np.ndarray) -> np.ndarray:
    """Return how many faces each undirected edge has."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


def loops(mesh: TriangleMesh) -> set[tuple[float, ...]]:
    """Return the directed boundary edges by their coordinates."""
    start, end = boundary(mesh.faces)
    return {tuple(edge) for edge in np.hstack([mesh.vertices[start], mesh.vertices[end]]).tolist()}


def rim(mesh: TriangleMesh) -> np.ndarray:
    """Return whether a vertex (n,) is in faces of the wall and of a niche."""
    assert mesh.face_block is not None
    sides = np.zeros((2, len(mesh.vertices)), dtype=bool)
    for side, chosen in enumerate([mesh.face_block == 0, mesh.face_block > 0]):
        sides[side, mesh.faces[chosen].ravel()] = True
    return sides.all(axis=0)


def assert_sound(carved: Carved, wall: TriangleMesh, blocks: Blocks) -> None:
    """Assert everything that holds for every carved wall."""
    mesh = carved.mesh
    assert mesh.face_block is not None
    assert mesh.vertex_block is not None
    assert np.isfinite(mesh.vertices).all()
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
    assert np.array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)))
    assert edge_counts(mesh.faces).max() == 2
    assert loops(mesh) == loops(wall)
    assert np.array_equal(np.unique(mesh.face_block), np.arange(len(blocks) + 1))
    on_rim = rim(mesh)
    assert np.all(mesh.vertex_block[on_rim] == 0)
    inside = ~on_rim[mesh.faces] & (mesh.face_block > 0)[:, None]
    assert np.array_equal(mesh.vertex_block[mesh.faces][inside], np.repeat(mesh.face_block, 3).reshape(-1, 3)[inside])
    assert smallest_height(mesh.vertices[mesh.faces[on_rim[mesh.faces].any(axis=1)]]).min() >= SLIVER_M
    assert np.all(carved.removed_volume_m3 > 0)
    assert abs(carved.balance_m3) <= 1e-9 * carved.wall_volume_m3


SMOOTH: dict[str, Any] = {"rotation_rad": 0, "irregularity": 0, "minimum_distance_m": 0.2}


def test_a_cube_in_a_plane_leaves_half_of_it() -> None:
    wall = plane_wall(5, 4)
    blocks = blocks_on(wall, shape="cube", size_m=[0.4, 0.6, 0.5], count=6, **SMOOTH)
    carved = carve(wall, blocks)
    assert carved.removed_volume_m3 == pytest.approx(0.06, rel=1e-9)
    assert_sound(replace_volume(carved, 5 * 4 * 1.0), wall, blocks)  # a plane has no volume above itself
    mesh = carved.mesh
    niche = mesh.face_block > 0
    areas = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).area_faces
    assert areas[niche].sum() == pytest.approx(6 * (0.24 + 2 * (0.4 + 0.6) * 0.25), rel=1e-4)
    assert areas[~niche].sum() == pytest.approx(20 - 6 * 0.24, rel=1e-4)


def replace_volume(carved: Carved, volume: float) -> Carved:
    return replace(carved, wall_volume_m3=volume)


def test_a_sphere_in_a_slope_leaves_the_part_below_the_plane() -> None:
    slope = 0.7
    wall = plane_wall(6, 4, slope=slope, cell_m=0.07)
    blocks = blocks_on(wall, shape="sphere", size_m=0.8, count=5, **SMOOTH)
    carved = carve(wall, blocks)
    for index, volume in enumerate(carved.removed_volume_m3):
        hull = ConvexHull(blocks.mesh(index).vertices)
        plane = [-slope, 0.0, 1.0, 0.0]  # z - slope x <= 0
        deepest = blocks.mesh(index).vertices[np.argmin(blocks.mesh(index).vertices @ plane[:3])]
        inside = deepest + 1e-3 * (blocks.position_m[index] - deepest)
        part = HalfspaceIntersection(np.vstack([hull.equations, plane]), inside)
        assert volume == pytest.approx(ConvexHull(part.intersections).volume, rel=1e-9)


@pytest.fixture(scope="module")
def rough() -> TriangleMesh:
    return rough_wall(24.0, 16.0, 0.06, seed=4)


@pytest.fixture(scope="module")
def rough_blocks(rough: TriangleMesh) -> Blocks:
    return blocks_on(rough, count=300)


@pytest.fixture(scope="module")
def rough_carved(rough: TriangleMesh, rough_blocks: Blocks) -> Carved:
    return carve(rough, rough_blocks)


def test_three_hundred_blocks_in_a_rough_wall(rough: TriangleMesh, rough_blocks: Blocks, rough_carved: Carved) -> None:
    assert_sound(rough_carved, rough, rough_blocks)
    base = rough.vertices[:, 2].min()
    assert rough_carved.wall_volume_m3 == pytest.approx(prisms(rough, base), rel=1e-12)
    assert prisms(rough, base) - prisms(rough_carved.mesh, base) == pytest.approx(rough_carved.removed_volume_m3.sum(), rel=1e-6)


def prisms(mesh: TriangleMesh, base: float) -> float:
    """Return the volume between the mesh and the plane z = base."""
    triangles = mesh.vertices[mesh.faces]
    area = np.linalg.det(triangles[:, 1:, :2] - triangles[:, :1, :2]) / 2
    return float(np.sum(area * (triangles[:, :, 2].mean(axis=1) - base)))


def test_a_closed_wall_stays_watertight() -> None:
    wall = closed(rough_wall(8.0, 6.0, 0.08, seed=5), thickness_m=2.0)
    blocks = blocks_on(wall, count=25)
    carved = carve(wall, blocks)
    assert_sound(carved, wall, blocks)
    before, after = (trimesh.Trimesh(m.vertices, m.faces, process=False) for m in (wall, carved.mesh))
    assert before.is_watertight
    assert after.is_watertight
    assert after.is_winding_consistent
    assert carved.wall_volume_m3 == pytest.approx(before.volume, rel=1e-12)
    assert abs(before.volume - after.volume - carved.removed_volume_m3.sum()) < 1e-9 * before.volume


def test_blocks_that_cut_through_a_thin_closed_wall() -> None:
    wall = closed(plane_wall(4, 3), thickness_m=0.1)
    blocks = blocks_on(wall, count=5, shape="cube", size_m=0.4, **SMOOTH)
    carved = carve(wall, blocks)
    assert carved.removed_volume_m3 == pytest.approx(0.16 * 0.1, rel=1e-9)
    after = trimesh.Trimesh(carved.mesh.vertices, carved.mesh.faces, process=False)
    assert after.is_watertight
    assert after.euler_number == 2 - 2 * 5


def test_a_wall_with_holes_and_overhangs() -> None:
    flat = rough_wall(10.0, 8.0, 0.07, seed=6)
    x, y, z = flat.vertices.T
    step = 0.5 * np.tanh((x - 5.0) / 0.2)  # a riser that the shear tips over
    centre = flat.vertices[flat.faces].mean(axis=1)[:, :2]
    hole = np.any([np.hypot(*(centre - c).T) < 0.4 for c in ([2.5, 3.0], [8.0, 5.0])], axis=0)
    used, faces = np.unique(flat.faces[~hole], return_inverse=True)
    wall = TriangleMesh(np.stack([x - 0.9 * step, y, z + step], axis=1)[used], faces.reshape(-1, 3).astype(np.int32))
    corners = wall.vertices[wall.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normal[:, 2] < 0).mean() > 0.02
    blocks = blocks_on(wall, count=40, safe_zone_offset_m=0.2, minimum_distance_m=0.05)
    over = np.abs(blocks.position_m[:, 0] - 5.0) < 0.5
    assert over.sum() >= 3
    carved = carve(wall, blocks)
    assert_sound(carved, wall, blocks)


def test_a_block_over_the_border_opens_it() -> None:
    wall = plane_wall(3, 3)
    block = blocks_on(wall, count=1, shape="cube", size_m=0.5, **SMOOTH)
    shift = np.array([-block.position_m[0, 0], 0, 0])
    block = replace(block, vertices=block.vertices + shift, position_m=block.position_m + shift)
    carved = carve(wall, block)
    assert carved.removed_volume_m3 == pytest.approx(0.5 * 0.25 * 0.25, rel=1e-5)  # the closure leans by micrometres
    assert edge_counts(carved.mesh.faces).max() == 2


def test_two_triangles_with_many_niches() -> None:
    x, y = np.meshgrid([0.0, 6.0], [0.0, 6.0])
    wall = grid_wall(x, y, 0 * x)
    blocks = blocks_on(wall, count=30, irregularity={"kind": "gaussian", "mean": 0, "sigma": 0.1})
    assert_sound(replace_volume(carve(wall, blocks), 36.0), wall, blocks)


def test_blocks_aligned_with_the_wall_edges() -> None:
    """Sides of cubes lie along rows of vertices, to micrometres, which makes the most slivers."""
    wall = plane_wall(6, 6, cell_m=0.1)
    blocks = blocks_on(wall, count=12, shape="cube", size_m=0.4, subdivisions=1, **SMOOTH)
    vertices, position = blocks.vertices.copy(), blocks.position_m.copy()
    for index in range(len(blocks)):
        shift = np.round(position[index] * 10) / 10 - position[index] + (index - 6) * np.array([3e-6, 2e-6, 0.0])
        vertices[blocks.vertex_start[index] : blocks.vertex_start[index + 1]] += shift
        position[index] += shift
    moved = replace(blocks, vertices=vertices, position_m=position)
    assert_sound(replace_volume(carve(wall, moved), 36.0), wall, moved)


@pytest.mark.parametrize(("seed", "cell_m", "sigma"), [(4, 0.1, 0.1), (6, 0.05, 0.02)])
def test_slivers_that_resist_the_simplest_collapse(seed: int, cell_m: float, sigma: float) -> None:
    """No sliver is left on two walls on which a simpler repair left one.

    They are two of some dozens of walls; the simpler repair collapsed shortest sides in one direction only.
    """
    wall = rough_wall(14, 10, cell_m, seed=seed)
    irregular = {"count": 100, "irregularity": {"kind": "gaussian", "mean": 0, "sigma": sigma}}
    blocks = place_blocks(parse(RockfallConfig, irregular, where="test"), wall, KeyedRandom(seed))
    assert_sound(carve(wall, blocks), wall, blocks)


def test_the_mending_has_something_to_mend(rough: TriangleMesh, rough_blocks: Blocks, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "scene.blocks.carve.remove_slivers", lambda vertices, faces, tag, rank: MendedSurface(faces, tag, np.zeros(301))
    )
    mesh = carve(rough, rough_blocks).mesh
    at_rim = rim(mesh)[mesh.faces].any(axis=1)
    assert (smallest_height(mesh.vertices[mesh.faces[at_rim]]) < SLIVER_M).sum() > 20


def test_far_from_the_blocks_nothing_changes(rough: TriangleMesh, rough_blocks: Blocks, rough_carved: Carved) -> None:
    mesh = rough_carved.mesh
    kept = {tuple(v) for v in mesh.vertices[mesh.vertex_block == 0].tolist()}
    far = ~np.any(
        [np.all((rough.vertices >= low - 0.01) & (rough.vertices <= high + 0.01), axis=1) for low, high in rough_blocks.bbox],
        axis=0,
    )
    assert far.mean() > 0.5
    assert {tuple(v) for v in rough.vertices[far].tolist()} <= kept


def test_the_albedo_is_carried_over() -> None:
    wall = plane_wall(5, 4)
    shade = (0.1 + 0.1 * wall.vertices[:, 0] + 0.05 * wall.vertices[:, 1]).astype(np.float32)  # linear: interpolation is exact
    blocks = blocks_on(wall, count=8)
    mesh = carve(replace(wall, vertex_albedo=shade), blocks).mesh
    outside = mesh.vertex_block == 0
    expected = 0.1 + 0.1 * mesh.vertices[:, 0] + 0.05 * mesh.vertices[:, 1]
    assert mesh.vertex_albedo[outside] == pytest.approx(expected[outside], abs=2e-5)
    assert np.all(mesh.vertex_albedo[~outside] == np.float32(FRESH_ALBEDO))
    assert carve(wall, blocks).mesh.vertex_albedo is None


def test_the_four_meshes_of_a_block_fit_together(rough: TriangleMesh, rough_blocks: Blocks, rough_carved: Carved) -> None:
    for index in (0, 17):
        meshes = block_meshes(rough, rough_blocks, index)
        removed, rest, block = (
            trimesh.Trimesh(m.vertices, m.faces, process=False)
            for m in (meshes.intersection, meshes.removed_block, rough_blocks.mesh(index))
        )
        assert removed.is_watertight
        assert rest.is_watertight
        assert removed.volume == pytest.approx(rough_carved.removed_volume_m3[index], rel=1e-9)
        assert removed.volume + rest.volume == pytest.approx(block.volume, rel=1e-9)
        skin = removed.area_faces[meshes.intersection.face_block == 0].sum()
        inner = removed.area_faces[meshes.intersection.face_block == index + 1].sum()
        niche = trimesh.Trimesh(meshes.niche.vertices, meshes.niche.faces, process=False)
        assert niche.area == pytest.approx(inner, rel=1e-9)
        assert np.all(meshes.niche.face_block == index + 1)
        hole = {e[3:] + e[:3] for e in loops(meshes.niche)}  # the niche's rim, run the other way round
        assert hole <= loops(meshes.wall_difference)
        low, high = rough_blocks.bbox[index, :, :2]
        under = np.all((rough.vertices[:, :2] >= low) & (rough.vertices[:, :2] <= high), axis=1)
        assert under.any()
        assert skin > 0


def test_the_same_blocks_give_the_same_bytes(rough: TriangleMesh, rough_blocks: Blocks, rough_carved: Carved) -> None:
    first, second = rough_carved.mesh, carve(rough, rough_blocks).mesh
    assert first.vertices.tobytes() == second.vertices.tobytes()
    assert first.faces.tobytes() == second.faces.tobytes()


def test_records_are_json(rough: TriangleMesh) -> None:
    blocks = blocks_on(rough, count=3)
    carved = carve(rough, blocks)
    records = json.loads(json.dumps(block_records(blocks, carved.removed_volume_m3)))
    assert [record["label"] for record in records] == [1, 2, 3]
    assert records[1]["volume_m3"] == carved.removed_volume_m3[1]
    assert records[2]["bbox_m"] == blocks.bbox[2].ravel().tolist()
    assert set(records[0]) == {"label", "shape", "size_m", "volume_m3", "bbox_m", "position_m"}


def test_a_block_in_the_air_is_an_error() -> None:
    wall = plane_wall(4, 4)
    blocks = blocks_on(wall, count=2)
    up = np.array([0.0, 0.0, 5.0])
    high = replace(blocks, vertices=blocks.vertices + up, position_m=blocks.position_m + up)
    with pytest.raises(InputError, match="2 of 2 blocks remove no rock"):
        carve(wall, high)


def test_a_wall_that_is_not_manifold_is_an_error() -> None:
    wall = plane_wall(4, 4)
    blocks = blocks_on(wall, count=2)
    doubled = TriangleMesh(wall.vertices, np.concatenate([wall.faces, wall.faces]))
    with pytest.raises(InputError, match="wall mesh: the triangles make no solid"):
        carve(doubled, blocks)
