"""Predict what a stereo pair achieves at places on the wall.

Predicted are the GSD, the base-to-distance ratio, the convergence and the precision of the intersection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.precision.detectability import Sampling, lattice
from pipeline.precision.surface import BoolArray, Places, rotate_vectors, surface_shift
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Camera, CameraPair, Side
from sensors.cameras.rectification import Rectification, rectify
from sensors.effects.base import Stage, apply_stage
from sensors.effects.matching_noise import NodeNoise
from sensors.models.sensor_model import DrawnParameter, OrientationNoise, StereoModel
from sensors.stereo.stereo_pair import REDUCTION, StereoPair


@dataclass(frozen=True)
class StereoGeometry:
    """Store resolution and precision of a stereo pair at n places of a wall, as if nothing obstructed the view.

    All attributes are (n,) arrays unless noted.

    Attributes
    ----------
    distance_m
        Distance from the middle of the base, m.
    gsd_m
        Ground sampling distance: side of the square that has the area of a pixel of the left image on the surface, m.
    cell_m
        Side of that square for a pixel of the depth map, which may be coarser than the image's, m.
    base_to_distance
        Distance between the cameras divided by `distance_m`.
    convergence_rad
        Angle between the rays from both cameras, rad.
    incidence_rad
        Angle of incidence of the more oblique ray, rad.
    covariance : (n, 3, 3)
        Covariance of a point from matching and image noise, wall frame, m2.
    orientation_covariance : (n, 3, 3)
        Covariance of a point from the noise of the cameras' orientation, wall frame, m2. All points of an observation share
        this error, and the registration largely removes it.
    normal_sigma_m
        Standard deviation of a point along the surface's normal from matching and image noise, m.
    in_left, in_right
        Whether the place is within the frame of the left and of the right image.
    sampling : Sampling
        How densely and precisely the pair samples the surface: what `detection_probability` of a fallen block needs.
    """

    distance_m: FloatArray
    gsd_m: FloatArray
    cell_m: FloatArray
    base_to_distance: FloatArray
    convergence_rad: FloatArray
    incidence_rad: FloatArray
    covariance: FloatArray
    orientation_covariance: FloatArray
    normal_sigma_m: FloatArray
    in_left: BoolArray
    in_right: BoolArray
    sampling: Sampling


@dataclass(frozen=True)
class DisparityNoise:
    """Summarise the noise of the disparities of a stereo pair, to predict the precision of its points.

    A stereo matcher interpolates part of the noise between widely spaced pixels (nodes of a grid); neighbouring points share
    this grid-correlated noise.

    Attributes
    ----------
    white : float
        Standard deviation of the noise that is independent from pixel to pixel, px.
    smooth : float
        Standard deviation of the grid-correlated noise, averaged over positions, px.
    step : float
        Distance between the nodes of the grid-correlated noise, px; infinite if there is none.
    """

    white: float
    smooth: float
    step: float

    @classmethod
    def of(cls, model: StereoModel) -> DisparityNoise:
        """Summarise the matching noise of a stereo sensor model: variances of independent and of correlated terms are added.

        If several correlated terms have grids of nodes, the largest distance between nodes is used.
        """
        noise = [effect for effect in model.matching_noise if not effect.is_null]
        white, smooth = (sum(each.total_variance for each in noise if each.shared == shared) for shared in (False, True))
        step = max((each.step_px for each in noise if isinstance(each, NodeNoise)), default=np.inf)
        return cls(float(np.sqrt(white)), float(np.sqrt(smooth)), step)


def stereo_geometry(pair: StereoPair, places: Places, image_sigma_px: float = 0.0) -> StereoGeometry:
    """Compute resolution and precision of a stereo pair at n places of a wall, by error propagation instead of simulation.

    It predicts what a planned pair can measure.

    Parameters
    ----------
    pair : StereoPair
        The cameras in front of the wall, with their sensor model.
    places : Places
        Positions and normals of the places, wall frame.
    image_sigma_px : float
        Standard deviation of each coordinate of measured image points, in addition to the sensor model's matching noise, px.
    """
    nominal = pair.cameras.in_wall_frame(pair.frame)
    noise = DisparityNoise.of(pair.model)
    along = _intersection(nominal, places.points)
    matching = np.einsum("ni,nj->nij", along.by_disparity, along.by_disparity) * (noise.white**2 + noise.smooth**2)
    covariance = matching + image_sigma_px**2 * along.by_image_noise()
    normal_by_disparity = np.abs(np.einsum("ni,ni->n", along.by_disparity, places.normals))
    normal_variance = np.einsum("ni,nij,nj->n", places.normals, covariance, places.normals)
    smooth = normal_by_disparity * noise.smooth
    by_u, by_v = _pixel_steps(nominal.left, places)
    gsd, cell = np.sqrt(np.linalg.norm(np.cross(by_u, by_v), axis=1)), REDUCTION[pair.quality]
    sights = [places.points - camera.position for camera in (nominal.left, nominal.right)]
    steps = lattice(by_u * cell, by_v * cell, places.normals, sights)
    middle = (nominal.left.position + nominal.right.position) / 2
    distance = np.linalg.norm(places.points - middle, axis=1)
    return StereoGeometry(
        distance_m=distance,
        gsd_m=gsd,
        cell_m=gsd * cell,
        base_to_distance=nominal.base_m / distance,
        convergence_rad=_angle(*sights),
        incidence_rad=np.maximum(*(_angle(-sight, places.normals) for sight in sights)),
        covariance=covariance,
        orientation_covariance=orientation_covariance(pair, places.points),
        normal_sigma_m=np.sqrt(normal_variance),
        in_left=_in_frame(nominal.left, places.points),
        in_right=_in_frame(nominal.right, places.points),
        sampling=Sampling(
            **steps,
            white=np.sqrt(np.maximum(normal_variance - smooth**2, 0.0)),
            smooth=smooth,
            grain_a=steps["step_a"] / cell * noise.step,
            grain_b=steps["step_b"] / cell * noise.step,
        ),
    )


@dataclass(frozen=True)
class _Derivatives:
    """Derivatives of a point by its rectified image coordinates, (n, 3) each, wall frame, m/px.

    Attributes
    ----------
    by_disparity
        By the disparity d = u_l - u_r.
    by_u
        By u_l at fixed disparity.
    by_v
        By the row v.
    """

    by_disparity: FloatArray
    by_u: FloatArray
    by_v: FloatArray

    def by_image_noise(self) -> FloatArray:
        """Return the covariance (n, 3, 3) of the least-squares intersection for image noise, m2/px2.

        The noise is 1 px in each of u_l, v_l, u_r, v_r. In the rectified pair both rows measure the same unknown, so their mean
        counts, with half the variance.
        """
        left = self.by_u + self.by_disparity
        terms = ((1.0, left), (1.0, self.by_disparity), (0.5, self.by_v))
        return np.sum([weight * np.einsum("ni,nj->nij", vector, vector) for weight, vector in terms], axis=0)


def _intersection(nominal: CameraPair, points: FloatArray) -> _Derivatives:
    """Compute the derivatives of the forward intersection in the rectified pair.

    z = f B / d, x = u z / f, y = v z / f, so dP/dd = -(x, y, z) z / (f B), whose z part is Kraus' Z^2 / (c B) of the normal
    case, dP/du = (z/f, 0, 0) and dP/dv = (0, z/f, 0).
    """
    geometry = rectify(nominal)
    to_wall = nominal.left.rotation @ geometry.left.T
    local = rotate_vectors(to_wall.T, points - nominal.left.position)
    z = local[:, 2:]
    by_disparity = -local * z / (geometry.f * geometry.base_m)
    return _Derivatives(rotate_vectors(to_wall, by_disparity), z / geometry.f * to_wall[:, 0], z / geometry.f * to_wall[:, 1])


def orientation_covariance(pair: StereoPair, points: FloatArray) -> FloatArray:
    """Compute by error propagation the covariance of a stereo pair's points due to the noise of both cameras' orientation.

    Each orientation parameter in turn is changed by its standard deviation, in one camera, or in both if its error is common to
    them. The point is projected with the changed cameras and intersected with the unchanged ones. The outer product of the
    shift with itself is added to the covariance.

    Parameters
    ----------
    pair : StereoPair
        The cameras in front of the wall, with their sensor model.
    points : (n, 3) array
        Points, wall frame, m.

    Returns
    -------
    (n, 3, 3) array
        Covariances, wall frame, m2.
    """
    covariance = np.zeros((len(points), 3, 3))
    noise, nominal = pair.model.noise.orientation, pair.cameras.in_wall_frame(pair.frame)
    geometry = rectify(nominal)
    sides: tuple[Side, ...] = ("both",) if pair.model.noise.orientation_drawn == "both_alike" else ("left", "right")
    for side in sides:
        for name in type(noise).model_fields:
            sigma = getattr(noise, name).sigma
            if sigma > 0:
                moved = OrientationNoise(**{name: DrawnParameter(mean=sigma)}).draw(side, KeyedRandom(0))
                real = apply_stage(moved, Stage.CAMERA, pair.cameras, KeyedRandom(0)).in_wall_frame(pair.frame)
                error = _recorded(nominal, geometry, real, points) - points
                covariance += np.einsum("ni,nj->nij", error, error)
    return covariance


def _recorded(nominal: CameraPair, geometry: Rectification, real: CameraPair, points: FloatArray) -> FloatArray:
    """Return where the nominal calibration puts points that the real cameras see, (n, 3), wall frame, m."""
    left = _rectified_tangents(nominal.left, geometry.left, *_project(real.left, points))
    right = _rectified_tangents(nominal.right, geometry.right, *_project(real.right, points))
    z = geometry.base_m / (left[0] - right[0])
    local = np.stack([left[0] * z, left[1] * z, z], axis=1)
    return rotate_vectors(nominal.left.rotation @ geometry.left.T, local) + nominal.left.position


def _rectified_tangents(camera: Camera, rotation: FloatArray, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Convert pixels to tangents in the rectified frame."""
    x, y = camera.tangents(u, v)
    ray = rotate_vectors(rotation, np.stack([x, y, np.ones_like(x)], axis=1))
    return ray[:, 0] / ray[:, 2], ray[:, 1] / ray[:, 2]


