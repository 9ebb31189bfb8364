"""What was found as entries of a config and of gap.json: parameters with uncertainty, class, and what would split it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.decisions import decided
from pipeline.gap.mean.candidates import POLYNOMIAL, Candidate
from pipeline.gap.mean.selection import SelectedEffect
from pipeline.gap.other.locking import Locking
from pipeline.gap.other.missing import MissingFound
from pipeline.gap.other.quantization import Comb
from pipeline.gap.other.shapes import ShapeFound
from pipeline.gap.other.spread import SpreadFound
from pipeline.gap.residuals.alignment import AlignedMeasurement, align
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.residuals.tls_residuals import TlsResiduals
from scene.common.config import parse
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from sensors.effects import effect_of
from sensors.effects.angle_empirical import AngleEmpirical
from sensors.effects.base import Effect, ShowsIn
from sensors.effects.detection_limit import DetectionLimit
from sensors.effects.pixel_locking import PixelLocking
from sensors.effects.range_quantization import RangeQuantization
from sensors.models.sensor_model import StereoModel, TlsModel
from sensors.numerics.curve import Axis, interpolate_on_host

_NODES, _GRID, _JOINED, _MOST_POINTS = 65, 17, 257, 20_000
"""Of the curve of an empirical term, of each side of a surface, and of a sum of curves."""
_FITTED = 1.1
"""How much more the parameters scatter than the covariance says: that of the reference's error is itself fitted.
By development cases, of whose 61 intervals of 90 % without it 52 held the truth."""
_WEAKEST = 20
"""Spacings of the weakest powers that tell how near they come to a limit."""


@dataclass(frozen=True)
class Named:
    """One effect of gap.json.

    name: with the sensor's prefix; entry: of a model's `effects`; std: of the parameters; p_value: by draws, None where none were
    made; split_by: the measurement that would split the class, "" for a class of one.
    """

    name: str
    kind: str
    entry: dict[str, Any]
    std: dict[str, float]
    alike: tuple[str, ...]
    p_value: float | None
    gain: float
    split_by: str = ""

    @property
    def effect(self) -> type[Effect]:
        """The class of what carries it."""
        return effect_of(self.name)

    @property
    def spreads(self) -> bool:
        """Whether it makes residuals spread more."""
        return self.effect.shows_in == ShowsIn.SPREAD

    def to_dict(self) -> dict[str, Any]:
        """As gap.json holds it."""
        parameters = {key: {"value": value, "std": self.std.get(key)} for key, value in self.entry.items() if key != "name"}
        return {
            "name": self.name,
            "cannot_be_told_from": list(self.alike),
            "split_by": self.split_by,
            "kind": self.kind,
            "parameters": parameters,
            "p_value": self.p_value,
            "held_out_log_score_gain": self.gain,
        }


def with_effects(
    model: TlsModel | StereoModel, entries: list[dict[str, Any]], noise: dict[str, float] | None = None
) -> TlsModel | StereoModel:
    """The model with further effects and other values of its noise, checked as a config is."""
    values = model.model_dump(mode="json")
    changed = {"effects": [*values["effects"], *entries], "noise": {**values["noise"], **(noise or {})}}
    return parse(type(model), {**values, **changed}, "model_after.yaml")


def settled_with(
    measurement: Measurement,
    effects: Iterable[Named],
    trusted: NDArray[np.int64] | None = None,
    noise: dict[str, float] | None = None,
) -> AlignedMeasurement:
    """The measurement with further effects in its model, settled: its residuals are taken again and registered.

    trusted: rows of the measurement's points by which to register, all where None; noise: other values of the model's noise.
    """
    model = with_effects(measurement.model, [item.entry for item in effects], noise)
    return align(measurement.changed(model=model), trusted)


def within_bounds(model: TlsModel | StereoModel, entry: dict[str, Any]) -> bool:
    """Whether a config may hold an entry's values."""
    try:
        with_effects(model, [entry])
    except InputError:
        return False
    return True


def only_within_bounds(model: TlsModel | StereoModel, named: list[Named]) -> tuple[list[Named], list[str]]:
    """The effects whose values a config may hold, and words for the others: what no model can hold explains nothing."""
    kept = [item for item in named if within_bounds(model, item.entry)]
    return kept, [f"{item.name} left out: the best value is beyond what a config may hold" for item in named if item not in kept]


def is_possible(model: TlsModel | StereoModel, entry: dict[str, Any]) -> bool:
    """Whether an entry's values lie within the bounds of its effect and are not far beyond what is typical of it."""
    if not within_bounds(model, entry):
        return False
    return typical_sizes(entry) <= decided().mean.largest_size


