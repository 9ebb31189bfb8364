"""Every stereo effect: its equation against an independent calculation, no effect at zero, and the order of the stages.

The independent calculation shares no code with `sensors/`: Metashape's equations and their inverse by fixed-point iteration,
Bouguet's rectification with SciPy's rotations, triangulation in NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation
from surfaces import heightfield, plane, step

from scene.common.backend import dr, mi
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.cameras.camera import Camera, CameraPair
from sensors.cameras.rectification import rectify
from sensors.effects import FURTHER_EFFECTS, STEREO_EFFECTS
from sensors.effects.base import Effect
from sensors.effects.edge_fattening import EdgeFattening
from sensors.effects.smoothing import smoothed
from sensors.effects.texture_noise import LARGEST_SIGMA_PX, TextureNoise
from sensors.models.placement import RigConfig, Target
from sensors.models.sensor_model import StereoModel
from sensors.signal_chain.matches import Matches, fill_gaps
from sensors.signal_chain.observation import Observation
from sensors.stereo.stereo_pair import REDUCTION, Quality, StereoPair

QUIET = {"parallax_sigma_px": 0.0, "regularization_sigma_px": 0.0}
SIGNIFICANCE = 1e-5
"""False-failure rate of each statistical test here; seeds are fixed, so a test that passes once passes always."""
# The wall frame's x is the world's x, its y the world's z, its z the world's -y: a vertical wall, cameras in the south.
FRAME = WallFrame(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]), np.zeros(3))
NORMAL = np.array([0.1, 0.2, 1.0])
HUNDREDTH_MM = 1e-5


def rig() -> CameraPair:
    """A converging pair 28 m apart, 105 m from the wall, with every interior parameter except k4 in use."""
    corners = FRAME.to_world(plane(np.array([0, 0, 1.0]), np.zeros(3)).vertices)
    front = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    pair = RigConfig(width=1840, height=1228, k1=-0.05, k2=0.03).place(Target(front))
    lens = {"cx_px": 7.0, "cy_px": -4.0, "b1": 0.8, "b2": -0.5, "k3": 0.01, "p1": 2e-4, "p2": -3e-4}
    return CameraPair(replace(pair.left, **lens), replace(pair.right, **lens))


def observe(
    mesh: TriangleMesh, effects: list[dict[str, Any]], quality: Quality = "high", pair: CameraPair | None = None, seed: int = 1
) -> Observation:
    sensor = StereoPair(pair or rig(), FRAME, StereoModel(noise=QUIET, effects=effects), quality, truth=True)
    return sensor.observe(RayCaster(mesh), KeyedRandom(seed))


# --- The oracle ---


def pixel(camera: Camera, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return pixel coordinates by the Metashape user manual, appendix D."""
    r = np.hypot(x, y)
    radial = 1 + camera.k1 * r**2 + camera.k2 * r**4 + camera.k3 * r**6 + camera.k4 * r**8
    xd = x * radial + camera.p1 * (r**2 + 2 * x**2) + 2 * camera.p2 * x * y
    yd = y * radial + camera.p2 * (r**2 + 2 * y**2) + 2 * camera.p1 * x * y
    u = camera.width * 0.5 + camera.cx_px + xd * camera.f_px + xd * camera.b1 + yd * camera.b2
    return u, camera.height * 0.5 + camera.cy_px + yd * camera.f_px


def ray(camera: Camera, u: FloatArray, v: FloatArray) -> FloatArray:
    """Return directions (x, y, 1) (n, 3) in the camera's frame, by fixed-point iteration of the pixel's error."""
    x, y = np.zeros_like(u), np.zeros_like(v)
    for _ in range(25):
        seen_u, seen_v = pixel(camera, x, y)
        x, y = x + (u - seen_u) / camera.f_px, y + (v - seen_v) / camera.f_px
    return np.stack([x, y, np.ones_like(x)], axis=1)


