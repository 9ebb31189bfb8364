"""Simulate a laser scan in closed form; recorded = true + effect.

The steps are pattern, aim, ray casting, footprint, range, power, return and record.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from . import walls
from .effects import Effect, Parameters, Whitening, alternatives, loss_strength, solve_size, spread_strength
from .frames import Frame, small_turn, turn
from .laser_effects import CATALOGUE, EFFECTS, SHAPED, Shot
from .surface import Array, Hits, Mask, Surface

Rng = np.random.Generator
GAP_BETWEEN_ECHOES_M = 0.15  # surfaces nearer to each other make one echo: half a pulse of 1 ns
SHARE_FROM_DROPS = 0.1  # of the pulses that rain or fog loses, those recorded on a drop of it
SHARE_OF_DOUBLES = 0.15  # of the pulses beside an edge: the footprint is so much narrower than the steps
REFERENCE_POWER_RANGE_M = 100.0
DARKEST = 1e-9  # power of a ray that grazes, so that decibels stay finite
RINGS = ((0.349, 6), (0.854, 12))  # radius over the beam's (1/e^2), rays: each of 1/19 of the power, second moment kept


@dataclass(frozen=True)
class Site:
    """Reference and true surface (wall's frame), that frame in the world, and the scanner as surveyed and as it stands."""

    kind: str
    reference: Surface
    truth: Surface
    error: walls.ReferenceError
    changes: list[walls.Change]
    wall: Frame
    surveyed: Frame
    standing: Frame


@dataclass(frozen=True)
class Pattern:
    """First azimuth and zenith, steps (rad) and numbers of lines and of pulses a line."""

    azimuth: float
    zenith: float
    azimuth_step: float
    zenith_step: float
    lines: int
    pulses: int

    def angles(self) -> tuple[Array, Array, Array]:
        """Azimuth, zenith (rad) and scan line of each pulse, (n,)."""
        line, pulse = (each.ravel() for each in np.indices((self.lines, self.pulses)))
        azimuth, zenith = self.azimuth + self.azimuth_step * line, self.zenith + self.zenith_step * pulse
        return np.asarray(azimuth, np.float64), np.asarray(zenith, np.float64), line.astype(np.float64)


@dataclass(frozen=True)
class Noise:
    """White noise of the range, m, and of the ray's azimuth and zenith about the recorded ones, rad."""

    range_m: float
    angle_rad: float


@dataclass(frozen=True)
class Scan:
    """Recorded pulses that returned.

    Attributes
    ----------
    points : (n, 3) in the surveyed scanner's frame, m.
    power : (n,) received power.
    time : (n,) time, s.
    sent : Number of pulses sent.
    """

    points: Array
    power: Array
    time: Array
    sent: int


def directions(azimuth: Array, zenith: Array) -> Array:
    """(n, 3) unit, scanner frame."""
    return np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=1)


def cast(surface: Surface, site: Site, rays: Array) -> tuple[Hits, Array, Array]:
    """Hits of rays (n, 3) of the scanner as it stands; their places (n, 3) in the wall's frame; cosines of incidence (n,)."""
    here = site.standing.within(site.wall)
    local = rays @ here.rotation.T
    hits = surface.cast(here.position, local)
    places = here.position + local * np.where(hits.found, hits.distance, 0.0)[:, None]
    return hits, places, np.abs(np.sum(local * hits.normal, axis=1))


def look(site: Site, pattern: Pattern, rho_seed: int) -> tuple[Shot, Array, Array]:
    """Return what the pulses would meet without noise and effects, with places (n, 3) and normals (n, 3), wall's frame."""
    azimuth, zenith, line = pattern.angles()
    hits, places, cosine = cast(site.reference, site, directions(azimuth, zenith))
    range_m = np.where(hits.found, hits.distance, 1.0)
    rho = walls.albedo(site.reference, places[:, 0], places[:, 2], np.random.default_rng(rho_seed))
    power = DARKEST + rho * cosine * (REFERENCE_POWER_RANGE_M / range_m) ** 2
    shot = Shot(azimuth, zenith, line, line / pattern.lines, range_m, cosine, power, hits.found.astype(np.float64))
    return shot, places, hits.normal


