"""Make a laser scanner's measurement folder: closed-form effects, rays by Open3D, nuisance effects always on."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr

from benchmarks.gap_closed_form import tls_effects as effects
from benchmarks.gap_closed_form.baselines import Data, rivals
from benchmarks.gap_closed_form.casting import AT_ONCE, Array, Surface
from benchmarks.gap_closed_form.files import write_mesh, write_points, write_yaml
from benchmarks.gap_closed_form.strength import (
    Strength,
    Target,
    Whitener,
    loss_distance,
    mean_strength,
    scaled,
    spread_distance,
    spread_strength,
)
from benchmarks.gap_closed_form.tls_effects import Parameters, Rays
from benchmarks.gap_closed_form.walls import (
    Fall,
    Place,
    Random,
    Wall,
    draw_falls,
    draw_place,
    draw_wall,
    small_turn,
    turn,
    wave_numbers,
    waves,
)

CATALOGUE = (*effects.MEAN, *effects.SPREAD, *effects.OTHER)
OFF_CATALOGUE = (*effects.OFF_MEAN, *effects.OFF_SPREAD, *effects.OFF_LOSS)
_LINEAR, _SPREADING = {**effects.MEAN, **effects.OFF_MEAN}, {**effects.SPREAD, **effects.OFF_SPREAD}
_LOST = 0.01
_GRAZING, _STEEP = 0.02, 0.12
"""Cosines of the incidence angle: below the first there is no return; below the second a case's own figures ignore a return."""
_MOST_PULSES = 200_000
"""Strengths and alternatives are computed on at most this many, evenly chosen pulses, to limit the memory for a hundred
signatures.
"""
_PULSE_M = 0.45
"""Echoes nearer than this merge into one, m: half the length of a 3 ns pulse."""
_WHITE_ALBEDO, _SMOOTH_ALBEDO = 0.25, 0.3


@dataclass(frozen=True)
class Set:
    """The set-up of a case.

    Attributes
    ----------
    real, known : Scanned surface, and reference, local frame.
    position, rotation : Nominal pose, scanner to local frame.
    true_position, true_rotation : True pose.
    reference : Standard deviation and correlation length of the reference's error, m.
    """

    wall: Wall
    real: Surface
    known: Surface
    place: Place
    falls: list[Fall]
    position: Array
    rotation: Array
    true_position: Array
    true_rotation: Array
    azimuth: Array
    zenith: Array
    sigma: tuple[float, float]
    reference: tuple[float, float]
    albedo_level: float
    fields: set[str]
    frame: str
    known_effects: list[tuple[str, Parameters]]
    blobs: bool


@dataclass
class Shot:
    """One scan. rays: of every pulse, as recorded; ranges: recorded, NaN without a return."""

    rays: Rays
    ranges: Array
    blob: Array