def bouguet(left: Camera, right: Camera) -> tuple[FloatArray, FloatArray, float]:
    """Return rotations into the rectified frame (x along the base), each by half of the relative rotation, and the base."""
    half = Rotation.from_rotvec(0.5 * Rotation.from_matrix(left.rotation.T @ right.rotation).as_rotvec())
    base = half.inv().apply(left.rotation.T @ (right.position - left.position))
    axis = np.cross(base, [1.0, 0, 0])
    turn = (
        Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.arccos(base[0] / np.linalg.norm(base)))
        if axis.any()
        else Rotation.identity()
    )
    return (turn * half.inv()).as_matrix(), (turn * half).as_matrix(), float(np.linalg.norm(base))


@dataclass(frozen=True)
class Change:
    """Real minus nominal camera: interior, rotation vector (own frame), shift (world), jitter (amplitude, period, phase)."""

    interior: dict[str, float]
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    jitter: tuple[float, float, float] = (0.0, 1.0, 0.0)

    def apply(self, camera: Camera) -> Camera:
        """Return the changed camera; camera: in the wall frame."""
        return replace(
            camera,
            **{name: getattr(camera, name) + value for name, value in self.interior.items()},
            rotation=camera.rotation @ Rotation.from_rotvec(self.turn).as_matrix(),
            position=camera.position + FRAME.rotation @ np.array(self.shift),
        )

    def displacement(self, v: FloatArray) -> FloatArray:
        amplitude, rows, phase = self.jitter
        return amplitude * np.sin(2 * np.pi * v / rows + phase)


NONE = Change({})


