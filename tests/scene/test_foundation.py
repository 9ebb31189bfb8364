"""Frame, grid, ray casting, keyed random numbers, configs and errors."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import pytest
from pydantic import Field
from scipy import stats
from surfaces import heightfield, plane, sphere

from scene.common.backend import dr, limited_threads, mi
from scene.common.config import Config, load_yaml, parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.common.regular_file import check_file
from scene.geometry.frame import WallFrame
from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh
from scene.ray_casting.raycast import RayCaster, heights

SIGNIFICANCE = 1e-5
"""False-failure rate of each statistical test here; seeds are fixed."""


def leaning_wall(offset: np.ndarray) -> np.ndarray:
    """Return points of a plane that leans back by 20 degrees and faces south-west, with relief, world frame."""
    random = np.random.default_rng(1)
    outward = np.array([-0.6, -0.8, 0.0]) * np.cos(0.35) + np.array([0, 0, 1.0]) * np.sin(0.35)
    along = np.array([0.8, -0.6, 0.0])
    up = np.cross(outward, along)
    up = up if up[2] > 0 else -up
    a, b = random.uniform(0, 70, 4000), random.uniform(0, 45, 4000)
    return offset + a[:, None] * along + b[:, None] * up + random.normal(0, 0.1, 4000)[:, None] * outward


@pytest.mark.parametrize("offset", [np.zeros(3), np.array([652_000.0, 4_921_000.0, 830.0])])
def test_the_wall_frame_is_the_mean_plane_and_inverts_exactly(offset: np.ndarray) -> None:
    points = leaning_wall(offset)
    outward = np.array([-0.6 * np.cos(0.35), -0.8 * np.cos(0.35), np.sin(0.35)])
    frame = WallFrame.fit(points, points.mean(axis=0) + 100 * np.array([-0.6, -0.8, 0.0]))
    wall = frame.to_wall(points)
    assert np.degrees(np.arccos(frame.rotation[2] @ outward)) < 0.05  # 0.1 m of relief over 4,000 points and 45 m
    assert abs(wall[:, 2].mean()) < 1e-6
    np.testing.assert_allclose(wall[:, :2].min(axis=0), 0, atol=1e-8)
    np.testing.assert_allclose(np.ptp(wall[:, :2], axis=0), [70, 45], atol=0.5)
    assert frame.rotation[1, 2] > 0.9  # y up the wall
    assert np.linalg.det(frame.rotation) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(frame.to_world(wall), points, rtol=0, atol=2e-9)  # a UTM northing is exact to 1e-9 m
    homogeneous = points @ frame.matrix[:3, :3].T + frame.matrix[:3, 3]
    np.testing.assert_allclose(homogeneous, wall, rtol=0, atol=5e-9)


def test_the_wall_frames_z_points_to_the_side_asked_for() -> None:
    points = leaning_wall(np.zeros(3))
    front, back = (WallFrame.fit(points, points.mean(axis=0) + side * np.array([-0.6, -0.8, 0.0])) for side in (100, -100))
    np.testing.assert_allclose(front.rotation[2], -back.rotation[2], atol=1e-12)


def test_points_on_a_line_have_no_wall_frame() -> None:
    line = np.arange(10.0)[:, None] * [1.0, 2.0, 3.0]
    with pytest.raises(InputError, match="one line"):
        WallFrame.fit(line, np.array([0.0, -10.0, 0.0]))


def test_the_grid_holds_whole_pixels_and_centres_at_halves() -> None:
    grid = Grid.over(np.array([[1.0, 2.0, 0.0], [4.05, 4.0, 0.0]]), 0.1)
    assert grid.shape == (20, 30)
    assert grid.columns(np.array([1.05]))[0] == pytest.approx(0.5)
    assert grid.rows(np.array([3.95]))[0] == pytest.approx(0.5)


def test_hits_are_refined_to_float64() -> None:
    """Large oblique triangles 100 m away: float32 alone is right to 10 um, the refined distance to a nanometre."""
    normal = np.array([0.3, -0.4, 1.0]) / np.linalg.norm([0.3, -0.4, 1.0])
    caster = RayCaster(plane(normal, np.array([35.0, 22.0, 1.0])))
    random = np.random.default_rng(1)
    origin = np.array([30.0, 20.0, 105.0])
    directions = np.concatenate([random.uniform(-0.2, 0.2, (5000, 2)), np.full((5000, 1), -1.0)], axis=1)
    distance, face = caster.cast(origin, directions)
    hit = face >= 0
    expected = (np.array([35.0, 22.0, 1.0]) - origin) @ normal / (directions @ normal)
    assert hit.mean() > 0.9
    assert np.abs(distance - expected)[hit].max() < 1e-9
    assert np.isnan(distance[~hit]).all()


def test_rays_at_edges_and_silhouettes_are_settled_in_float64() -> None:
    """Compared with every triangle in double precision: rays through points within 20 um of edges of a steep wall 100 m away.

    At most one in two hundred of these chosen rays may be wrong by more than 0.1 um (where all the rays around it meet a third
    face); only one ray in a thousand passes so close to an edge.
    """
    wall = heightfield(6.0, 4.0, 0.1, roughness=1.5)
    random = np.random.default_rng(4)
    face = wall.faces[random.integers(0, len(wall.faces), 1500)]
    share = random.uniform(0, 1, (1500, 1))
    on_edge = share * wall.vertices[face[:, 0]] + (1 - share) * wall.vertices[face[:, 1]]
    origin = np.array([30.0, -20.0, 95.0])
    directions = on_edge + random.uniform(-2e-5, 2e-5, on_edge.shape) - origin
    expected = np.array([first_hit(origin, direction, wall) for direction in directions])
    wrong = {}
    for exact in (False, True):
        device = [mi.Array3f64(np.ascontiguousarray(rows.T)) for rows in (np.broadcast_to(origin, directions.shape), directions)]
        hits = RayCaster(wall).intersect(*device, coherent=False, exact=exact)
        both = np.array(hits.valid) & ~np.isnan(expected)  # the border's rays decide in float32 whether they meet the wall at all
        assert both.mean() > 0.95
        wrong[exact] = np.mean(np.abs(np.array(hits.distance) - expected)[both] > 1e-9)
    assert wrong[True] < 0.005
    assert wrong[False] > 0.01  # Embree's errors are a little larger than OptiX's


def first_hit(origin: np.ndarray, direction: np.ndarray, mesh: TriangleMesh) -> float:
    """Return the distance, in lengths of the direction, to the nearest triangle that the ray hits; NaN for a miss."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    across = np.cross(direction, c - a)
    scale = 1 / np.einsum("ij,ij->i", b - a, across)
    u = scale * np.einsum("ij,ij->i", origin - a, across)
    around = np.cross(origin - a, b - a)
    v, t = scale * (around @ direction), scale * np.einsum("ij,ij->i", c - a, around)
    through = (u >= -1e-11) & (v >= -1e-11) & (u + v <= 1 + 1e-11)
    return float(t[through].min()) if through.any() else float("nan")


