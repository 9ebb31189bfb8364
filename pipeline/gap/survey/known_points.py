"""Describe points of known position that a survey could measure in addition to the wall.

Compute what they say about effects and pose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.formats.measurements.measurement import StereoMeasurement, TlsMeasurement
from pipeline.gap.mean.candidates import Candidate
from pipeline.gap.residuals.nominal_pair import NominalPair, moved_pairs, project, real_pair
from pipeline.gap.residuals.ray_hits import RayGeometry
from pipeline.gap.survey.survey_views import SurveyView
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
_STEP, _NUDGE = 0.01, 1e-4
"""Steps of the finite differences: relative to a parameter's typical value, and of a pose, m and rad."""


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


def known_points(view: SurveyView) -> KnownPoints:
    """Return observations of points with known positions that a survey could add, to find out how much they would help.

    They are twelve targets around the first station of a laser scanner, or 24 check points in front of the first stereo pair.
    """
    base = view.measurement
    return _targets(view, base.station[1]) if isinstance(base, TlsMeasurement) else _check_points(view, base)


def _targets(view: SurveyView, turn: FloatArray) -> KnownPoints:
    """Twelve targets around the station, which has the rotation `turn` (3, 3) to the wall frame.

    A point that is known in three dimensions gives as much information as three orthogonal planes through it. They are equally
    inclined to the ray here, so the signatures of ranges can be used.
    """
    g: Any = view.residuals.geometry
    azimuth = float(g.azimuth.mean()) + 2 * np.pi * np.arange(_TARGETS) / _TARGETS
    zenith = np.pi / 2 - np.tile([-0.25, 0.1, 0.45], _TARGETS)[:_TARGETS]
    distance = float(np.median(g.range_m)) * np.tile([0.25, 0.5, 0.75, 1.0], _TARGETS)[:_TARGETS]
    azimuth, zenith, distance = (np.repeat(each, 3) for each in (azimuth, zenith, distance))
    angle = np.tile(2 * np.pi * np.arange(3) / 3, _TARGETS)
    # components of the planes' normals across the ray, relative to that along it
    across, along = np.sqrt(2.0) * np.cos(angle), np.sqrt(2.0) * np.sin(angle)
    ray, right, down = polar_axes(azimuth, zenith)
    normal = np.einsum("ij,nj->ni", turn, ray + across[:, None] * right + along[:, None] * down)
    ray = np.einsum("ij,nj->ni", turn, ray)
    pose = np.concatenate([-normal, -distance[:, None] * np.cross(ray, normal)], axis=1)
    order = np.argsort(g.azimuth)
    geometry = RayGeometry(
        azimuth,
        zenith,
        range_m=distance,
        measured_m=distance,
        by_azimuth=-distance * across * np.sin(zenith),
        by_zenith=-distance * along,
        cos_incidence=np.ones_like(distance),
        line=None if g.line is None else np.interp(azimuth, g.azimuth[order], g.line[order]),
        share=None if g.share is None else np.interp(azimuth, g.azimuth[order], g.share[order]),
        power=None if g.power is None else np.full_like(distance, float(np.median(g.power))),
    )
    sigma = np.full(len(distance), _TARGET_SIGMA_M * np.sqrt(3.0))
    # signatures depend on the geometry alone
    there = replace(view, residuals=replace(view.residuals.part(np.zeros(len(distance), dtype=int)), geometry=geometry))
    title = f"{_TARGETS} targets around the station, known to {1e3 * _TARGET_SIGMA_M:.0f} mm"
    return KnownPoints(title, pose, sigma, there.signature_columns)


def _check_points(view: SurveyView, measurement: StereoMeasurement) -> KnownPoints:
    """A grid of points at two depths in front of the pair, whose columns and rows are measured in both images."""
    nominal = NominalPair.of(measurement)
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
        real = real_pair((effect(**{"camera": camera, key: step}),), measurement)
        return np.asarray((seen(real) - base) / step)

    def columns(candidate: Candidate) -> FloatArray:
        side = str(candidate.fixed.get("camera", ""))
        if candidate.wave is not None:
            return _jitter(candidate, side, base)
        if side:
            return np.stack([column(effect_of(candidate.name), side, key) for key in candidate.names], axis=1)
        # other effects arise in area matching, which is not used for targets
        return np.zeros((len(base), candidate.columns.shape[1]))

    pose = np.stack([(seen(pair) - base) / _NUDGE for pair in moved_pairs(nominal.pair, _NUDGE)], axis=1)
    title = f"{_CHECK_ROWS * _CHECK_COLUMNS} check points across the frame, known to {_CHECK_SIGMA_PX:g} px"
    return KnownPoints(
        title, pose, np.full(len(base), _CHECK_SIGMA_PX), lambda wanted: np.concatenate([*map(columns, wanted)], axis=1)
    )


def _jitter(candidate: Candidate, side: str, base: FloatArray) -> FloatArray:
    """Columns of a row jitter: rows of one image are displaced. The observations are left u, left v, right u and right v."""
    left_u, left_v, _, right_v = np.split(base, 4)
    angle = 2 * np.pi / candidate.period * (left_v if side == "left" else right_v)
    found = np.zeros((4, len(left_u), 2))
    found[0 if side == "left" else 2] = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    return found.reshape(-1, 2)
