"""Compute which blocks a sensor detects: the probability that the fall of a block exceeds the level of detection.

A cube of side s that was half embedded in the rock leaves a niche of s x s and depth h = s/2 (see `depth_ratio`). The epochs
are compared over the floor of the niche, along its normal, with the test of M3C2 (Lague et al. 2013, eq. 1; in the form that
py4dgeo computes):

    detected where   D > LoD = z (se^ + reg),   se^ = sqrt(s1^2/n1 + s2^2/n2),   z = 1.96

1  Points. The sensor's rays meet the surface in a lattice with steps a and b, so that a patch of w_a x w_b contains N = N_a N_b
   points. N_a is floor(w_a/a), or one more with probability frac(w_a/a), for a place at random relative to the lattice. The mean
   is w_a w_b / (a b): for a laser scanner s^2 cos i / spacing^2. On the floor the lattice is shifted by h t_a (t: tangents below)
   against the block's face, a share delta = frac(h t_a/a) of a step. With rho = frac(w_a/a), both epochs have the additional line
   with probability max(0, rho - delta) + max(0, rho + delta - 1). With fewer than `minimum_points` in an epoch there is no test.
2  Shadow. Seen along a direction with the tangents t_a, t_b against the normal, the niche's rim hides h t_a and h t_b of its
   floor. Several viewpoints may hide it on both sides: w_a = s - h (max(0, t_a...) - min(0, t_a...)). Both epochs are compared
   over the visible rest.
3  Noise. A point's error along the normal has a white part of variance w^2 and, for stereo, a grid-correlated part of variance
   c^2. Of the latter the patch's mean keeps c_m^2, and c^2 - c_m^2 appears as scatter. With sigma^2 = w^2 + c^2 - c_m^2 and a
   registration error ~ N(0, reg^2):
       D ~ N(h, tau^2),  tau^2 = w^2/N_1 + w^2/N_2 + 2 c_m^2 + reg^2,      se^2 = sigma^2/N_1 + sigma^2/N_2
   A beam that leaves in another direction than recorded, by b_a on the surface, may miss the floor near its edge. The share
   f_a = erf(r) - (1 - exp(-r^2))/(r sqrt(pi)), r = w_a/(b_a sqrt(2)), hits it. With f = f_a f_b the mean change is f h, and the
   variance of the points after the fall increases by f (1 - f) h^2.
4  Test. s1, s2 are estimated from the same points, so (D - z reg)/se^ times se/tau is noncentral t with
   nu = se^4 / (se_1^4/(N_1 - 1) + se_2^4/(N_2 - 1)) (Welch, Satterthwaite) and delta = (f h - z reg)/tau:
       P(detected | N_1, N_2) = P(T_nu(delta) > q),  q = z se/tau  ~  1 - Phi((q (1 - 1/(4 nu)) - delta) / sqrt(1 + q^2/(2 nu)))
   (Abramowitz & Stegun 26.7.10, accurate to 0.005 from nu = 4 on). For white noise and N_1 = N_2 the noncentral t is exact, and
   for many points P is Phi((h - LoD)/se).
5  P(detected) = sum over the cases of (N_a, N_b) in both epochs.

Limits: the wall is a plane over the block, with the wall's normal at that place. Roughness that differs between the epochs is
ignored, and so are points on the niche's side walls, which would help. A niche whose floor is hidden completely counts as not
seen. At very oblique views, beams that miss the floor count as hitting the face, although some hit a side wall; the probability
is then somewhat too low. The block is aligned with the scan lines or the image's columns; a rotated one has the same mean number
of points. Where the lattice is oblique, all its lines count as having the same number of points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from scene.common.config import Config
from scene.geometry.mesh import FloatArray

CLEAR_SNR = 4.0
"""Signal-to-noise ratio from which a block differs from the noise of the whole wall, as in a data set's card."""
_SMALLEST_M, _LARGEST_M, _HALVINGS = 1e-3, 30.0, 13
"""Range and number of bisections of the search for the smallest block; its accuracy is ln(30000) / 2^13 = 0.13 %."""