def make(
    folder: Path, random: Random, kinds: list[str], falls: int, points: int, nodes: int, baselines: bool = True
) -> dict[str, Any]:
    """Write a measurement with the effects `kinds`, and return its truth, with or without the answers of the baselines."""
    scene = _draw(random, kinds, falls, points, nodes)
    rays, pose, at = _expected(scene)
    albedo, blob = _albedo(scene, rays, random), _blobs(scene, at, random)
    rays = replace(rays, power=albedo * rays.cos_i * (100 / rays.R) ** 2)
    weighed = np.arange(len(rays.R)) % -(-len(rays.R) // _MOST_PULSES) == 0
    usable = weighed & np.isfinite(rays.R) & (rays.cos_i > _STEEP) & ~blob
    drawn = _drawn(scene, kinds, rays, usable, pose, at, random)
    shot = _shoot(scene, [*((name, p) for name, p, _ in drawn), *scene.known_effects], albedo, blob, random)
    kept = np.isfinite(shot.ranges)
    rows = weighed & kept & np.isfinite(rays.R) & (rays.cos_i > _STEEP)
    _write(folder, scene, shot, kept)
    return {
        "sensor": "tls",
        "points": int(kept.sum()),
        "distance_m": float(np.nanmedian(rays.R)),
        "fields": sorted(scene.fields),
        "effects": [{"name": name, "parameters": p, **strength.to_dict()} for name, p, strength in drawn],
        "changes": [fall.world_box(scene.wall, scene.place) for fall in scene.falls],
        "nuisances": {"range_sigma_m": scene.sigma[0], "angle_sigma_rad": scene.sigma[1], "reference_m": scene.reference},
        "known": [name for name, _ in scene.known_effects],
        **(_rivals(scene, drawn, rays, shot, rows, pose[rows], at[rows]) if baselines else {}),
    }


def _rivals(scene: Set, drawn: list[Any], rays: Rays, shot: Shot, rows: Array, pose: Array, at: Array) -> dict[str, Any]:
    """Return the answers of the baselines to the ranges in `rows`, whose columns of the pose and places are given."""
    recorded = replace(rays, power=shot.rays.power).part(rows)
    value = (shot.ranges - rays.R)[rows]
    value = value - sum(effects.signature(name, p, recorded) for name, p in scene.known_effects)
    data = Data(value, _sigma(scene, recorded), pose, at)
    true_mean = [effects.signature(name, p, recorded) for name, p, _ in drawn if name in effects.MEAN]
    return rivals(data, effects.families(recorded, scene.fields), effects.forms(recorded, scene.fields), true_mean)


def _draw(random: Random, kinds: list[str], falls: int, points: int, nodes: int) -> Set:
    steps = "beam_divergence" in kinds or random.uniform() < 0.5
    wall = draw_wall(random, nodes, steps)
    width, height = wall.size
    distance = float(np.clip(random.uniform(0.4, 1.6) * width, 12, 90))
    position = np.array([random.uniform(0.1, 0.9) * width, wall.depth.min() - distance, random.uniform(-1, 0.4 * height)])
    rotation = turn(2, random.uniform(-np.pi, np.pi)) @ small_turn(random.uniform(-0.009, 0.009, 3))
    shift, skew = random.uniform(1e-3, 3e-3) * random.standard_normal(3), random.uniform(2e-5, 6e-5) * random.standard_normal(3)
    reference = random.uniform(2e-4, 8e-4), random.uniform(1.5, 6.0)
    found = draw_falls(wall, falls, random)
    x, z = wall.nodes()
    known = wall.deeper(reference[0] * waves(x, z, reference[1], random))
    needed = set().union(*(effects.NEEDS.get(kind, set()) for kind in kinds))
    given = {field for field in ("intensity", "gps_time", "pattern") if random.uniform() < 0.75} | needed
    azimuth, zenith = _pattern(wall, position, rotation, points, random)
    return Set(
        wall=wall,
        real=wall.deeper(sum((fall.change(wall) for fall in found), np.zeros_like(wall.depth))).surface(),
        known=known.surface(),
        place=draw_place(random),
        falls=found,
        position=position,
        rotation=rotation,
        true_position=position + shift,
        true_rotation=small_turn(skew) @ rotation,
        azimuth=azimuth,
        zenith=zenith,
        sigma=(float(random.uniform(0.0015, 0.005)), float(random.uniform(1e-5, 5e-5))),
        reference=reference,
        albedo_level=float(random.uniform(0.15, 0.5)),
        fields=given,
        frame="world" if random.uniform() < 0.2 else "scanner",
        known_effects=_known(kinds, random),
        blobs=bool(random.uniform() < 0.3),
    )


def _known(kinds: list[str], random: Random) -> list[tuple[str, Parameters]]:
    """Return effects that the model already contains: in one case of eight, one that is in the data and in model.yaml."""
    known = {
        "range_scale": {"scale_ppm": float(random.uniform(20, 80))},
        "vertical_index": {"offset_rad": float(random.uniform(5e-5, 3e-4))},
    }
    name = str(random.choice(sorted(known)))
    return [(name, known[name])] if random.uniform() < 0.125 and name not in kinds else []


def _pattern(wall: Wall, position: Array, rotation: Array, points: int, random: Random) -> tuple[Array, Array]:
    """Return azimuths and zenith angles that cover the wall, or nearly."""
    x, y, z = ((wall.vertices - position) @ rotation).T
    middle = np.arctan2(y.mean(), x.mean())
    azimuth = middle + np.angle(np.exp(1j * (np.arctan2(y, x) - middle)))
    zenith = np.arctan2(np.hypot(x, y), z)
    ends = [
        np.quantile(angle, [q, 1 - q]) for angle, q in ((azimuth, random.uniform(0, 0.02)), (zenith, random.uniform(0, 0.02)))
    ]
    step = np.sqrt(np.prod([np.ptp(end) for end in ends]) / points)
    ratio = np.exp(random.uniform(-0.3, 0.3))
    return tuple(np.arange(end[0], end[1], step * r) for end, r in zip(ends, (ratio, 1 / ratio), strict=True))  # type: ignore[return-value]


def _directions(azimuth: Array, zenith: Array) -> Array:
    return np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=1)


