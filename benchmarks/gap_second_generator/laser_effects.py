"""Laser scanner effects as EFFECTS.md specifies them, recorded = true + effect, and others outside the catalogue.

Stages: `aim` gives (2, n) recorded minus true azimuth and zenith angle, rad; `range` (n,) m added to the range; `spread` (n,) m,
the standard deviation of white noise added in quadrature; `ray_spread` (2, n) rad, that of the true ray about the recorded one;
`step` the step in m to which ranges are rounded; `loss` the (n,) probability that a return is lost; `footprint` the beam's full
angle, rad.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .effects import Effect, Parameters
from .surface import Array

Rng = np.random.Generator


@dataclass(frozen=True)
class Shot:
    """What an effect may depend on, (n,) each.

    Attributes
    ----------
    azimuth, zenith : Recorded angles, rad.
    line : Scan line.
    time : Elapsed share of the scan, 0 to 1.
    range_m : Range, m.
    cosine : Cosine of the incidence angle.
    power : Received power.
    """

    azimuth: Array
    zenith: Array
    line: Array
    time: Array
    range_m: Array
    cosine: Array
    power: Array
    seen: Array

    @property
    def relative_power(self) -> Array:
        """(n,) power over the median of what came back."""
        return self.power / np.median(self.power[self.seen > 0])

    @property
    def obliquity(self) -> Array:
        """(n,) 1 / cos i - 1."""
        return 1 / np.maximum(self.cosine, 0.05) - 1


def _aim(shot: Shot, azimuth: Array | float = 0.0, zenith: Array | float = 0.0) -> Array:
    return np.stack([np.broadcast_to(azimuth, shot.zenith.shape), np.broadcast_to(zenith, shot.zenith.shape)])


def _phase(rng: Rng, shot: Shot) -> Parameters:
    return {"phase_rad": float(rng.uniform(0, 2 * np.pi))}


def _cyclic(rng: Rng, shot: Shot) -> Parameters:
    return {"period_m": float(np.exp(rng.uniform(np.log(0.6), np.log(8.0)))), **_phase(rng, shot)}


def _wobble(rng: Rng, shot: Shot) -> Parameters:
    return {"lines_per_cycle": float(np.exp(rng.uniform(np.log(5.0), np.log(60.0)))), **_phase(rng, shot)}


def _beam(rng: Rng, shot: Shot) -> Parameters:
    mode, width = rng.choice(["mean", "mean", "first", "strongest"]), rng.uniform(np.log(2e-4), np.log(8e-4))
    return {"mode": str(mode), "divergence_rad": float(np.exp(width))}


def _tilted(p: Parameters, shot: Shot) -> Array:
    """Return recorded minus true angles of rays that a tilt about x and y by rate * time moved."""
    x, y = p["rate_x_rad"] * shot.time, p["rate_y_rad"] * shot.time
    c, s, cot = np.cos(shot.azimuth), np.sin(shot.azimuth), 1 / np.tan(shot.zenith)
    # true = recorded + rate x direction: the azimuth turns by -cot z (x cos az + y sin az), the zenith by y cos az - x sin az
    return np.stack([cot * (x * c + y * s), -(y * c - x * s)])


CATALOGUE: dict[str, Effect] = {
    "range_offset": Effect(
        "range", lambda p, s: np.full(len(s.line), p["offset_m"]), {"offset_m": 2e-3}, most=8.0, scored=("offset_m",)
    ),
    "range_scale": Effect(
        "range", lambda p, s: p["scale_ppm"] * 1e-6 * s.range_m, {"scale_ppm": 50.0}, most=3.0, scored=("scale_ppm",)
    ),
    "range_cyclic": Effect(
        "range",
        lambda p, s: p["amplitude_m"] * np.sin(2 * np.pi * s.range_m / p["period_m"] + p["phase_rad"]),
        {"amplitude_m": 1e-3},
        _cyclic,
        most=6.0,
        scored=("amplitude_m", "period_m"),
    ),
    "range_intensity_bias": Effect(
        "range",
        lambda p, s: p["coefficient_m"] * np.log(s.relative_power),
        {"coefficient_m": 2e-3},
        most=10.0,
        scored=("coefficient_m",),
    ),
    "range_incidence_bias": Effect(
        "range", lambda p, s: p["coefficient_m"] * s.obliquity, {"coefficient_m": 2e-3}, most=5.0, scored=("coefficient_m",)
    ),
    "range_quantization": Effect("step", lambda p, s: p["step_m"], {"step_m": 5e-3}, most=2.0, scored=("step_m",)),
    "range_noise": Effect("spread", lambda p, s: np.full(len(s.line), p["sigma_m"]), {"sigma_m": 2e-3}, scored=("sigma_m",)),
    "range_noise_proportional": Effect("spread", lambda p, s: p["ppm"] * 1e-6 * s.range_m, {"ppm": 50.0}, scored=("ppm",)),
    "range_noise_incidence": Effect("spread", lambda p, s: p["sigma_m"] * s.obliquity, {"sigma_m": 2e-3}, scored=("sigma_m",)),
    "range_noise_intensity": Effect(
        "spread",
        lambda p, s: p["a_m"] * s.power ** p["exponent"],
        {"a_m": 2e-3},
        lambda rng, s: {"exponent": -float(rng.uniform(0.5, 1.0))},
        scored=("a_m", "exponent"),
    ),
    "angle_noise": Effect(
        "ray_spread",
        lambda p, s: _aim(s, p["azimuth_sigma_rad"], p["zenith_sigma_rad"]),
        {"azimuth_sigma_rad": 6e-5, "zenith_sigma_rad": 6e-5},
        scored=("azimuth_sigma_rad", "zenith_sigma_rad"),
    ),
    "vertical_index": Effect(
        "aim", lambda p, s: _aim(s, zenith=p["offset_rad"]), {"offset_rad": 1e-4}, most=10.0, scored=("offset_rad",)
    ),
    "collimation": Effect(
        "aim",
        lambda p, s: _aim(s, azimuth=p["angle_rad"] / np.sin(s.zenith)),
        {"angle_rad": 1e-4},
        most=10.0,
        scored=("angle_rad",),
    ),
    "trunnion_tilt": Effect(
        "aim",
        lambda p, s: _aim(s, azimuth=p["angle_rad"] / np.tan(s.zenith)),
        {"angle_rad": 1e-4},
        most=10.0,
        scored=("angle_rad",),
    ),
    "horizontal_eccentricity": Effect(
        "aim",
        lambda p, s: _aim(s, azimuth=p["amplitude_rad"] * np.sin(s.azimuth + p["phase_rad"])),
        {"amplitude_rad": 1e-4},
        _phase,
        most=10.0,
        scored=("amplitude_rad",),
    ),
    "vertical_eccentricity": Effect(
        "aim",
        lambda p, s: _aim(s, zenith=p["amplitude_rad"] * np.sin(s.zenith + p["phase_rad"])),
        {"amplitude_rad": 1e-4},
        _phase,
        most=10.0,
        scored=("amplitude_rad",),
    ),
    "wobble": Effect(
        "aim",
        lambda p, s: _aim(s, zenith=p["amplitude_rad"] * np.sin(2 * np.pi * s.line / p["lines_per_cycle"] + p["phase_rad"])),
        {"amplitude_rad": 5e-5},
        _wobble,
        most=6.0,
        scored=("amplitude_rad", "lines_per_cycle"),
    ),
    "tilt_drift": Effect("aim", _tilted, {"rate_x_rad": 1e-4, "rate_y_rad": 1e-4}, most=8.0, scored=("rate_x_rad", "rate_y_rad")),
    "beam_divergence": Effect("footprint", lambda p, s: p["divergence_rad"], {}, _beam, scored=("divergence_rad",)),
    "detection_limit": Effect(
        "loss",
        lambda p, s: (s.power < p["minimum_power"]) * 1.0,
        {},
        lambda rng, s: {"minimum_power": float(np.quantile(s.power[s.seen > 0], rng.uniform(0.03, 0.2)))},
        scored=("minimum_power",),
    ),
    "precipitation": Effect(
        "loss", lambda p, s: 1 - np.exp(-2 * p["rate_per_m"] * s.range_m), {"rate_per_m": 1e-3}, most=4.0, scored=("rate_per_m",)
    ),
}


def _bump(rng: Rng, shot: Shot) -> Parameters:
    return {"at": float(rng.uniform(0.35, 0.65))}


def _corner(p: Parameters, s: Shot) -> Array:
    """Return the longer ranges of echoes via a second wall, where the wall is met at 35 to 55 degrees."""
    return p["amplitude_m"] * ((s.cosine > 0.57) & (s.cosine < 0.82))


OFF_CATALOGUE: dict[str, Effect] = {
    "warm_up": Effect(
        "range",
        lambda p, s: p["amplitude_m"] * np.exp(-s.time / p["share"]),
        {"amplitude_m": 3e-3},
        lambda rng, s: {"share": float(rng.uniform(0.05, 0.15))},
    ),
    "zenith_harmonic": Effect(
        "aim",
        lambda p, s: _aim(s, zenith=p["amplitude_rad"] * np.sin(p["order"] * s.zenith)),
        {"amplitude_rad": 1e-4},
        lambda rng, s: {"order": float(rng.integers(25, 60))},
    ),
    "tripod_bump": Effect("aim", lambda p, s: _aim(s, zenith=p["angle_rad"] * (s.time > p["at"])), {"angle_rad": 1e-4}, _bump),
    "bright_step": Effect(
        "range",
        lambda p, s: p["amplitude_m"] * (s.power > p["above"]),
        {"amplitude_m": 2e-3},
        lambda rng, s: {"above": float(np.quantile(s.power[s.seen > 0], rng.uniform(0.6, 0.85)))},
    ),
    "second_wall": Effect("range", _corner, {"amplitude_m": 2e-3}),
    "noisy_lines": Effect(
        "spread",
        lambda p, s: p["sigma_m"] * (np.mod(s.line, p["every"]) < 1),
        {"sigma_m": 4e-3},
        lambda rng, s: {"every": float(rng.integers(3, 8))},
    ),
    "blind_sector": Effect(
        "loss",
        lambda p, s: p["share"] * (np.abs(s.time - p["at"]) < 0.12),
        {"share": 0.2},
        _bump,
        most=4.0,
        least=0.05,
    ),
    "late_shake": Effect("spread", lambda p, s: p["sigma_m"] * (s.time > p["at"]), {"sigma_m": 3e-3}, _bump),
}
SHAPED = {"range_cyclic", "wobble"}
EFFECTS = {**CATALOGUE, **OFF_CATALOGUE}