def test_hits_know_normal_albedo_and_block() -> None:
    ball = sphere(np.zeros(3), 5.0, 4)
    labels = (np.arange(len(ball.faces)) % 7).astype(np.int32)
    albedo = np.linspace(0.1, 0.9, len(ball.vertices)).astype(np.float32)
    mesh = TriangleMesh(ball.vertices, ball.faces, vertex_albedo=albedo, face_block=labels)
    random = np.random.default_rng(2)
    outward = random.normal(size=(3000, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    hits = RayCaster(mesh).intersect(mi.Array3f64((20 * outward).T.copy()), mi.Array3f64((-outward).T.copy()), coherent=False)
    face = np.array(hits.face)
    np.testing.assert_array_equal(np.array(hits.block), labels[face])
    np.testing.assert_allclose(np.array(hits.albedo), albedo[ball.faces[face]].mean(axis=1), rtol=1e-6)
    corners = ball.vertices[ball.faces[face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(np.array(hits.normal).T, normal, atol=1e-6)


def test_heights_are_those_of_the_surface_and_nan_beside_it() -> None:
    slope = plane(np.array([0.2, 0.1, 1.0]), np.zeros(3), half_side=3.0)
    grid = Grid(-5.0, 5.0, 0.05, 200, 200)
    raster = heights(RayCaster(slope), grid)
    x, y = np.meshgrid(-5 + (np.arange(200) + 0.5) * 0.05, 5 - (np.arange(200) + 0.5) * 0.05)
    seen = ~np.isnan(raster)
    assert np.abs(raster - -(0.2 * x + 0.1 * y))[seen].max() < 1e-6
    assert seen[100, 100]
    assert not seen[0, 0]


def test_no_ray_leaks_through_a_closed_fine_mesh() -> None:
    """327,680 triangles smaller than a tenth of a metre, seen from inside: every ray hits."""
    ball = sphere(np.zeros(3), 5.0, 7)
    directions = np.random.default_rng(3).normal(size=(200_000, 3))
    _, face = RayCaster(ball).cast(np.zeros(3), directions)
    assert (face >= 0).all()


def test_triangles_below_a_millimetre_leak_no_ray() -> None:
    """720,000 triangles with sides of 0.5 mm, seen from 100 m, where float32 resolves 8 um."""
    patch = heightfield(0.3, 0.3, 0.0005, roughness=0.02)
    random = np.random.default_rng(5)
    aims = np.concatenate([random.uniform(0.02, 0.28, (200_000, 2)), np.zeros((200_000, 1))], axis=1)
    origin = np.array([10.0, -5.0, 100.0])
    _, face = RayCaster(patch).cast(origin, aims - origin)
    assert (face >= 0).all()


def test_coordinates_far_from_the_origin_are_refused() -> None:
    mesh = plane(np.array([0, 0, 1.0]), np.array([652_000.0, 4_921_000.0, 830.0]))
    with pytest.raises(InputError, match="too far from the origin"):
        RayCaster(mesh)


def test_vertex_normals_of_a_sphere_are_radial() -> None:
    ball = sphere(np.zeros(3), 1.0, 5)
    assert np.abs(ball.vertex_normals() - ball.vertices).max() < 0.005
    field = heightfield(5.0, 4.0, 0.1)
    tilted = field.with_vertices(field.vertices * [1, 1, 0] + field.vertices[:, :1] * [0, 0, 0.5])
    np.testing.assert_allclose(
        tilted.vertex_normals(), np.broadcast_to(np.array([-0.5, 0, 1]) / np.hypot(0.5, 1), tilted.vertices.shape), atol=1e-12
    )


def test_device_numbers_are_standard_normal_and_uniform_and_independent() -> None:
    index = dr.arange(mi.UInt32, 100_000)
    source = KeyedRandom(5).child("test")
    normals, uniforms = np.array(source.normals(index)), np.array(source.child("u").uniforms(index))
    assert min(stats.kstest(row, "norm").pvalue for row in normals) > SIGNIFICANCE / 4
    assert min(stats.kstest(row, "uniform").pvalue for row in uniforms) > SIGNIFICANCE / 4
    others = np.concatenate([normals, np.array(source.normals(index, 1)), np.array(KeyedRandom(6).child("test").normals(index))])
    correlation = np.corrcoef(others)[np.triu_indices(len(others), 1)]
    limit = stats.norm.isf(SIGNIFICANCE / 2 / len(correlation)) / np.sqrt(100_000)
    assert np.abs(correlation).max() < limit


def test_a_number_depends_on_its_key_only() -> None:
    source = KeyedRandom(5).child("pulse")
    whole = np.array(source.normals(dr.arange(mi.UInt32, 1000)))
    part = np.array(source.normals(dr.arange(mi.UInt32, 100) + 500))
    np.testing.assert_array_equal(part, whole[:, 500:600])
    assert source.generator().normal() == source.generator().normal()
    assert KeyedRandom(5).child("a", 1).key != KeyedRandom(5).child("a", 2).key != KeyedRandom(6).child("a", 2).key


class Inner(Config):
    step_m: float = Field(1.0, gt=0)


class Outer(Config):
    inner: Inner = Inner()
    count: int


def test_config_mistakes_are_named_with_the_nearest_key() -> None:
    with pytest.raises(
        InputError, match=r"file\.yaml: keys or values are wrong: unknown key 'inner\.stepm'; did you mean 'step_m'\?"
    ):
        parse(Outer, {"count": 1, "inner": {"stepm": 2}}, "file.yaml")
    with pytest.raises(InputError, match="'count' is missing"):
        parse(Outer, {}, "file.yaml")
    with pytest.raises(InputError, match=r"'inner\.step_m'.*greater than 0, got -1"):
        parse(Outer, {"count": 1, "inner": {"step_m": -1}}, "file.yaml")
    with pytest.raises(InputError, match="must be a mapping"):
        parse(Outer, [1], "file.yaml")
    with pytest.raises(InputError, match=r"got \{'a': \{'b': \{\.\.\.\}\}\}$"):
        parse(Outer, {"count": {"a": {"b": {"c": {"d": 1}}}}}, "file.yaml")


class Round(Config):
    short_forms: ClassVar[tuple[str, ...]] = ("like",)
    shape: Literal["round"] = "round"
    inner: Inner = Inner()
    radius_m: float = 1.0


class Square(Config):
    class Inner(Config):
        side_m: float = 1.0

    shape: Literal["square"] = "square"
    inner: Inner = Inner()
    side_m: float = 1.0


class Shapes(Config):
    shapes: tuple[Annotated[Round | Square, Field(discriminator="shape")], ...] = ()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"side_m": 1}, "'shapes.0.side_m' belongs to square, not to round; allowed: inner, like, radius_m, shape"),
        ({"inner": {"side_m": 1}}, "'shapes.0.inner.side_m' belongs to square, not to round; allowed: step_m"),
        ({"radus_m": 1}, "unknown key 'shapes.0.radus_m'; did you mean 'radius_m'?"),
        ({"lik": 1}, "unknown key 'shapes.0.lik'; did you mean 'like'?"),
        ({"sid_m": 1}, "unknown key 'shapes.0.sid_m'; allowed: inner, like, radius_m, shape"),
    ],
)
def test_a_key_of_another_kind_is_told_whose_it_is(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"file.yaml: keys or values are wrong: {message}") + "$"):
        parse(Shapes, {"shapes": [{"shape": "round", **values}]}, "file.yaml")


