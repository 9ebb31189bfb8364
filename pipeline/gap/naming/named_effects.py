"""Turn what was found into named effects: entries of a config and of gap.json, with standard deviations and equivalence class."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.mean.candidates import Candidate
from pipeline.gap.mean.nonparametric_terms import POLYNOMIAL
from pipeline.gap.mean.selection import SelectedEffect
from pipeline.gap.noise_and_edges.edge_effects import EdgeEffect
from pipeline.gap.noise_and_edges.missing_returns import LossExplanation
from pipeline.gap.noise_and_edges.pixel_locking import Locking
from pipeline.gap.noise_and_edges.rounded_ranges import RangeStep
from pipeline.gap.noise_and_edges.tile_seams import TileSeams
from pipeline.gap.noise_and_edges.variance_model import VarianceTerm
from pipeline.gap.residuals.alignment import AlignedMeasurement, align
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from pipeline.gap.thresholds import largest_relative_size
from scene.common.config import parse
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from sensors.effects import effect_of
from sensors.effects.angle_empirical import AngleEmpirical
from sensors.effects.base import Effect, ShowsIn
from sensors.effects.detection_limit import DetectionLimit
from sensors.effects.pixel_locking import PixelLocking
from sensors.effects.range_quantization import RangeQuantization
from sensors.effects.tile_shift import TileShift
from sensors.models.sensor_model import StereoModel, TlsModel

_CURVE_NODES, _SURFACE_NODES, _MOST_POINTS = 65, 17, 20_000
"""Nodes of the curve of an empirical term and of each side of a surface; most points that a surface is fitted to."""
_STD_INFLATION = 1.1
"""Factor on all standard deviations, because the covariance of the reference error is itself estimated. Without it, 52 of 61
intervals of 90 % contained the true value on the development cases."""
_WEAKEST_POWERS = 20
"""Number of spacings between the weakest recorded powers that tell how close they come to a detection limit."""


@dataclass(frozen=True)
class NamedEffect:
    """One sensor error (effect) that a diagnosis names as an explanation of residuals; an entry of `effects` in gap.json.

    Attributes
    ----------
    name : name with the sensor's prefix, such as `tls.range_offset`.
    kind : "physical" for an effect of the catalogue, "empirical" for a term without a physical cause.
    entry : entry for the list `effects` of a sensor model's config: name and parameter values.
    std : standard deviations of the parameters, by key of `entry`.
    indistinguishable : names of the other effects that this measurement cannot distinguish from it.
    p_value : p-value from the simulated null distribution; None if none was simulated.
    gain : log-likelihood ratio of the models with and without it, on validation points once it was validated.
    split_by : further measurement that would tell it from those in `indistinguishable`, in words; "" if there are none.
    replacing_pair : names of two effects that together explain the measurement as well, in place of this one, or of this one
        and another named one; they are among the indistinguishable ones. Empty if there are none.
    replaced_too : name of that other effect; "" if the pair would replace this one alone.
    only_together : those of the pair that do not explain the measurement as well without the other one.
    """

    name: str
    kind: str
    entry: dict[str, Any]
    std: dict[str, float]
    indistinguishable: tuple[str, ...]
    p_value: float | None
    gain: float
    split_by: str = ""
    replacing_pair: tuple[str, ...] = ()
    replaced_too: str = ""
    only_together: tuple[str, ...] = ()

    @property
    def alternatives(self) -> list[str]:
        """Explanations that fit this measurement as well, in words: an effect's name, or two joined by "together with"."""
        found = [name for name in self.indistinguishable if name not in self.only_together]
        if self.replacing_pair:
            instead = f" in place of it and {self.replaced_too}" if self.replaced_too else ""
            found.append(" together with ".join(self.replacing_pair) + instead)
        return found

    @property
    def effect(self) -> type[Effect]:
        """Class that implements this sensor error in a model. Empirical terms, which name no cause, have a class too."""
        return effect_of(self.name)

    @property
    def adds_variance(self) -> bool:
        """Whether this sensor error is noise: it changes the standard deviation of the residuals and not their mean."""
        return self.effect.shows_in == ShowsIn.SPREAD

    def to_dict(self) -> dict[str, Any]:
        """Return this sensor error as an entry of `effects` in gap.json, with its parameters and the alternatives to it."""
        parameters = {key: {"value": value, "std": self.std.get(key)} for key, value in self.entry.items() if key != "name"}
        return {
            "name": self.name,
            "cannot_be_told_from": list(self.indistinguishable),
            "split_by": self.split_by,
            "kind": self.kind,
            "parameters": parameters,
            "p_value": self.p_value,
            "held_out_log_score_gain": self.gain,
        }