class Strength:
    """Signal-to-noise ratios of effects for one site and pattern, from tangent planes (only footprints are cast)."""

    def __init__(self, site: Site, pattern: Pattern, noise: Noise, rho_seed: int, losses: float) -> None:
        shot, places, normal = look(site, pattern, rho_seed)
        self.site = replace(site, truth=site.reference)
        met = (shot.seen > 0) & (shot.cosine > 0.1)
        self.shot, self.losses = Shot(*(getattr(shot, name)[met] for name in Shot.__dataclass_fields__)), losses
        here = site.standing.within(site.wall)
        self.normal = normal[met] @ here.rotation
        self.ray = directions(self.shot.azimuth, self.shot.zenith)
        self.tangent = np.sqrt(1 / self.shot.cosine**2 - 1)
        self.variance = noise.range_m**2 + (noise.angle_rad * self.shot.range_m * self.tangent) ** 2
        along = np.sum(self.normal * self.ray, axis=1)
        point = self.ray * self.shot.range_m[:, None]
        pose = np.concatenate([self.normal, np.cross(point, self.normal)], axis=1) / along[:, None]
        patch_variance = (site.error.sigma * normal[met, 1] / self.shot.cosine) ** 2
        cell = np.floor(places[met][:, [0, 2]] / site.error.patch).astype(int)
        patch = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
        self.whitening = Whitening(self.variance, patch, patch_variance, pose)

    def of(self, effect: Effect, parameters: Parameters) -> float:
        """Return the effect's signal-to-noise ratio."""
        if effect.stage in ("range", "aim"):
            return self.whitening.strength(self._shift(effect, parameters))
        if effect.stage == "footprint":
            return self._mixed(parameters)
        if effect.stage == "loss":
            return loss_strength(effect.act(parameters, self.shot), self.losses)
        return spread_strength(self._added(effect, parameters), self.variance)

    def apart(self, name: str, parameters: Parameters, rng: Rng) -> tuple[float, str]:
        """Return the ratio after the nearest other mean effect of the catalogue took its share, and that effect's name."""
        wanted, found = self._shift(EFFECTS[name], parameters), {}
        for other in sorted(set(CATALOGUE) - {name} - SHAPED):
            if CATALOGUE[other].stage in ("range", "aim"):
                every = alternatives(CATALOGUE[other], rng, self.shot)
                shifts = [self._shift(CATALOGUE[other], p) for p in every]
                found[other] = self.whitening.strength(wanted, np.stack(shifts, axis=1))
        nearest = min(found, key=lambda each: found[each])
        return found[nearest], nearest

    def _shift(self, effect: Effect, parameters: Parameters) -> Array:
        acted = effect.act(parameters, self.shot)
        if effect.stage == "range":
            return np.asarray(acted)
        true = directions(self.shot.azimuth - acted[0], self.shot.zenith - acted[1])
        ratio = np.sum(self.normal * self.ray, axis=1) / np.sum(self.normal * true, axis=1)
        return np.clip(self.shot.range_m * (ratio - 1), -0.5, 0.5)

    def _mixed(self, parameters: Parameters) -> float:
        """Return the difference between ranges of footprints and of rays as a ratio; a pulse counts 9 at most."""
        far = self.shot.range_m
        mixed, met = _footprint(self.site, self.ray, parameters["divergence_rad"], parameters["mode"], far, far > 0)
        return float(np.sqrt(np.sum(np.where(met, np.minimum((mixed - far) ** 2 / self.variance, 9.0), 0.0))))

    def _added(self, effect: Effect, parameters: Parameters) -> Array:
        acted = effect.act(parameters, self.shot)
        if effect.stage == "step":
            return np.full(len(self.variance), acted**2 / 12)
        if effect.stage == "spread":
            return np.asarray(acted) ** 2
        side = np.stack([-np.sin(self.shot.azimuth), np.cos(self.shot.azimuth), np.zeros(len(self.variance))], axis=1)
        slopes = [np.sum(self.normal * each, axis=1) / self.shot.cosine for each in (side, np.cross(side, self.ray))]
        across = acted[0] * np.sin(self.shot.zenith) * slopes[0]
        return self.shot.range_m**2 * (across**2 + (acted[1] * slopes[1]) ** 2)


