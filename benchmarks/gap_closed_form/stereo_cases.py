"""Make a stereo pair's measurement folder by brute-force projection.

Matches are found through the real cameras, points by the nominal ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gap_closed_form import stereo_effects as effects
from benchmarks.gap_closed_form.baselines import Data, rivals
from benchmarks.gap_closed_form.casting import Array, Surface
from benchmarks.gap_closed_form.files import write_mesh, write_points, write_yaml
from benchmarks.gap_closed_form.stereo_cameras import INTERIOR, Frame, Pair, Rectified, looking_at
from benchmarks.gap_closed_form.stereo_effects import Image, Parameters
from benchmarks.gap_closed_form.strength import (
    Strength,
    Target,
    Whitener,
    mean_strength,
    scaled,
    spread_distance,
    spread_strength,
)
from benchmarks.gap_closed_form.walls import (
    Fall,
    Place,
    Random,
    Wall,
    draw_falls,
    draw_place,
    draw_wall,
    small_turn,
    wave_numbers,
    waves,
)

CATALOGUE = (*effects.CAMERA, *effects.IMAGE, *effects.SPREAD, *effects.RASTER)
OFF_CATALOGUE = (*effects.OFF_MEAN, *effects.OFF_SPREAD)
_LINEAR = {**effects.CAMERA, **effects.IMAGE, **effects.OFF_MEAN}
_SPREADING = {**effects.SPREAD, **effects.OFF_SPREAD}
Drawn = list[tuple[str, Parameters, Strength]]
_LOST = 0.02
_STEP_PX = 32.0
_POSES = 5
"""Gauss-Newton steps for the best pose; after three, the residuals change by at most 2 %, also for rotations of 20 mrad."""
_STEEP, _WEIGHTLESS = 6.0, 1e12
"""Neighbours that differ by more than so many typical differences are depth steps, where the reference is not known well enough
to count for an effect's strength; variance, px^2, that expresses this.
"""


@dataclass(frozen=True)
class Set:
    """The set-up of a case.

    Attributes
    ----------
    nominal : The calibrated pair, local frame.
    pose : Shift (m) and rotation (rad) of both cameras relative to it.
    registration : Registration of the points afterwards.
    noise : Parallax and regularisation noise, px.
    cells : Left pixels (rows, columns).
    """

    wall: Wall
    real: Surface
    known: Surface
    place: Place
    falls: list[Fall]
    nominal: Rectified
    pose: Array
    registration: Array
    noise: tuple[float, float]
    reference: tuple[float, float]
    u: Array
    v: Array
    step: int
    fields: set[str]
    blobs: bool

    @property
    def world(self) -> Array:
        """(3, 3) world to local."""
        return self.place.rotation.T

    def as_placed(self) -> Pair:
        """Return the calibrated pair where it really stood."""
        return self.nominal.pair.moved(self.pose[:3], small_turn(self.pose[3:]))


def make(
    folder: Path, random: Random, kinds: list[str], falls: int, points: int, nodes: int, baselines: bool = True
) -> dict[str, Any]:
    """Write a measurement with the effects `kinds`, and return its truth, with or without the answers of the baselines."""
    scene = _draw(random, kinds, falls, points, nodes)
    plain, where = _disparity(scene, scene.nominal.pair, scene.known)
    usable = np.isfinite(plain) & scene.nominal.pair.seen_by_right(scene.known, np.nan_to_num(where))
    blob = _blobs(scene, where, random)
    u, v = scene.u.ravel(), scene.v.ravel()
    size = scene.nominal.pair.left.width, scene.nominal.pair.left.height
    v_right = scene.nominal.pair.right.project(np.nan_to_num(where, nan=1.0))[1]
    chosen = np.flatnonzero(usable & ~blob)
    part = Image(u[chosen], v[chosen], plain[chosen], v_right[chosen], size)
    base, families = _columns(scene, part) if baselines or set(kinds) & set(_LINEAR) else (np.zeros((len(chosen), 0)), {})
    drawn = _drawn(scene, kinds, part, base, families, where[chosen], plain, chosen, random)
    found = _observe(scene, drawn, blob, random)
    kept = np.isfinite(found)
    _write(folder, scene, found, kept)
    return {
        "sensor": "stereo",
        "points": int(kept.sum()),
        "distance_m": float(np.nanmedian(np.linalg.norm(where - scene.nominal.pair.left.position, axis=1))),
        "fields": sorted(scene.fields),
        "effects": [{"name": name, "parameters": p, **strength.to_dict()} for name, p, strength in drawn],
        "changes": [fall.world_box(scene.wall, scene.place) for fall in scene.falls],
        "nuisances": {
            "parallax_sigma_px": scene.noise[0],
            "regularization_sigma_px": scene.noise[1],
            "reference_m": scene.reference,
        },
        "known": [],
        **(_rivals(scene, drawn, part, (found - plain)[chosen], base, families, where[chosen]) if baselines else {}),
    }


def _rivals(
    scene: Set, drawn: Drawn, part: Image, value: Array, base: Array, families: dict[str, list[Array]], where: Array
) -> dict[str, Any]:
    """Return the answers of the baselines to the disparity errors `value` (n,), NaN without a match, at the points `where`."""
    rows = np.isfinite(value)
    sigma = np.full(int(rows.sum()), np.hypot(scene.noise[0], scene.noise[1] * 2 / 3))
    data = Data(value[rows], sigma, base[rows], where[rows][:, [0, 2]])
    truth = [_signature(scene, name, p, part)[rows] for name, p, _ in drawn if name in (*effects.CAMERA, *effects.IMAGE)]
    some = {name: [design[rows] for design in designs] for name, designs in families.items()}
    return rivals(data, some, {"parallax_noise": [np.ones(int(rows.sum()))]}, truth)


def _draw(random: Random, kinds: list[str], falls: int, points: int, nodes: int) -> Set:
    wall = draw_wall(random, nodes, bool(set(kinds) & set(effects.RASTER)) or random.uniform() < 0.5)
    width, height = wall.size
    distance = float(np.clip(random.uniform(1.0, 2.2) * max(width, height), 30, 120))
    base = distance / random.uniform(4.5, 8)
    middle = np.array([width / 2, 0.0, height / 2])
    stand = np.array([random.uniform(0.3, 0.7) * width, -distance, random.uniform(-2, 0.6 * height)])
    pixels = (1840, 1228) if random.uniform() < 0.7 else (3680, 2456)
    f = 0.82 * pixels[0] * distance / max(width + base, 1.5 * height)
    cameras = [
        _camera(random, pixels, f, stand + np.array([side * base / 2, random.uniform(-1, 1), random.uniform(-1, 1)]), middle)
        for side in (-1, 1)
    ]
    pair = Pair(*cameras)
    reference = random.uniform(1e-3, 4e-3), random.uniform(1.5, 6.0)
    found = draw_falls(wall, falls, random)
    x, z = wall.nodes()
    known = wall.deeper(reference[0] * waves(x, z, reference[1], random))
    u, v, step = _cells(pair.left, wall, points, random)
    return Set(
        wall=wall,
        real=wall.deeper(sum((fall.change(wall) for fall in found), np.zeros_like(wall.depth))).surface(),
        known=known.surface(),
        place=draw_place(random),
        falls=found,
        nominal=Rectified(
            pair, float(pair.left.interior["f_px"] if random.uniform() < 0.5 else np.mean([c.interior["f_px"] for c in cameras]))
        ),
        pose=np.concatenate([5e-3 * random.standard_normal(3), 5e-5 * random.standard_normal(3)]),
        registration=(random.uniform() < 0.5)
        * np.concatenate([5e-3 * random.standard_normal(3), 5e-5 * random.standard_normal(3)]),
        noise=(float(random.uniform(0.1, 0.4)), float(random.uniform(0.03, 0.15))),
        reference=reference,
        u=u,
        v=v,
        step=step,
        fields={"pixels"} if random.uniform() < 0.75 else set(),
        blobs=bool(random.uniform() < 0.3),
    )


def _camera(random: Random, pixels: tuple[int, int], f: float, position: Array, target: Array) -> Frame:
    interior = dict.fromkeys(INTERIOR, 0.0)
    interior |= {
        "f_px": f * (1 + 1e-3 * random.standard_normal()),
        "cx_px": 10 * random.standard_normal(),
        "cy_px": 10 * random.standard_normal(),
    }
    interior |= {"b1": 0.5 * random.standard_normal(), "b2": 0.3 * random.standard_normal()}
    interior |= {"k1": random.uniform(-0.08, 0.0), "k2": random.uniform(0.0, 0.06)}
    interior |= {"p1": 2e-4 * random.standard_normal(), "p2": 2e-4 * random.standard_normal()}
    aim = target + np.array([random.uniform(-1, 1), 0, random.uniform(-1, 1)])
    return Frame(
        *pixels,
        {key: float(value) for key, value in interior.items()},
        position,
        looking_at(position, aim, random.uniform(-0.02, 0.02)),
    )


def _cells(left: Frame, wall: Wall, points: int, random: Random) -> tuple[Array, Array, int]:
    """Return left pixels in a raster over the part of the frame that the wall fills."""
    u, v = left.project(wall.vertices)
    ends = [(max(values.min(), 1.0), min(values.max(), size - 1.0)) for values, size in ((u, left.width), (v, left.height))]
    step = int(max(np.rint(np.sqrt((ends[0][1] - ends[0][0]) * (ends[1][1] - ends[1][0]) / points)), 2))
    first = 0.5 if random.uniform() < 0.3 else step / 2
    columns, rows = (np.arange(np.ceil((low - first) / step), (high - first) / step) * step + first for low, high in ends)
    grid = np.meshgrid(columns, rows)
    return grid[0], grid[1], step


def _disparity(scene: Set, real: Pair, surface: Surface, rows: Any = slice(None)) -> tuple[Array, Array]:
    """Return the (n,) disparity, in the nominal rectified pair, of what the real pair sees at the left pixels, and the points."""
    u, v = scene.u.ravel()[rows], scene.v.ravel()[rows]
    u_right, v_right, points = real.matches(surface, u, v)
    return scene.nominal.disparity(u, v, u_right, v_right), points


def _blobs(scene: Set, where: Array, random: Random) -> Array:
    hidden = np.zeros(len(where), dtype=bool)
    if scene.blobs:
        for _ in range(random.integers(1, 5)):
            centre = random.uniform(0, 1, 2) * scene.wall.size
            hidden |= np.hypot(*(where[:, [0, 2]] - centre).T) < random.uniform(0.4, 1.6)
    return hidden


def _at_steps(disparity: Array) -> Array:
    """Return the (h, w) mask of pixels beside a depth step, or beside a pixel without a disparity."""
    found = np.zeros(disparity.shape, dtype=bool)
    for axis in (0, 1):
        steps = np.diff(disparity, axis=axis)
        size = np.abs(steps - np.nanmedian(steps))
        steep = ~(size < _STEEP * 1.4826 * np.nanmedian(size))
        before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
        before[axis], after[axis] = (0, 1), (1, 0)
        found |= np.pad(steep, before) | np.pad(steep, after)
    return found


def _signature(scene: Set, name: str, p: Parameters, part: Image) -> Array:
    """(n,) change of the disparity on the reference, px."""
    if name in effects.CAMERA or name == "row_jitter":
        return _seen(scene, effects.real_pair(scene.nominal.pair, name, p, scene.world), part)
    return effects.disparity_errors(name, p, part)


def _seen(scene: Set, real: Pair, part: Image) -> Array:
    u_right, v_right, _ = real.matches(scene.known, part.u, part.v)
    return np.nan_to_num(scene.nominal.disparity(part.u, part.v, u_right, v_right) - part.disparity)


def _columns(scene: Set, part: Image) -> tuple[Array, dict[str, list[Array]]]:
    """Return the effect of the pose (n, 6), and the designs of every mean effect."""
    pose = []
    for axis in range(6):
        nudge = np.zeros(6)
        nudge[axis] = 1e-3 if axis < 3 else 1e-5
        moved = scene.nominal.pair.moved(nudge[:3], small_turn(nudge[3:]))
        pose.append(_seen(scene, moved, part) / nudge[axis])
    families: dict[str, list[Array]] = {}
    known: dict[str, Array] = {}
    for name, units in effects.variants():
        columns = []
        for unit in units:
            key = f"{name} {[(k, v) for k, v in unit.items() if v]}"
            if key not in known:
                known[key] = _signature(scene, name, unit, part)
            columns.append(known[key])
        families.setdefault(name, []).append(np.stack(columns, axis=1))
    return np.stack(pose, axis=1), families | effects.waves(part)


def _drawn(
    scene: Set,
    kinds: list[str],
    part: Image,
    base: Array,
    families: dict[str, list[Array]],
    where: Array,
    plain: Array,
    chosen: Array,
    random: Random,
) -> Drawn:
    """Draw effects, each scaled so that it alone has its drawn strength; returned strengths are those beside the others."""
    white = np.full(len(part.u), scene.noise[0] ** 2 + 4 / 9 * scene.noise[1] ** 2)
    unknown = np.where(_at_steps(plain.reshape(scene.u.shape)).ravel()[chosen], _WEIGHTLESS, 0.0)
    found: list[tuple[str, Parameters, Strength | None]] = []
    for kind in kinds:
        target = Target.draw(random)
        if kind in _LINEAR:
            start, most = _LINEAR[kind]
            unit = effects.shape(kind, part, random)
            alone = mean_strength(
                kind, _shown(scene, kind, unit, part), base, families, _whitener(scene, white + unknown, part, where, unit)
            )
            found.append((kind, effects.times(unit, min(target.value / max(target.of(alone), 1e-9), most / start)), None))
        elif kind == "regularization_noise":
            found.append((kind, *_regularization(scene, part, effects.shape(kind, part, random), target.value)))
        elif kind in _SPREADING:
            start, most = _SPREADING[kind]
            unit = effects.shape(kind, part, random)
            added = effects.variance(kind, unit, part)
            factor = scaled(lambda f: spread_distance(white + f**2 * added, white), target.value, most / start)  # noqa: B023
            found.append((kind, effects.times(unit, factor), None))
        else:
            found.append((kind, *_raster(kind, scene, plain, chosen, white[0], random)))
    added = {kind: effects.variance(kind, p, part) for kind, p, _ in found}
    whole = sum(added.values(), white)
    spread = {kind: _whitener(scene, whole + unknown, part, where, p) for kind, p, _ in found if kind in _LINEAR}
    shown = {kind: _left_by_pose(scene, kind, p, part, base, spread[kind])[:, None] for kind, p, _ in found if kind in _LINEAR}
    strong = []
    for kind, p, strength in found:
        if kind in _LINEAR:
            beside = np.concatenate([base, *(column for other, column in shown.items() if other != kind)], axis=1)
            strength = mean_strength(kind, shown[kind][:, 0], beside, families, spread[kind])
        elif strength is None:
            strength = spread_strength(kind, added[kind], whole - added[kind], {"parallax_noise": [np.ones_like(white)]})
        strong.append((kind, p, strength))
    return strong


def _shown(scene: Set, kind: str, p: Parameters, part: Image) -> Array:
    """Return the mean change (n,) of the disparity by an effect, px.

    Locking acts on the noisy disparity, which reduces its mean over the true one.
    """
    damping = float(np.exp(-2 * np.pi**2 * scene.noise[0] ** 2)) if kind == "pixel_locking" else 1.0
    return damping * _signature(scene, kind, p, part)


def _left_by_pose(scene: Set, kind: str, p: Parameters, part: Image, base: Array, whiten: Whitener) -> Array:
    """Return the (n,) mean change of the disparity at the pose of both cameras that hides most of it, by Gauss-Newton.

    base: (n, 6) change by shifts (m) and rotations (rad) of both. A principal point 10 px off is mostly a rotation of both
    cameras. Linearised at the original pixels, much of it would remain beside ledges; with the rotation itself, the cameras see
    the same places as before, and nothing remains.
    """
    shown = _shown(scene, kind, p, part)
    if kind not in effects.CAMERA:
        return shown
    fixed, pose, least = whiten(base), np.zeros(6), np.inf
    for _ in range(_POSES):
        pair = scene.nominal.pair.moved(pose[:3], small_turn(pose[3:]))
        found = _seen(scene, effects.real_pair(pair, kind, p, scene.world), part)
        columns = whiten(found)[:, 0]
        step = np.linalg.lstsq(fixed, columns, rcond=None)[0]
        size = float(np.linalg.norm(columns - fixed @ step))
        if size < least:
            shown, least = found, size
        pose = pose - step
    return shown


def _whitener(scene: Set, variance: Array, part: Image, where: Array, p: Parameters) -> Whitener:
    """Return the whitening. Its correlated part is the reference's error, by its change of the disparity.

    Regularisation noise counts as white noise with its power at the effect's wavelength: N sigma^2 for N points per node of its
    grid, less for a short row jitter (sinc^4).
    """
    at = where[:, [0, 2]]
    waved = wave_numbers(scene.reference[1], 200, np.random.default_rng(0))
    angle = at @ waved.T
    per_metre = part.disparity**2 / (scene.nominal.f * scene.nominal.base)
    error = np.concatenate([np.sin(angle), np.cos(angle)], axis=1) * (scene.reference[0] / np.sqrt(200) * per_metre)[:, None]
    power = (_STEP_PX / scene.step) ** 2 * np.sinc(_STEP_PX / p.get("rows_per_cycle", np.inf)) ** 4
    return Whitener(np.sqrt(variance + max(power - 4 / 9, 0.0) * scene.noise[1] ** 2), at, error)


def _regularization(scene: Set, part: Image, unit: Parameters, target: float) -> tuple[Parameters, Strength]:
    """Draw regularisation noise, whose strength follows from the variance of the grid's nodes seen through the pixels' noise."""
    step = unit["step_px"]
    nodes = len(np.unique(np.floor(part.u / step) + 10_000 * np.floor(part.v / step)))
    noise = scene.noise[0] ** 2 * nodes / len(part.u) + 4 / 9 * scene.noise[1] ** 2 * min(1.0, (_STEP_PX / step) ** 2)
    one = np.ones(nodes)
    factor = scaled(lambda f: spread_distance(noise + 4 / 9 * (f * unit["sigma_px"]) ** 2 * one, noise * one), target, 50.0)
    snr = spread_distance(noise + 4 / 9 * (factor * unit["sigma_px"]) ** 2 * one, noise * one)
    return effects.times(unit, factor), Strength(snr, "parallax_noise", snr)


def _raster(kind: str, scene: Set, plain: Array, chosen: Array, white: float, random: Random) -> tuple[Parameters, Strength]:
    """Draw an effect on neighbourhoods: its size is drawn, and its strength is what that gives on the reference."""
    key, low, high = {
        "edge_fattening": ("radius_px", 1.0, 4.0),
        "smoothing": ("sigma_px", 0.4, 3.0),
        "occlusion_fill": ("reach_px", 2.0, 16.0),
    }[kind]
    p = {key: scene.step * float(random.uniform(low, high))}
    known = np.full(scene.u.size, np.nan)
    known[chosen] = plain[chosen]
    after = effects.raster_effect(kind, p, known.reshape(scene.u.shape), scene.step).ravel()
    if kind == "occlusion_fill":
        snr = float(np.sqrt(2 * np.sum(np.isfinite(after) & np.isnan(known))))
    else:
        snr = float(np.linalg.norm(np.clip(np.nan_to_num(after - known) / np.sqrt(white), -20, 20)))
    return p, Strength(snr, "", snr)


def _observe(scene: Set, drawn: Drawn, blob: Array, random: Random) -> Array:
    """Return the (n,) disparities found at the left pixels, NaN without a match: expose, match, fill."""
    real = scene.as_placed()
    jitter = {}
    for name, p, _ in drawn:
        real = effects.real_pair(real, name, p, scene.world)
        jitter |= real.jitter
    disparity, points = _disparity(scene, real, scene.real)
    inside = np.isfinite(disparity)
    u_right, v_right = real.right.project(np.nan_to_num(points))
    inside &= (u_right > 0) & (u_right < real.right.width) & (v_right > 0) & (v_right < real.right.height)
    seen = inside & real.seen_by_right(scene.real, np.nan_to_num(points)) & ~blob
    raster = np.where(seen, disparity, np.nan).reshape(scene.u.shape)
    for kind in ("edge_fattening", "smoothing"):
        for name, p, _ in drawn:
            raster = effects.raster_effect(name, p, raster, scene.step) if name == kind else raster
    found = raster.ravel()
    image = Image(scene.u.ravel(), scene.v.ravel(), found, v_right, (real.left.width, real.left.height))
    found = found + _grid_noise(scene.noise[1], _STEP_PX, image, random) + scene.noise[0] * random.standard_normal(len(found))
    kept = np.isfinite(found)
    for name, p, _ in drawn:
        if name == "regularization_noise":
            found = found + _grid_noise(p["sigma_px"], p["step_px"], image, random)
        elif name in effects.SPREAD or name in effects.OFF_SPREAD:
            part = Image(image.u[kept], image.v[kept], found[kept], v_right[kept], image.size)
            found[kept] += np.sqrt(effects.variance(name, p, part)) * random.standard_normal(int(kept.sum()))
    for name, p, _ in drawn:
        if name not in effects.CAMERA and name != "row_jitter":
            part = Image(image.u[kept], image.v[kept], found[kept], v_right[kept], image.size)
            found[kept] += effects.disparity_errors(name, p, part)
    found = np.where(random.uniform(size=len(found)) < _LOST, np.nan, found)
    for name, p, _ in drawn:
        if name == "occlusion_fill":
            found = effects.raster_effect(name, p, found.reshape(scene.u.shape), scene.step).ravel()
    return found


def _grid_noise(sigma: float, step: float, image: Image, random: Random) -> Array:
    """(n,) independent normal values on a grid over the frame, interpolated bilinearly."""
    shape = int(image.size[1] / step) + 2, int(image.size[0] / step) + 2
    nodes = sigma * random.standard_normal(shape)
    i, j = (image.v / step).astype(int), (image.u / step).astype(int)
    a, b = image.v / step - i, image.u / step - j
    upper = (1 - b) * nodes[i, j] + b * nodes[i, j + 1]
    return (1 - a) * upper + a * ((1 - b) * nodes[i + 1, j] + b * nodes[i + 1, j + 1])


def _write(folder: Path, scene: Set, found: Array, kept: Array) -> None:
    """Write the folder; optional fields that are not given are absent."""
    u, v = scene.u.ravel()[kept], scene.v.ravel()[kept]
    points = scene.nominal.points(u, v, found[kept])
    centre = points.mean(axis=0)
    points = (points - centre) @ small_turn(scene.registration[3:]).T + centre + scene.registration[:3]
    fields = {"pixel_x": u, "pixel_y": v} if "pixels" in scene.fields else {}
    file = "surface.ply" if fields else "surface.xyz"
    write_points(folder / file, scene.place.to_world(points), fields)
    write_mesh(folder / "wall.ply", scene.place.to_world(scene.known.vertices), scene.known.faces)
    noise = {"parallax_sigma_px": scene.noise[0], "regularization_sigma_px": scene.noise[1], "regularization_step_px": _STEP_PX}
    write_yaml(folder / "model.yaml", {"sensor": "stereo", "noise": noise, "effects": []})
    cameras = {
        side: {
            "width": camera.width,
            "height": camera.height,
            **camera.interior,
            "position_m": scene.place.to_world(camera.position),
            "rotation": scene.place.rotation @ camera.rotation,
        }
        for side, camera in (("left", scene.nominal.pair.left), ("right", scene.nominal.pair.right))
    }
    write_yaml(folder / "cameras.yaml", cameras)
    write_yaml(
        folder / "measurement.yaml",
        {
            "sensor": "stereo",
            "reference": "wall.ply",
            "points": file,
            "frame": "world",
            "cameras": "cameras.yaml",
            "model": "model.yaml",
        },
    )