def _project(camera: Camera, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the pixels (u, v) of points (n, 3)."""
    local = rotate_vectors(camera.rotation.T, points - camera.position)
    return camera.pixel(local[:, 0] / local[:, 2], local[:, 1] / local[:, 2])


def _in_frame(camera: Camera, points: FloatArray) -> BoolArray:
    """Return whether points (n,) lie in front of the camera and on its frame."""
    depth = np.einsum("ni,i->n", points - camera.position, camera.rotation[:, 2])
    with np.errstate(all="ignore"):
        u, v = _project(camera, points)
        return (depth > 0) & (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)


def _pixel_steps(camera: Camera, places: Places) -> tuple[FloatArray, FloatArray]:
    """Return how far one frame pixel to the right, and one down, extend on the surface, (n, 3) each, m (central differences)."""
    local = rotate_vectors(camera.rotation.T, places.points - camera.position)
    u, v = _project(camera, places.points)
    steps = []
    for du, dv in ((0.5, 0.0), (0.0, 0.5)):
        (x_0, y_0), (x_1, y_1) = camera.tangents(u - du, v - dv), camera.tangents(u + du, v + dv)
        turn = np.stack([x_1 - x_0, y_1 - y_0, np.zeros_like(u)], axis=1) * local[:, 2:]
        steps.append(surface_shift(places.points - camera.position, rotate_vectors(camera.rotation, turn), places.normals))
    return steps[0], steps[1]


def _angle(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the angle (n,) between vectors (n, 3), rad."""
    return np.arctan2(np.linalg.norm(np.cross(first, second), axis=1), np.einsum("ni,ni->n", first, second))