def with_effects(
    model: TlsModel | StereoModel, entries: list[dict[str, Any]], noise: dict[str, float] | None = None
) -> TlsModel | StereoModel:
    """Return a copy of a sensor model with further errors (effects) and other noise values, validated like a config file.

    InputError is raised if a value is outside its bounds.

    Parameters
    ----------
    model : model to extend.
    entries : effects to append, each as an entry of a config: name and parameter values.
    noise : new values of the model's noise, by key such as `range_sigma_m`; None: unchanged.
    """
    values = model.model_dump(mode="json")
    changed = {"effects": [*values["effects"], *entries], "noise": {**values["noise"], **(noise or {})}}
    return parse(type(model), {**values, **changed}, "model_after.yaml")


def aligned_with(
    measurement: Measurement,
    effects: Iterable[NamedEffect],
    registration_rows: NDArray[np.int64] | None = None,
    noise: dict[str, float] | None = None,
) -> AlignedMeasurement:
    """Put sensor errors (effects) into the model of a measurement, estimate the pose again, and compute residuals there.

    Parameters
    ----------
    measurement : the measured points with the model to extend, and the pose to start from.
    effects : effects to append to the model.
    registration_rows : rows of the measurement's points from which the pose is estimated; None: all.
    noise : new values of the model's noise, by key such as `range_sigma_m`; None: unchanged.
    """
    model = with_effects(measurement.model, [item.entry for item in effects], noise)
    return align(measurement.changed(model=model), registration_rows)


def within_bounds(model: TlsModel | StereoModel, entry: dict[str, Any]) -> bool:
    """Tell whether the config of a sensor model accepts a fitted sensor error (effect) with its parameter values.

    model: the sensor model that would contain the effect.
    entry: the effect as in the config's list `effects`: name and parameter values.
    """
    try:
        with_effects(model, [entry])
    except InputError:
        return False
    return True


def only_within_bounds(model: TlsModel | StereoModel, named: list[NamedEffect]) -> tuple[list[NamedEffect], list[str]]:
    """Keep the sensor errors (effects) whose fitted parameter values a config of the sensor model accepts.

    model: the sensor model that would contain the effects.
    named: effects with their fitted values. Returns those that are kept, and a note for the report on each of the others.
    """
    kept = [item for item in named if within_bounds(model, item.entry)]
    return kept, [
        f"{item.name} left out: its best value is outside the bounds of the effect" for item in named if item not in kept
    ]


def relative_size(entry: dict[str, Any]) -> float:
    """Return how many times its typical size in the catalogue a sensor error (effect) has, to judge its plausibility.

    entry: the effect as in a model's config: name and parameter values. Of several parameters, the largest ratio is returned;
    for an effect that is not in the catalogue, 0.
    """
    effect = effect_of(entry["name"])
    sizes = effect.typical_sizes() if effect.catalogue else {}
    return max((abs(entry.get(key, 0.0) / typical) for key, typical in sizes.items()), default=0.0)


