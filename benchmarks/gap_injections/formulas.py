"""Effects in closed form on measured ranges, angles and disparities, with NumPy and SciPy only and nothing of the project.

The sign is recorded = true + effect, as in EFFECTS.md. Names that begin with off_ are outside the catalogue.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, grey_dilation
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Values = dict[str, Any]
_NEIGHBOURS = 24
_LEAST_COSINE = 0.1


@dataclass(frozen=True)
class Scan:
    """Points of a scanner, (n,) each.

    Attributes
    ----------
    az, ze : Recorded azimuth and zenith, rad.
    R : Range, m.
    line : Scan line.
    cos_i : Cosine of the incidence angle.
    power : Received power, or None.
    """

    az: Array
    ze: Array
    R: Array
    line: Array
    cos_i: Array
    power: Array | None

    @classmethod
    def of(cls, local: Array, surface: Array, line: Array, power: Array | None) -> Scan:
        """Of points (n, 3) and a surface's vertices (m, 3), both in the scanner's frame."""
        R = np.linalg.norm(local, axis=1)
        az, ze = np.arctan2(local[:, 1], local[:, 0]), np.arccos(local[:, 2] / R)
        middle = np.angle(np.mean(np.exp(1j * az)))
        return cls(middle + np.angle(np.exp(1j * (az - middle))), ze, R, line, _cosine(local, surface), power)

    @property
    def local(self) -> Array:
        """(n, 3) points, scanner's frame."""
        flat = np.sin(self.ze)
        return self.R[:, None] * np.stack([flat * np.cos(self.az), flat * np.sin(self.az), np.cos(self.ze)], axis=1)


def _cosine(points: Array, surface: Array) -> Array:
    """(n,) cosine between the line of sight and the normal of the plane through the nearest points of a surface."""
    near = surface[cKDTree(surface).query(points, _NEIGHBOURS)[1]]
    near = near - near.mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
    sight = points / np.linalg.norm(points, axis=1, keepdims=True)
    return np.asarray(np.clip(np.abs(np.einsum("ni,ni->n", normal, sight)), _LEAST_COSINE, 1.0))


def scanned(name: str, p: Values, scan: Scan, rng: np.random.Generator) -> Scan:
    """Return the scan with an effect."""
    az, ze, R = scan.az, scan.ze, scan.R
    n = len(R)
    slant = 1 / scan.cos_i - 1
    share = (az - az.min()) / np.ptp(az)
    power = np.ones(n) if scan.power is None else np.maximum(scan.power, 1e-3)
    match name:
        case "none":
            return scan
        case "range_offset":
            R = R + p["offset_m"]
        case "range_scale":
            R = R * (1 + 1e-6 * p["scale_ppm"])
        case "range_cyclic":
            R = R + p["amplitude_m"] * np.sin(2 * np.pi * R / p["period_m"] + p["phase_rad"])
        case "range_incidence_bias":
            R = R + p["coefficient_m"] * slant
        case "range_intensity_bias":
            R = R + p["coefficient_m"] * np.log(power / np.median(power))
        case "range_quantization":
            R = p["step_m"] * np.rint(R / p["step_m"])
        case "range_noise":
            R = R + p["sigma_m"] * rng.standard_normal(n)
        case "range_noise_proportional":
            R = R + 1e-6 * p["ppm"] * R * rng.standard_normal(n)
        case "range_noise_incidence":
            R = R + p["sigma_m"] * slant * rng.standard_normal(n)
        case "range_noise_intensity":
            R = R + p["a_m"] * power ** p["exponent"] * rng.standard_normal(n)
        case "vertical_index":
            ze = ze + p["offset_rad"]
        case "vertical_eccentricity":
            ze = ze + p["amplitude_rad"] * np.sin(ze + p["phase_rad"])
        case "horizontal_eccentricity":
            az = az + p["amplitude_rad"] * np.sin(az + p["phase_rad"])
        case "collimation":
            az = az + p["angle_rad"] / np.sin(ze)
        case "trunnion_tilt":
            az = az + p["angle_rad"] / np.tan(ze)
        case "wobble":
            ze = ze + p["amplitude_rad"] * np.sin(2 * np.pi * scan.line / p["lines_per_cycle"] + p["phase_rad"])
        case "angle_noise":
            ze = ze + p["zenith_sigma_rad"] * rng.standard_normal(n)
        case "off_jump":
            R = R + p["size_m"] * (share > 0.5)
        case "off_facets":
            R = R + p["size_m"] * (scan.line % 4 == 1)
        case "off_saddle":
            up = (ze - ze.min()) / np.ptp(ze)
            R = R + 4 * p["size_m"] * (share - 0.5) * (up - 0.5)
        case "off_azimuth_harmonic":
            az = az + p["amplitude_rad"] * np.sin(2 * np.pi * az / p["period_rad"])
        case _:
            raise ValueError(f"no formula for {name}")
    return replace(scan, az=az, ze=ze, R=R)


