"""Which blocks a sensor sees: the probability that the fall of a block exceeds the level of detection.

A cube of side s that sat with half of its height in the rock leaves a niche of s x s and of depth h = s/2 (`depth_ratio` says
otherwise). Two epochs are compared over the floor of the niche, along its normal, with a test as M3C2 makes it (Lague et al.
2013, eq. 1; in the form py4dgeo computes):

    detected where   D > LoD = z (se^ + reg),   se^ = sqrt(s1^2/n1 + s2^2/n2),   z = 1.96

1  Points. The sensor's rays meet the surface in a lattice with steps a and b, so that a patch of w_a x w_b holds N = N_a N_b
   points, N_a = floor(w_a/a) or one more; the latter with probability frac(w_a/a), for a place that owes nothing to the lattice.
   The mean is w_a w_b / (a b): for a laser scanner s^2 cos i / spacing^2. Seen obliquely, the lattice falls elsewhere on the
   floor than on the face of the block, so that the two epochs' numbers N_1 and N_2 are independent. Fewer than
   `minimum_points` in one of them make no test.
2  Shadow. Seen along a direction with the tangents t_a, t_b against the normal, the niche's rim hides h t_a and h t_b of its
   floor; several viewpoints hide on both sides: w_a = s - h (max(0, t_a...) - min(0, t_a...)). Both epochs are compared over what
   is left.
3  Noise. A point's error along the normal has a white part of variance w^2 and, for stereo, a smooth part c^2, of which the
   patch's mean keeps c_m^2 and shows c^2 - c_m^2 as spread. With sigma^2 = w^2 + c^2 - c_m^2 and the registration's error
   ~ N(0, reg^2):
       D ~ N(h, tau^2),  tau^2 = w^2/N_1 + w^2/N_2 + 2 c_m^2 + reg^2,      se^2 = sigma^2/N_1 + sigma^2/N_2
4  Test. s1, s2 are estimates from the same points, so (D - z reg)/se^ times se/tau is noncentral t with
   nu = (1/N_1 + 1/N_2)^2 / (1/(N_1^2 (N_1 - 1)) + 1/(N_2^2 (N_2 - 1))) (Welch, Satterthwaite) and delta = (h - z reg)/tau:
       P(detected | N_1, N_2) = P(T_nu(delta) > q),  q = z se/tau  ~  1 - Phi((q (1 - 1/(4 nu)) - delta) / sqrt(1 + q^2/(2 nu)))
   (Abramowitz & Stegun 26.7.10, within 0.005 from nu = 4). For white noise and N_1 = N_2 the noncentral t is exact, and for many
   points P is Phi((h - LoD)/se).
5  P(detected) = sum over the cases of (N_a, N_b) in both epochs.

Limits: the wall is a plane over the block, as steep as its normal at that place; roughness that is not the same in both epochs is
not counted, nor are points of the niche's side walls, which help; a niche whose floor is hidden altogether counts as not seen.
The block lies along the lattice; a turned one has the same mean number of points.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.integrate import cumulative_trapezoid
from scipy.special import ndtr

from scene.config import Config
from scene.mesh import FloatArray

_SMALLEST_M, _LARGEST_M, _HALVINGS = 1e-3, 30.0, 13
"""The search of the smallest block: ln(30000) / 2^13 leaves 0.13 %."""


class PlanningConfig(Config):
    """What `scarpsim inspect` maps, and when a block counts as seen."""

    gsd_m: float | None = Field(None, gt=0, description="side of a map's pixel; none: some 100,000 pixels for the wall [m]")
    image_sigma_px: float = Field(
        0.0, ge=0, description="stereo: noise of each image coordinate beyond the sensor model's, as of measured points [px]"
    )
    registration_sigma_m: float = Field(0.0, ge=0, description="standard deviation of the registration between two epochs [m]")
    critical_value: float = Field(1.96, gt=0, description="standard errors in the level of detection (1.96: 95 %)")
    minimum_points: int = Field(4, ge=2, description="points that each epoch needs on the niche's floor")
    depth_ratio: float = Field(
        0.5, gt=0, le=1, description="depth of the niche over the block's side (a half: it protruded half)"
    )
    probability: float = Field(0.95, gt=0, lt=1, description="share of cases in which the smallest block is to be seen")
    block_size_m: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        (0.1, 0.2, 0.5), min_length=1, description="sides of the blocks of curves and maps [m]"
    )


@dataclass(frozen=True)
class Sampling:
    """What a sensor puts on n places of a surface; all (n,) or numbers.

    step_a, step_b: of the lattice of points on the surface, along two perpendicular directions, m; shadow_a, shadow_b: hidden
    width of a niche's floor over its depth; white: standard deviation of a point along the normal, m; smooth: of a smooth error
    whose nodes are grain_a, grain_b apart, averaged over places, m.
    """

    step_a: FloatArray
    step_b: FloatArray
    shadow_a: FloatArray
    shadow_b: FloatArray
    white: FloatArray
    smooth: FloatArray | float = 0.0
    grain_a: FloatArray | float = np.inf
    grain_b: FloatArray | float = np.inf


def lattice(
    step_a: FloatArray, step_b: FloatArray, normals: FloatArray, sights: list[FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Steps and shadows (step_a, step_b, shadow_a, shadow_b) of a `Sampling`.

    step_a, step_b: (n, 3) steps of the lattice on the surface, m, taken as the rectangle of the same area along step_a;
    sights: (n, 3) each, from the viewpoints to the places, any length.
    """
    length = np.linalg.norm(step_a, axis=1)
    width = np.linalg.norm(np.cross(step_a, step_b), axis=1) / length
    axis_a = step_a / length[:, None]
    axis_b = np.cross(normals, axis_a)
    into = [-np.einsum("ni,ni->n", sight, normals) for sight in sights]
    tangents = [
        np.array([np.einsum("ni,ni->n", sight, axis) / depth for sight, depth in zip(sights, into, strict=True)])
        for axis in (axis_a, axis_b)
    ]
    shadow_a, shadow_b = (np.maximum(0, tangent.max(axis=0)) - np.minimum(0, tangent.min(axis=0)) for tangent in tangents)
    return length, width, shadow_a, shadow_b