def _grid(scene: Set) -> tuple[Array, Array, Array, Array]:
    """Return azimuth, zenith angle, line and share of the duration of every pulse."""
    az, ze = (grid.ravel() for grid in np.meshgrid(scene.azimuth, scene.zenith, indexing="ij"))
    line = np.repeat(np.arange(len(scene.azimuth)), len(scene.zenith)).astype(float)
    return az, ze, line, np.arange(len(az)) / (len(az) - 1)


def _expected(scene: Set) -> tuple[Rays, Array, Array]:
    """Return what reference and survey predict for every pulse: rays, effect of the pose (n, 6), place on the wall (n, 2)."""
    grid = _grid(scene)
    parts = [_expected_of(scene, *(each[first : first + AT_ONCE] for each in grid)) for first in range(0, len(grid[0]), AT_ONCE)]
    rays, pose, at = zip(*parts, strict=True)
    columns = {field.name: np.concatenate([getattr(part, field.name) for part in rays]) for field in fields(Rays)}
    return Rays(**columns), np.concatenate(pose), np.concatenate(at)


def _expected_of(scene: Set, az: Array, ze: Array, line: Array, share: Array) -> tuple[Rays, Array, Array]:
    ray = _directions(az, ze) @ scene.rotation.T
    R, normal = scene.known.cast(scene.position, ray)
    across = np.stack([-np.sin(az), np.cos(az), np.zeros_like(az)], axis=1) @ scene.rotation.T * np.sin(ze)[:, None]
    up = _directions(az, ze + np.pi / 2) @ scene.rotation.T
    along = np.einsum("ni,ni->n", ray, normal)
    slopes = [-R * np.einsum("ni,ni->n", normal, tangent) / along for tangent in (across, up)]
    cos_i = np.maximum(np.abs(along), 1e-3)
    rays = Rays(az, ze, R, cos_i, np.ones_like(R), line, share, *slopes)
    pose = -np.concatenate([normal, R[:, None] * np.cross(ray, normal)], axis=1) / along[:, None]
    return rays, pose, (scene.position + R[:, None] * ray)[:, [0, 2]]


def _albedo(scene: Set, rays: Rays, random: Random) -> Array:
    smooth = waves(rays.az * np.nanmedian(rays.R), rays.ze * np.nanmedian(rays.R), 5.0, random)
    return scene.albedo_level * np.exp(_SMOOTH_ALBEDO * smooth + _WHITE_ALBEDO * random.standard_normal(len(smooth)))


def _blobs(scene: Set, at: Array, random: Random) -> Array:
    """Return the (n,) pulses that shrubs intercept: a few round patches."""
    hidden = np.zeros(len(at), dtype=bool)
    if scene.blobs:
        for _ in range(random.integers(1, 5)):
            centre = random.uniform(0, 1, 2) * scene.wall.size
            hidden |= np.hypot(*(at - centre).T) < random.uniform(0.4, 1.6)
    return hidden


def _sigma(scene: Set, rays: Rays) -> Array:
    """Return the (n,) standard deviation of a range that the model predicts, m."""
    return np.sqrt(scene.sigma[0] ** 2 + scene.sigma[1] ** 2 * (rays.by_az**2 + rays.by_ze**2))


