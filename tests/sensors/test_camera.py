"""The camera model against OpenCV's, its inverse, the camera effects and rectification."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from scene.common.errors import InputError
from sensors.cameras.camera import INTERIOR, Camera, CameraPair, axis_rotation
from sensors.cameras.rectification import rectify
from sensors.effects import STEREO_EFFECTS
from sensors.effects.base import Stage
from sensors.models.placement import look_at

LENS = {"b1": 1.2, "b2": -0.5, "k1": -0.05, "k2": 0.04, "k3": 0.01, "k4": 0.02, "p1": 0.001, "p2": -0.0005}


def camera(**changes: float) -> Camera:
    aim = look_at(np.array([-14.0, -105.0, 20.0]), np.array([0.0, 0.0, 22.0]))
    values = {"f_px": 10250.0, "cx_px": 51.4, "cy_px": -7.0, **LENS, **changes}
    return Camera(7360, 4912, **values, position=np.array([-14.0, -105.0, 20.0]), rotation=aim)


def frame_pixels(one: Camera) -> tuple[np.ndarray, np.ndarray]:
    return tuple(axis.ravel() for axis in np.meshgrid(np.linspace(0, one.width, 40), np.linspace(0, one.height, 30)))


def test_the_inverse_is_exact_over_the_frame() -> None:
    one = camera()
    u, v = frame_pixels(one)
    back = one.pixel(*one.tangents(u, v))
    np.testing.assert_allclose(np.stack(back), np.stack([u, v]), rtol=0, atol=1e-9)


def test_the_model_is_opencvs_where_both_have_the_parameters() -> None:
    """OpenCV has p1 and p2 exchanged, pixel centres at integers, no k4 and no b2; b1 widens fx."""
    one = camera(k4=0.0, b2=0.0)
    x, y = np.random.default_rng(1).uniform(-0.3, 0.3, (2, 500))
    matrix = np.array(
        [[one.f_px + one.b1, 0, one.width / 2 + one.cx_px - 0.5], [0, one.f_px, one.height / 2 + one.cy_px - 0.5], [0, 0, 1]]
    )
    coefficients = np.array([one.k1, one.k2, one.p2, one.p1, one.k3])
    expected, _ = cv2.projectPoints(np.stack([x, y, np.ones_like(x)], axis=1), np.zeros(3), np.zeros(3), matrix, coefficients)
    np.testing.assert_allclose(np.stack(one.pixel(x, y), axis=1) - 0.5, expected[:, 0], rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", INTERIOR)
def test_every_interior_parameter_moves_pixels_as_its_finite_difference_says(name: str) -> None:
    """The expected values come from the documented model, implemented again term by term."""
    x, y = np.array([0.21, -0.17]), np.array([-0.13, 0.08])
    for one in (camera(), replace(camera(), **{name: getattr(camera(), name) + 0.01})):
        r2 = x**2 + y**2
        radial = 1 + one.k1 * r2 + one.k2 * r2**2 + one.k3 * r2**3 + one.k4 * r2**4
        xd = x * radial + one.p1 * (r2 + 2 * x**2) + 2 * one.p2 * x * y
        yd = y * radial + one.p2 * (r2 + 2 * y**2) + 2 * one.p1 * x * y
        u = one.width / 2 + one.cx_px + xd * one.f_px + xd * one.b1 + yd * one.b2
        v = one.height / 2 + one.cy_px + yd * one.f_px
        np.testing.assert_allclose(np.stack(one.pixel(x, y)), np.stack([u, v]), rtol=0, atol=1e-9)


def test_a_distortion_that_folds_the_image_is_refused() -> None:
    with pytest.raises(InputError, match="folds the image"):
        camera(k1=-5.0).check_invertible()


@pytest.mark.parametrize(
    "effect", [kind for kind in STEREO_EFFECTS if kind.stage == Stage.CAMERA], ids=lambda kind: kind.__name__
)
def test_a_camera_effect_changes_the_side_it_names_and_nothing_at_its_null(effect: type) -> None:
    pair = CameraPair(camera(), camera())
    assert effect().apply(pair, None) is pair
    parameters = {name: 1e-3 for name in effect.model_fields if name not in ("name", "camera")}
    changed = effect(camera="left", **parameters).apply(pair, None)
    assert changed.right is pair.right
    assert any(
        not np.array_equal(getattr(changed.left, key), getattr(pair.left, key)) for key in (*INTERIOR, "position", "rotation")
    )


@pytest.mark.parametrize(("axis", "name"), [(0, "CameraOmega"), (1, "CameraPhi"), (2, "CameraKappa")])
def test_rotations_turn_about_the_cameras_own_axis_by_the_right_hand_rule(axis: int, name: str) -> None:
    effect = next(kind for kind in STEREO_EFFECTS if kind.__name__ == name)
    pair = CameraPair(camera(), camera())
    turned = effect(camera="right", angle_rad=0.3).apply(pair, None).right
    own_axis = pair.right.rotation[:, axis]
    expected = cv2.Rodrigues(0.3 * own_axis)[0] @ pair.right.rotation  # the same turn, said in the outer frame
    np.testing.assert_allclose(turned.rotation, expected, atol=1e-12)


def test_rectification_puts_corresponding_points_on_one_row_with_the_closed_form_disparity() -> None:
    """Random points in front of a convergent pair: equal v, and d - d_inf = f B / z with z along the rectified axis."""
    left = camera()
    right_position = np.array([14.0, -104.0, 20.5])
    right = replace(
        camera(cx_px=-9.0),
        position=right_position,
        rotation=look_at(right_position, np.array([1.0, 0.0, 22.0])) @ axis_rotation(2, 0.01),
    )
    geometry = rectify(CameraPair(left, right))
    points = np.random.default_rng(2).uniform([-30, -3, 0], [30, 3, 40], (200, 3))
    rectified_left = (points - left.position) @ left.rotation @ geometry.left.T
    rectified_right = (points - right.position) @ right.rotation @ geometry.right.T
    v_left, v_right = (local[:, 1] / local[:, 2] for local in (rectified_left, rectified_right))
    np.testing.assert_allclose(v_left, v_right, atol=1e-12)
    disparity = geometry.f * (rectified_left[:, 0] / rectified_left[:, 2] - rectified_right[:, 0] / rectified_right[:, 2])
    np.testing.assert_allclose(disparity, geometry.f * geometry.base_m / rectified_left[:, 2], rtol=1e-12)
    assert geometry.base_m == pytest.approx(np.linalg.norm(right.position - left.position), rel=1e-12)


def test_swapped_or_coinciding_cameras_are_refused() -> None:
    left, right = camera(), replace(camera(), position=camera().position + np.array([28.0, 0, 0]))
    with pytest.raises(InputError, match="exchange the cameras left and right"):
        rectify(CameraPair(right, left))
    with pytest.raises(InputError, match="same place"):
        rectify(CameraPair(left, left))
