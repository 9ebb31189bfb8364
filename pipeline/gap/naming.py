"""Naming: effects on the mean and on the spread, from the points that selection may look at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pipeline.gap.candidates import PLACE
from pipeline.gap.cells import Cells
from pipeline.gap.entries import Named, from_comb, from_locking, from_mean, from_spread
from pipeline.gap.exactly import Points, beyond, followed_up, noisier, weighed
from pipeline.gap.families import believes, families_of
from pipeline.gap.locking import find_locking
from pipeline.gap.measurement import Measurement
from pipeline.gap.quantization import find_comb
from pipeline.gap.registration import registered
from pipeline.gap.residuals import Residuals
from pipeline.gap.selection import MeanSearch, Tried
from pipeline.gap.spread import SpreadFound, SpreadTried, find_spread, share_of_spread
from pipeline.gap.stereo_noise import find_nodes, told_apart
from scene.keyed_random import KeyedRandom
from scene.mesh import FloatArray
from sensors.model import StereoModel


@dataclass(frozen=True)
class Naming:
    """What the selection leaves beside the effects: what was tried for the mean and for the spread, what remains, and the
    standard deviation of the reference."""

    tried: tuple[Tried, ...]
    spread_tried: tuple[SpreadTried, ...]
    remaining: dict[str, Any]
    identifiability: dict[str, Any]
    reference_sigma: float


def name_effects(
    measurement: Measurement,
    part: Residuals,
    scale: float,
    random: KeyedRandom,
    left_out: frozenset[tuple[str, bool]] = frozenset(),
) -> tuple[list[Named], Naming]:
    """Effects on the mean and on the spread.

    What the first search finds goes into the model, the residuals are taken again against that (exactly, where the first had only
    slopes), and the search is repeated beside what was found. scale: how many predicted sigmas the residuals spread; left_out:
    families (name, empirical) whose best values lie beyond the effect's bounds; all is done again without them, with a word.
    """
    named: list[Named] = []
    whole, whole_scale, added = part, scale, 0.0
    tls = part.sensor == "tls"
    comb = find_comb(part.geometry.measured_m) if tls and not believes(measurement, "range_quantization") else None
    if comb is not None:
        named.append(from_comb(comb, part))
        added, scale = comb.step_m**2 / 12, 1.0
    locking = (
        None if tls or believes(measurement, "pixel_locking") else find_locking(part.geometry.found, part.geometry.disparity)
    )
    found_apart = set()
    if locking is not None:
        named.append(from_locking(locking))
        added = locking.amplitude_px**2 / 2
        found_apart.add(("pixel_locking", False))
    part = noisier(part, added)
    allowed = (each for each in families_of(measurement, part) if (each.name, each.empirical) not in left_out | found_apart)
    families = list(allowed)
    spread, spread_tried = _spread(measurement, part, Cells.over(part.at), registered(part)[0], random)
    points = Points(measurement, part, families, spread, (scale, added), random)
    first = MeanSearch(weighed(part, spread, scale), families, random)
    found = followed_up(points, first)
    wrong = beyond(measurement, found.estimates, found.at)
    if wrong:
        return name_effects(measurement, whole, whole_scale, random, left_out | wrong)
    left = found.search.without(found.beside)
    if found.chosen:
        spread, spread_tried = _spread(measurement, found.at, found.search.cells, left, random)
    if not spread and isinstance(measurement.model, StereoModel):
        nodes = find_nodes(found.at, left, measurement.model, random)
        spread = [] if nodes is None else [nodes]
    named += [from_mean(each, found.at) for each in found.estimates]
    named += [from_spread(each, part.sensor) for each in spread]
    names, cosines, survival = first.identifiability()
    p_value = found.search.p_value(found.tried[0].score) if found.tried else 1.0
    share = 1.0 if spread else share_of_spread(found.at, found.search.cells, left)
    remaining = {"p_value": p_value, "note": "; ".join([*part.notes, *_words(left_out), *_quieter(share)])}
    table = {"names": [f"{part.sensor}.{name}" for name in names], "cosines": cosines.tolist(), "survival": survival.tolist()}
    tried = found.chosen[0].tried if found.chosen else found.tried
    shown = tuple(item for item in tried if not item.name.startswith(PLACE))
    return named, Naming(shown, tuple(spread_tried), remaining, table, found.search.reference_sigma(found.beside))


def _spread(
    measurement: Measurement, part: Residuals, cells: Cells, value: FloatArray, random: KeyedRandom
) -> tuple[list[SpreadFound], list[SpreadTried]]:
    """Effects on the spread of residuals (n,) without the mean effects found, and what was tried."""
    found, tried = find_spread(part, cells, value, random)
    model = measurement.model
    return (told_apart(found, part, value, model) if found and isinstance(model, StereoModel) else found), tried


def _words(left_out: frozenset[tuple[str, bool]]) -> list[str]:
    said = (f"free forms of {name}" if empirical else name for name, empirical in sorted(left_out))
    return [f"{what} left out: the best value is beyond what a config may hold" for what in said]


def _quieter(share: float) -> list[str]:
    said = f"the residuals spread {share:.0%} of what the model predicts: its noise is too large, which no effect can mend"
    return [said] if share < 1.0 else []