def _drawn(
    scene: Set, kinds: list[str], rays: Rays, usable: Array, pose: Array, at: Array, random: Random
) -> list[tuple[str, Parameters, Strength]]:
    """Draw effects, each scaled so that it alone has its drawn strength; returned strengths are those beside the others."""
    part, sigma = rays.part(usable), _sigma(scene, rays.part(usable))
    families, forms = effects.families(part, scene.fields), effects.forms(part, scene.fields)
    found: list[tuple[str, Parameters, Strength | None]] = []
    for kind in kinds:
        target = Target.draw(random)
        if kind in _LINEAR:
            start, most = _LINEAR[kind]
            unit = effects.shape(kind, part, random)
            alone = mean_strength(
                kind, effects.signature(kind, unit, part), pose[usable], families, _whitener(scene, sigma, at[usable])
            )
            found.append((kind, effects.times(unit, min(target.value / max(target.of(alone), 1e-9), most / start)), None))
        elif kind in _SPREADING:
            start, most = _SPREADING[kind]
            unit = effects.shape(kind, part, random)
            added = effects.variance(kind, unit, part)
            factor = scaled(lambda f: spread_distance(sigma**2 + f**2 * added, sigma**2), target.value, most / start)  # noqa: B023
            found.append((kind, effects.times(unit, factor), None))
        else:
            found.append((kind, *_special(kind, scene, part, sigma, random)))
    added = {kind: effects.variance(kind, p, part) for kind, p, _ in found}
    shown = {kind: effects.signature(kind, p, part)[:, None] for kind, p, _ in found if kind in _LINEAR}
    whole = sum(added.values(), sigma**2)
    whiten = _whitener(scene, np.sqrt(whole), at[usable])
    strong: list[tuple[str, Parameters, Strength]] = []
    for kind, p, strength in found:
        if kind in _LINEAR:
            base = np.concatenate([pose[usable], *(column for other, column in shown.items() if other != kind)], axis=1)
            strength = mean_strength(kind, shown[kind][:, 0], base, families, whiten)
        elif kind in _SPREADING:
            strength = spread_strength(kind, added[kind], whole - added[kind], forms)
        assert strength is not None
        strong.append((kind, p, strength))
    return strong


def _whitener(scene: Set, sigma: Array, at: Array) -> Whitener:
    waved = wave_numbers(scene.reference[1], 250, np.random.default_rng(0))
    angle = at @ waved.T
    features = np.concatenate([np.sin(angle), np.cos(angle)], axis=1) * scene.reference[0] / np.sqrt(250)
    return Whitener(sigma, at, features)


def _special(kind: str, scene: Set, rays: Rays, sigma: Array, random: Random) -> tuple[Parameters, Strength]:
    """Draw range quantisation, footprints and losses, which are neither mean nor variance effects."""
    base = np.full(len(rays.R), _LOST)
    if kind == "range_quantization":
        step = float(np.exp(random.uniform(np.log(2e-4), np.log(0.02))))
        snr = np.sqrt(2 * len(rays.R))
        return {"step_m": step}, Strength(snr, "", snr)
    if kind == "beam_divergence":
        p = {
            "divergence_rad": float(np.exp(random.uniform(np.log(2e-4), np.log(2e-3)))),
            "mode": str(random.choice(["mean", "first", "strongest"])),
        }
        mixed = _footprint(scene, rays, p)[0] - rays.R
        snr = float(np.linalg.norm(np.clip(np.nan_to_num(mixed) / sigma, -20, 20)))
        return p, Strength(snr, "", snr)
    if kind == "detection_limit":
        level = np.log(rays.cos_i * (100 / rays.R) ** 2 * scene.albedo_level)
        spread = np.hypot(_WHITE_ALBEDO, _SMOOTH_ALBEDO)
        limit = float(np.quantile(level, 0.5) + random.uniform(-3.2, 0.3) * np.hypot(spread, level.std()))
        chance = base + (1 - _LOST) * ndtr((limit - level) / spread)
        snr = loss_distance(chance, np.full_like(chance, chance.mean()))
        rain = min(
            loss_distance(chance, 1 - (1 - q) * np.exp(-2 * b * rays.R))
            for b in np.geomspace(1e-6, 0.05, 40)
            for q in (0, 0.003, 0.01, 0.03)
        )
        return {"minimum_power": float(np.exp(limit))}, Strength(snr, "precipitation", min(rain, snr))
    if kind == "precipitation":
        rate, early = (
            float(np.exp(random.uniform(np.log(3e-5), np.log(4e-3)))),
            float(random.choice([0.0, random.uniform(0, 0.3)])),
        )
        gone = 1 - np.exp(-2 * rate * rays.R)
        chance = base + (1 - _LOST) * gone * (1 - early)
        plain = loss_distance(chance, np.full_like(chance, chance.mean()))
        snr = float(np.hypot(plain, np.sqrt(20 * gone.sum() * early)))
        return {"rate_per_m": rate, "early_share": early}, Strength(snr, "detection_limit", snr)
    p = {
        "where": float(np.quantile(rays.az, random.uniform(0.2, 0.8))),
        "width": float(np.ptp(rays.az) * random.uniform(0.05, 0.2)),
        "share": float(random.uniform(0.05, 0.6)),
    }
    chance = base + p["share"] * (np.abs(rays.az - p["where"]) < p["width"] / 2)
    snr = loss_distance(chance, np.full_like(chance, chance.mean()))
    return p, Strength(snr, "precipitation", snr)