def test_a_config_file_that_cannot_be_read_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_yaml(tmp_path / "absent.yaml")
    (tmp_path / "tag.yaml").write_text("a: !!python/object/apply:os.system ['true']")
    with pytest.raises(InputError, match="not valid YAML"):
        load_yaml(tmp_path / "tag.yaml")


MERGE_BOMB = "m0: &m0 {k: 1}\n" + "".join(
    f"m{level}: &m{level} {{<<: [{', '.join([f'*m{level - 1}'] * 9)}]}}\n" for level in range(1, 11)
)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (MERGE_BOMB, "10,000 keys"),
        ("seed: " + "1" * 5000, "a number of 5,000 digits"),
        ("# a\n" * 1_100_000, "has 4 MB; allowed: up to 4 MB"),
    ],
    ids=["merge_keys", "digits", "large"],
)  # fmt: skip
def test_yaml_that_takes_without_end_is_refused(text: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(InputError, match=problem) as caught:
        load_yaml(tmp_path / "a.yaml")
    assert len(str(caught.value)) < 1000


def test_json_is_read_as_a_config(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"seed": 1, "wall": {"width_m": 1e1}}')
    assert load_yaml(tmp_path / "a.json") == {"seed": 1, "wall": {"width_m": 10.0}}


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (os.mkfifo, "is a pipe, a device or a socket"),
        (lambda path: path.symlink_to("/dev/zero"), "is a pipe, a device or a socket"),
        (lambda path: path.symlink_to(path), "Too many levels of symbolic links"),
        (lambda path: path.mkdir(), "Is a directory"),
        (lambda path: None, "No such file or directory"),
    ],
)
def test_what_is_no_file_is_not_opened(make: Any, problem: str, tmp_path: Path) -> None:
    make(tmp_path / "a")
    with pytest.raises(InputError, match=problem):
        check_file(tmp_path / "a")
    for name in ("a" * 5000, "a\0b"):
        with pytest.raises(InputError, match="cannot be read"):
            check_file(tmp_path / name)