def recorded(pair: CameraPair, left: Change, right: Change, normal: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """Return the points (n, 3), wall frame, that a nominally calibrated matcher finds for left pixels of a plane through 0."""
    nominal = pair.in_wall_frame(FRAME)
    real_left, real_right = left.apply(nominal.left), right.apply(nominal.right)
    sight = ray(real_left, u - left.displacement(v), v) @ real_left.rotation.T
    point = real_left.position - sight * (normal @ real_left.position) / (sight @ normal)[:, None]
    local = (point - real_right.position) @ real_right.rotation
    right_u, right_v = pixel(real_right, local[:, 0] / local[:, 2], local[:, 1] / local[:, 2])
    right_u = right_u + right.displacement(right_v)
    to_left, to_right, base = bouguet(nominal.left, nominal.right)
    left_ray, right_ray = ray(nominal.left, u, v) @ to_left.T, ray(nominal.right, right_u, right_v) @ to_right.T
    depth = base / (left_ray[:, 0] / left_ray[:, 2] - right_ray[:, 0] / right_ray[:, 2])
    return nominal.left.position + (left_ray / left_ray[:, 2:] * depth[:, None]) @ to_left @ nominal.left.rotation.T


CAMERA_EFFECTS: list[tuple[str, dict[str, Any], Change]] = [
    ("focal_length", {"delta_px": 2.0}, Change({"f_px": 2.0})),
    ("principal_point_x", {"delta_px": -3.0}, Change({"cx_px": -3.0})),
    ("principal_point_y", {"delta_px": 3.0}, Change({"cy_px": 3.0})),
    (
        "radial_distortion",
        {"k1": 0.002, "k2": -0.01, "k3": 0.02, "k4": 0.05},
        Change({"k1": 0.002, "k2": -0.01, "k3": 0.02, "k4": 0.05}),
    ),
    ("tangential_distortion", {"p1": 5e-4, "p2": -3e-4}, Change({"p1": 5e-4, "p2": -3e-4})),
    ("affinity_skew", {"b1_px": 1.5, "b2_px": -2.0}, Change({"b1": 1.5, "b2": -2.0})),
    ("camera_omega", {"angle_rad": 3e-4}, Change({}, turn=(3e-4, 0, 0))),
    ("camera_phi", {"angle_rad": 2e-4}, Change({}, turn=(0, 2e-4, 0))),
    ("camera_kappa", {"angle_rad": -5e-4}, Change({}, turn=(0, 0, -5e-4))),
    ("camera_shift", {"x_m": 0.02, "y_m": -0.03, "z_m": 0.01}, Change({}, shift=(0.02, -0.03, 0.01))),
    ("row_jitter", {"amplitude_px": 0.7, "rows_per_cycle": 300.0, "phase_rad": 0.4}, Change({}, jitter=(0.7, 300.0, 0.4))),
]


@pytest.mark.parametrize("side", ["left", "right", "both"])
@pytest.mark.parametrize(("name", "parameters", "change"), CAMERA_EFFECTS, ids=[name for name, _, _ in CAMERA_EFFECTS])
def test_camera_and_exposure_effects_act_as_brute_force_projection_says(
    name: str, parameters: dict[str, float], change: Change, side: str
) -> None:
    """Every fifth matched cell of a tilted plane to 0.01 mm; somewhere the change must be a hundred times larger."""
    seen = observe(plane(NORMAL, np.zeros(3)), [{"name": name, "camera": side, **parameters}], "low")
    row, column = (indices[::5] for indices in np.nonzero(seen.valid))
    left, right = (change if side in (camera, "both") else NONE for camera in ("left", "right"))
    cells = (column + 0.5) * 8, (row + 0.5) * 8
    points = seen.points[row, column]
    np.testing.assert_allclose(points, recorded(rig(), left, right, NORMAL, *cells), rtol=0, atol=HUNDREDTH_MM)
    undisturbed = recorded(rig(), NONE, NONE, NORMAL, *cells)
    assert len(points) > 3_000
    assert np.abs(undisturbed @ NORMAL).max() < 1e-9
    assert np.linalg.norm(points - undisturbed, axis=1).max() > 100 * HUNDREDTH_MM


def parallel_pair(distance: float, base: float) -> CameraPair:
    """Two distortion-free cameras that look straight at the wall z = 0 from (-base/2, 0, distance) and (base/2, 0, distance)."""
    rotation = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # camera x = world x, y = -z, z = y
    interior = dict.fromkeys(("cx_px", "cy_px", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2"), 0.0)
    left, right = (
        Camera(1840, 1228, f_px=1500.0, **interior, position=np.array([x, -distance, 0.0]), rotation=rotation)
        for x in (-base / 2, base / 2)
    )
    return CameraPair(left, right)


def test_radial_distortion_domes_a_parallel_pair_by_the_closed_form() -> None:
    """The depth error is dZ = -Z k1 [3 (u - b/2)^2 + v^2 + b^2/4], to 0.01 mm for k1 = 5e-5.

    The remainder is of second order in k1. Undistorting the left pixel and inverting the disparity both add terms of Z (k1
    r^2)^2; so twice the k1 has four times the remainder.
    """
    distance, base = 105.0, 28.0
    pair = parallel_pair(distance, base)

    def remainder(k1: float) -> FloatArray:
        seen = observe(plane(np.array([0, 0, 1.0]), np.zeros(3), 200.0), [{"name": "radial_distortion", "k1": k1}], "low", pair)
        rows, columns = seen.depth.shape
        u, v = np.meshgrid((np.arange(columns) + 0.5) * 8 - 920, (np.arange(rows) + 0.5) * 8 - 614)
        u, v, b = u / 1500, v / 1500, base / distance
        return seen.depth - distance + distance * k1 * (3 * (u - b / 2) ** 2 + v**2 + b**2 / 4)

    small, large = remainder(5e-5), remainder(0.01)
    assert np.nanmax(np.abs(small)) < HUNDREDTH_MM
    assert np.nanmax(np.abs(large)) > 1e-3
    assert np.nanmax(np.abs(large)) / np.nanmax(np.abs(remainder(0.005))) == pytest.approx(4.0, rel=0.05)


# --- Identity at null, registry ---


def steps_with_texture() -> TriangleMesh:
    """Two planes, 6 m apart in depth, with an albedo, so that every effect changes something."""
    mesh = step(6.0, 0.0)
    return replace(mesh, vertex_albedo=np.linspace(0.2, 0.8, len(mesh.vertices), dtype=np.float32))


def typical(effect: type[Effect]) -> dict[str, Any]:
    extras = {key: info.json_schema_extra for key, info in effect.model_fields.items()}
    found = {
        key: extra["typical"] for key, extra in extras.items() if isinstance(extra, dict) and extra.get("typical") is not None
    }
    return {"name": effect.model_fields["name"].default, **found}


@pytest.mark.parametrize("effect", [*STEREO_EFFECTS, *FURTHER_EFFECTS], ids=lambda effect: effect.__name__)
def test_an_effect_is_the_identity_at_null_bit_for_bit_and_acts_at_its_typical_value(effect: type[Effect]) -> None:
    mesh = steps_with_texture()
    without = observe(mesh, [], "medium")
    null = observe(mesh, [{"name": typical(effect)["name"], **effect.nulls()}], "medium")
    acting = observe(mesh, [typical(effect)], "medium")
    for channel in ("points", "depth", "block"):
        assert getattr(null, channel).tobytes() == getattr(without, channel).tobytes()
    assert acting.depth.tobytes() != without.depth.tobytes()


def test_the_registry_has_the_whole_catalogue() -> None:
    assert {effect.tag() for effect in STEREO_EFFECTS} == {
        *("focal_length", "principal_point_x", "principal_point_y", "radial_distortion", "tangential_distortion"),
        *("affinity_skew", "camera_omega", "camera_phi", "camera_kappa", "camera_shift", "parallax_noise"),
        *(
            "regularization_noise",
            "pixel_locking",
            "edge_fattening",
            "smoothing",
            "occlusion_fill",
            "texture_noise",
            "row_jitter",
            "tile_shift",
            "fronto_parallel_bias",
        ),
    }


def disparity(seen: Observation, pair: CameraPair) -> FloatArray:
    """Return the disparity (rows, columns), px of the frame, that corresponds to an observation's depths."""
    nominal = pair.in_wall_frame(FRAME)
    geometry = rectify(nominal)
    z = (seen.points - nominal.left.position) @ nominal.left.rotation @ geometry.left[2]
    return geometry.f * geometry.base_m / z + geometry.offset


def locked(values: FloatArray, amplitude: float, reduction: int) -> FloatArray:
    return values + amplitude * np.sin(2 * np.pi * (values / reduction % 1.0))


@pytest.mark.parametrize("quality", ["high", "low"])
def test_pixel_locking_is_a_sine_of_the_fraction_of_the_matched_images_pixel(quality: Quality) -> None:
    mesh, effect = plane(NORMAL, np.zeros(3)), {"name": "pixel_locking", "amplitude_px": 0.4}
    true, found = (disparity(observe(mesh, effects, quality), rig()) for effects in ([], [effect]))
    np.testing.assert_allclose(found, locked(true, 0.4, REDUCTION[quality]), rtol=0, atol=1e-6)
    assert np.nanmax(found - true) == pytest.approx(0.4, abs=1e-3)


@pytest.mark.parametrize(
    "turn", [[[1.0, 0, 0], [0, 1, 0], [0, 0, 1]], [[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]], ids=["upright", "level"]
)
def test_matching_effects_act_in_the_chains_order_whatever_the_configs(turn: list[list[float]]) -> None:
    """Fattening, smoothing, locking, then filling; noise before locking: parallax noise of a locked matcher is locked too.

    A vertical edge has a half-occluded strip to fill; at a horizontal one, fattening and smoothing meet and do not commute.
    """
    flat = step(6.0, 0.0)
    mesh, pair = flat.with_vertices(flat.vertices @ np.array(turn)), rig()
    effects = [
        {"name": "occlusion_fill", "reach_px": 1e4},
        {"name": "pixel_locking", "amplitude_px": 0.4},
        {"name": "smoothing", "sigma_px": 3.0},
        {"name": "edge_fattening", "radius_px": 4.0},
    ]
    grown = EdgeFattening(radius_px=2, step_px=2.0).filtered(disparity(observe(mesh, []), pair), 1.0, 2.0)
    expected = fill_gaps(locked(smoothed(grown, 1.5), 0.4, 2), np.inf)
    for order in (effects, effects[::-1]):
        np.testing.assert_allclose(disparity(observe(mesh, order), pair), expected, rtol=0, atol=1e-6)
    noise = {"name": "parallax_noise", "sigma_px": 0.3}
    true, noisy, both = (disparity(observe(mesh, chosen), pair) for chosen in ([], [noise], [effects[1], noise]))
    np.testing.assert_allclose(both, locked(noisy, 0.4, 2), rtol=0, atol=1e-6)
    assert np.nanstd(noisy - true) == pytest.approx(0.3, rel=0.02)


def test_heavy_tailed_noise_has_its_standard_deviation_kurtosis_and_grain() -> None:
    """Variance sigma^2 and kurtosis 3 exp(4 t^2) everywhere; cells two nodes apart are independent, neighbours are not.

    8 seeds x 1,200 nodes: the variance is known to about 2 %, the kurtosis to 4 % (t = 0.3); the bounds are five times that.
    """
    mesh, pair = plane(np.array([0, 0, 1.0]), np.zeros(3)), rig()
    effect = {"name": "heavy_tailed_noise", "sigma_px": 0.5, "step_px": 20.0, "tail": 0.3}
    quiet = disparity(observe(mesh, []), pair)
    errors = np.stack([disparity(observe(mesh, [effect], seed=seed), pair) for seed in range(8)]) - quiet
    inner = errors[:, 150:450, 250:650]
    assert np.isfinite(inner).all()
    assert np.mean(inner**2) == pytest.approx(0.25, rel=0.1)
    assert np.mean(inner**4) / np.mean(inner**2) ** 2 == pytest.approx(3 * np.exp(4 * 0.3**2), rel=0.2)
    columns = np.mean(inner**2, axis=(0, 1))[:400].reshape(-1, 10).mean(axis=0)  # ten cells from node to node
    assert columns.max() < 1.2 * columns.min()
    apart = 2 * 10 + 1
    assert abs(np.mean(inner[..., apart:] * inner[..., :-apart])) < 0.1 * 0.25
    assert np.mean(inner[..., 1:] * inner[..., :-1]) > 0.9 * 0.25


# --- Fattening, smoothing, filling ---


def test_the_foreground_of_a_step_grows_by_the_radius_over_the_half_occluded_strip() -> None:
    """The near plane ends at x = 0; its outline moves to x = -r Z / f, within a cell."""
    radius_px, cell = 12.0, 2 * 99.0 / rig().left.f_px
    without, with_effect = (
        observe(step(6.0, 0.0), effects) for effects in ([], [{"name": "edge_fattening", "radius_px": radius_px}])
    )
    edges = []
    for seen in (without, with_effect):
        near = seen.points[seen.valid & (seen.points[..., 2] > 3.0) & (np.abs(seen.points[..., 1]) < 10.0)]
        edges.append(near[:, 0].min())
    assert edges[0] == pytest.approx(0.0, abs=cell)
    assert edges[1] - edges[0] == pytest.approx(-radius_px * 99.0 / rig().left.f_px, abs=1.5 * cell)


def test_smoothing_damps_a_sine_by_the_gaussians_transfer_function_and_keeps_a_plane() -> None:
    """exp(-2 pi^2 sigma^2 / wavelength^2) away from the border (the kernel ends at 4 sigma: 1e-4)."""
    sigma, wavelength = 2.5, 24.0
    row, column = np.mgrid[:70, :110]
    sine, slope = np.sin(2 * np.pi * column / wavelength), 0.3 * row - 0.2 * column
    inner = np.s_[15:-15, 15:-15]
    gain = np.exp(-2 * np.pi**2 * sigma**2 / wavelength**2)
    np.testing.assert_allclose(smoothed(sine, sigma)[inner], gain * sine[inner], rtol=0, atol=2e-4)
    np.testing.assert_allclose(smoothed(slope, sigma)[inner], slope[inner], rtol=0, atol=1e-10)


def test_occlusion_fill_fills_strips_up_to_its_reach_with_background() -> None:
    """Beside a step of h = 6 m, a strip of b h / (Z - h) = 1.7 m on the far plane is seen by the left camera only: 41 px."""
    mesh, pair = step(6.0, 0.0), rig()
    width_px = 28.0 * 6.0 / 99.0 * pair.left.f_px / 105.0
    empty, short, filled = (
        observe(mesh, effects)
        for effects in (
            [],
            [{"name": "occlusion_fill", "reach_px": 0.7 * width_px}],
            [{"name": "occlusion_fill", "reach_px": 1.3 * width_px}],
        )
    )
    np.testing.assert_allclose(short.points, empty.points, atol=1e-12)  # a graphics card rounds each kernel in its own way
    new = filled.valid & ~empty.valid
    across = new.sum(axis=1)[new.any(axis=1)]
    assert np.median(across) * 2 == pytest.approx(width_px, abs=3.0)
    np.testing.assert_allclose(filled.points[new][:, 2], 0.0, atol=0.3)  # the background's disparity a little way on
    np.testing.assert_allclose(filled.points[empty.valid], empty.points[empty.valid], atol=1e-12)
    row = filled.valid[filled.valid.shape[0] // 2]
    assert row[np.flatnonzero(row)[0] : np.flatnonzero(row)[-1]].all()


# --- Texture noise ---


def textured_matches(albedo: FloatArray) -> Matches:
    rows, columns = albedo.shape
    index = dr.arange(mi.UInt32, rows * columns)
    zero, block = dr.zeros(mi.Float64, rows * columns), dr.zeros(mi.Int32, rows * columns)
    seen = block, zero, mi.Float32(albedo.astype(np.float32).ravel())
    return Matches(index, zero, zero, zero, dr.full(mi.Bool, True, rows * columns), *seen, columns * 4, rows * 4, 4, zero, 0.0)


def test_texture_noise_has_the_cramer_rao_bounds_variance_and_an_end_where_there_is_no_texture() -> None:
    """A ramp of g grey values per px has sum gx^2 = 25 g^2; g rises over the rows from zero."""
    steps = np.repeat(np.array([0.0, 0.3, 0.6, 1.2]), 100)
    albedo = 0.1 + np.outer(steps, np.arange(300)) * 4 / 255 / 2000
    coefficient = 25 * (0.6 / 2000) ** 2 * 0.3**2  # sigma is 0.3 px where g is 0.6 / 2000
    state = TextureNoise(coefficient=coefficient).evaluate(textured_matches(albedo), KeyedRandom(4))
    noise = state.raster()[:, 10:-10]
    for first, sigma in ((0, LARGEST_SIGMA_PX), (100, 0.6), (200, 0.3), (300, 0.15)):
        score = noise[first + 5 : first + 95] / sigma
        assert score.var() == pytest.approx(
            1.0, abs=stats.norm.isf(SIGNIFICANCE / 2) * np.sqrt(2 / score.size) + 0.02
        )  # float32 albedo
        assert abs(score.mean()) < stats.norm.isf(SIGNIFICANCE / 2) / np.sqrt(score.size)


def test_texture_noise_comes_from_the_walls_albedo() -> None:
    """A flat wall, speckled on one half (x < 0) and plain on the other."""
    wall = heightfield(40.0, 30.0, 0.1, roughness=0.0)
    vertices = wall.vertices - [20.0, 15.0, 0.0]
    speckle = np.random.default_rng(1).uniform(0.3, 0.7, len(vertices))
    mesh = replace(wall, vertices=vertices, vertex_albedo=np.where(vertices[:, 0] < 0, speckle, 0.5).astype(np.float32))
    true, noisy = (observe(mesh, effects) for effects in ([], [{"name": "texture_noise", "coefficient": 2.0}]))
    error = disparity(noisy, rig()) - disparity(true, rig())
    plain = error[true.valid & (true.points[..., 0] > 1.0)]
    assert plain.std() == pytest.approx(LARGEST_SIGMA_PX, rel=stats.norm.isf(SIGNIFICANCE / 2) / np.sqrt(2 * plain.size) + 1e-3)
    assert error[true.valid & (true.points[..., 0] < -1.0)].std() < 0.1


def test_texture_noise_on_a_wall_without_albedo_is_refused() -> None:
    with pytest.raises(InputError, match="no albedo"):
        observe(plane(NORMAL, np.zeros(3)), [{"name": "texture_noise", "coefficient": 2.0}], "low")
