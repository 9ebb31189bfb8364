"""Simulate a stereo pair in closed form.

Rays are cast from both real cameras, disparities run along rectified rows, and points are reconstructed by the nominal cameras.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from . import walls
from .camera import LENS, Camera, Pair
from .effects import Effect, Parameters, Whitening, alternatives, solve_size, spread_strength
from .frames import Frame, small_turn, turn
from .stereo_effects import CATALOGUE, EFFECTS, SHAPED, Match, grid_noise
from .surface import Array, Mask, Surface

Rng = np.random.Generator
HIDDEN_M = 0.02  # the right camera sees something so much nearer: hidden, and no rounding
OUTLIER_Z2 = 9.0  # no pixel counts for more, as a robust evaluation would limit it too


@dataclass(frozen=True)
class Site:
    """Reference and true surface (wall's frame), that frame's stated and true place, and the nominal pair."""

    kind: str
    reference: Surface
    truth: Surface
    error: walls.ReferenceError
    changes: list[walls.Change]
    wall: Frame
    standing: Frame
    pair: Pair


@dataclass(frozen=True)
class Noise:
    """White noise, and a grid of Gaussian values interpolated with `order`, of the disparity, px."""

    white_px: float
    grid_px: float
    step_px: float
    order: int


@dataclass(frozen=True)
class Cloud:
    """Reconstructed points (n, 3), world frame, m, their left pixels (n, 2), disparities (n,) px; how many were filled in."""

    points: Array
    pixels: Array
    disparity: Array
    filled: int


@dataclass(frozen=True)
class View:
    """What left pixels see: disparities by the nominal pair (n,), px; normals and places (n, 3), wall's frame."""

    disparity: Array
    normal: Array
    place: Array
    met: Mask
    hidden: Mask


def raster(pair: Pair, stride: float) -> tuple[Array, tuple[int, int]]:
    """Left pixels (n, 2) every `stride` px, row after row, and (rows, columns)."""
    rows = np.arange(stride / 2, pair.left.height, stride)
    columns = np.arange(stride / 2, pair.left.width, stride)
    v, u = np.meshgrid(rows, columns, indexing="ij")
    return np.stack([u.ravel(), v.ravel()], axis=1), v.shape


def view(surface: Surface, wall: Frame, nominal: Pair, real: tuple[Camera, Camera], pixels: Array) -> View:
    """Cast left pixels through the real left camera, and find what they meet in the real right one."""
    left, right = (camera.frame.within(wall) for camera in real)
    rays = real[0].rays(pixels) @ left.rotation.T
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    hits = surface.cast(left.position, rays)
    met = hits.found.copy()
    place = left.position + rays * np.where(met, hits.distance, 1.0)[:, None]
    back = place - right.position
    far = np.linalg.norm(back, axis=1)
    hidden = met & (surface.cast(right.position, back / far[:, None]).distance < far - HIDDEN_M)
    other = real[1].project(wall.outward(place))
    met &= np.all((other > 0) & (other < [real[1].width, real[1].height]), axis=1)
    disparity = np.full(len(pixels), np.nan)
    disparity[met] = nominal.disparity(pixels[met], other[met])
    return View(disparity, hits.normal, place, met, hidden)


def real_pair(pair: Pair, effects: dict[str, Parameters]) -> tuple[Camera, Camera]:
    """Return the nominal pair with the effects of the stage `camera` in it."""
    left, right = pair.left, pair.right
    for name, parameters in effects.items():
        if EFFECTS[name].stage == "camera":
            left, right = EFFECTS[name].act(parameters, Pair(left, right))
    return left, right


def match(site: Site, seen: View, pixels: Array, shape: tuple[int, int], stride: float) -> Match:
    """Return what effects of the matcher may depend on, for all left pixels (disparity NaN without a match)."""
    return Match(pixels[:, 0], pixels[:, 1], seen.disparity, site.pair, stride, shape)


class Strength:
    """Signal-to-noise ratios of effects at one site, from tangent planes (no casting) and the map of disparities."""

    def __init__(self, site: Site, noise: Noise, stride: float) -> None:
        pixels, shape = raster(site.pair, stride)
        seen = view(site.reference, site.wall, site.pair, (site.pair.left, site.pair.right), pixels)
        self.site, self.noise, self.stride, self.met = site, noise, stride, seen.met & ~seen.hidden
        self.map = np.where(self.met, seen.disparity, np.nan).reshape(shape)
        self.whole = match(site, seen, pixels, shape, stride)
        at = self.met
        self.pixels, self.disparity = pixels[at], seen.disparity[at]
        self.match = Match(pixels[at, 0], pixels[at, 1], self.disparity, site.pair, stride, shape)
        self.normal = seen.normal[at] @ site.wall.rotation.T
        self.place = site.wall.outward(seen.place[at])
        self.variance = np.full(at.sum(), noise.white_px**2 + noise.grid_px**2)
        ray = self.place - site.pair.left.frame.position
        self.range_m = np.linalg.norm(ray, axis=1)
        self.cosine = np.maximum(np.abs(np.sum(ray * self.normal, axis=1)) / self.range_m, 0.05)
        per_metre = self.disparity / self.range_m / self.cosine
        patch_variance = (site.error.sigma * seen.normal[at, 1] * per_metre) ** 2
        cell = np.floor(seen.place[at][:, [0, 2]] / site.error.patch).astype(int)
        patch = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
        self.whitening = Whitening(self.variance, patch, patch_variance, self._pose(per_metre))

    def _pose(self, per_metre: Array) -> Array:
        """Return the (n, 6) disparity per metre and per radian of a rigid movement of the wall; it grows towards the camera."""
        middle = self.place - self.place.mean(axis=0)
        return np.concatenate([self.normal, np.cross(middle, self.normal)], axis=1) * per_metre[:, None]

    def of(self, effect: Effect, parameters: Parameters) -> float:
        """Return the effect's signal-to-noise ratio; 0 for `fill`, which is counted afterwards."""
        if effect.stage in ("camera", "disparity"):
            return self.whitening.strength(self._shift(effect, parameters))
        if effect.stage == "spread":
            return spread_strength(effect.act(parameters, self.match) ** 2, self.variance)
        if effect.stage == "field":
            return self._field(parameters)
        if effect.stage == "map":
            shift = (effect.act(parameters, self.map, self.stride) - self.map).ravel()[self.met]
            return float(np.sqrt(np.sum(np.minimum(shift**2 / self.variance, OUTLIER_Z2))))
        return 0.0

    def _field(self, parameters: Parameters) -> float:
        """Return the signal-to-noise ratio of grid noise.

        A node is seen by (step / stride)^2 points. It stands out against white noise, the model's own grid noise and the
        reference's error.
        """
        many = max((parameters["step_px"] / self.stride) ** 2, 1.0)
        own = max((self.noise.step_px / self.stride) ** 2, 1.0)
        known = self.noise.white_px**2 / many + self.noise.grid_px**2 * min(own / many, 1.0)
        known += float(self.whitening.patch_variance.mean())
        nodes = max(int(len(self.variance) / many), 1)
        return spread_strength(np.full(nodes, parameters["sigma_px"] ** 2 * 4 / 9), np.full(nodes, known))

    def apart(self, name: str, parameters: Parameters, rng: Rng) -> tuple[float, str]:
        """Return the ratio after the nearest other mean effect of the catalogue took its share, and that effect's name."""
        wanted, found = self._shift(EFFECTS[name], parameters), {}
        for other in sorted(set(CATALOGUE) - {name} - SHAPED):
            if CATALOGUE[other].stage == "camera":
                drawn = alternatives(CATALOGUE[other], rng, self.match)
                shifts = [self._shift(CATALOGUE[other], {**p, "camera": side}) for p in drawn for side in ("left", "right")]
                found[other] = self.whitening.strength(wanted, np.stack(shifts, axis=1))
        nearest = min(found, key=lambda each: found[each])
        return found[nearest], nearest

    def _shift(self, effect: Effect, parameters: Parameters) -> Array:
        if effect.stage == "disparity":
            return np.asarray(effect.act(parameters, self.match))
        left, right = effect.act(parameters, self.site.pair)
        rays = left.rays(self.pixels) @ left.frame.rotation.T
        along = np.sum((self.place - left.frame.position) * self.normal, axis=1) / np.sum(rays * self.normal, axis=1)
        other = right.project(left.frame.position + rays * along[:, None])
        return np.clip(self.site.pair.disparity(self.pixels, other) - self.disparity, -20, 20)


def reconstruct(
    site: Site, noise: Noise, effects: dict[str, Parameters], losses: dict[str, Any], stride: float, seed: int
) -> Cloud:
    """One surface with all `effects` (name to parameters) in it."""
    rng = np.random.default_rng([seed, 2])
    pixels, shape = raster(site.pair, stride)
    seen = view(site.truth, site.standing, site.pair, real_pair(site.pair, effects), pixels)
    disparity = np.where(seen.met & ~seen.hidden, seen.disparity, np.nan)
    chosen = {stage: [(EFFECTS[n], p) for n, p in effects.items() if EFFECTS[n].stage == stage] for stage in _STAGES}
    for effect, p in chosen["map"]:
        disparity = effect.act(p, disparity.reshape(shape), stride).ravel()
    for _, p in chosen["fill"]:
        disparity = filled(disparity.reshape(shape), (seen.hidden & seen.met).reshape(shape), p["reach_px"] / stride).ravel()
    known = Match(pixels[:, 0], pixels[:, 1], np.nan_to_num(disparity), site.pair, stride, shape)
    recorded = disparity + sum((effect.act(p, known) for effect, p in chosen["disparity"]), np.zeros(len(pixels)))
    recorded = recorded + _drawn(rng, noise, chosen, known)
    kept = np.isfinite(recorded) & (rng.random(len(pixels)) > losses["share"])
    kept &= ~walls.vegetation(site.reference, seen.place[:, 0], seen.place[:, 2], rng, losses["bushes"])
    points = site.pair.points(pixels[kept], recorded[kept])
    return Cloud(points, pixels[kept], recorded[kept], int(np.sum(kept & seen.hidden)))


_STAGES = ("map", "fill", "disparity", "spread", "field")


def _drawn(rng: Rng, noise: Noise, chosen: dict[str, list[tuple[Effect, Parameters]]], known: Match) -> Array:
    """(n,) px: white noise and grids, the model's and those of effects."""
    variance = sum((effect.act(p, known) ** 2 for effect, p in chosen["spread"]), np.full(len(known.u), noise.white_px**2))
    drawn = np.sqrt(variance) * rng.standard_normal(len(known.u))
    drawn = drawn + noise.grid_px * grid_noise(rng, known.shape, known.stride, noise.step_px, noise.order).ravel()
    for _, p in chosen["field"]:
        drawn = drawn + p["sigma_px"] * grid_noise(rng, known.shape, known.stride, p["step_px"], noise.order).ravel()
    return drawn


def filled(disparity: Array, hidden: Mask, reach: float) -> Array:
    """Fill half-occluded pixels within `reach` columns of matched ones with the background's disparity.

    disparity, hidden: (rows, columns). The background is the side with the smaller disparity.
    """
    columns = np.arange(disparity.shape[1])
    there = np.isfinite(disparity)
    before = np.maximum.accumulate(np.where(there, columns, -1), axis=1)
    after = np.minimum.accumulate(np.where(there, columns, 10**6)[:, ::-1], axis=1)[:, ::-1]
    rows = np.arange(len(disparity))[:, None]
    low = np.where(before >= 0, disparity[rows, np.maximum(before, 0)], np.inf)
    high = np.where(after < 10**6, disparity[rows, np.minimum(after, columns[-1])], np.inf)
    away = np.where(low <= high, columns - before, after - columns)
    value = np.minimum(low, high)
    return np.where(hidden & (away <= reach) & np.isfinite(value), value, disparity)


def _camera(rng: Rng, width: int, height: int, frame: Frame) -> Camera:
    focal = width * rng.uniform(0.9, 1.5)
    lens = dict.fromkeys(LENS, 0.0) | {"f_px": focal, "cx_px": rng.normal(0, 12), "cy_px": rng.normal(0, 12)}
    lens |= {"k1": rng.normal(0, 0.04), "k2": rng.normal(0, 0.02), "p1": rng.normal(0, 2e-4), "p2": rng.normal(0, 2e-4)}
    lens |= {"b1": rng.normal(0, 0.5), "b2": rng.normal(0, 0.5)}
    return Camera(width, height, {name: float(value) for name, value in lens.items()}, frame)


def place(rng: Rng, change_count: int, reference_share: float, straight: bool) -> Site:
    """Draw a wall and a pair in front of it.

    straight: the normal case with one camera body, where a disparity has only one meaning; reference_share: error of the
    reference in px of disparity.
    """
    kind = str(rng.choice(list(walls.WALLS)))
    width, tall = rng.uniform(36, 64), rng.uniform(24, 40)
    reference = walls.make(kind, rng, width, tall, float(np.exp(rng.uniform(np.log(0.12), np.log(0.3)))))
    pixels = int(rng.choice([1600, 2400, 4000, 5472]))
    shape = pixels, int(pixels * rng.choice([0.667, 0.75, 0.5625]))
    body = _camera(rng, *shape, Frame(np.eye(3), np.zeros(3)))
    away = float(rng.uniform(0.75, 0.95) * min(width / shape[0], tall / shape[1] * 1.1) * body.lens["f_px"])
    base = away * float(rng.uniform(0.12, 0.3))
    cameras = [_aimed(rng, body, np.array([side * base / 2, away, tall / 2]), 0.0 if straight else 1.0) for side in (1, -1)]
    if not straight and rng.random() < 0.5:
        other = _camera(rng, *shape, cameras[1].frame)
        cameras[1] = other.with_lens(f_px=body.lens["f_px"] * rng.uniform(0.995, 1.005) - other.lens["f_px"])
    sigma = reference_share * away / (body.lens["f_px"] * base / away)
    error = walls.reference_error(reference, rng, sigma)
    changes = walls.changes(reference, rng, change_count)
    truth = reference.with_height(reference.height + error.field + walls.moved(reference, changes, rng))
    wall = Frame(turn(2, rng.uniform(-np.pi, np.pi)) @ turn(0, rng.uniform(-0.1, 0.1)), rng.uniform(-1e4, 1e4, 3) * [1, 1, 0.02])
    standing = Frame(wall.rotation @ small_turn(rng.normal(0, 2e-4, 3)), wall.position + rng.normal(0, 0.015, 3))
    pair = Pair(*(camera.with_frame(camera.frame.of(wall)) for camera in cameras))
    return Site(kind, reference, truth, error, changes, wall, standing, pair)


def _aimed(rng: Rng, body: Camera, at: Array, loose: float) -> Camera:
    """Return a camera that looks half-way to the wall's middle (convergent), slightly askew.

    at: its place, wall frame, m; loose: how much its direction and place scatter. Image axes are x right, y down.
    """
    toe = loose * rng.uniform(0.2, 1.0) * np.arctan2(at[0], at[1])
    facing = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
    askew = small_turn(loose * rng.normal(0, [0.01, 0.004, 0.01]))
    offset = loose * rng.normal(0, 0.2, 3)
    return body.with_frame(Frame(turn(2, -toe) @ facing @ askew, at + offset))


def size(effect: Effect, parameters: Parameters, strength: Strength, wanted: float) -> Parameters:
    """Parameters with the wanted strength, where the effect's size is free."""
    return solve_size(effect, parameters, lambda p: strength.of(effect, p), wanted) if effect.sizes else parameters
