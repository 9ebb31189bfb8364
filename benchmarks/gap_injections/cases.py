"""Cases of the evaluation: which effect is injected into which measurement, at which sizes."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.gap_injections.formulas import Values
from benchmarks.gap_injections.score import INTENSITY


@dataclass(frozen=True)
class Case:
    """One injection. effect: `none` for the unchanged measurement."""

    number: int
    base: str
    effect: str
    values: Values

    @property
    def name(self) -> str:
        """Number of the case in three digits."""
        return f"{self.number:03d}"


def _cyclic(amplitude: float, period: float = 0.6, phase: float = 0.8) -> Values:
    return {"amplitude_m": amplitude, "period_m": period, "phase_rad": phase}


def _wobble(amplitude: float, lines: float = 9.0) -> Values:
    return {"amplitude_rad": amplitude, "lines_per_cycle": lines, "phase_rad": 0.5}


_GROUND: list[tuple[str, str, Values]] = [
    ("ground_1", "range_cyclic", _cyclic(5e-4)),
    ("ground_1", "range_cyclic", _cyclic(2e-3)),
    ("ground_2", "range_cyclic", _cyclic(1e-3)),
    ("ground_3", "range_cyclic", _cyclic(2e-3, 1.1)),
    ("ground_4", "range_cyclic", _cyclic(4e-3, 0.35)),
    ("ground_1", "range_incidence_bias", {"coefficient_m": 2e-3}),
    ("ground_2", "range_incidence_bias", {"coefficient_m": 5e-3}),
    ("ground_3", "range_incidence_bias", {"coefficient_m": 1e-2}),
    ("ground_4", "range_incidence_bias", {"coefficient_m": -5e-3}),
    ("ground_1", "wobble", _wobble(5e-5)),
    ("ground_2", "wobble", _wobble(1.5e-4)),
    ("ground_3", "wobble", _wobble(4e-4, 13.0)),
    ("ground_4", "wobble", _wobble(4e-4, 6.5)),
    ("ground_1", "vertical_index", {"offset_rad": 1e-3}),
    ("ground_2", "vertical_index", {"offset_rad": 3e-3}),
    ("ground_3", "vertical_eccentricity", {"amplitude_rad": 2e-3, "phase_rad": 1.0}),
    ("ground_4", "range_offset", {"offset_m": 5e-3}),
    ("ground_1", "range_offset", {"offset_m": 2e-2}),
    ("ground_2", "range_quantization", {"step_m": 6e-3}),
    ("ground_3", "range_quantization", {"step_m": 2e-2}),
    ("ground_4", "range_noise", {"sigma_m": 1e-3}),
    ("ground_1", "range_noise", {"sigma_m": 2e-3}),
    ("ground_2", "range_noise", {"sigma_m": 5e-3}),
    ("ground_3", "range_noise_incidence", {"sigma_m": 1e-3}),
    ("ground_4", "range_noise_incidence", {"sigma_m": 4e-3}),
    ("ground_1", "range_noise_proportional", {"ppm": 1500.0}),
    ("ground_2", "angle_noise", {"zenith_sigma_rad": 3e-4}),
    ("ground_3", "angle_noise", {"zenith_sigma_rad": 1e-3}),
    ("ground_4", "off_jump", {"size_m": 3e-3}),
    ("ground_1", "off_facets", {"size_m": 3e-3}),
    ("ground_2", "off_saddle", {"size_m": 5e-3}),
    ("trees", "range_cyclic", _cyclic(2e-3)),
    ("trees", "range_cyclic", _cyclic(6e-3, 1.7)),
    ("trees", "range_incidence_bias", {"coefficient_m": 6e-3}),
    ("trees", "range_noise", {"sigma_m": 5e-3}),
    ("trees", "wobble", _wobble(5e-4)),
    ("trees", "collimation", {"angle_rad": 2e-3}),
    ("trees", "trunnion_tilt", {"angle_rad": 2e-3}),
    ("trees", "horizontal_eccentricity", {"amplitude_rad": 3e-3, "phase_rad": 0.4}),
    ("trees", "vertical_index", {"offset_rad": 2e-3}),
    ("trees", "range_offset", {"offset_m": 1e-2}),
]
_ROCKS: list[tuple[str, str, Values]] = [
    ("rocks", "range_cyclic", _cyclic(1e-2, 1.3)),
    ("rocks", "range_cyclic", _cyclic(4e-2, 1.3)),
    ("rocks", "range_intensity_bias", {"coefficient_m": 2e-2}),
    ("rocks", "range_intensity_bias", {"coefficient_m": -8e-2}),
    ("rocks", "range_incidence_bias", {"coefficient_m": 4e-2}),
    ("rocks", "range_noise", {"sigma_m": 3e-2}),
    ("rocks", "range_noise", {"sigma_m": 8e-2}),
    ("rocks", "range_noise_intensity", {"a_m": 3e-2 * INTENSITY**0.7, "exponent": -0.7}),
    ("rocks", "trunnion_tilt", {"angle_rad": 5e-3}),
    ("rocks", "vertical_index", {"offset_rad": 2e-3}),
    ("rocks", "off_jump", {"size_m": 3e-2}),
]


def _jitter(amplitude: float, rows: float = 60.0) -> Values:
    return {"amplitude_px": amplitude, "rows_per_cycle": rows, "phase_rad": 0.5}


_LIGHT: list[tuple[str, str, Values]] = [
    ("light", "row_jitter", _jitter(0.01)),
    ("light", "row_jitter", _jitter(0.05)),
    ("light", "row_jitter", _jitter(0.2, 140.0)),
    ("light", "pixel_locking", {"amplitude_px": 0.02}),
    ("light", "pixel_locking", {"amplitude_px": 0.1}),
    ("light", "principal_point_x", {"delta_px": 0.3}),
    ("light", "principal_point_x", {"delta_px": 3.0}),
    ("light", "focal_length", {"delta_px": 0.5}),
    ("light", "focal_length", {"delta_px": 5.0}),
    ("light", "radial_distortion", {"k1": 0.001}),
    ("light", "radial_distortion", {"k1": 0.01}),
    ("light", "parallax_noise", {"sigma_px": 0.03}),
    ("light", "parallax_noise", {"sigma_px": 0.15}),
    ("light", "regularization_noise", {"sigma_px": 0.1, "step_px": 32.0}),
    ("light", "smoothing", {"sigma_px": 3.0}),
    ("light", "edge_fattening", {"radius_px": 4.0}),
    ("light", "off_column_banding", {"size_px": 0.05, "period_px": 64.0}),
    ("light", "off_saddle", {"size_px": 0.3}),
]
_MATCHER: list[tuple[str, str, Values]] = [
    ("matcher", "row_jitter", _jitter(0.15)),
    ("matcher", "pixel_locking", {"amplitude_px": 0.15}),
    ("matcher", "parallax_noise", {"sigma_px": 0.3}),
    ("matcher", "radial_distortion", {"k1": 0.01}),
    ("matcher", "edge_fattening", {"radius_px": 4.0}),
    ("matcher", "off_column_banding", {"size_px": 0.3, "period_px": 64.0}),
]
CASES = tuple(Case(number, *each) for number, each in enumerate([*_GROUND, *_ROCKS, *_LIGHT, *_MATCHER], start=1))