def scan(site: Site, pattern: Pattern, noise: Noise, effects: dict[str, Parameters], losses: dict[str, Any], seed: int) -> Scan:
    """One scan with all `effects` (name to parameters) in it; `losses` as `lost` takes them."""
    rng = np.random.default_rng([seed, 1])
    shot, _, _ = look(site, pattern, seed)
    of = {stage: [(EFFECTS[n], p) for n, p in effects.items() if EFFECTS[n].stage == stage] for stage in _STAGES}
    rays, hits, places, cosine = _emitted(site, shot, noise, of, rng)
    met = hits.found.copy()
    true = np.where(met, hits.distance, 1.0)
    for effect, parameters in of["footprint"]:
        true, met = _footprint(site, rays, effect.act(parameters, shot), parameters["mode"], true, met)
    rho = walls.albedo(site.reference, places[:, 0], places[:, 2], np.random.default_rng(seed))
    power = DARKEST + rho * cosine * (REFERENCE_POWER_RANGE_M / true) ** 2
    shot = replace(shot, range_m=true, cosine=cosine, power=power, seen=met.astype(np.float64))
    recorded = true + sum((effect.act(p, shot) for effect, p in of["range"]), np.zeros(len(true)))
    variance = sum((effect.act(p, shot) ** 2 for effect, p in of["spread"]), np.full(len(true), noise.range_m**2))
    recorded = recorded + np.sqrt(variance) * rng.standard_normal(len(true))
    kept = met & ~lost(site, pattern, shot, places, losses, rng)
    for effect, p in of["loss"]:
        gone = rng.random(len(true)) < effect.act(p, shot)
        early = gone & (rng.random(len(true)) < SHARE_FROM_DROPS) & ("rate_per_m" in p)
        recorded = np.where(early, rng.uniform(0.1, 1.0, len(true)) * recorded, recorded)
        kept &= ~gone | early
    for effect, p in of["step"]:
        recorded = np.round(recorded / effect.act(p, shot)) * effect.act(p, shot)
    points = recorded[:, None] * directions(shot.azimuth, shot.zenith)
    clock = 100.0 + 0.05 * shot.line + 0.04 * (shot.zenith - pattern.zenith) / (pattern.pulses * pattern.zenith_step)
    return Scan(points[kept], power[kept], clock[kept], len(true))


_STAGES = ("aim", "ray_spread", "footprint", "range", "spread", "loss", "step")


def _emitted(
    site: Site, shot: Shot, noise: Noise, of: dict[str, list[tuple[Effect, Parameters]]], rng: Rng
) -> tuple[Array, Hits, Array, Array]:
    """Return true rays (scanner frame), what they hit, the places, and the cosines of incidence."""
    aim = sum((effect.act(p, shot) for effect, p in of["aim"]), np.zeros((2, len(shot.line))))
    spread = sum((effect.act(p, shot) ** 2 for effect, p in of["ray_spread"]), np.full((2, len(shot.line)), noise.angle_rad**2))
    off = np.sqrt(spread) * rng.standard_normal((2, len(shot.line))) - aim
    rays = directions(shot.azimuth + off[0], shot.zenith + off[1])
    return rays, *cast(site.truth, site, rays)


def _footprint(site: Site, rays: Array, divergence_rad: float, mode: str, centre: Array, met: Mask) -> tuple[Array, Mask]:
    """Return range and return of a Gaussian beam (full angle at 1/e^2): 18 rays of equal power around the middle one, merged."""
    side = np.cross(rays, [0.0, 0.0, 1.0])
    side = side / np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, rays)
    ranges = [np.where(met, centre, np.inf)]
    for radius, count in RINGS:
        for turn_rad in 2 * np.pi * np.arange(count) / count:
            angle = radius * divergence_rad / 2
            off = rays + np.tan(angle) * (np.cos(turn_rad) * side + np.sin(turn_rad) * up)
            hits, _, _ = cast(site.truth, site, off / np.linalg.norm(off, axis=1, keepdims=True))
            ranges.append(hits.distance)
    echoes = np.stack(ranges, axis=1)
    return _merged(echoes, np.ones(echoes.shape), mode, centre)


def _merged(ranges: Array, weights: Array, mode: str, centre: Array) -> tuple[Array, Mask]:
    """Return the range of merged sub-rays (n, m): their mean, or the mean of the first or the strongest cluster of echoes."""
    order = np.argsort(ranges, axis=1)
    ranges, weights = np.take_along_axis(ranges, order, 1), np.take_along_axis(weights, order, 1)
    weights = np.where(np.isfinite(ranges), weights, 0.0)
    ranges = np.where(np.isfinite(ranges), ranges, 1e9)
    cluster = np.cumsum(np.diff(ranges, axis=1, prepend=ranges[:, :1]) > GAP_BETWEEN_ECHOES_M, axis=1)
    if mode == "strongest":
        sums = np.stack([np.where(cluster == k, weights, 0).sum(axis=1) for k in range(ranges.shape[1])], axis=1)
        weights = np.where(cluster == sums.argmax(axis=1)[:, None], weights, 0.0)
    if mode == "first":
        weights = np.where(cluster == 0, weights, 0.0)
    total = weights.sum(axis=1)
    mean = np.sum(weights * np.where(weights > 0, ranges, 0.0), axis=1) / np.maximum(total, 1e-12)
    return np.where(total > 0, mean, centre), total > 0