class PlanningConfig(Config):
    """Settings of `scarpsim inspect`: the resolution of its maps, and when a fallen block counts as detected.

    A block is a cube. Its fall leaves a niche (a hole) in the wall. The niche's floor is compared between two epochs, one
    before and one after the fall.
    """

    gsd_m: float | None = Field(None, gt=0, description="side of a map's pixel; none: about 100,000 pixels for the wall [m]")
    image_sigma_px: float = Field(
        0.0,
        ge=0,
        description="stereo: noise of each image coordinate in addition to the sensor model's, as of measured points [px]",
    )
    registration_sigma_m: float = Field(0.0, ge=0, description="standard deviation of the registration between two epochs [m]")
    critical_value: float = Field(1.96, gt=0, description="standard errors in the level of detection (1.96: 95 %)")
    minimum_points: int = Field(4, ge=2, description="points that each epoch needs on the niche's floor")
    depth_ratio: float = Field(
        0.5, gt=0, le=1, description="ratio of the niche's depth to the block's side (0.5: half of it was embedded)"
    )
    probability: float = Field(0.95, gt=0, lt=1, description="share of cases in which the smallest block must be seen")
    block_size_m: tuple[Annotated[float, Field(ge=_SMALLEST_M, le=_LARGEST_M)], ...] = Field(
        (0.1, 0.2, 0.5), min_length=1, max_length=50, description="sides of the blocks for which curves and maps are made [m]"
    )


@dataclass(frozen=True)
class Sampling:
    """Describe how densely and precisely a sensor samples a surface at n places, to predict which fallen blocks it detects.

    The sensor's rays meet the surface in a lattice of points. a and b are two perpendicular directions on the surface, b along
    the scan lines or image columns. A niche is the hole that a fallen block leaves. All attributes are (n,) arrays or numbers.

    Attributes
    ----------
    step_a, step_b
        Distance between neighbouring points along a and b, m.
    shadow_a, shadow_b
        Width of the niche's floor that its rim hides along a and b, divided by the niche's depth.
    white
        Standard deviation of a point along the normal, without the grid-correlated part, m. It is independent from point to
        point.
    slope_a, slope_b
        Tangents along a and b of the angle between the rays and the normal.
    blur_a, blur_b
        Standard deviation along a and b of the distance between where a ray hits the surface and where it is recorded, m.
    smooth
        Standard deviation along the normal of the grid-correlated part of the error, m. Neighbouring points share this part: a
        stereo matcher interpolates it between widely spaced pixels (nodes of a grid).
    grain_a, grain_b
        Distance between these nodes along a and b, m.
    """

    step_a: FloatArray
    step_b: FloatArray
    shadow_a: FloatArray
    shadow_b: FloatArray
    white: FloatArray
    slope_a: FloatArray | float = 0.0
    slope_b: FloatArray | float = 0.0
    blur_a: FloatArray | float = 0.0
    blur_b: FloatArray | float = 0.0
    smooth: FloatArray | float = 0.0
    grain_a: FloatArray | float = np.inf
    grain_b: FloatArray | float = np.inf


def lattice(step_a: FloatArray, step_b: FloatArray, normals: FloatArray, sights: Sequence[FloatArray]) -> dict[str, FloatArray]:
    """Describe the lattice in which a sensor's rays meet a surface at n places: values for the fields of a `Sampling`.

    An oblique lattice is replaced by the rectangular one of equal area. Its direction b is along the scan lines or image
    columns, which run upright on a steep wall; direction a is perpendicular to it.

    Parameters
    ----------
    step_a, step_b : (n, 3) arrays
        Vectors on the surface from a point to the next one: step_b to that on the same scan line (or image column), step_a to
        that on the neighbouring one, m.
    normals : (n, 3) array
        Unit normals of the surface.
    sights : sequence of (n, 3) arrays
        Vectors from each viewpoint to the places, of any length. The rays of the first viewpoint make the lattice.

    Returns
    -------
    dict of (n,) arrays
        step_a, step_b: distances between points along a and b, m; shadow_a, shadow_b: width of the part of a hole's floor that
        some viewpoint does not see, divided by the hole's depth; slope_a, slope_b: tangents of the angle between ray and
        normal.
    """
    length = np.linalg.norm(step_b, axis=1)
    width = np.linalg.norm(np.cross(step_a, step_b), axis=1) / length
    axis_b = step_b / length[:, None]
    axis_a = np.cross(axis_b, normals)
    into = [-np.einsum("ni,ni->n", sight, normals) for sight in sights]
    tangents = [
        np.array([np.einsum("ni,ni->n", sight, axis) / depth for sight, depth in zip(sights, into, strict=True)])
        for axis in (axis_a, axis_b)
    ]
    shadow_a, shadow_b = (np.maximum(0, tangent.max(axis=0)) - np.minimum(0, tangent.min(axis=0)) for tangent in tangents)
    slope_a, slope_b = (tangent[0] for tangent in tangents)
    steps = {"step_a": width, "step_b": length}
    return {**steps, "shadow_a": shadow_a, "shadow_b": shadow_b, "slope_a": slope_a, "slope_b": slope_b}


