"""Stereo effects of EFFECTS.md in closed form or by brute force, and forms outside the catalogue; recorded = true + effect."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage

from benchmarks.gap_closed_form.casting import Array
from benchmarks.gap_closed_form.stereo_cameras import Jitter, Pair
from benchmarks.gap_closed_form.walls import Random, turn

Parameters = dict[str, Any]

CAMERA: dict[str, tuple[float, float]] = {
    "focal_length": (0.1, 8.0),
    "principal_point_x": (0.1, 10.0),
    "principal_point_y": (0.1, 10.0),
    "radial_distortion": (1e-4, 2e-2),
    "tangential_distortion": (1e-5, 5e-3),
    "affinity_skew": (0.1, 8.0),
    "camera_omega": (1e-5, 4e-3),
    "camera_phi": (1e-5, 4e-3),
    "camera_kappa": (1e-5, 4e-3),
    "camera_shift": (1e-3, 0.2),
}
"""Effects on the real cameras, with an initial amplitude and the largest drawn one."""
IMAGE: dict[str, tuple[float, float]] = {"row_jitter": (0.02, 3.0), "pixel_locking": (0.01, 0.4)}
SPREAD: dict[str, tuple[float, float]] = {"parallax_noise": (0.05, 1.5), "regularization_noise": (0.02, 1.0)}
RASTER = ("edge_fattening", "smoothing", "occlusion_fill")
OFF_MEAN: dict[str, tuple[float, float]] = {
    "off_column_step": (0.02, 1.5),
    "off_column_waves": (0.02, 1.0),
    "off_bump": (0.02, 2.0),
    "off_cubic": (0.02, 2.0),
    "off_column_banding": (0.02, 1.0),
}
OFF_SPREAD: dict[str, tuple[float, float]] = {"off_spread_radius": (0.05, 1.5), "off_spread_half": (0.05, 1.5)}
_ONE_SIDED = ("camera_omega", "camera_phi", "camera_kappa", "camera_shift", "row_jitter")
"""Effects that, on both cameras, are (nearly) a registration."""
_SETS = {
    "focal_length": [("delta_px",)],
    "principal_point_x": [("delta_px",)],
    "principal_point_y": [("delta_px",)],
    "radial_distortion": [("k1",), ("k1", "k2")],
    "tangential_distortion": [("p1",), ("p2",), ("p1", "p2")],
    "affinity_skew": [("b1_px",), ("b2_px",), ("b1_px", "b2_px")],
    "camera_omega": [("angle_rad",)],
    "camera_phi": [("angle_rad",)],
    "camera_kappa": [("angle_rad",)],
    "camera_shift": [("x_m", "y_m", "z_m")],
}
_INTERIOR = {"focal_length": "f_px", "principal_point_x": "cx_px", "principal_point_y": "cy_px"}
_STEP_PX, _SLOPE = 2.0, 0.35
"""Neighbours whose disparities differ by more than this, px, or by more than this slope, are a depth step."""
_FIXED = {"camera", "rows_per_cycle", "phase_rad", "step_px", "where", "width", "row"}


@dataclass(frozen=True)
class Image:
    """What disparity errors depend on, for each left pixel: column and row, disparity (px), right row, and the frame's size."""

    u: Array
    v: Array
    disparity: Array
    v_right: Array
    size: tuple[int, int]


def sides(name: str) -> tuple[str, ...]:
    """Return the cameras on which an effect is tried."""
    return ("left", "right") if name in _ONE_SIDED else ("left", "right", "both")


def shape(name: str, image: Image, random: Random) -> Parameters:
    """Return an effect at its initial amplitude, with random other parameters."""
    size = {**CAMERA, **IMAGE, **SPREAD, **OFF_MEAN, **OFF_SPREAD}[name][0]
    sign, phase = size * random.choice([-1.0, 1.0]), float(random.uniform(-np.pi, np.pi))
    if name in CAMERA:
        sets = _SETS[name]
        names = sets[random.integers(len(sets))]
        values = sign * (random.standard_normal(len(names)) if len(names) > 1 else np.ones(1))
        return {"camera": str(random.choice(sides(name))), **dict(zip(names, values.tolist(), strict=True))}
    if name == "row_jitter":
        rows = float(np.exp(random.uniform(np.log(40), np.log(np.ptp(image.v)))))
        return {"camera": str(random.choice(["left", "right"])), "amplitude_px": size, "rows_per_cycle": rows, "phase_rad": phase}
    if name == "pixel_locking":
        return {"amplitude_px": size}
    if name in SPREAD:
        more = {"step_px": float(random.choice([16.0, 32.0, 64.0, 96.0]))} if name == "regularization_noise" else {}
        return {"sigma_px": size, **more}
    where, row = (float(np.quantile(values, random.uniform(0.3, 0.7))) for values in (image.u, image.v))
    return {"size": sign, "where": where, "row": row, "width": float(np.ptp(image.u) * random.uniform(0.1, 0.25))}


def times(parameters: Parameters, factor: float) -> Parameters:
    """Return the same effect, scaled."""
    return {key: value if key in _FIXED else value * factor for key, value in parameters.items()}