def typical_sizes(entry: dict[str, Any]) -> float:
    """How many times its typical size an effect has; 0 of one that is not in the catalogue."""
    effect = effect_of(entry["name"])
    sizes = effect.typical_sizes() if effect.catalogue else {}
    return max((abs(entry.get(key, 0.0) / typical) for key, typical in sizes.items()), default=0.0)


def from_comb(comb: Comb, part: Residuals) -> Named:
    """Steps of the range. Gain: of the probability that all ranges lie on the comb, an e-fold each at the least."""
    entry = {"name": RangeQuantization.tag(), "step_m": comb.step_m}
    name, gain = f"tls.{RangeQuantization.tag()}", float(len(part)) * comb.strength
    return Named(name, "physical", entry, {"step_m": comb.std_m}, (), None, gain)


def from_locking(found: Locking) -> Named:
    """Locking that the measured disparities show."""
    entry = {
        "name": PixelLocking.tag(),
        "amplitude_px": found.amplitude_px,
        "period_px": found.period_px,
        "phase_rad": found.phase_rad,
        "tilt_rad": found.tilt_rad,
    }
    return Named(f"stereo.{PixelLocking.tag()}", "physical", entry, {"amplitude_px": found.std_px}, (), None, found.gain)


def from_spread(found: SpreadFound, sensor: str) -> Named:
    """An effect on the spread of laser ranges or disparities."""
    alike = tuple(f"{sensor}.{name}" for name in found.alike)
    empirical = found.empirical or effect_of(found.effect).empirical
    entry = {"name": found.effect, **found.parameters}
    name, kind = f"{sensor}.{found.effect}", "empirical" if empirical else "physical"
    return Named(name, kind, entry, found.std, () if empirical else alike, found.p_value, found.gain)


def from_shape(found: ShapeFound) -> Named:
    """An effect where the surface is not smooth."""
    entry = {"name": found.name, **found.effect.model_dump(mode="json", exclude_unset=True)}
    return Named(f"{found.effect.sensor}.{found.name}", "physical", entry, found.std, (), None, found.gain)


def from_tails(part: Residuals, sigma: float, gain: float) -> Named:
    """Noise with heavy tails, which the catalogue does not have: its standard deviation as white noise, marked empirical."""
    noise, key = part.white_noise
    return Named(f"{part.sensor}.{noise.tag()}", "empirical", {"name": noise.tag(), key: sigma}, {}, (), None, gain)


def from_missing(found: MissingFound, intensity: FloatArray | None) -> Named:
    """An effect on the returns; a detection limit shows as the smallest recorded power."""
    parameters, std = dict(found.parameters), dict(found.std)
    kind = "empirical" if found.covariate else "physical"
    if found.name == DetectionLimit.tag() and intensity is not None:
        # above a limit the weakest powers lie about as far apart as the weakest lies above it
        low = np.sort(intensity)[: _WEAKEST + 1]
        gap = float(low[-1] - low[0]) / (len(low) - 1)
        parameters["minimum_power"], std["minimum_power"] = float(low[0]) - gap, gap
    return Named(f"tls.{found.name}", kind, {"name": found.name, **parameters}, std, (), None, found.gain)


@dataclass(frozen=True)
class Estimate:
    """An explanation of the mean with the values of its coefficients (k,) and their covariance (k, k)."""

    chosen: SelectedEffect
    candidate: Candidate
    values: FloatArray
    covariance: FloatArray


def from_mean(found: Estimate, part: Residuals) -> Named:
    """An effect on the mean; part: the residuals on whose rows its candidate stands."""
    if found.candidate.empirical:
        return _empirical(found.candidate, found.values, found.chosen, part)
    return _physical(found.candidate, found.values, found.covariance, found.chosen, part)


def _physical(candidate: Candidate, values: FloatArray, covariance: FloatArray, item: SelectedEffect, part: Residuals) -> Named:
    entry = {"name": candidate.name, **candidate.fixed, **candidate.parameters(values)}
    std = _uncertainty(candidate, values, covariance)
    alike = tuple(f"{part.sensor}.{name}" for name in item.indistinguishable)
    return Named(
        f"{part.sensor}.{candidate.name}", "physical", _plain(entry), std, alike, item.p_value, item.log_likelihood_ratio
    )


def _uncertainty(candidate: Candidate, values: FloatArray, covariance: FloatArray) -> dict[str, float]:
    """Standard deviations of the parameters, by finite differences of what the coefficients mean."""
    base = candidate.parameters(values)
    steps = np.sqrt(np.maximum(np.diag(covariance), 1e-300)) * 1e-3
    std = {}
    for key in base:
        slopes = [
            (candidate.parameters(values + step * unit)[key] - base[key]) / step
            for step, unit in zip(steps, np.eye(len(values)), strict=True)
        ]
        std[key] = _FITTED * float(np.sqrt(max(np.array(slopes) @ covariance @ np.array(slopes), 0.0)))
    return std