def detection_probability(sampling: Sampling, side_m: FloatArray | float, config: PlanningConfig) -> FloatArray:
    """Predict the probability that a sensor detects the fall of a cube at n places of a wall.

    The fall leaves a hole. It counts as detected if the mean change on the hole's floor exceeds the level of detection, as in
    M3C2 (Lague et al. 2013). The probability is a mean over all positions of the measured points relative to the hole.

    Parameters
    ----------
    sampling : Sampling
        How densely and precisely the sensor samples the surface at the places.
    side_m : (n,) array or float
        Side of the cube that fell, m.
    config : PlanningConfig
        Critical value, least number of points and registration error of the test; ratio of the hole's depth to the side.

    Returns
    -------
    (n,) array
        Probabilities, 0 to 1.
    """
    depth = config.depth_ratio * np.asarray(side_m)
    width_a, width_b = (np.maximum(side_m - depth * shadow, 0.0) for shadow in (sampling.shadow_a, sampling.shadow_b))
    kept = sampling.smooth**2 * _kept(width_a / sampling.grain_a) * _kept(width_b / sampling.grain_b)
    hit = _hit(width_a, sampling.blur_a) * _hit(width_b, sampling.blur_b)
    white = np.stack([sampling.white**2, sampling.white**2 + hit * (1 - hit) * depth**2])
    spread = white + np.maximum(sampling.smooth**2 - kept, 0.0)
    total = np.zeros(np.broadcast(width_a, width_b, sampling.white).shape)
    for lines_a, share_a in _lines(width_a / sampling.step_a, depth * sampling.slope_a / sampling.step_a):
        for lines_b, share_b in _lines(width_b / sampling.step_b, depth * sampling.slope_b / sampling.step_b):
            points = lines_a * lines_b
            found = _exceeds(hit * depth, points, white, spread, kept, config)
            total += share_a * share_b * np.where(points.min(axis=0) >= config.minimum_points, found, 0.0)
    return np.minimum(total, 1.0)  # the shares are rounded


def smallest_block(sampling: Sampling, config: PlanningConfig) -> FloatArray:
    """Find the side of the smallest cube whose fall a sensor detects with the probability `config.probability` at n places.

    Parameters
    ----------
    sampling : Sampling
        How densely and precisely the sensor samples the surface at the places.
    config : PlanningConfig
        Probability, critical value, least number of points and registration error of the test; ratio of the depth of the hole
        that the cube leaves to its side.

    Returns
    -------
    (n,) array
        Sides, m; NaN if not even a block of 30 m is detected, or if no part of the hole's floor is visible.
    """
    return _smallest(sampling, lambda side: detection_probability(sampling, side, config) >= config.probability)


def smallest_clear_block(sampling: Sampling, config: PlanningConfig) -> FloatArray:
    """Find the side of the smallest cube whose fall stands out from the noise of the whole wall, at n places.

    A detector that does not know place and shape of the block needs a signal-to-noise ratio of the change of at least 4
    (CLEAR_SNR). Below it, noise somewhere else on the wall looks as much like a block.

    Parameters
    ----------
    sampling : Sampling
        How densely and precisely the sensor samples the surface at the places.
    config : PlanningConfig
        Registration error between the epochs; ratio of the depth of the hole that the cube leaves to its side.

    Returns
    -------
    (n,) array
        Sides, m; NaN if not even a block of 30 m stands out, or if no part of the hole's floor is visible.
    """
    return _smallest(sampling, lambda side: signal_to_noise(sampling, side, config) >= CLEAR_SNR)


def signal_to_noise(sampling: Sampling, side_m: FloatArray | float, config: PlanningConfig) -> FloatArray:
    """Return how clearly the fall of a cube shows: mean change on the floor of its hole over the standard deviation.

    The mean change is the hole's depth times the share of the beams that hit its floor. The standard deviation is that of the
    difference of two epochs' means over the floor, including the error of their registration.

    Parameters
    ----------
    sampling : Sampling
        How densely and precisely the sensor samples the surface at n places.
    side_m : (n,) array or float
        Side of the cube that fell, m.
    config : PlanningConfig
        Ratio of the hole's depth to the cube's side, and standard deviation of the registration.

    Returns
    -------
    (n,) array
        Ratios, for the mean number of points on the hole's floor; 0 if that number is less than one.
    """
    depth = config.depth_ratio * np.asarray(side_m)
    width_a, width_b = (np.maximum(side_m - depth * shadow, 0.0) for shadow in (sampling.shadow_a, sampling.shadow_b))
    kept = sampling.smooth**2 * _kept(width_a / sampling.grain_a) * _kept(width_b / sampling.grain_b)
    hit = _hit(width_a, sampling.blur_a) * _hit(width_b, sampling.blur_b)
    points = width_a * width_b / (sampling.step_a * sampling.step_b)
    white = 2 * sampling.white**2 / np.maximum(points, 1.0)
    tau = np.sqrt(np.maximum(white + 2 * kept + config.registration_sigma_m**2, 1e-24))
    return np.asarray(np.where(points >= 1, hit * depth / tau, 0.0))


