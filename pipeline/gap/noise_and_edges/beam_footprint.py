"""Find the width of a beam from points at edges, whose ranges lie between near and far surface (mixed pixels)."""

from __future__ import annotations

from functools import cache, partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import TlsMeasurement
from pipeline.gap.noise_and_edges.edge_effects import EdgeEffect, agreed_gain, block_std, edge_blocks, log_density, maximise_gain
from pipeline.gap.residuals.residuals import BoolArray
from pipeline.gap.residuals.scan_simulation import simulate_ranges, simulate_ranges_by_mode, systematic_part
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from pipeline.gap.thresholds import thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.angle_noise import AngleNoise
from sensors.effects.beam_divergence import BeamDivergence
from sensors.models.sensor_model import TlsModel
from sensors.signal_chain.beam import Mode

_MODES: tuple[Mode, ...] = ("strongest", "mean", "first")
_DIVERGENCES_RAD = [1e-4 * 2 ** (step / 2) for step in range(11)]
"""Divergences that are tried first, rad."""
_REFINEMENT_FACTORS = (1.12, 1.03)
_MOST_POINTS = 30_000
_PROFILE_UNCERTAINTY = 0.12
"""Relative uncertainty of a divergence, because the beam's energy may be distributed differently from the model's."""

_RANDOM = KeyedRandom(0, ("gap", "mean"))


def find_footprint(
    measurement: TlsMeasurement,
    residuals: TlsResiduals,
    registered_residuals: FloatArray,
    noise_ratio: float,
    held_out: BoolArray,
) -> list[EdgeEffect]:
    """Find the divergence of the laser beam from points at depth steps.

    A wide beam hits both sides of a step and returns a range in between. The divergence is returned if it explains these points
    better than random errors of the ray direction do.

    Parameters
    ----------
    measurement : laser scan with the pose that was estimated by fitting it to the reference surface.
    residuals : its n range residuals (measured minus predicted from the reference), m.
    registered_residuals : (n,) these residuals after a small correction of the pose, fitted robustly, m.
    noise_ratio : observed standard deviation of `registered_residuals`, divided by the predicted one.
    held_out : (n,) true for validation points, which are not used.

    Returns
    -------
    list : one edge effect with the divergence; empty if none is significant.
    """
    sigma, plain = noise_ratio * residuals.sigma, systematic_part(measurement.model)
    axis = simulate_ranges(measurement, plain, residuals.geometry, _RANDOM)

    def shift(at: NDArray[np.int64], modes: tuple[Mode, ...], angle: float) -> dict[Mode, FloatArray]:
        """(m,) range of a beam of divergence `angle` minus that of its axis, m, for each mode; 0 where either does not return."""
        beam = plain.model_copy(update={"effects": (*plain.effects, BeamDivergence(divergence_rad=angle))})
        whole = simulate_ranges_by_mode(measurement, beam, modes, residuals.geometry.part(at), _RANDOM)
        return {mode: np.asarray(np.nan_to_num(whole[mode] - axis[at])) for mode in modes}

    rows = np.flatnonzero(~held_out)[:: max(len(residuals) // _MOST_POINTS, 1)]
    widest_shift = shift(rows, ("mean",), _DIVERGENCES_RAD[-1])["mean"]
    rows = rows[np.abs(widest_shift) > sigma[rows]]
    if not len(rows):
        return []
    block = edge_blocks(residuals.wall_xy)[rows]
    jittered = shift(rows, ("mean",), _equivalent_divergence(measurement.model))["mean"]
    without = [log_density(registered_residuals[rows], moved, sigma[rows]) for moved in (np.zeros_like(jittered), jittered)]
    null = np.logaddexp(*without) - np.log(2)  # the first holds at a step, the second on a curved slope
    shift_by = cache(partial(shift, rows, _MODES))

    def gains(mode: Mode, divergence_rad: float) -> FloatArray:
        moved = shift_by(divergence_rad)[mode]
        return np.asarray(log_density(registered_residuals[rows], moved, sigma[rows]) - null)

    mode, first = max(product(_MODES, _DIVERGENCES_RAD), key=lambda each: float(gains(*each).sum()))
    gain = agreed_gain(gains(mode, first), block, thresholds().edges.least_block_sigmas)
    if gain is None:
        return []
    divergence = maximise_gain(partial(gains, mode), [first], _REFINEMENT_FACTORS)
    from_blocks = block_std(partial(gains, mode), block, divergence)
    std = {"divergence_rad": float(np.hypot(from_blocks, _PROFILE_UNCERTAINTY * divergence))}
    touched = np.abs(shift(np.arange(len(residuals)), (mode,), 1.5 * divergence)[mode]) > sigma
    return [EdgeEffect(BeamDivergence(divergence_rad=divergence, mode=mode), std, gain, touched)]


def _equivalent_divergence(model: TlsModel) -> float:
    """Divergence (rad) of a beam whose energy spreads as the directions of a thin beam with the model's noise of the angles.

    On average such a thin beam records what the wide one records as the mean of its returns. Energy that falls as exp(-8 r^2 /
    D^2) has a standard deviation of D / 4 in each direction.
    """
    noises = [each for each in model.chain() if isinstance(each, AngleNoise)]
    both = sum(each.azimuth_sigma_rad**2 + each.zenith_sigma_rad**2 for each in noises)
    return 4 * float(np.sqrt(both / 2))