def _empirical(candidate: Candidate, values: FloatArray, item: SelectedEffect, part: Residuals) -> Named:
    """A free form by values: over one cycle of a periodic one, else over all of its covariate that occurs."""
    error = candidate.columns @ values[: candidate.columns.shape[1]]
    if candidate.angle and isinstance(part, TlsResiduals):
        return _of_an_angle(candidate, error, item, part)
    term, key = part.empirical_term
    found = _surface(candidate, error, part) if candidate.form == POLYNOMIAL else _curve(candidate, error, part)
    rows = _rows(found.pop("values"))
    entry = {"name": term.tag(), **found, key: rows}
    return Named(f"{part.sensor}.{term.tag()}", "empirical", entry, {}, (), item.p_value, item.log_likelihood_ratio)


def _of_an_angle(candidate: Candidate, error: FloatArray, item: SelectedEffect, part: TlsResiduals) -> Named:
    """Its curve is found back from the ranges where the surface slants more than at half of the points."""
    levers = {"azimuth": part.geometry.by_azimuth, "zenith": part.geometry.by_zenith}
    lever = -levers[candidate.angle]
    steep = np.abs(lever) > np.median(np.abs(lever))
    found = _curve(candidate, np.divide(error, lever, out=np.zeros_like(error), where=steep), part, steep)
    rows = _rows(found.pop("values"))
    entry = {"name": AngleEmpirical.tag(), "angle": candidate.angle, **found, "values_rad": rows}
    return Named(f"{part.sensor}.{AngleEmpirical.tag()}", "empirical", entry, {}, (), item.p_value, item.log_likelihood_ratio)


def with_corrections(angles: list[Named], later: list[Named], part: Residuals) -> tuple[list[Named], list[Named]]:
    """Curves of an angle's error with those that were found beside them along the same angle, as one; what remains of those."""
    joined, others = [], list(later)
    for term in angles:
        alike = [item for item in others if all(item.entry[key] == term.entry[key] for key in ("angle", "covariate"))]
        others = [item for item in others if item not in alike]
        joined.append(_joined(term, alike, part) if alike else term)
    return joined, others


def _joined(term: Named, later: list[Named], part: Residuals) -> Named:
    """The sum of curves, over all of the angle that occurs."""
    x = part.covariates[term.entry["covariate"]]
    low, high = float(x.min()), float(x.max())
    nodes = np.linspace(low, high, _JOINED)
    curves = ((Axis(**item.entry["along"]), item.entry["values_rad"]) for item in (term, *later))
    total = sum(interpolate_on_host(nodes, nodes, along, Axis(), values) for along, values in curves)
    return replace(term, entry={**term.entry, "along": {"low": low, "high": high}, "values_rad": _rows([total])})


def _rows(values: Any) -> list[list[float]]:
    return [[float(f"{value:.6g}") for value in row] for row in values]


def _curve(candidate: Candidate, error: FloatArray, part: Residuals, rows: Any = slice(None)) -> dict[str, Any]:
    """rows: those whose error (n,) is known."""
    x = part.covariates[candidate.name]
    cycle = candidate.period * ((float(x.std()) or 1.0) if candidate.form == "wave" else 1.0)
    x = x + _shift(candidate.name, part)  # as the sensor counts it, before it is folded
    low, high = (0.0, cycle) if cycle else (float(x.min()), float(x.max()))
    turned, error = (np.mod(x, cycle) if cycle else x)[rows], error[rows]
    order = np.argsort(turned)
    curve = np.interp(np.linspace(low, high, _NODES), turned[order], error[order], period=cycle or None)
    return {"covariate": candidate.name, "along": {"low": low, "high": high, "period": cycle}, "values": [curve]}


def _surface(candidate: Candidate, error: FloatArray, part: Residuals) -> dict[str, Any]:
    """The polynomial again, at the nodes of a grid: it is found back from its values at the points."""
    first, second = part.position_covariates
    x, y = part.covariates[first], part.covariates[second]
    axes = [np.linspace(values.min(), values.max(), _GRID) for values in (x, y)]
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


def _shift(covariate: str, part: Residuals) -> float:
    """What an effect's covariate is more than that of the residuals, which is relative for the power."""
    if covariate != "intensity" or not isinstance(part, TlsResiduals):
        return 0.0
    return float(np.median(np.log(np.maximum(part.geometry.power, 1e-12)) - part.covariates[covariate]))


def _plain(entry: dict[str, Any]) -> dict[str, Any]:
    return {key: float(value) if isinstance(value, np.floating) else value for key, value in entry.items()}