def test_a_message_is_one_plain_line_of_bounded_length() -> None:
    text = str(InputError("is \x1b[31mred\n\x07", where="a" * 10_000, allowed="b", remedy="c"))
    assert text.endswith("is \ufffd[31mred \ufffd; allowed: b; c")
    assert len(text) < 700
    assert text.isprintable()


def test_a_wrong_variant_is_an_input_error() -> None:
    code = "import scene.common.backend"
    environment = {"SCARPSIM_VARIANT": "vulkan", "PYTHONPATH": str(Path(__file__).parents[2]), "PATH": "/usr/bin"}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert "allowed: cuda_ad_mono, llvm_ad_mono" in result.stderr


@pytest.mark.parametrize(("most", "inside"), [(1, 1), (1_000, 2), (None, 2)])
def test_the_ray_tracer_gets_its_two_threads_back_after_an_error(most: int | None, inside: int) -> None:
    """A limit above the number of threads changes nothing."""
    of_machine, seen = dr.thread_count(), list[int]()

    @limited_threads(most)
    def fail() -> None:
        seen.append(dr.thread_count())
        raise InputError("failed", where="here", remedy="none")

    dr.set_thread_count(2)
    try:
        with pytest.raises(InputError):
            fail()
        assert (seen, dr.thread_count()) == ([inside], 2)
    finally:
        dr.set_thread_count(of_machine)