def _footprint(scene: Set, rays: Rays, p: Parameters, seen: Surface | None = None) -> tuple[Array, Array]:
    """Return the range by the whole beam and the range along its axis, (n,) each, m.

    A Gaussian beam has 19 sub-rays; echoes within a pulse length are merged.
    """
    surface = scene.known if seen is None else seen
    position, rotation = (scene.position, scene.rotation) if seen is None else (scene.true_position, scene.true_rotation)
    radius = np.concatenate([[0.0], np.full(6, 0.5), np.full(12, 1.0)]) * p["divergence_rad"] / 2
    angle = np.concatenate([[0.0], np.arange(6) * np.pi / 3, np.arange(12) * np.pi / 6 + np.pi / 12])
    weight = np.exp(-2 * (radius / (p["divergence_rad"] / 2)) ** 2) * np.concatenate(
        [[0.25], np.full(6, 0.25), np.full(12, 0.25)]
    )
    ranges, powers = [], []
    for r, a, w in zip(radius, angle, weight, strict=True):
        ray = _directions(rays.az + r * np.cos(a) / np.sin(rays.ze), rays.ze + r * np.sin(a)) @ rotation.T
        distance, normal = surface.cast(position, ray)
        ranges.append(distance)
        powers.append(np.where(np.isfinite(distance), w * np.abs(np.einsum("ni,ni->n", ray, normal)) / distance**2, 0.0))
    return _merged(np.stack(ranges, axis=1), np.nan_to_num(np.stack(powers, axis=1)), p["mode"]), np.asarray(ranges[0])


def _merged(ranges: Array, powers: Array, mode: str) -> Array:
    order = np.argsort(ranges, axis=1)
    ranges, powers = np.take_along_axis(ranges, order, 1), np.take_along_axis(powers, order, 1)
    if mode == "mean":
        return np.nansum(ranges * powers, axis=1) / np.maximum(powers.sum(axis=1), 1e-300)
    group = np.concatenate([np.zeros((len(ranges), 1)), np.cumsum(np.diff(ranges, axis=1) > _PULSE_M, axis=1)], axis=1)
    total = np.stack([np.where(group == k, powers, 0).sum(axis=1) for k in range(4)], axis=1)
    centre = np.stack([np.nansum(np.where(group == k, powers * ranges, 0), axis=1) for k in range(4)], axis=1) / np.maximum(
        total, 1e-300
    )
    chosen = np.zeros(len(ranges), dtype=int) if mode == "first" else np.argmax(total, axis=1)
    return np.take_along_axis(centre, chosen[:, None], 1)[:, 0]


