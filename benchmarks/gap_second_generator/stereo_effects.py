"""Stereo effects as EFFECTS.md specifies them, real minus nominal or recorded = true + effect, and others outside the catalogue.

Stages: `camera` gives (left, right), the real cameras from the nominal ones; `disparity` (n,) px added to the disparity; `spread`
(n,) px, white noise in quadrature; `field` (rows, columns) px, random each time, added; `map` transforms the map of disparities
(rows, columns; NaN where none); `fill` says how far disparities reach into half-occluded strips, px. texture_noise is left out
because it needs the pictures, which a measurement folder does not have.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from .camera import Camera, Pair
from .effects import Effect, Parameters
from .frames import Frame, turn
from .surface import Array

Rng = np.random.Generator
STEP_PX = 1.5
CUBIC_AGAINST_LINEAR = 0.763  # spread of white values interpolated linearly over that by cubic splines


@dataclass(frozen=True)
class Match:
    """What an effect may depend on: left pixels u, v (n,), disparity (n,) px, nominal pair, stride px, (rows, columns)."""

    u: Array
    v: Array
    disparity: Array
    pair: Pair
    stride: float
    shape: tuple[int, int]


def grid_noise(rng: Rng, shape: tuple[int, int], stride: float, step_px: float, order: int = 1) -> Array:
    """Return (rows, columns) unit Gaussian values on a grid of `step_px`, interpolated to every `stride` px.

    order 1: linear; 3: cubic splines, scaled to the standard deviation of the linear field (two thirds on average).
    """
    count = [int(np.ceil(n * stride / step_px)) + 3 for n in shape]
    begin = rng.uniform(0, 1, 2)
    rows, columns = (begin[axis] + np.arange(n) * stride / step_px for axis, n in enumerate(shape))
    place = np.stack(np.meshgrid(rows, columns, indexing="ij"))
    field = ndimage.map_coordinates(rng.standard_normal(count), place, order=order, mode="mirror")
    return np.asarray(field * (1.0 if order == 1 else CUBIC_AGAINST_LINEAR))


def _whose(p: Parameters, camera: str) -> bool:
    return p["camera"] in (camera, "both")


def _lens(**names: str) -> Any:
    """Return a function that adds parameters (second name) to those of the lens (first name)."""

    def act(p: Parameters, pair: Pair) -> tuple[Camera, Camera]:
        added = {number: p[name] for number, name in names.items()}
        left, right = pair.left, pair.right
        return (
            left.with_lens(**added) if _whose(p, "left") else left,
            right.with_lens(**added) if _whose(p, "right") else right,
        )

    return act


def _turned(axis: int) -> Any:
    def one(camera: Camera, p: Parameters) -> Camera:
        return camera.with_frame(Frame(camera.frame.rotation @ turn(axis, p["angle_rad"]), camera.frame.position))

    def act(p: Parameters, pair: Pair) -> tuple[Camera, Camera]:
        return (
            one(pair.left, p) if _whose(p, "left") else pair.left,
            one(pair.right, p) if _whose(p, "right") else pair.right,
        )

    return act


def _shifted(p: Parameters, pair: Pair) -> tuple[Camera, Camera]:
    def one(camera: Camera) -> Camera:
        offset = camera.frame.rotation @ np.array([p["x_m"], p["y_m"], p["z_m"]])
        return camera.with_frame(Frame(camera.frame.rotation, camera.frame.position + offset))

    return (one(pair.left) if _whose(p, "left") else pair.left, one(pair.right) if _whose(p, "right") else pair.right)


def _one_side(rng: Rng, match: Match) -> Parameters:
    return {"camera": str(rng.choice(["left", "right"]))}


def _first_order(rng: Rng, match: Match) -> Parameters:
    return {**_any_side(rng, match), "k2": 0.0, "k3": 0.0, "k4": 0.0}


def _any_side(rng: Rng, match: Match) -> Parameters:
    return {"camera": str(rng.choice(["left", "right", "both"]))}


def fattened(p: Parameters, disparity: Array, stride: float) -> Array:
    """Return the largest disparity within `radius_px` where it exceeds a step: foreground spreads over background."""
    reach = p["radius_px"] / stride
    rows, columns = np.mgrid[-int(reach) : int(reach) + 1, -int(reach) : int(reach) + 1]
    disc = rows**2 + columns**2 <= reach**2
    largest = ndimage.grey_dilation(np.where(np.isnan(disparity), -np.inf, disparity), footprint=disc)
    slope = 3 * np.nanmedian(np.abs(np.diff(disparity, axis=1))) * reach
    return np.where(largest - disparity > STEP_PX + slope, largest, disparity)


def smoothed(p: Parameters, disparity: Array, stride: float) -> Array:
    """Gaussian low-pass over what is there."""
    there = ~np.isnan(disparity)
    sigma = p["sigma_px"] / stride
    total = ndimage.gaussian_filter(np.where(there, disparity, 0.0), sigma, truncate=4)
    return np.where(there, total / np.maximum(ndimage.gaussian_filter(there * 1.0, sigma, truncate=4), 1e-9), np.nan)


def _jitter(rng: Rng, match: Match) -> Parameters:
    return {"rows_per_cycle": float(match.pair.left.height / rng.uniform(2.5, 30)), "phase_rad": float(rng.uniform(0, 2 * np.pi))}


def _strides(name: str, low: float, high: float) -> Any:
    """Return a function that draws the parameter `name`, px, as a number of strides."""
    return lambda rng, match: {name: float(match.stride * rng.uniform(low, high))}


CATALOGUE: dict[str, Effect] = {
    "focal_length": Effect("camera", _lens(f_px="delta_px"), {"delta_px": 1.0}, _any_side, most=12.0, scored=("delta_px",)),
    "principal_point_x": Effect("camera", _lens(cx_px="delta_px"), {"delta_px": 1.0}, _one_side, most=12.0, scored=("delta_px",)),
    "principal_point_y": Effect("camera", _lens(cy_px="delta_px"), {"delta_px": 1.0}, _one_side, most=12.0, scored=("delta_px",)),
    "radial_distortion": Effect(
        "camera", _lens(k1="k1", k2="k2", k3="k3", k4="k4"), {"k1": 5e-4}, _first_order, most=12.0, scored=("k1",)
    ),
    "tangential_distortion": Effect(
        "camera", _lens(p1="p1", p2="p2"), {"p1": 1e-4, "p2": 1e-4}, _any_side, most=12.0, scored=("p1", "p2")
    ),
    "affinity_skew": Effect(
        "camera", _lens(b1="b1_px", b2="b2_px"), {"b1_px": 0.5, "b2_px": 0.5}, _one_side, most=12.0, scored=("b1_px", "b2_px")
    ),
    "camera_omega": Effect("camera", _turned(0), {"angle_rad": 2e-4}, _one_side, most=12.0, scored=("angle_rad",)),
    "camera_phi": Effect("camera", _turned(1), {"angle_rad": 2e-4}, _one_side, most=12.0, scored=("angle_rad",)),
    "camera_kappa": Effect("camera", _turned(2), {"angle_rad": 2e-4}, _one_side, most=12.0, scored=("angle_rad",)),
    "camera_shift": Effect("camera", _shifted, {"x_m": 0.01, "y_m": 0.01, "z_m": 0.01}, _one_side, most=12.0),
    "parallax_noise": Effect("spread", lambda p, m: np.full(len(m.u), p["sigma_px"]), {"sigma_px": 0.3}, scored=("sigma_px",)),
    "regularization_noise": Effect(
        "field", lambda p, m: p["sigma_px"], {"sigma_px": 0.3}, _strides("step_px", 4, 14), scored=("sigma_px", "step_px")
    ),
    "pixel_locking": Effect(
        "disparity",
        lambda p, m: p["amplitude_px"] * np.sin(2 * np.pi * np.mod(m.disparity, 1.0)),
        {"amplitude_px": 0.15},
        scored=("amplitude_px",),
    ),
    "edge_fattening": Effect("map", fattened, {}, _strides("radius_px", 1.5, 4.5), scored=("radius_px",)),
    "smoothing": Effect("map", smoothed, {}, _strides("sigma_px", 1.0, 3.5), scored=("sigma_px",)),
    "occlusion_fill": Effect("fill", lambda p, m: p["reach_px"], {}, _strides("reach_px", 2.0, 8.0)),
    "row_jitter": Effect(
        "disparity",
        lambda p, m: p["amplitude_px"] * np.sin(2 * np.pi * m.v / p["rows_per_cycle"] + p["phase_rad"]),
        {"amplitude_px": 0.15},
        _jitter,
        scored=("amplitude_px", "rows_per_cycle"),
    ),
}


def _tiles(p: Parameters, m: Match) -> Array:
    """Each tile of the matcher has its own offset."""
    offsets = np.random.default_rng(int(p["seed"])).standard_normal((60, 60))
    return p["amplitude_px"] * offsets[(m.u / p["tile_px"]).astype(int) % 60, (m.v / p["tile_px"]).astype(int) % 60]


def _radius(m: Match) -> Array:
    """(n,) distance from the picture's middle over half its diagonal."""
    width, height = m.pair.left.width, m.pair.left.height
    return np.hypot(m.u - width / 2, m.v - height / 2) / (0.5 * np.hypot(width, height))