def lost(site: Site, pattern: Pattern, shot: Shot, places: Array, losses: dict[str, Any], rng: Rng) -> Mask:
    """Return the (n,) pulses without a record: at random, under bushes, in gaps of scan lines, and from removed double echoes."""
    gone = rng.random(len(shot.line)) < losses["share"]
    gone |= walls.vegetation(site.reference, places[:, 0], places[:, 2], rng, losses["bushes"])
    for _ in range(losses["gaps"]):
        line, first = rng.integers(0, pattern.lines), rng.uniform(shot.zenith.min(), shot.zenith.max())
        gone |= (np.abs(shot.line - line) < 2) & (np.abs(shot.zenith - first) < 0.05)
    if losses["double_removed"]:
        seen = np.where(shot.seen > 0, shot.range_m, np.nan).reshape(pattern.lines, pattern.pulses)
        jump = np.zeros(seen.shape, bool)
        jump[:, 1:] |= np.abs(np.diff(seen, axis=1)) > 0.8
        jump[1:] |= np.abs(np.diff(seen, axis=0)) > 0.8
        gone |= jump.ravel() & (rng.random(len(gone)) < SHARE_OF_DOUBLES)
    return gone


def place(rng: Rng, count: int, noise: Noise, change_count: int) -> tuple[Site, Pattern]:
    """Draw a site with a wall, a scanner in front, aside or below, and a pattern with about `count` pulses on the wall."""
    kind = str(rng.choice(list(walls.WALLS)))
    width, tall = rng.uniform(30, 60), rng.uniform(18, 32)
    reference = walls.make(kind, rng, width, tall, float(np.exp(rng.uniform(np.log(0.1), np.log(0.3)))))
    error = walls.reference_error(reference, rng, noise.range_m * rng.uniform(0.1, 0.4))
    changes = walls.changes(reference, rng, change_count)
    truth = reference.with_height(reference.height + error.field + walls.moved(reference, changes, rng))
    heading = turn(2, rng.uniform(-np.pi, np.pi))
    wall = Frame(heading @ turn(0, rng.uniform(-0.15, 0.1)), rng.uniform(-1e4, 1e4, 3) * [1, 1, 0.02])
    away = rng.uniform(18, 80)
    stand = np.array([rng.uniform(-0.9, 0.9) * away, away, rng.uniform(-0.1, 0.6) * tall])
    facing = np.arctan2(-stand[1], -stand[0]) + rng.uniform(-0.8, 0.8)
    tilt = small_turn(np.array([*rng.normal(0, 0.005, 2), 0.0]))
    surveyed = Frame(heading @ turn(2, facing) @ tilt, wall.outward(stand))
    slip = small_turn(rng.normal(0, 3e-4, 3))
    standing = Frame(surveyed.rotation @ slip, surveyed.position + rng.normal(0, 0.01, 3))
    site = Site(kind, reference, truth, error, changes, wall, surveyed, standing)
    return site, _pattern(site, rng, count)


def _pattern(site: Site, rng: Rng, count: int) -> Pattern:
    """Return angular steps (unequal) and a sector so that about `count` pulses hit the wall."""
    seen = site.surveyed.inward(site.wall.outward(site.reference.vertices()))
    range_m = np.linalg.norm(seen, axis=1)
    azimuth, zenith = np.arctan2(seen[:, 1], seen[:, 0]), np.arccos(seen[:, 2] / range_m)
    (a0, a1), (z0, z1) = np.percentile(azimuth, [1.5, 98.5]), np.percentile(zenith, [1.5, 98.5])
    step, ratio = np.sqrt((a1 - a0) * (z1 - z0) / count), rng.uniform(0.6, 1.7)
    lines, pulses = int((a1 - a0) / (step * ratio)) + 1, int((z1 - z0) * ratio / step) + 1
    return Pattern(float(a0), float(z0), float(step * ratio), float(step / ratio), lines, pulses)


def size(effect: Effect, parameters: Parameters, strength: Strength, wanted: float) -> Parameters:
    """Parameters with the wanted strength, where the effect's size is free."""
    return solve_size(effect, parameters, lambda p: strength.of(effect, p), wanted) if effect.sizes else parameters
