"""Laser scanner effects of EFFECTS.md in closed form, and forms outside the catalogue; recorded = true + effect."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from benchmarks.gap_closed_form.casting import Array
from benchmarks.gap_closed_form.walls import Random

Parameters = dict[str, Any]
SECOND = np.pi / 180 / 3600


@dataclass(frozen=True)
class Rays:
    """What effects depend on, for each pulse.

    They are angles (rad, as recorded), range (m), cosine of the incidence angle, received power, scan line, share of the scan's
    duration, and derivatives of the range by azimuth and zenith angle (m per rad).
    """

    az: Array
    ze: Array
    R: Array
    cos_i: Array
    power: Array
    line: Array
    share: Array
    by_az: Array
    by_ze: Array

    def part(self, rows: Any) -> Rays:
        """Return some of the pulses."""
        return Rays(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    @property
    def slant(self) -> Array:
        """1 / cos i - 1."""
        return 1 / self.cos_i - 1


MEAN: dict[str, tuple[float, float]] = {
    "range_offset": (1e-3, 0.02),
    "range_scale": (10.0, 300.0),
    "range_cyclic": (1e-3, 0.02),
    "range_intensity_bias": (1e-3, 0.03),
    "range_incidence_bias": (1e-3, 0.03),
    "vertical_index": (10 * SECOND, 150 * SECOND),
    "collimation": (10 * SECOND, 150 * SECOND),
    "trunnion_tilt": (10 * SECOND, 150 * SECOND),
    "horizontal_eccentricity": (10 * SECOND, 150 * SECOND),
    "vertical_eccentricity": (10 * SECOND, 150 * SECOND),
    "wobble": (5 * SECOND, 60 * SECOND),
    "tilt_drift": (10 * SECOND, 150 * SECOND),
}
"""Mean effects, with an initial amplitude and the largest drawn one."""
SPREAD: dict[str, tuple[float, float]] = {
    "range_noise": (1e-3, 0.02),
    "range_noise_proportional": (20.0, 600.0),
    "range_noise_incidence": (1e-3, 0.02),
    "range_noise_intensity": (1e-3, 0.02),
    "angle_noise": (10 * SECOND, 100 * SECOND),
}
OTHER = ("range_quantization", "beam_divergence", "detection_limit", "precipitation")
NEEDS = {
    "range_intensity_bias": {"intensity"},
    "range_noise_intensity": {"intensity"},
    "detection_limit": {"pattern", "intensity"},
    "precipitation": {"pattern"},
    "wobble": {"pattern"},
    "tilt_drift": {"gps_time"},
    "off_drift": {"gps_time"},
    "off_spread_time": {"gps_time"},
    "off_intensity_square": {"intensity"},
    "off_loss_sector": {"pattern"},
    "off_facets": {"pattern"},
}
"""Fields without which a measurement cannot show an effect."""
OFF_MEAN: dict[str, tuple[float, float]] = {
    "off_quadratic": (1e-3, 0.05),
    "off_jump": (1e-3, 0.03),
    "off_drift": (1e-3, 0.03),
    "off_square_wave": (1e-3, 0.02),
    "off_azimuth_waves": (1e-3, 0.02),
    "off_saddle": (1e-3, 0.05),
    "off_intensity_square": (1e-3, 0.02),
    "off_facets": (1e-3, 0.02),
}
OFF_SPREAD: dict[str, tuple[float, float]] = {"off_spread_sector": (1e-3, 0.02), "off_spread_time": (1e-3, 0.02)}
OFF_LOSS = ("off_loss_sector",)


def shape(name: str, rays: Rays, random: Random) -> Parameters:
    """Return a mean or variance effect at its initial amplitude, with random other parameters."""
    size = {**MEAN, **SPREAD, **OFF_MEAN, **OFF_SPREAD}[name][0]
    sign = size * random.choice([-1.0, 1.0])
    phase = random.uniform(-np.pi, np.pi)
    if name == "range_cyclic":
        reach = float(np.ptp(np.quantile(rays.R, [0.02, 0.98])))
        period = float(np.exp(random.uniform(np.log(0.5), np.log(min(10.0, max(reach, 0.8))))))
        return {"amplitude_m": size, "period_m": period, "phase_rad": phase}
    if name == "wobble":
        lines = float(np.ptp(rays.line))
        return {
            "amplitude_rad": size,
            "lines_per_cycle": float(np.exp(random.uniform(np.log(8), np.log(lines / 2)))),
            "phase_rad": phase,
        }
    if name.endswith("eccentricity"):
        return {"amplitude_rad": size, "phase_rad": phase}
    if name == "tilt_drift":
        return {"rate_x_rad": size * np.cos(phase), "rate_y_rad": size * np.sin(phase)}
    if name == "angle_noise":
        return dict(
            zip(
                ("azimuth_sigma_rad", "zenith_sigma_rad"),
                size * np.array([(1, 1), (1, 0), (0, 1)][random.integers(3)]),
                strict=True,
            )
        )
    if name == "range_noise_intensity":
        return {"a_m": size, "exponent": float(random.choice([-0.5, -0.75, -1.0]))}
    if name.startswith("off_"):
        return _off_shape(name, sign, rays, random)
    return {_KEYS[name]: abs(sign) if name in SPREAD else sign}


def _off_shape(name: str, sign: float, rays: Rays, random: Random) -> Parameters:
    where = float(np.quantile(rays.az, random.uniform(0.3, 0.7)))
    period = float(np.ptp(rays.az) / random.uniform(2.5, 8))
    reach = float(np.ptp(np.quantile(rays.R, [0.02, 0.98])))
    return {
        "size": sign,
        "where": where,
        "period": period,
        "length": reach / random.uniform(1.5, 6),
        "rate": random.uniform(3, 10),
        "facets": int(random.integers(3, 6)),
    }


_KEYS = {
    "range_offset": "offset_m",
    "range_scale": "scale_ppm",
    "range_intensity_bias": "coefficient_m",
    "range_incidence_bias": "coefficient_m",
    "vertical_index": "offset_rad",
    "collimation": "angle_rad",
    "trunnion_tilt": "angle_rad",
    "range_noise": "sigma_m",
    "range_noise_proportional": "ppm",
    "range_noise_incidence": "sigma_m",
}
_FACETS = np.array([0.0, 1.0, -0.6, 0.3, -0.2])
"""Range offsets of a mirror's facets, as multiples of the size; lines use them in turn."""
_FIXED = {"facets", "period_m", "phase_rad", "lines_per_cycle", "exponent", "where", "period", "length", "rate"}