def detection_probability(sampling: Sampling, side_m: FloatArray | float, config: PlanningConfig) -> FloatArray:
    """(n,) the probability that the fall of a block of side `side_m` exceeds the level of detection (see the module)."""
    depth = config.depth_ratio * np.asarray(side_m)
    width_a, width_b = (np.maximum(side_m - depth * shadow, 0.0) for shadow in (sampling.shadow_a, sampling.shadow_b))
    kept = sampling.smooth**2 * _kept(width_a / sampling.grain_a) * _kept(width_b / sampling.grain_b)
    spread = sampling.white**2 + np.maximum(sampling.smooth**2 - kept, 0.0)
    total = np.zeros(np.broadcast(width_a, width_b, sampling.white).shape)
    counts = _counts(width_a / sampling.step_a, width_b / sampling.step_b)
    for before, share_before in counts:
        for after, share_after in counts:
            found = _exceeds(depth, (before, after), sampling.white**2, spread, kept, config)
            total += share_before * share_after * np.where(np.minimum(before, after) >= config.minimum_points, found, 0.0)
    return total


def smallest_block(sampling: Sampling, config: PlanningConfig) -> FloatArray:
    """(n,) side of the smallest block that is seen with `config.probability`, m; NaN where 30 m are not, or no floor shows."""
    low, high = (np.full(np.shape(sampling.step_a), np.log(limit)) for limit in (_SMALLEST_M, _LARGEST_M))
    possible = detection_probability(sampling, np.exp(high), config) >= config.probability
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        seen = detection_probability(sampling, np.exp(middle), config) >= config.probability
        low, high = np.where(seen, low, middle), np.where(seen, middle, high)
    return np.where(possible, np.exp(high), np.nan)


def _counts(steps_a: FloatArray, steps_b: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """The four possible numbers of lattice points in a patch of steps_a x steps_b steps, each with its probability."""
    (fewer_a, rest_a), (fewer_b, rest_b) = ((np.floor(steps), steps % 1.0) for steps in (steps_a, steps_b))
    lines_a, lines_b = ([(fewer, 1 - rest), (fewer + 1, rest)] for fewer, rest in ((fewer_a, rest_a), (fewer_b, rest_b)))
    return [(a * b, share_a * share_b) for a, share_a in lines_a for b, share_b in lines_b]


def _exceeds(
    depth: FloatArray,
    points: tuple[FloatArray, FloatArray],
    white: FloatArray,
    spread: FloatArray,
    kept: FloatArray,
    config: PlanningConfig,
) -> FloatArray:
    """P(detected | N_1, N_2), steps 3 and 4 of the module; white, spread, kept are variances, m2."""
    z, registration = config.critical_value, config.registration_sigma_m
    first, second = (np.maximum(number, 2.0) for number in points)
    inverse = 1 / first + 1 / second
    freedom = inverse**2 / (1 / (first**2 * (first - 1)) + 1 / (second**2 * (second - 1)))
    tau = np.maximum(np.sqrt(white * inverse + 2 * kept + registration**2), 1e-12)  # without noise a step function
    q = z * np.sqrt(spread * inverse) / tau
    delta = (depth - z * registration) / tau
    return ndtr((delta - q * (1 - 1 / (4 * freedom))) / np.sqrt(1 + q**2 / (2 * freedom)))


def _kept(width: FloatArray) -> FloatArray:
    """The share of a smooth error's variance that the mean over a width, in units of its nodes' distance, keeps (one axis)."""
    steps, share = _averaging()
    return np.where(width > steps[-1], 1.5 / np.maximum(width, 1.0), np.interp(width, steps, share))


@cache
def _averaging() -> tuple[FloatArray, FloatArray]:
    """Widths and `_kept` at them, for white nodes interpolated linearly.

    The autocovariance, averaged over the phase, is the cubic B-spline R(t), R(0) = 2/3; the mean over a width w has the variance
    2/w int_0^w (1 - t/w) R(t) dt, which tends to 1/w.
    """
    t = np.linspace(0, 2, 4001)
    covariance = np.where(t < 1, 2 / 3 - t**2 + t**3 / 2, (2 - t) ** 3 / 6)
    first, second = (cumulative_trapezoid(covariance * weight, t, initial=0) for weight in (1.0, t))
    widths = np.linspace(0, 40, 4001)
    reach = np.minimum(widths, 2)
    integral = np.interp(reach, t, first) - np.interp(reach, t, second) / np.maximum(widths, 1e-9)
    share = np.where(widths > 1e-6, 2 * integral / np.maximum(widths, 1e-9), 2 / 3) * 1.5
    return widths, share