@dataclass(frozen=True)
class Matched:
    """Matched points of a rectified pair. u, v: left pixel (0.5 at the middle of the first); d: disparity, px."""

    u: Array
    v: Array
    d: Array


@dataclass(frozen=True)
class Optics:
    """Camera constants. f, cx, cy: px, with cx, cy from the centre of the first pixel; offset: px added to a disparity."""

    f: float
    cx: float
    cy: float
    offset: float


def matched(name: str, p: Values, seen: Matched, optics: Optics, rng: np.random.Generator) -> Matched:
    """Return disparities with an effect on single points.

    An effect on the left image moves both place and disparity of a point.
    """
    u, v, d = seen.u, seen.v, seen.d
    x, y = (u - 0.5 - optics.cx) / optics.f, (v - 0.5 - optics.cy) / optics.f
    none = np.zeros_like(u)
    match name:
        case "none":
            return seen
        case "principal_point_x":
            along, across = none + p["delta_px"], none
        case "focal_length":
            along, across = p["delta_px"] * x, p["delta_px"] * y
        case "radial_distortion":
            r2 = x * x + y * y
            along, across = optics.f * x * p["k1"] * r2, optics.f * y * p["k1"] * r2
        case "row_jitter":
            along, across = p["amplitude_px"] * np.sin(2 * np.pi * v / p["rows_per_cycle"] + p["phase_rad"]), none
        case "pixel_locking":
            return replace(seen, d=d + p["amplitude_px"] * np.sin(2 * np.pi * (d % 1.0)))
        case "parallax_noise":
            return replace(seen, d=d + p["sigma_px"] * rng.standard_normal(len(d)))
        case "off_column_banding":
            return replace(seen, d=d + p["size_px"] * np.where((u // (p["period_px"] / 2)) % 2 == 0, 0.5, -0.5))
        case "off_saddle":
            return replace(seen, d=d + p["size_px"] * x * y / np.abs(x * y).max())
        case _:
            raise ValueError(f"no formula for {name}")
    return Matched(u + along, v + across, d + along)


def in_raster(name: str, p: Values, raster: Array, rng: np.random.Generator) -> Array:
    """Return a raster (rows, columns) of disparities, px, NaN where there are none, with an effect on neighbourhoods."""
    known = np.isfinite(raster)
    match name:
        case "smoothing":
            weight = gaussian_filter(known.astype(float), p["sigma_px"])
            smooth = gaussian_filter(np.where(known, raster, 0.0), p["sigma_px"]) / np.maximum(weight, 1e-9)
            return np.where(known, smooth, np.nan)
        case "edge_fattening":
            size = int(np.ceil(p["radius_px"]))
            y, x = np.mgrid[-size : size + 1, -size : size + 1]
            nearest = grey_dilation(np.where(known, raster, -1e9), footprint=np.hypot(x, y) <= p["radius_px"])
            return np.where(known & (nearest - raster > 1.0), nearest, raster)
        case "regularization_noise":
            return raster + p["sigma_px"] * _on_nodes(raster.shape, p["step_px"], rng)
    raise ValueError(f"no formula for {name}")


def _on_nodes(shape: tuple[int, ...], step: float, rng: np.random.Generator) -> Array:
    """Return (rows, columns) standard normal values on nodes `step` px apart, interpolated bilinearly."""
    rows, columns = (np.arange(size) / step for size in shape[:2])
    nodes = rng.standard_normal((int(rows[-1]) + 2, int(columns[-1]) + 2))
    i, j = rows.astype(int)[:, None], columns.astype(int)[None, :]
    a, b = rows[:, None] - i, columns[None, :] - j
    low = (1 - b) * nodes[i, j] + b * nodes[i, j + 1]
    high = (1 - b) * nodes[i + 1, j] + b * nodes[i + 1, j + 1]
    return np.asarray((1 - a) * low + a * high)


IN_RASTER = ("smoothing", "edge_fattening", "regularization_noise")