def times(parameters: Parameters, factor: float) -> Parameters:
    """Return the same effect, scaled."""
    return {key: value if key in _FIXED else value * factor for key, value in parameters.items()}


def angle_errors(name: str, p: Parameters, rays: Rays) -> tuple[Array, Array]:
    """(n,) recorded minus true azimuth and zenith, rad."""
    none, az, ze = np.zeros_like(rays.az), rays.az, rays.ze
    match name:
        case "vertical_index":
            return none, none + p["offset_rad"]
        case "collimation":
            return p["angle_rad"] / np.sin(ze), none
        case "trunnion_tilt":
            return p["angle_rad"] / np.tan(ze), none
        case "horizontal_eccentricity":
            return p["amplitude_rad"] * np.sin(az + p["phase_rad"]), none
        case "vertical_eccentricity":
            return none, p["amplitude_rad"] * np.sin(ze + p["phase_rad"])
        case "wobble":
            return none, p["amplitude_rad"] * np.sin(2 * np.pi * rays.line / p["lines_per_cycle"] + p["phase_rad"])
        case "tilt_drift":
            x, y = p["rate_x_rad"] * rays.share, p["rate_y_rad"] * rays.share
            return -(x * np.cos(az) + y * np.sin(az)) / np.tan(ze), y * np.cos(az) - x * np.sin(az)
    return none, none


def range_errors(name: str, p: Parameters, rays: Rays) -> Array:
    """(n,) recorded minus true range, m."""
    match name:
        case "range_offset":
            return np.full_like(rays.R, p["offset_m"])
        case "range_scale":
            return p["scale_ppm"] * 1e-6 * rays.R
        case "range_cyclic":
            return p["amplitude_m"] * np.sin(2 * np.pi * rays.R / p["period_m"] + p["phase_rad"])
        case "range_intensity_bias":
            return p["coefficient_m"] * np.log(rays.power / np.median(rays.power))
        case "range_incidence_bias":
            return p["coefficient_m"] * rays.slant
        case "off_quadratic":
            return p["size"] * ((rays.R - rays.R.mean()) / rays.R.std()) ** 2
        case "off_jump":
            return p["size"] * np.where(rays.az > p["where"], 1.0, -1.0)
        case "off_drift":
            return p["size"] * 2 * np.exp(-p["rate"] * rays.share)
        case "off_square_wave":
            return p["size"] * np.sign(np.sin(2 * np.pi * rays.R / p["length"] + p["where"]))
        case "off_azimuth_waves":
            return p["size"] * np.sin(2 * np.pi * rays.az / p["period"])
        case "off_saddle":
            return p["size"] * _standard(rays.az) * _standard(rays.ze)
        case "off_intensity_square":
            return p["size"] * _standard(np.log(rays.power)) ** 2
        case "off_facets":
            return p["size"] * _FACETS[np.rint(rays.line).astype(int) % p["facets"]]
    return np.zeros_like(rays.R)