def effect_from_range_step(comb: RangeStep, part: Residuals) -> NamedEffect:
    """Convert the rounding of a scanner's ranges to the named effect "range quantisation", as an entry of gap.json.

    Its log-likelihood ratio is the number of ranges times the strength of the rounding, as rounded ranges leave no doubt.

    comb: the step, such as 1 mm, to which ranges are rounded, and its strength from 0 to 1.
    part: residuals of the rounded ranges; only their number is used.
    """
    entry = {"name": RangeQuantization.tag(), "step_m": comb.step_m}
    return _named("tls", entry, {"step_m": comb.std_m}, float(len(part)) * comb.strength)


def effect_from_locking(found: Locking) -> NamedEffect:
    """Convert pixel locking that was found in measured disparities to a named effect, as an entry of gap.json.

    found: amplitude, period (px) and phase of the locking. It is a matching error that repeats with each pixel of the
    disparity.
    """
    keys = ("amplitude_px", "period_px", "phase_rad", "tilt_rad")
    entry = {"name": PixelLocking.tag(), **{key: getattr(found, key) for key in keys}}
    return _named("stereo", entry, {"amplitude_px": found.std_px}, found.gain)


def effect_from_seams(found: TileSeams) -> NamedEffect:
    """Convert shifted image tiles to the named effect "tile shift", as an entry of gap.json.

    found: side and shift (px) of square tiles that a stereo matcher shifted against each other, from the jumps of the
    disparities at their seams.
    """
    entry = {"name": TileShift.tag(), "amplitude_px": found.amplitude_px, "tile_px": found.tile_px}
    std = {"amplitude_px": found.amplitude_std_px, "tile_px": found.tile_std_px}
    return _named("stereo", entry, std, found.gain, p_value=found.p_value)


def effect_from_variance(found: VarianceTerm, sensor: str) -> NamedEffect:
    """Convert a fitted noise term to a named effect (sensor error), as an entry of gap.json.

    found: the noise term, which explains variance of the residuals that the sensor model does not predict.
    sensor: "tls" or "stereo", the prefix of the name.
    """
    empirical = found.empirical or effect_of(found.effect).empirical
    entry, alike = {"name": found.effect, **found.parameters}, () if empirical else found.indistinguishable
    return _named(sensor, entry, found.std, found.gain, empirical=empirical, alike=alike, p_value=found.p_value)


def effect_from_edges(found: EdgeEffect) -> NamedEffect:
    """Convert an effect that was found at depth steps, such as edge fattening, to a named effect, as an entry of gap.json.

    found: the effect with its estimated parameters and their standard deviations.
    """
    entry = {"name": found.name, **found.effect.model_dump(mode="json", exclude_unset=True)}
    return _named(found.effect.sensor, entry, found.std, found.gain)


def effect_from_tails(part: Residuals, sigma: float, gain: float) -> NamedEffect:
    """Convert heavy tails of the residuals to a named effect: additional white noise, marked empirical.

    The catalogue of sensor errors has no effect for an excess of outliers.

    Parameters
    ----------
    part : residuals with the heavy tails.
    sigma : standard deviation of the additional noise, in the unit of the observable (m or px).
    gain : log-likelihood ratio of the noise models with and without heavy tails.
    """
    noise, key = part.white_noise
    return _named(part.sensor, {"name": noise.tag(), key: sigma}, {}, gain, empirical=True)


def effect_from_losses(found: LossExplanation, intensity: FloatArray | None) -> NamedEffect:
    """Convert an explanation of missing laser returns, such as a detection limit, to a named effect, as an entry of gap.json.

    found: the explanation, with its parameters and their standard deviations. intensity: (n,) received powers of the recorded
    points, from the weakest of which the detection limit is taken; None if no powers were recorded.
    """
    parameters, std = dict(found.parameters), dict(found.std)
    if found.name == DetectionLimit.tag() and intensity is not None:
        # the limit lies about as far below the weakest power as the weakest powers lie apart
        low = np.sort(intensity)[: _WEAKEST_POWERS + 1]
        gap = float(low[-1] - low[0]) / (len(low) - 1)
        parameters["minimum_power"], std["minimum_power"] = float(low[0]) - gap, gap
    return _named("tls", {"name": found.name, **parameters}, std, found.gain, empirical=bool(found.covariate))