OFF_CATALOGUE: dict[str, Effect] = {
    "diagonal_wave": Effect(
        "disparity",
        lambda p, m: p["amplitude_px"] * np.sin(2 * np.pi * (m.u + m.v) / p["px_per_cycle"]),
        {"amplitude_px": 0.15},
        lambda r, m: {"px_per_cycle": float(m.pair.left.width / r.uniform(4, 14))},
    ),
    "stitched_chip": Effect(
        "disparity",
        lambda p, m: p["amplitude_px"] * (m.u > p["column_px"]),
        {"amplitude_px": 0.2},
        lambda r, m: {"column_px": float(m.pair.left.width * r.uniform(0.35, 0.65))},
    ),
    "half_pixel_locking": Effect(
        "disparity", lambda p, m: p["amplitude_px"] * np.sin(4 * np.pi * np.mod(m.disparity, 1.0)), {"amplitude_px": 0.15}
    ),
    "soft_corners": Effect("spread", lambda p, m: p["sigma_px"] * _radius(m) ** 3, {"sigma_px": 0.8}),
    "matcher_tiles": Effect(
        "disparity",
        _tiles,
        {"amplitude_px": 0.1},
        lambda r, m: {"tile_px": float(m.pair.left.width / r.uniform(5, 9)), "seed": float(r.integers(1000))},
    ),
    "rough_rows": Effect(
        "spread",
        lambda p, m: p["sigma_px"] * (np.mod(m.v, 8 * m.stride) < 2 * m.stride),
        {"sigma_px": 0.4},
    ),
    "haze_with_height": Effect(
        "disparity",
        lambda p, m: p["amplitude_px"] * np.exp(-(m.v / m.pair.left.height) / 0.12),
        {"amplitude_px": 0.3},
    ),
}
SHAPED = {"pixel_locking", "row_jitter"}
EFFECTS = {**CATALOGUE, **OFF_CATALOGUE}