def signature(name: str, p: Parameters, rays: Rays) -> Array:
    """Return what an effect adds to the recorded range (n,) at the recorded direction, linearised, m."""
    azimuth, zenith = angle_errors(name, p, rays)
    return range_errors(name, p, rays) - rays.by_az * azimuth - rays.by_ze * zenith


def variance(name: str, p: Parameters, rays: Rays) -> Array:
    """(n,) variance that an effect adds to the recorded range, m^2."""
    match name:
        case "range_noise":
            return np.full_like(rays.R, p["sigma_m"] ** 2)
        case "range_noise_proportional":
            return (p["ppm"] * 1e-6 * rays.R) ** 2
        case "range_noise_incidence":
            return (p["sigma_m"] * rays.slant) ** 2
        case "range_noise_intensity":
            return (p["a_m"] * rays.power ** p["exponent"]) ** 2
        case "angle_noise":
            return (p["azimuth_sigma_rad"] * rays.by_az) ** 2 + (p["zenith_sigma_rad"] * rays.by_ze) ** 2
        case "off_spread_sector":
            return p["size"] ** 2 * (np.abs(rays.az - p["where"]) < 0.12 * np.ptp(rays.az))
        case "off_spread_time":
            return p["size"] ** 2 * (np.sin(3 * np.pi * rays.share) > 0)
    return np.zeros_like(rays.R)


def _standard(values: Array) -> Array:
    return (values - values.mean()) / values.std()


def families(rays: Rays, fields_known: set[str]) -> dict[str, list[Array]]:
    """Return designs of all mean effects that the fields allow, with periods on a grid."""
    cot, one = 1 / np.tan(rays.ze), np.ones_like(rays.R)
    found = {
        "range_offset": [one],
        "range_scale": [rays.R],
        "range_incidence_bias": [rays.slant],
        "vertical_index": [rays.by_ze],
        "collimation": [rays.by_az / np.sin(rays.ze)],
        "trunnion_tilt": [rays.by_az * cot],
        "horizontal_eccentricity": [_sine(rays.by_az, rays.az)],
        "vertical_eccentricity": [_sine(rays.by_ze, rays.ze)],
    }
    reach, lines = float(np.ptp(np.quantile(rays.R, [0.01, 0.99]))), float(np.ptp(rays.line))
    periods = 1 / np.linspace(1 / min(12.0, max(reach, 0.8)), 1 / 0.4, 60)
    found["range_cyclic"] = [_sine(one, 2 * np.pi * rays.R / period) for period in periods]
    if "intensity" in fields_known:
        found["range_intensity_bias"] = [np.log(rays.power / np.median(rays.power))]
    if fields_known & {"pattern", "gps_time"}:
        found["wobble"] = [_sine(rays.by_ze, 2 * np.pi * rays.line * f) for f in np.linspace(2 / lines, 1 / 7, 60)]
        cos, sin = np.cos(rays.az), np.sin(rays.az)
        by_x, by_y = -cot * cos * rays.by_az - sin * rays.by_ze, -cot * sin * rays.by_az + cos * rays.by_ze
        found["tilt_drift"] = [np.stack([rays.share * by_x, rays.share * by_y], axis=1)]
    return {name: [design.reshape(len(one), -1) for design in designs] for name, designs in found.items()}


def _sine(factor: Array, angle: Array) -> Array:
    return factor[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1)


def forms(rays: Rays, fields_known: set[str]) -> dict[str, list[Array]]:
    """Return variances (n,) of all variance effects that the fields allow, to be scaled."""
    found = {
        "range_noise": [np.ones_like(rays.R)],
        "range_noise_proportional": [rays.R**2],
        "range_noise_incidence": [rays.slant**2],
        "angle_noise": [rays.by_az**2, rays.by_ze**2, rays.by_az**2 + rays.by_ze**2],
    }
    if "intensity" in fields_known:
        found["range_noise_intensity"] = [rays.power ** (2 * e) for e in (-0.5, -0.625, -0.75, -0.875, -1.0)]
    return found