def _named(
    sensor: str,
    entry: dict[str, Any],
    std: dict[str, float],
    gain: float,
    *,
    empirical: bool = False,
    alike: Iterable[str] = (),
    p_value: float | None = None,
) -> NamedEffect:
    """Return a named effect. alike: names of those that it cannot be told from, without the sensor's prefix."""
    kind, others = "empirical" if empirical else "physical", tuple(f"{sensor}.{name}" for name in alike)
    return NamedEffect(f"{sensor}.{entry['name']}", kind, entry, std, others, p_value, gain)


@dataclass(frozen=True)
class Estimate:
    """A systematic sensor error (effect) that a selection chose, with its fitted coefficients.

    Attributes
    ----------
    chosen : the effect as selected, with its score and with the effects that it cannot be distinguished from.
    candidate : the effect as a regression term: design columns, linearised at the fitted model.
    values : (k,) coefficients of the design columns.
    covariance : (k, k) covariance of the coefficients.
    """

    chosen: SelectedEffect
    candidate: Candidate
    values: FloatArray
    covariance: FloatArray


def effect_from_estimate(found: Estimate, part: Residuals) -> NamedEffect:
    """Describe a fitted systematic error as an entry of gap.json: name, parameters and their standard deviations.

    A non-parametric term is described by its values at evenly spaced places along its covariate.

    found: the error as a regression term with fitted coefficients.
    part: residuals of the points to which it was fitted.
    """
    candidate, item = found.candidate, found.chosen
    ratio, p_value = item.log_likelihood_ratio, item.p_value
    if candidate.empirical:
        entry = _empirical_entry(candidate, found.values, part)
        return _named(part.sensor, entry, {}, ratio, empirical=True, p_value=p_value)
    entry = {"name": candidate.name, **candidate.fixed, **candidate.parameters(found.values)}
    std = _standard_deviations(candidate, found.values, found.covariance)
    alike = dict.fromkeys([*item.indistinguishable, *item.replacing_pair])
    named = _named(part.sensor, entry, std, ratio, alike=alike, p_value=p_value)
    pair = {f"{part.sensor}.{name}": name in item.indistinguishable for name in item.replacing_pair}
    return replace(
        named,
        replacing_pair=tuple(pair),
        replaced_too=f"{part.sensor}.{item.replaced_too}" if item.replaced_too else "",
        only_together=tuple(name for name, alone in pair.items() if not alone),
    )


def _standard_deviations(candidate: Candidate, values: FloatArray, covariance: FloatArray) -> dict[str, float]:
    """Standard deviations of the parameters, propagated from the coefficients by finite differences."""
    base = candidate.parameters(values)
    steps = np.sqrt(np.maximum(np.diag(covariance), 1e-300)) * 1e-3
    std = {}
    for key in base:
        slopes = [
            (candidate.parameters(values + step * unit)[key] - base[key]) / step
            for step, unit in zip(steps, np.eye(len(values)), strict=True)
        ]
        std[key] = _STD_INFLATION * float(np.sqrt(max(np.array(slopes) @ covariance @ np.array(slopes), 0.0)))
    return std


def _empirical_entry(candidate: Candidate, values: FloatArray, part: Residuals) -> dict[str, Any]:
    """Describe a non-parametric term by its values at nodes: over one cycle if periodic, else over the range of its covariate.

    A curve of an angle's error is recovered from the half of the ranges that depend most on the angle.
    """
    error = candidate.columns @ values[: candidate.columns.shape[1]]
    if candidate.angle and isinstance(part, TlsResiduals):
        lever = -{"azimuth": part.geometry.by_azimuth, "zenith": part.geometry.by_zenith}[candidate.angle]
        steep = np.abs(lever) > np.median(np.abs(lever))
        error = np.divide(error, lever, out=np.zeros_like(error), where=steep)
        name, key = AngleEmpirical.tag(), "values_rad"
        found = {"angle": candidate.angle, **_curve_nodes(candidate, error, part, steep)}
    else:
        name, key = part.empirical_term[0].tag(), part.empirical_term[1]
        found = _surface_nodes(error, part) if candidate.form == POLYNOMIAL else _curve_nodes(candidate, error, part)
    rows = _rounded_rows(found.pop("values"))
    return {"name": name, **found, key: rows}


