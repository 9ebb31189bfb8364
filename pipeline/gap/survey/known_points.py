"""Describe points of known position that a survey could measure in addition to the wall.

Compute what they say about effects and pose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.gap.mean.candidates import Candidate
from pipeline.gap.residuals.nominal_pair import NominalPair, moved_pair, project, real_pair
from pipeline.gap.residuals.ray_hits import RayGeometry
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from pipeline.gap.survey.survey_views import StereoView, TlsView
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import CameraPair
from sensors.effects import effect_of
from sensors.effects.base import Effect
from sensors.signal_chain.polar import polar_axes

_TARGETS = 12
"""Number of targets around a scanner."""
_TARGET_SIGMA_M = 0.001
"""Standard deviation of a target's position, m."""
_CHECK_ROWS, _CHECK_COLUMNS = 4, 6
"""Rows and columns of check points across the frame of a pair."""
_CHECK_SIGMA_PX = 0.1
"""Standard deviation of an image coordinate of a check point, px."""
_CHECK_DEPTHS = (0.7, 1.0)
"""Depths of the check points relative to that of the wall, alternating."""
_STEP = 0.01
"""Step of the finite differences, relative to a parameter's typical value."""


@dataclass(frozen=True)
class KnownPoints:
    """Additional observations of points with known positions, such as targets, and how sensor effects change them.

    They are used to find out how well an effect can be detected if a survey adds such points.

    Attributes
    ----------
    title : The points, in words.
    pose_jacobian : (n, 6) derivatives of the observations by the pose of the first station or pair: shift (m) and rotation
        (rad).
    sigma : (n,) standard deviations of the observations, m (ranges) or px (image coordinates).
    columns : Function that takes a list of effects and returns the (n, k) changes of the observations per unit of each of the k
        coefficients of all these effects.
    """

    title: str
    pose_jacobian: FloatArray
    sigma: FloatArray
    columns: Callable[[list[Candidate]], FloatArray]


def known_points(view: TlsView | StereoView) -> KnownPoints:
    """Return observations of points with known positions that a survey could add, to find out how much they would help.

    They are twelve targets around a laser scanner, or 24 check points in front of a stereo pair.

    Parameters
    ----------
    view : What the first scanner station or stereo pair sees of the wall.
    """
    return _targets(view) if isinstance(view, TlsView) else _check_points(view)


def _targets(view: TlsView) -> KnownPoints:
    """Twelve targets around the station.

    A point that is known in three dimensions gives as much information as three orthogonal planes through it. They are equally
    inclined to the ray here, so the signatures of ranges can be used.
    """
    from pipeline.gap.survey.survey_design import signature_columns

    g = view.residuals.geometry
    azimuth = float(g.azimuth.mean()) + 2 * np.pi * np.arange(_TARGETS) / _TARGETS
    zenith = np.pi / 2 - np.tile([-0.25, 0.1, 0.45], _TARGETS)[:_TARGETS]
    distance = float(np.median(g.range_m)) * np.tile([0.25, 0.5, 0.75, 1.0], _TARGETS)[:_TARGETS]
    azimuth, zenith, distance = (np.repeat(each, 3) for each in (azimuth, zenith, distance))
    angle = np.tile(2 * np.pi * np.arange(3) / 3, _TARGETS)
    across, along = (
        np.sqrt(2.0) * np.cos(angle),
        np.sqrt(2.0) * np.sin(angle),
    )  # components of the planes' normals across the ray, relative to that along it
    by_azimuth, by_zenith = -distance * across * np.sin(zenith), -distance * along
    ray, right, down = polar_axes(azimuth, zenith)
    turn = view.measurement.station[1]
    normal = np.einsum("ij,nj->ni", turn, ray + across[:, None] * right + along[:, None] * down)
    ray = np.einsum("ij,nj->ni", turn, ray)
    pose = np.concatenate([-normal, -distance[:, None] * np.cross(ray, normal)], axis=1)
    geometry = RayGeometry(
        azimuth,
        zenith,
        range_m=distance,
        measured_m=distance,
        by_azimuth=by_azimuth,
        by_zenith=by_zenith,
        cos_incidence=np.ones_like(distance),
        line=None if g.line is None else np.interp(azimuth, *_sorted_by_first(g.azimuth, g.line)),
        share=None if g.share is None else np.interp(azimuth, *_sorted_by_first(g.azimuth, g.share)),
        power=None if g.power is None else np.full_like(distance, float(np.median(g.power))),
    )
    sigma = np.full(len(distance), _TARGET_SIGMA_M * np.sqrt(3.0))
    residuals = _only_geometry(view.residuals, geometry, sigma, pose)
    there = replace(view, residuals=residuals, point_count=len(sigma))
    title = f"{_TARGETS} targets around the station, known to {1e3 * _TARGET_SIGMA_M:.0f} mm"
    return KnownPoints(title, pose, sigma, lambda wanted: signature_columns(there, wanted))


