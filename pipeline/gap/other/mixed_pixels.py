"""A beam with a footprint, by the points at edges: their ranges lie between what is near and what is far (mixed pixels)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property, partial

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import TlsMeasurement
from pipeline.gap.decisions import decided
from pipeline.gap.other.shapes import ShapeFound, WallBlocks, log_density, refined
from pipeline.gap.residuals.residuals import BoolArray
from pipeline.gap.residuals.scan_simulation import simulate_ranges, simulate_ranges_by_mode, systematic_part
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.angle_noise import AngleNoise
from sensors.effects.beam_divergence import BeamDivergence
from sensors.models.sensor_model import TlsModel
from sensors.signal_chain.beam import Mode

_MODES: tuple[Mode, ...] = ("strongest", "mean", "first")
_DIVERGENCES_RAD = [1e-4 * 2 ** (step / 2) for step in range(11)]
_FINER = (1.12, 1.03)
_MOST_POINTS = 30_000
_PROFILE = 0.12
"""Share by which a divergence is off where the beam's energy is not distributed as the model's is."""

_RANDOM = KeyedRandom(0, ("gap", "mean"))


def find_footprint(
    measurement: TlsMeasurement, residuals: TlsResiduals, rough: FloatArray, scale: float, held_out: BoolArray
) -> list[ShapeFound]:
    """The divergence that points at edges ask for beyond what the noise of angles does there, if any.

    rough: (n,) registered residuals, m; scale: sigmas they spread; held_out: (n,) points that have no say.
    """
    sigma, footprint = scale * residuals.sigma, _Footprint(measurement, residuals)
    thin = slice(None, None, max(len(residuals) // _MOST_POINTS, 1))
    some = np.flatnonzero(~held_out)[thin]
    wide = footprint.moved(some, ("mean",), _DIVERGENCES_RAD[-1])["mean"]
    some = some[np.abs(wide) > sigma[some]]
    if len(some) < decided().shapes.footprint_fewest:
        return []
    blocks = WallBlocks(WallBlocks.over(residuals.wall_xy).number[some])
    jittered = footprint.moved(some, ("mean",), _width_of_noise(measurement.model))["mean"]
    without = [log_density(rough[some], moved, sigma[some]) for moved in (np.zeros_like(jittered), jittered)]
    null = np.logaddexp(*without) - np.log(2)  # at a step the one, on a slope that bends the other
    moved_by = cache(partial(footprint.moved, some, _MODES))

    def gains(mode: Mode, divergence_rad: float) -> FloatArray:
        moved = moved_by(divergence_rad)[mode]
        return np.asarray(log_density(rough[some], moved, sigma[some]) - null)

    tops = {mode: refined(partial(gains, mode), _DIVERGENCES_RAD, ()) for mode in _MODES}
    mode = max(tops, key=lambda each: float(gains(each, tops[each]).sum()))
    gain = blocks.tested(gains(mode, tops[mode]), decided().shapes.footprint_block_sigmas)
    if gain is None:
        return []
    divergence = refined(partial(gains, mode), [tops[mode]], _FINER)
    std = {"divergence_rad": float(np.hypot(blocks.std(partial(gains, mode), divergence), _PROFILE * divergence))}
    touched = np.abs(footprint.moved(np.arange(len(residuals)), (mode,), 1.5 * divergence)[mode]) > sigma
    return [ShapeFound(BeamDivergence(divergence_rad=divergence, mode=mode), std, gain, touched)]


def _width_of_noise(model: TlsModel) -> float:
    """Divergence of a beam whose energy lies about its axis as a thin one's directions do that have the model's noise, rad.

    Such a thin beam records on average what the wide one does that records the mean of its returns. Energy that falls as
    exp(-8 r^2 / D^2) spreads by D / 4 in each direction.
    """
    noises = [each for each in model.chain() if isinstance(each, AngleNoise)]
    both = sum(each.azimuth_sigma_rad**2 + each.zenith_sigma_rad**2 for each in noises)
    return 4 * float(np.sqrt(both / 2))


@dataclass(frozen=True)
class _Footprint:
    """What a beam's divergence does to the ranges of a scan."""

    measurement: TlsMeasurement
    residuals: TlsResiduals

    @cached_property
    def _axis(self) -> FloatArray:
        """(n,) ranges along the beams' axes, m."""
        return simulate_ranges(self.measurement, systematic_part(self.measurement.model), self.residuals.geometry, _RANDOM)

    def moved(self, rows: NDArray[np.int64], modes: tuple[Mode, ...], angle: float) -> dict[Mode, FloatArray]:
        """(m,) range of a beam of divergence `angle` less that of its axis, m, for each mode; 0 where either does not return."""
        plain = systematic_part(self.measurement.model)
        beam = plain.model_copy(update={"effects": (*plain.effects, BeamDivergence(divergence_rad=angle))})
        whole = simulate_ranges_by_mode(self.measurement, beam, modes, self.residuals.geometry.part(rows), _RANDOM)
        return {mode: np.asarray(np.nan_to_num(whole[mode] - self._axis[rows])) for mode in modes}