def _shoot(scene: Set, drawn: list[tuple[str, Parameters]], albedo: Array, blob: Array, random: Random) -> Shot:
    """Simulate the scan with all effects, in their physical order: aim, footprint, range, return."""
    az, ze, line, share = _grid(scene)
    nothing = np.zeros_like(az)
    aimed = Rays(az, ze, nothing, nothing + 1, nothing + 1, line, share, nothing, nothing)
    d_az, d_ze = scene.sigma[1] * random.standard_normal((2, len(az)))
    for name, p in drawn:
        more = effects.angle_errors(name, p, aimed)
        if name == "angle_noise":
            keys = ("azimuth_sigma_rad", "zenith_sigma_rad")
            more = tuple(p[key] * random.standard_normal(len(az)) for key in keys)  # type: ignore[assignment]
        d_az, d_ze = d_az + more[0], d_ze + more[1]
    true = replace(aimed, az=az - d_az, ze=ze - d_ze)
    ray = _directions(true.az, true.ze) @ scene.true_rotation.T
    R, normal = scene.real.cast(scene.true_position, ray)
    cos_i = np.abs(np.einsum("ni,ni->n", ray, normal))
    back = np.isfinite(R) & (cos_i > _GRAZING) & ~blob & (random.uniform(size=len(R)) > _LOST)
    for name, p in drawn:
        if name == "beam_divergence":
            R = _footprint(scene, true, p, scene.real)[0]
    power = albedo * cos_i * (100 / np.where(back, R, 1e3)) ** 2
    rays = replace(aimed, R=np.where(back, R, 1.0), cos_i=np.where(back, cos_i, 1.0), power=power)
    part = rays.part(back)
    recorded = part.R + scene.sigma[0] * random.standard_normal(len(part.R))
    for name, p in drawn:
        recorded = recorded + effects.range_errors(name, p, part)
        if name != "angle_noise" and (name in effects.SPREAD or name in effects.OFF_SPREAD):
            recorded = recorded + np.sqrt(effects.variance(name, p, part)) * random.standard_normal(len(recorded))
    ranges = np.full(len(R), np.nan)
    ranges[back] = recorded
    for name, p in drawn:
        ranges = _returned(name, p, rays, ranges, random)
    return Shot(rays, ranges, blob)


def _returned(name: str, p: Parameters, rays: Rays, ranges: Array, random: Random) -> Array:
    """Return recorded ranges after quantisation and losses."""
    match name:
        case "range_quantization":
            return p["step_m"] * np.rint(ranges / p["step_m"])
        case "detection_limit":
            return np.where(rays.power >= p["minimum_power"], ranges, np.nan)
        case "off_loss_sector":
            hit = (np.abs(rays.az - p["where"]) < p["width"] / 2) & (random.uniform(size=len(ranges)) < p["share"])
            return np.where(hit, np.nan, ranges)
        case "precipitation":
            chance, which, place = random.uniform(size=(3, len(ranges)))
            lost = chance > np.exp(-2 * p["rate_per_m"] * rays.R)
            drop = -np.log1p(-place * -np.expm1(-2 * p["rate_per_m"] * (rays.R - 1))) / (2 * p["rate_per_m"]) + 1
            early = lost & (which < p["early_share"]) & np.isfinite(ranges)
            return np.where(early, drop, np.where(lost, np.nan, ranges))
    return ranges


def _write(folder: Path, scene: Set, shot: Shot, kept: Array) -> None:
    """Write the folder; optional fields that are not given are absent."""
    az, ze, _, share = _grid(scene)
    points = (_directions(az, ze) * shot.ranges[:, None])[kept]
    if scene.frame == "world":
        points = scene.place.to_world(points @ scene.rotation.T + scene.position)
    columns = {"intensity": shot.rays.power[kept], "gps_time": (1e3 + 2e-5 * len(share) * share)[kept]}
    fields = {name: values for name, values in columns.items() if name in scene.fields}
    file = "scan.ply" if fields else "scan.xyz"
    write_points(folder / file, points, fields)
    write_mesh(folder / "wall.ply", scene.place.to_world(scene.known.vertices), scene.known.faces)
    noise = {"range_sigma_m": scene.sigma[0], "angle_sigma_rad": scene.sigma[1]}
    write_yaml(
        folder / "model.yaml",
        {"sensor": "tls", "noise": noise, "effects": [{"name": name, **p} for name, p in scene.known_effects]},
    )
    sweep = {
        key: [angles[0], angles[-1] + 1e-9, angles[1] - angles[0]]
        for key, angles in (("azimuth_rad", scene.azimuth), ("zenith_rad", scene.zenith))
    }
    station = {"position_m": scene.place.to_world(scene.position), "rotation": scene.place.rotation @ scene.rotation}
    settings = {"sensor": "tls", "reference": "wall.ply", "points": file, "frame": scene.frame, "scanner": station}
    pattern = {"pattern": sweep} if "pattern" in scene.fields else {}
    write_yaml(folder / "measurement.yaml", {**settings, **pattern, "model": "model.yaml"})