def real_pair(pair: Pair, name: str, p: Parameters, world: Array) -> Pair:
    """Return the cameras with an effect.

    world: (3, 3) world to the cameras' frame, for shifts along the world's axes.
    """
    camera = p.get("camera", "both")
    if name in _INTERIOR:
        return pair.each(camera, lambda c: c.changed(**{_INTERIOR[name]: p["delta_px"]}))
    if name in ("radial_distortion", "tangential_distortion", "affinity_skew"):
        values = {key.removesuffix("_px"): value for key, value in p.items() if key != "camera"}
        return pair.each(camera, lambda c: c.changed(**values))
    if name in ("camera_omega", "camera_phi", "camera_kappa"):
        axis = ("camera_omega", "camera_phi", "camera_kappa").index(name)
        return pair.each(camera, lambda c: replace(c, rotation=c.rotation @ turn(axis, p["angle_rad"])))
    if name == "camera_shift":
        shift = world @ np.array([p["x_m"], p["y_m"], p["z_m"]])
        return pair.each(camera, lambda c: replace(c, position=c.position + shift))
    if name == "row_jitter":
        return replace(pair, jitter={p["camera"]: Jitter(p["amplitude_px"], p["rows_per_cycle"], p["phase_rad"])})
    return pair


def disparity_errors(name: str, p: Parameters, image: Image) -> Array:
    """Return the (n,) errors, px, of effects on the disparity itself."""
    u, v = image.u, image.v
    match name:
        case "pixel_locking":
            return p["amplitude_px"] * np.sin(2 * np.pi * image.disparity)
        case "off_column_step":
            return p["size"] * np.where(u > p["where"], 1.0, -1.0)
        case "off_column_waves":
            return p["size"] * np.sin(2 * np.pi * u / p["width"])
        case "off_bump":
            return p["size"] * 3 * np.exp(-((u - p["where"]) ** 2 + (v - p["row"]) ** 2) / (2 * (0.8 * p["width"]) ** 2))
        case "off_column_banding":
            return p["size"] * np.sign(np.sin(2 * np.pi * (u - p["where"]) / (0.5 * p["width"])))
        case "off_cubic":
            return p["size"] * _standard(u) ** 2 * _standard(v)
    return np.zeros_like(u)


def variance(name: str, p: Parameters, image: Image) -> Array:
    """Return the (n,) variance, px^2, of added white noise."""
    match name:
        case "parallax_noise":
            return np.full_like(image.u, p["sigma_px"] ** 2)
        case "off_spread_radius":
            return p["size"] ** 2 * (np.hypot(_standard(image.u), _standard(image.v)) / 1.4) ** 4
        case "off_spread_half":
            return p["size"] ** 2 * (image.u > p["where"])
    return np.zeros_like(image.u)


def _standard(values: Array) -> Array:
    return (values - values.mean()) / values.std()


def variants() -> list[tuple[str, list[Parameters]]]:
    """Return unit effects on the cameras whose errors span each effect's: name, and parameters of each column."""
    return [
        (name, [{"camera": camera, **{key: CAMERA[name][0] * (key == chosen) for key in names}} for chosen in names])
        for name in CAMERA
        for camera in sides(name)
        for names in _SETS[name]
    ]


def waves(image: Image) -> dict[str, list[Array]]:
    """Return designs of row jitter, with rows per cycle on a grid, and of pixel locking at any phase."""
    height = float(np.ptp(image.v))
    frequencies = np.linspace(0.7 / height, 1 / 38, 40)
    jitter = [_sine(2 * np.pi * rows * f) for rows in (image.v, image.v_right) for f in frequencies]
    return {"row_jitter": jitter, "pixel_locking": [_sine(2 * np.pi * image.disparity)]}


def _sine(angle: Array) -> Array:
    return np.stack([np.sin(angle), np.cos(angle)], axis=1)


def raster_effect(name: str, p: Parameters, disparity: Array, step: int) -> Array:
    """Return (rows, columns) disparities after an effect on neighbourhoods; NaN without a match. step: px per cell."""
    if name == "smoothing":
        known = np.isfinite(disparity)
        weight = ndimage.gaussian_filter(known.astype(float), p["sigma_px"] / step)
        total = ndimage.gaussian_filter(np.where(known, disparity, 0.0), p["sigma_px"] / step)
        return np.where(known, total / np.maximum(weight, 1e-9), np.nan)
    if name == "edge_fattening":
        reach = int(p["radius_px"] / step)
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        behind = np.where(np.isfinite(disparity), disparity, np.inf)
        jump = max(_STEP_PX, _SLOPE * step)
        rim = np.where(disparity - ndimage.minimum_filter(behind, size=3) > jump, disparity, -np.inf)
        grown = ndimage.maximum_filter(rim, footprint=x * x + y * y <= reach * reach)
        return np.where(grown - disparity > jump, grown, disparity)
    return _filled(disparity, int(p["reach_px"] / step))


def _filled(disparity: Array, reach: int) -> Array:
    """Fill strips without a match, at most `reach` cells wide, with the farther disparity of their two ends, row by row."""
    rows, columns = disparity.shape
    known = np.isfinite(disparity)
    index = np.broadcast_to(np.arange(columns), disparity.shape)
    before = np.maximum.accumulate(np.where(known, index, -1), axis=1)
    after = np.minimum.accumulate(np.where(known, index, columns)[:, ::-1], axis=1)[:, ::-1]
    narrow = ~known & (before >= 0) & (after < columns) & (after - before - 1 <= reach)
    row = np.arange(rows)[:, None]
    ends = [disparity[row, np.clip(end, 0, columns - 1)] for end in (before, after)]
    return np.where(narrow, np.fmin(*ends), disparity)