def _sorted_by_first(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both arrays sorted by the first one."""
    order = np.argsort(x)
    return x[order], y[order]


def _only_geometry(like: TlsResiduals, geometry: RayGeometry, sigma: FloatArray, pose: FloatArray) -> TlsResiduals:
    """Residuals that hold nothing but the geometry of some rays."""
    zero = np.zeros(len(sigma))
    return replace(
        like,
        value=zero,
        sigma=sigma,
        unit_m=zero + 1,
        usable=zero < 1,
        on_smooth_surface=zero < 1,
        pose_jacobian=pose,
        wall_xy=np.zeros((len(sigma), 2)),
        covariates={},
        index=np.arange(len(sigma)),
        geometry=geometry,
        expected_pulses=None,
    )


def _check_points(view: StereoView) -> KnownPoints:
    """A grid of points at two depths in front of the pair, whose columns and rows are measured in both images."""
    nominal = NominalPair.of(view.measurement)
    left, depth = nominal.pair.left, float(np.median(view.residuals.covariates["depth"]))
    share = [(np.arange(count) + 0.5) / count for count in (_CHECK_COLUMNS, _CHECK_ROWS)]
    u, v = (each.ravel() for each in np.meshgrid(left.width * share[0], left.height * share[1]))
    x, y = left.tangents(u, v)
    local = np.stack([x, y, np.ones_like(x)], axis=1) * (depth * np.tile(_CHECK_DEPTHS, len(u))[: len(u), None])
    points = left.position + np.einsum("ij,nj->ni", left.rotation, local)

    def seen(pair: CameraPair) -> FloatArray:
        return np.concatenate([pixel for camera in (pair.left, pair.right) for pixel in project(camera, points)])

    base = seen(nominal.pair)

    def column(effect: type[Effect], camera: str, key: str) -> FloatArray:
        extra: Any = effect.model_fields[key].json_schema_extra
        step = _STEP * float(extra["typical"] or 1e-3)
        real = real_pair((effect(**{"camera": camera, key: step}),), view.measurement)
        return np.asarray((seen(real) - base) / step)

    def columns(wanted: list[Candidate]) -> FloatArray:
        found = []
        for candidate in wanted:
            side = str(candidate.fixed.get("camera", ""))
            if candidate.wave is not None:
                found.append(_jitter(candidate, side, base))
            elif side:
                found.append(np.stack([column(effect_of(candidate.name), side, key) for key in candidate.names], axis=1))
            else:
                found.append(
                    np.zeros((len(base), candidate.columns.shape[1]))
                )  # other effects arise in area matching, which is not used for targets
        return np.concatenate(found, axis=1)

    pose = []
    for axis in range(6):
        vector = 1e-4 * np.eye(3)[axis % 3]
        pose.append((seen(moved_pair(nominal.pair, left.position, vector, turned=axis >= 3)) - base) / 1e-4)
    count = _CHECK_ROWS * _CHECK_COLUMNS
    title = f"{count} check points across the frame, known to {_CHECK_SIGMA_PX:g} px"
    return KnownPoints(title, np.stack(pose, axis=1), np.full(len(base), _CHECK_SIGMA_PX), columns)


def _jitter(candidate: Candidate, side: str, base: FloatArray) -> FloatArray:
    """Columns of a row jitter: rows of one image are displaced. The observations are left u, left v, right u and right v."""
    left_u, left_v, _, right_v = np.split(base, 4)
    angle = 2 * np.pi / candidate.period * (left_v if side == "left" else right_v)
    found = np.zeros((4, len(left_u), 2))
    found[0 if side == "left" else 2] = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    return found.reshape(-1, 2)
