"""Test ICP against known transforms, a slow reference implementation of one step, and closed forms.

Tested are also the uncertainty and each parameter's effect.
"""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm
from threadpoolctl import threadpool_info, threadpool_limits

from pipeline.registration import pairs as nearest_pairs
from pipeline.registration.closest_points import ReferenceSurface, scan_order
from pipeline.registration.register import IcpConfig, Registration, measure_fit, register, register_to
from pipeline.registration.rigid import RigidTransform, rotation_matrix
from pipeline.registration.steps import point_step
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

WIDTH, HEIGHT, SIGMA = 20.0, 12.0, 0.01
RANDOM = KeyedRandom(7, ("test_register",))
OFFSET = RigidTransform.about(np.array([10.0, 6.0, 0.0]), np.array([2e-3, -3e-3, 4e-3]), np.array([0.05, -0.04, 0.06]))
"""From the true pose to the moving cloud's; a registration has to find its inverse."""
WAVES = [(2.1, 0.3, 0.12), (3.7, 1.4, 0.25), (2.9, 2.3, 0.15), (6.3, 0.8, 0.40)]
"""Wavelength m, direction rad, amplitude m."""


def surface(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points (n, 3) and unit normals of a rough wall."""
    z, slope = np.zeros_like(x), np.zeros((2, *x.shape))
    for length, direction, amplitude in WAVES:
        wave = 2 * np.pi / length * np.array([np.cos(direction), np.sin(direction)])
        phase = wave[0] * x + wave[1] * y
        z += amplitude * np.sin(phase)
        slope += amplitude * np.cos(phase) * wave[:, None]
    normal = np.stack([-slope[0], -slope[1], np.ones_like(x)], axis=1)
    return np.stack([x, y, z], axis=1), normal / np.linalg.norm(normal, axis=1)[:, None]


def grid(spacing: float) -> tuple[FloatArray, FloatArray]:
    x, y = np.meshgrid(np.arange(0.0, WIDTH, spacing), np.arange(0.0, HEIGHT, spacing))
    return surface(x.ravel(), y.ravel())


def sample(count: int, random: KeyedRandom, sigma: float = SIGMA) -> tuple[FloatArray, FloatArray]:
    """Return points at random places, with noise along the normals, and the normals.

    The places are at least a metre inside the reference's edge.
    """
    generator = random.generator()
    x, y = generator.uniform(1, WIDTH - 1, count), generator.uniform(1, HEIGHT - 1, count)
    points, normals = surface(x, y)
    return points + sigma * generator.normal(size=(count, 1)) * normals, normals


def covariance(points: FloatArray, normals: FloatArray, sigma: float) -> FloatArray:
    """Return the covariance (6, 6) of (w, t) about the centroid, rad and m: sigma^2 (J^T J)^-1."""
    jacobian = np.hstack([np.cross(points - points.mean(axis=0), normals), normals])
    return sigma**2 * np.linalg.inv(jacobian.T @ jacobian)


def errors(result: Registration, points: FloatArray) -> FloatArray:
    """Return what is left of OFFSET (6,): rotation vector, rad, and shift of the centroid, m."""
    centroid = points.mean(axis=0)
    left = RigidTransform(result.rotation @ OFFSET.rotation, result.translation).rotation_vector
    return np.concatenate([left, result.apply(OFFSET.apply(centroid)) - centroid])


@pytest.fixture(scope="module")
def reference() -> ReferenceSurface:
    return ReferenceSurface.build(*grid(0.05))


@pytest.fixture(scope="module")
def cloud() -> tuple[FloatArray, FloatArray]:
    return sample(20_000, RANDOM.child("cloud"))


# --- known transforms ---


@pytest.mark.parametrize("method", ["point_to_plane", "point_to_point"])
@pytest.mark.parametrize("away", [0.0, 5e6])
def test_identical_points_are_recovered_exactly(method: str, away: float) -> None:
    points, normals = grid(0.3)
    shift = np.array([away, away / 2, 100.0])
    config = IcpConfig(method=method, delta_threshold=0.0)
    result = register(OFFSET.apply(points) + shift, points + shift, normals, config, RANDOM)
    rounding = 1e-9 if away == 0 else 3e-8  # 5,000 km in float64 is known to 1e-9 m, and turns with R
    np.testing.assert_allclose(result.rotation, OFFSET.rotation.T, atol=1e-9)
    np.testing.assert_allclose(result.apply(OFFSET.apply(points) + shift), points + shift, rtol=0, atol=rounding)
    assert result.converged
    assert result.rms_m < 10 * rounding


def test_other_samples_of_the_surface_within_the_noise(reference: ReferenceSurface, cloud: tuple[FloatArray, FloatArray]) -> None:
    points, normals = cloud
    result = register_to(reference, OFFSET.apply(points), IcpConfig(), RANDOM)
    # 5 sigma of the closed form, plus 0.05 mm (or that over 5 m) for the reference's facets and delta_threshold
    allowed = 5 * np.sqrt(np.diag(covariance(points, normals, SIGMA))) + np.repeat([1e-5, 5e-5], 3)
    assert np.all(np.abs(errors(result, points)) < allowed)
    assert result.rms_m == pytest.approx(SIGMA, rel=0.03)  # sigma / sqrt(2 n) is 0.5 %
    assert result.converged
    assert result.undetermined == 0


def test_scatter_is_the_closed_form(reference: ReferenceSurface) -> None:
    """50 noise draws: their spread follows chi-square, their mean is zero. False-failure rate 1e-4 for 6 + 6 tests together."""
    draws, level = 50, 1e-4 / 12
    clouds = [sample(2_000, RANDOM.child("draw", draw)) for draw in range(draws)]
    config = IcpConfig(delta_threshold=1e-6, threshold=0.0, outlier_threshold_decay_iteration=2)
    scaled = np.array(
        [
            errors(register_to(reference, OFFSET.apply(points), config, RANDOM), points)
            / np.sqrt(np.diag(covariance(points, normals, SIGMA)))
            for points, normals in clouds
        ]
    )
    low, high = chi2.ppf([level / 2, 1 - level / 2], draws)
    assert np.all((np.sum(scaled**2, axis=0) > low) & (np.sum(scaled**2, axis=0) < high))
    assert np.all(np.abs(scaled.mean(axis=0)) < norm.isf(level / 2) / np.sqrt(draws))


def test_shift_along_z_of_a_gentle_wall_scatters_by_sigma_over_root_n() -> None:
    """Var(z) = sigma^2 / n where normals are nearly z; 50 draws, false-failure rate 1e-4."""
    points, normals = grid(0.1)
    flat = np.array([1.0, 1.0, 0.05])
    normals = normals / flat
    reference = ReferenceSurface.build(points * flat, normals)
    count, shifts = 2_000, []
    for draw in range(50):
        generator = RANDOM.child("gentle", draw).generator()
        x, y = generator.uniform(1, WIDTH - 1, count), generator.uniform(1, HEIGHT - 1, count)
        moving = surface(x, y)[0] * flat + generator.normal(size=(count, 1)) * [0, 0, SIGMA]
        centroid = moving.mean(axis=0)
        moved = register_to(reference, moving, IcpConfig(outlier_threshold_decay_iteration=1), RANDOM).apply(centroid)
        shifts.append(moved[2] - centroid[2])
    low, high = chi2.ppf([0.5e-4, 1 - 0.5e-4], 50)
    assert low < np.sum(np.square(shifts)) / (SIGMA**2 / count) < high


def test_shuffled_points_give_the_same_pose(reference: ReferenceSurface, cloud: tuple[FloatArray, FloatArray]) -> None:
    """Only rounding and the random coarse subset differ, so poses agree to delta_threshold."""
    moving = OFFSET.apply(cloud[0])
    shuffled = moving[RANDOM.child("shuffle").generator().permutation(len(moving))]
    config = IcpConfig(delta_threshold=1e-6, threshold=0.0)
    one, two = (register_to(reference, points, config, RANDOM) for points in (moving, shuffled))
    np.testing.assert_allclose(one.apply(moving), two.apply(moving), atol=2e-5)


# --- one step against an obvious twin ---


def pairs() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Moving points, a reference with normals, and the index of the nearest reference point to each, by brute force."""
    points, normals = grid(0.5)
    moving = OFFSET.apply(sample(300, RANDOM.child("oracle"))[0])
    return moving, points, normals, cdist(moving, points).argmin(axis=1)


def one_step(method: str, moving: FloatArray, points: FloatArray, normals: FloatArray) -> Registration:
    return register(moving, points, normals, IcpConfig(method=method, max_iteration=1, remove_outlier=False), RANDOM)


def test_a_point_to_plane_step_is_the_least_squares_solution() -> None:
    moving, points, normals, nearest = pairs()
    result = one_step("point_to_plane", moving, points, normals)
    n, offset, arm = normals[nearest], points[nearest] - moving, moving - moving.mean(axis=0)
    solution, squares, _, _ = np.linalg.lstsq(np.hstack([np.cross(arm, n), n]), np.sum(n * offset, axis=1))
    expected = RigidTransform.about(moving.mean(axis=0), solution[:3], solution[3:])
    np.testing.assert_allclose(result.rotation, expected.rotation, atol=1e-12)
    np.testing.assert_allclose(result.translation, expected.translation, atol=1e-11)
    assert result.rms_m == pytest.approx(np.sqrt(squares[0] / len(moving)), rel=1e-9)
    assert result.history[0].step_m == pytest.approx(np.sqrt(np.mean(np.sum((expected.apply(moving) - moving) ** 2, 1))))


def test_a_point_to_point_step_is_scipys_alignment() -> None:
    moving, points, normals, nearest = pairs()
    result = one_step("point_to_point", moving, points, normals)
    target = points[nearest]
    expected, distance = Rotation.align_vectors(target - target.mean(axis=0), moving - moving.mean(axis=0))
    np.testing.assert_allclose(result.rotation, expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(result.apply(moving.mean(axis=0)), target.mean(axis=0), atol=1e-12)
    assert result.rms_m == pytest.approx(distance / np.sqrt(len(moving)), rel=1e-9)


def test_no_reflection() -> None:
    """Pairs that a mirror image in x would match best still give a proper rotation."""
    p = RANDOM.child("mirror").generator().normal(size=(50, 3))
    columns = np.vstack([p.T, (p * [-1, 1, 1] - p).T, np.ones((1, 50))])
    assert np.linalg.det(point_step(columns @ columns.T).rotation) == pytest.approx(1.0)


def test_fit_counts_and_measures(reference: ReferenceSurface, cloud: tuple[FloatArray, FloatArray]) -> None:
    points = cloud[0] + [0, 0, 1.0] * (np.arange(len(cloud[0])) % 4 == 0)[:, None]
    result = measure_fit(reference, points, IcpConfig())
    assert result.points == len(points)
    assert result.inliers == len(points) * 3 // 4
    assert result.rms_m == pytest.approx(SIGMA, rel=0.03)
    assert np.isnan(measure_fit(reference, points + np.array([0, 0, 9.0]), IcpConfig()).rms_m)


# --- outliers and degenerate surfaces ---


def niche(cloud: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Return the cloud with a niche 0.3 m deep (missing rock: -z) in the 5 % of its points nearest to a corner."""
    points = cloud[0].copy()
    distance = np.hypot(points[:, 0] - 1, points[:, 1] - 1)
    points[distance <= np.quantile(distance, 0.05), 2] -= 0.3
    return points


def test_a_niche_biases_only_without_outlier_removal(reference: ReferenceSurface, cloud: tuple[FloatArray, FloatArray]) -> None:
    moving = OFFSET.apply(niche(cloud))
    kept, removed = (register_to(reference, moving, IcpConfig(remove_outlier=flag), RANDOM) for flag in (False, True))
    allowed = 5 * np.sqrt(np.diag(covariance(*cloud, SIGMA))) + np.repeat([1e-5, 5e-5], 3)
    assert np.all(np.abs(errors(removed, cloud[0])) < 2 * allowed)  # twice: points at the niche's rim lie within the threshold
    assert removed.inliers == pytest.approx(0.95 * removed.points, rel=0.01)
    assert abs(errors(kept, cloud[0])[5]) > 0.005  # 5 % of 0.3 m is 0.015 m
    assert kept.inliers == kept.points
    last = removed.history[-1]
    squares = last.inliers * last.rms_m**2 + (last.points - last.inliers) * last.outlier_threshold_m**2
    assert last.error_m == pytest.approx(np.sqrt(squares / last.points), rel=1e-12)
    assert kept.to_dict()["history"][0]["outlier_threshold_m"] is None


def test_a_plane_determines_three_motions_and_the_rest_stays_still() -> None:
    x, y = np.meshgrid(np.arange(0, 10, 0.25), np.arange(0, 8, 0.25))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    tilt = RigidTransform.about(points.mean(axis=0), np.array([0.01, -0.02, 0.0]), np.array([0.0, 0.0, 0.07]))
    moving = tilt.apply(points[::3])
    result = register(moving, points, np.broadcast_to([0.0, 0.0, 1.0], points.shape), IcpConfig(), RANDOM)
    assert result.undetermined == 3
    assert result.converged
    np.testing.assert_allclose(result.apply(moving)[:, 2], 0, atol=1e-9)
    np.testing.assert_allclose(result.apply(moving)[:, :2], points[::3, :2], atol=5e-3)  # of the order of 0.07 m x 0.02 rad
    assert abs(result.transform.rotation_vector[2]) < 1e-3
    again = register(points[::3], points, None, IcpConfig(method="point_to_point"), RANDOM)
    np.testing.assert_allclose(again.transform.rotation, np.eye(3), atol=1e-12)


# --- the parameters ---


def run(reference: ReferenceSurface, cloud: tuple[FloatArray, FloatArray], **values: object) -> Registration:
    return register_to(reference, OFFSET.apply(cloud[0]), IcpConfig(**values), RANDOM)


def test_max_iteration_ends_the_search(reference: ReferenceSurface, cloud: tuple[FloatArray, FloatArray]) -> None:
    result = register_to(reference, OFFSET.apply(np.tile(cloud[0], (2, 1))), IcpConfig(max_iteration=3), RANDOM)
    assert (result.iterations, result.converged, result.points) == (3, False, 40_000)
    assert [record.points for record in result.history] == [8192, 8192, 40_000]
    assert "max_iteration = 3" in result.reason


def test_outlier_distance_threshold_decides_who_counts(reference: ReferenceSurface, cloud: tuple[FloatArray, FloatArray]) -> None:
    moving = OFFSET.apply(niche(cloud))
    inliers = [register_to(reference, moving, IcpConfig(outlier_distance_threshold=t), RANDOM).inliers for t in (0.02, 0.1, 0.5)]
    assert inliers[0] < inliers[1] < inliers[2] == len(moving)


def test_outlier_threshold_halves_until_its_iteration(reference: ReferenceSurface, cloud: tuple[FloatArray, FloatArray]) -> None:
    result = run(reference, cloud, outlier_distance_threshold=0.1, outlier_threshold_decay_iteration=4, delta_threshold=0.05)
    assert [record.outlier_threshold_m for record in result.history[:4]] == [0.8, 0.4, 0.2, 0.1]
    assert result.iterations >= 4  # delta_threshold is met at once, but not asked before
    far = RigidTransform(np.eye(3), np.array([0.0, 0.0, 0.4])).apply(cloud[0])
    with pytest.raises(InputError, match="outlier_distance_threshold"):
        register_to(reference, far, IcpConfig(outlier_threshold_decay_iteration=1), RANDOM)
    found = register_to(reference, far, IcpConfig(outlier_threshold_decay_iteration=5), RANDOM)
    np.testing.assert_allclose(found.apply(far), cloud[0], atol=2e-3)


def test_threshold_and_delta_threshold_end_the_search(reference: ReferenceSurface, cloud: tuple[FloatArray, FloatArray]) -> None:
    never = {"threshold": 0.0, "delta_threshold": 0.0, "max_iteration": 12, "method": "point_to_point"}
    never["outlier_threshold_decay_iteration"] = 1
    endless = run(reference, cloud, **never)
    by_threshold = run(reference, cloud, **(never | {"threshold": 1e-3}))
    by_delta = run(reference, cloud, **(never | {"delta_threshold": 5e-3}))
    assert not endless.converged
    assert by_threshold.converged
    assert "than threshold = 0.001" in by_threshold.reason
    assert by_delta.converged
    assert "delta_threshold = 0.005" in by_delta.reason
    assert by_threshold.iterations < endless.iterations
    assert by_delta.iterations < endless.iterations
    assert by_delta.history[-1].residual_change_m < 5e-3 <= by_delta.history[-2].residual_change_m


def test_subsampling_leaves_the_share_out(reference: ReferenceSurface, cloud: tuple[FloatArray, FloatArray]) -> None:
    everything = run(reference, cloud, subsample_ratio=0.75)
    quarter = run(reference, cloud, subsample_points=True, subsample_ratio=0.75)
    tenth = run(reference, cloud, subsample_points=True, subsample_ratio=0.9)
    assert (everything.points, quarter.points, tenth.points) == (20_000, 5_000, 2_000)
    others = register_to(
        reference, OFFSET.apply(cloud[0]), IcpConfig(subsample_points=True, subsample_ratio=0.75), RANDOM.child("other")
    )
    assert not np.array_equal(others.translation, quarter.translation)
    allowed = 5 * np.sqrt(np.diag(covariance(*cloud, SIGMA)) * 10) + np.repeat([1e-5, 5e-5], 3)
    assert np.all(np.abs(errors(tenth, cloud[0])) < allowed)


# --- input errors ---


def test_errors_name_what_is_wrong(reference: ReferenceSurface) -> None:
    points, normals = grid(1.0)
    line = np.arange(50.0)[:, None] * [1.0, 2.0, 0.0]
    holes = np.where(np.arange(len(points))[:, None] == 3, np.nan, points)
    cases: list[tuple[FloatArray, FloatArray, FloatArray | None, dict[str, object], str]] = [
        (np.zeros((0, 3)), points, normals, {}, "moving points: 0 points are too few"),
        (points[:5], points, normals, {}, "moving points: 5 points are too few"),
        (points, points[:5], normals[:5], {}, "reference points: 5 points"),
        (points[:, :2], points, normals, {}, r"not \(n, 3\)"),
        (holes, points, normals, {}, "moving points: 1 of 240 points have coordinates that are NaN or infinite; remove"),
        (line, points, normals, {}, "moving points: the points lie on one line"),
        (points, points, normals[:-1], {}, r"reference normals: the array has the shape \(239, 3\), not \(240, 3\)"),
        (points, points, normals * 0, {}, "reference normals: 240 of 240 normals are zero"),
        (points, points, None, {}, "icp.method: point_to_plane needs"),
        (
            points,
            points,
            normals,
            {"subsample_points": True, "subsample_ratio": 0.99},
            "icp.subsample_ratio: the subsample would leave only 2 of 240",
        ),
        (points + 0.4, points, normals, {"outlier_distance_threshold": 1e-4}, "icp.outlier_distance_threshold: only"),
    ]
    for moving, target, directions, values, message in cases:
        with pytest.raises(InputError, match=message):
            register(moving, target, directions, IcpConfig(**values), RANDOM)


# --- repeatability and results ---


def test_threads_do_not_change_a_bit(reference: ReferenceSurface) -> None:
    moving = OFFSET.apply(sample(50_000, RANDOM.child("threads"))[0])
    for method in ("point_to_plane", "point_to_point"):
        one, two = (
            register_to(reference, moving, IcpConfig(method=method, max_iteration=8), RANDOM, threads=count) for count in (1, 2)
        )
        assert json.dumps(one.to_dict()) == json.dumps(two.to_dict())


@pytest.mark.parametrize("method", ["point_to_plane", "point_to_point"])
@pytest.mark.parametrize("remove_outlier", [True, False])
def test_kept_pairs_are_those_of_a_full_search(
    method: str, remove_outlier: bool, reference: ReferenceSurface, monkeypatch: pytest.MonkeyPatch
) -> None:
    moving = OFFSET.apply(sample(50_000, RANDOM.child("kept"))[0])
    moving[::50, 2] += 0.09  # some points are outliers only once the outlier threshold has decayed
    config = IcpConfig(method=method, remove_outlier=remove_outlier, delta_threshold=1e-9, threshold=1e-13, max_iteration=30)
    kept = register_to(reference, moving, config, RANDOM)
    monkeypatch.setattr(nearest_pairs, "_ROUNDING_M", np.inf)  # no point may keep its pair
    assert json.dumps(register_to(reference, moving, config, RANDOM).to_dict()) == json.dumps(kept.to_dict())


def test_most_points_keep_their_pairs(reference: ReferenceSurface) -> None:
    class CountingTree:
        searched = 0

        def query(self, points: FloatArray, neighbours: int, limit: float) -> Any:
            self.searched += len(points)
            return reference.tree.query(points, neighbours, limit)

    tree: Any = CountingTree()
    moving = OFFSET.apply(sample(20_000, RANDOM.child("again"))[0])
    config = IcpConfig(method="point_to_point", delta_threshold=1e-9, threshold=1e-13, max_iteration=30)
    found = register_to(dataclasses.replace(reference, tree=tree), moving, config, RANDOM, threads=1)
    assert found.iterations > 10
    assert tree.searched < 0.5 * found.iterations * len(moving)


def test_blas_threads_do_not_change_a_bit() -> None:
    points = np.stack([*np.random.default_rng(3).uniform(0, 9, (2, 40_000)), np.zeros(40_000)], axis=1)
    points[:, 2] = np.sin(points[:, 0]) * np.cos(points[:, 1])
    config = IcpConfig(method="point_to_point", max_iteration=6, outlier_distance_threshold=0.5)
    found = []
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            assert {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"} == {threads}
            found.append(register(points[::2] + 0.02, points, None, config, KeyedRandom(1)).to_dict())
    assert found[0] == found[1]


def test_scan_order_sorts_only_what_is_scattered() -> None:
    points = grid(0.1)[0]
    assert scan_order(points) == slice(None)
    shuffled = points[RANDOM.child("scan").generator().permutation(len(points))]
    order = scan_order(shuffled)
    assert isinstance(order, np.ndarray)
    assert np.array_equal(np.sort(order), np.arange(len(points)))
    assert np.abs(np.diff(shuffled[order], axis=0)).mean() < 0.05 * np.abs(np.diff(shuffled, axis=0)).mean()


def test_result_is_plain_json(reference: ReferenceSurface, cloud: tuple[FloatArray, FloatArray]) -> None:
    result = run(reference, cloud)
    values = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    np.testing.assert_array_equal(values["rotation"], result.rotation)
    assert values["iterations"] == len(values["history"])
    assert "converged after" in result.summary()


def test_rigid_transform_conventions() -> None:
    vector = np.array([0.3, -0.2, 0.5])
    np.testing.assert_allclose(rotation_matrix(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)
    np.testing.assert_array_equal(rotation_matrix(np.zeros(3)), np.eye(3))
    move = RigidTransform.about(np.array([1.0, 2.0, 3.0]), vector, np.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(move.apply(np.array([1.0, 2.0, 3.0])), [1.1, 2.0, 3.0], atol=1e-15)
    np.testing.assert_allclose(move.rotation_vector, vector, atol=1e-15)
    np.testing.assert_allclose(move.inverse().apply(move.apply(np.eye(3))), np.eye(3), atol=1e-15)


def test_rounded_arrays_are_refused() -> None:
    """Projected coordinates in single precision have steps of half a metre."""
    from pipeline import register as register_surfaces

    offset = np.array([345_200.0, 5_389_450.0, 120.0])
    points = np.random.default_rng(5).uniform([0, 0, 0], [20, 2, 10], (2000, 3)) + offset
    with pytest.raises(InputError, match="single precision"):
        register_surfaces(points.astype(np.float32), points)
