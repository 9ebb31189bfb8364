"""Imported walls: coordinates are kept, each defect is repaired and named, each wrong input has its message."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError
from scene_files import UTM, sheet, written
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh
from scene.meshes.cleaning import clean, connected_groups, unique_rows, weld
from scene.walls.imported import ImportedWall
from scene.walls.wall import build_wall


def load(path, **keys):
    wall = build_wall(ImportedWall(mesh=path, **keys), KeyedRandom(0))
    return wall.mesh, wall.repairs


def edge_uses(faces):
    """Return how often each undirected edge is used, by a slow and simple loop."""
    uses = {}
    for a, b, c in faces.tolist():
        for edge in ((a, b), (b, c), (c, a)):
            uses.setdefault(frozenset(edge), []).append(edge)
    return uses


def assert_sound(mesh, several_parts=False):
    uses = edge_uses(mesh.faces).values()
    assert max(map(len, uses)) <= 2
    assert all(len(set(edges)) == len(edges) for edges in uses), "neighbours run along an edge in opposite directions"
    assert several_parts or len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
    assert set(mesh.faces.ravel().tolist()) == set(range(len(mesh.vertices)))


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off"])
def test_utm_coordinates_survive_to_a_micrometre(tmp_path, suffix):
    mesh = sheet()
    mesh = mesh.with_vertices(mesh.vertices + UTM)
    read, repairs = load(written(tmp_path / f"wall{suffix}", mesh))
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-6, rtol=0)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    assert read.vertices.dtype == np.float64
    assert repairs == ()


@pytest.mark.parametrize("suffix", ["stl", "glb", "ply", "obj"])
def test_what_trimesh_writes_can_be_read(tmp_path, suffix):
    mesh = sheet()
    x, y, z = mesh.vertices.T
    stored = np.stack([x, z, -y], axis=1) if suffix == "glb" else mesh.vertices  # in glTF y points up
    trimesh.Trimesh(stored, mesh.faces, process=False).export(tmp_path / f"wall.{suffix}")
    read, notes = load(tmp_path / f"wall.{suffix}")
    assert ("y is up in glTF: turned so that z is" in notes) == (suffix == "glb")
    assert len(read.vertices) == len(mesh.vertices)  # the STL's triangle soup is welded
    assert len(read.faces) == len(mesh.faces)
    distance = np.linalg.norm(read.vertices[:, None] - mesh.vertices, axis=2).min(axis=1)
    assert distance.max() < 1e-5  # these are stored in float32 or 8 digits
    assert_sound(read)


def test_a_scene_may_be_given_as_several_files(tmp_path):
    mesh = sheet()
    files = written(tmp_path / "terrain.ply", mesh), tmp_path / "rock.obj"
    trimesh.Trimesh(mesh.vertices + np.array([0.0, -1.0, 9.0]), mesh.faces, process=False).export(files[1])
    read, repairs = load(files)
    assert len(read.faces) == 2 * len(mesh.faces)
    np.testing.assert_allclose(np.ptp(read.vertices, axis=0), np.ptp(mesh.vertices, axis=0) + np.array([0, 1, 9]), atol=1e-6)
    assert repairs == (f"kept 1 pieces apart from the main surface, of {len(mesh.faces)} to {len(mesh.faces)} triangles",)
    with pytest.raises(ValidationError, match="names a file twice"):
        ImportedWall(mesh=(files[0], files[0]))
    with pytest.raises(InputError, match="no such file"):
        load((files[0], tmp_path / "missing.ply"))


def test_scenes_of_several_meshes_are_joined(tmp_path):
    mesh = sheet()
    scene = trimesh.Scene([trimesh.Trimesh(mesh.vertices + shift, mesh.faces, process=False) for shift in (0.0, [0.0, 0.0, 9.0])])
    scene.export(tmp_path / "wall.glb")
    read, repairs = load(tmp_path / "wall.glb")
    assert len(read.faces) == 2 * len(mesh.faces)
    assert repairs[0] == f"kept 1 pieces apart from the main surface, of {len(mesh.faces)} to {len(mesh.faces)} triangles"


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("ft", 0.3048)])
def test_units(tmp_path, unit, metres):
    mesh = sheet()
    read, _ = load(written(tmp_path / "wall.ply", mesh.with_vertices(mesh.vertices / metres)), unit=unit)
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-12)


def test_albedo_is_the_luminance_of_the_colours_or_as_given(tmp_path):
    mesh = sheet()
    colours = np.zeros((len(mesh.vertices), 3), np.uint8)
    colours[0], colours[1], colours[2] = (255, 255, 255), (0, 255, 0), (188, 188, 188)
    path = written(tmp_path / "wall.ply", mesh, colours)
    # sRGB 188 is half of the light (0.5029 by IEC 61966-2-1); green carries 0.7152 of the luminance
    np.testing.assert_allclose(load(path)[0].vertex_albedo[:4], [1.0, 0.7152, 0.5029, 0.0], atol=1e-4)
    np.testing.assert_allclose(load(path, albedo=0.3)[0].vertex_albedo, 0.3, atol=1e-7)
    assert load(written(tmp_path / "plain.ply", mesh))[0].vertex_albedo is None


def with_duplicates(mesh):
    soup = mesh.with_vertices(mesh.vertices[mesh.faces].reshape(-1, 3))
    return replace(soup, faces=np.arange(len(soup.vertices), dtype=np.int32).reshape(-1, 3))


def with_faces(mesh, *faces):
    return replace(mesh, faces=np.concatenate([mesh.faces, np.array(faces, np.int32)]))


def with_vertices(mesh, *vertices):
    return mesh.with_vertices(np.concatenate([mesh.vertices, np.array(vertices)]))


def with_flips(mesh):
    faces = mesh.faces.copy()
    faces[[3, 10, 11]] = faces[[3, 10, 11], ::-1]
    return replace(mesh, faces=faces)


def with_fin(mesh):
    fin = mesh.vertices[[9, 10]].mean(axis=0) - [0, 0.1, 0]  # smaller than the two triangles at the inner edge 9-10
    return with_faces(with_vertices(mesh, fin), [9, 10, 48])


def with_touching_fan(mesh):
    base = mesh.vertices[0]
    return with_faces(with_vertices(mesh, base - [1, 0, 0], base - [1, 0, 1]), [0, 48, 49])


DEFECTS = {
    "duplicate vertices": (with_duplicates, "162 duplicate vertices welded"),
    "unused vertices": (lambda mesh: with_vertices(mesh, [1.0, 1.0, 1.5]), "1 unused vertices removed"),
    "repeated corner": (lambda mesh: with_faces(mesh, [0, 0, 1], [5, 5, 5]), "2 degenerate triangles removed"),
    "doubled": (lambda mesh: with_faces(mesh, mesh.faces[5, [1, 2, 0]], mesh.faces[7, ::-1]), "2 duplicate triangles removed ("),
    "winding": (with_flips, "3 triangles wound the other way round"),
}
PARTS = {"a fin on an edge": (with_fin, 2), "a triangle on a vertex": (with_touching_fan, 1)}
"""What touches the surface, and at how many vertices."""


@pytest.mark.parametrize("name", PARTS)
def test_parts_that_touch_stay_and_are_no_longer_connected(tmp_path, name):
    mesh = sheet()
    add, touching = PARTS[name]
    read, repairs = load(written(tmp_path / "wall.ply", add(mesh)))
    assert f"parts of the surface that touch kept apart at {touching} vertices" in repairs
    assert not any("removed" in words for words in repairs)
    assert_sound(read, several_parts=True)
    harmed = add(mesh)
    corners = (np.sort(each.vertices[each.faces].reshape(-1, 9), axis=1) for each in (harmed, read))
    assert len(read.faces) == len(harmed.faces)
    np.testing.assert_allclose(*(each[np.lexsort(each.T)] for each in corners), atol=1e-9)


def test_a_removed_triangle_with_an_area_is_said_with_its_place():
    mesh = sheet()
    _, repairs = clean(with_faces(mesh, mesh.faces[5, [1, 2, 0]]), "wall", np.array([1000.0, 2000.0, 0.0]))
    corners = mesh.vertices[mesh.faces[5]]
    area = np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])) / 2
    x, y, z = corners.mean(axis=0) + np.array([1000, 2000, 0])
    assert repairs == (f"1 duplicate triangles removed ({area:.3g} m2, the first at {x:.2f}, {y:.2f}, {z:.2f})",)


@pytest.mark.parametrize("name", DEFECTS)
def test_each_defect_is_mended_and_named(tmp_path, name):
    mesh = sheet()
    harm, words = DEFECTS[name]
    read, repairs = load(written(tmp_path / "wall.ply", harm(mesh)))
    assert any(each.startswith(words) for each in repairs)
    assert_sound(read)
    whole = {tuple(np.round(np.sort(corners, axis=0).ravel(), 9)) for corners in mesh.vertices[mesh.faces]}
    mended = {tuple(np.round(np.sort(corners, axis=0).ravel(), 9)) for corners in read.vertices[read.faces]}
    assert mended == whole


def test_collinear_triangles_have_no_area():
    mesh = with_faces(with_vertices(sheet(), [0.0, 9.0, 0.0], [1.0, 9.0, 0.0], [2.0, 9.0, 0.0]), [48, 49, 50])
    assert clean(mesh, "wall")[1] == ("1 degenerate triangles removed", "3 unused vertices removed")


def test_vertices_within_a_micrometre_are_one_at_utm_scale(tmp_path):
    mesh = sheet()
    soup = with_duplicates(mesh.with_vertices(mesh.vertices + UTM))
    shift = np.random.default_rng(1).uniform(-1, 1, soup.vertices.shape)
    # shifts below 0.25 um keep any two copies within 0.87 um of one another; UTM coordinates in float64 step by 0.93 nm
    read, _ = load(written(tmp_path / "wall.ply", soup.with_vertices(soup.vertices + 0.25e-6 * shift)))
    assert len(read.vertices) == len(mesh.vertices)
    far = soup.with_vertices(soup.vertices + 1e-4 * shift)
    assert len(load(written(tmp_path / "far.ply", far))[0].vertices) == len(soup.vertices)


def test_welding_equals_the_brute_force_grouping():
    random = np.random.default_rng(3)
    vertices = random.uniform(0, 4e-6, (120, 3))
    distance = np.linalg.norm(vertices[:, None] - vertices, axis=2)
    label = np.arange(len(vertices))
    for _ in range(len(vertices)):
        label = np.where(distance <= 1e-6, label, len(vertices)).min(axis=1)
    welded, _ = weld(TriangleMesh(vertices, np.arange(120, dtype=np.int32).reshape(-1, 3)))
    np.testing.assert_array_equal(welded.vertices, vertices[np.unique(label)])
    np.testing.assert_array_equal(welded.vertices[welded.faces.ravel()], vertices[label])


def test_unique_rows_keep_the_first_of_each_group():
    rows = np.random.default_rng(2).integers(0, 5, (400, 3))
    first, group = unique_rows(rows)
    seen = list(dict.fromkeys(map(tuple, rows.tolist())))
    assert [tuple(row) for row in rows[first].tolist()] == seen
    np.testing.assert_array_equal(rows[first][group], rows)


def test_winding_follows_the_larger_part_of_each_piece():
    mesh = sheet()
    faces = mesh.faces.copy()
    faces[: len(faces) - 4] = faces[: len(faces) - 4, ::-1]
    mended = clean(replace(mesh, faces=faces), "wall")[0]
    np.testing.assert_array_equal(mended.faces, mesh.faces[:, ::-1])


def test_a_closed_surface_stays_closed_and_an_open_one_open():
    sphere = trimesh.creation.icosphere(3)
    ball = TriangleMesh(np.asarray(sphere.vertices), np.asarray(sphere.faces, np.int32))
    mended, repairs = clean(with_duplicates(ball), "ball")
    assert repairs == (f"{3 * len(ball.faces) - len(ball.vertices)} duplicate vertices welded",)
    assert all(len(edges) == 2 for edges in edge_uses(mended.faces).values())
    rim = sum(len(edges) == 1 for edges in edge_uses(clean(sheet(), "sheet")[0].faces).values())
    assert rim == 2 * (5 + 7)


def test_two_balls_that_touch_in_a_vertex_are_parted():
    sphere = trimesh.creation.icosphere(2)
    small = trimesh.creation.icosphere(1)
    vertices = np.concatenate([sphere.vertices, small.vertices * -1 + sphere.vertices[0] + small.vertices[0]])
    faces = np.concatenate([sphere.faces, small.faces[:, ::-1] + len(sphere.vertices)]).astype(np.int32)
    mended, repairs = clean(TriangleMesh(vertices, faces), "balls")
    assert "parts of the surface that touch kept apart at 1 vertices" in repairs
    assert len(mended.faces) == len(faces)
    assert_sound(mended, several_parts=True)


def test_flipped_turns_the_faces_round(tmp_path):
    mesh = sheet()  # wound counter-clockwise seen from -y
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / "wall.obj")
    plain, _ = ImportedWall(mesh=tmp_path / "wall.obj").load()
    turned, _ = ImportedWall(mesh=tmp_path / "wall.obj", flipped=True).load()
    np.testing.assert_array_equal(turned.faces, plain.faces[:, ::-1])


def broken(vertex):
    mesh = sheet()
    mesh.vertices[[7, 9]] = vertex
    return mesh


def line():
    return TriangleMesh(np.arange(9.0)[:, None] * [1.0, 2.0, 3.0], np.arange(9, dtype=np.int32).reshape(3, 3))


WRONG = {
    "nan": (broken(np.nan), {}, r"2 of 48 vertices are not finite, the first is vertex 7 at \(nan, nan, nan\); allowed: finite"),
    "infinite": (broken(np.inf), {}, r"2 of 48 vertices are not finite, the first is vertex 7 at \(inf"),
    "empty": (replace(sheet(), faces=np.empty((0, 3), np.int32)), {}, "contains no triangles"),
    "line": (line(), {}, "no triangle has an area"),
    "millimetres": (sheet(step=1e4), {}, r"7e\+04 m in size with `unit: m`; allowed: 0.5 m to 5000 m; set `unit` to cm or mm"),
    "tiny": (sheet(), {"unit": "mm"}, "set `unit` to m or ft"),
}


@pytest.mark.parametrize("name", WRONG)
def test_each_wrong_mesh_is_answered_in_one_line(tmp_path, name):
    mesh, keys, words = WRONG[name]
    path = written(tmp_path / "wall.ply", mesh)
    with pytest.raises(InputError, match=words) as caught:
        load(path, **keys)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("missing.ply", None, "there is no such file"),
        ("wall.plx", b"", "'.plx' is not a mesh format that can be read; allowed: .*did you mean 'ply'"),
        ("wall.pkl", b"cos\nsystem\n", "'.pkl' is not a mesh format"),
        ("wall.ply", b"this is no mesh", "is not a valid ply file"),
        ("empty.ply", b"", "is not a valid ply file"),
        ("cut.off", b"OFF\n3 1 0\n0 0 0\n", "is not a valid off file"),
        ("wild.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "refers to vertex 7|is not a valid off file"),
        ("points.xyz", b"0 0 0\n1 0 0\n0 1 0\n", "contains no triangles"),
    ],
)
def test_each_wrong_file_is_answered_in_one_line(tmp_path, name, content, words):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        load(path)
    assert "\n" not in str(caught.value)


def test_a_one_sided_surface_is_refused():
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    centre = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    across = 0.3 * np.stack([np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)], axis=1)
    vertices = np.stack([centre + across, centre - across], axis=1).reshape(-1, 3)
    near, far = 2 * np.arange(12), 2 * np.arange(12) + 1
    next_near, next_far = np.append(near[1:], far[0]), np.append(far[1:], near[0])
    faces = np.concatenate([np.stack([near, far, next_near], 1), np.stack([far, next_far, next_near], 1)]).astype(np.int32)
    with pytest.raises(InputError, match="only one side"):
        clean(TriangleMesh(vertices, faces), "strip")


@pytest.mark.parametrize("more", ["", "colours", "signed colours", "quads", "ascii"])
def test_a_ply_file_gives_the_same_wall_as_trimesh_reads(tmp_path, more):
    """Files with triangles only are read without trimesh, the others by it."""
    sheet_mesh = sheet()
    if more == "quads":
        path = tmp_path / "wall.ply"
        path.write_text(
            "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
            "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
            "0 0 0\n4 0 0\n4 0 4\n0 0 4\n2 0 6\n4 0 1 2 3\n3 3 2 4\n"
        )
    elif more == "ascii":
        path = tmp_path / "wall.ply"
        rows = [f"{x!r} {y!r} {z!r}" for x, y, z in sheet_mesh.vertices.tolist()]
        rows += [f"3 {a} {b} {c}" for a, b, c in sheet_mesh.faces.tolist()]
        path.write_text(
            f"ply\nformat ascii 1.0\nelement vertex {len(sheet_mesh.vertices)}\nproperty double x\nproperty double y\n"
            f"property double z\nelement face {len(sheet_mesh.faces)}\nproperty list uchar int vertex_index\nend_header\n"
            + "\n".join(rows)
        )
    else:
        colours = np.random.default_rng(1).integers(0, 255, (len(sheet_mesh.vertices), 3)) if "colours" in more else None
        path = written(tmp_path / "wall.ply", sheet_mesh, colours)
        if more == "signed colours":
            path.write_bytes(path.read_bytes().replace(b"uchar red", b"char red"))
    expected = trimesh.load(path, process=False)
    found, _ = load(path)
    np.testing.assert_array_equal(found.faces, expected.faces)
    np.testing.assert_allclose(found.vertices, expected.vertices, atol=1e-12)
    coloured = expected.visual.kind == "vertex"
    assert (found.vertex_albedo is not None) == coloured
    if coloured:
        grey = np.asarray(expected.visual.vertex_colors)[:, :3] / 255.0
        linear = np.where(grey <= 0.04045, grey / 12.92, ((grey + 0.055) / 1.055) ** 2.4)
        np.testing.assert_allclose(found.vertex_albedo, linear @ [0.2126, 0.7152, 0.0722], rtol=1e-5)


def test_the_pieces_of_a_surface_are_those_that_scipy_finds():
    """Random graphs of some dozen pieces, shuffled, and a long chain in the worst order; numbered by first appearance."""
    random = np.random.default_rng(2)
    chain = random.permutation(5000)
    cases = [
        (random.integers(0, 3000, (2500, 2)), 3000),
        (np.stack([chain[:-1], chain[1:]], axis=1), 5000),
        (np.empty((0, 2), int), 4),
    ]
    for pairs, count in cases:
        graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
        expected = connected_components(graph, directed=False)[1]
        np.testing.assert_array_equal(connected_groups(pairs, count), expected)