def _rounded_rows(values: Any) -> list[list[float]]:
    """Round values to six significant digits."""
    return [[float(f"{value:.6g}") for value in row] for row in values]


def _curve_nodes(candidate: Candidate, error: FloatArray, part: Residuals, rows: Any = slice(None)) -> dict[str, Any]:
    """Describe a curve by its values at nodes. rows: rows whose error (n,) is known."""
    x = part.covariates[candidate.name]
    cycle = candidate.period * ((float(x.std()) or 1.0) if candidate.form == "wave" else 1.0)
    x = x + _covariate_offset(candidate.name, part)  # the sensor's own value, before it is folded
    low, high = (0.0, cycle) if cycle else (float(x.min()), float(x.max()))
    turned, error = (np.mod(x, cycle) if cycle else x)[rows], error[rows]
    order = np.argsort(turned)
    curve = np.interp(np.linspace(low, high, _CURVE_NODES), turned[order], error[order], period=cycle or None)
    return {"covariate": candidate.name, "along": {"low": low, "high": high, "period": cycle}, "values": [curve]}


def _surface_nodes(error: FloatArray, part: Residuals) -> dict[str, Any]:
    """Fit the polynomial of two covariates to its values at the points and evaluate it on a grid of nodes."""
    first, second = part.position_covariates
    x, y = part.covariates[first], part.covariates[second]
    axes = [np.linspace(values.min(), values.max(), _SURFACE_NODES) for values in (x, y)]
    nodes = np.meshgrid(*axes)
    thin = slice(None, None, max(len(x) // _MOST_POINTS, 1))
    columns, there = (
        np.stack(
            [((s - x.mean()) / np.ptp(x)) ** a * ((t - y.mean()) / np.ptp(y)) ** b for a in range(5) for b in range(5 - a)],
            axis=-1,
        )
        for s, t in ((x[thin], y[thin]), nodes)
    )
    values = there @ np.linalg.lstsq(columns, error[thin], rcond=None)[0]
    along, across = ({"low": float(axis[0]), "high": float(axis[-1])} for axis in axes)
    return {"covariate": first, "along": along, "second": second, "across": across, "values": values}


def _covariate_offset(covariate: str, part: Residuals) -> float:
    """Return an effect's covariate minus that of the residuals.

    It differs from zero only for the power, which is relative in the residuals.
    """
    if covariate != "intensity" or not isinstance(part, TlsResiduals):
        return 0.0
    return float(np.median(np.log(np.maximum(part.geometry.power, 1e-12)) - part.covariates[covariate]))


def out_of_bounds(measurement: Measurement, estimates: list[Estimate], part: Residuals) -> frozenset[tuple[str, bool]]:
    """Find fitted sensor errors (effects) of implausible size, to exclude them from the next selection.

    They are those whose values a config does not accept, and those larger than `largest_relative_size` (by default 100) times
    their typical size in the catalogue. They are returned as pairs (name, whether it is an empirical term).

    Parameters
    ----------
    measurement : measurement to whose sensor model the effects would be added.
    estimates : effects with fitted coefficients.
    part : residuals of the points to which the rows of their design columns belong.
    """

    def is_plausible(entry: dict[str, Any]) -> bool:
        return within_bounds(measurement.model, entry) and relative_size(entry) <= largest_relative_size()

    wrong = [each for each in estimates if not is_plausible(effect_from_estimate(each, part).entry)]
    return frozenset((each.candidate.name, each.candidate.empirical) for each in wrong)