def _smallest(sampling: Sampling, seen: Callable[[FloatArray], NDArray[np.bool_]]) -> FloatArray:
    """Find the smallest side (n,), m, from which on a block is `seen`, by bisection; NaN if the largest is not."""
    low, high = (np.full(np.shape(sampling.step_a), np.log(limit)) for limit in (_SMALLEST_M, _LARGEST_M))
    possible = seen(np.exp(high))
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        enough = seen(np.exp(middle))
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    return np.where(possible, np.exp(high), np.nan)


def _lines(steps: FloatArray, shift: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return the four cases of how many lattice lines lie within a width of `steps` steps, and their probabilities.

    Each case holds the numbers before and after, (2, n). shift: of the lattice between the two, in steps.
    """
    fewer, rest, shift = np.floor(steps), steps % 1.0, shift % 1.0
    both = np.maximum(0.0, rest - shift) + np.maximum(0.0, rest + shift - 1.0)
    shares = {(0, 0): 1 - 2 * rest + both, (0, 1): rest - both, (1, 0): rest - both, (1, 1): both}
    return [(np.stack([fewer + before, fewer + after]), share) for (before, after), share in shares.items()]


def _hit(width: FloatArray, blur: FloatArray | float) -> FloatArray:
    """Return the share f_a of the points recorded within a width that truly lie in it (step 3 of the module)."""
    from scipy.special import erf

    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.maximum(width / (np.sqrt(2) * blur), 1e-9)
        share = erf(ratio) - (1 - np.exp(-(ratio**2))) / (ratio * np.sqrt(np.pi))
    return np.where(blur > 0, share, 1.0)


def _exceeds(
    change: FloatArray, points: FloatArray, white: FloatArray, spread: FloatArray, kept: FloatArray, config: PlanningConfig
) -> FloatArray:
    """Return P(detected | N_1, N_2), step 4 of the module.

    points, white, spread: (2, n) before and after. white, spread and kept are variances, m2.
    """
    from scipy.special import ndtr

    z, registration, number = config.critical_value, config.registration_sigma_m, np.maximum(points, 2.0)
    squared = spread / number
    error = np.maximum(squared.sum(axis=0), 1e-24)  # positive, so that the case without noise is a step function
    with np.errstate(over="ignore", invalid="ignore"):  # at grazing incidence the variance is unbounded
        freedom = error**2 / np.maximum((squared**2 / (number - 1)).sum(axis=0), 1e-48)
        tau = np.maximum(np.sqrt((white / number).sum(axis=0) + 2 * kept + registration**2), 1e-12)
        q, delta = z * np.sqrt(error) / tau, (change - z * registration) / tau
        return ndtr((delta - q * (1 - 1 / (4 * freedom))) / np.sqrt(1 + q**2 / (2 * freedom)))


def _kept(width: FloatArray) -> FloatArray:
    """Return the share of a grid-correlated error's variance that the mean over a width keeps.

    width: in units of the nodes' distance.
    """
    steps, share = _averaging()
    return np.where(width > steps[-1], 1.5 / np.maximum(width, 1.0), np.interp(width, steps, share))


@cache
def _averaging() -> tuple[FloatArray, FloatArray]:
    """Return widths and `_kept` at them, for white nodes with linear interpolation.

    The autocovariance, averaged over the phase, is the cubic B-spline R(t) with R(0) = 2/3. The mean over a width w has the
    variance 2/w int_0^w (1 - t/w) R(t) dt, which tends to 1/w.
    """
    t = np.linspace(0, 2, 4001)
    covariance = np.where(t < 1, 2 / 3 - t**2 + t**3 / 2, (2 - t) ** 3 / 6)
    first, second = (_integral(covariance * weight, t) for weight in (1.0, t))
    widths = np.linspace(0, 40, 4001)
    reach = np.minimum(widths, 2)
    integral = np.interp(reach, t, first) - np.interp(reach, t, second) / np.maximum(widths, 1e-9)
    share = np.where(widths > 1e-6, 2 * integral / np.maximum(widths, 1e-9), 2 / 3) * 1.5
    return widths, share


def _integral(values: FloatArray, t: FloatArray) -> FloatArray:
    """Return the integral of `values` from the first `t` to each, by the trapezoidal rule."""
    return np.concatenate([[0.0], np.cumsum(np.diff(t) * (values[1:] + values[:-1]) / 2)])
